"""Time transformation dt = g dtau for a comet of eccentricity 0.999: fixed steps of tau, variable steps of t.

Both variants are symplectic. With g = r^(3/2) steps are smaller near the sun; with g = r and Levi-Civita coordinates,
x + i y = (u + i w)^2, the comet is a harmonic oscillator, regular at collisions.
"""

import math

import numpy as np

import scvi_codegen as sc

E, ORBITS = 0.999, 20
comet = sc.LagrangianSystem.from_text(
    name="comet", coordinates=["x", "y"], lagrangian="(x_dot**2 + y_dot**2)/2 + 1/sqrt(x**2 + y**2)"
)
stretched = sc.reparametrise(comet, "frequency")
regular = sc.change_coordinates(
    sc.reparametrise(comet, "sqrt(x**2 + y**2)"), {"x": "u**2 - w**2", "y": "2*u*w"}, coordinates=["u", "w"]
)
aphelion, speed = 1 + E, math.sqrt((1 - E) / (1 + E))
STARTS = {  # p_u = J^T p_x
    "g = r^(3/2)": (stretched, [aphelion, 0.0], [0.0, speed], 0.1),
    "Levi-Civita": (regular, [math.sqrt(aphelion), 0.0], [0.0, 2 * math.sqrt(aphelion) * speed], 0.2),
}

print(f"{'':12} steps an orbit  longest step  shortest step  energy error  error after {ORBITS} orbits")
for name, (system, q, p, h) in STARTS.items():
    run = sc.compile_stepper(system, sc.SVI(8)).integrate(q, p, h=h, t_end=2 * math.pi * ORBITS)
    steps, energy = np.diff(run.t)[:-1], run.energy()
    errors = abs(energy / energy[0] - 1).max(), np.linalg.norm(run.q[-1] - q)
    print(
        f"{name:12} {len(run) / ORBITS:14.0f}{steps.max():14.2g}{steps.min():15.2g}{errors[0]:14.1e}{errors[1]:16.1e}"
    )
