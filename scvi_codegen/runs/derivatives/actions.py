"""Action along a run, and the shadow energy that it gives.

The discrete action S_n = sum_k L_d(q_k, q_k+1) is a sum over the quadrature points of the steps, which are solved again
from the saved states. Sums of many steps are compensated (Neumaier, ZAMM 54 (1974) 39).
"""

from math import factorial

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.native.options import SolverOptions, step_failure
from scvi_codegen.common.errors import StateError
from scvi_codegen.runs.derivatives.gradients import pieces, starts_of
from scvi_codegen.runs.results.joining import compensated_sums
from scvi_codegen.runs.results.recomputation import check_recomputed, ends_of_steps
from scvi_codegen.runs.results.saved_states import SavedStates
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.stepping.features import require
from scvi_codegen.runs.stepping.step_derivatives import LinearisedMethod, Starts
from scvi_codegen.runs.stepping.step_plan import FixedSteps

ORDERS = range(2, 25, 2)
"""Orders of the central differences of the shadow energy."""


def actions_of_steps(
    stepper: LinearisedMethod, starts: Starts, parameters: Array, options: SolverOptions | None
) -> tuple[Array, Array]:
    """Return the (n,) actions of n steps without forces and constraints, and their (n, 2m) ends."""
    binding, count = stepper.tangent, len(starts.h)
    (q1, p1), actions = np.empty((2, count, stepper.dimension)), np.empty(count)
    report = binding.new("report *")
    status = binding.function("actions")(
        count,
        *map(binding.pointer, (*starts.arrays, parameters)),
        0,
        binding.options(options),
        *map(binding.pointer, (q1, p1, actions)),
        report,
        binding.workspace(),
    )
    if status:
        k = int(report.steps)
        failures = stepper._failures_from(starts.q[k], starts.p[k], float(starts.t[k]), parameters)
        raise step_failure(status, report, step=k, h=float(starts.h[k]), failures=failures)
    return actions, np.concatenate([q1, p1], axis=1)


def actions_between(states: SavedStates) -> Array:
    """Return the (n - 1,) actions from each saved state to the next."""
    require(states.stepper, "action")
    result = np.zeros(len(states) - 1)
    ends = ends_of_steps(states)
    for first, last in pieces(states):
        starts, _ = starts_of(states, first, last)
        actions, reached = actions_of_steps(states.stepper, starts, states.parameters, states.options)
        if last - first == len(actions):
            result[first:last] = actions
            check_recomputed(states, starts.t, reached, ends[first + 1 : last + 1], ends[first:last])
        else:
            result[first] = compensated_sums(actions)[-1]
            check_recomputed(states, starts.t[-1:], reached[-1:], ends[last : last + 1], ends[first : first + 1])
    return result


def actions_until(states: SavedStates, summed: Array | None) -> Array:
    """Return the (n,) actions from the first saved state to each; ``summed``: those of the run.

    They are computed again where a step was not solved by the fixed-point iteration that sums them. Raises as
    :func:`actions_between`.
    """
    if summed is not None and np.isfinite(summed).all():
        return np.asarray(summed - summed[0])
    return compensated_sums(np.concatenate([[0.0], actions_between(states)]))


def shadow_energy(states: SavedStates, order: int) -> Array:
    """Return (n,) shadow energies, NaN at the first and last ``order / 2`` states; see ``Trajectory.shadow_energy``."""
    half = order // 2
    if order not in ORDERS:
        raise StateError(f"order must be an even number from 2 to {ORDERS[-1]}, not {order!r}")
    steps = np.diff(states.t)
    fixed = isinstance(states.plan, FixedSteps)
    if not fixed or np.ptp(steps) > 1e-6 * abs(steps[0]) or abs(steps[0] - states.h) > 1e-6 * abs(states.h):
        raise StateError("shadow_energy() requires all states of a run of fixed step size: give h and save_every=1")
    if len(states) <= order:
        raise StateError(f"order {order} requires more than {order} states; the run has {len(states)}")
    actions, energies = actions_between(states), np.full(len(states), np.nan)
    inner, p, h = slice(half, len(states) - half), np.asarray(states.p), states.h
    total = np.zeros(len(states) - order)
    for j, weight in enumerate(central_weights(half), 1):
        moved = differences(np.asarray(states.q), half, j)
        acted = np.convolve(actions, np.ones(2 * j), "valid")[half - j : half - j + len(total)]
        total += weight / h * (np.einsum("ij,ij->i", p[inner], moved) - acted)
    energies[inner] = total
    return energies


def central_weights(half: int) -> NDArray[np.float64]:
    """Return the weights of f(j h) - f(-j h), j = 1, 2, .., in the central difference of order 2 ``half``."""
    signs = [
        (-1) ** (j + 1) * factorial(half) ** 2 / (j * factorial(half - j) * factorial(half + j))
        for j in range(1, half + 1)
    ]
    return np.array(signs, dtype=float)


def differences(values: Array, half: int, j: int) -> Array:
    """Return f(+j) - f(-j) at the inner values."""
    count = len(values)
    return np.asarray(values[half + j : count - half + j] - values[half - j : count - half - j])
