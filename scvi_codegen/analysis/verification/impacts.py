"""Checks of events that change the state, on a run of the compiled integrator that meets them."""

import warnings
from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple, cast

import numpy as np
import sympy

from scvi_codegen.analysis.verification.certificate import Check, Finding, checked
from scvi_codegen.analysis.verification.system_under_test import EPSILON, SystemUnderTest, linearised
from scvi_codegen.codegen.rendering.events import EventFormulas
from scvi_codegen.common.errors import EventWarning, StateError
from scvi_codegen.methods.discretise import is_symplectic
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.stepper import Stepper
from scvi_codegen.runs.trajectory import Trajectory
from scvi_codegen.systems.formulas.symbols import TIME, symbol

STEPS, ROUND_OFF, ROUNDINGS = 2000, 64.0 * EPSILON, 16.0
"""Number of steps of the run; bounds on g relative to its terms, and on errors in units of their rounding."""
DIVISOR, LEAST_REDUCTION = 8.0, 4.0
"""Ratio of two step sizes, and least ratio of the defects of the symplectic form, which are those of the method."""
REVERSED = 5
"""Number of impacts that are undone."""
WIDTH = 1e-6
"""Relative width of the differences by which the rounding of a normal is estimated."""
SPREAD, NOISE = 100.0, 1e-9
"""Bound on deviations from finite differences, in units of their uncertainty, and besides."""


class Change(NamedTuple):
    """Change of the state (q, p): g relative to its terms, n = (g_q, g_t), restitution (NaN of maps).

    ``rounding`` bounds the change of n by one rounding of each of q, t and n.
    """

    t: float
    residual: float
    normal: Array
    rounding: Array
    restitution: float
    before: tuple[Array, Array]
    after: tuple[Array, Array]


def impact_checks(tested: SystemUnderTest, stepper: Stepper, parameters: Any = None) -> Iterator[Check]:
    """Yield the checks of the events of a stepper that change the state; ``parameters`` of its runs."""
    crossings = list[Any]()
    if stepper.changes_states:
        statement = "g = 0 up to round-off where the state changes"
        yield from checked("event surfaces", statement, partial(_surfaces, tested, stepper, parameters, crossings))
    if not crossings:
        return
    statement = "the derivative of a step across an event (saltation matrix) is that of finite differences"
    yield from checked("saltation", statement, partial(_saltation, tested.scales(tested.initial), *crossings))
    if not tested.system.constraints:
        if tested.method.symmetric:
            statement = "a step with -h undoes a step with an elastic impact"
            yield from checked("reversal, impacts", statement, partial(_reversal, *crossings))
        statement = "p + (1 + e)/2 lambda n, H(p + lambda n) - H(p) = -lambda g_t, symmetries of walls, to round-off"
        yield from checked("impacts", statement, partial(_impacts, *crossings))
        if is_symplectic(tested.method, tested.system):
            statement = "J^T Omega J = Omega of a step with an elastic impact, up to the error of the method"
            yield from checked("symplecticity, impacts", statement, partial(_symplecticity, *crossings))


def _surfaces(tested: SystemUnderTest, stepper: Stepper, parameters: Any, crossings: list[Any]) -> Finding:
    """Return the largest value of an event function; add the run and its changes to ``crossings``."""
    start = tested.initial
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EventWarning)  # a run of this length may end where impacts accumulate
        run = stepper.integrate(start.q, start.p, h=start.h, steps=STEPS, t=start.t, parameters=parameters)
    crossings.extend((run, _changes(run)))
    return Finding(max(each.residual for each in crossings[1]), ROUND_OFF, f"{len(crossings[1])} changes")


def _changes(run: Trajectory) -> list[Change]:
    """Return the changes of the state that are a step away from other events."""
    entries = [
        (each, k, event) for each in run.events for k, event in enumerate(run.stepper._events_of_entries(each.event))
    ]
    of_entries = [each.chosen(each.element == k) for each, k, _ in entries]
    formulas, changes = EventFormulas(run.stepper.interface, [each[2] for each in entries]), list[Change]()
    known = (*formulas.q, *formulas.p, *formulas.v, symbol(TIME), *formulas.parameters)
    times = np.concatenate([[run.t[0]], *(each.t for each in run.events)])
    for crossings, g, (_, values) in zip(of_entries, formulas.functions, formulas.changes, strict=True):
        e = sympy.nan if crossings.event.restitution is None else values[-1]
        function = sympy.lambdify(known, [g, e, *(g.diff(each) for each in (*formulas.q, symbol(TIME)))])
        for t, q, p in zip(crossings.t, np.asarray(crossings.q), np.asarray(crossings.p), strict=True):
            if crossings.event.changes_state and np.count_nonzero(np.abs(times - t) < 1.5 * abs(run.h)) == 1:
                row, v = int(np.searchsorted(run.t, t, side="right")) - 1, run.stepper.velocity(q, p, t)

                def evaluated(at: Array, p: Array = p, v: Array = v, function: Any = function) -> Array:
                    return np.array(function(*at[:-1], *p, *v, at[-1], *run.parameters), dtype=float)

                here = np.append(q, t)
                value, restitution, *normal = evaluated(here)
                moved = (evaluated(here + width) for width in np.diag(WIDTH * here))
                rounding = sum((np.abs(each[2:] - normal) for each in moved), WIDTH * np.abs(normal)) * EPSILON / WIDTH
                size = np.abs(normal) @ np.append(np.abs(q) + np.abs(v * run.h), abs(t) + abs(run.h))
                after = np.asarray(run.q)[row], np.asarray(run.p)[row]
                changes.append(Change(t, abs(value) / size, np.array(normal), rounding, restitution, (q, p), after))
    if not changes:
        raise StateError(f"no event alone changes the state within {STEPS} steps: give another state or step size")
    return changes


def _impacts(run: Trajectory, changes: list[Change]) -> Finding | None:
    """Return the largest violation of the equations of an impact, or change of a map that the wall respects.

    Each is in units of its change by one rounding of the momenta before and after, of the normal, of the approach speed
    v . n + g_t, from which lambda is computed, and of the terms of the energy and of the maps.
    """
    stepper, at, worst = run.stepper, run.parameters, list[float]()
    for t, _, normal, rounding, e, (q, p), after in (each for each in changes if each.restitution >= 0.0):
        n, n_rounding, jump = normal[:-1], rounding[:-1], after[1] - p
        size, jump_rounding = np.abs(n), EPSILON * (np.abs(p) + np.abs(after[1]))
        part, square = 0.5 * (1.0 + e), n @ n
        impulse = jump @ n / square / part
        elastic, pushed = p + impulse * n, abs(impulse) * size
        energies, speeds = ([f(q, x, t, at) for x in (p, elastic)] for f in (stepper.energy, stepper.velocity))
        speed, other = np.abs(speeds[0]), np.abs(speeds[1])
        turned = n_rounding @ size / square
        approach = EPSILON * (size @ speed + abs(normal[-1])) + n_rounding @ speed + rounding[-1]
        of_impulse = (jump_rounding @ size + np.abs(jump) @ n_rounding) / square / part + 2.0 * abs(impulse) * turned
        of_impulse += EPSILON * abs(impulse) + abs(impulse) * approach / (abs(n @ (speeds[1] - speeds[0])) or 1.0)
        of_energy = EPSILON * (np.abs(p) @ speed + np.abs(elastic) @ other + sum(map(abs, energies)))
        of_energy += abs(speeds[1] @ n + normal[-1]) * of_impulse + abs(impulse) * (n_rounding @ other + rounding[-1])
        worst.append(abs(energies[1] - energies[0] + impulse * normal[-1]) / of_energy)
        along = jump_rounding + part * (of_impulse * size + abs(impulse) * n_rounding)
        worst.append(float((np.abs(jump - part * impulse * n) / along).max()))
        (first, map_sizes), *others = (
            stepper._momentum_maps_and_sizes(q[np.newaxis], x[np.newaxis], t, at) for x in (p, elastic, after[1])
        )
        changed = [np.abs(maps - first)[0] for maps, _ in others]
        of_maps = (EPSILON * (map_sizes + others[0][1]))[0] + (along + EPSILON * pushed).max() * (1.0 + np.abs(q).max())
        respected = changed[0] <= ROUNDINGS * of_maps
        worst.append(float((changed[1] / of_maps)[respected].max(initial=0.0)))
    return Finding(float(max(worst)), ROUNDINGS, f"in units of rounding, {len(worst) // 3} impacts") if worst else None


def _across(run: Trajectory, change: Change, h: float) -> tuple[Array, Any]:
    """Return the state h/2 before a change, and the step of size h from a state there."""
    t, m = change.t - 0.5 * h, run.stepper.dimension
    step = partial(cast(Stepper, run.stepper).integrate, h=h, steps=1, t=t, parameters=run.parameters)
    return np.concatenate(run.at(t)), lambda z: step(z[:m], z[m:])


def _saltation(scales: Array, run: Trajectory, changes: list[Change]) -> Finding:
    start, step = _across(run, changes[0], run.h)
    around = linearised(lambda z: np.hstack([step(z).q[-1], step(z).p[-1]]), start, scales)
    if around is None:
        raise StateError("steps from neighbouring states fail")
    exact = step(start).tangent()[-1] / scales[:, np.newaxis] * scales
    return Finding(float(np.abs(exact - around.matrix).max()), SPREAD * around.uncertainty + NOISE, "relative")


def _reversal(run: Trajectory, changes: list[Change]) -> Finding | None:
    """Return the defect of steps with elastic impacts and back, in units of one rounding of state, time and step."""
    worst = list[float]()
    for change in [each for each in changes if each.restitution == 1.0][:REVERSED]:
        start, step = _across(run, change, run.h)
        there, stepper = step(start), cast(Stepper, run.stepper)
        end, t = np.hstack([there.q[-1], there.p[-1]]), there.t[-1]
        back = stepper.integrate(there.q[-1], there.p[-1], h=-run.h, steps=1, t=t, parameters=run.parameters)
        moved = np.abs(end - start) * (1.0 + abs(t / run.h))
        forward = there.tangent()[-1]
        reached = np.abs(end) + moved + np.abs(forward) @ (np.abs(start) + moved)
        unit = EPSILON * (np.abs(start) + np.abs(np.linalg.inv(forward)) @ reached)
        worst.append(float((np.abs(np.hstack([back.q[-1], back.p[-1]]) - start) / unit).max()))
    return Finding(max(worst), ROUNDINGS, f"in units of rounding, {len(worst)} impacts") if worst else None


def _symplecticity(run: Trajectory, changes: list[Change]) -> Finding | None:
    elastic, defects = [each for each in changes if each.restitution == 1.0], []
    form = np.kron([[0.0, 1.0], [-1.0, 0.0]], np.eye(run.stepper.dimension))
    for h in (run.h, run.h / DIVISOR) if elastic else ():
        start, step = _across(run, elastic[0], h)
        matrix = step(start).tangent()[-1]
        defects.append(float(np.abs(matrix.T @ form @ matrix - form).max() / np.abs(matrix).max() ** 2))
    return Finding(defects[1], max(defects[0] / LEAST_REDUCTION, NOISE), "step / 8") if elastic else None
