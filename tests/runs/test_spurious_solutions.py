"""No step ends at a spurious solution of its equations: thermal states of a double pendulum, with large steps."""

import numpy as np
import pytest
from notation import lagrange

import scvi_codegen as sc

PENDULUM = sc.LagrangianSystem.from_text(
    "thermal double pendulum",
    ["a", "b"],
    "((1+m)*a_dot**2 + m*b_dot**2 + 2*m*a_dot*b_dot*cos(a-b))/2 + g*((1+m)*cos(a) + m*cos(b))",
    parameters={"m": 2.0, "g": 1.0},
)
STEPS = (0.05, 0.1, 0.2, 0.3)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("count", [400, pytest.param(20_000, marks=pytest.mark.full)])
@pytest.mark.parametrize("solver", ["auto", "newton"])
@pytest.mark.parametrize("method", ["svi:1", "gauss:1", "svi:2", "radau-iia:2"])
def test_displacements_of_steps_are_those_of_the_motion(method: str, solver: str, count: int) -> None:
    """A displacement that is accepted differs from that of the motion by at most half of the larger one."""
    stepper, reference = sc.compile_stepper(PENDULUM, method, solver=solver), sc.compile_stepper(PENDULUM, "svi:12")
    rng = np.random.default_rng(11)
    refused = 0
    for k in range(count):
        q, h = rng.uniform(-np.pi, np.pi, 2), STEPS[k % len(STEPS)]
        c = np.cos(q[0] - q[1])
        factor = np.linalg.cholesky(np.array([[3.0, 2.0 * c], [2.0 * c, 2.0]]))
        p = factor @ rng.normal(size=2) * np.sqrt(rng.uniform(0.5, 4.0))
        try:
            run = stepper.integrate(q, p, h=h, steps=1)
        except sc.ScviCodegenError:
            refused += 1
            continue
        energy = run.energy()
        if abs(energy[1] - energy[0]) > 0.2 * (1.0 + abs(energy[0])):
            moved = reference.integrate(q, p, t_end=h).q[-1] - q
            size = max(np.abs(moved).max(), np.abs(run.q[1] - q).max())
            assert np.abs(run.q[1] - q - moved).max() < 0.5 * size, (q, p, h)
    assert refused < count // 25


def test_published_jump_of_the_midpoint_rule_is_refused() -> None:
    """Energy -0.36 -> 363 in one step of h = 0.2: the fallback, Newton's method, left the branch of solutions."""
    stepper = sc.compile_stepper(PENDULUM, "svi:1")
    q, p = (-0.7878676328182967, -0.16836441326210805), (-0.7847247237395704, -3.2708402299120847)
    for h in (0.19, 0.2, 0.25):
        with pytest.raises(sc.StepFailedError):
            stepper.integrate(q, p, h=h, steps=1)
    assert stepper.integrate(q, p, h=0.05, steps=1).step_error > 0.0


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("solver", ["auto", "newton"])
def test_unresolved_vibrations_are_no_spurious_solutions(solver: str) -> None:
    system = lagrange("stiff", "a b", "a_dot**2 + b_dot**2/2 + a_dot*b_dot*cos(a-b)/2 - 1e6*(a-b)**2/2 + cos(a)")
    run = sc.compile_stepper(system, "svi:1", solver=solver).integrate(
        [1.0, 1.001], velocity=[0.0, 0.0], h=0.05, steps=500
    )
    assert np.ptp(run.energy()) < 1e-3


@pytest.mark.second
def test_explicit_stages_have_no_spurious_solutions() -> None:
    """A step of Euler's method from rest does not move, its halves do: q1 = q + h v, then v1 = v + h a."""
    stepper, q, h, steps = sc.compile_stepper(PENDULUM, "explicit-euler"), np.array([0.3, 0.7]), 1e-3, 500
    with pytest.warns(sc.AccuracyWarning):
        run = stepper.integrate(q, [0.0, 0.0], h=h, steps=steps)
    np.testing.assert_array_equal(run.q[1], q)
    reference = sc.compile_stepper(PENDULUM, "svi:8").integrate(q, [0.0, 0.0], h=h, steps=steps)
    np.testing.assert_allclose(run.q[-1], reference.q[-1], rtol=0.0, atol=5.0 * h)
