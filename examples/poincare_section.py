"""Poincare sections of the Henon-Heiles system: regular at a low energy, mostly chaotic near the escape energy.

Orbits of one energy are cut at x = 0, x increasing. Each crossing is located within its step to the order of the
method: the energy at the crossings is that of the start.
"""

import numpy as np

import scvi_codegen as sc

problem = sc.problem("henon-heiles")
stepper = sc.compile_stepper(problem.system, sc.SVI(8), events=sc.Event("x", direction=1))


def orbit(energy: float, y: float, p_y: float) -> sc.Trajectory:
    p_x = np.sqrt(2 * energy - p_y**2 - y**2 + 2 * y**3 / 3)
    return stepper.integrate([0.0, y], [p_x, p_y], h=0.4, steps=40_000, save_every=40_000)


for energy, name in ((1 / 12, "regular"), (1 / 8, "mixed"), (1 / 6, "chaotic")):
    starts = [(y, 0.0) for y in np.linspace(-0.3, 0.4, 6)] + [(0.0, 0.15), (0.0, 0.25)]
    orbits = [orbit(energy, y, p_y) for y, p_y in starts]
    cuts = [run.events[0] for run in orbits]
    error = max(np.abs(stepper.energy(cut.q, cut.p) - energy).max() for cut in cuts)
    away = max(np.abs(cut.q[:, 0]).max() for cut in cuts)
    print(f"{name:8} E = {energy:.4f}: {sum(map(len, cuts))} crossings, |x| < {away:.0e}, energy error {error:.0e}")
    sc.plot_section(orbits, f"section_{name}.png", axes=("y", "p_y"))
