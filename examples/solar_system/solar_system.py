"""Solar system from one Lagrangian, compared with DE421: the effect of each of its terms, body by body.

From the states of DE421 on 28 June 1969, backward to 1899 and forward to 2200. Needs the extras `ephemeris` and `plot`.
Arguments on the command line, up to 15, are numbers of asteroids of further models, after the one with three.
"""

from __future__ import annotations

import os
import sys

import ephemeris
import matplotlib
import numpy as np
from ephemeris import AU, BODIES
from models import Model, ladder

matplotlib.use("Agg")
import matplotlib.pyplot as plt

STEP = 4.0  # days
SAMPLING = 8.0
SHOWN = ("mercury", "earth", "moon", "mars", "jupiter", "neptune")


def distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return distances between positions of bodies in km: (times, bodies)."""
    return np.linalg.norm(ephemeris.relative(a) - ephemeris.relative(b), axis=-1) * AU


def measured(model: Model) -> tuple[np.ndarray, np.ndarray]:
    """Return times and positions; print processor times and the difference to half the step size."""
    began = _processor_time()
    _ = model.stepper
    compiling = _processor_time() - began
    _ = model.start
    began = _processor_time()
    t, x = model.motion(STEP, round(SAMPLING / STEP))
    running = _processor_time() - began
    _, finer = model.motion(STEP / 2.0, round(2.0 * SAMPLING / STEP))
    halved = distances(x, finer).max(axis=0)
    most = BODIES[1 + halved.argmax()]
    years = (t[-1] - t[0]) / 365.25
    print(
        f"{model.name:32} compiled in {compiling:4.1f} s, {years:.0f} years in {running:5.2f} s;"
        f" half steps change {most} by {1e3 * halved.max():.0f} m, others by {1e3 * np.sort(halved)[-2]:.1f} m",
        flush=True,
    )
    return t, x[:, : len(BODIES)]


def _processor_time() -> float:
    """Return the processor time of this process and of the compilers it has called."""
    return sum(os.times()[:4])


def turning_of_the_moon(t: np.ndarray, x: np.ndarray) -> float:
    """Return the excess of the Moon's mean acceleration over DE421, in arcseconds a century squared."""
    earth, moon = BODIES.index("earth"), BODIES.index("moon")
    q, v = (each[:, moon] - each[:, earth] for each in ephemeris.states(t))
    ahead = np.cross(np.cross(q, v), q)
    off = x[:, moon] - x[:, earth] - q
    angle = np.einsum("ti,ti->t", off, ahead) / np.linalg.norm(ahead, axis=1) / np.linalg.norm(q, axis=1)
    return 2.0 * 3600.0 * np.degrees(np.polyfit(t / 36525.0, angle, 3)[1])


def conserved(model: Model) -> str:
    """Return the errors of the conserved quantities of L over all years, as text."""
    runs = model.runs(STEP, round(SAMPLING / STEP))
    energy = max(abs(run.energy() / run.energy()[0] - 1.0).max() for run in runs)
    errors = np.max([abs(run.momentum_errors()).max(axis=0) for run in runs], axis=0)
    names = model.stepper.momentum_map_names
    kept = ", ".join(f"{name} {error:.0e}" for name, error in zip(names, errors, strict=True))
    return f"energy {energy:.0e}; {kept}"


def print_table(title: str, rows: dict[str, np.ndarray]) -> None:
    print(f"\n{title}\n{'':32}" + "".join(f"{body:>9}" for body in BODIES[1:]))
    for name, largest in rows.items():
        print(f"{name:32}" + "".join(f"{_three_digits(km):>9}" for km in largest))


def _three_digits(km: float) -> str:
    return f"{km:.{max(0, 2 - int(np.floor(np.log10(km))))}f}"


def drawn(found: dict[str, tuple[np.ndarray, np.ndarray]]) -> None:
    figure, axes = plt.subplots(2, 3, figsize=(12, 7), layout="constrained", sharex=True)
    colours = plt.get_cmap("viridis_r")(np.linspace(0.1, 1.0, len(found)))
    for body, ax in zip(SHOWN, axes.flat, strict=True):
        for (name, (t, away)), colour in zip(found.items(), colours, strict=True):
            year = 2000.0 + (t - ephemeris.YEAR_2000) / 365.25
            envelope = away[:, BODIES.index(body) - 1]
            width = 92  # of eight days: two years
            kept = len(envelope) // width * width
            ax.semilogy(year[:kept:width], envelope[:kept].reshape(-1, width).max(axis=1), color=colour, label=name)
        ax.set(title=f"{body.capitalize()}, km from DE421")
        ax.axvspan(year[0], 2000.0 + (ephemeris.END_OF_FIT - ephemeris.YEAR_2000) / 365.25, color="0.94", zorder=0)
        ax.grid(color="0.9")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False)
    figure.savefig("solar_system.png", dpi=110)


def main() -> None:
    found, turning = {}, {}
    for model in ladder((3, *map(int, sys.argv[1:]))):
        t, x = measured(model)
        fitted = t <= ephemeris.END_OF_FIT
        found[model.name] = t, distances(x, ephemeris.states(t)[0])
        turning[model.name] = turning_of_the_moon(t[fitted], x[fitted])
        if model.name.endswith("Hoffmann"):
            print(f"{'':32} kept to: {conserved(model)}", flush=True)
    largest = {name: away[t <= ephemeris.END_OF_FIT].max(axis=0) for name, (t, away) in found.items()}
    print_table("largest distance from DE421, 1899 to 2053, km (planets from the Sun, Moon from the Earth)", largest)
    print_table("and to 2200", {name: away.max(axis=0) for name, (_, away) in found.items()})
    print("\nchange of the Moon's mean motion against DE421, 1899 to 2053, arcseconds a century squared")
    for name, excess in turning.items():
        print(f"{name:32}{excess:9.2f}")
    drawn(found)


if __name__ == "__main__":
    main()
