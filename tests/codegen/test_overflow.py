"""Iterations that overflow fail, and errors are controlled for states of any size."""

import numpy as np
import pytest
from notation import lagrange
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen.common.errors import StepFailedError

OSCILLATOR = sc.LagrangianSystem.from_text(name="osc", coordinates=["q"], lagrangian="q_dot**2/2 - q**2/2")
COUPLED = lagrange("pair", "q r", "(q_dot**2 + r_dot**2 + q_dot*r_dot/2)/2 - q**2/2 - r**2/2 - q*r/3")
HAMILTONIAN = sc.HamiltonianSystem.from_text(name="mixed", coordinates=["q"], hamiltonian="p_q**2/2 + q**2/2 + p_q*q/3")
ITERATED = [
    *((OSCILLATOR, method) for method in ("svi:2", "scvi:3", "sc:3")),
    (COUPLED, "svi:3"),
    (HAMILTONIAN, "gauss:3"),
]


class StoppedError(Exception):
    """A run was going on."""


def stop(steps: int) -> None:
    """Ends a run that has taken so many steps, but is not at its end."""
    raise StoppedError


@pytest.mark.tiers(0, 1)
@pytest.mark.sampled(2)
@pytest.mark.parametrize(("system", "method"), ITERATED, ids=[f"{system.name}-{method}" for system, method in ITERATED])
def test_iterations_that_overflow_do_not_converge(system, method):
    stepper = sc.compile_stepper(system, method, solver="fixed-point", flags=QUICK_FLAGS)
    start = np.linspace(1.0, 0.5, stepper.dimension), np.zeros(stepper.dimension)
    for h in (1e4, 1e5, 1e6, 1e7, 1e10, 1e14, 1e20, 1e26, 1e40, 1e80, 1e160, 1e300):
        with pytest.raises(StepFailedError, match=r"did not converge|infinite or NaN"):
            stepper.step(*start, h)
        if system is OSCILLATOR and method == "svi:2":
            many = stepper.integrate_ensemble([start[0]] * 3, [start[1]] * 3, h=h, steps=1)
            assert set(many.status) <= {"not converged", "not finite"}
    with pytest.raises(StoppedError):  # not by one step
        stepper.integrate(*start, t_end=1e14, tolerance=1e-9, progress=stop)


@pytest.mark.tiers(1, 2)
@pytest.mark.parametrize(("system", "method"), ITERATED, ids=[f"{system.name}-{method}" for system, method in ITERATED])
def test_step_count_does_not_depend_on_scale(system, method):
    stepper = sc.compile_stepper(system, method, solver="fixed-point", flags=QUICK_FLAGS)
    start = np.linspace(1.0, 0.5, stepper.dimension), np.zeros(stepper.dimension)
    expected = stepper.integrate(*start, t_end=5.0, tolerance=1e-9)
    for size in (1e-290, 1e-200, 1e-150, 1e150, 1e200, 1e290):
        found = stepper.integrate(*(size * x for x in start), t_end=5.0, tolerance=1e-9)
        assert found.steps == expected.steps
        np.testing.assert_allclose(found.q / size, expected.q, rtol=0, atol=1e-13)
        assert found.step_error == pytest.approx(expected.step_error, rel=1e-3)
