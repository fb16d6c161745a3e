"""Optimal control: a satellite of three hinged panels rotates by a quarter turn with zero angular momentum.

Three equal rods in the plane; the cost of two joint torques is minimised. The falling cat works on the same principle.
"""

import sys

import matplotlib.pyplot as plt
import numpy as np
import sympy as sp
from comparing import HEADING, compared

import scvi_codegen as sc

angles, rates = sp.symbols("theta alpha beta"), sp.symbols("theta_dot alpha_dot beta_dot")


def turning(middle, left, right):
    """Return the angles of the left, middle and right rod; joint angles are relative to the middle one."""
    return [middle + left, middle, middle + right]


along = [sp.Matrix([sp.cos(a), sp.sin(a)]) for a in turning(*angles)]
across = [rate * sp.Matrix([-d[1], d[0]]) for d, rate in zip(along, turning(*rates), strict=True)]
speeds = [-across[1] - across[0], sp.zeros(2, 1), across[1] + across[2]]  # of the centres, beside the middle one's
mean = sum(speeds, sp.zeros(2, 1)) / 3
L = sum((v - mean).dot(v - mean) / 2 + rate**2 / 6 for v, rate in zip(speeds, turning(*rates), strict=True))
L = sp.trigsimp(sp.expand(L))  # theta drops out
u, w = sp.symbols("u w")
satellite = sc.LagrangianSystem.from_sympy(
    name="satellite", lagrangian=L, coordinates=angles, forces={angles[1]: u, angles[2]: w}, inputs=["u", "w"]
)
phase = np.linspace(0, 2 * np.pi, 41)
lifted = 0.75 * (1 - np.cos(phase))
at_rest = dict.fromkeys(("alpha", "beta", "theta_dot", "alpha_dot", "beta_dot"), 0.0)
task = {
    "duration": 10.0,
    "start": {"theta": 0.0, **at_rest},
    "end": {"theta": np.pi / 2, **at_rest},
    "cost": "u**2 + w**2",
    "guess": {"theta": [0.0, np.pi / 2], "alpha": np.sin(phase) + lifted, "beta": np.sin(phase) - lifted},  # a loop
    "degree": 1,
}
momentum = sp.lambdify([*angles, *rates], sp.diff(L, rates[0]))

print(HEADING)
for steps in map(int, sys.argv[1:] or (20, 40, 80)):
    motion = compared(satellite, 3, {**task, "steps": steps}, momentum)
print(f"angular momentum of the states: {abs(motion.p[:, 0]).max():.0e}")

figure, axes = plt.subplots(figsize=(9, 1.8), layout="constrained")
for place, k in enumerate(np.linspace(0, steps, 9).astype(int)):
    rods = 2 * np.exp(1j * np.array(turning(*motion.q[k])))
    points = np.cumsum([0, *rods])
    points -= (points[:-1] + points[1:]).mean() / 2  # the centre of mass stays
    axes.plot(points.real + 6 * place, points.imag, "C0", lw=2)
    axes.plot((points.real + 6 * place)[1:3], points.imag[1:3], "C3", lw=2)
axes.set(aspect="equal", xticks=[], yticks=[], xlabel="from left to right, in equal times")
figure.savefig("reorientation.png", dpi=110)
