"""The table in docs/features.md: each feature works for a kind of system, or an error names it and the reason."""

import warnings
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
import pytest
from features import FEATURES, KINDS, SUPPORTS, Kind, refusals
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen.codegen.native.option_table import in_words
from scvi_codegen.common.errors import MissingLibraryError, ScviCodegenError
from scvi_codegen.runs.stepping import features

PAGE = (Path(__file__).parents[2] / "docs" / "features.md").read_text(encoding="utf-8")
ROWS = [[cell.strip() for cell in line.strip("|").split("|")] for line in PAGE.splitlines() if line.startswith("| ")]
TABLE = {row[0]: dict(zip(KINDS, row[1:], strict=True)) for row in ROWS if len(row) == 4 and row[0] in FEATURES}
REASONS = r"known at run time|must have (the )?shape|run\.at\(times\)|not an array of positions"
"""Beginnings of reasons: of sizes, of states whose size is known, of output times, of lists of neighbours."""


@pytest.fixture(scope="module")
def kinds():
    return {name: Kind(name) for name in KINDS}


def test_table_lists_the_features_that_are_tested():
    assert list(TABLE) == list(FEATURES)
    assert {cell for row in TABLE.values() for cell in row.values()} == {"yes", "no"}


def cases():
    """Each refusal is in every run; features that work, which have tests of their own, rotate."""
    for feature, row in TABLE.items():
        for kind in KINDS:
            marks = pytest.mark.rotated if row[kind] == "yes" else pytest.mark.second
            yield pytest.param(feature, kind, marks=marks)


@pytest.mark.parametrize(("feature", "kind"), [*cases()])
def test_features_work_or_are_refused_with_a_reason(feature, kind, kinds, tmp_path):
    of = kinds[kind]
    of.used = of.stepper()
    with warnings.catch_warnings(action="ignore"):
        if TABLE[feature][kind] == "no":
            with pytest.raises(ScviCodegenError, match=REASONS):
                FEATURES[feature](of, tmp_path)
            assert feature not in SUPPORTS or not of.used.supports(SUPPORTS[feature])
            return
        try:
            FEATURES[feature](of, tmp_path)
        except MissingLibraryError as error:
            pytest.skip(str(error))
        finally:
            assert feature not in SUPPORTS or of.used.supports(SUPPORTS[feature])


def stepper_of(method="svi:2", *, g=None, tau=None, events=None, precision="double", **arguments):
    """Return a stepper of one coordinate, or with arguments of the system."""
    lagrangian = arguments.pop("lagrangian", "q_dot**2/2 - q**2/2")
    system = sc.LagrangianSystem.from_text("body", arguments.pop("coordinates", ["q"]), lagrangian, **arguments)
    system = sc.reparametrise(system, tau) if tau else system
    return sc.compile_stepper(
        system, method, time_transformation=g, events=events, precision=precision, flags=QUICK_FLAGS
    )


def loaded(stepper):
    """Return a stepper from its C source alone."""
    return type(stepper)(stepper.source, stepper.interface, flags=QUICK_FLAGS)


FIRST_ORDER = {"coordinates": ["q", "r"], "lagrangian": "q*r_dot - (q**2 + r**2)/2"}
ARRAY = {"coordinates": ["q[N]"], "lagrangian": "sum(i in N, q_dot[i]**2/2 - q[i]**2/2)"}


def array_with_constraint(method):
    return stepper_of(method, **ARRAY, constraints=["q[0] - q[1] = 0"])


LOBATTO = {"method": sc.SVI(1, "gauss-lobatto:2"), "coordinates": ["q", "r"], "lagrangian": "(q_dot**2 + r_dot**2)/2"}
SITUATIONS = {
    "in a heat bath": lambda: stepper_of(damping=0.1, temperature=1.0),
    "with a time transformation": lambda: stepper_of(g="1/(1 + q**2)"),
    "in transformed time": lambda: stepper_of(tau="1/(1 + q**2)"),
    "in transformed time of a first-order system": lambda: stepper_of(tau="1/(1 + q**2)", **FIRST_ORDER),
    "for a first-order system": lambda: stepper_of(**FIRST_ORDER),
    "with events that change the state": lambda: stepper_of(events=sc.Event("q - 0.25", then={"p_q": "-p_q"})),
    "with events that set parameters": lambda: stepper_of(
        lagrangian="q_dot**2/2 - k*q**2/2", parameters={"k": 1.0}, events=sc.Event("q - 0.25", then={"k": "2"})
    ),
    "with constraints": lambda: stepper_of(**LOBATTO, constraints=["q - r = 0"]),
    "with nonholonomic constraints": lambda: stepper_of(
        coordinates=["q", "r"], lagrangian="(q_dot**2 + r_dot**2)/2", constraints=["q_dot = q*r_dot"]
    ),
    "with contacts": lambda: sc.compile_stepper(
        sc.LagrangianSystem.from_text("body", ["q"], "q_dot**2/2 - q"), "svi:2", contacts=[sc.contact("q + 1")]
    ),
    "with contacts by steps": lambda: sc.compile_stepper(
        sc.LagrangianSystem.from_text("body", ["q"], "q_dot**2/2 - q"), "svi:1", contacts=[sc.contact("q + 1")]
    ).by_transitions("by steps"),
    "with kinks that runs locate": lambda: stepper_of(lagrangian="q_dot**2/2 - q**2/2 - positive_part(q - 0.25)**2"),
    "where L or H jumps": lambda: stepper_of(lagrangian="q_dot**2/2 - q**2/2 - unit_step(q - 0.25)"),
    "with constraints of arrays": lambda: array_with_constraint("stoermer-verlet"),
    "with constraints of arrays by a composition": lambda: array_with_constraint("composition:4"),
    "with constraints that prescribe the motion": lambda: stepper_of(
        **LOBATTO, constraints=["q - r = 0", "q + r - 0.6 = 0"]
    ),
    "without derivatives": lambda: loaded(stepper_of()),
    "without second derivatives": lambda: stepper_of(damping=0.1),
    "without an error estimate": lambda: stepper_of("stoermer-verlet"),
    "without trajectories in SIMD lanes": lambda: stepper_of("scvi:2"),
    "without a tangent vector along runs": lambda: stepper_of("scvi:2"),
    "with sizes known at run time": lambda: stepper_of(**ARRAY),
    "with precision='double-double'": lambda: stepper_of(precision="double-double"),
    "with forces": lambda: stepper_of(forces={"q": "-q_dot"}),
    "with the long steps of this method": lambda: stepper_of("svi:4"),
    "where the energy changes": lambda: stepper_of(lagrangian="q_dot**2/2 - cos(t)*q**2/2"),
    "": stepper_of,
}
"""Steppers with the properties of the table; one without any lacks constraints, work, a mesh and run-time sizes."""
PLAIN = (
    *("without constraints", "without the work of forces", "without a mesh", "with sizes known when compiled"),
    "without steps of contacts",
)


def run_of(stepper, **arguments):
    """Return a run of few steps."""
    q, p = state_of(stepper)
    with_end = bool(stepper.interface.time_transformation)
    return stepper.integrate(q, p, **{"h": 0.1, "t_end" if with_end else "steps": 0.4 if with_end else 4} | arguments)


def state_of(stepper):
    """Return a state on the constraints."""
    if stepper.interface.layout.coordinates:
        return {"q": [0.3, 0.3]}, {"q": [0.0, 0.0]}
    return np.full(stepper.dimension, 0.3), np.zeros(stepper.dimension)


def rows_of(run):
    return np.ones((len(run.t), 2 * run.stepper.dimension))


OPERATIONS = {
    "adaptive": lambda s: s.integrate(*state_of(s), t_end=0.3),
    "error": lambda s: s.integrate(*state_of(s), t_end=0.3, error=1e-6),
    "check_growth": lambda s: s.integrate(*state_of(s), t_end=0.3, check_growth=True, **step_of_tau(s)),
    "t_eval": lambda s: run_of(s, steps=None, t_end=0.4, t_eval=[0.1]),
    "observe": lambda s: run_of(s, observe=lambda run: run.energy),
    "events": lambda s: run_of(s, events=sc.Event("t - 0.17", terminal=True)),
    "threads": lambda s: run_of(s, threads=2),
    "tables": lambda s: run_of(s, tables={}),
    "with_sizes": lambda s: s.with_sizes(N=2),
    "ensembles": lambda s: s.integrate_ensemble(*map(stacked, state_of(s)), h=0.1, steps=3),
    "observe_ensemble": lambda s: s.integrate_ensemble(*map(stacked, state_of(s)), h=0.1, steps=3, observe="extremes"),
    "single": lambda s: s.integrate_ensemble(*map(stacked, state_of(s)), h=0.1, steps=3, precision="single"),
    "by_steps": lambda s: s.by_transitions("by steps"),
    "crossings": lambda s: run_of(s).crossings("t - 0.17"),
    "checkpoint": lambda s: s.start(*state_of(s), h=0.1, **end_of(s)).checkpoint(),
    "recording": lambda s: sc.record_run(
        s.start(*state_of(s), h=0.1, **end_of(s)), mkdtemp() + "/a.run", steps=None if end_of(s) else 3
    ),
    "dense_output": lambda s: run_of(s).at([0.15]),
    "project": lambda s: s.project(*state_of(s)),
    "multipliers": lambda s: s.multipliers(*state_of(s)),
    "work": lambda s: s.work_and_impulses(*state_of(s), 0.1),
    "discrete_lagrangian": lambda s: s.discrete_lagrangian(state_of(s)[0], state_of(s)[0], 0.1),
    "momentum_maps": lambda s: run_of(s).momentum_maps(),
    "unresolved": lambda s: run_of(s).unresolved(),
    "jacobian": lambda s: s.jacobian(*state_of(s), 0.1),
    "tangent": lambda s: run_of(s).tangent(),
    "pullback": lambda s: (run := run_of(s)).pullback(rows_of(run)),
    "sensitivity": lambda s: run_of(s).sensitivity(),
    "hessian": lambda s: (run := run_of(s)).hessian_product(rows_of(run), np.ones(2 * run.stepper.dimension)),
    "chaos": lambda s: run_of(s).chaos_indicators(),
    "shadow_energy": lambda s: run_of(s, t_end=2.0, steps=None).shadow_energy(),
    "chaos_ensemble": lambda s: s.chaos_indicators_ensemble(*map(stacked, state_of(s)), h=0.1, steps=3),
    "periodic_orbit": lambda s: sc.periodic_orbit(s, *state_of(s), period=6.3, steps=60),
    "energy": lambda s: sc.periodic_orbit(s, *state_of(s), period=6.3, steps=60, energy=0.1),
    "fit": lambda s: sc.fit(s, [0.1, 0.2], [[0.3], [0.3]], q=state_of(s)[0], p=state_of(s)[1], h=0.1, unknown=["k"]),
    "flow": lambda s: sc.jax_flow(s, steps=3),
}
"""Each operation of the table that one stepper can run; inputs have their own tests."""
OF_OTHER_STATES = {
    "with contacts": {"jacobian", "multipliers", "work", "discrete_lagrangian"},  # modes as parameters
    "with contacts by steps": {"jacobian", "multipliers", "work", "discrete_lagrangian"},
    "with kinks that runs locate": {"shadow_energy"},  # runs that cross none
}
"""Operations that these situations support, but not with the states of ``OPERATIONS``."""


def stacked(state):
    return {name: np.stack([x, x]) for name, x in state.items()} if isinstance(state, dict) else np.stack([state] * 2)


def step_of_tau(stepper):
    return {"h": 0.1} if stepper._has_tau else {}


def end_of(stepper):
    return {"t_end": 1.0} if stepper.interface.time_transformation else {}


@pytest.fixture(scope="module")
def situations():
    return cache(lambda name: SITUATIONS[name]())


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("situation", SITUATIONS)
def test_refusals_of_the_table_are_those_of_the_operations(situation, situations):
    stepper = situations(situation)
    for operation, excluding in features.FEATURES:
        if operation not in OPERATIONS or excluding not in (PLAIN if situation == "" else (situation,)):
            continue
        support = stepper.supports(operation)
        assert not support
        with pytest.raises(ScviCodegenError) as error:
            OPERATIONS[operation](stepper)
        remedy = in_words(features.FEATURES[operation, excluding])
        assert support.reason.endswith(remedy), (operation, situation)
        assert remedy in str(error.value), (operation, situation)


@pytest.mark.rotated
@pytest.mark.parametrize("half", [0, pytest.param(1, marks=pytest.mark.full)])
@pytest.mark.parametrize("situation", [name for name in SITUATIONS if name != "without derivatives"])
def test_operations_that_a_stepper_supports_work(situation, half, situations):
    """In the default tier half of the operations in each situation, each operation in half of the situations."""
    stepper, left_out = situations(situation), {"observe_ensemble", "fit", "flow", "periodic_orbit", "energy"}
    left_out |= OF_OTHER_STATES.get(situation, set())
    left_out |= {"work", "discrete_lagrangian", "chaos"} if stepper.run_time_sizes else set()
    with warnings.catch_warnings(action="ignore"):
        for number, (operation, call) in enumerate(OPERATIONS.items(), [*SITUATIONS].index(situation)):
            if number % 2 == half and operation not in left_out and stepper.supports(operation):
                call(stepper)


def test_every_property_of_a_stepper_has_a_stepper_that_has_it():
    named = {excluding for _, excluding in features.FEATURES} - {"without an action", "without a sum of L along steps"}
    known = features.PROPERTIES.keys() | features.PROPERTIES_OF_SIZES.keys()
    assert named & known == set(SITUATIONS) - {""} | set(PLAIN)


@pytest.mark.second
def test_arguments_of_one_run_exclude_each_other():
    stepper = stepper_of()
    for operation, other in (("t_eval", "inputs"), ("observe", "inputs"), ("observe", "t_eval"), ("chaos", "inputs")):
        assert stepper.supports(operation)
        assert f"not available with {other}" in stepper.supports(operation, other).reason


def test_page_lists_the_names_and_what_excludes_them():
    assert PAGE.endswith(refusals())
