"""Dissipation densities: absorbing ends and damped oscillations; Legendre-Galerkin discretisation of one interval."""

import numpy as np
import pytest
from numpy import cos, exp, pi, sin
from samples import QUICK_FLAGS

import scvi_codegen as sc

STRING = "u_t**2/2 - u_x**2/2"


@pytest.mark.second
def test_waves_leave_through_an_absorbing_end():
    field = sc.FieldSystem.from_text(
        "string", ["u"], {"x": (0, 12)}, STRING, dissipation="2*exp(-(x - 12)**2/6)*u_t**2/2"
    )
    mesh = field.discretise("spectral-elements", degree=8, elements=12)
    x = mesh.points["x"]
    stepper = sc.compile_stepper(mesh.system, "svi:2", flags=QUICK_FLAGS)
    y = x - 3
    wave, rate = exp(-y * y) * sin(4 * y), exp(-y * y) * (2 * y * sin(4 * y) - 4 * cos(4 * y))  # to the right
    run = stepper.integrate({"u": wave}, velocity={"u": rate}, h=0.02, t_end=14.0)
    assert run.energy()[150] == pytest.approx(run.energy()[0], rel=1e-2)
    assert np.abs(run.q["u"][-1]).max() < 0.02
    assert run.energy()[-1] < 1e-3 * run.energy()[0]


@pytest.mark.rotated
def test_damped_waves_in_one_legendre_interval():
    field = sc.FieldSystem.from_text(
        "string", ["u"], {"x": (0, 1)}, STRING, boundary={"x": (0, 0)}, parameters={"g": 0.4}, dissipation="g*u_t**2/2"
    )
    assert str(field.euler_lagrange()["u"].rhs.subs("g", 1)).count("Derivative(u(x, t), t)") == 1
    assert field.derive().laws == ()
    mesh = field.discretise("legendre", degree=16)
    x, w = mesh.points["x"], np.sqrt(pi**2 - 0.04)
    assert x.shape == (15,)
    stepper = sc.compile_stepper(mesh.system, "svi:3", flags=QUICK_FLAGS)
    run = stepper.integrate({"u": sin(pi * x)}, velocity={"u": 0 * x}, h=0.01, steps=100)
    exact = sin(pi * x) * exp(-0.2) * (cos(w) + 0.2 / w * sin(w))
    assert run.q["u"][-1] == pytest.approx(exact, abs=1e-11)
