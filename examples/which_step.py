"""Comparison of step-size selections on an orbit of eccentricity 0.9: cost, and conservation.

Fixed steps, adaptive steps, fixed steps of a time transformation, and steps of the reversible controller, each over a
number of periods (argument on the command line, default 1000). The exact orbit is periodic, so that the distance from
the start after whole periods is the error.
"""

from __future__ import annotations

import sys
import time

import numpy as np

import scvi_codegen as sc

ECCENTRICITY = 0.9
PERIODS = int(sys.argv[1]) if len(sys.argv) > 1 else 1000

kepler = sc.problem("kepler").system
q = np.array([1.0 - ECCENTRICITY, 0.0])
p = np.array([0.0, np.sqrt((1.0 + ECCENTRICITY) / (1.0 - ECCENTRICITY))])
end = 2.0 * np.pi * PERIODS
method = sc.SVI(8)

plain = sc.compile_stepper(kepler, method)
stretched = sc.compile_stepper(sc.reparametrise(kepler, "frequency"), method)
reversible = sc.compile_stepper(kepler, method, time_transformation="frequency")
fixed = 2.0 * np.pi / 300

ways = {
    "fixed, h = period / 300": lambda t: plain.integrate(q, p, h=fixed, steps=round(t / fixed)),
    "controlled, to round-off": lambda t: plain.integrate(q, p, t_end=t),
    "controlled, tolerance 1e-12": lambda t: plain.integrate(q, p, t_end=t, tolerance=1e-12),
    "transformed time, tau = 0.2": lambda t: stretched.integrate(q, p, h=0.2, t_end=t),
    "reversible, tau = 0.2": lambda t: reversible.integrate(q, p, h=0.2, t_end=t),
}
print(f"{'steps':28} {'a period':>8} {'us a period':>11} {'|dE/E|':>9} {'at the end':>10} {'|dq|':>9}")
for name, run in ways.items():
    run(2.0 * np.pi)  # compiles before timing
    began = time.perf_counter()
    found = run(end)
    seconds = time.perf_counter() - began
    energy = np.abs(found.energy() / found.energy()[0] - 1.0)
    print(
        f"{name:28} {found.steps / PERIODS:8.1f} {1e6 * seconds / PERIODS:11.1f} {energy.max():9.1e} {energy[-1]:10.1e}"
        f" {np.abs(found.q[-1] - q).max():9.1e}"
    )
