"""Point Lagrangians: masses, springs and scalars at places, against transcendental equations."""

from itertools import pairwise

import numpy as np
import pytest
from numpy import cos, pi, sin, tan
from samples import QUICK_FLAGS
from scipy.optimize import brentq

import scvi_codegen as sc

WAVES = "u_t**2/2 - u_x**2/2"


def string(points, *, ends=(0, 0), scalars=(), length=1, density=WAVES, **parameters):
    return sc.FieldSystem.from_text(
        "string",
        fields=["u"],
        space={"x": (0, length)},
        boundary={"x": ends},
        density=density,
        parameters=parameters,
        scalars=scalars,
        point_lagrangians=points,
    )


def change(mesh, state, *, to, by="svi:4", h=0.01, steps=100):
    """Largest differences of a run from rest to ``to`` times its initial state."""
    run = sc.compile_stepper(mesh.system, by, flags=QUICK_FLAGS).integrate(state, h=h, steps=steps)
    assert run.energy_error() < 1e-14
    return [float(np.abs(run.q[name][-1] - to * values).max()) for name, values in state.items()]


@pytest.mark.rotated
@pytest.mark.parametrize("mode", [0, 1, 2])
def test_string_with_a_mass_at_its_end_has_the_frequencies_of_the_transcendental_equation(mode):
    """m w = cot w for a string of length, density and tension 1."""
    m = 0.7
    w = brentq(lambda w: m * w * sin(w) - cos(w), mode * pi + 1e-6, (mode + 0.5) * pi)
    system = string([{"x": 1, "lagrangian": "m*u_t**2/2"}], ends=(0, "natural"), m=m)
    mesh = system.discretise("spectral-elements", degree=10, elements=2)
    assert change(mesh, {"u": sin(w * mesh.points["x"])}, to=cos(w))[0] < 1e-9


@pytest.mark.rotated
def test_oscillator_on_a_spring_at_a_place_inside():
    """Its force is the jump of u_x, w (cot w (1 - a) + cot w a) = k M w^2/(k - M w^2); an element ends there."""
    a, mass, k = 0.37, 0.3, 2.0
    w = brentq(lambda w: w * (1 / tan(w * (1 - a)) + 1 / tan(w * a)) - k * mass * w * w / (k - mass * w * w), 3.5, 4.2)
    system = string([{"x": "1 - 63/100", "lagrangian": "M*X_t**2/2 - k*(u - X)**2/2"}], scalars=["X"], M=mass, k=k)
    mesh = system.discretise("spectral-elements", degree=10, elements=3)
    x = mesh.points["x"]
    assert np.isclose(mesh.axes[0].cell_points, a).any()
    u = np.where(x < a, sin(w * x) / sin(w * a), sin(w * (1 - x)) / sin(w * (1 - a)))
    assert max(change(mesh, {"u": u, "X": np.array(k / (k - mass * w * w))}, to=cos(w))) < 2e-12


@pytest.mark.parametrize(
    ("method", "options", "degree"),
    [
        ("finite-differences", {"order": 4, "points": 16}, 0),
        ("finite-differences", {"order": 8, "points": 16}, 0),
        ("fourier", {"points": 9}, 4),
        ("fourier", {"points": 10}, 4),
    ],
)
def test_interpolation_is_exact_for_the_functions_of_the_basis(method, options, degree):
    ring = sc.FieldSystem.from_text("ring", ["u"], {"x": (0, 2)}, WAVES, boundary={"x": "periodic"})
    axis = ring.discretise(method, **options).axes[0]
    for at in (0.03, 0.77, 1.99, 2.0):
        row = axis.interpolation(at)
        indices, coefficients = np.array(list(row)), np.array(list(row.values()))
        distance = (axis.points[indices] - at + 1) % 2 - 1
        if "order" in options:
            assert np.abs(distance).max() < options["order"] / 16 + 1e-9
        powers = range(options["order"]) if degree == 0 and len(row) > 1 else (0,)
        for power in powers:
            assert coefficients @ distance**power == pytest.approx(float(power == 0), abs=1e-13)
        for k in range(degree + 1):
            assert coefficients @ cos(k * pi * distance) == pytest.approx(1, abs=1e-13)
            assert coefficients @ sin(k * pi * distance) == pytest.approx(0, abs=1e-13)


def test_highest_frequency_contains_points():
    """An upper bound, and that of a hard spring: sqrt(k (1/w + 1/M)) with the weight w of the point."""
    points = [{"x": 0.5, "lagrangian": "M*X_t**2/2 - k*(u - X)**2/2"}]
    mesh = string(points, scalars=["X"], M=0.3, k=1e8).discretise("spectral-elements", degree=4, elements=2)
    weight = mesh.weights[np.isclose(mesh.points["x"], 0.5)].item()
    assert mesh.highest_frequency() == pytest.approx(np.sqrt(1e8 * (1 / weight + 1 / 0.3)), rel=1e-5)
    assert mesh.highest_frequency(k=0.0) < 60


def test_equal_elements_are_divided_at_places():
    points = [{"x": 0.3, "lagrangian": "-u**2"}, {"x": 0.55, "lagrangian": "-u**2"}]
    axis = string(points).discretise("spectral-elements", degree=2, elements=4).axes[0]
    ends = [*axis.cell_points[:, 0], 1.0]
    assert {0.3, 0.55} < {*np.round(ends, 15)}
    assert all(0 < b - a < 0.2501 for a, b in pairwise(ends))
    given = string(points).discretise("spectral-elements", degree=2, elements=[0, 0.5, 1]).axes[0]
    assert given.cell_points[:, 0].tolist() == [0, 0.3, 0.5, 0.55]


def test_masses_need_a_point_and_hamiltonian_densities_have_none():
    ring = {"space": {"x": (0, 1)}, "boundary": {"x": "periodic"}}
    mass = [{"x": 0.3, "lagrangian": "m*u_t**2/2"}]
    field = sc.FieldSystem.from_text(
        "ring", ["u"], density=WAVES, point_lagrangians=mass, parameters={"m": 1.0}, **ring
    )
    with pytest.raises(sc.SystemDefinitionError, match=r"at x = 0\.3 contains u_t, but no point of the mesh is there"):
        field.discretise("fourier", points=32)
    assert field.discretise("fourier", points=30).highest_frequency() > 0
    with pytest.raises(sc.SystemDefinitionError, match="which has no point_lagrangians=: omit it"):
        sc.FieldSystem.from_text("ring", ["u"], momenta=["v"], hamiltonian="u*v", point_lagrangians=mass, **ring)
    with pytest.raises(sc.SystemDefinitionError, match="'u' is"):
        string(mass, scalars=["u"], m=1.0)
