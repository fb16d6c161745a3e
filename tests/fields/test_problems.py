"""Problems with analytic solutions, from a density to the fields at the end of a run."""

import numpy as np
import pytest
from numpy import arctan, cos, cosh, exp, pi, sin, sinh, sqrt
from samples import QUICK_FLAGS
from scipy.special import ellipj, ellipk

import scvi_codegen as sc
from scvi_codegen import FieldSystem

V = 0.5
GAMMA = 1 / sqrt(1 - V * V)


def rate_of(exact, grid, t, d=1e-3):
    """Return the derivative in time of an exact solution by differences of order 6."""
    each = [exact(*grid, t + k * d) for k in (-3, -2, -1, 1, 2, 3)]
    return np.tensordot(np.array([-1, 9, -45, 45, -9, 1]) / (60 * d), each, 1)


def evolved(field, method, options, exact, *, start=0.0, end=1.0, h=0.01, by="svi:4"):
    """Return mesh, run and largest error of the fields after a run from exact initial values."""
    mesh = field.discretise(method, **options)
    grid = [*mesh.points.values()]
    state = {each: values(*grid, start) for each, values in exact.items()}
    if field.momenta:
        p = {field.fields[k]: mesh.weights * state.pop(each) for k, each in enumerate(field.momenta)}
        given = {"p": p}
    else:
        given = {"velocity": {each: rate_of(values, grid, start) for each, values in exact.items()}}
    stepper = sc.compile_stepper(mesh.system, by, flags=QUICK_FLAGS)
    run = stepper.integrate(state, **given, t=start, h=h, steps=round((end - start) / h))
    end_values = {each: run.q[each][-1] for each in field.fields}
    end_values |= {p: run.p[q][-1] / mesh.weights for q, p in zip(field.fields, field.momenta, strict=False)}
    error = max(np.abs(end_values[each] - values(*grid, end)).max() for each, values in exact.items())
    return mesh, run, error


def line(density, bounds, boundary="periodic", **others):
    return FieldSystem.from_text("line", ["u"], {"x": bounds}, density, boundary={"x": boundary}, **others)


def kink(x, t):
    return 4 * arctan(exp(GAMMA * (x - V * t)))


def kinks(x, t):
    """Two kinks that collide (J. K. Perring, T. H. R. Skyrme, Nuclear Physics 31 (1962) 550)."""
    return 4 * arctan(V * sinh(GAMMA * x) / cosh(GAMMA * V * t))


def sine_gordon(left, right):
    return line("u_t**2/2 - u_x**2/2 - (1 - cos(u))", (-20, 20), (left, right))


SINE_GORDON = {
    "kink": (sine_gordon("0", "2*pi"), kink, (-3, 3)),
    "collision": (sine_gordon("-2*pi", "2*pi"), kinks, (-6, 6)),
}


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", SINE_GORDON)
def test_sine_gordon_kink_and_collision(name):
    field, exact, (start, end) = SINE_GORDON[name]
    options = {"degree": 10, "elements": 20}
    mesh, run, error = evolved(field, "spectral-elements", options, {"u": exact}, start=start, end=end, h=0.02)
    assert error < 2e-6
    assert np.ptp(run.energy()) < 1e-12
    assert mesh.unresolved(run.q["u"]).max() < 1e-5  # the values at the ends, 0 and 2 pi, are no jump
    momentum = mesh.conserved(run, "momentum_x")["momentum_x"]
    assert momentum == pytest.approx(8 * GAMMA * V if name == "kink" else 0, abs=1e-5)
    kinks_of = 1 if name == "kink" else 2
    assert mesh.conserved(run, "energy")["energy"] == pytest.approx(8 * GAMMA * kinks_of, abs=1e-6)


def test_klein_gordon_waves_have_their_dispersion():
    field = line("u_t**2/2 - u_x**2/2 - m**2*u**2/2", (0, "2*pi"), parameters={"m": 2})
    exact = {"u": lambda x, t: sum(sin(k * x - sqrt(k * k + 4) * t + k) for k in (1, 2, 5))}
    mesh, run, error = evolved(field, "fourier", {"points": 16}, exact, end=20, h=0.05)
    assert error < 1e-9
    assert np.ptp(mesh.conserved(run, "momentum_x")["momentum_x"]) < 1e-12


def peregrine(x, t):
    """Solution of i psi_t = -psi_xx/2 - |psi|^2 psi (D. H. Peregrine, J. Austral. Math. Soc. B 25 (1983) 16)."""
    return exp(1j * t) * (1 - 4 * (1 + 2j * t) / (1 + 4 * x * x + 4 * t * t))


@pytest.mark.full
def test_peregrine_breather_between_prescribed_ends():
    bulge = "4/(1 + 4*25 + 4*t**2)"
    ends = {"a": f"cos(t)*(1 - {bulge}) + sin(t)*2*t*{bulge}", "b": f"sin(t)*(1 - {bulge}) - cos(t)*2*t*{bulge}"}
    field = FieldSystem.from_text(
        "Peregrine",
        ["a"],
        {"x": (-5, 5)},
        hamiltonian="(a_x**2 + b_x**2)/4 - (a**2 + b**2)**2/4",
        momenta=["b"],
        boundary={"x": (ends, ends)},
    )
    exact = {"a": lambda x, t: peregrine(x, t).real, "b": lambda x, t: peregrine(x, t).imag}
    options = {"degree": 8, "elements": 14}
    mesh, run, error = evolved(field, "spectral-elements", options, exact, start=-0.5, end=0.5, h=0.001, by="svi:2")
    assert error < 1e-5
    middle = np.abs(run.q["a"] + 1j * run.p["a"] / mesh.weights).max()
    assert middle == pytest.approx(3, abs=1e-5)  # three times the background at t = 0


def solitons(x, t):
    """Two solitons of u_t + 6 u u_x + u_xxx = 0 that collide at t = 0, 2 (log tau)_xx by exact derivatives."""
    one, two = 1.0, 1.5
    e, f = exp(one * (x - one**2 * t)), exp(two * (x - two**2 * t))
    both = ((one - two) / (one + two)) ** 2 * e * f
    tau = 1 + e + f + both
    first = one * e + two * f + (one + two) * both
    second = one**2 * e + two**2 * f + (one + two) ** 2 * both
    return 2 * (second / tau - (first / tau) ** 2)


@pytest.mark.full
def test_korteweg_de_vries_solitons_collide():
    """The bracket {u(x), u(y)} = d/dx delta(x - y) is that of u = q_x/2 + p for canonical q and p; q_x/2 - p rests."""
    field = FieldSystem.from_text(
        "Korteweg-de Vries",
        ["q"],
        {"x": (-16, 16)},
        hamiltonian="(q_xx/2 + p_x)**2/2 - (q_x/2 + p)**3",
        momenta=["p"],
        boundary={"x": "periodic"},
    )
    mesh = field.discretise("fourier", points=63)
    x = mesh.points["x"]
    u = solitons(x, -2.0)
    mean, k = u.mean(), 2j * pi * np.fft.fftfreq(63, 32 / 63)
    q = np.fft.ifft(np.fft.fft(u - mean) / np.where(k == 0, 1, k)).real  # q_x = u - mean
    stepper = sc.compile_stepper(mesh.system, "gauss:2", flags=QUICK_FLAGS)
    run = stepper.integrate({"q": q}, p={"q": mesh.weights * (u + mean) / 2}, t=-2.0, h=0.004, steps=1000)
    found = mesh.derivative(run.q["q"], "x") / 2 + run.p["q"] / mesh.weights
    assert np.abs(found[-1] - solitons(x, 2.0)).max() < 2e-4
    rest = mesh.derivative(run.q["q"], "x") / 2 - run.p["q"] / mesh.weights
    assert np.ptp(rest, axis=0).max() < 1e-10
    totals = mesh.conserved(run, "energy", "momentum_x")
    assert np.ptp(mesh.integral(found)) < 1e-12
    assert mesh.integral(found)[0] == pytest.approx(2 * (1 + 1.5), abs=1e-5)
    assert totals["energy"] == pytest.approx(-(1 + 1.5**5) / 5, abs=1e-5)
    assert np.ptp(totals["energy"]) < 1e-9
    assert np.ptp(totals["momentum_x"]) < 1e-5


def test_membrane_vibrates_in_its_first_modes():
    field = FieldSystem.from_text(
        "drum",
        ["u"],
        {"x": (0, 1), "y": (0, "sqrt(2)")},
        "u_t**2/2 - u_x**2/2 - u_y**2/2",
        boundary={"x": (0, 0), "y": (0, 0)},
    )
    modes = [(1, 1), (2, 1), (1, 3)]

    def exact(x, y, t):
        return sum(
            sin(a * pi * x) * sin(b * pi * y / sqrt(2)) * cos(pi * sqrt(a * a + b * b / 2) * t) for a, b in modes
        )

    _, run, error = evolved(field, "spectral-elements", {"degree": 10, "elements": 2}, {"u": exact}, h=0.005, end=0.5)
    assert error < 1e-7
    assert np.ptp(run.energy()) < 1e-12


def test_maxwell_modes_of_a_cavity():
    """TE mode of a cavity (0, pi)^2 by the vector potential in the temporal gauge; walls by reflection."""
    field = FieldSystem.from_text(
        "Maxwell",
        ["u", "v"],
        {"x": (0, "2*pi"), "y": (0, "2*pi")},
        "u_t**2/2 + v_t**2/2 - (v_x - u_y)**2/2",
        boundary={"x": "periodic", "y": "periodic"},
    )
    w = sqrt(5)
    exact = {
        "u": lambda x, y, t: 2 * cos(x) * sin(2 * y) * cos(w * t),
        "v": lambda x, y, t: -sin(x) * cos(2 * y) * cos(w * t),
    }
    mesh, run, error = evolved(field, "finite-differences", {"order": 8, "points": 24}, exact, h=0.02)
    assert error < 1e-4
    u, v = run.q["u"], run.q["v"]
    assert np.abs(u[:, :, [0, 12]]).max() < 1e-12  # tangential electric field at y = 0, pi
    assert np.abs(v[:, [0, 12]]).max() < 1e-12
    charge = mesh.derivative(run.p["u"], "x") + mesh.derivative(run.p["v"], "y")
    assert np.abs(charge).max() < 1e-5
    assert np.ptp(run.energy()) < 1e-12


@pytest.mark.full
def test_elastic_waves_in_the_plane_have_two_speeds():
    field = FieldSystem.from_text(
        "solid",
        ["u", "v"],
        {"x": (0, "2*pi"), "y": (0, "2*pi")},
        "u_t**2/2 + v_t**2/2 - lam*(u_x + v_y)**2/2 - mu*(u_x**2 + v_y**2 + (u_y + v_x)**2/2)",
        boundary={"x": "periodic", "y": "periodic"},
        parameters={"lam": 2, "mu": 1},
    )
    p, s = sqrt(2) * 2, sqrt(2) * 1  # |k| = sqrt(2), speeds sqrt(lam + 2 mu) = 2 and sqrt(mu) = 1
    exact = {
        "u": lambda x, y, t: sin(x + y - p * t) + cos(x + y - s * t),
        "v": lambda x, y, t: sin(x + y - p * t) - cos(x + y - s * t),
    }
    _, run, error = evolved(field, "finite-differences", {"order": 8, "points": 24}, exact, h=0.02)
    assert error < 1e-5
    assert np.ptp(run.energy()) < 1e-11


@pytest.mark.full
def test_quartic_waves_in_space():
    """Plane wave u = A cn(k (x + y + z) - w t) of modulus 1/sqrt(2) of u_tt = Laplace u - u^3, w^2 = 3 k^2 + A^2."""
    period = 4 * ellipk(0.5)
    field = FieldSystem.from_text(
        "phi^4",
        ["u"],
        dict.fromkeys("xyz", (0, period)),
        "u_t**2/2 - u_x**2/2 - u_y**2/2 - u_z**2/2 - u**4/4",
        boundary=dict.fromkeys("xyz", "periodic"),
    )
    exact = {"u": lambda x, y, z, t: ellipj(x + y + z - 2 * t, 0.5)[1]}
    _, run, error = evolved(field, "fourier", {"points": 16}, exact, h=0.05)
    assert error < 1e-4
    assert np.ptp(run.energy()) < 1e-10
