"""Optimal control: swing-up of a pole on a cart in two seconds with least effort, short track and weak motor."""

import sys

import matplotlib.pyplot as plt
import numpy as np
from comparing import HEADING, compared

import scvi_codegen as sc

cart = sc.LagrangianSystem.from_text(
    name="cart and pole",
    coordinates=["x", "a"],
    lagrangian="(M + m)*x_dot**2/2 + m*l*x_dot*a_dot*cos(a) + m*l**2*a_dot**2/2 - m*g*l*cos(a)",
    parameters={"M": 1.0, "m": 0.2, "l": 0.5, "g": 9.81},
    forces={"x": "u"},
    inputs=["u"],
)
task = {
    "duration": 2.0,
    "start": {"x": 0.0, "a": np.pi, "x_dot": 0.0, "a_dot": 0.0},
    "end": {"x": 0.0, "a": 0.0, "x_dot": 0.0, "a_dot": 0.0},
    "cost": "u**2",
    "bounds": {"u": (-12.0, 12.0), "x": (-0.6, 0.6)},
    "guess": {"x": 0.0, "a": [np.pi, 0.0]},
    "degree": 1,
}

print(HEADING)
for steps in map(int, sys.argv[1:] or (20, 40, 80)):
    motion = compared(cart, 3, {**task, "steps": steps})

figure, (place, push) = plt.subplots(2, 1, figsize=(7, 4.4), height_ratios=[2, 1], layout="constrained")
for k in range(0, steps + 1, max(1, steps // 40)):
    x, a = motion.q[k]
    color = plt.cm.viridis(k / steps)
    place.plot([x, x + 0.5 * np.sin(a)], [0, 0.5 * np.cos(a)], color=color, lw=1)
    place.plot(x + 0.5 * np.sin(a), 0.5 * np.cos(a), "o", color=color, ms=4)
place.set(aspect="equal", xlabel="x in m")
times = np.linspace(0, 2, 2001)[:-1]
push.plot(times, motion.inputs["u"](times))
push.set(xlabel="t in s", ylabel="force in N")
figure.savefig("swing_up.png", dpi=110)
