"""States on the constraints g(q, t) = 0 of a system: residuals, projection, multipliers, initial consistency."""

import re

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.errors import AccuracyWarning, MethodError, StateError, warn
from scvi_codegen.native.arguments import checked_number
from scvi_codegen.native.options import REASONS, STATUS
from scvi_codegen.rendering.text import INPUT_PRECISION, LARGEST_VIOLATION, ROUNDING_UNITS
from scvi_codegen.runtime.constraints.rank import Jacobian, nearly_dependent, rank_deficiency
from scvi_codegen.runtime.core.integrator import Integrator
from scvi_codegen.runtime.core.validation import (
    Array,
    Parameters,
    States,
    checked_states,
    checked_vector,
    inputs_not_given,
    missing_input,
)

MOST_SHOWN, MOST_DENSE = 4, 64
"""Largest numbers of positions and constraints in a message, and of those whose rank is checked at run-time sizes."""


def constraint_values(stepper: Integrator, q: States, p: States, t: ArrayLike, parameters: Parameters) -> Array:
    """Return (2, n, c) values of g and of its rate g_q v + g_t at states."""
    times, positions, momenta = _of_constrained(stepper, q, p, t)
    values = np.empty((2, len(times), len(stepper.constraints)))
    _call(stepper, "constraint_values", times, positions, momenta, parameters, *values)
    return values


def multipliers(stepper: Integrator, q: States, p: States, t: ArrayLike, parameters: Parameters) -> Array:
    """Return (n, c) lambda of d/dt L_v = L_q + f + g_q^T lambda at states, in physical time t."""
    times, positions, momenta = _of_constrained(stepper, q, p, t)
    values = np.empty((len(times), len(stepper.constraints)))
    _call(stepper, "multipliers", times, positions, momenta, parameters, values)
    if stepper.interface.energy_parameter:
        values /= stepper.rates(positions, momenta, parameters)[:, np.newaxis]
    return values


def projected(
    stepper: Integrator, q: States, p: States, t: float, parameters: Parameters
) -> tuple[Array, Array, Array]:
    """Return the nearest state on the constraints, and (2,) its relative distance in q and in p.

    Distances are in the metric of the mass matrix at the projected state, hence independent of coordinate units.

    Raises:
        StateError: if the iteration fails, or if the constraints are linearly dependent there.
    """
    q0, p0 = checked_vector(stepper.interface, q, "q"), checked_vector(stepper.interface, p, "p")
    _of_constrained(stepper, q0, p0, t)
    binding, q1, p1 = stepper.binding, np.empty_like(q0), np.empty_like(p0)
    values = stepper._parameters(parameters)
    status = binding.function("project")(
        checked_number(t, "the time t"), *map(binding.pointer, (q0, p0, values, q1, p1)), binding.workspace()
    )
    if status:
        if wrong := _dependent(stepper, q0, t, parameters, nearest=True):
            raise StateError(f"projection onto the constraints failed near q = {_shown(q0)}: {wrong}")
        _refuse(stepper, status, q0)
    apart = np.empty(2)
    status = binding.function("apart")(t, *map(binding.pointer, (q0, p0, q1, p1, values, apart)), binding.workspace())
    if status:
        _refuse(stepper, status, q0)
    return q1, p1, apart


def consistent(
    stepper: Integrator, q: States, p: States, t: float, parameters: Parameters, *, check_rank: bool = True
) -> tuple[Array, Array]:
    """Return an initial state projected onto the constraints; warn unless rounding explains the distance.

    Raises:
        StateError: if the state is far from the constraints, if these are linearly dependent there
            (``check_rank``), or if an input that occurs in a constraint is not set.
    """
    for name in inputs_not_given(stepper.interface, parameters):
        if any(re.search(rf"\b{name}\b", formula) for formula in stepper.constraints):
            raise missing_input(name)
    q0, p0 = checked_vector(stepper.interface, q, "q"), checked_vector(stepper.interface, p, "p")
    q1, p1, apart = projected(stepper, q0, p0, t, parameters)
    if check_rank and (wrong := _dependent(stepper, q1, t, parameters)):
        raise StateError(f"{wrong} (q = {_shown(q1)})")
    moved = float(apart.max())
    if moved <= ROUNDING_UNITS * np.finfo(float).eps:
        return q0, p0
    if moved <= INPUT_PRECISION:
        return q1, p1
    worst = _worst(stepper, q0, p0, t, parameters)
    message = f"the initial state violates the constraints by {moved:.1e} (relative): {worst}"
    if moved > LARGEST_VIOLATION:
        raise StateError(f"{message}. Use stepper.project(q, p) for the nearest consistent state")
    warn(f"{message}. It was projected onto the constraints", AccuracyWarning)
    return q1, p1


def _worst(stepper: Integrator, q: Array, p: Array, t: float, parameters: Parameters) -> str:
    """Describe the largest residual of the constraints and of their rates, omitting one that is 0 up to rounding."""
    values = constraint_values(stepper, q, p, t, parameters)[:, 0]
    worst = np.abs(values).argmax(axis=1)
    largest = values[np.arange(2), worst]
    names = [stepper.constraints[k] for k in worst]
    if not any(f"{q}_dot" in names[1] for q in stepper.coordinates):  # a velocity constraint is a rate itself
        names[1] = f"the rate of {names[1]}"
    descriptions = [
        f"{name} is {value:.3g}"
        for name, value in zip(names, largest, strict=True)
        if abs(value) > ROUNDING_UNITS * np.finfo(float).eps * np.abs(largest).max()
    ]
    return f"{' and '.join(descriptions)}, not 0"


def check_reachable(stepper: Integrator, q: Array, p: Array, t: float, parameters: Array) -> None:
    """Raise :class:`StateError` if new parameters move the position constraints away from the state (q, p) of a run.

    Rates may jump: an impulse along the constraint gradients then changes the momenta. Positions cannot jump.
    """
    moved = projected(stepper, q, p, t, parameters)[2][0]
    if moved > INPUT_PRECISION:
        g = constraint_values(stepper, q, p, t, parameters)[0, 0]
        k = int(np.abs(g).argmax())
        raise StateError(
            f"at t = {t:g} the position constraint {stepper.constraints[k]} jumps to {g[k]:.3g}: inputs and parameters "
            "in position constraints must be continuous, as 'linear' and 'cubic' inputs are"
        )


def _of_constrained(stepper: Integrator, q: States, p: States, t: ArrayLike) -> tuple[Array, Array, Array]:
    if not stepper.constraints:
        raise MethodError(f"'{stepper.interface.system}' has no constraints")
    return checked_states(stepper.interface, q, p, t)


def _call(
    stepper: Integrator, name: str, times: Array, q: Array, p: Array, parameters: Parameters, *results: Array
) -> None:
    pointer = stepper.binding.pointer
    values = stepper._parameters(parameters)
    status = stepper.binding.function(name)(
        len(times), *map(pointer, (times, q, p, values, *results)), stepper.binding.workspace()
    )
    if status:
        _refuse(stepper, status, q)


def _dependent(stepper: Integrator, q: Array, t: float, parameters: Parameters, *, nearest: bool = False) -> str:
    """Return the message of :func:`rank_deficiency`; "" for run-time sizes too large for dense linear algebra."""
    if stepper.interface.layout.coordinates and max(stepper.dimension, len(stepper.constraints)) > MOST_DENSE:
        return ""
    return rank_deficiency(stepper.constraints, q, _linearised(stepper, t, parameters), nearest=nearest)


def singular_position(stepper: Integrator, q: Array, t: float, parameters: Array) -> str:
    """Return a remark on a failed step from positions where the constraints are nearly dependent, or ""."""
    if not stepper.constraints or max(stepper.dimension, len(stepper.constraints)) > MOST_DENSE:
        return ""
    return nearly_dependent(_linearised(stepper, t, parameters)(q)[1])


def _linearised(stepper: Integrator, t: float, parameters: Parameters) -> Jacobian:
    """Return a function that evaluates g and G by unit velocities; NaN where velocities have no momenta."""
    unit = np.concatenate([np.zeros((1, stepper.dimension)), np.eye(stepper.dimension)])

    def at(q: Array) -> tuple[Array, Array]:
        positions = np.tile(q, (len(unit), 1))
        try:
            momenta = stepper.momentum(positions, unit, t, parameters)
            g, rates = constraint_values(stepper, positions, momenta, t, parameters)
        except StateError:
            return np.full(len(stepper.constraints), np.nan), np.full((len(stepper.constraints), len(q)), np.nan)
        return g[0], (rates[1:] - rates[0]).T

    return at


def _shown(q: Array) -> str:
    return np.array2string(q, threshold=2 * MOST_SHOWN)


def _refuse(stepper: Integrator, status: int, q: Array) -> None:
    hint = "; check for redundant or contradictory constraints" if "singular" in STATUS[status] else ""
    shown = ", ".join(stepper.constraints[:MOST_SHOWN]) + ", .." * (len(stepper.constraints) > MOST_SHOWN)
    raise StateError(f"the constraints {shown} cannot be satisfied near q = {_shown(q)}: {REASONS[status]}{hint}")
