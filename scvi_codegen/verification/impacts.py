"""Checks of events that change the state, on a run of the compiled integrator that meets them."""

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import sympy

from scvi_codegen.errors import StateError
from scvi_codegen.formulas.symbols import TIME, symbol
from scvi_codegen.methods.discretise import is_symplectic
from scvi_codegen.rendering.events import EventFormulas
from scvi_codegen.runtime.core.stepper import Stepper
from scvi_codegen.runtime.core.validation import Array
from scvi_codegen.runtime.trajectory.trajectory import Trajectory
from scvi_codegen.verification.certificate import Check, Finding, checked
from scvi_codegen.verification.system_under_test import EPSILON, SystemUnderTest, linearised

STEPS, ROUND_OFF = 2000, 64.0 * EPSILON
"""Number of steps of the run; bound on relative errors of single states."""
DIVISOR, LEAST_REDUCTION = 8.0, 4.0
"""Ratio of two step sizes, and least ratio of the defects of the symplectic form, which are those of the method."""
REVERSED, REVERSAL = 5, 2.0**12 * EPSILON
"""Number of impacts that are undone, and the bound on the relative defect."""
SPREAD, NOISE = 100.0, 1e-9
"""Bound on deviations from finite differences, in units of their uncertainty, and besides."""


class Change(NamedTuple):
    """Change of the state (q, p): g relative to its terms, n = (g_q, g_t), restitution (NaN of maps)."""

    t: float
    residual: float
    normal: Array
    restitution: float
    before: tuple[Array, Array]
    after: tuple[Array, Array]


def impact_checks(tested: SystemUnderTest, stepper: Stepper, parameters: Any = None) -> Iterator[Check]:
    """Yield the checks of the events of a stepper that change the state; ``parameters`` of its runs."""
    found = list[Any]()
    if stepper.changes_states:
        statement = "g = 0 up to round-off where the state changes"
        yield from checked("event surfaces", statement, partial(_surfaces, tested, stepper, parameters, found))
    if not found:
        return
    statement = "the derivative of a step across an event (saltation matrix) is that of finite differences"
    yield from checked("saltation", statement, partial(_saltation, tested.scales(tested.initial), *found))
    if not tested.system.constraints:
        if tested.method.symmetric:
            statement = "a step with -h undoes a step with an elastic impact"
            yield from checked("reversal, impacts", statement, partial(_reversal, *found))
        statement = "p + (1 + e)/2 lambda n, H(p + lambda n) - H(p) = -lambda g_t, symmetries of walls, to round-off"
        yield from checked("impacts", statement, partial(_impacts, *found))
        if is_symplectic(tested.method, tested.system):
            statement = "J^T Omega J = Omega of a step with an elastic impact, up to the error of the method"
            yield from checked("symplecticity, impacts", statement, partial(_symplecticity, *found))


def _surfaces(tested: SystemUnderTest, stepper: Stepper, parameters: Any, found: list[Any]) -> Finding:
    """Return the largest value of an event function; add the run and its changes to ``found``."""
    start = tested.initial
    run = stepper.integrate(start.q, start.p, h=start.h, steps=STEPS, t=start.t, parameters=parameters)
    found.extend((run, _changes(run)))
    return Finding(max(each.residual for each in found[1]), ROUND_OFF, f"{len(found[1])} changes")


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
                value, restitution, *normal = map(float, function(*q, *p, *v, t, *run.parameters))
                size = np.abs(normal) @ np.append(np.abs(q) + np.abs(v * run.h), abs(t) + abs(run.h))
                after = np.asarray(run.q)[row], np.asarray(run.p)[row]
                changes.append(Change(t, abs(value) / size, np.array(normal), restitution, (q, p), after))
    if not changes:
        raise StateError(f"no event alone changes the state within {STEPS} steps: give another state or step size")
    return changes


def _impacts(run: Trajectory, changes: list[Change]) -> Finding | None:
    """Return the largest violation of the equations of an impact, or change of a map that the wall respects."""
    stepper, at, worst = run.stepper, run.parameters, list[float]()
    for t, _, normal, e, (q, p), after in (each for each in changes if each.restitution >= 0.0):
        n, jump = normal[:-1], after[1] - p
        impulse = 2.0 / (1.0 + e) * (jump @ n) / (n @ n)
        elastic, size = p + impulse * n, np.abs(impulse * n).max()
        energies = [stepper.energy(q, x, t, at) for x in (p, elastic)]
        maps = [stepper.momentum_maps(q, x, t, at) for x in (p, elastic, after[1])]
        respected = np.abs(maps[1] - maps[0]) <= ROUND_OFF * size * (1.0 + np.abs(q).max())
        work = abs(impulse) * (np.abs(normal) @ np.append(np.abs(stepper.velocity(q, p, t, at)), 1.0))
        worst.append(abs(energies[1] - energies[0] + impulse * normal[-1]) / max(work, abs(energies[0])))
        worst.append(np.abs(jump - 0.5 * (1.0 + e) * impulse * n).max() / np.abs(p).max())
        worst.append(np.abs(maps[2] - maps[0])[respected].max(initial=0.0) / (size * (1.0 + np.abs(q).max())))
    return Finding(float(max(worst)), ROUND_OFF, f"relative, {len(worst) // 3} impacts") if worst else None


def _across(run: Trajectory, change: Change, h: float) -> tuple[Array, Any]:
    """Return the state h/2 before a change, and the step of size h from a state there."""
    t, m = change.t - 0.5 * h, run.stepper.dimension
    step = partial(run.stepper.integrate, h=h, steps=1, t=t, parameters=run.parameters)
    return np.concatenate(run.at(t)), lambda z: step(z[:m], z[m:])


def _saltation(scales: Array, run: Trajectory, changes: list[Change]) -> Finding:
    start, step = _across(run, changes[0], run.h)
    around = linearised(lambda z: np.hstack([step(z).q[-1], step(z).p[-1]]), start, scales)
    if around is None:
        raise StateError("steps from neighbouring states fail")
    exact = step(start).tangent()[-1] / scales[:, np.newaxis] * scales
    return Finding(float(np.abs(exact - around.matrix).max()), SPREAD * around.uncertainty + NOISE, "relative")


def _reversal(run: Trajectory, changes: list[Change]) -> Finding | None:
    """Return the defect of steps with elastic impacts and back, relative to the state."""
    worst = list[float]()
    for change in [each for each in changes if each.restitution == 1.0][:REVERSED]:
        start, step = _across(run, change, run.h)
        end = step(start)
        back = run.stepper.integrate(end.q[-1], end.p[-1], h=-run.h, steps=1, t=end.t[-1], parameters=run.parameters)
        worst.append(np.abs(np.hstack([back.q[-1], back.p[-1]]) - start).max() / np.abs(start).max())
    return Finding(float(max(worst)), REVERSAL, f"relative, {len(worst)} impacts") if worst else None


def _symplecticity(run: Trajectory, changes: list[Change]) -> Finding | None:
    elastic, defects = [each for each in changes if each.restitution == 1.0], []
    form = np.kron([[0.0, 1.0], [-1.0, 0.0]], np.eye(run.stepper.dimension))
    for h in (run.h, run.h / DIVISOR) if elastic else ():
        start, step = _across(run, elastic[0], h)
        matrix = step(start).tangent()[-1]
        defects.append(float(np.abs(matrix.T @ form @ matrix - form).max() / np.abs(matrix).max() ** 2))
    return Finding(defects[1], max(defects[0] / LEAST_REDUCTION, NOISE), "step / 8") if elastic else None
