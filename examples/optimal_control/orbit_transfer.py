"""Optimal control: minimum-time transfer from a circular orbit to twice the radius, with a thrust of 0.01 of gravity.

For such low thrust Edelbaum's formula approximates the time: the difference of the circular velocities divided by the
acceleration.
"""

import sys

import matplotlib.pyplot as plt
import numpy as np
from comparing import HEADING, compared

import scvi_codegen as sc

FAR, THRUST = 2.0, 0.01
craft = sc.LagrangianSystem.from_text(
    name="craft",
    coordinates=["r", "theta"],
    lagrangian="(r_dot**2 + r**2*theta_dot**2)/2 + 1/r",
    forces={"r": "a", "theta": "r*b"},
    inputs=["a", "b"],
)
edelbaum = (1 - FAR**-0.5) / THRUST
r = (1 - np.linspace(0, 1, 400) * (1 - FAR**-0.5)) ** -2.0  # as the spiral would be
theta = np.cumsum(r**-1.5) * edelbaum / 400
task = {
    "duration": (20.0, 60.0),
    "start": {"r": 1.0, "theta": 0.0, "r_dot": 0.0, "theta_dot": 1.0},
    "end": {"r": FAR, "r_dot": 0.0, "theta_dot": FAR**-1.5},
    "cost": "1",
    "bounds": {"a**2 + b**2": (None, THRUST**2)},
    "guess": {"r": r, "theta": theta, "duration": edelbaum},
}

print(HEADING)
for steps in map(int, sys.argv[1:] or (40, 80)):
    motion = compared(craft, 3, {**task, "steps": steps})
print(f"takes {motion.t[-1]:.4f}, by Edelbaum's formula {edelbaum:.4f}")

stepper = sc.compile_stepper(craft, "svi:3")
run = stepper.integrate(motion.q[0], motion.p[0], inputs=motion.inputs, h=motion.h / 8, t_end=motion.t[-1])
x, y = run.q[:, 0] * np.cos(run.q[:, 1]), run.q[:, 0] * np.sin(run.q[:, 1])
figure, axes = plt.subplots(figsize=(5.5, 5.5), layout="constrained")
circle = np.exp(1j * np.linspace(0, 2 * np.pi, 200))
for radius in (1, FAR):
    axes.plot(radius * circle.real, radius * circle.imag, "0.7", lw=1)
axes.plot(x, y)
(radial, along), (r, theta) = (motion.coefficients[name][:, 0] for name in "ab"), motion.q[:-1].T
push = (radial + 1j * along) * np.exp(1j * theta)
axes.quiver(r * np.cos(theta), r * np.sin(theta), push.real, push.imag, color="C3", width=0.003, scale=0.15)
axes.set(aspect="equal", xticks=[], yticks=[])
figure.savefig("orbit_transfer.png", dpi=110)
