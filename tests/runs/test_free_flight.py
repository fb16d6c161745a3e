"""Forces that set in between the points of two steps are seen: free flights onto stiff floors, by every solver."""

import numpy as np
import pytest
from notation import lagrange

import scvi_codegen as sc


def largest_energy_error(stepper: sc.Stepper, q: object, v: object) -> float:
    run = stepper.integrate(q, velocity=v, t_end=2.0, tolerance=1e-12, check_growth=False)
    return float(np.abs(run.energy() / run.energy()[0] - 1).max())


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(
    ("lagrangian", "solver", "allowed"),
    [
        ("x_dot**2/2 + y_dot**2/2 - 9.8*y - 1e5*positive_part(-y)**2", "auto", 1e-4),
        ("x_dot**2/2 + y_dot**2/2 + x_dot*y_dot/4 - 9.8*y - 1e5*positive_part(-y)**2", "auto", 1e-4),
        ("x_dot**2/2 + y_dot**2/2 + x_dot*y_dot/4 - 9.8*y - 1e5*positive_part(-y)**2", "newton", 1e-4),
    ],
)
def test_ball_on_a_stiff_floor_conserves_its_energy(lagrangian: str, solver: str, allowed: float) -> None:
    system = sc.LagrangianSystem.from_text("ball", ["x", "y"], lagrangian)
    stepper = sc.compile_stepper(system, "svi:8", solver=solver)
    errors = [largest_energy_error(stepper, [0.0, height], [0.3, 0.0]) for height in np.linspace(0.5, 3.0, 21)]
    assert max(errors) < allowed, errors


@pytest.mark.filterwarnings("ignore::scvi_codegen.common.errors.MethodWarning")
@pytest.mark.second
def test_array_of_balls_on_a_stiff_floor_conserves_its_energy() -> None:
    system = lagrange("balls", "q[N]", "sum(i in N, q_dot[i]**2/2 - 9.8*q[i] - 1e5*positive_part(-q[i])**2)")
    stepper = sc.compile_stepper(system, "svi:8")
    errors = [largest_energy_error(stepper, {"q": [height]}, {"q": [0.0]}) for height in np.linspace(0.5, 3.0, 21)]
    assert max(errors) < 1e-4, errors


@pytest.mark.rotated
def test_smooth_motion_takes_the_same_steps() -> None:
    """The examination of free flights rejects no step of a comet, which moves nearly freely far from its sun."""
    comet = sc.LagrangianSystem.from_text("comet", ["x", "y"], "(x_dot**2 + y_dot**2)/2 + 1/sqrt(x**2 + y**2)")
    run = sc.compile_stepper(comet, "svi:8").integrate([1.0, 0.0], velocity=[0.0, 1.4], t_end=400.0)
    assert abs(run.energy()[-1] - run.energy()[0]) < 1e-14
    assert run.rejected_steps <= len(run.t) // 8
