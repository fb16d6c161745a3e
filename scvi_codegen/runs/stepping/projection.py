"""States on the constraints g(q, t) = 0 of a system: residuals, projection, multipliers, initial consistency.

Linearly dependent and contradictory constraints are found from the rank of the constraint Jacobian G at a state. G is
computed from the rates G v + g_t, which are linear in v, at unit velocities. A constraint implied by others only on the
constraint manifold (``(u - 1)**2 + y**2 = 1`` by ``x**2 + y**2 = 1`` and ``u = x + 1``) reduces the rank there but not
at generic points.
"""

import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.codegen.native.options import REASONS, STATUS
from scvi_codegen.codegen.rendering.text import INPUT_PRECISION, LARGEST_VIOLATION, ROUNDING_UNITS
from scvi_codegen.common.errors import AccuracyWarning, StateError, of_trajectory, warn
from scvi_codegen.common.tangent_space import DEPENDENT, tangent_space
from scvi_codegen.runs.states.validation import Array, Parameters, States, inputs_not_given, missing_input
from scvi_codegen.runs.states.words import quotient_of
from scvi_codegen.runs.stepping.features import require
from scvi_codegen.runs.stepping.integrator import Integrator

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
    values = np.empty((len(times), len(stepper.constraints) * stepper.interface.words))
    _call(stepper, "multipliers", times, positions, momenta, parameters, values)
    values = stepper._states.numbers(values)
    if stepper.in_tau:
        values = quotient_of(values, stepper.rates(positions, momenta, parameters)[:, np.newaxis])
    return values


def projected(
    stepper: Integrator, q: States, p: States, t: float, parameters: Parameters
) -> tuple[Array, Array, Array]:
    """Return the nearest state on the constraints, and (2,) its relative distance in q and in p.

    Distances are in the metric of the mass matrix at the projected state, hence independent of coordinate units.
    Without constraints it is the state.
    """
    q0, p0 = stepper._states.pair(q, p)
    if not stepper.constraints:
        return q0, p0, np.zeros(2)
    binding, (q1, p1) = stepper.binding, np.empty((2, len(q0) * stepper.interface.words))
    block = stepper._states.block
    before, values = (block(q0), block(p0)), block(stepper._parameters(parameters))
    at = stepper._time_argument(stepper._states.time(t))
    status = binding.function("project")(at, *map(binding.pointer, (*before, values, q1, p1)), binding.workspace())
    if status:
        if wrong := _dependent(stepper, q0, t, parameters, nearest=True):
            raise StateError(f"projection onto the constraints failed near q = {_shown(q0)}: {wrong}")
        _refuse(stepper, status, q0)
    apart = np.empty(2)
    status = binding.function("apart")(at, *map(binding.pointer, (*before, q1, p1, values, apart)), binding.workspace())
    if status:
        _refuse(stepper, status, q0)
    return stepper._states.numbers(q1), stepper._states.numbers(p1), apart


def consistent(
    stepper: Integrator, q: States, p: States, t: float, parameters: Parameters, *, check_rank: bool = True
) -> tuple[Any, Any]:
    """Return an initial state projected onto the constraints; warn unless rounding explains the distance.

    Without constraints it is the state as it is.

    Raises:
        StateError: if the state is far from the constraints, if these are linearly dependent there
            (``check_rank``), or if an input that occurs in a constraint is not set.
    """
    if not stepper.constraints:
        return q, p
    for name in inputs_not_given(stepper.interface, parameters):
        if any(re.search(rf"\b{name}\b", formula) for formula in stepper.constraints):
            raise missing_input(name)
    q0, p0 = stepper._states.pair(q, p)
    binding, states = stepper.binding, (q0, p0, stepper._parameters(parameters), np.empty_like(q0), np.empty_like(p0))
    if binding.has("call_consistent") and not binding.function("call_consistent")(
        stepper._states.time(t), *map(binding.pointer, states), binding.workspace()
    ):
        return states[3], states[4]
    q1, p1, apart = projected(stepper, q0, p0, t, parameters)
    if check_rank and (wrong := _dependent(stepper, q1, t, parameters)):
        raise StateError(f"{wrong} (q = {_shown(q1)})")
    moved = float(apart.max())
    if moved <= ROUNDING_UNITS * np.finfo(float).eps ** stepper.interface.words:
        return q0, p0
    if moved <= INPUT_PRECISION:
        return q1, p1
    worst = _worst(stepper, q0, p0, t, parameters)
    message = f"the initial state violates the constraints by {moved:.1e} (relative): {worst}"
    if moved > LARGEST_VIOLATION:
        raise StateError(f"{message}. Use stepper.project(q, p) for the nearest consistent state")
    warn(f"{message}. It was projected onto the constraints", AccuracyWarning)
    return q1, p1


def make_consistent(stepper: Integrator, q: Array, p: Array, t: float, parameters: Array) -> None:
    """Replace (k, m) states by those of :func:`consistent`, each with its own parameters."""
    of_two_words = stepper.interface.words > 1  # one by one
    for k in range(len(q) if of_two_words else 1):
        with of_trajectory(k):
            q[k], p[k] = consistent(stepper, q[k], p[k], t, parameters[k], check_rank=k == 0)
    if of_two_words:
        return
    q1, p1, apart = np.empty_like(q), np.empty_like(p), np.empty((len(q), 2))
    stepper.binding.of_each("project", t, parameters, q, p, q1, p1, apart)
    moved = apart.max(axis=1)
    by_typing = (moved > ROUNDING_UNITS * np.finfo(float).eps) & (moved <= INPUT_PRECISION)
    q[by_typing], p[by_typing] = q1[by_typing], p1[by_typing]
    for k in np.flatnonzero(~(moved <= INPUT_PRECISION)).tolist():
        with of_trajectory(k):
            q[k], p[k] = consistent(stepper, q[k], p[k], t, parameters[k], check_rank=False)


def _worst(stepper: Integrator, q: Array, p: Array, t: float, parameters: Parameters) -> str:
    """Describe the largest residual of the constraints and of their rates, omitting one that is 0 up to rounding."""
    values = constraint_values(stepper, q, p, t, parameters)[:, 0]
    worst = np.abs(values).argmax(axis=1)
    largest = values[np.arange(2), worst]
    scales = np.full(2, np.abs(largest).max())
    if stepper.dimension <= MOST_DENSE:  # sums of |G_i x_i| of the positions and of the velocities x
        rows = linearised(stepper, t, parameters)(q)[1][worst]
        places = np.stack([q, stepper._transform("velocity", q, p, t, parameters, "p")])
        scales = np.fmax(scales, np.abs(rows * places).sum(axis=1))
    names = [stepper.constraints[k] for k in worst]
    from scvi_codegen.systems.formulas.rotations import RotationNames  # imports SymPy

    members = RotationNames.members_of(stepper.interface.rotations)
    velocities = {f"{x}_dot" for x in stepper.coordinates} | {x.name for member in members for x in member.rates}
    if velocities.isdisjoint(re.findall(r"\w+", names[1])):  # a velocity constraint is a rate itself
        names[1] = f"the rate of {names[1]}"
    descriptions = [
        f"{name} is {value:.3g}"
        for name, value, scale in zip(names, largest, scales, strict=True)
        if abs(value) > ROUNDING_UNITS * np.finfo(float).eps * scale
    ]
    return f"{' and '.join(descriptions)}, not 0"


def check_reachable(stepper: Integrator, q: Array, p: Array, t: float, parameters: Array) -> None:
    """Raise :class:`StateError` if new parameters move the position constraints away from the state (q, p) of a run.

    Rates may jump: an impulse along the constraint gradients then changes the momenta. Positions cannot jump.
    """
    if projected(stepper, q, p, t, parameters)[2][0] > INPUT_PRECISION:
        g = constraint_values(stepper, q, p, t, parameters)[0, 0]
        k = int(np.abs(g).argmax())
        raise StateError(
            f"at t = {t:g} the position constraint {stepper.constraints[k]} jumps to {g[k]:.3g}: inputs and parameters "
            "in position constraints must be continuous, as 'linear' and 'cubic' inputs are"
        )


def _of_constrained(stepper: Integrator, q: States, p: States, t: ArrayLike) -> tuple[Array, Array, Array]:
    if not stepper.constraints:
        require(stepper, "project")
    return stepper._states.rows(q, p, t)


def _call(
    stepper: Integrator, name: str, times: Array, q: Array, p: Array, parameters: Parameters, *results: Array
) -> None:
    layout, numbers = stepper._states, (q, p, stepper._parameters(parameters))
    arguments = layout.times_block(times), *map(layout.block, numbers), *results
    status = stepper.binding.function(name)(
        len(times), *map(stepper.binding.pointer, arguments), stepper.binding.workspace()
    )
    if status:
        _refuse(stepper, status, q)


def _first_names(names: Sequence[str]) -> str:
    """Return the first names as text, with dots for the others."""
    shown = ", ".join(names[:MOST_SHOWN])
    return f"{shown}, .." if len(names) > MOST_SHOWN else shown


def _dependent(stepper: Integrator, q: Array, t: float, parameters: Parameters, *, nearest: bool = False) -> str | None:
    """Return the message of :func:`rank_deficiency`; ``None`` for run-time sizes too large for dense linear algebra."""
    if stepper.interface.layout.coordinates and max(stepper.dimension, len(stepper.constraints)) > MOST_DENSE:
        return None
    massless, at = _massless(stepper, q, t, parameters), linearised(stepper, t, parameters)
    names = [stepper.constraints[k] for k in _imposed(stepper, at(q)[1])]
    return massless or rank_deficiency(names, q, lambda q: _rows(stepper, *at(q)), nearest=nearest)


def _imposed(stepper: Integrator, jacobian: Array) -> NDArray[np.intp]:
    """Return the indices of the constraints that are imposed: the masks of others make their rows of G zero."""
    always = np.arange(len(jacobian)) < len(jacobian) - stepper.interface.masked
    return np.flatnonzero(always | jacobian.any(axis=1))


def _rows(stepper: Integrator, g: Array, jacobian: Array) -> tuple[Array, Array]:
    """Return g and G of the constraints that are imposed."""
    rows = _imposed(stepper, jacobian)
    return g[rows], jacobian[rows]


def _massless(stepper: Integrator, q: Array, t: float, parameters: Parameters) -> str | None:
    """Return what is wrong with coordinates whose velocities contribute to no momentum, and the remedy, or ``None``."""
    try:
        _, momenta = _at_unit_velocities(stepper, q, t, parameters)
    except StateError:
        return None
    names = [name for name, p in zip(stepper.coordinates, momenta[1:], strict=True) if (p == momenta[0]).all()]
    if not names:
        return None
    listed = _first_names(names)
    return (
        f"{listed} ha{'ve' if len(names) > 1 else 's'} no kinetic energy there, so that momenta do not determine "
        "velocities. Where the constraints do, compile the system with a mass of 0 as the default, "
        "system.with_parameters(m=0): then all its values are accepted"
    )


def _at_unit_velocities(stepper: Integrator, q: Array, t: float, parameters: Parameters) -> tuple[Array, Array]:
    """Return (1 + m, m) equal positions and the momenta there, of no and of unit velocities; StateError without any."""
    unit = np.concatenate([np.zeros((1, stepper.dimension)), np.eye(stepper.dimension)])
    positions = np.tile(q, (len(unit), 1))
    return positions, stepper.momentum(positions, unit, t, parameters)


def determined_coordinates(stepper: Integrator, q: Array, t: float, parameters: Parameters) -> NDArray[np.intp]:
    """Return the indices of coordinates that the constraints of positions determine from the others.

    They are those of the largest ``G_ki q_i``: differences of the others between two states fix theirs, without the
    rounding errors of large positions, as of the height of a pendulum that hardly swings.
    """
    if not stepper.constraints or stepper.dimension > MOST_DENSE:
        return np.empty(0, np.intp)
    try:
        positions, momenta = _at_unit_velocities(stepper, q, t, parameters)
        g, rates = constraint_values(stepper, positions, momenta, t, parameters)
    except StateError:  # velocities have no momenta
        return np.empty(0, np.intp)
    weights = ((rates[1:] - rates[0]).T * q)[(g == g[0]).all(axis=0)]  # g of a constraint of velocities is its rate
    return tangent_space(weights[np.isfinite(weights).all(axis=1)]).determined


def roots_of_masses(stepper: Integrator, q: Array, t: float, parameters: Parameters) -> Array:
    """Return (m,) roots of the masses M_ii = dp_i/dv_i: p_i / sqrt(M_ii) have one unit, the root of that of energies.

    They are 1 where they are undefined, and of more than ``MOST_DENSE`` coordinates.
    """
    roots = np.ones(stepper.dimension)
    if stepper.dimension <= MOST_DENSE:
        with suppress(StateError):
            _, momenta = _at_unit_velocities(stepper, q, t, parameters)
            masses = np.diagonal(momenta[1:] - momenta[0])
            np.sqrt(masses, out=roots, where=masses > 0.0)
    return roots


def singular_position(stepper: Integrator, q: Array, t: float, parameters: Array) -> str:
    """Return a remark on a failed step from positions where the constraints are nearly dependent, or ""."""
    if not stepper.constraints or max(stepper.dimension, len(stepper.constraints)) > MOST_DENSE:
        return ""
    _, imposed = _rows(stepper, *linearised(stepper, t, parameters)(q))
    return nearly_dependent(imposed) if len(imposed) else ""


def linearised(stepper: Integrator, t: float, parameters: Parameters) -> Callable[[Array], tuple[Array, Array]]:
    """Return a function that evaluates g and G by unit velocities; NaN where velocities have no momenta."""

    def at(q: Array) -> tuple[Array, Array]:
        try:
            positions, momenta = _at_unit_velocities(stepper, q, t, parameters)
            g, rates = constraint_values(stepper, positions, momenta, t, parameters)
        except StateError:
            return np.full(len(stepper.constraints), np.nan), np.full((len(stepper.constraints), len(q)), np.nan)
        return g[0], (rates[1:] - rates[0]).T

    return at


def _shown(q: Array) -> str:
    return np.array2string(q, threshold=2 * MOST_SHOWN)


def _refuse(stepper: Integrator, status: int, q: Array) -> None:
    hint = "; check for redundant or contradictory constraints" if "singular" in STATUS[status] else ""
    shown = _first_names(stepper.constraints)
    raise StateError(f"the constraints {shown} cannot be satisfied near q = {_shown(q)}: {REASONS[status]}{hint}")


NEARLY_DEPENDENT = 0.15
"""The same for constraints at a state from which a step fails."""
NAMED_SHARE = 1e-6
"""Entries of a null vector above this fraction of 1 mark the constraints that are dependent."""
CONTRADICTED = 1e-7
"""Residual at the nearest state, relative to the size of q, above which constraints count as contradictory."""
ITERATIONS = 30

Jacobian: TypeAlias = Callable[[Array], tuple[Array, Array]]
"""Values g and Jacobian G of the constraints at positions."""


def nearly_dependent(jacobian: Array) -> str:
    """Return a remark with the rank that a nearly singular Jacobian loses, or ""."""
    values = tangent_space(jacobian).singular_values if np.isfinite(jacobian).all() else np.ones(1)
    if values[-1] > NEARLY_DEPENDENT:
        return ""
    return (
        f". The Jacobian of the constraints is nearly singular there (smallest singular value {values[-1]:.2g} with "
        f"rows of length 1; rank {np.count_nonzero(values > NEARLY_DEPENDENT)} of {len(values)} where it is 0), as at "
        "a dead point of a mechanism: fixed steps (h=, steps=) pass it if the motion does; otherwise end the run "
        "before it, or prescribe the motion of another coordinate"
    )


def rank_deficiency(names: Sequence[str], q: Array, at: Jacobian, *, nearest: bool = False) -> str | None:
    """Return what is wrong with constraints of deficient rank, and what to do; ``None`` if they are independent.

    ``nearest``: first minimise the constraint residual by Gauss-Newton iteration.
    """
    for left in range(ITERATIONS if nearest else 0, -1, -1):
        g, jacobian = at(q)
        if not (np.isfinite(g).all() and np.isfinite(jacobian).all()):
            return None
        q = q - np.linalg.lstsq(jacobian, g, rcond=DEPENDENT)[0] if left else q
    free = tangent_space(jacobian)
    rows = np.flatnonzero(np.abs(free.conditions).max(axis=1, initial=0.0) > NAMED_SHARE).tolist()
    if not rows:
        return None
    listed = " and ".join(f"'{names[int(k)]}'" for k in rows) if len(rows) < 5 else f"{len(rows)} of them"
    rests = ", ".join(f"{g[k]:.3g}" for k in rows[:4])
    if nearest and np.abs(g).max() > CONTRADICTED * max(float(np.abs(q).max()), 1e-300):
        return (
            f"the constraints {listed} contradict each other or cannot be reached: at the nearest positions their "
            f"values are {rests}, not 0. Change or remove one of them"
        )
    return (
        f"the constraints {listed} are linearly dependent there (rank {free.rank} of {len(g)}), so their multipliers "
        "are undetermined. Remove one that follows from the others, or start from a state where they are independent"
    )
