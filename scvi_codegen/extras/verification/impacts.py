"""Checks of events that change the state, of contacts and of located kinks, on a run that meets them."""

import math
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple, cast

import numpy as np
import sympy

from scvi_codegen.api.formulas import TIME, Tape, mp, symbol
from scvi_codegen.api.methods import Discretisation
from scvi_codegen.api.states import Array
from scvi_codegen.common.errors import EventWarning, StateError
from scvi_codegen.extras.exact.solution import ExactMotion, Numbers, exact_motion, numbers, solved
from scvi_codegen.extras.verification.certificate import Check, Finding, checked
from scvi_codegen.extras.verification.convergence import MAX_HALVINGS, SLACK
from scvi_codegen.extras.verification.structure import SPREAD
from scvi_codegen.extras.verification.system_under_test import (
    BOUND,
    CONSECUTIVE_STEPS,
    EPSILON,
    LARGEST_RATIO,
    LONG_RUN,
    ROUND_OFF,
    ROUNDINGS,
    SAMPLED,
    SHORT_RUN,
    STEP_DIVISOR,
    WIDTH,
    State,
    SystemUnderTest,
    canonical_form,
    linearised,
)
from scvi_codegen.runs.stepper import Stepper
from scvi_codegen.runs.trajectory import Trajectory
from scvi_codegen.systems.event import Crossings


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
        if Discretisation(tested.system, tested.method).symplectic:
            statement = "J^T Omega J = Omega of a step with an elastic impact, up to the error of the method"
            yield from checked("symplecticity, impacts", statement, partial(_symplecticity, *crossings))


def _surfaces(tested: SystemUnderTest, stepper: Stepper, parameters: Any, crossings: list[Any]) -> Finding:
    """Return the largest value of an event function; add the run and its changes to ``crossings``."""
    run = run_of(stepper, tested.initial, tested.initial.h, steps=2 * LONG_RUN, parameters=parameters)
    crossings.extend((run, _changes(run)))
    return Finding(max(change.residual for change in crossings[1]), ROUNDED, f"{len(crossings[1])} changes")


def _changes(run: Trajectory) -> list[Change]:
    """Return the changes of the state that are a step away from other events."""
    times = np.concatenate([[run.t[0]], *(crossings.t for crossings in run.events)])
    changes = list[Change]()
    for crossings, function in _event_functions(run):
        if not crossings.event.changes_state:
            continue
        for t, q, p in zip(crossings.t, np.asarray(crossings.q), np.asarray(crossings.p), strict=True):
            if np.count_nonzero(np.abs(times - t) < 1.5 * abs(run.h)) == 1:
                changes.append(_change_at(run, function, t, q, p))
    if not changes:
        raise StateError(
            f"no event alone changes the state within {2 * LONG_RUN} steps: give another state or step size"
        )
    return changes


def _event_functions(run: Trajectory) -> Iterator[tuple[Crossings, Callable[..., list[float]]]]:
    """Yield the crossings of each scalar event, and [g, e, g_q, g_t] as a function of (q, p, v, t, parameters)."""
    scalar_events = [
        (crossings.chosen(crossings.element == k), event)
        for crossings in run.events
        for k, event in enumerate(run.stepper._events_of_entries(crossings.event))
    ]
    formulas = cast(Any, run.stepper).products.event_formulas([event for _, event in scalar_events])
    arguments = (*formulas.q, *formulas.p, *formulas.v, symbol(TIME), *formulas.parameters)
    for (crossings, _), g, (_, values) in zip(scalar_events, formulas.functions, formulas.changes, strict=True):
        if not g.free_symbols.isdisjoint(formulas.multipliers):
            continue
        restitution = sympy.nan if crossings.event.restitution is None else values[-1]
        gradient = [g.diff(variable) for variable in (*formulas.q, symbol(TIME))]
        yield crossings, sympy.lambdify(arguments, [g, restitution, *gradient])


def _change_at(run: Trajectory, function: Callable[..., list[float]], t: float, q: Array, p: Array) -> Change:
    """Return the change of the state at time t; ``function`` as of :func:`_event_functions`."""
    v = run.stepper.velocity(q, p, t)

    def evaluated(point: Array) -> Array:
        return np.array(function(*point[:-1], *p, *v, point[-1], *run.parameters), dtype=float)

    point = np.append(q, t)
    g, restitution, *normal = evaluated(point)
    moved_normals = [evaluated(point + shift)[2:] for shift in np.diag(WIDTH * point)]
    moved = sum((np.abs(moved_normal - normal) for moved_normal in moved_normals), WIDTH * np.abs(normal))
    size = np.abs(normal) @ np.append(np.abs(q) + np.abs(v * run.h), abs(t) + abs(run.h))
    row = int(np.searchsorted(run.t, t, side="right")) - 1
    after = np.asarray(run.q)[row], np.asarray(run.p)[row]
    return Change(t, abs(g) / size, np.array(normal), moved * EPSILON / WIDTH, restitution, (q, p), after)


def _impacts(run: Trajectory, changes: list[Change]) -> Finding | None:
    """Return the largest violation of the equations of an impact, or change of a map that the wall respects."""
    impacts = [change for change in changes if change.restitution >= 0.0]
    errors = [error for impact in impacts for error in _impact_errors(run, impact)]
    return Finding(max(errors), ROUNDINGS, f"in units of rounding, {len(impacts)} impacts") if errors else None


def _impact_errors(run: Trajectory, impact: Change) -> tuple[float, float, float]:
    """Return the errors of the energy, of the momenta, and of the maps that the wall respects, in units of rounding.

    A unit is the change by one rounding of the momenta before and after, of the normal, of the approach speed
    v . n + g_t, from which lambda is computed, and of the terms of the energy and of the maps.
    """
    stepper, parameters, t = run.stepper, run.parameters, impact.t
    (q, p), p_after = impact.before, impact.after[1]
    n, g_t = impact.normal[:-1], impact.normal[-1]
    n_rounding, g_t_rounding = impact.rounding[:-1], impact.rounding[-1]
    size, square = np.abs(n), n @ n
    # p_after = p + (1 + e)/2 lambda n, with lambda of the elastic impact: H(p + lambda n) - H(p) = -lambda g_t.
    part, jump = 0.5 * (1.0 + impact.restitution), p_after - p
    impulse = jump @ n / square / part
    elastic = p + impulse * n
    energies = [stepper.energy(q, momenta, t, parameters) for momenta in (p, elastic)]
    velocities = [stepper.velocity(q, momenta, t, parameters) for momenta in (p, elastic)]
    speed, elastic_speed = np.abs(velocities[0]), np.abs(velocities[1])

    jump_rounding = EPSILON * (np.abs(p) + np.abs(p_after))
    approach = EPSILON * (size @ speed + abs(g_t)) + n_rounding @ speed + g_t_rounding
    impulse_rounding = (jump_rounding @ size + np.abs(jump) @ n_rounding) / square / part
    impulse_rounding += 2.0 * abs(impulse) * (n_rounding @ size / square) + EPSILON * abs(impulse)
    impulse_rounding += abs(impulse) * approach / (abs(n @ (velocities[1] - velocities[0])) or 1.0)
    energy_rounding = EPSILON * (np.abs(p) @ speed + np.abs(elastic) @ elastic_speed + sum(map(abs, energies)))
    energy_rounding += abs(velocities[1] @ n + g_t) * impulse_rounding
    energy_rounding += abs(impulse) * (n_rounding @ elastic_speed + g_t_rounding)
    momentum_rounding = jump_rounding + part * (impulse_rounding * size + abs(impulse) * n_rounding)

    energy_error = float(abs(energies[1] - energies[0] + impulse * g_t) / energy_rounding)
    momentum_error = float((np.abs(jump - part * impulse * n) / momentum_rounding).max())
    (maps, map_sizes), (elastic_maps, elastic_sizes), (maps_after, _) = (
        stepper._momentum_maps_and_sizes(q[np.newaxis], momenta[np.newaxis], t, parameters)
        for momenta in (p, elastic, p_after)
    )
    map_rounding = (momentum_rounding + EPSILON * abs(impulse) * size).max() * (1.0 + np.abs(q).max())
    map_rounding = map_rounding + (EPSILON * (map_sizes + elastic_sizes))[0]
    respected = np.abs(elastic_maps - maps)[0] <= ROUNDINGS * map_rounding
    map_errors = np.abs(maps_after - maps)[0] / map_rounding
    return energy_error, momentum_error, float(map_errors[respected].max(initial=0.0))


def _elastic(changes: list[Change]) -> list[Change]:
    return [change for change in changes if change.restitution == 1.0]


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
    return Finding(float(np.abs(exact - around.matrix).max()), SPREAD * around.uncertainty + BOUND, "relative")


def _reversal(run: Trajectory, changes: list[Change]) -> Finding | None:
    """Return the defect of steps with elastic impacts and back, in units of one rounding of state, time and step."""
    worst = list[float]()
    for change in _elastic(changes)[:SAMPLED]:
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
    elastic, defects = _elastic(changes), []
    if not elastic:
        return None
    form = canonical_form(run.stepper.dimension)
    for h in (run.h, run.h / STEP_DIVISOR):
        start, step = _across(run, elastic[0], h)
        matrix = step(start).tangent()[-1]
        defects.append(float(np.abs(matrix.T @ form @ matrix - form).max() / np.abs(matrix).max() ** 2))
    return Finding(defects[1], max(defects[0] * LARGEST_RATIO, BOUND), "step / 8")


ROUNDED, DIFFERENCE = ROUNDINGS * EPSILON, mp.mpf(10) ** -30
"""Bound on zeros relative to their terms, and width of differences."""
OUTSIDE = 1e-9
"""Part of their size by which impulses may leave their cone, ten times that by which runs choose them
(CONTACT_ROUNDING)."""


@dataclass(frozen=True)
class RunInModes:
    """Run under test, and functions that are >= 0 in its modes (:mod:`scvi_codegen.systems.contacts.modes`)."""

    tested: SystemUnderTest
    run: Trajectory

    def motion(self, parameters: Array) -> ExactMotion:
        """Return the exact motion in the mode of parameters."""
        return exact_motion(self.tested.system).with_parameters(parameters.tolist())

    @cached_property
    def functions(self) -> Tape:
        """Functions of kinks and transitions by (q, p, v, t, parameters, multipliers)."""
        of = cast(Any, self.run.stepper).products.event_formulas(self.run.stepper.searched)
        return Tape(of.functions, (*of.q, *of.p, *of.v, symbol(TIME), *of.parameters, *of.multipliers))

    def values(self, x: Numbers, parameters: Array) -> Numbers:
        """Return the functions at x = (q, p, t), u of kinks times its side, then +- constraints and their rates."""
        motion, (q, p), zeros, forces = self.motion(parameters), np.split(x[:-1], 2), np.zeros(0), np.zeros(0)
        v, named = motion.velocity(q, p, x[-1]), self.tested.stepper.parameters_by_name(parameters)
        if self.tested.system.constraints:
            zeros, forces = motion.constraint_terms(q, v, x[-1])[2][1:3].ravel(), motion.multipliers(q, v, x[-1])
        values = self.functions([*q, *p, *v, x[-1], *motion.parameters, *forces])
        modes = (getattr(event, "mode", None) for event in self.run.stepper.searched)
        sides = [1 if mode is None else np.sign(named[mode]) for mode in modes]
        return np.array([*np.multiply(values, sides), *zeros, *-zeros], dtype=object)

    def derivatives(self, x: Numbers, parameters: Array) -> Numbers:
        """Return the derivatives of the values by x, by differences."""
        now, moves = self.values(x, parameters), np.eye(len(x), dtype=int)
        return np.array([(self.values(x + DIFFERENCE * move, parameters) - now) / DIFFERENCE for move in moves]).T

    def relative(self, x: Numbers, parameters: Array) -> Array:
        """Return the values relative to their terms: derivatives by x times x, its change in a step, and in the run."""
        q, p = np.split(x[:-1], 2)
        rates = np.array([*np.concatenate(self.motion(parameters).rates(q, p, x[-1])), 1])
        moved = np.ptp(np.hstack([self.run.q, self.run.p]), axis=0) * abs(self.run.h) / np.ptp(self.run.t)
        terms = np.abs(self.derivatives(x, parameters)) @ (np.abs(x) + np.abs(rates * self.run.h) + np.append(moved, 0))
        return (self.values(x, parameters) / np.where(terms == 0, 1, terms)).astype(float)

    @cached_property
    def changes(self) -> list[tuple[float, int, Numbers, Numbers, tuple[Array, Array]]]:
        """Some of the transitions that are alone at their time: it, number, x before and after, parameters there."""
        run, changes = self.run, []
        for crossings, rows in replace(run, events=()).changes_by_events():
            for t, q, p, row in zip(crossings.t.tolist(), crossings.q, crossings.p, rows.tolist(), strict=True):
                sides = run.parameters_on_sides(run.t.item(max(row - 1, 0))), run.parameters_on_sides(t)
                ends = numbers([*q, *p, t]), numbers([*run.q[row], *run.p[row], t])
                changes.append((t, run.stepper.searched.index(crossings.event), *ends, sides))
        times = [change[0] for change in changes]
        alone = sorted((change for change in changes if times.count(change[0]) == 1), key=lambda change: change[0])
        return alone[:: -(-len(alone) // SAMPLED) or 1]

    @cached_property
    def impacts(self) -> list[tuple[float, float]]:
        """Violations of the law of impact, and of the friction cone by the impulse, of contacts that meet alone.

        With friction v_n+ may be less than by the law.
        """
        stepper, errors, m = self.run.stepper, list[tuple[float, float]](), self.run.stepper.dimension
        contacts, first = stepper.interface.contacts, len(self.tested.system.constraints) - stepper.interface.masked
        for _, k, *ends, (old, new) in self.changes:
            event, named = stepper.searched[k], stepper.parameters_by_name(old)
            contact, is_closed = getattr(event, "contact", 0), any(named[c.closed] for c in contacts if c.closed)
            if getattr(event, "kind", "") != "closes" or is_closed:
                continue
            rows, imposed, rates, size = contacts[contact], old.copy(), [], mp.mpf(0)
            imposed[[stepper.interface.parameters.index(name) for name in (rows.closed, *rows.sticks)]] = 1.0
            motion, row = self.motion(imposed), first + cast(int, rows.normal)
            q, t, jump = ends[0][:m], ends[0][-1], (ends[1] - ends[0])[m:-1]
            laws = Tape([law for item in self.tested.system.contacts for law in item.laws], motion.symbols)
            at_impact = laws([*q, *motion.velocity(q, ends[0][m:-1], t), t, *motion.parameters])
            friction, _, restitution = at_impact[3 * contact : 3 * contact + 3]
            for q, p, t in ((x[:m], x[m:-1], x[-1]) for x in ends):
                v = motion.velocity(q, p, t)
                normal, _, terms = motion.constraint_terms(q, v, t)
                rates.append(terms[2][row])
                size += np.abs(normal[row]) @ np.abs(v) + abs(terms[2][row])
            excess = rates[1] + (0 if stepper.parameters_by_name(new)[str(rows.closed)] else restitution) * rates[0]
            excess = max(excess, -rates[1]) if friction else abs(excess)
            G = normal[[row, *(first + (rows.tangential or 0) + i for i in range(rows.slips))]]
            pushes, *slips = solved(G @ G.T, G @ jump)
            outside = max(mp.sqrt(sum(x * x for x in slips)) - friction * pushes, -pushes)
            outside *= G[0] @ G[0] / (np.abs(G[0]) @ (np.abs(ends[0][m:-1]) + np.abs(ends[1][m:-1])))
            errors.append((float(excess / size), float(outside)))
        return errors

    def states(self) -> Iterator[tuple[Numbers, Array]]:
        """Yield states x with parameters: some of those of the run, and those before transitions."""
        for t in self.run.t[:: -(-len(self.run) // SHORT_RUN)].tolist():
            yield numbers([*np.concatenate(self.run.at(t)), t]), self.run.parameters_on_sides(t)
        yield from ((before, sides[0]) for _, _, before, _, sides in self.changes)


def run_of(stepper: Stepper, start: State, h: float, **plan: Any) -> Trajectory:
    """Return the run from a state by steps h; it may end where impacts accumulate."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EventWarning)
        return stepper.integrate(start.q, start.p, h=h, t=start.t, **plan)


def transition_checks(tested: SystemUnderTest, run: Trajectory) -> Iterator[Check]:
    """Yield the checks of a run by the stepper under test."""
    of, count = RunInModes(tested, run), 4 * len(tested.system.constraints)
    yield from checked("transitions", "their functions are 0 where modes change (60 digits)", partial(_zeros, of))
    kinds = [getattr(event, "kind", "kink") for event in run.stepper.searched] + ["constraint"] * count
    for name, statement, ends in (
        ("sides of kinks", "u has the sign of its side at all states (60 digits)", ("kink",)),
        ("complementarity", "gaps and normal forces are >= 0 (60 digits)", ("closes", "lifts", "leaves")),
        ("friction", "it is in its cone, and opposite to slip (60 digits)", ("stops", "forward", "backward", "begins")),
        ("closed contacts", "gaps, their rates, and slips that stick are 0 (60 digits)", ("constraint",)),
    ):
        if rows_of_kinds := [k for k, kind in enumerate(kinds) if kind in ends]:
            yield from checked(name, statement, partial(_conditions, of, rows_of_kinds))
    statement = "continuous; where L jumps p+ - p- = lambda u_q and H+ - H- = -lambda u_t (60 digits)"
    yield from checked("states at kinks", statement, partial(_states_at_kinks, of))
    statement = "v_n+ = -e v_n- of a contact alone, with friction at most; v_n+ = 0 if it closes (60 digits)"
    yield from checked("impacts of contacts", statement, partial(_impacts_of_contacts, of, 0, ROUNDED))
    statement = "impulses push, and are in the friction cone (60 digits)"
    yield from checked("friction of impacts", statement, partial(_impacts_of_contacts, of, 1, OUTSIDE))
    statement = f"order {tested.method.order} in h of the end of a run, and of its balance H - W"
    yield from checked("order across transitions", statement, partial(_order, of))


def _zeros(of: RunInModes) -> Finding:
    if not of.changes:
        raise StateError(f"no transition alone within {of.run.steps} steps: give another state, or step size")
    values = [abs(of.relative(before, sides[0])[k]) for _, k, before, _, sides in of.changes]
    return Finding(max(values), ROUNDED, f"relative to its terms, {len(values)} transitions")


def _conditions(of: RunInModes, rows_of_kinds: list[int]) -> Finding:
    """Return how far below 0 functions are at states of the run, relative to their terms."""
    low = [
        float(-of.relative(*state)[rows_of_kinds].min())
        for state in of.states()
        if min(of.values(*state)[rows_of_kinds]) < 0
    ]
    return Finding(max(low, default=0.0), ROUNDED, "relative to their terms")


def _states_at_kinks(of: RunInModes) -> Finding | None:
    errors, m, searched = list[float](), of.tested.system.dimension, of.run.stepper.searched
    for t, k, before, after, sides in (change for change in of.changes if hasattr(searched[change[1]], "mode")):
        jump = after - before
        if jump.any():
            n = of.derivatives(before, sides[0])[k]
            impulse, ends = jump[m:-1] @ n[:m] / (n[:m] @ n[:m]), zip(sides, (before, after), strict=True)
            old, new = (of.motion(side).energy(x[:m], x[m:-1], mp.mpf(t)) for side, x in ends)
            jump = np.array([*jump[:m], *(jump[m:-1] - impulse * n[:m]), new - old + impulse * n[-1]])
        errors.append(float(max(abs(jump)) / max(1, *abs(before))))
    return Finding(max(errors), ROUNDED, f"relative, {len(errors)} crossings") if errors else None


def _impacts_of_contacts(of: RunInModes, which: int, bound: float) -> Finding | None:
    errors = [pair[which] for pair in of.impacts]
    return Finding(max(errors), bound, f"relative to its terms, {len(errors)} impacts") if errors else None


def _order(of: RunInModes) -> Finding:
    """Return the least order of both errors, of runs with steps h, h/2 and h/8 over the first transitions."""
    if any(getattr(event, "power_sides", ()) for event in of.run.stepper.searched):
        raise StateError("motions are not smooth at kinks with powers that are not whole: the order is lower there")
    start, best, stepper = of.tested.initial, Finding(-math.inf, math.nan), of.tested.stepper
    times = [*(change[0] for change in of.changes), of.run.t.item(-1)][:CONSECUTIVE_STEPS]
    end, scales = sum(times[-2:]) / len(times[-2:]), of.tested.scales(start)
    for halving in range(MAX_HALVINGS):
        steps = max(SHORT_RUN, math.ceil((end - start.t) / abs(of.run.h))) << halving
        runs = [run_of(stepper, start, (end - start.t) / (part * steps), t_end=end) for part in (1, 2, 8)]
        apart = [np.abs((np.hstack([run.q[-1] - runs[2].q[-1], run.p[-1] - runs[2].p[-1]])) / scales) for run in runs]
        errors = [(float(z.max()), run.energy_error()) for z, run in zip(apart[:2], runs, strict=False)]
        orders = [math.log2(a / b) for a, b in zip(*errors, strict=True) if b > ROUND_OFF]
        remark = f"errors {max(errors[0]):.1e}, then {max(errors[1]):.1e}; infinite: round-off"
        least = (of.tested.method.order or 1) - SLACK
        best = max(best, Finding(min(orders, default=math.inf), least, remark, at_least=True))
        if best.satisfied:
            break
    return best
