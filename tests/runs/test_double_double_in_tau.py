"""Double-double steps in transformed time, against Kepler's equation and stage equations solved here in 60 digits."""

import operator
from functools import cache
from typing import Any

import numpy as np
import pytest
from mpmath import mp
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen.runs.states.words import as_mpmath, product_of, quotient_of, sum_of, with_low

pytestmark = pytest.mark.rotated

KEPLER = lagrange("kepler", "x y", "(x_dot**2 + y_dot**2)/2 + mu/sqrt(x**2 + y**2)", mu=1.0)
RADIUS = "sqrt(x**2 + y**2)"


@cache
def stepper(method: str, g: str = "frequency", *, hamiltonian: bool = False) -> sc.Stepper:
    system = sc.reparametrise(sc.hamiltonian_of(KEPLER) if hamiltonian else KEPLER, g)
    return sc.compile_stepper(system, method, precision="double-double")


def start(e: str) -> dict[str, Any]:
    """Return the pericentre of an orbit with semi-major axis 1."""
    with mp.workdps(50):
        return {"q": [1 - mp.mpf(e), 0], "velocity": [0, mp.sqrt((1 + mp.mpf(e)) / (1 - mp.mpf(e)))]}


def largest(values: Any) -> float:
    return float(max(map(abs, values)))


def gauss_tables() -> tuple[list, list]:
    """Return the coefficients of Gauss's method with two stages."""
    root = mp.sqrt(3) / 6
    quarter = mp.mpf(1) / 4
    return [[quarter, quarter - root], [quarter + root, quarter]], [mp.mpf(1) / 2] * 2


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("hamiltonian", [False, True])
def test_step(hamiltonian: bool) -> None:
    """A step of K = r (H - E) and its duration, the integral of r, are those of Gauss's method in 60 digits."""
    run = stepper("gauss:2", RADIUS, hamiltonian=hamiltonian).integrate(**start("0.9"), h=0.125, steps=3)
    with mp.workdps(60):
        A, b = gauss_tables()
        h, E = mp.mpf("0.125"), run.mp("parameters")[1]
        assert abs(E + mp.mpf(1) / 2) < 5e-31  # of 9.5 - 10

        def rates(x: Any, y: Any, p: Any, w: Any) -> list:
            r, K = mp.sqrt(x * x + y * y), (p * p + w * w) / 2 - E
            return [r * p, r * w, -K * x / r, -K * y / r, r]  # K = r (p^2/2 - E) - 1

        for k in (0, 2):
            z = [*run.mp("q")[k], *run.mp("p")[k], run.mp("t")[k]]
            f = [rates(*z[:4])] * 2
            for _ in range(120):
                f = [rates(*(z[i] + h * mp.fdot(line, [g[i] for g in f]) for i in range(4))) for line in A]
            exact = [z[i] + h * mp.fdot(b, [g[i] for g in f]) for i in range(5)]
            found = [*run.mp("q")[k + 1], *run.mp("p")[k + 1], run.mp("t")[k + 1]]
            assert largest(a - c for a, c in zip(found, exact, strict=True)) < 2e-30 * largest(exact)


def walk_of_energy(g: str, method: str, steps: int) -> np.ndarray:
    """Return K = g (H - E) along six orbits, minus its mean over the first twentieth of the steps."""
    found = []
    for k in range(6):
        with mp.workdps(50):
            (r, _), (_, v) = start(str(0.9 - k / 1000)).values()
            c, s = mp.cos(k), mp.sin(k)
        run = stepper(method, g).integrate(
            [r * c, r * s], velocity=[-v * s, v * c], h=0.125, steps=steps, save_every=steps // 1000
        )
        energy = run.energy()
        rates = np.hypot(*run.q.T) ** (1.0 if g == RADIUS else 1.5)
        found.append(rates * np.asarray(energy - energy[0]))
    K = np.array(found)
    return K - K[:, 1:51].mean(axis=1, keepdims=True)


@pytest.mark.parametrize(
    ("g", "steps", "most"),
    [
        ("frequency", 5000, 1.2e-33),
        pytest.param(RADIUS, 200_000, 2.5e-33, marks=pytest.mark.full),
        pytest.param("frequency", 200_000, 1.2e-33, marks=pytest.mark.full),
    ],
)
def test_energy_performs_a_random_walk(g: str, steps: int, most: float) -> None:
    """K = 0 changes by rounding errors alone, without drift, whose root mean square grows with that of the steps."""
    K = walk_of_energy(g, "svi:16", steps)
    for part in (200, 1000):
        ends = K[:, part - 20 : part].mean(axis=1)
        assert np.sqrt((ends**2).mean()) < most * np.sqrt(part / 1000 * steps)


@pytest.mark.quick
def test_arithmetic() -> None:
    """Sums, products and quotients of arrays of two words are accurate to 1e-31; of doubles they are those of NumPy."""
    rng = np.random.default_rng(5)
    high = rng.uniform(0.5, 2.0, (2, 100))
    x, y = (with_low(each, each * 2.0**-54 * rng.uniform(-1, 1, 100)) for each in high)
    with mp.workdps(50):
        a, b = map(as_mpmath, (x, y))
        for function, plain in ((sum_of, operator.add), (product_of, operator.mul), (quotient_of, operator.truediv)):
            exact = plain(a, b)
            assert largest((as_mpmath(function(x, y)) - exact) / exact) < 3e-32
            assert (function(*high) == plain(*high)).all()
