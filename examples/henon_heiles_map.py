"""Chaos indicators: MEGNO of the Henon-Heiles system at energy 1/8, on a grid of initial states with x = 0.

Each trajectory has one tangent vector and is integrated for 500 units of time; a value of 2 or less is regular. With an
argument, as in `python henon_heiles_map.py 400`, the grid has that number of y and half as many p_y; the default is
100.
"""

import sys
import time

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import scvi_codegen as sc

ENERGY, SPAN, STEP = 1 / 8, 500.0, 0.2
many = int(sys.argv[1]) if len(sys.argv) > 1 else 100

y, p_y = np.meshgrid(np.linspace(-0.45, 0.75, many), np.linspace(0.0, 0.5, many // 2))
square = 2 * ENERGY - p_y**2 - y**2 + 2 * y**3 / 3
inside = square > 0
q = np.column_stack([np.zeros(inside.sum()), y[inside]])
p = np.column_stack([np.sqrt(square[inside]), p_y[inside]])

stepper = sc.compile_stepper(sc.problem("henon-heiles").system, sc.SVI(2))
stepper.chaos_indicators_ensemble(q[:1], p[:1], h=STEP, steps=1, count=1)  # compiles
begun, work = time.perf_counter(), time.process_time()
found = stepper.chaos_indicators_ensemble(q, p, h=STEP, steps=round(SPAN / STEP), count=1)
took, work = time.perf_counter() - begun, time.process_time() - work

megno = np.full(y.shape, np.nan)
megno[inside] = found.megno()[-1]
rate = len(q) / work
print(f"{len(q)} states in {took:.1f} s, {rate:.0f} a second on one core: a million in {1e6 / rate / 60:.1f} min")
print(f"regular (MEGNO below 2.5): {np.mean(found.megno()[-1] < 2.5):.0%} of them")

figure, axes = plt.subplots(figsize=(7, 5), layout="constrained")
for side in (1, -1):  # a motion and its reversal
    shown = axes.pcolormesh(y, side * p_y, megno, vmin=0, vmax=8, cmap="inferno", rasterized=True)
figure.colorbar(shown, label="MEGNO", extend="max")
axes.set(xlabel="y", ylabel="p_y", title="Henon-Heiles, E = 1/8, x = 0")
figure.savefig("henon_heiles_map.png", dpi=110)
