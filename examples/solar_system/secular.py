"""Secular frequencies of the giant planets over millions of years, compared with Laskar's.

Sun and giant planets of DE421, the inner planets merged with the Sun. The run is recorded in a folder: a second call
continues it, also after it was killed.
"""

from __future__ import annotations

import argparse
import math
import time
from itertools import pairwise
from pathlib import Path

import ephemeris
import matplotlib
import numpy as np
from figures import zonal
from point_masses import coordinates, newton, relativity
from scipy.optimize import minimize_scalar

import scvi_codegen as sc

matplotlib.use("Agg")
import matplotlib.pyplot as plt

INNER = ("sun", "mercury", "venus", "earth", "moon", "mars")
PLANETS = ("jupiter", "saturn", "uranus", "neptune")
STEP, EVERY = 400.0, 1000  # days, steps between kept states
MILLION_YEARS = 365.25e6  # in days
WINDOW = 20.0  # million years, over which Laskar's frequencies are
ARCSECONDS = np.degrees(3600.0) * 365.25  # a year, of radians a day

# Laskar et al., "A long-term numerical solution for the insolation quantities of the Earth", A&A 428 (2004), table 3:
# arcseconds a year; g of eccentricities and perihelia, s of inclinations and nodes, over 20 million years
PUBLISHED = {"g5": 4.257452, "g6": 28.2449, "g7": 3.087946, "g8": 0.673019} | {
    "s6": -26.347841, "s7": -2.9925258, "s8": -0.691736
}  # fmt: skip


def bodies() -> tuple[dict[str, float], np.ndarray, np.ndarray, float]:
    """Return masses, positions, velocities and J2 R^2 of inner planets as rings: sum m a^2 / 2 over the mass inside."""
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
    """Return the direction of the angular momentum."""
    momentum = np.array(list(masses.values())) @ np.cross(q, v)
    return momentum / np.linalg.norm(momentum)


def stepper_of(masses: dict[str, float], rings: float, axis: np.ndarray, *, plain: bool = False) -> sc.Stepper:
    """Return a stepper of order 16; with Newton's Lagrangian alone if ``plain``."""
    lagrangian = newton(tuple(masses))
    parameters = {f"gm_{body}": mass for body, mass in masses.items()}
    if not plain:
        ring = zonal("sun", PLANETS, [repr(k) for k in axis.tolist()], 1.0, {2: rings})
        lagrangian += f" + {relativity(tuple(masses))} + {ring}"
        parameters["c"] = ephemeris.LIGHT
    system = sc.LagrangianSystem.from_text(
        name="giant planets", coordinates=coordinates(tuple(masses)), lagrangian=lagrangian, parameters=parameters
    )
    return sc.compile_stepper(system, sc.SVI(8))


def elements(run: sc.Trajectory, masses: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """Return perihelia, e exp(i longitude), and nodes, sin(i/2) exp(i node), of planets: complex, (times, planets).

    They are heliocentric, in the plane perpendicular to the total angular momentum.
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
    longitude = towards[..., 0] + 1j * towards[..., 1]  # for small inclinations
    return longitude, nodes


def frequency(t: np.ndarray, signal: np.ndarray, rank: int = 0) -> float:
    """Return the strongest frequency of a complex signal, or that of a later rank, in radians per unit of t.

    Laskar's frequency analysis: the maximum of the Fourier integral with a Hann window, then of the remainder.
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


def frequencies(t: np.ndarray, signals: dict[str, np.ndarray]) -> dict[str, float]:
    """Return the frequency of each signal in arcseconds a year; for Uranus g5 is stronger than g7."""
    return {name: ARCSECONDS * frequency(t, signal, int(name == "g7")) for name, signal in signals.items()}


def parts(count: int, number: int) -> list[slice]:
    """Split ``count`` rows into ``number`` equal slices."""
    ends = np.linspace(0, count, number + 1).astype(int)
    return [slice(first, last) for first, last in pairwise(ends)]


def recorded(folder: Path, steps: int, hours: float, *, plain: bool) -> sc.RecordedRun:
    """Return the run in the folder, continued to a number of steps, or for hours of processor time."""
    began = time.process_time()

    def stop() -> bool:
        return time.process_time() - began > 3600.0 * hours

    if folder.exists():
        before = len(sc.load_run(folder))
        run = sc.resume_run(folder, steps=max(steps, EVERY * (before - 1)), stop=stop)
    else:
        before = 1
        masses, q, v, rings = bodies()
        stepper = stepper_of(masses, rings, pole(masses, q, v), plain=plain)
        run = sc.record_run(
            stepper.start(q.ravel(), velocity=v.ravel(), h=STEP), folder, steps=steps, save_every=EVERY, stop=stop
        )
    seconds, done = time.process_time() - began, EVERY * (len(run) - before)
    each = f" ({1e6 * seconds / done:.2f} us a step)" if done else ""
    print(f"{done:,} steps in {seconds:.0f} s of processor time{each}")
    return run


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("million_years", type=float, nargs="?", default=20.0, help="how many (20)")
    parser.add_argument("--hours", type=float, default=math.inf, help="of processor time, after which the run ends")
    parser.add_argument("--newton", action="store_true", help="Newton's Lagrangian alone")
    parser.add_argument("--folder", type=Path, help="of the recorded run (giant_planets.run)")
    options = parser.parse_args()
    folder = options.folder or Path(f"giant_planets{'_newton' * options.newton}.run")
    steps = round(options.million_years * MILLION_YEARS / STEP / EVERY) * EVERY
    run = recorded(folder, steps, options.hours, plain=options.newton)[:]
    energy = run.energy() / run.energy()[0] - 1.0
    print(f"{run.t[-1] / MILLION_YEARS:.1f} million years, {EVERY * (len(run.t) - 1):,} steps")
    print(f"energy error at most {abs(energy).max():.1e}, at the end {abs(energy[-1]):.1e}")
    print(f"angular momentum {abs(run.momentum_errors()).max():.1e}")
    masses, *_ = bodies()
    perihelia, nodes = elements(run, masses)
    signals = {name: (perihelia if name[0] == "g" else nodes)[:, int(name[1]) - 5] for name in PUBLISHED}
    whole = frequencies(run.t, signals)
    quarters = [
        frequencies(run.t[part], {name: signal[part] for name, signal in signals.items()})
        for part in parts(len(run.t), 4)
    ]
    print(f"{'':4}{'here':>12}{'quarters off by':>18}{'Laskar':>12}   arcseconds a year")
    for name, published in PUBLISHED.items():
        apart = max(abs(quarter[name] - whole[name]) for quarter in quarters)
        print(f"{name:4}{whole[name]:12.6f}{apart:18.6f}{published:12.6f}")
    drawn(run.t / MILLION_YEARS, perihelia, nodes, energy, signals)


def drawn(
    million: np.ndarray, perihelia: np.ndarray, nodes: np.ndarray, energy: np.ndarray, signals: dict[str, np.ndarray]
) -> None:
    figure, (top, middle, lower, bottom) = plt.subplots(4, 1, figsize=(10, 10.5), layout="constrained")
    early = million < 1.0
    for k, planet in enumerate(PLANETS):
        top.plot(million[early], abs(perihelia[early, k]), lw=0.8, label=planet.capitalize())
        middle.plot(million[early], 2.0 * np.degrees(np.arcsin(abs(nodes[early, k]))))
    top.set(ylabel="eccentricity", title="The first million years")
    top.legend(ncols=4, frameon=False)
    middle.set(ylabel="inclination, degrees", xlabel="million years")
    windows = parts(len(million), max(4, int(million[-1] / WINDOW)))
    for name in ("g5", "g6", "s6"):
        found = [
            ARCSECONDS * frequency(MILLION_YEARS * million[part], signals[name][part]) - PUBLISHED[name]
            for part in windows
        ]
        lower.plot([million[part].mean() for part in windows], found, "o-", ms=3, lw=1, label=name)
    lower.set(
        ylabel="arcseconds a year beside Laskar",
        title=f"Frequencies over {million[-1] / len(windows):.0f} million years each",
    )
    lower.axhline(0.0, color="0.6", lw=0.8)
    lower.legend(ncols=3, frameon=False)
    bottom.plot(million, energy, lw=0.3)
    bottom.set(ylabel="relative energy error", xlabel="million years")
    figure.savefig("secular.png", dpi=110)


if __name__ == "__main__":
    main()
