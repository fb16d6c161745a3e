"""Time transformation dt = g dtau: partial steps that end at a time t, and dense output.

A run in transformed time takes steps of tau and integrates t with the method's own quadrature. Arguments and results
refer to t: velocities are dq/dt and energies are those of the original system.
"""

import numpy as np

from scvi_codegen.native.options import SolverOptions, step_failure
from scvi_codegen.runtime.core.integrator import Integrator
from scvi_codegen.runtime.core.validation import Array
from scvi_codegen.runtime.trajectory.saved_states import SavedStates


def part_of_step(
    stepper: Integrator,
    t: float,
    h: float,
    end: float,
    q: Array,
    p: Array,
    parameters: Array,
    options: SolverOptions | None,
) -> tuple[Array, Array, float]:
    """Return the state at the time ``end`` within a step of h from (q, p) at t, and the fraction of the step taken.

    Raises:
        StepFailedError: if a partial step fails.
    """
    binding = stepper.binding
    start_q, start_p, q1, p1 = (np.array(x, dtype=float) for x in (q, p, q, p))
    part, report = binding.numbers("double *"), binding.new("report *")
    status = binding.function("part_of_step")(
        t,
        h,
        end,
        binding.pointer(start_q),
        binding.pointer(start_p),
        binding.pointer(parameters),
        binding.options(options),
        binding.pointer(q1),
        binding.pointer(p1),
        part,
        report,
        binding.workspace(),
    )
    if status:
        raise step_failure(status, report, step=0, h=h)
    return q1, p1, float(part[0])


def states_in_transformed_time(states: SavedStates, times: Array) -> tuple[Array, Array, Array]:
    """Return (n, m) positions and momenta, and (n,) tau, at (n,) times within the range of the saved states."""
    assert states.tau is not None
    (q, p), tau = np.empty((2, len(times), states.q.shape[1])), np.empty(len(times))
    left = np.searchsorted(states.forward * states.t, states.forward * times, side="right") - 1
    for saved in np.unique(left):
        t_near, q_near, p_near, h = _steps_from(states, int(saved))
        for k in np.flatnonzero(left == saved):
            j = int(np.searchsorted(states.forward * t_near, states.forward * times[k], side="right")) - 1
            q[k], p[k], part = q_near[j], p_near[j], 0.0
            if times[k] != t_near[j]:
                q[k], p[k], part = part_of_step(
                    states.stepper, t_near[j], h, times[k], q[k], p[k], states.parameters, states.options
                )
            tau[k] = states.tau[saved] + (j + part) * h
    return q, p, tau


def _steps_from(states: SavedStates, saved: int) -> tuple[Array, Array, Array, float]:
    """Return the states of all steps from a saved state up to the next one, and the size of these steps."""
    assert states.tau is not None
    t, q, p = (array[saved : saved + 1] for array in (states.t, states.q, states.p))
    h = float(np.nan_to_num(states.step_sizes[saved], nan=states.h))
    count = round((states.tau[saved + 1] - states.tau[saved]) / h) if saved + 1 < len(states) else 1
    if count <= 1:
        return t, q, p, h
    positions, momenta = np.empty((2, count - 1, q.shape[1]))
    times = states._restarted(saved, h)._fill(count - 1, positions, momenta)
    return np.append(t, times), np.concatenate([q, positions]), np.concatenate([p, momenta]), h
