"""Holonomic constraints: a chain of 100 rods between two hooks, in Cartesian coordinates, and its Lagrange multipliers.

Released from a V with friction, it comes to rest as a catenary of rods. There the horizontal part of the tension, which
the multipliers determine, is the same in every rod.
"""

from time import perf_counter

import numpy as np

from scvi_codegen import LagrangianSystem, compile_stepper

RODS, WIDTH, LENGTH = 100, 1.0, 1.2
BEADS = range(1, RODS)


def chain() -> LagrangianSystem:
    """Return beads of mass m between rods of equal length, with ends at (0, 0) and (WIDTH, 0)."""
    place = {0: ("0", "0"), RODS: ("w", "0")} | {k: (f"x{k}", f"y{k}") for k in BEADS}
    rods = [
        f"({place[k + 1][0]} - {place[k][0]})**2 + ({place[k + 1][1]} - {place[k][1]})**2 = l**2" for k in range(RODS)
    ]
    squares = " + ".join(f"x{k}_dot**2 + y{k}_dot**2" for k in BEADS)
    heights = " + ".join(f"y{k}" for k in BEADS)
    return LagrangianSystem.from_text(
        name="hanging chain",
        coordinates=[name for k in BEADS for name in place[k]],
        lagrangian=f"m*({squares})/2 - m*g*({heights})",
        parameters={"m": 1.0 / RODS, "g": 9.81, "w": WIDTH, "l": LENGTH / RODS, "c": 4.0},
        constraints=rods,
        dissipation=f"c*m*({squares})/2",
    )


system = chain()
began = perf_counter()
stepper = compile_stepper(system, "svi:1")
print(f"{system.dimension} coordinates, {len(stepper.constraints)} rods: ready in {perf_counter() - began:.1f} s")

part = np.linspace(0.0, 1.0, RODS + 1)[1:-1]
depth = np.sqrt(LENGTH**2 - WIDTH**2) * np.minimum(part, 1.0 - part)
q, p = stepper.project(np.column_stack([part * WIDTH, -depth]).ravel())
began = perf_counter()
run = stepper.integrate(q, p, h=2e-3, steps=3000, save_every=100)
print(f"{1e6 * (perf_counter() - began) / 3000:.0f} us a step")
print(f"rods are off their length by {np.abs(run.constraint_values()[0]).max():.0e}")

beads = np.vstack([[0.0, 0.0], run.q[-1].reshape(-1, 2), [WIDTH, 0.0]])
directions = np.diff(beads, axis=0)
pulls = -2.0 * run.multipliers()[-1][:, np.newaxis] * directions
print(f"sag {-beads[:, 1].min():.4f}, speed {np.abs(run.velocity[-1]).max():.0e}")
print(f"horizontal tension {pulls[:, 0].mean():.6f}, the same in all rods to {np.ptp(pulls[:, 0]):.0e}")
weight = (RODS - 1) / RODS * 9.81
print(f"the hooks carry {pulls[-1, 1] - pulls[0, 1]:.6f} of the weight {weight:.6f}")
