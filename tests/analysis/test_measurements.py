"""Measurements of certificates: known errors of a step in closed form, and the checks of every kind of system.

Nothing is compiled: the stepper is the midpoint rule for the oscillator, in NumPy.
"""

import json
import math
from collections.abc import Iterable
from types import MappingProxyType, SimpleNamespace
from typing import Any

import golden_cells
import numpy as np
import pytest

import scvi_codegen as sc
from scvi_codegen.common.precision import mp
from scvi_codegen.extras import verification
from scvi_codegen.extras.verification import arrays, convergence, roundoff, variable_steps
from scvi_codegen.extras.verification.certificate import Certificate, Check, Outcome, information
from scvi_codegen.extras.verification.derivatives import derivative_checks
from scvi_codegen.extras.verification.impacts import impact_checks
from scvi_codegen.extras.verification.roundoff import roundoff_checks
from scvi_codegen.extras.verification.stepping import _agree, _solves, predictor_checks, step_checks
from scvi_codegen.extras.verification.structure import _reversal, _symplecticity, structure_checks
from scvi_codegen.extras.verification.system_under_test import State, SystemUnderTest
from scvi_codegen.extras.verification.variable_steps import variable_step_checks
from scvi_codegen.runs.products import Products


def lagrangian(formula: str, coordinates: str = "q", **others: Any) -> sc.LagrangianSystem:
    return sc.LagrangianSystem.from_text("system", [*coordinates], formula, **others)


OSCILLATOR = lagrangian("q_dot**2/2 - q**2/2")
DAMPED = lagrangian("q_dot**2/2 - q**2/2", damping="g", parameters={"g": 0.25})
PUSHED = lagrangian("q_dot**2/2", forces={"q": "-q_dot"})
ROD = lagrangian("(x_dot**2 + y_dot**2)/2 - y", "xy", constraints=["x**2 + y**2 = 1"])
MIDPOINT = sc.SVI(1)
ERROR, EPSILON = 1e-4, float(np.finfo(float).eps)


class Midpoint:
    """Midpoint rule with relative errors of (q1, p1) if h has a sign, and of an entry of J and of its transpose."""

    defaults = MappingProxyType[str, float]({})
    flags = ("-O2",)
    interface = SimpleNamespace(
        title="",
        rotations=(),
        map_names=(),
        inputs=(),
        mode_names=(),
        modes=(),
        has_fallback=False,
        time_transformation=None,
    )
    source = SimpleNamespace(files={"a.h": "1", "a.c": "2"})
    _input_size, mode_columns, _states, _parameters = 4, (), None, None
    products = property(Products)

    def __init__(self, errors: Any = (0.0, 0.0), sign: int = 0, forward: float = 0.0, back: float = 0.0) -> None:
        self.errors, self.sign, self.tangent_errors = 1.0 + np.array(errors), sign, (forward, back)

    def with_events(self, events: Any) -> "Midpoint":
        return self

    @property
    def _second_derivatives(self) -> None:
        raise sc.MethodError

    def matrix(self, h: float) -> np.ndarray:
        exact = np.array([[1 - h * h / 4, h], [-h, 1 - h * h / 4]]) / (1 + h * h / 4)
        return exact * self.errors[:, np.newaxis] if h * self.sign > 0 else exact

    def step(self, q: Any, p: Any, h: float, *_: Any, options: Any = None) -> Any:
        return np.split(self.matrix(h) @ [*q, *p], 2)

    def velocity(self, q: Any, p: Any, *_: Any) -> Any:
        return p

    momentum = velocity

    def energy(self, q: Any, p: Any, *_: Any) -> float:
        return float(q @ q + p @ p) / 2

    def _propagate(self, starts: Any, vectors: Any, *_: Any, transpose: bool = False) -> None:
        (h,), jacobian = starts.h, np.eye(4)  # of (q, p, t, h)
        jacobian[:2, :2] = self.matrix(h)
        rate = np.array([[-h, 1 - h * h / 4], [h * h / 4 - 1, -h]]) / (1 + h * h / 4) ** 2
        jacobian[:2, 3] = rate @ [*starts.q[0], *starts.p[0]]
        jacobian[1, 0] *= 1.0 + self.tangent_errors[transpose]
        vectors[int(not transpose), 0] = (jacobian.T if transpose else jacobian) @ vectors[int(transpose), 0]


START = State(np.array([0.7]), np.array([0.4]), 0.0, 0.1)


def under_test(stepper: Any = None, newton: Any = None, system: Any = OSCILLATOR) -> SystemUnderTest:
    return SystemUnderTest(system, MIDPOINT, stepper or Midpoint(), newton, START)


ROUNDED = ERROR / EPSILON
RANGES = (
    (lambda tested: _solves(tested, tested.stepper), ROUNDED / 8, ROUNDED),
    (_agree, ROUNDED / 8, ROUNDED),
    (_reversal, ROUNDED / 16, ROUNDED),
    (_symplecticity, ERROR * (1 - 1e-6), ERROR * (1 + 1e-6)),  # det J - 1
)


@pytest.mark.parametrize("errors", [(0.0, ERROR), (ERROR, 0.0)], ids=["p", "q"])
@pytest.mark.parametrize("sign", [1, -1])
def test_an_error_of_one_component_at_one_of_two_states_is_measured(errors: Any, sign: int) -> None:
    for measure, low, high in RANGES:
        exact, wrong = (measure(under_test(each, Midpoint())) for each in (Midpoint(), Midpoint(errors, sign)))
        assert exact.satisfied
        assert low < wrong.measured < high
        assert exact.bound == 16.0 if low > 1.0 else exact.bound < 1e-11


def test_damping_contracts_areas_by_its_rate() -> None:
    tested = under_test(system=DAMPED)
    assert tested.damping == pytest.approx(0.25 * (1 + 0.05 * math.sin(1.0)))  # parameters are perturbed
    assert [state.h for state in tested.states] == [0.1, -0.05]
    assert _symplecticity(tested).measured == pytest.approx(1 - math.exp(-tested.damping * 0.1), rel=1e-6)


def test_derivatives_of_both_steppers_are_compared_with_differences_and_their_transpose() -> None:
    exact = {check.name: (check.measured < 1e-12, check.bound) for check in derivative_checks(under_test())}
    assert exact == dict.fromkeys(("derivatives", "adjoint"), (True, 1e-10))
    for wrong in (Midpoint(forward=ERROR, back=ERROR), Midpoint(forward=ERROR), Midpoint(back=ERROR)):
        forward, back = wrong.tangent_errors
        for tested in (under_test(wrong, Midpoint()), under_test(None, wrong)):
            derivative, adjoint = (check.measured for check in derivative_checks(tested))
            assert (derivative > ERROR / 100) == (forward > 0.0)
            assert (adjoint > ERROR / 1000) == (forward != back)


def test_order_and_rate_are_those_of_closed_forms() -> None:
    """The midpoint rule rotates by 2 arctan(h/2) in place of h."""
    tested = under_test()
    order, rate = convergence.convergence_checks(tested)
    assert (order.name, order.statement, order.bound) == ("order", "order 2 in h", 1.8)
    assert order.measured == pytest.approx(2.0, abs=1e-2)
    state = tested.states[0]
    missed = np.array([*Midpoint().step(state.q, state.p, state.h)]).ravel()
    missed -= np.array([[math.cos(0.1), math.sin(0.1)], [-math.sin(0.1), math.cos(0.1)]]) @ state.z
    coarse, fine = (float(convergence._error(tested, sc.SVI(s), state, state.h)) for s in (1, 3))
    assert coarse == pytest.approx(np.abs(missed / tested.scales(state)).max(), rel=1e-9)
    assert (rate.measured, rate.bound) == (pytest.approx(fine / coarse), 0.25)
    assert rate.remark == f"{MIDPOINT.name}: {coarse:.1e}, {sc.SVI(3).name}: {fine:.1e}, h = 0.1"


@pytest.mark.parametrize("names", ["svi:2 svi:4", "gauss:1 gauss:3", "sc:3 sc:5", "lobatto-iiia:2 lobatto-iiia:4"])
def test_degrees_compared_differ_by_two(names: str, monkeypatch: pytest.MonkeyPatch) -> None:
    compared = list[Any]()
    found = mp.mpf("0.1"), [mp.mpf("1e-3"), mp.mpf("1e-5")]
    monkeypatch.setattr(convergence, "_errors_of", lambda _, pair: (compared.extend(pair), found)[1])
    pair = [*map(sc.as_method, names.split())]
    result = convergence._rate_in_degree(SimpleNamespace(method=pair[1]))
    assert (compared, result.measured, result.bound) == (pair, pytest.approx(1e-2), 0.25)


def test_the_worst_of_several_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    walks = [roundoff._Walk(name, 100, mean, 1e-16, 64) for name, mean in (("energy", 1e-16), ("p", -3e-14))]
    student = roundoff._largest_student(iter(walks))
    assert student == (pytest.approx(3e-14 / math.hypot(1e-16, EPSILON / 4) * 8), 7.0, "p, 64 runs of 100 steps", False)
    monkeypatch.setattr(roundoff, "_walks", lambda *_: iter(walks))
    significant = (3e-14 - 7.0 * 1e-16 / 8) / (EPSILON * 100)
    assert roundoff._residual_drift(under_test())[:2] == (pytest.approx(significant), 0.25)
    steps = [(SimpleNamespace(h=0.1, unit=unit), error) for unit, error in ((1e-9, 2e-7), (4e-9, 9e-7), (2e-9, 3e-7))]
    monkeypatch.setattr(variable_steps, "_steps_of", lambda _: iter(steps))
    runs = SimpleNamespace(motion=None, tolerance=1e-6, rounding=lambda s: s.unit, distance=lambda *known: known[-1])
    expected = (3e-7, pytest.approx(1e-6 + 16 * 4e-9), "relative, 12 steps, largest 9.0e-07")
    assert variable_steps._within_tolerance(runs)[:3] == expected


TURNING = {"rotations": ("rotation R omega", "direction n", "spin s", "spin u")}
IN_TAU, DENSITY = {"in_tau": True}, {"time_transformation": "q**2"}
SYMMETRIC, LEFT = "svi:2", "radau-iia:2"
KINDS: list[tuple[Any, str, Any, dict[str, Any], str]] = [
    (structure_checks, SYMMETRIC, OSCILLATOR, {}, "symplecticity, reversal, L"),
    (structure_checks, SYMMETRIC, DAMPED, {}, "conformal symplecticity, reversal, L"),
    (structure_checks, SYMMETRIC, PUSHED, {}, "reversal, L"),
    (structure_checks, LEFT, OSCILLATOR, {}, ""),
    (structure_checks, "lobatto-iiia:2", OSCILLATOR, {}, "reversal"),
    (structure_checks, SYMMETRIC, ROD, {}, "symplecticity, constraints, multipliers, reversal, L"),
    (structure_checks, SYMMETRIC, OSCILLATOR, TURNING,
     "symplecticity, gauge invariance, reduced symplecticity, reversal, L"),
    (structure_checks, SYMMETRIC, ROD, TURNING,
     "symplecticity, gauge invariance, constraints, multipliers, reversal, L"),
    (step_checks, SYMMETRIC, OSCILLATOR, {},
     "stage equations, Newton's solver, solvers, Newton's matrix, fallback, convergence rate, run, stationarity, "
     "Legendre transform, discrete Lagrangian"),
    (predictor_checks, SYMMETRIC, OSCILLATOR, {}, "predictor"),
    (predictor_checks, "svi:1", OSCILLATOR, {}, ""),
    (predictor_checks, "stoermer-verlet", OSCILLATOR, {}, ""),
    (roundoff_checks, SYMMETRIC, OSCILLATOR, {},
     "compensated sums, low words, ensemble, drift, drift of ensembles, residual drift"),
    (derivative_checks, SYMMETRIC, OSCILLATOR, {}, "derivatives, adjoint, second derivatives, Hessian"),
    (variable_step_checks, SYMMETRIC, OSCILLATOR, IN_TAU, "steps of tau, time, final time, reversal in tau"),
    (variable_step_checks, SYMMETRIC, OSCILLATOR, {}, "adaptive steps, local error, L, adaptive steps"),
    (variable_step_checks, SYMMETRIC, OSCILLATOR, DENSITY,
     "adaptive steps, step density, reversal of adaptive steps, L, adaptive steps"),
    (variable_step_checks, LEFT, OSCILLATOR, DENSITY, "adaptive steps, step density"),
    (impact_checks, SYMMETRIC, OSCILLATOR, {},
     "event surfaces, saltation, reversal, impacts, impacts, symplecticity, impacts"),
    (impact_checks, LEFT, OSCILLATOR, {}, "event surfaces, saltation, impacts"),
    (impact_checks, SYMMETRIC, ROD, {}, "event surfaces, saltation"),
]  # fmt: skip


@pytest.mark.parametrize(("checks", "method", "system", "changes", "expected"), KINDS)
def test_each_kind_of_system_has_its_checks(
    checks: Any, method: str, system: Any, changes: Any, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing is measured; the checks of events share the crossings of the first."""

    def named(name: str, statement: str, measure: Any) -> Iterable[Check]:
        if name == "event surfaces":
            measure.args[-1].extend((None, []))
        assert name != "reduced symplecticity" or statement.endswith("(T*SO(3) and T*S^2 and S^2)")
        yield information(name, statement, None)

    monkeypatch.setitem(checks.__globals__, "checked", named)
    names = {"map_names": ("L", "E"), "map_exact": (True, False), "rotations": (), "in_tau": False}
    interface = SimpleNamespace(**{**names, "time_transformation": None} | changes)
    stepper, chosen = SimpleNamespace(interface=interface, changes_states=True), sc.as_method(method, system)
    tested = SimpleNamespace(system=system, method=chosen, stepper=stepper, scales=lambda _: None, initial=None)
    runs = SimpleNamespace(tested=tested, stepper=stepper)
    arguments = {impact_checks: (tested, stepper), variable_step_checks: (runs,)}
    assert ", ".join(check.name for check in checks(*arguments.get(checks, (tested,)))) == expected


GROUPS = (
    *("variable_step_checks", "step_checks", "predictor_checks", "roundoff_checks", "structure_checks"),
    *("derivative_checks", "time_transformation_derivative_checks", "convergence_checks", "identity_checks"),
    *("impact_checks", "largest_step"),
)
SLOWED = sc.reparametrise(OSCILLATOR, "1 + q**2")


@pytest.mark.parametrize(
    ("system", "tolerance", "missing"),
    [(OSCILLATOR, None, {0, 6}), (OSCILLATOR, 1e-6, {6}), (ROD, None, {0, 3, 6}), (SLOWED, None, set())],
)
def test_certificates_have_all_groups_of_checks_in_order(
    system: Any, tolerance: float | None, missing: set[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    for group in GROUPS[:-1]:
        monkeypatch.setattr(verification, group, lambda *_, group=group: [information(group, "", None)])
    monkeypatch.setattr(verification, "largest_step", lambda _: information("largest_step", "", None))
    monkeypatch.setattr(verification, "compile_stepper", lambda *_, **__: Midpoint())
    found = verification._certificate(
        system, system, MIDPOINT, Midpoint(), START, 0.0, solver="auto", tolerance=tolerance
    )
    assert [check.name for check in found.checks] == [g for k, g in enumerate(GROUPS) if k not in missing]
    assert (found.q, found.p, found.t, found.h, found.method) == ((0.7,), (0.4,), 0.0, 0.1, MIDPOINT.name)
    assert found.checksum == "6b51d431df5d7f141cbececcf79edf3dd861c3b4069f0b11661a3eefacbba918"  # of "12"


def test_constrained_arrays_are_certified_as_rattle(monkeypatch: pytest.MonkeyPatch) -> None:
    """At known sizes it is the variational integrator of degree 1 with the trapezoidal rule."""
    run = SimpleNamespace(q="q", p="p", _step_size=0.1, t=0.5)
    sizes = SimpleNamespace(sizes={"N": 2}, places={}, fields={})
    sizes.numbers, interface = (), SimpleNamespace(parameters=())
    stepper = SimpleNamespace(run_time_sizes=True, start=lambda *_, **__: run, interface=interface, source=None)
    stepper.events, stepper.with_events = (), lambda _: stepper
    stepper.products = SimpleNamespace(run_arrays=lambda *_: sizes)
    arguments: dict[str, Any] = {"tolerance": None, "parameters": None, "tables": None}
    arguments["of_known_sizes"] = lambda system, *state, **how: (system.dimension, *state, how["h"], how["t"])
    swings, method = golden_cells.swings(), sc.StoermerVerlet()
    result = arrays.verify_arrays(swings, method, stepper, (0, 0, 1, 1), 0.0, **arguments)
    assert result == (4, sc.SVI(1, "gauss-lobatto:2"), "q", "p", 0.1, 0.5)


def test_texts_of_certificates_have_all_numbers() -> None:
    outcomes = (Outcome.SATISFIED, Outcome.VIOLATED, Outcome.NOT_MEASURED, Outcome.INFORMATION)
    rows = zip(outcomes, (1e-3, math.inf, None, 0.5), (0.25, 2.0, None, None), ("a", "", "b", "c"), strict=True)
    checks = (Check(name=n, statement="s", outcome=o, measured=m, bound=b, remark=n) for o, m, b, n in rows)
    numbers = {"q": (1.0,), "p": (2.0,), "t": 3.0, "h": 0.125, "parameters": {"k": 4.0}, "seconds": 1.25}
    names = dict.fromkeys(("title", "system", "method", "version"), "T")
    found = Certificate(**names, **numbers, checksum="abc", flags=("-O2", "-g"), checks=tuple(checks))
    assert found.to_text().splitlines() == [
        *("T", "C source sha256 abc", "flags -O2 -g; step 0.125", ""),
        "satisfied     a: s: 0.001 (bound 0.25); a",
        "VIOLATED      : s: inf (bound 2)",
        "not measured  b: s: b",
        "information   c: s: 0.5; c",
        *("", "PROPERTIES ARE VIOLATED: 1 satisfied, 1 VIOLATED, 1 not measured, 1 information; 1.2 s"),
    ]
    read = json.loads(found.to_json())
    assert (read["passed"], read["checks"][1]["measured"], read["checks"][0]["bound"]) == (False, "inf", 0.25)
    page = str(found._repr_html_())
    assert [page.count(word) for word in ("<strong>", ">0.001<", ">0.25<", ">inf<", ">s; a<", ">0.5<")] == [1] * 6
