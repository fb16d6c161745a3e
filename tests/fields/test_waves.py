"""Waves with exact solutions: densities x discretisations, from initial values to the fields at the end of a run."""

from itertools import pairwise

import numpy as np
import pytest
from numpy import arctan, cos, cosh, exp, pi, sin, sqrt
from samples import QUICK_FLAGS
from scipy.special import ellipj, ellipk

import scvi_codegen as sc

V, W = 0.5, 0.6
GAMMA = 1 / sqrt(1 - V * V)
TURN = (0, "2*pi")
ELEMENTS, DIFFERENCES, FOURIER = "spectral-elements", "finite-differences", "fourier"


def field(density, space, boundary="periodic", fields="u", **more):
    space = space if isinstance(space, dict) else {"x": space}
    boundary = boundary if isinstance(boundary, dict) else dict.fromkeys(space, boundary)
    return sc.FieldSystem.from_text("waves", [*fields], space, density, boundary=boundary, **more)


def rate_of(exact, grid, t, d=1e-3):
    """Return the derivative in time of an exact solution by differences of order 6."""
    each = [exact(*grid, t + k * d) for k in (-3, -2, -1, 1, 2, 3)]
    return np.tensordot(np.array([-1, 9, -45, 45, -9, 1]) / (60 * d), each, 1)


def evolved(field, exact, method, options, *, start=0.0, end=0.5, h=0.01, by="svi:4"):
    """Return mesh, run and largest error of the fields after a run from exact initial values."""
    mesh = field.discretise(method, **options)
    grid = [*mesh.points.values()]
    state = {each: values(*grid, start) for each, values in exact.items()}
    if field.momenta:
        derivatives = {"p": {q: mesh.weights * state.pop(p) for q, p in zip(field.fields, field.momenta, strict=True)}}
    else:
        derivatives = {"velocity": {each: rate_of(values, grid, start) for each, values in exact.items()}}
    stepper = sc.compile_stepper(mesh.system, by, flags=QUICK_FLAGS)
    run = stepper.integrate(state, **derivatives, t=start, h=h, steps=round((end - start) / h))
    found = {each: run.q[each][-1] for each in field.fields}
    found |= {p: run.p[q][-1] / mesh.weights for q, p in zip(field.fields, field.momenta, strict=False)}
    return mesh, run, max(np.abs(found[each] - values(*grid, end)).max() for each, values in exact.items())


def breather(x, t):
    """Sine-Gordon breather of frequency W, 4 arctan(sqrt(1 - W^2)/W sin(W t)/cosh(sqrt(1 - W^2) x))."""
    e = sqrt(1 - W * W)
    return 4 * arctan(e / W * sin(W * t) / cosh(e * x))


def kink(x, t):
    return 4 * arctan(exp(GAMMA * (x - V * t)))


def soliton(x, t):
    """Soliton sech(x - V t) exp(i (V x + (1 - V^2) t/2)) of i psi_t = -psi_xx/2 - |psi|^2 psi."""
    return exp(1j * (V * x + (1 - V * V) / 2 * t)) / cosh(x - V * t)


def peregrine(x, t):
    """Solution of i psi_t = -psi_xx/2 - |psi|^2 psi (D. H. Peregrine, J. Austral. Math. Soc. B 25 (1983) 16)."""
    return exp(1j * t) * (1 - 4 * (1 + 2j * t) / (1 + 4 * x * x + 4 * t * t))


def parts(psi):
    return {"a": lambda x, t: psi(x, t).real, "b": lambda x, t: psi(x, t).imag}


def sine_gordon(width, boundary="periodic"):
    return field("u_t**2/2 - u_x**2/2 - (1 - cos(u))", (-width, width), boundary)


def schroedinger(width, boundary="periodic"):
    hamiltonian = "(a_x**2 + b_x**2)/4 - (a**2 + b**2)**2/4"
    return field(None, (-width, width), boundary, "a", hamiltonian=hamiltonian, momenta=["b"])


def string(density="u_t**2/2 - u_x**2/2", boundary=("natural", "natural"), **more):
    return field(density, (0, 1), {"x": boundary}, **more)


def kink_has_momentum_and_energy(mesh, run):
    """The values at the ends are no jump."""
    assert mesh.unresolved(run.q["u"]).max() < 1e-5
    momentum, energy = mesh.conserved(run, "momentum_x", "energy").values()
    assert momentum == pytest.approx(8 * GAMMA * V, abs=1e-5)
    assert energy == pytest.approx(8 * GAMMA, abs=1e-6)


def mass_is_conserved(mesh, run):
    assert np.ptp(mesh.integral(run.q["a"] ** 2 + (run.p["a"] / mesh.weights) ** 2)) < 5e-15
    assert mesh.unresolved(run.q["a"])[-1] < 1e-9


def momentum_is_conserved(mesh, run):
    assert np.ptp(mesh.conserved(run, "momentum_x")["momentum_x"]) < 1e-12


def amplitude_is_three(mesh, run):
    """Three times the background at t = 0."""
    assert np.abs(run.q["a"] + 1j * run.p["a"] / mesh.weights).max() == pytest.approx(3, abs=1e-5)


def walls_and_charge(mesh, run):
    """The tangential electric field is 0 at the walls, the charge everywhere."""
    assert np.abs(run.q["u"][:, :, [0, 12]]).max() < 1e-12
    assert np.abs(run.q["v"][:, [0, 12]]).max() < 1e-12
    assert np.abs(mesh.derivative(run.p["u"], "x") + mesh.derivative(run.p["v"], "y")).max() < 1e-5


BULGE = "4/(1 + 4*25 + 4*t**2)"
ENDS = {"a": f"cos(t)*(1 - {BULGE}) + sin(t)*2*t*{BULGE}", "b": f"sin(t)*(1 - {BULGE}) - cos(t)*2*t*{BULGE}"}
PLANE, ROOT = dict.fromkeys("xy", TURN), 4 * ellipk(0.5)
SOLID = "u_t**2/2 + v_t**2/2 - lam*(u_x + v_y)**2/2 - mu*(u_x**2 + v_y**2 + (u_y + v_x)**2/2)"
TWO = "u_t**2/2 + v_t**2/2 - u_x**2/2 - v_x**2/2 - k*(u - v)**2/2"
MODES = [(1, 1), (2, 1), (1, 3)]


def oblique(density):
    return field(f"u_t**2/2 - ({density})", PLANE), {"u": lambda x, y, t: sin(x + 2 * y - sqrt(7) * t)}


def standing(shape, frequency):
    return {"u": lambda *place: shape(*place[:-1]) * cos(frequency * place[-1])}


WAVES = {
    "breather": (sine_gordon(40), {"u": breather}),
    "kink": (sine_gordon(20, {"x": ("0", "2*pi")}), {"u": kink}, kink_has_momentum_and_energy),
    "Klein-Gordon": (
        field("u_t**2/2 - u_x**2/2 - m**2*u**2/2", TURN, parameters={"m": 2}),
        {"u": lambda x, t: sum(sin(k * x - sqrt(k * k + 4) * t + k) for k in (1, 2, 5))},
        momentum_is_conserved,
    ),
    "soliton": (schroedinger(20), parts(soliton), mass_is_conserved),
    "Peregrine": (schroedinger(5, {"x": (ENDS, ENDS)}), parts(peregrine), amplitude_is_three),
    "fixed": (string(boundary=(0, 0)), standing(lambda x: sin(pi * x), pi)),
    "natural": (string(), standing(lambda x: cos(pi * x), pi)),
    "left": (string(boundary=("0", "natural")), standing(lambda x: sin(pi / 2 * x), pi / 2)),
    "right": (string(boundary=("natural", 0)), standing(lambda x: cos(pi / 2 * x), pi / 2)),
    "moving": (
        string(boundary=("sin(k*t)", "sin(k*(t - 1))"), parameters={"k": 3}),
        {"u": lambda x, t: sin(3 * (t - x))},
    ),
    "variable": (
        string("u_t**2/(2*(1 + x)) - (1 + x)*u_x**2/2", (0, 0)),
        standing(lambda x: sin(pi * np.log(1 + x) / np.log(2)), pi / np.log(2)),
    ),
    "octave": (string(boundary=(0, 0)), standing(lambda x: sin(2 * pi * x), 2 * pi)),
    "ring": (field("u_t**2/2 - u_x**2/2", TURN), {"u": lambda x, t: sin(2 * (x - t))}),
    "two": (
        field(TWO, TURN, fields="uv", parameters={"k": 1.5}),
        {"u": lambda x, t: sin(x - t) + sin(x) * cos(2 * t), "v": lambda x, t: sin(x - t) - sin(x) * cos(2 * t)},
    ),
    "torus": (field("u_t**2/2 - u_x**2/2 - u_y**2/2", PLANE), standing(lambda x, y: sin(x) * sin(2 * y), sqrt(5))),
    "oblique": oblique("u_x**2/2 + u_y**2/2 + u_x*u_y/2"),
    "oblique square": oblique("(u_x + u_y)**2/4 + u_x**2/4 + u_y**2/4"),
    "box": (
        field(
            "u_t**2/2 - u_x**2/2 - u_y**2/2 - u_z**2/2",
            {"x": (0, pi), "y": (0, "pi"), "z": TURN},
            {"x": (0, 0), "z": "periodic"},
        ),
        standing(lambda x, y, z: sin(x) * cos(y) * sin(z), sqrt(3)),
    ),
    "beam": (field("u_t**2/2 - u_xx**2/2", TURN), standing(sin, 1)),
    "drum": (
        field("u_t**2/2 - u_x**2/2 - u_y**2/2", {"x": (0, 1), "y": (0, "sqrt(2)")}, (0, 0)),
        {
            "u": lambda x, y, t: sum(
                sin(a * pi * x) * sin(b * pi * y / sqrt(2)) * cos(pi * sqrt(a * a + b * b / 2) * t) for a, b in MODES
            )
        },
    ),
    "Maxwell": (
        field("u_t**2/2 + v_t**2/2 - (v_x - u_y)**2/2", PLANE, fields="uv"),
        {
            "u": lambda x, y, t: 2 * cos(x) * sin(2 * y) * cos(sqrt(5) * t),
            "v": lambda x, y, t: -sin(x) * cos(2 * y) * cos(sqrt(5) * t),
        },
        walls_and_charge,
    ),
    "solid": (  # |k| = sqrt(2), speeds sqrt(lam + 2 mu) = 2 and sqrt(mu) = 1
        field(SOLID, PLANE, fields="uv", parameters={"lam": 2, "mu": 1}),
        {
            "u": lambda x, y, t: sin(x + y - sqrt(8) * t) + cos(x + y - sqrt(2) * t),
            "v": lambda x, y, t: sin(x + y - sqrt(8) * t) - cos(x + y - sqrt(2) * t),
        },
    ),
    "quartic": (  # A cn(k (x + y + z) - w t) of modulus 1/sqrt(2), w^2 = 3 k^2 + A^2
        field("u_t**2/2 - u_x**2/2 - u_y**2/2 - u_z**2/2 - u**4/4", dict.fromkeys("xyz", (0, ROOT))),
        {"u": lambda x, y, z, t: ellipj(x + y + z - 2 * t, 0.5)[1]},
    ),
}
"""Density, exact solution, further properties of a run."""
UNEVEN = {"degree": 10, "elements": [0, 0.3, 0.6, 1]}
EVEN = {"degree": 10, "elements": 2}
HALVES = {"h": 0.004, "end": 0.2}
MESHES = [
    ("breather", ELEMENTS, {"degree": 8, "elements": 40}, 6e-7, {"start": 1, "end": 11, "h": 0.05, "by": "svi:8"}),
    ("breather", DIFFERENCES, {"order": 8, "points": 320}, 2e-6, {"start": 1, "end": 11, "h": 0.05, "by": "svi:8"}),
    ("breather", FOURIER, {"points": 256}, 2e-9, {"start": 1, "end": 11, "h": 0.05, "by": "svi:8"}),
    ("kink", ELEMENTS, {"degree": 10, "elements": 20}, 2e-6, {"start": -3, "end": 3, "h": 0.02}),
    ("Klein-Gordon", FOURIER, {"points": 16}, 1e-9, {"end": 20, "h": 0.05}),
    ("soliton", DIFFERENCES, {"order": 8, "points": 256}, 2e-6, {"h": 0.005, "by": "svi:2"}),
    ("soliton", ELEMENTS, {"degree": 8, "elements": 30}, 2e-6, {"h": 0.002, "by": "svi:2"}),
    ("soliton", FOURIER, {"points": 128}, 2e-6, {"by": "svi:2"}),
    *((name, ELEMENTS, EVEN, 1e-11, HALVES) for name in ("fixed", "natural", "moving")),
    *((name, ELEMENTS, UNEVEN, 1e-11, HALVES) for name in ("left", "right", "variable")),
    ("fixed", ELEMENTS, {"degree": 12, "elements": 1}, 1e-10, {}),
    ("two", ELEMENTS, {"degree": 8, "elements": 4}, 1e-9, {}),
    ("two", DIFFERENCES, {"order": 6, "points": 64}, 1e-9, {}),
    ("two", FOURIER, {"points": 16}, 1e-11, {}),
    ("torus", ELEMENTS, {"degree": 6, "elements": {"x": 3, "y": 4}}, 2e-5, {}),
    ("torus", DIFFERENCES, {"order": 6, "points": 32}, 5e-6, {}),
    ("torus", FOURIER, {"points": {"x": 12, "y": 16}}, 1e-11, {}),
    ("oblique", ELEMENTS, {"degree": 9, "elements": 3}, 2e-5, {}),
    ("oblique square", DIFFERENCES, {"order": 6, "points": 40}, 2e-5, {}),
    ("beam", FOURIER, {"points": 16}, 1e-12, {"h": 0.005}),
    ("beam", DIFFERENCES, {"order": 4, "points": 32}, 1e-4, {"h": 0.005}),
    ("beam", DIFFERENCES, {"order": 8, "points": 32}, 1e-8, {"h": 0.005}),
    ("drum", ELEMENTS, {"degree": 10, "elements": 2}, 1e-7, {"h": 0.005}),
    ("Maxwell", DIFFERENCES, {"order": 8, "points": 24}, 1e-4, {"h": 0.02, "end": 1.0}),
]
FULL = [
    ("Peregrine", ELEMENTS, {"degree": 8, "elements": 14}, 1e-5, {"start": -0.5, "h": 0.001, "by": "svi:2"}),
    ("box", ELEMENTS, {"degree": 6, "elements": 2}, 2e-5, {}),
    ("solid", DIFFERENCES, {"order": 8, "points": 24}, 1e-5, {"h": 0.02, "end": 1.0}),
    ("quartic", FOURIER, {"points": 16}, 1e-4, {"h": 0.05, "end": 1.0}),
]


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(
    ("name", "method", "options", "bound", "plan"),
    [*MESHES, *(pytest.param(*each, marks=pytest.mark.full) for each in FULL)],
)
def test_waves_are_within_the_error_of_the_mesh(name, method, options, bound, plan):
    density, exact, *properties = WAVES[name]
    mesh, run, error = evolved(density, exact, method, options, **plan)
    assert bound / 1e5 < error < bound
    if name not in ("moving", "Peregrine"):
        assert np.ptp(run.energy()) < 1e-9
    for check in properties:
        check(mesh, run)


@pytest.mark.rotated
def test_errors_of_elements_fall_exponentially_with_the_degree():
    options = [{"degree": degree, "elements": 4} for degree in (4, 6, 8, 10)]
    found = [evolved(*WAVES["octave"], ELEMENTS, each, h=0.005, end=0.25)[2] for each in options]
    assert all(b < a / 50 for a, b in pairwise(found)), found
    assert found[-1] < 1e-10


@pytest.mark.rotated
@pytest.mark.sampled(2)
@pytest.mark.parametrize("order", [2, 4, 6, 8])
def test_differences_have_their_order(order):
    options = [{"order": order, "points": points} for points in (24, 48)]
    one, two = (evolved(*WAVES["ring"], DIFFERENCES, each)[2] for each in options)
    assert np.log2(one / two) == pytest.approx(order, abs=0.35)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(("method", "order"), [("svi:1", 2), ("svi:2", 4)])
def test_order_in_time_is_twice_the_number_of_points(method, order):
    ends = []
    for h in (0.05, 0.025, 0.0125):
        run = evolved(*WAVES["breather"], ELEMENTS, {"degree": 6, "elements": 40}, start=1, end=3, h=h, by=method)[1]
        ends.append(run.q["u"][-1])
    assert np.log2(np.abs(ends[0] - ends[1]).max() / np.abs(ends[1] - ends[2]).max()) == pytest.approx(order, abs=0.2)
