"""Kustaanheimo-Stiefel regularisation: a comet in space that almost hits the sun, as four harmonic oscillators.

A point of space is x = K(u) for a circle of points u of R^4, with |x| = |u|^2. The Lagrangian in u is

    L = 2 |u|^2 |u'|^2 + 1 / |u|^2,      dt = |u|^2 ds,

whose solutions are regular in s at |x| = 0. Rotation along these circles is a symmetry with a fourth momentum; if that
is 0, K(u) is the orbit of the comet. Source: Stiefel & Scheifele, Linear and Regular Celestial Mechanics (1971),
chapters 9 and 11.
"""

import math

import numpy as np

import scvi_codegen as sc

E, ORBITS, STEPS = 0.99999, 100, 24
NAMES = ["u1", "u2", "u3", "u4"]
square = " + ".join(f"{u}**2" for u in NAMES)
speed = " + ".join(f"{u}_dot**2" for u in NAMES)
oscillators = sc.reparametrise(
    sc.LagrangianSystem.from_text(
        name="comet in space", coordinates=NAMES, lagrangian=f"2*({square})*({speed}) + 1/({square})"
    ),
    square,
)


def matrix(u: np.ndarray) -> np.ndarray:
    """Return A(u), whose first three rows give K(u) = A(u) u and K' = 2 A(u) u'."""
    a, b, c, d = u
    return np.array([[a, -b, -c, d], [b, a, -d, -c], [c, d, a, b], [d, -c, b, -a]])


def lifted(x: np.ndarray, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return one u with K(u) = x, and the momenta p = 4 |u|^2 u', whose component along the circle is 0."""
    r = np.linalg.norm(x)
    u1 = math.sqrt((r + x[0]) / 2)
    u = np.array([u1, x[1] / (2 * u1), x[2] / (2 * u1), 0.0])
    return u, 2 * matrix(u).T @ np.append(velocity, 0.0)


tilt = math.radians(40)
aphelion = (1 + E) * np.array([0.8, 0.6 * math.cos(tilt), 0.6 * math.sin(tilt)])
across = math.sqrt((1 - E) / (1 + E)) * np.array([-0.6, 0.8 * math.cos(tilt), 0.8 * math.sin(tilt)])
u, p = lifted(aphelion, across)
stepper = sc.compile_stepper(oscillators, sc.SVI(8))
run = stepper.integrate(u, p, h=2 * math.pi / STEPS, t_end=2 * math.pi * ORBITS)

places = np.array([matrix(state)[:3] @ state for state in run.q])
along = np.array([matrix(state)[3] @ momentum for state, momentum in zip(run.q, run.p, strict=True)])
distances = np.linalg.norm(places, axis=1)
far = distances > 0.01  # nearer, the energy is a difference of numbers so large that rounding of u shows
print(f"{len(run) / ORBITS:.0f} steps an orbit; distances from {distances.min():.1e} to {distances.max():.2f}")
print(f"energy error: {np.ptp(run.energy()[far]):.1e}")
print(f"momentum along the circles: {abs(along).max():.1e}")
print(f"distance from the start after {ORBITS} orbits: {np.linalg.norm(places[-1] - aphelion):.1e}")
