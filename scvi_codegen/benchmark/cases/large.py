"""Array systems of any size for timing: a ring of springs, a field, a crystal and a cluster of bodies."""

from typing import Any

import numpy as np

from scvi_codegen.benchmark.cases.unforced import Array, Arrays, Bodies, Case
from scvi_codegen.mechanics.lagrangian import LagrangianSystem

SEED = 20261121
SPACING = 0.98 * 2 ** (2 / 3)
"""Lattice constant of an argon crystal in diameters of its atoms, slightly compressed."""


def _case(
    name: str,
    q: Array,
    velocity: Array,
    span: float,
    longest: float,
    by_hand: tuple[int, int, float] | None = None,
    bodies: Bodies | None = None,
    **definition: Any,
) -> Case:
    return Case(
        name=f"lattices:{name}:{len(q)}",
        system=LagrangianSystem.from_text(name=name, **definition),
        q=q.reshape(1, -1),
        velocity=velocity.reshape(1, -1),
        span=span,
        step=longest,
        bodies=bodies,
        arrays=Arrays(shape=q.shape, by_hand=by_hand),
    )


def ring(count: int, span: float) -> Case:
    """Return a Fermi-Pasta-Ulam-Tsingou ring with random velocities."""
    beta, numbers = 0.25, np.random.default_rng(SEED)

    return _case(
        "ring",
        coordinates=["q[N]"],
        parameters={"beta": beta},
        lagrangian="sum(i in N, q_dot[i]**2/2)- sum(i in N periodic, (q[i+1] - q[i])**2/2 + beta*(q[i+1] - q[i])**4/4)",
        q=np.zeros(count),
        velocity=numbers.normal(size=count),
        span=span,
        longest=0.4,
        by_hand=(0, count, beta),
    )


def field(side: int, span: float) -> Case:
    """Return the sine-Gordon equation on a torus with a smooth bump."""
    dx = 0.1
    x = dx * (np.arange(side) - side // 2)
    bump = 2.0 * np.exp(-(x[:, np.newaxis] ** 2 + x**2) / 4.0)

    return _case(
        "field",
        coordinates=["u[NX, NY]"],
        parameters={"w": 1 / dx**2},
        lagrangian="sum(i in NX periodic, j in NY periodic, u_dot[i, j]**2/2"
        "- w*((u[i+1, j] - u[i, j])**2 + (u[i, j+1] - u[i, j])**2)/2 + cos(u[i, j]))",
        q=bump,
        velocity=np.zeros((side, side)),
        span=span,
        longest=0.06,
        by_hand=(1, side, 1 / dx**2),
    )


def bodies(count: int, span: float) -> Case:
    """Return a cluster with softened gravity."""
    softening, numbers = 0.1, np.random.default_rng(SEED)

    return _case(
        "bodies",
        coordinates=["r[N, 3]"],
        parameters={"m": 1 / count, "e": softening},
        lagrangian="m*sum(i in N, sum(a in 3, r_dot[i, a]**2)/2)"
        "+ m**2*sum(i < j in N, 1/sqrt(sum(a in 3, (r[i, a] - r[j, a])**2) + e**2))",
        q=numbers.normal(size=(count, 3)),
        velocity=0.4 * numbers.normal(size=(count, 3)),
        span=span,
        longest=0.25,
        bodies=Bodies(masses=(1 / count,) * count, gravity=1.0, fixed_centre=False, axes=3, softening=softening),
    )


def atoms(cells: int, span: float) -> Case:
    """Return a crystal of argon (face-centred cubic, free surfaces), slightly compressed, with random velocities."""
    corner = np.array([[0.0, 0, 0], [0.5, 0.5, 0], [0.5, 0, 0.5], [0, 0.5, 0.5]])
    q = SPACING * np.concatenate([corner + np.array(cell) for cell in np.ndindex(cells, cells, cells)])

    return _case(
        "atoms",
        coordinates=["r[N, 3]"],
        lagrangian="sum(i in N, sum(a in 3, r_dot[i, a]**2)/2) - sum(i < j in N, "
        "4/sum(a in 3, (r[i, a] - r[j, a])**2)**6 - 4/sum(a in 3, (r[i, a] - r[j, a])**2)**3)",
        q=q,
        velocity=0.5 * np.random.default_rng(SEED).normal(size=q.shape),
        span=span,
        longest=0.05,
    )
