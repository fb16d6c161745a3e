"""Light bodies among joints: what forces and reactions do to them in a step exceeds how they move by their ratio."""

import numpy as np
import pytest
from notation import lagrange

import scvi_codegen as sc

MASSES = (1.0, 1e-2, 1e-4, 1e-5, 3e-7, 1e-9)
START = 1.0
POSITION = [np.sin(START) / 2, -np.cos(START) / 2, START, np.sin(START), -np.cos(START)]


@pytest.fixture(scope="module", params=["svi:4", "svi:8"])
def pendulum(request):
    """A rod of mass m and length 1 with a bob of mass M at its end, by four equations of joints, in both solvers."""
    rod = lagrange(
        "rod and bob",
        ["x", "y", "a", "X", "Y"],
        "m*(x_dot**2 + y_dot**2)/2 + m*a_dot**2/24 + M*(X_dot**2 + Y_dot**2)/2 - 9.81*(m*y + M*Y)",
        constraints=["x - sin(a)/2", "y + cos(a)/2", "X - x - sin(a)/2", "Y - y + cos(a)/2"],
        m=1.0,
        M=1.0,
    )
    return tuple(sc.compile_stepper(rod, request.param, solver=solver) for solver in ("auto", "newton"))


@pytest.fixture(scope="module")
def angle():
    of_angle = lagrange("angle", "a", "(m/3 + M)*a_dot**2/2 + 9.81*(m/2 + M)*cos(a)", m=1.0, M=1.0)
    return sc.compile_stepper(of_angle, "svi:8")


@pytest.mark.parametrize("m", MASSES)
def test_the_default_solver_has_the_digits_of_newtons_method(pendulum, angle, m):
    """Within 10 roundings of it, and right, by fixed and adaptive steps; counted where the multipliers lose them."""
    parameters = {"m": m, "M": 1.0}
    exact = angle.integrate([START], [0.0], parameters=parameters, t_end=0.5, tolerance=1e-15).q[-1, 0]
    for span in ({"h": 0.005, "steps": 100}, {"t_end": 0.5}):
        run, other = (s.integrate(POSITION, [0.0] * 5, parameters=parameters, **span) for s in pendulum)
        if "h" in span:
            assert np.abs(run.q[-1] - other.q[-1]).max() < 10 * 2**-52
            assert run.fallback_steps == (run.steps if m < 1e-3 else 0)
        assert np.abs(run.q[-1] - other.q[-1]).max() < 1e-13
        assert run.q[-1, 2] == pytest.approx(exact, abs=1e-9 if "h" in span else 2e-14)
        assert np.abs(run.constraint_values()[0]).max() < 1e-15
        assert run.steps <= 1.1 * other.steps + 2


def test_a_massless_rod_is_refused_by_its_cause_and_the_remedy_works(pendulum, angle):
    with pytest.raises(sc.StateError, match=r"x, y, a have no kinetic energy there.*1e-9 of the others"):
        pendulum[0].integrate(POSITION, [0.0] * 5, parameters={"m": 0.0, "M": 1.0}, h=0.005, steps=10)
    with pytest.raises(sc.SystemDefinitionError, match=r"m = 0 is the default.*1e-9 of the others"):
        lagrange("rod", "x X", "(m*x_dot**2 + X_dot**2)/2", constraints=["X - x - 1"], m=0.0)
    with pytest.raises(sc.SystemDefinitionError, match=r"'x' .* has no kinetic energy.*1e-9 of the others"):
        lagrange("rod", "x X", "X_dot**2/2", constraints=["X - x - 1"])
    run = pendulum[0].integrate(POSITION, [0.0] * 5, parameters={"m": 1e-9, "M": 1.0}, h=0.005, steps=100)
    exact = angle.integrate([START], [0.0], parameters={"m": 0.0, "M": 1.0}, t_end=0.5, tolerance=1e-15)
    assert run.q[-1, 2] == pytest.approx(exact.q[-1, 0], abs=2e-9)


@pytest.mark.parametrize("power", [-40, 3, 50])
def test_masses_times_powers_of_two_give_equal_bits(pendulum, power):
    """But where Newton's method chooses other pivots."""
    for m in (0.3, 1e-6):
        runs = [
            pendulum[0].integrate(POSITION, [0.0] * 5, parameters={"m": m * scale, "M": scale}, h=0.01, steps=40)
            for scale in (1.0, 2.0**power)
        ]
        if not runs[0].fallback_steps:
            assert np.array_equal(runs[0].q, runs[1].q)
            assert np.array_equal(runs[0].p * 2.0**power, runs[1].p)
        assert np.abs(runs[0].q - runs[1].q).max() <= 4 * 2**-52


def test_ensembles_of_mass_ratios_agree_with_single_runs(pendulum):
    parameters = np.array([[m, 1.0] for m in MASSES])
    states = np.tile(POSITION, (len(MASSES), 1)), np.zeros((len(MASSES), 5))
    ensemble = pendulum[0].integrate_ensemble(*states, parameters=parameters, h=0.005, steps=20)
    for k, m in enumerate(MASSES):
        run = pendulum[0].integrate(POSITION, [0.0] * 5, parameters={"m": m, "M": 1.0}, h=0.005, steps=20)
        assert np.array_equal(ensemble.q[-1, k], run.q[-1])


def test_a_light_pinned_slider_is_no_light_body():
    """Its coordinate y = 0 has no size, forces and reactions cancel there, but no other coordinate is lost by it."""
    slider = lagrange(
        "slider",
        ["x", "y", "X", "Y"],
        "m*(x_dot**2 + y_dot**2)/2 + (X_dot**2 + Y_dot**2)/2 - 9.81*(m*y + Y)",
        constraints=["y", "(X - x)**2 + (Y - y)**2 - 1"],
        m=0.01,
    )
    run = sc.compile_stepper(slider, "svi:4").integrate([0.0, 0.0, 0.6, -0.8], [0.0] * 4, h=0.005, steps=100)
    assert run.fallback_steps == 0
    assert np.abs(run.q[:, 1]).max() < 1e-16
