"""Checks of located kinks and of contacts along a run, by functions evaluated in 60 digits outside its steps.

The functions of transitions (:mod:`scvi_codegen.systems.contacts.modes`) are >= 0 between these, and 0 there: gaps,
normal forces, slips along their directions, margins of friction cones, and u of kinks times the sign of their side.
Forces are those of the exact motion in the mode.
"""

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np

from scvi_codegen.analysis.verification.certificate import Check, Finding, checked
from scvi_codegen.analysis.verification.convergence import SLACK, measured_order
from scvi_codegen.analysis.verification.stepping import solves
from scvi_codegen.analysis.verification.system_under_test import EPSILON, State, SystemUnderTest
from scvi_codegen.codegen.rendering.events import EventFormulas
from scvi_codegen.common.errors import EventWarning, StateError
from scvi_codegen.common.precision import mp
from scvi_codegen.methods.exact.solution import ExactMotion, Numbers, exact_motion, numbers
from scvi_codegen.runs.results.recomputation import changes_by_events
from scvi_codegen.runs.results.saved_states import parameters_on_sides
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.stepper import Stepper
from scvi_codegen.runs.trajectory import Trajectory
from scvi_codegen.systems.contact import static_limit
from scvi_codegen.systems.event import Event
from scvi_codegen.systems.formulas.expressions import Tape
from scvi_codegen.systems.formulas.symbols import TIME, symbol

STEPS, SAMPLED_STATES, SAMPLED_CHANGES, SAMPLED_MODES = 400, 40, 12, 3
"""Number of steps of the run, and of its states, transitions and modes that are checked."""
ROUND_OFF, WIDTH = 256.0 * EPSILON, mp.mpf(10) ** -30
"""Bound on values that are 0, relative to the sum of their terms; width of differences in 60 digits."""
LEAST_STEPS, HALVINGS, CHANGES_OF_ORDER, SLACK_OF_RUNS, DECIDED = 16, 4, 2, 0.5, 1e-12
"""Of runs by which an order is measured: least number of steps, halvings that are tried, number of transitions,
difference allowed between measured and claimed order, and error that is round-off."""
CONDITIONS = (
    ("sides of kinks", "u has the sign of its side at all states (60 digits)", ("kink",)),
    ("complementarity", "gaps and normal forces are >= 0 (60 digits)", ("closes", "lifts", "leaves")),
    ("friction", "it is in its cone, and opposite to slip (60 digits)", ("stops", "forward", "backward", "begins")),
)
"""Names and statements of conditions, and the kinds of transitions that end them."""


class Change(NamedTuple):
    """Number of a transition, its time, (2m,) states and (k,) parameters before and after it, and row of the latter."""

    number: int
    t: float
    states: tuple[Array, Array]
    parameters: tuple[Array, Array]
    row: int


@dataclass(frozen=True)
class RunInModes:
    """Run of the stepper under test, whose parameters contain modes."""

    tested: SystemUnderTest
    run: Trajectory

    def motion(self, parameters: Array) -> ExactMotion:
        """Return the exact motion in the mode of parameters."""
        return exact_motion(self.tested.system).with_parameters(parameters.tolist())

    @cached_property
    def events(self) -> list[Event]:
        """Kinks and transitions that the run is searched for."""
        return [crossings.event for crossings in self.run.switches]

    @cached_property
    def functions(self) -> Tape:
        """Their functions by (q, p, v, t, parameters, multipliers)."""
        of = EventFormulas(self.run.stepper.interface, self.events)
        return Tape(of.functions, (*of.q, *of.p, *of.v, symbol(TIME), *of.parameters, *of.multipliers))

    def values(self, x: Numbers, parameters: Array) -> Numbers:
        """Return the functions at x = (q, p, t), then constraints and their rates, and these with the other sign."""
        motion, (q, p), t, zeros = self.motion(parameters), np.split(x[:-1], 2), x[-1], np.zeros(0)
        v, forces, named = motion.velocity(q, p, t), zeros, self.tested.stepper.parameters_by_name(parameters)
        if self.tested.system.constraints:
            forces, zeros = motion.multipliers(q, v, t), motion.constraint_terms(q, v, t)[2][1:3].ravel()
        values = self.functions([*q, *p, *v, t, *motion.parameters, *forces])
        sides = [np.sign(named[event.mode]) if hasattr(event, "mode") else 1 for event in self.events]
        return np.array([*(a * b for a, b in zip(values, sides, strict=True)), *zeros, *(-zeros)], dtype=object)

    def derivatives(self, x: Numbers, parameters: Array) -> Numbers:
        """Return the derivatives of the values by x, by differences."""
        now, moves = self.values(x, parameters), np.eye(len(x), dtype=int)
        return np.array([(self.values(x + WIDTH * move, parameters) - now) / WIDTH for move in moves]).T

    def relative(self, state: Array, t: float, parameters: Array) -> Array:
        """Return the values relative to the sum of their terms: derivatives by x times x and its change in a step."""
        x = numbers([*state, t])
        rates = np.array([*np.concatenate(self.motion(parameters).rates(*np.split(x[:-1], 2), x[-1])), 1])
        terms = np.abs(self.derivatives(x, parameters)) @ (np.abs(x) + np.abs(rates * self.run.h))
        return (self.values(x, parameters) / np.where(terms == 0, 1, terms)).astype(float)

    @cached_property
    def changes(self) -> list[Change]:
        """Some of the transitions that are alone at their time."""
        run, found = self.run, list[Change]()
        for crossings, rows in changes_by_events(replace(run, events=())):
            for t, q, p, row in zip(crossings.t.tolist(), crossings.q, crossings.p, rows.tolist(), strict=True):
                states = np.concatenate([q, p]), np.concatenate([run.q[row], run.p[row]])
                sides = parameters_on_sides(run, run.t.item(max(row - 1, 0))), parameters_on_sides(run, t)
                found.append(Change(self.events.index(crossings.event), t, states, sides, row))
        times = [change.t for change in found]
        alone = sorted((change for change in found if times.count(change.t) == 1), key=lambda change: change.t)
        return alone[:: -(-len(alone) // SAMPLED_CHANGES) or 1]

    def states(self) -> Iterator[tuple[Array, float, Array]]:
        """Yield (2m,) states, times and parameters: some of those of the run, and those before transitions."""
        for k in range(0, len(self.run), -(-len(self.run) // SAMPLED_STATES)):
            t = self.run.t.item(k)
            yield np.concatenate([self.run.q[k], self.run.p[k]]), t, parameters_on_sides(self.run, t)
        yield from ((change.states[0], change.t, change.parameters[0]) for change in self.changes)


def run_of(stepper: Stepper, start: State, h: float, end: float) -> Trajectory:
    """Return the run from a state by steps h; it may end where impacts accumulate."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", EventWarning)
        run: Trajectory = stepper.integrate(start.q, start.p, h=h, t_end=end, t=start.t)
        return run


def transition_checks(tested: SystemUnderTest, run: Trajectory) -> Iterator[Check]:
    """Yield the checks of a run by the stepper under test."""
    of, order = RunInModes(tested, run), f"order {tested.method.order} in h"
    statement = "their functions are 0 where modes change, up to round-off (60 digits)"
    yield from checked("transitions", statement, partial(_zeros, of))
    for name, statement, kinds in CONDITIONS:
        chosen = [k for k, event in enumerate(of.events) if getattr(event, "kind", "kink") in kinds]
        yield from checked(name, statement, partial(_conditions, of, chosen))
    last = [*range(len(of.events), len(of.events) + 4 * len(tested.system.constraints))]
    for name, statement, measure in (
        ("closed contacts", "gaps, their rates, and slips that stick are 0", partial(_conditions, chosen=last)),
        ("states at kinks", "continuous; where L jumps p+ - p- = lambda u_q, H+ - H- = -lambda u_t", _jumps),
        ("impacts of contacts", "impulses are >= 0, in their cone, and do no positive work (60 digits)", _impulses),
        ("steps in modes", "a step in each mode solves its equations (60 digits)", _steps),
        ("order in modes", f"{order} in each mode, to the exact motion (60 digits)", _order_in_modes),
        ("order across transitions", f"{order} of the end of a run", partial(_order, errors=_differences)),
        ("energy balance", f"{order} of H - W along a run", partial(_order, errors=_balances)),
    ):
        yield from checked(name, statement, partial(measure, of))


def _zeros(of: RunInModes) -> Finding:
    if not of.changes:
        raise StateError(f"no transition alone within {of.run.steps} steps: give another state, or step size")
    values = [abs(of.relative(at.states[0], at.t, at.parameters[0])[at.number]) for at in of.changes]
    return Finding(max(values), ROUND_OFF, f"relative to its terms, {len(values)} transitions")


def _conditions(of: RunInModes, chosen: Sequence[int]) -> Finding | None:
    """Return how far below 0 functions are at states of the run, relative to their terms."""
    if not chosen:
        return None
    low = [at for at in of.states() if min(of.values(numbers([*at[0], at[1]]), at[2])[chosen]) < 0]
    values = [float(-of.relative(*at)[chosen].min()) for at in low]
    return Finding(max(values, default=0.0), ROUND_OFF, "relative to their terms")


def _jumps(of: RunInModes) -> Finding | None:
    """Return the largest violation of the continuity at kinks, or of the Weierstrass-Erdmann conditions."""
    errors, m = list[float](), of.tested.system.dimension
    for at in of.changes:
        if hasattr(of.events[at.number], "mode"):
            x, jump, p = (
                numbers([*at.states[0], at.t]),
                numbers(at.states[1]) - numbers(at.states[0]),
                numbers(at.states[1])[m:],
            )
            n = of.derivatives(x, at.parameters[0])[at.number]
            impulse = jump[m:] @ n[:m] / (n[:m] @ n[:m] or 1)
            old, new = (
                of.motion(side).energy(x[:m], end, x[-1]) for side, end in zip(at.parameters, (x[m:-1], p), strict=True)
            )
            differences = *jump[:m], *(jump[m:] - impulse * n[:m]), (new - old + impulse * n[-1]) * bool(jump.any())
            errors.append(float(max(map(abs, differences)) / max(1, *map(abs, x), abs(old))))
    return Finding(max(errors), ROUND_OFF, f"relative, {len(errors)} crossings") if errors else None


def _impulses(of: RunInModes) -> Finding | None:
    """Return the largest violation of p+ - p- = G^T Lambda, |Lambda_t| <= mu Lambda_n, Lambda . (w+ + w-) <= 0.

    The last one is twice the work of the impulses at the rates w of gaps and slips, relative to moving surfaces.
    """
    system, stepper, errors = of.tested.system, of.tested.stepper, list[float]()
    contacts, first, m = (
        stepper.interface.contacts,
        len(system.constraints) - stepper.interface.masked,
        system.dimension,
    )
    for at in of.changes:
        if getattr(of.events[at.number], "kind", "") != "closes":
            continue
        named, hit = stepper.parameters_by_name(at.parameters[0]), getattr(of.events[at.number], "contact", 0)
        touching = [item for k, item in enumerate(contacts) if k == hit or named.get(str(item.closed))]
        masks = {name: float(item in touching and name in item.imposing) for item in contacts for name in item.masks}
        motion, (q, p), t = (
            of.motion(np.array([*(named | masks).values()])),
            np.split(numbers(at.states[0]), 2),
            mp.mpf(at.t),
        )
        v, after = (motion.velocity(q, end, t) for end in (p, numbers(at.states[1][m:])))
        (G, _, terms), rates, jump = (
            motion.constraint_terms(q, v, t),
            motion.constraint_terms(q, after, t)[2][2],
            at.states[1][m:] - p.astype(float),
        )
        impulses, _, rank, _ = np.linalg.lstsq(G.T.astype(float), jump)
        if rank < np.count_nonzero(np.any(G, axis=1)):
            continue  # they are not unique
        size, rates = np.abs(impulses).max(), (terms[2] + rates).astype(float)
        errors.append(np.abs(G.T.astype(float) @ impulses - jump).max() / np.abs(jump).max())
        errors.append(impulses @ rates / (size * np.abs(rates).max() or 1.0))
        for k, item in enumerate(contacts):
            if item in touching and item.normal is not None:
                mu = static_limit(system.contacts[k]) if item.slips else 0
                limit = (
                    float(Tape([mu], motion.symbols)([*q, *v, t, *motion.parameters])[0])
                    * impulses[first + item.normal]
                )
                slips = impulses[first + (item.tangential or 0) :][: item.slips]
                errors += [-impulses[first + item.normal] / size, (np.linalg.norm(slips) - limit) / size]
    return Finding(float(max(errors)), ROUND_OFF, "relative") if errors else None


def _in_modes(of: RunInModes) -> list[SystemUnderTest]:
    """Return the system under test in each of the first modes of the run."""
    seen = dict[bytes, SystemUnderTest]()
    for row in (0, *(change.row for change in of.changes)):
        parameters = parameters_on_sides(of.run, of.run.t.item(row))
        system = of.tested.system.with_parameters(**of.tested.stepper.parameters_by_name(parameters))
        start = State(of.run.q[row], of.run.p[row], of.run.t.item(row), of.run.h)
        seen.setdefault(parameters.tobytes(), replace(of.tested, system=system, initial=start))
    return [*seen.values()][:SAMPLED_MODES]


def _steps(of: RunInModes) -> Finding:
    return max(solves(tested, tested.stepper) for tested in _in_modes(of))


def _order_in_modes(of: RunInModes) -> Finding:
    orders = [order for tested in _in_modes(of) if (order := measured_order(tested)[0]) is not None]
    return Finding(
        min(orders, default=math.inf), (of.tested.method.order or 1) - SLACK, "infinite: exact steps", at_least=True
    )


def _differences(of: RunInModes, runs: list[Trajectory]) -> list[float]:
    ends = [np.concatenate([run.q[-1], run.p[-1]]) / of.tested.scales(of.tested.initial) for run in runs]
    return [float(np.abs(end - ends[-1]).max()) for end in ends]


def _balances(_: RunInModes, runs: list[Trajectory]) -> list[float]:
    return [run.energy_error() for run in runs]


def _order(of: RunInModes, errors: Callable[[RunInModes, list[Trajectory]], list[float]]) -> Finding:
    """Return the order of errors of runs with steps h, h/2 and h/8, over the first transitions."""
    if any(getattr(event, "power_sides", ()) for event in of.events):
        raise StateError("motions are not smooth at kinks with powers that are not whole: the order is lower there")
    start, order, best = of.run.t.item(0), of.tested.method.order or 1, Finding(-math.inf, math.nan)
    times = [*(change.t for change in of.changes), of.run.t.item(-1)][: CHANGES_OF_ORDER + 1]
    span = sum(times[-2:]) / len(times[-2:]) - start
    for halving in range(HALVINGS):
        steps = max(LEAST_STEPS, math.ceil(span / abs(of.run.h))) << halving
        plans = [(span / (factor * steps), start + span) for factor in (1, 2, 8)]
        first, second, _ = errors(of, [run_of(of.tested.stepper, of.tested.initial, *plan) for plan in plans])
        remark = f"{first:.1e}, then {second:.1e}, {steps} steps"
        if second <= DECIDED:
            return Finding(second, DECIDED, "exact up to round-off")
        best = max(best, Finding(math.log2(first / second), order - SLACK_OF_RUNS, remark, at_least=True))
        if best.satisfied:
            break
    return best
