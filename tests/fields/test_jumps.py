"""Coefficients that jump at ends of elements: exponential convergence to roots of the equations of both sides."""

import numpy as np
import pytest
from scipy.optimize import brentq

import scvi_codegen as sc

FLAGS = ("-O0",)


def roots(function, count):
    """Return the first positive roots of a function."""
    grid = np.linspace(0.5, 12.0, 400)
    changes = np.flatnonzero(np.diff(np.sign(function(grid))))[:count]
    return np.array([brentq(function, grid[k], grid[k + 1], xtol=1e-15) for k in changes])


# u = sin w x on [0, 1/2], and B sin k w (1 - x) beyond with the speed 1/k; u and its flux are continuous
MASS = (
    "(1 + 3*unit_step(x - a))*u_t**2/2 - u_x**2/2",
    lambda w: np.sin(w / 2) * 2 * np.cos(w) + np.cos(w / 2) * np.sin(w),
)
STIFFNESS = (
    "u_t**2/2 - (1 + 3*unit_step(x - a))*u_x**2/2",
    lambda w: 2 * np.sin(w / 2) * np.cos(w / 4) + np.cos(w / 2) * np.sin(w / 4),
)


def mesh_of(density, degree, elements, **arguments):
    space, boundary = {"x": (0, 1)}, {"x": (0, 0)}
    arguments = {"parameters": {"a": 0.5}, **arguments}
    system = sc.FieldSystem.from_text("string", ["u"], space, density, boundary=boundary, **arguments)
    return system.discretise("spectral-elements", degree=degree, elements=elements)


def lowest_frequencies(mesh, count):
    """Frequencies of a system without couplings of velocities, from its energy, a quadratic form."""
    stepper, n = sc.compile_stepper(mesh.system, "svi:2", flags=FLAGS), mesh.weights.size
    pairs = [(i, j) for i in range(n) for j in range(i, n)]
    q = np.array([np.eye(n)[i] + np.eye(n)[j] * (i != j) for i, j in pairs])
    energies = dict(zip(pairs, 2 * stepper.energy(q, np.zeros_like(q), np.zeros(len(q))), strict=True))
    stiffness = np.array([[_entry(energies, min(i, j), max(i, j)) for j in range(n)] for i in range(n)])
    inverse = 2 * stepper.energy(np.zeros((n, n)), np.eye(n), np.zeros(n))
    roots_of = np.sqrt(inverse)
    return np.sqrt(np.linalg.eigvalsh(stiffness * np.outer(roots_of, roots_of))[:count])


def _entry(energies, i, j):
    return energies[i, i] if i == j else (energies[i, j] - energies[i, i] - energies[j, j]) / 2


@pytest.mark.rotated
@pytest.mark.parametrize(("density", "function"), [MASS, STIFFNESS], ids=["mass", "stiffness"])
def test_errors_fall_exponentially_where_a_coefficient_jumps_between_elements(density, function):
    exact = roots(function, 2)
    for degree, error in ((4, 2e-3), (8, 2e-9), (12, 1e-12)):
        found = lowest_frequencies(mesh_of(density, degree, [0, 0.5, 1]), 2)
        assert np.abs(found / exact - 1).max() < error


def test_the_value_at_a_common_end_is_that_of_each_element():
    """Masses and damping at the points, of which one is at the jump, by the quadrature of both elements."""
    mesh = mesh_of(MASS[0], 4, [0, 0.5, 1], dissipation="unit_step(x - a)*u_t**2/2")
    stepper = sc.compile_stepper(mesh.system, "svi:2", flags=FLAGS)
    x, n = mesh.points["x"], mesh.weights.size
    share = np.where(x > 0.5, 1.0, 0.0)
    share[np.abs(x - 0.5) < 1e-12] = 0.5
    inverse = 2 * stepper.energy(np.zeros((n, n)), np.eye(n), np.zeros(n))
    assert 1 / inverse == pytest.approx(mesh.weights * (1 + 3 * share), rel=1e-14)
    run = stepper.integrate(np.zeros(n), velocity=np.eye(n)[int(np.argmax(share == 0.5))], h=1e-6, steps=1)
    lost = (run.energy()[0] - run.energy()[-1]) / 1e-6
    assert lost == pytest.approx(mesh.weights[share == 0.5][0] * 0.5, rel=1e-4)


@pytest.mark.second
def test_jumps_in_the_plane_along_ends_of_elements():
    """The mass of a membrane, a quarter of which is four times as heavy."""
    density = "(1 + 3*unit_step(x - 1/2)*unit_step(y - 1/2))*u_t**2/2 - u_x**2/2 - u_y**2/2"
    system = sc.FieldSystem.from_text("membrane", ["u"], {"x": (0, 1), "y": (0, 1)}, density)
    mesh = system.discretise("spectral-elements", degree=2, elements=2)
    stepper, shape = sc.compile_stepper(mesh.system, "svi:2", flags=FLAGS), mesh.weights.shape
    run = stepper.integrate({"u": np.zeros(shape)}, velocity={"u": np.ones(shape)}, h=1e-9, steps=1)
    energy = run.energy()[0]
    assert energy == pytest.approx((1 + 3 / 4) / 2, rel=1e-14)


def test_jumps_within_elements_are_reported():
    with pytest.warns(
        sc.SystemDefinitionWarning, match=r"jumps at x = 0\.5, within the element from 0\.4 to 1: .*0\.5"
    ):
        mesh_of(STIFFNESS[0], 4, [0, 0.4, 1])
    with pytest.warns(sc.SystemDefinitionWarning, match="in other terms with derivatives"):
        mesh_of("u_t**2/2 - (1 + unit_step(x - a))*u_x**2/2 - u_xx**2/2", 4, 2)
    space = {"x": (0, 1), "y": (0, 1)}
    disc = "(1 + unit_step(x**2 + y**2 - 1/4))*u_t**2/2 - u_x**2/2 - u_y**2/2"
    with pytest.warns(sc.SystemDefinitionWarning, match="jumps within elements of x and y"):
        sc.FieldSystem.from_text("disc", ["u"], space, disc).discretise("spectral-elements", degree=2, elements=2)
