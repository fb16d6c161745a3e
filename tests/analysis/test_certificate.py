"""The certificate: whole integrators pass it, and no fault of the generator does."""

import contextlib
import json
import sys
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sympy
from certified_cases import Case, case
from commands import invoke
from notation import lagrange
from samples import QUICK_FLAGS, pushed_pendulum

import scvi_codegen as sc
from scvi_codegen.codegen.ir import kernel
from scvi_codegen.codegen.lowering import stage_groups
from scvi_codegen.codegen.native import announcements
from scvi_codegen.codegen.rendering.kernels import printer
from scvi_codegen.common.precision import mp
from scvi_codegen.extras.exact.solution import exact_motion
from scvi_codegen.extras.exact.step import derived_step
from scvi_codegen.extras.verification import system_under_test
from scvi_codegen.extras.verification.certificate import Check, Finding, Outcome, ViolationError, checked
from scvi_codegen.extras.verification.stepping import step_checks
from scvi_codegen.extras.verification.structure import structure_checks
from scvi_codegen.methods import constraints, stage_system
from scvi_codegen.runs import compiler
from scvi_codegen.systems import derived_expressions
from scvi_codegen.systems.formulas.expressions import evaluate

pytestmark = [pytest.mark.long, pytest.mark.rotated]


def of_result(change: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """A function whose result is changed, in place of the original."""
    return lambda original: lambda *arguments, **named: change(original(*arguments, **named))


def without_velocities(original: Any) -> Any:
    """The chain rule of the double pendulum without the terms of its angles."""

    def along(expressions: Any, variables: Any, rates: Any) -> Any:
        pairs = [pair for pair in zip(variables, rates, strict=False) if not pair[0].name.startswith("theta")]
        return original(expressions, *zip(*pairs, strict=True))

    return along


SLIGHTLY = sympy.Rational(1, 10**6)
FAULTS = {
    "numbers printed with 8 digits": (
        *("pendulum/svi", printer, "print_number"),
        lambda _: lambda x, target=None: f"{float(x):.7e}",
    ),
    "tables of 24 bits": (
        *("double/svi", kernel, "lower_matrix"),
        of_result(lambda rows: tuple(tuple(mp.nint(x * 2**24) / 2**24 for x in row) for row in rows)),
    ),
    "a derivative in Newton's matrix five per cent off": (
        *("double/svi", stage_groups, "_partials"),
        of_result(lambda entries: entries | {(0, 0): entries[0, 0] * sympy.Rational(21, 20)}),
    ),
    "L_vq v left out": ("double/sc", derived_expressions, "tangents", without_velocities),
    "momentum by A in place of its transpose": (
        *("kepler/sc-phase-space", stage_system.Table, "transposed"),
        lambda own: property(lambda table: own.fget(table) if len(table.entries[0]) == 1 else table),
    ),
    "a multiplier's force off its gradient": (
        *("linkage/lobatto-svi", constraints, "with_constraint_forces"),
        of_result(lambda forces: (forces[0] * (1 + SLIGHTLY), *forces[1:])),
    ),
}
"""Faults of the generator by name: the case, the place of the function or property, and its replacement."""
_numbers = count(1)
"""Of compilations: each has its own library, also of the fallback, which a fault may leave unchanged."""


@contextlib.contextmanager
def planted(home: Any, name: str, replacement: Callable[[Any], Any]) -> Iterator[None]:
    """Replace a function wherever it has been imported; results computed with it are forgotten afterwards."""
    original = getattr(home, name)
    modules = [module for key, module in sys.modules.items() if key.startswith("scvi_codegen")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiler, "cached_source", lambda *arguments: arguments[-1]())
        patch.setattr(home, name, faulty := replacement(original))
        for module in modules:
            for key, value in list(vars(module).items()):
                if value is original:
                    patch.setattr(module, key, faulty)
        _empty_caches()
        yield
    _empty_caches()


def _empty_caches() -> None:
    for module in [module for key, module in sys.modules.items() if key.startswith("scvi_codegen")]:
        for value in list(vars(module).values()):
            if hasattr(value, "cache_clear"):
                value.cache_clear()


def certified(own: Case, *flags: str) -> sc.Certificate:
    stepper = sc.compile_stepper(
        *(own.system, own.method()), flags=(*QUICK_FLAGS, *flags), time_transformation=own.time_transformation
    )
    return sc.verify(own.system, own.method(), own.q, own.p, h=own.h, stepper=stepper, tolerance=own.tolerance)


def violated_by(fault: str) -> tuple[Check, ...]:
    name, *change = FAULTS[fault]
    assert case(name).system.formula is not None  # read before the fault is in force
    with planted(*change):
        return certified(case(name), f"-DFAULT_{next(_numbers)}").violated


@pytest.mark.parametrize("fault", FAULTS)
def test_planted_fault_is_detected(fault: str) -> None:
    assert violated_by(fault)


def test_planted_fault_leaves_no_trace_in_the_process() -> None:
    """The fallback iteration of Newton, for example, is shared by sources with and without the fault."""
    fault = "momentum by A in place of its transpose"
    assert violated_by(fault)
    assert certified(case(FAULTS[fault][0])).passed


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("given", [{}, {"q": [0.6], "p": [-0.3]}])
def test_inputs_are_certified_between_breakpoints(given: dict[str, Any]) -> None:
    system, stepper = pushed_pendulum(), sc.compile_stepper(pushed_pendulum(), sc.SVI(2), flags=QUICK_FLAGS)
    certificate = sc.verify(system, sc.SVI(2), **given, **({"stepper": stepper} if given else {}))
    assert certificate.passed, certificate.to_text()
    assert not certificate.not_measured


# Contents of a certificate.


def pendulum_certificate(**changes: object) -> sc.Certificate:
    system = sc.problem("planar-pendulum").system
    return sc.verify(system, sc.SVI(2), [0.7], [0.9], h=0.2, **changes)


def test_a_certificate_is_text_json_and_a_verdict(tmp_path: Path) -> None:
    certificate = pendulum_certificate()
    assert certificate.passed
    assert not certificate.not_measured
    known = {"stage equations", "Newton's matrix", "symplecticity", "reversal", "derivatives", "adjoint", "order"}
    assert known | {"largest step"} <= {check.name for check in certificate.checks}
    certificate.save(tmp_path / "certificate.json")
    read = json.loads((tmp_path / "certificate.json").read_text())
    assert read["passed"] is True
    assert len(read["checks"]) == len(certificate.checks)
    assert read["checksum"] == certificate.checksum
    assert "all measured properties are satisfied" in certificate.to_text()


def test_the_state_is_given_by_momenta_or_by_velocities() -> None:
    rod = sc.LagrangianSystem.from_text("rod", ["q"], "2*q_dot**2 + cos(q)")
    certificate = sc.verify(rod, "svi:1", [0.5], velocity={"q": 0.25}, h=0.1)
    assert certificate.passed
    assert (certificate.q, certificate.p) == ((0.5,), (1.0,))
    for state, message in (({"q": 1.0}, "got neither"), ({"velocity": 1.0}, "without q"), ({"p": 1.0}, "without q")):
        with pytest.raises(sc.StateError, match=message):
            sc.verify(rod, "svi:1", **state)


@pytest.mark.parametrize("method", ["svi:4", "svi:8"])
def test_rounding_of_growing_motions_is_no_drift(method: str) -> None:
    """A body falls 10^5 times its initial distance: terms of the energy and of the boost grow alike in all runs."""
    falling = sc.LagrangianSystem.from_text("falling", ["x", "y"], "(x_dot**2 + y_dot**2)/2 - 9.81*y")
    certificate = sc.verify(falling, method, q=[0.1, 1.0], p=[0.3, 0.0], h=0.02)
    drifts = [check for check in certificate.checks if check.name.startswith("drift")]
    assert len(drifts) == 2
    assert all(
        check.outcome is Outcome.SATISFIED and check.measured is not None and check.measured < 3.5 for check in drifts
    )


@pytest.mark.tiers(0, 1)
def test_constraints_are_certified_with_constant_inputs() -> None:
    """Cubics of time would push with 5000 after 50 units of it, and steps fail."""
    text = "(x_dot**2 + y_dot**2)/2 - y"
    pushed = lagrange(
        "pushed rod", "x y", text, constraints=["x**2 + y**2 = w**2"], forces={"x": "u"}, inputs="u w"
    ).with_parameters(w_0=1.0)
    method = sc.SVI(2, "gauss-lobatto:3")
    stepper = sc.compile_stepper(pushed, method, flags=QUICK_FLAGS)
    given = system_under_test.State(np.array([0.6, -0.8]), np.array([0.4, 0.3]), 0.0, 0.05)
    checks = structure_checks(system_under_test.SystemUnderTest(pushed, method, stepper, None, given))
    assert {check.name: check.outcome for check in checks}["constraints"] is Outcome.SATISFIED


def test_different_integrator_is_not_certified() -> None:
    system = sc.problem("planar-pendulum").system
    other = sc.compile_stepper(system, sc.SpectralCollocation(2), flags=QUICK_FLAGS)
    names = {check.name for check in pendulum_certificate(stepper=other).violated}
    assert {"stage equations", "symplecticity", "reversal"} <= names


@pytest.mark.quick
@pytest.mark.parametrize(
    ("measure", "outcome"),
    [
        (lambda: Finding(1.0, 2.0), Outcome.SATISFIED),
        (lambda: Finding(3.0, 2.0), Outcome.VIOLATED),
        (lambda: Finding(3.0, 2.0, at_least=True), Outcome.SATISFIED),
        (lambda: Finding(float("nan"), 2.0), Outcome.VIOLATED),
        (lambda: Finding(float("nan"), 2.0, at_least=True), Outcome.VIOLATED),
        (lambda: violated(ViolationError("it fails")), Outcome.VIOLATED),
        (lambda: violated(sc.StateError("it is singular")), Outcome.NOT_MEASURED),
        (lambda: violated(ZeroDivisionError("by zero")), Outcome.NOT_MEASURED),
    ],
)
def test_unmeasurable_properties_are_not_reported_as_satisfied(measure, outcome) -> None:
    (check,) = checked("name", "promise", measure)
    assert check.outcome is outcome
    assert check.outcome is not Outcome.NOT_MEASURED or check.remark


def violated(error: Exception) -> Finding:
    raise error


# What it measures with.


@pytest.mark.quick
@pytest.mark.parametrize("name", ["relativistic-particle", "double-pendulum"])
def test_velocities_are_found_where_newton_leaves_the_domain(name: str) -> None:
    motion = exact_motion(sc.problem(name).system)
    size = motion.system.dimension
    q, v = np.array([mp.mpf("0.3")] * size), np.array([mp.mpf("0.9")] * size)
    found = motion.velocity(q, motion.momentum(q, v, mp.zero), mp.zero)
    assert max(abs(found - v)) < mp.mpf("1e-40")


@pytest.mark.quick
def test_the_derived_step_is_that_of_the_closed_form() -> None:
    """Its unknowns satisfy the equations that ``derive`` prints."""
    system, method = sc.problem("planar-pendulum").system, sc.SVI(2)
    solved, derived = derived_step(system, method)([0.7], [0.4], 0.2), sc.derive(system, method)
    values = {entry.symbol: entry.value for entry in derived.entries} | dict(
        zip(derived.unknowns, solved.unknowns, strict=True)
    )
    values |= {derived.state[0][0]: mp.mpf(0.7), derived.state[1][0]: mp.mpf(0.4), derived.step: mp.mpf(0.2)}
    values |= {name: mp.mpf(value) for name, value in system.constants.items()}
    for equation in derived.equations:
        assert abs(evaluate(equation.residual, values)) < mp.mpf("1e-45")
    assert abs(evaluate(derived.end_momentum[0].residual, values) - solved.p[0]) < mp.mpf("1e-45")


# The command line.


def command(*words: str) -> tuple[int, str]:
    result = invoke("verify", *words, status=None)
    return result.exit_code, result.output


def test_model_file_and_its_generated_folder_are_verified(tmp_path: Path) -> None:
    entry = sc.problem("planar-pendulum")
    model = sc.Model(system=entry.system, method=sc.SVI(2), q=(0.7,), velocity=(0.1,), h=0.2, steps=10)
    sc.save_model(model, tmp_path / "pendulum.toml")
    code, output = command(str(tmp_path / "pendulum.toml"))
    assert code == 0, output
    assert json.loads((tmp_path / "pendulum.certificate.json").read_text())["passed"] is True

    folder = sc.generate_package(model, tmp_path / "pendulum_svi")
    source = folder / "pendulum_svi.c"
    text = source.read_text()
    source.write_text(text.replace("value[0] = -", "value[0] = -1.001*", 1))
    assert source.read_text() != text
    code, output = command(str(folder))
    assert code == 1
    assert "violated: " in output
    assert json.loads((folder / "certificate.json").read_text())["passed"] is False
    assert command(str(folder), "--degree", "3")[0] == 2


@pytest.mark.second
def test_certificate_reports_slow_checks_and_their_duration(quickly_compiled, monkeypatch, capsys):
    entry = sc.problem("harmonic-oscillator")
    message: list[str] = []
    monkeypatch.setattr(announcements, "PATIENCE_SECONDS", 0.0)
    monkeypatch.setattr(system_under_test, "ANNOUNCED_SECONDS", 0.0)
    stepper = quickly_compiled(entry.system, sc.SVI(1))
    given = system_under_test.State(np.array([1.0]), np.array([0.5]), 0.0, 0.1)
    with announcements.announce_to(message.append):
        next(step_checks(system_under_test.SystemUnderTest(entry.system, sc.SVI(1), stepper, None, given)))
    assert capsys.readouterr().err == ""
    next(step_checks(system_under_test.SystemUnderTest(entry.system, sc.SVI(1), stepper, None, given)))
    assert "which takes about" in capsys.readouterr().err  # which is no terminal
    assert "measuring stage equations" in message
    assert any("unknowns per step are solved in 60 digits, which takes about" in line for line in message)
