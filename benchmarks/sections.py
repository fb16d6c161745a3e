"""Sections of the benchmark that compare contenders at equal error: a case with its contenders and reference each."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np

from benchmarks.cases.adaptive import ADAPTIVE_CASES, adaptive_case
from benchmarks.cases.fields import FIELDS, FieldCase, our_fields
from benchmarks.cases.forced import driven_pendulum
from benchmarks.cases.large import atoms, bodies, field, ring
from benchmarks.cases.published import PUBLISHED_CASES, published_case
from benchmarks.cases.references import Reference, rms_error
from benchmarks.cases.robots import ROBOTS, TREES
from benchmarks.cases.rods import RODS, rods, with_constraints
from benchmarks.cases.rotations import BODIES, FEW_BODIES, ROTATIONS, tumbling
from benchmarks.cases.suites import SUITE_CASES, SUITE_ENDS, suite_case
from benchmarks.cases.unforced import CASES, STATES, Case, case
from benchmarks.comparison import Race
from benchmarks.contenders.arrays import step_counts
from benchmarks.contenders.contact import CONTACTS, contact_case, mujoco_contacts, our_contacts, siconos_contacts
from benchmarks.contenders.engines import mujoco_contenders
from benchmarks.contenders.mechanisms import LINKS, links
from benchmarks.contenders.ours import (
    LOOSE_TOLERANCES,
    adaptive_contenders,
    compiled,
    controlled_contenders,
    degree_contenders,
    fixed_contenders,
    our_contenders,
    our_ensembles,
    run_contenders,
)
from benchmarks.contenders.peers import PEERS, rebound_contenders
from benchmarks.contenders.taylor import heyoka_contenders, heyoka_ensembles
from benchmarks.report import Contender
from benchmarks.settings import Plan
from scvi_codegen.methods.composition import Composition
from scvi_codegen.methods.method import Method

ENSEMBLES = ("planar-pendulum", "kepler:0.2", "outer-solar-system")
"""Names of the cases that are run as ensembles."""
TRAJECTORIES = 64
Counts = Mapping[str | Method, Sequence[int]]
"""Numbers of steps by method."""


def _shortened(chosen: Case, plan: Plan) -> Case:
    return replace(chosen, span=chosen.span * plan.share)


def _single(make: Callable[[], Case], plan: Plan) -> Race:
    """Return single trajectories at advised step sizes."""
    chosen = _shortened(make(), plan)
    return Race(case=chosen, ours=partial(our_contenders, chosen, methods=plan.methods, quick=plan.quick))


def _ensemble(few: Case, many: Case, plan: Plan) -> Race:
    """Return all trajectories at once in one thread; heyoka in its batch mode."""
    peers = {"heyoka": lambda _, quick: heyoka_ensembles(many, quick), "mujoco": mujoco_contenders}
    return Race(case=few, ours=partial(our_ensembles, many, quick=plan.quick), peers=peers)


def _copies(name: str, plan: Plan) -> Race:
    """Return an ensemble of 64 trajectories from the eight states of a case, so that eight references suffice."""
    few = replace(_shortened(case(name), plan), name=f"ensemble:{name}")
    copies = 2 if plan.quick else TRAJECTORIES // STATES
    return _ensemble(
        few, replace(few, q=np.tile(few.q, (copies, 1)), velocity=np.tile(few.velocity, (copies, 1))), plan
    )


def _tumbling(plan: Plan) -> Race:
    """Return many free bodies, which MuJoCo integrates as one model."""
    chosen = _shortened(tumbling(FEW_BODIES if plan.quick else BODIES), plan)
    halved = step_counts(replace(chosen, step=1.0), range(2 if plan.quick else 5))
    counts: Counts = {"svi:8": halved, "composition:8": (1,)}  # exact in any step
    return replace(
        _ensemble(chosen, chosen, plan),
        ours=lambda: [*run_contenders(chosen, counts), *our_ensembles(chosen, counts=counts)],
    )


def _adaptive(name: str, plan: Plan) -> Race:
    """Return problems with close encounters, in all modes of this package."""
    chosen = _shortened(adaptive_case(name), plan)
    peers = {"heyoka": lambda case, _: heyoka_contenders(case, True), "rebound": rebound_contenders}
    return Race(case=chosen, ours=partial(adaptive_contenders, chosen, quick=plan.quick), peers=peers)


def _precision(make: Callable[[], Case], name: str, plan: Plan) -> Race:
    """Return all degrees with adaptive step size, and all peers, from errors of 1e-3 to round-off."""
    chosen = replace(_shortened(make(), plan), name=f"precision:{name}")
    peers = {peer: each.contenders for peer, each in PEERS.items()}
    peers["heyoka"] = partial(heyoka_contenders, loose=True)
    return Race(case=chosen, ours=partial(degree_contenders, chosen, quick=plan.quick), peers=peers)


def _published(make: Callable[[], Case], plan: Plan) -> Race:
    """Return a published problem, at advised and at adaptive step sizes."""
    chosen = _shortened(make(), plan)
    both = (our_contenders, adaptive_contenders)
    return Race(case=chosen, ours=lambda: [each for make in both for each in make(chosen, quick=plan.quick)])


def _suite(name: str, plan: Plan) -> Race:
    """Return a problem of another project's benchmark; the end of one is published, that of a part of it is not."""
    race = _published(partial(suite_case, name), plan)

    def once(make: Callable[..., Iterable[Contender]], *arguments: Any) -> Iterator[Contender]:
        return (replace(each, starts=1) for each in make(*arguments))

    peers = {peer: partial(once, make) for peer, make in race.peers.items()}
    ends = race.ends if plan.quick else SUITE_ENDS.get(name, race.ends)
    return replace(race, ours=partial(once, race.ours), peers=peers, ends=ends)


def _rods(n: int, plan: Plan) -> Race:
    """Return a chain of rods in angles, and with constraints."""
    chosen = _shortened(rods(n), plan)
    return Race(
        case=chosen,
        ours=lambda: [*with_constraints(chosen, n, quick=plan.quick), *adaptive_contenders(chosen, quick=plan.quick)],
        peers={"heyoka": lambda case, _: heyoka_contenders(case, True)},
    )


def _rotation(name: str, plan: Plan) -> Race:
    """Return a rigid body, at advised and at adaptive step sizes, and by explicit splitting, exact without forces."""
    chosen = _shortened(ROTATIONS[name](), plan)
    longest, halvings = (chosen.span, range(0, 13, 2)) if name == "free-top" else (1.0, range(6))
    splitting: Counts = {Composition(8): step_counts(replace(chosen, step=longest), halvings)}

    def ours() -> list[Contender]:
        both = (our_contenders, adaptive_contenders)
        made = [contender for make in both for contender in make(chosen, quick=plan.quick)]
        return [*made, *fixed_contenders(chosen, splitting)]

    return Race(case=chosen, ours=ours)


def _halved(
    make: Callable[[], Case], methods: Mapping[str | Method, range], exact: Mapping[str | Method, int], plan: Plan
) -> Race:
    """Return a case with its step size halved repeatedly; reference and its accuracy: the methods of ``exact``."""
    chosen = _shortened(make(), plan)

    @cache
    def exact_end() -> Reference:
        counts: Counts = {method: step_counts(chosen, range(k, k + 1)) for method, k in exact.items()}
        result, other = (each.prepare(0)() for each in fixed_contenders(chosen, counts))
        reference = Reference(positions=result.reshape(1, -1), accuracy=0.0)
        return replace(reference, accuracy=rms_error(other.reshape(1, -1), reference))

    some = {method: step_counts(chosen, k[: 2 if plan.quick else None]) for method, k in methods.items()}
    return Race(case=chosen, ours=partial(fixed_contenders, chosen, some), ends=lambda _, __: exact_end())


def _tree(make: Callable[[], Case], plan: Plan) -> Race:
    """Return a robot on a free base."""
    return replace(_robot(make, plan, TREE_METHODS, TREES_EXACT), errors=TREE_ERRORS)


def _robot(
    make: Callable[[], Case],
    plan: Plan,
    methods: Mapping[str | Method, range] | None = None,
    exact: Mapping[str | Method, int] | None = None,
) -> Race:
    """Return a multibody system at halved fixed steps; without closed loops also with adaptive steps."""
    race = _halved(make, methods or ROBOT_METHODS, exact or ROBOTS_EXACT, plan)
    if race.case.system.constraints:
        return race

    def ours() -> list[Contender]:
        tolerances = ROBOT_TOLERANCES[:: 4 if plan.quick else 1]
        return [*race.ours(), *controlled_contenders(race.case, *compiled(race.case.system, "svi:4"), tolerances)]

    return replace(race, ours=ours)


def _field(make: Callable[[], FieldCase], plan: Plan) -> Race:
    """Return a partial differential equation; every contender knows the exact solution on its own mesh."""
    chosen, exact = make(), Reference(positions=np.ones((1, 1)), accuracy=0.0)
    return Race(case=chosen.plain(), ours=lambda: our_fields(chosen, plan.quick), ends=lambda _, __: exact)


def _contact(name: str, plan: Plan) -> Race:
    """Return a problem with contacts; every contender knows the closed form."""
    chosen, exact = contact_case(name), Reference(positions=np.ones((1, 1)), accuracy=0.0)
    peers = {"mujoco": mujoco_contacts, "siconos": siconos_contacts}
    return Race(case=chosen, ours=partial(our_contacts, chosen, plan.quick), peers=peers, ends=lambda _, __: exact)


LATTICES: Mapping[str, Callable[[], Case]] = {
    "ring:1000": partial(ring, 1000, 20.0),
    "ring:100000": partial(ring, 100_000, 2.0),
    "field:256": partial(field, 256, 2.0),
    "bodies:256": partial(bodies, 256, 2.0),
    "bodies:1000": partial(bodies, 1000, 0.5),
    "atoms:256": partial(atoms, 4, 1.0),
}
EXPLICIT: dict[str | Method, range] = {f"svi:{s}": range(7 - s // 2) for s in (2, 4, 6, 8)}
EXPLICIT |= {Composition(8): range(6), "stoermer-verlet": range(1, 13)}
EXACT: dict[str | Method, int] = {"svi:10": 3, Composition(10): 5}
ROBOT_METHODS: dict[str | Method, range] = {f"svi:{s}": range(most) for s, most in ((2, 7), (4, 5), (6, 4))}
ROBOTS_EXACT: dict[str | Method, int] = {"svi:8": 3, "svi:6": 4}
ROBOT_TOLERANCES = (*LOOSE_TOLERANCES, 0.1, 0.3, 0.9)
"""Tolerances of adaptive steps: those of the curve of a step, whose ends have smaller errors."""
TREE_METHODS: dict[str | Method, range] = {"svi:2": range(4, 9), "svi:4": range(1, 6)}
TREE_ERRORS = (1e-4, 1e-7, 1e-10)
TREES_EXACT: dict[str | Method, int] = {"svi:4": 6, "svi:3": 7}
MECHANISM_METHODS: dict[str | Method, range] = {"svi:4": range(6)}

ALL_CASES: Mapping[str, Callable[[], Case]] = {
    **CASES,
    "forced:double-pendulum": driven_pendulum,
    **{f"published:{name}": partial(published_case, name) for name in PUBLISHED_CASES},
    **{f"adaptive:{name}": partial(adaptive_case, name) for name in ADAPTIVE_CASES},
    **{f"rotations:{name}": make for name, make in ROTATIONS.items()},
}
"""Cases whose degrees are compared."""

BUILDERS: dict[str, Callable[[Plan], Race]] = {
    **{name: partial(_single, make) for name, make in CASES.items()},
    **{f"ensemble:{name}": partial(_copies, name) for name in ENSEMBLES},
    "forced:double-pendulum": partial(_single, driven_pendulum),
    **{f"published:{name}": partial(_published, partial(published_case, name)) for name in PUBLISHED_CASES},
    **{name: partial(_suite, name) for name in SUITE_CASES},
    **{f"rods:{n}": partial(_rods, n) for n in RODS},
    **{f"precision:{name}": partial(_precision, make, name) for name, make in ALL_CASES.items()},
    **{f"adaptive:{name}": partial(_adaptive, name) for name in ADAPTIVE_CASES},
    **{f"rotations:{name}": partial(_rotation, name) for name in ROTATIONS},
    "rotations:bodies": _tumbling,
    **{f"robots:{name}": partial(_robot, make) for name, make in ROBOTS.items()},
    **{f"robots:{name}": partial(_tree, make) for name, make in TREES.items()},
    **{name: partial(_contact, name) for name in CONTACTS},
    **{f"fields:{name}": partial(_field, make) for name, make in FIELDS.items()},
    **{f"lattices:{name}": partial(_halved, make, EXPLICIT, EXACT) for name, make in LATTICES.items()},
    **{
        f"mechanisms:{n}": partial(_halved, partial(links, n), MECHANISM_METHODS, {"svi:6": 5, "svi:4": 6})
        for n in LINKS
    },
}
"""Functions from a plan to a race, by the name of the section."""
