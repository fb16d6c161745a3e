"""Error estimate of adaptive steps: Legendre coefficients of the curve of a step, compared with those of NumPy."""

import numpy as np
import pytest
from notation import lagrange
from numpy.polynomial import Legendre
from numpy.polynomial.legendre import leggauss

import scvi_codegen as sc
from scvi_codegen.codegen.pipeline import program_of

FREE = sc.LagrangianSystem.from_text(name="quartic", coordinates=["x"], lagrangian="x_dot**2/2 - x**4")
HELD = lagrange("rod", "x y", "(x_dot**2 + y_dot**2)/2 - y", constraints=["x**2 + y**2 = 1"])
CASES = {
    **{f"velocities, {s}": (FREE, sc.SVI(s), s - 1) for s in (2, 5)},
    "velocities, Gauss": (FREE, sc.Gauss(4), 3),
    "more points than velocities": (FREE, sc.SVI(3, "gauss-lobatto:5"), 2),
    **{f"with the velocity at the end, {s}": (HELD, sc.SVI(s, f"gauss-lobatto:{s + 1}"), s) for s in (1, 2, 3)},
    **{f"accelerations, {text}": (FREE, text, int(text[-1])) for text in ("sc:2", "sc:4", "scvi:3")},
}
"""System, method, and degree of the velocity along a step."""


def unknowns(system, method, degree, velocity):
    """Return the unknowns of a coordinate for a velocity along the step [0, 1]."""
    if system is HELD:
        return velocity(np.append((leggauss(degree)[0] + 1) / 2, 1.0))
    if not isinstance(method, str):
        return velocity((leggauss(degree + 1)[0] + 1) / 2)
    points = np.array(sc.methods.as_method(method).stage_system(system).shape.tableau.c, dtype=float)
    return np.concatenate([[velocity(0.0)], velocity.deriv()(points)])


@pytest.mark.parametrize("name", CASES)
def test_leading_displacements_are_legendre_coefficients_of_the_acceleration(name):
    """A random velocity of the degree of the curve. Its leading coefficient is proportional to h^degree."""
    system, method, degree = CASES[name]
    curve = program_of(system, sc.methods.as_method(method), solver="newton").equations.stage_curve
    velocity = Legendre(np.random.default_rng(7).normal(size=degree + 1), domain=[0, 1])
    z = unknowns(system, method, degree, velocity)
    highest, following, whole, half = (
        float(np.array(line[: len(z)], dtype=float) @ z) for line in (curve.highest, curve.next, *curve.curvatures)
    )
    coefficients = [0.0, *velocity.deriv().coef]
    assert highest == pytest.approx(coefficients[-1], rel=1e-13)
    assert not any(curve.highest[len(z) :])
    if system is not HELD:
        assert following == pytest.approx(coefficients[-2], rel=1e-12, abs=1e-12)
    if not isinstance(method, str):
        assert (whole, half) == (z[-1] - z[0], z[len(z) // 2] - z[0])
    assert curve.power == 2 * degree - (degree > (2 if isinstance(method, str) else 1))
