"""Nearly singular masses: rounding alone changes velocities by 1e-12 and more, and motions are done all the same."""

import numpy as np
import pytest
from notation import lagrange
from scipy.integrate import solve_ivp

import scvi_codegen as sc

pytestmark = pytest.mark.rotated

LIGHT, SPAN = 1e-4, 5.0


@pytest.fixture(scope="module")
def cart():
    """A pendulum on a cart of a ten-thousandth of its mass, which is flung aside whenever the bob passes below."""
    text = "(M + m)*x_dot**2/2 + m*l*x_dot*th_dot*cos(th) + m*l**2*th_dot**2/2 + m*g*l*cos(th)"
    return lagrange("light cart", "x th", text, M=LIGHT, m=1.0, l=1.0, g=9.81)


@pytest.fixture(scope="module")
def stepper(cart):
    return sc.compile_stepper(cart, sc.SVI(8))


def angle_alone():
    """The angle at the end: the momentum along x is 0, which leaves one coordinate and its equation."""

    def derivative(t, state):
        angle, rate = state
        part = 1.0 / (1.0 + LIGHT)
        mass = 1.0 - part * np.cos(angle) ** 2
        return rate, -np.sin(angle) * (9.81 + part * np.cos(angle) * rate**2) / mass

    return solve_ivp(derivative, (0.0, SPAN), (1.0, 0.0), method="DOP853", rtol=1e-13, atol=1e-13).y[0, -1]


@pytest.mark.tiers(0, 1)
@pytest.mark.sampled(2)
@pytest.mark.parametrize("method", ["svi:8", "scvi:4"])
@pytest.mark.parametrize("tolerance", [None, 1e-9])
def test_light_cart_is_accelerated_strongly(cart, method, tolerance):
    run = sc.compile_stepper(cart, method).integrate([0, 1], velocity=[0, 0], t_end=SPAN, tolerance=tolerance)
    allowed = 1e-9 if tolerance is None else 1e-5
    assert run.q[-1, 1] == pytest.approx(angle_alone(), abs=allowed)
    np.testing.assert_allclose(run.q[:, 0], (np.sin(1.0) - np.sin(run.q[:, 1])) / (1 + LIGHT), rtol=0, atol=allowed)


@pytest.mark.second
def test_step_count_is_bounded_by_the_tolerance(stepper):
    """Rounding that were taken for unresolved motion would end in steps of 1e-17."""
    exact, loose = (stepper.integrate([0, 1], velocity=[0, 0], t_end=SPAN, tolerance=x) for x in (None, 1e-9))
    assert exact.steps < 3 * loose.steps
    assert exact.rejected_steps < 50


def test_first_step_of_a_sleeping_top_is_not_tiny():
    """At phi = psi = 0 the shortest steps show nothing but rounding, as a part of hardly any motion."""
    text = "A*(theta_dot**2 + phi_dot**2*sin(theta)**2)/2 + C*(psi_dot + phi_dot*cos(theta))**2/2 - g*cos(theta)"
    top = lagrange("sleeping top", "phi theta psi", text, A=1.0, C=0.4, g=1.5)
    run = sc.compile_stepper(top, sc.SVI(8)).integrate([0, 0.05, 0], velocity=[0.1, 0.3, 8.0], t_end=3.0)
    assert run.steps < 200
    assert np.ptp(run.energy()) < 1e-13 * run.energy()[0]


@pytest.mark.usefixtures("as_users_compile")
def test_velocities_are_found_where_newton_converges_slowly(cart):
    """At one state in a thousand Newton's corrections shrank the misfit by a rounding each, and were given up.

    Where products are fused with sums, whose misfits can be less than a rounding of either.
    """
    stepper = sc.compile_stepper(cart, sc.SVI(8))
    rng = np.random.default_rng(1)
    angles, momenta = -rng.uniform(0.05, 0.15, 20_000), rng.uniform(0.1, 1.0, 20_000)
    found = stepper.velocity(np.column_stack([0 * angles, angles]), np.column_stack([0 * momenta, momenta]))
    rates = momenta / (1.0 - np.cos(angles) ** 2 / (1.0 + LIGHT))
    assert found[:, 1] == pytest.approx(rates, rel=1e-10)
    assert found[:, 0] == pytest.approx(-np.cos(angles) / (1.0 + LIGHT) * rates, rel=1e-10)


def test_velocities_are_found_beside_tiny_entries_of_masses():
    """Products with sin(a) = 1e-17 cancel, whose rounding lets the misfit fall by 1e-16 in each iteration."""
    text = "x_dot**2 + y_dot**2 + m*((x_dot*cos(a) - y_dot*sin(a) - d*a_dot)**2 + (x_dot*sin(a) + y_dot*cos(a))**2)/2"
    stepper = sc.compile_stepper(lagrange("leg", "x y a", text + " + a_dot**2/100", m=0.7, d=0.2), "svi:3")
    q, v = [[0, 0, -k * 1e-18] for k in range(100)], [[0, 1, 0]] * 100
    assert stepper.velocity(q, stepper.momentum(q, v)) == pytest.approx(np.array(v))
