"""A step as equations in CasADi: against the equations in 60 digits, and compiled steps."""

import numpy as np
import pytest
from notation import lagrange
from numpy.testing import assert_allclose
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen.extras.exact.step import compiled_equations

ca = pytest.importorskip("casadi", reason="needs the extra 'casadi'")

KEPLER = sc.problem("kepler").system
Q, P, H = [0.5, 0.1], [0.2, 1.6], 0.1
NO_INPUTS = ca.DM(0, 1)
TOWED = lagrange("towed", "x", "m*x_dot**2/2 - x**4/4 + w*cos(t)*x", m=2.0, forces={"x": "u - x_dot*w"}, inputs="u w")


@pytest.mark.parametrize(
    "method", [sc.SVI(2), sc.SCVI(2), sc.SpectralCollocation(3), sc.RadauIIA(2)], ids=lambda m: m.name
)
@pytest.mark.parametrize("system", [KEPLER, sc.hamiltonian_of(KEPLER)], ids=["L", "H"])
def test_a_solved_step_is_that_of_the_equations_in_60_digits(system, method):
    found = sc.casadi_step(system, method, solved=True)(q=Q, p=P, inputs=NO_INPUTS, parameters=1.0, t=0.0, h=H)
    exact = compiled_equations(system, method)(Q, P, H)
    assert_allclose(found["q1"].full()[:, 0], [float(x) for x in exact.q], rtol=0, atol=1e-12)
    assert_allclose(found["p1"].full()[:, 0], [float(x) for x in exact.p], rtol=0, atol=1e-12)


def test_constraints_are_among_the_equations():
    rod = lagrange("rod", "x y", "(x_dot**2 + y_dot**2)/2 - y", constraints=["x**2 + y**2 = 1"])
    method = sc.SVI(2, "gauss-lobatto:3")
    found = sc.casadi_step(rod, method, solved=True)(q=[0.6, -0.8], p=[0.4, 0.3], inputs=NO_INPUTS, t=0.0, h=0.1)
    exact = compiled_equations(rod, method)([0.6, -0.8], [0.4, 0.3], 0.1)
    assert_allclose(found["q1"].full()[:, 0], [float(x) for x in exact.q], rtol=0, atol=1e-9)
    assert_allclose(found["p1"].full()[:, 0], [float(x) for x in exact.p], rtol=0, atol=1e-9)


def test_inputs_in_bernsteins_form_are_the_cubics_of_compiled_steps():
    t, h, pushes = 0.7, 0.05, np.array([[1.0, 2.0, -1.0], [0.3, 0.1, 0.5]])
    step = sc.casadi_step(TOWED, sc.SVI(3), degree=2, along=["u", "w*x_dot", "m*t"])
    solved = sc.casadi_step(TOWED, sc.SVI(3), degree=2, solved=True)
    found = solved(q=0.4, p=1.1, inputs=pushes, parameters=2.0, t=t, h=h)
    powers = {}
    for name, (b0, b1, b2) in zip("uw", pushes, strict=True):
        cubic = (b0, 2 * (b1 - b0) / h, (b0 - 2 * b1 + b2) / h**2, 0.0, t)
        powers |= dict(zip((f"{name}_{part}" for part in "0123t"), cubic, strict=True))
    stepper = sc.compile_stepper(TOWED, sc.SVI(3), flags=QUICK_FLAGS)
    run = stepper.integrate([0.4], [1.1], h=h, steps=1, t=t, parameters=powers)
    assert_allclose([float(found["q1"]), float(found["p1"])], [run.q[1, 0], run.p[1, 0]], rtol=0, atol=1e-13)
    values = step(q=0.4, p=1.1, stages=[1.0, 1.0, 1.0], inputs=pushes, parameters=2.0, t=t, h=h)
    mean_of_u = pushes[0].mean()  # of a polynomial in Bernstein's form
    assert_allclose(values["integrals"].full()[[0, 2], 0], [h * mean_of_u, 2.0 * h * (t + h / 2)], rtol=1e-13)
    assert values["along"].shape == (3, 3)
    assert_allclose(
        values["along"].full()[2], 2.0 * (t + h * np.array(sc.gauss_legendre(3).abscissae, dtype=float)), rtol=1e-13
    )


def test_unsupported_methods_are_reported():
    with pytest.raises(sc.MethodError, match=r"degree must be at most 3"):
        sc.casadi_step(TOWED, sc.SVI(2), degree=4)
    with pytest.raises(sc.MethodError, match="no quadrature along its curve"):
        sc.casadi_step(TOWED, sc.RadauIIA(2), along=["u**2"])
    with pytest.raises(sc.MethodError, match="transformed time"):
        sc.casadi_step(sc.reparametrise(KEPLER, time_transformation="q1**2 + q2**2"), sc.SVI(2))
    with pytest.raises(sc.ExpressionError, match="'z'"):
        sc.casadi_step(TOWED, sc.SVI(2), along=["z"])
