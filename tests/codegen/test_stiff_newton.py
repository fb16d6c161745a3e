"""Newton's iteration ends where rounding does in a stiff system: a pendulum whose rod is a spring."""

import numpy as np
import pytest
from notation import lagrange
from samples import QUICK_FLAGS

from scvi_codegen import SVI, RadauIIA, SolverOptions, StepFailedError, compile_stepper
from scvi_codegen.extras.exact.step import derived_step

STIFFNESS = 1e8
EPSILON = 2.0**-52


def spring_pendulum():
    return lagrange(
        "spring pendulum", "x y", "(x_dot**2 + y_dot**2)/2 - 9.81*y - k/2*(sqrt(x**2 + y**2) - 1)**2", k=STIFFNESS
    )


@pytest.mark.second
@pytest.mark.parametrize("method", [RadauIIA(3), SVI(1), SVI(2)], ids=lambda method: method.name)
def test_steps_are_those_of_60_digits_up_to_the_rounding_of_positions(method):
    """The momenta's error is what rounding of a position does through the spring in a step: h k epsilon."""
    system = spring_pendulum()
    stepper, derived = compile_stepper(system, method, solver="newton", flags=QUICK_FLAGS), derived_step(system, method)
    for h in (0.01, 0.001):
        run = stepper.integrate([1.0, 0.0], [0.0, 0.1], h=h, steps=200)
        for k in (0, 3, 100):
            q, p = stepper.step(run.q[k], run.p[k], h)
            exact = derived(run.q[k], run.p[k], h, 0.0)
            assert max(abs(exact.q - q)) < 16 * EPSILON
            assert max(abs(exact.p - p)) < 4 * h * STIFFNESS * EPSILON


def test_unconverged_steps_are_rejected():
    stepper = compile_stepper(spring_pendulum(), SVI(1), solver="newton", flags=QUICK_FLAGS)
    with pytest.raises(StepFailedError, match="did not converge"):
        stepper.step([1.0, 0.0], [0.0, 100.0], 0.1, options=SolverOptions(max_iterations=2))
    assert np.isfinite(stepper.step([1.0, 0.0], [0.0, 0.1], 0.001)).all()
