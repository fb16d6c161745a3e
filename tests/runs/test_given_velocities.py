"""A state may be given by its velocity."""

import numpy as np
import pytest
from notation import lagrange
from samples import QUICK_FLAGS

import scvi_codegen as sc

Q, V = [1.2, 0.4], [0.3, -0.7]


def pendulum_on_cart():
    return sc.compile_stepper(sc.problem("cart-pole").system, "svi:2", flags=QUICK_FLAGS)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(
    ("coordinates", "lagrangian", "q", "v", "dropped"),
    [
        ("x", "x**2*x_dot**2/2 - x**2", [0.0], [1.0], "x_dot = 1"),
        ("r th", "(r_dot**2 + r**2*th_dot**2)/2 - r**2", [0.0, 0.3], [0.5, 2.0], "th_dot = 2"),
        ("x y", "(x_dot - y_dot)**2/2 + y**2*y_dot**2/2", [1.0, 0.0], [1.0, 1.0], "x_dot = 1"),
    ],
)
def test_velocity_in_the_kernel_of_the_mass_matrix_is_rejected(coordinates, lagrangian, q, v, dropped):
    system = sc.LagrangianSystem.from_text(name="singular", coordinates=coordinates.split(), lagrangian=lagrangian)
    stepper = sc.compile_stepper(system, "svi:2", flags=QUICK_FLAGS)
    with pytest.raises(
        sc.StateError, match=f"the velocity {dropped} at .* the mass matrix is singular there .* Start from"
    ):
        stepper.integrate(q, velocity=v, h=0.1, steps=3)
    with pytest.raises(sc.StateError, match=f"the velocity {dropped} at "):
        stepper.integrate_ensemble([q, q], velocity=[np.zeros_like(v), v], h=0.1, steps=3)
    assert stepper.start(q, velocity=np.zeros_like(v), h=0.1).p.tolist() == [0.0] * len(q)
    assert stepper.start(np.add(q, 0.25), velocity=v, h=0.1).advance(1) is None


def test_velocity_with_zero_momentum_is_accepted():
    """In a magnetic field p = v - y may be 0."""
    system = lagrange("drifting", "x y", "x_dot**2/2 + y_dot**2/2 - y*x_dot")
    run = sc.compile_stepper(system, "svi:2", flags=QUICK_FLAGS).start([0.0, 1.0], velocity=[1.0, 0.0], h=0.1)
    assert run.p.tolist() == [0.0, 0.0]


@pytest.mark.second
def test_velocities_of_nonlinear_momenta_are_found_to_round_off():
    """Newton's iteration for L_v = p, where one that ends early is seen only when it ends between two squares."""
    text = "-m*c**2*sqrt(1 - (x_dot**2 + y_dot**2 + z_dot**2)/c**2) - x*y - z**2"
    system = lagrange("relativistic particle in space", "x y z", text, m=0.7, c=1.3)
    stepper = sc.compile_stepper(system, sc.SVI(1), flags=QUICK_FLAGS)
    generator, (m, c) = np.random.default_rng(5), (0.7, 1.3)
    for p in generator.normal(size=(100, 3)):
        energy = np.sqrt((m * c) ** 2 + p @ p)
        condition = (energy / (m * c)) ** 2
        assert np.abs(stepper.velocity(p, p) - c * p / energy).max() < 64 * 2.0**-52 * max(1.0, condition)
        assert np.abs(stepper.momentum(p, c * p / energy) - p).max() < 16 * 2.0**-52 * condition * np.abs(p).max()


def test_solve_ivp_accepts_velocities_and_scipy_arguments():
    stepper = pendulum_on_cart()
    values = [2.0 * value for value in stepper.defaults]
    motion = sc.solve_ivp(stepper, (0.0, 1.0), Q, velocity=V, args=values)
    other = sc.solve_ivp(stepper, (0.0, 1.0), [*Q, *stepper.momentum(Q, V, 0.0, values)], args=values)
    assert np.array_equal(motion.y, other.y)
