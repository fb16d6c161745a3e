"""Densities with second derivatives on spectral elements: beams with all ends, plates, and nonlinear densities."""

import numpy as np
import pytest
from numpy import cos, cosh, pi, sin, sinh
from samples import QUICK_FLAGS

import scvi_codegen as sc

pytestmark = pytest.mark.rotated

BEAM = "u_t**2/2 - u_xx**2/2"
CLAMPED, CANTILEVER = 4.730040744862704, 1.8751040687119611


def mode(k, sign, shift):
    """Eigenfunction of a beam of length 1 with an end at x = 0 that is clamped (sign 1) or free (-1)."""
    ratio = (cosh(k) - shift * cos(k)) / (sinh(k) - shift * sin(k))
    return lambda x: cosh(k * x) - sign * cos(k * x) - ratio * (sinh(k * x) - sign * sin(k * x))


ENDS = {
    "supported": ((0, 0), pi, lambda x: sin(pi * x)),
    "clamped": (("clamped", "clamped"), CLAMPED, mode(CLAMPED, 1, 1)),
    "free": (("natural", "natural"), CLAMPED, mode(CLAMPED, -1, 1)),
    "cantilever": (("clamped", "natural"), CANTILEVER, mode(CANTILEVER, 1, -1)),
    "to the right": (("natural", {"u": 0, "u_x": 0}), CANTILEVER, lambda x: mode(CANTILEVER, 1, -1)(1 - x)),
    "ring": ("periodic", 2 * pi, lambda x: sin(2 * pi * x)),
}


def integrated(field, options, start, *, method="svi:4", h=0.01, steps=10):
    mesh = field.discretise("spectral-elements", **options)
    stepper = sc.compile_stepper(mesh.system, method, solver="newton", flags=QUICK_FLAGS)
    places = [mesh.points[axis] for axis in field.space]
    return mesh, stepper.integrate({"u": start(*places)}, h=h, steps=steps)


@pytest.mark.sampled(1)
@pytest.mark.filterwarnings("ignore::scvi_codegen.AccuracyWarning")
@pytest.mark.parametrize("ends", ENDS)
def test_errors_of_beams_fall_exponentially_with_the_degree(ends):
    boundary, k, shape = ENDS[ends]
    field, errors = sc.FieldSystem.from_text("beam", ["u"], {"x": (0, 1)}, BEAM, boundary={"x": boundary}), []
    elements = [0, 0.5, 1] if ends in ("supported", "clamped") else [0, 0.3, 0.6, 1]
    for degree in (4, 8):
        mesh, run = integrated(field, {"degree": degree, "elements": elements}, shape)
        x = mesh.points["x"]
        errors.append(np.abs(run.q["u"][-1] - shape(x) * cos(k * k * 0.1)).max() / np.abs(shape(x)).max())
        assert run.iterations.max() <= 2
        assert 0.01 * mesh.highest_frequency() > 3  # fixed-point iterations do not converge
    assert errors[1] < errors[0] / 1000 < 1e-5
    assert errors[1] < 2e-8


def test_one_clamped_element():
    boundary, k, shape = ENDS["clamped"]
    field = sc.FieldSystem.from_text("beam", ["u"], {"x": (0, 1)}, BEAM, boundary={"x": boundary})
    mesh, run = integrated(field, {"degree": 14, "elements": 1}, shape)
    assert run.q["u"][-1] == pytest.approx(shape(mesh.points["x"]) * cos(k * k * 0.1), abs=1e-9)


@pytest.mark.full
def test_supported_plate():
    field = sc.FieldSystem.from_text(
        "plate", ["u"], {"x": (0, 1), "y": (0, 2)}, "u_t**2/2 - (u_xx + u_yy)**2/2", boundary={"x": (0, 0), "y": (0, 0)}
    )
    shape = lambda x, y: sin(pi * x) * sin(pi * y / 2)  # noqa: E731
    mesh, run = integrated(field, {"degree": 6, "elements": 2}, shape)
    exact = shape(mesh.points["x"], mesh.points["y"]) * cos(1.25 * pi**2 * 0.1)
    assert run.q["u"][-1] == pytest.approx(exact, abs=2e-6)
    assert run.energy_error() < 1e-12


@pytest.mark.full
def test_solitary_wave_of_the_boussinesq_equation():
    """Soliton 6 k^2/cosh(k (x - c t))^2 of u_tt = (u - u^2 - u_xx)_xx in potential form, u = w_x."""
    c, k = 0.6, 0.4
    density = "w_t**2/2 - w_x**2/2 + w_x**3/3 - w_xx**2/2"  # w_tt = w_xx - (w_x^2)_x - w_xxxx
    field = sc.FieldSystem.from_text("Boussinesq", ["w"], {"x": (-40, 40)}, density)
    assert c**2 == pytest.approx(1 - 4 * k**2)
    wave = lambda x, t: 6 * k * np.tanh(k * (x - c * t))  # noqa: E731  (u = 6 k^2 / cosh^2)
    mesh = field.discretise("spectral-elements", degree=8, elements=40)
    x = mesh.points["x"]
    stepper = sc.compile_stepper(mesh.system, "svi:4", solver="newton", flags=QUICK_FLAGS)
    rate = -6 * k * k * c / cosh(k * x) ** 2
    run = stepper.integrate({"w": wave(x, 0)}, velocity={"w": rate}, h=0.1, steps=50)
    assert np.abs(run.q["w"][-1] - wave(x, 5.0)).max() < 1e-6
