"""Energy on a Kepler ellipse: a variational integrator, spectral collocation on the same nodes, and explicit Euler.

All three take the same step size, for a hundred revolutions. The energy error of the variational integrator remains
bounded; that of collocation grows linearly; explicit Euler leaves the ellipse at once.
"""

import math
import warnings

import numpy as np

import scvi_codegen as sc

kepler = sc.problem("kepler")
METHODS = {
    "SVI, degree 4": sc.SVI(4),
    "spectral collocation, degree 4": sc.SpectralCollocation(4),
    "explicit Euler": sc.ExplicitEuler(),
}
REVOLUTIONS = (1, 10, 100)
STEPS = 40

warnings.simplefilter("ignore", sc.AccuracyWarning)  # explicit Euler becomes inaccurate soon

print("largest relative energy error within " + ", ".join(map(str, REVOLUTIONS)) + " revolutions")
for name, method in METHODS.items():
    stepper = sc.compile_stepper(kepler.system, method)
    p = stepper.momentum(kepler.q, kepler.velocity)
    run = stepper.integrate(kepler.q, p, h=2 * math.pi / STEPS, steps=STEPS * REVOLUTIONS[-1])
    energy = run.energy()
    error = np.abs(energy / energy[0] - 1)
    print(f"{name:32}" + "".join(f"{error[: STEPS * n + 1].max():12.1e}" for n in REVOLUTIONS))
