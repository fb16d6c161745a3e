"""Light bodies among joints: what forces and reactions do to them in a step exceeds how they move by their ratio."""

import numpy as np
import pytest
from notation import lagrange

import scvi_codegen as sc

MASSES = (1.0, 1e-2, 1e-4, 1e-5, 3e-7, 1e-9)
DEGREES = ["svi:4", pytest.param("svi:8", marks=pytest.mark.rotated(8))]
START = 1.0
POSITION = [np.sin(START) / 2, -np.cos(START) / 2, START, np.sin(START), -np.cos(START)]


@pytest.fixture(scope="module", params=DEGREES)
def pendulum(request):
    """The steppers of rod and bob of both solvers."""
    return tuple(sc.compile_stepper(rod_and_bob(), request.param, solver=solver) for solver in ("auto", "newton"))


def rod_and_bob():
    """A rod of mass m and length 1 with a bob of mass M at its end, by four equations of joints."""
    return lagrange(
        "rod and bob",
        ["x", "y", "a", "X", "Y"],
        "m*(x_dot**2 + y_dot**2)/2 + m*a_dot**2/24 + M*(X_dot**2 + Y_dot**2)/2 - 9.81*(m*y + M*Y)",
        constraints=["x - sin(a)/2", "y + cos(a)/2", "X - x - sin(a)/2", "Y - y + cos(a)/2"],
        m=1.0,
        M=1.0,
    )


@pytest.fixture(scope="module")
def angle():
    of_angle = lagrange("angle", "a", "(m/3 + M)*a_dot**2/2 + 9.81*(m/2 + M)*cos(a)", m=1.0, M=1.0)
    return sc.compile_stepper(of_angle, "svi:8")


@pytest.mark.second
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


@pytest.mark.rotated
def test_rods_in_line_throw_a_light_body():
    """A double pendulum in x, y: constraints of light bodies round by more than their own lengths."""
    text = "(m*(x_dot**2 + y_dot**2) + X_dot**2 + Y_dot**2)/2 - 9.81*(m*y + Y)"
    constraints = ["x**2 + y**2 = 1", "(X - x)**2 + (Y - y)**2 = 1"]
    stepper = sc.compile_stepper(lagrange("rods", ["x", "y", "X", "Y"], text, constraints=constraints, m=1.0), "svi:8")
    of_angles = "m*a_dot**2/2 + (a_dot**2 + b_dot**2)/2 + a_dot*b_dot*cos(a - b) + 9.81*((m + 1)*cos(a) + cos(b))"
    angles = sc.compile_stepper(lagrange("angles", "a b", of_angles, m=1.0), "svi:8", precision="double-double")
    rods = np.exp(1j * np.array([0.5, 0.6])).cumsum() / 1j
    exact = angles.integrate([0.5, 0.6], [0.0] * 2, parameters={"m": 1e-5}, t_end=0.05, tolerance=1e-18).q[-1]
    exact = np.exp(1j * exact.astype(float)).cumsum() / 1j
    for m, digits in ((1e-5, 1e-12), (1e-6, 1e-11), (1e-7, 1e-10)):
        run = stepper.integrate(rods.view(float), [0.0] * 4, parameters={"m": m}, t_end=0.05)
        assert np.abs(run.energy_error()).max() < digits
        assert run.steps < 200
        assert m < 1e-5 or np.abs(run.q[-1] - exact.view(float)).max() < 1e-12


@pytest.mark.second
def test_masses_of_zero_that_nothing_replaces_are_refused_by_name(pendulum):
    with pytest.raises(sc.StateError, match=r"x, y, a have no kinetic energy there.*with_parameters\(m=0\)"):
        pendulum[0].integrate(POSITION, [0.0] * 5, parameters={"m": 0.0, "M": 1.0}, h=0.005, steps=10)


@pytest.fixture(scope="module", params=DEGREES)
def massless(request):
    """The same pendulum, whose rod has the mass 0 by default."""
    return sc.compile_stepper(rod_and_bob().with_parameters(m=0.0), request.param)


@pytest.mark.parametrize("m", [0.0, 1e-12, 1e-3, 1.0])
def test_a_massless_rod_swings_as_its_angle(massless, angle, m):
    parameters = {"m": m, "M": 1.0}
    exact = angle.integrate([START], [0.0], parameters=parameters, t_end=0.5, tolerance=1e-15)
    a, rate = exact.q[-1, 0], exact.velocity[-1, 0]
    for span in ({"h": 0.005, "steps": 100}, {"t_end": 0.5}):
        run = massless.integrate(POSITION, [0.0] * 5, parameters=parameters, **span)
        assert run.q[-1, 2] == pytest.approx(a, abs=1e-13)
        assert np.abs(run.constraint_values()).max() < 2e-15
        assert np.ptp(run.energy()) < 2e-14
        if m <= 1e-12:
            tension = 9.81 * np.cos(a) + rate**2
            forces = np.array([-np.sin(a), np.cos(a)] * 2) * tension
            assert run.multipliers()[-1] == pytest.approx(forces, rel=2e-12, abs=1e-11)
            assert np.abs(run.p[:, :3]).max() <= 1e-11 * m / 1e-12 + 1e-15


def test_a_massless_rod_has_order_energy_and_reversal(massless, angle):
    exact = angle.integrate([START], [0.0], parameters={"m": 0.0, "M": 1.0}, t_end=1.0, tolerance=1e-15).q[-1, 0]
    if massless.interface.method.startswith("svi-4"):
        errors = [massless.integrate(POSITION, [0.0] * 5, h=h, t_end=1.0).q[-1, 2] - exact for h in (0.1, 0.05)]
        assert np.log2(errors[0] / errors[1]) == pytest.approx(8, abs=0.4)
    run = massless.integrate(POSITION, [0.0] * 5, h=0.05, steps=400)
    energy = np.abs(run.energy() - run.energy()[0])
    assert energy[200:].max() < 1.2 * energy[:200].max() + 1e-14
    back = massless.integrate(run.q[-1], run.p[-1], h=-0.05, steps=400)
    assert back.q[-1] == pytest.approx(POSITION, abs=1e-12)


def test_ensembles_with_masses_of_zero_agree_with_single_runs(massless):
    masses = np.array([[0.0, 1.0], [1e-9, 1.0], [0.0, 2.0], [1.0, 0.0]])
    ensemble = massless.integrate_ensemble(
        np.tile(POSITION, (4, 1)), np.zeros((4, 5)), parameters=masses, h=0.01, steps=10
    )
    for k, (m, M) in enumerate(masses):
        run = massless.integrate(POSITION, [0.0] * 5, parameters={"m": m, "M": M}, h=0.01, steps=10)
        assert np.abs(ensemble.q[-1, k] - run.q[-1]).max() <= 4 * 2**-52


@pytest.mark.rotated
def test_a_massless_rod_in_two_words():
    precise = sc.compile_stepper(rod_and_bob().with_parameters(m=0.0), "svi:4", precision="double-double")
    run = precise.integrate(POSITION, [0.0] * 5, h=0.01, steps=5)
    assert np.abs(run.constraint_values()).max() < 1e-30


@pytest.mark.second
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


@pytest.mark.rotated
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
