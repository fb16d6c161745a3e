"""How the orbits of the giant planets turn: their secular frequencies over millions of years, beside Laskar's.

Sun and giant planets of DE421, the inner planets within the Sun; with a number of million years on the command line
(default 20) and `newton` after it without what relativity and the ring of the inner planets add.
"""

from __future__ import annotations

import sys
import time

import ephemeris
import matplotlib
import numpy as np
from figures import zonal
from point_masses import coordinates, newton, relativity
from scipy.optimize import minimize_scalar

import scvi_codegen as sc

matplotlib.use("Agg")
import matplotlib.pyplot as plt

MILLION_YEARS = float(sys.argv[1]) if len(sys.argv) > 1 else 20.0
PLAIN = "newton" in sys.argv[2:]
INNER = ("sun", "mercury", "venus", "earth", "moon", "mars")
PLANETS = ("jupiter", "saturn", "uranus", "neptune")
STEP, EVERY = 200.0, 400  # days, steps between kept states
ARCSECONDS = np.degrees(3600.0) * 365.25  # a year, of radians a day

# Laskar et al., "A long-term numerical solution for the insolation quantities of the Earth", A&A 428 (2004), table 3:
# arcseconds a year; g of eccentricities and perihelia, s of inclinations and nodes, over 20 million years
PUBLISHED = {"g5": 4.257452, "g6": 28.2449, "g7": 3.087946, "g8": 0.673019} | {
    "s6": -26.347841, "s7": -2.9925258, "s8": -0.691736
}  # fmt: skip


def bodies() -> tuple[dict[str, float], np.ndarray, np.ndarray, float]:
    """Masses, positions and velocities; J2 R^2 of inner planets as rings: half of sum m a^2 over the mass within."""
    gm = ephemeris.masses()
    q, v = (dict(zip(ephemeris.BODIES, each[0], strict=True)) for each in ephemeris.states(np.zeros(1)))
    inside = sum(gm[body] for body in INNER)
    middle = [sum(gm[body] * x[body] for body in INNER) / inside for x in (q, v)]
    rings = sum(gm[body] * np.sum((q[body] - q["sun"]) ** 2) for body in INNER[1:]) / inside / 2.0
    masses = {"sun": inside} | {planet: gm[planet] for planet in PLANETS}
    together = [np.array([first, *(x[planet] for planet in PLANETS)]) for first, x in zip(middle, (q, v), strict=True)]
    weights = np.array(list(masses.values()))
    q0, v0 = (x - weights @ x / weights.sum() for x in together)
    return masses, q0, v0, float(rings)


def pole(masses: dict[str, float], q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """The direction of the angular momentum."""
    momentum = np.array(list(masses.values())) @ np.cross(q, v)
    return momentum / np.linalg.norm(momentum)


def stepper_of(masses: dict[str, float], rings: float, axis: np.ndarray) -> sc.Stepper:
    lagrangian = newton(tuple(masses))
    parameters = {f"gm_{body}": mass for body, mass in masses.items()}
    if not PLAIN:
        ring = zonal("sun", PLANETS, [repr(k) for k in axis.tolist()], 1.0, {2: rings})
        lagrangian += f" + {relativity(tuple(masses))} + {ring}"
        parameters["c"] = ephemeris.LIGHT
    system = sc.LagrangianSystem.from_text(
        name="giant planets", coordinates=coordinates(tuple(masses)), lagrangian=lagrangian, parameters=parameters
    )
    return sc.compile_stepper(system, sc.SVI(8))


def elements(run: sc.Trajectory, masses: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Perihelia, e exp(i longitude), and nodes, sin(i/2) exp(i node), of planets: complex, (times, planets).

    About the Sun, in the plane at right angles to the angular momentum of all.
    """
    gm = np.array(list(masses.values()))
    q, v = (x.reshape(len(x), -1, 3) for x in (run.q, run.velocity))
    z = pole(masses, q[0], v[0])
    x = np.cross([0.0, 1.0, 0.0], z) / np.linalg.norm(np.cross([0.0, 1.0, 0.0], z))
    axes = np.array([x, np.cross(z, x), z])
    q, v = ((each[:, 1:] - each[:, :1]) @ axes.T for each in (q, v))
    h = np.cross(q, v)
    towards = np.cross(v, h) / (gm[0] + gm[1:])[:, None] - q / np.linalg.norm(q, axis=-1, keepdims=True)
    normal = h / np.linalg.norm(h, axis=-1, keepdims=True)
    nodes = (1j * normal[..., 0] - normal[..., 1]) / np.sqrt(2.0 * (1.0 + normal[..., 2]))
    longitude = towards[..., 0] + 1j * towards[..., 1]  # of small inclinations
    return longitude, nodes


def frequency(t: np.ndarray, signal: np.ndarray, rank: int = 0) -> float:
    """The strongest frequency of a complex signal, or that of a rank after it, in radians per unit of t.

    Laskar's frequency analysis: where the Fourier integral with Hann's window is largest, then of what is left.
    """
    window, lines = np.hanning(len(t)), 2.0 * np.pi * np.fft.fftfreq(len(t), t[1] - t[0])

    def integral(w: float) -> complex:
        return np.vdot(np.exp(1j * w * (t - t[0])), window * signal) / window.sum()

    guess, width = lines[np.abs(np.fft.fft(window * signal)).argmax()], lines[1]
    around = (guess - width, guess + width)
    found = minimize_scalar(
        lambda w: -abs(integral(w)), bounds=around, method="bounded", options={"xatol": 1e-9 * width}
    ).x
    return frequency(t, signal - integral(found) * np.exp(1j * found * (t - t[0])), rank - 1) if rank else float(found)


def main() -> None:
    masses, q, v, rings = bodies()
    stepper = stepper_of(masses, rings, pole(masses, q, v))
    steps = round(MILLION_YEARS * 365.25e6 / STEP / EVERY) * EVERY
    began = time.process_time()
    run = stepper.integrate(q.ravel(), velocity=v.ravel(), h=STEP, steps=steps, every=EVERY)
    seconds = time.process_time() - began
    energy = run.energy() / run.energy()[0] - 1.0
    print(
        f"{MILLION_YEARS:g} million years, {steps:,} steps in {seconds:.0f} s ({1e6 * seconds / steps:.2f} us a step)"
    )
    print(f"energy error at most {abs(energy).max():.1e}, at the end {abs(energy[-1]):.1e}")
    print(f"angular momentum {abs(run.momentum_errors()).max():.1e}")
    perihelia, nodes = elements(run, masses)
    half = len(run.t) // 2
    print(f"{'':4}{'here':>12}{'of halves':>24}{'Laskar':>12}   arcseconds a year")
    for name, published in PUBLISHED.items():
        signal = (perihelia if name[0] == "g" else nodes)[:, int(name[1]) - 5]
        rank = int(name == "g7")  # in the motion of Uranus g5 is stronger
        whole, first, second = (
            ARCSECONDS * frequency(run.t[part], signal[part], rank)
            for part in (slice(None), slice(half), slice(half, None))
        )
        print(f"{name:4}{whole:12.5f}{first:12.5f}{second:12.5f}{published:12.5f}")
    drawn(run.t, perihelia, nodes, energy)


def drawn(t: np.ndarray, perihelia: np.ndarray, nodes: np.ndarray, energy: np.ndarray) -> None:
    million = t / 365.25e6
    figure, (top, middle, bottom) = plt.subplots(3, 1, figsize=(10, 8), layout="constrained")
    early = million < 1.0
    for k, planet in enumerate(PLANETS):
        top.plot(million[early], abs(perihelia[early, k]), label=planet.capitalize())
        middle.plot(million[early], 2.0 * np.degrees(np.arcsin(abs(nodes[early, k]))))
    top.set(ylabel="eccentricity", title="The first million years")
    top.legend(ncols=4, frameon=False)
    middle.set(ylabel="inclination, degrees", xlabel="million years")
    bottom.plot(million, energy, lw=0.3)
    bottom.set(ylabel="relative energy error", xlabel="million years")
    figure.savefig("secular.png", dpi=110)


if __name__ == "__main__":
    main()
