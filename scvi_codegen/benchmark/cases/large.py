"""Large systems for timing: lattices, fields, molecules, cloth and bodies, of any size."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from scvi_codegen.benchmark.cases.unforced import Array
from scvi_codegen.mechanics.arrays.system import ArraySystem
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.mechanics.system import MechanicalSystem

SEED = 20261121
SPACING = 0.98 * 2 ** (2 / 3)
"""Lattice constant of an argon crystal in diameters of its atoms, slightly compressed."""


class Lattice(NamedTuple):
    """Problem: system and initial state, duration, largest step size to try.

    ``accelerations``: by NumPy, for SciPy's DOP853; ``by_hand``: (is a field, length of an axis, strength) for the
    hand-written C; ``tables``: index tables of bonds.
    """

    name: str
    system: ArraySystem | MechanicalSystem
    q: Array
    v: Array
    span: float
    longest: float
    accelerations: Callable[[Array], Array] | None = None
    by_hand: tuple[int, int, float] | None = None
    parameters: Mapping[str, float] = MappingProxyType({})
    tables: Mapping[str, Any] = MappingProxyType({})


def ring(count: int, span: float) -> Lattice:
    """Return a Fermi-Pasta-Ulam-Tsingou ring with random velocities."""
    beta, numbers = 0.25, np.random.default_rng(SEED)

    def accelerations(q: Array) -> Array:
        d = np.roll(q, -1) - q
        pull = d + beta * d**3
        return pull - np.roll(pull, 1)

    return Lattice(
        name="ring",
        system=LagrangianSystem.from_text(
            name="ring",
            coordinates=["q[N]"],
            parameters={"beta": beta},
            lagrangian="sum(i in N, q_dot[i]**2/2)"
            "- sum(i in N periodic, (q[i+1] - q[i])**2/2 + beta*(q[i+1] - q[i])**4/4)",
        ),
        q=np.zeros(count),
        v=numbers.normal(size=count),
        span=span,
        longest=0.4,
        accelerations=accelerations,
        by_hand=(0, count, beta),
    )


def field(side: int, span: float) -> Lattice:
    """Return the sine-Gordon equation on a torus with a smooth bump."""
    dx = 0.1
    x = dx * (np.arange(side) - side // 2)
    bump = 2.0 * np.exp(-(x[:, np.newaxis] ** 2 + x**2) / 4.0)

    def accelerations(u: Array) -> Array:
        around = sum(np.roll(u, shift, axis) for shift in (1, -1) for axis in (0, 1))
        result: Array = (around - 4.0 * u) / dx**2 - np.sin(u)
        return result

    return Lattice(
        name="field",
        system=LagrangianSystem.from_text(
            name="field",
            coordinates=["u[NX, NY]"],
            parameters={"w": 1 / dx**2},
            lagrangian="sum(i in NX periodic, j in NY periodic, u_dot[i, j]**2/2"
            "- w*((u[i+1, j] - u[i, j])**2 + (u[i, j+1] - u[i, j])**2)/2 + cos(u[i, j]))",
        ),
        q=bump,
        v=np.zeros((side, side)),
        span=span,
        longest=0.06,
        accelerations=accelerations,
        by_hand=(1, side, 1 / dx**2),
    )


def bodies(count: int, span: float) -> Lattice:
    """Return a cluster with softened gravity."""
    softening, numbers = 0.1, np.random.default_rng(SEED)

    def accelerations(r: Array) -> Array:
        d = r[np.newaxis] - r[:, np.newaxis]
        cube = (np.sum(d**2, axis=-1) + softening**2) ** -1.5
        result: Array = np.einsum("ij,ijk->ik", cube, d) / count
        return result

    return Lattice(
        name="bodies",
        system=LagrangianSystem.from_text(
            name="bodies",
            coordinates=["r[N, 3]"],
            parameters={"m": 1, "e": softening},
            lagrangian="m*sum(i in N, sum(a in 3, r_dot[i, a]**2)/2)"
            "+ m**2*sum(i < j in N, 1/sqrt(sum(a in 3, (r[i, a] - r[j, a])**2) + e**2))",
        ),
        q=numbers.normal(size=(count, 3)),
        v=0.4 * numbers.normal(size=(count, 3)),
        span=span,
        longest=0.25,
        accelerations=accelerations,
        parameters={"m": 1 / count},
    )


def atoms(cells: int, span: float) -> Lattice:
    """Return a crystal of argon (face-centred cubic, free surfaces), slightly compressed, with random velocities."""
    corner = np.array([[0.0, 0, 0], [0.5, 0.5, 0], [0.5, 0, 0.5], [0, 0.5, 0.5]])
    q = SPACING * np.concatenate([corner + np.array(cell) for cell in np.ndindex(cells, cells, cells)])

    def accelerations(r: Array) -> Array:
        d = r[np.newaxis] - r[:, np.newaxis]
        square = np.sum(d**2, axis=-1)
        np.fill_diagonal(square, np.inf)
        result: Array = -np.einsum("ij,ijk->ik", 24.0 * (2.0 * square**-7 - square**-4), d)
        return result

    return Lattice(
        name="atoms",
        system=LagrangianSystem.from_text(
            name="atoms",
            coordinates=["r[N, 3]"],
            lagrangian="sum(i in N, sum(a in 3, r_dot[i, a]**2)/2) - sum(i < j in N, "
            "4/sum(a in 3, (r[i, a] - r[j, a])**2)**6 - 4/sum(a in 3, (r[i, a] - r[j, a])**2)**3)",
        ),
        q=q,
        v=0.5 * np.random.default_rng(SEED).normal(size=q.shape),
        span=span,
        longest=0.05,
        accelerations=accelerations,
    )


def waves(count: int, span: float) -> Lattice:
    """Return a Klein-Gordon ring with on-site q^4 potential, with long waves."""
    phase = 2.0 * np.pi * np.arange(count) / count
    return Lattice(
        name="waves",
        system=LagrangianSystem.from_text(
            name="waves",
            coordinates=["q[N]"],
            lagrangian="sum(i in N, q_dot[i]**2/2 - q[i]**2/2 - q[i]**4/4)- sum(i in N periodic, (q[i+1] - q[i])**2/2)",
        ),
        q=np.sin(8.0 * phase),
        v=np.cos(3.0 * phase),
        span=span,
        longest=0.4,
    )


def breather(count: int, span: float) -> Lattice:
    """Return the breather of the sine-Gordon equation, 4 atan(k sin(w t) / (w cosh(k x))), k^2 = 1 - w^2, on a ring."""
    dx, frequency = 0.1, 0.8
    derivative = np.sqrt(1.0 - frequency**2)

    x = dx * (np.arange(count) - count // 2)
    return Lattice(
        name="breather",
        system=LagrangianSystem.from_text(
            name="breather",
            coordinates=["u[N]"],
            parameters={"w": 1 / dx**2},
            lagrangian="sum(i in N, u_dot[i]**2/2 + cos(u[i])) - w*sum(i in N periodic, (u[i+1] - u[i])**2/2)",
        ),
        q=np.zeros(count),
        v=4.0 * derivative / np.cosh(derivative * x),
        span=span,
        longest=0.06,
    )


def cloth(side: int, span: float) -> Lattice:
    """Return points on a square with springs between neighbours along both axes, slightly stretched and waving."""
    indices = np.arange(side**2).reshape(side, side)
    down, along = np.stack([indices[:-1], indices[1:]], -1), np.stack([indices[:, :-1], indices[:, 1:]], -1)
    bonds = np.concatenate([down.reshape(-1, 2), along.reshape(-1, 2)])
    x, y = (each.T for each in np.meshgrid(np.arange(side), np.arange(side)))
    q = np.stack([1.05 * x, 1.02 * y, 0.1 * np.sin(x) * np.cos(y)], axis=-1).reshape(-1, 3)
    return Lattice(
        name="cloth",
        system=LagrangianSystem.from_text(
            name="cloth",
            coordinates=["r[N, 3]"],
            parameters={"k": 100},
            tables=["bonds[B, 2]"],
            lagrangian="sum(i in N, sum(a in 3, r_dot[i, a]**2)/2)"
            "- k*sum(b in B, (sqrt(sum(a in 3, (r[bonds[b, 0], a] - r[bonds[b, 1], a])**2)) - 1)**2/2)",
        ),
        q=q,
        v=np.zeros_like(q),
        span=span,
        longest=0.04,
        tables={"bonds": bonds},
    )
