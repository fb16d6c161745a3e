"""Finite differences on axes with ends: orders, frequencies, energy, laws, and the operators at the ends."""

from itertools import pairwise

import numpy as np
import pytest
from numpy import cos, exp, pi, sin
from samples import QUICK_FLAGS

import scvi_codegen as sc

WAVES = "u_t**2/2 - u_x**2/2"


def line(ends, density=WAVES, **options):
    return sc.FieldSystem.from_text("line", ["u"], {"x": (0, 1)}, density, boundary={"x": ends}, **options)


def dense(axis, fixed):
    """Operators of an axis as matrices: D of all cells by all points, and the weights of cells and points."""
    h = axis.jacobians[0]
    count = len(axis.jacobians) + 1
    size = sum(1 for cells in axis.cells if not cells.loop) // 2
    rows, weights = np.zeros((count - 1, count)), np.ones(count - 1)
    middle = np.array([float(x) for x in axis.operators[1][0]])
    for c in range(size, count - 1 - size):
        first = c + 1 - len(middle) // 2
        rows[c, first : first + len(middle)] = middle
    for k, cells in enumerate(cells for cells in axis.cells if not cells.loop):
        c, row = k // 2, np.array([float(x) for x in cells.operators[1][0]])
        if k % 2:
            rows[-1 - c, ::-1][: len(row)], weights[-1 - c] = row, cells.weight
        else:
            rows[c, : len(row)], weights[c] = row, cells.weight
    return rows / h, h * weights, axis.closed.weights


@pytest.mark.tiers(3)
@pytest.mark.parametrize("order", [2, 4, 6, 8])
def test_operators_satisfy_summation_by_parts(order):
    """D is exact to degree m, the weights integrate to degree 2 m - 1, and D^T W g is -M g' with the ends."""
    (axis,) = line(("natural", "natural")).discretise("finite-differences", points=41, order=order).axes
    rows, weights, masses = dense(axis, (False, False))
    x = np.linspace(0, 1, 41)
    between = (x[1:] + x[:-1]) / 2
    m = order // 2
    assert min(weights.min(), masses.min()) > 0
    for k in range(m + 1):
        derivative = k * x ** max(k - 1, 0)
        assert rows @ x**k == pytest.approx(k * between ** max(k - 1, 0), abs=1e-11)
        by_parts = -masses * derivative
        by_parts[0] -= float(k == 0)
        by_parts[-1] += 1
        assert rows.T @ (weights * between**k) == pytest.approx(by_parts, abs=1e-11)
    for k in range(order):
        assert weights @ between**k == pytest.approx(1 / (k + 1), abs=1e-13)
        assert masses @ x**k == pytest.approx(1 / (k + 1), abs=1e-13)
    largest = np.linalg.eigvalsh(rows.T @ (weights[:, None] * rows) / np.sqrt(np.outer(masses, masses))).max()
    assert largest < axis.stiffness[0] < 1.03 * largest


@pytest.mark.rotated
@pytest.mark.sampled(3)
@pytest.mark.parametrize("order", [2, 4, 6, 8])
@pytest.mark.parametrize(
    ("ends", "mode"), [((0, 0), lambda x: sin(pi * x)), (("natural", "natural"), lambda x: cos(pi * x))]
)
def test_fields_have_order_m_plus_one_and_energy_does_not_drift(order, ends, mode):
    errors = []
    for points in (41, 81):
        mesh = line(ends).discretise("finite-differences", order=order, points=points)
        u = mode(mesh.points["x"])
        run = sc.compile_stepper(mesh.system, "svi:4", flags=QUICK_FLAGS).integrate({"u": u}, h=0.002, steps=150)
        errors.append(np.abs(run.q["u"] - u * cos(pi * run.t)[:, None]).max())
        assert run.energy_error() < 2e-14
    assert np.log2(errors[0] / errors[1]) > min(order, order / 2 + 1) - 0.3
    assert errors[1] < {2: 3e-4, 4: 5e-5, 6: 8e-6, 8: 1e-6}[order]


@pytest.mark.tiers(3, 3)
@pytest.mark.parametrize("order", [2, 4, 6, 8])
def test_frequencies_have_the_full_order(order):
    """Lowest but three of a string with one natural end, from a generalised eigenvalue problem."""
    errors = []
    for points in (33, 65):
        (axis,) = line((0, "natural")).discretise("finite-differences", points=points, order=order).axes
        rows, weights, masses = dense(axis, (True, False))
        scaled = (np.sqrt(weights)[:, None] * rows / np.sqrt(masses))[:, 1:]
        found = np.sqrt(np.linalg.eigvalsh(scaled.T @ scaled)[3])
        errors.append(abs(found / (3.5 * pi) - 1))
    assert np.log2(errors[0] / errors[1]) > order - 0.2


@pytest.mark.rotated
def test_moving_ends_coefficients_and_a_plane():
    """u = sin 5(x + t) with prescribed ends; u = sin(log(1 + x) - t) of a density with coefficients; a membrane."""
    mesh = line(("sin(5*t)", "sin(5*t + 5)")).discretise("finite-differences", order=8, points=81)
    x = mesh.points["x"]
    stepper = sc.compile_stepper(mesh.system, "svi:4", flags=QUICK_FLAGS)
    run = stepper.integrate({"u": sin(5 * x)}, velocity={"u": 5 * cos(5 * x)}, h=0.005, steps=100)
    assert np.abs(run.q["u"][-1] - sin(5 * (x + 0.5))).max() < 2e-5
    assert np.abs(mesh.local_laws(run, "energy")["energy"].residual[:, 20:-20]).max() < 0.05
    mesh = line((0, 0), "u_t**2/(2*(1 + x)) - (1 + x)*u_x**2/2").discretise("finite-differences", order=6, points=81)
    s = np.log1p(mesh.points["x"])
    k = pi / np.log(2)
    run = sc.compile_stepper(mesh.system, "svi:4", flags=QUICK_FLAGS).integrate({"u": sin(k * s)}, h=0.005, steps=100)
    assert np.abs(run.q["u"][-1] - sin(k * s) * cos(k * 0.5)).max() < 2e-5
    plane = sc.FieldSystem.from_text(
        "membrane", ["u"], {"x": (0, 1), "y": (0, 1)}, f"{WAVES} - u_y**2/2", boundary={"x": (0, 0)}
    )
    mesh = plane.discretise("finite-differences", order=4, points={"x": 21, "y": 31})
    u = sin(pi * mesh.points["x"]) * cos(2 * pi * mesh.points["y"])
    run = sc.compile_stepper(mesh.system, "svi:2", flags=QUICK_FLAGS).integrate({"u": u}, h=0.005, steps=60)
    assert np.abs(run.q["u"][-1] - u * cos(pi * np.sqrt(5) * 0.3)).max() < 2e-3
    assert run.energy_error() < 1e-14


@pytest.mark.rotated
def test_products_of_a_field_and_its_derivative_converge():
    """u^2 u_x^2 is interpolated at the ends."""
    found = []
    for points in (25, 49, 97):
        mesh = line(("natural", 0), f"{WAVES}*(1 + u**2/4)".replace("u_t**2/2 -", "u_t**2/2 - 1*")).discretise(
            "finite-differences", order=4, points=points
        )
        u = cos(pi * mesh.points["x"] / 2) ** 2
        run = sc.compile_stepper(mesh.system, "svi:3", flags=QUICK_FLAGS).integrate({"u": u}, h=0.005, steps=60)
        found.append(run.q["u"][-1][:: (points - 1) // 24][:24])
        assert run.energy_error() < 1e-9
    errors = [np.abs(one - two).max() for one, two in pairwise(found)]
    assert np.log2(errors[0] / errors[1]) > 1.8


@pytest.mark.rotated
def test_spectrum_and_derivative_of_a_line_with_ends():
    mesh = line((0, "natural")).discretise("finite-differences", order=8, points=65)
    x = mesh.points["x"]
    assert mesh.unresolved(sin(2.5 * pi * x)) < 1e-7
    assert mesh.unresolved(sin(61.5 * pi * x)) > 0.5
    assert mesh.derivative(x * exp(x), "x") == pytest.approx((1 + x) * exp(x), abs=1e-9)
    assert mesh.integral(x * exp(x)) == pytest.approx(1, abs=1e-10)
