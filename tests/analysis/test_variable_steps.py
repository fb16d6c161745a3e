"""Certificates of runs in transformed time and with adaptive steps."""

from collections.abc import Iterator

import numpy as np
import pytest
from certified_cases import CONTROLLED, REVERSIBLE, Case, case
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen.analysis.verification.certificate import Check, Outcome
from scvi_codegen.analysis.verification.system_under_test import State, SystemUnderTest
from scvi_codegen.analysis.verification.variable_steps import VariableSteps, at_fixed_energy, variable_step_checks

STEP_CHECKS = {
    "transformed": (case("slowed/svi-3"), {"steps of tau", "time", "final time", "reversal in tau"}),
    "controlled": (CONTROLLED, {"adaptive steps", "local error", "angular momentum, adaptive steps"}),
    "reversible": (
        REVERSIBLE,
        {"adaptive steps", "step density", "reversal of adaptive steps", "angular momentum, adaptive steps"},
    ),
}


def checks_of(given: Case) -> Iterator[Check]:
    """Without those of single steps, which ``test_certificate.py`` has."""
    own = given.system.clock.plain if given.system.clock else given.system
    runs = sc.compile_stepper(
        given.system, given.method(), flags=QUICK_FLAGS, time_transformation=given.time_transformation
    )
    q, p = np.array(given.q), np.array(given.p)
    steps = at_fixed_energy(given.system, runs.energy(q, p))
    single = sc.compile_stepper(steps, given.method(), flags=QUICK_FLAGS)
    tested = SystemUnderTest(steps, given.method(), single, None, State(q, p, 0.0, given.h))
    return variable_step_checks(VariableSteps(tested, runs, own, given.system, given.tolerance))


@pytest.mark.second
@pytest.mark.parametrize("name", STEP_CHECKS)
def test_local_error_of_run_steps_is_measured(name: str) -> None:
    given, claims = STEP_CHECKS[name]
    checks = list(checks_of(given))
    assert all(check.outcome is Outcome.SATISFIED for check in checks), "\n".join(map(str, checks))
    assert {check.name for check in checks} == claims


@pytest.mark.full
@pytest.mark.parametrize("name", STEP_CHECKS)
def test_certificates_contain_the_local_error(name: str) -> None:
    given, claims = STEP_CHECKS[name]
    stepper = sc.compile_stepper(
        given.system, given.method(), flags=QUICK_FLAGS, time_transformation=given.time_transformation
    )
    certificate = sc.verify(
        given.system, given.method(), given.q, given.p, h=given.h, stepper=stepper, tolerance=given.tolerance
    )
    assert certificate.passed, certificate.to_text()
    assert claims <= {check.name for check in certificate.checks}
