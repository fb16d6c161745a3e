"""Array systems of run-time sizes for timing: a ring of springs, a field, a crystal and a cluster of bodies."""

from collections.abc import Mapping

import numpy as np

from benchmarks.cases.unforced import SYSTEMS, Array, Arrays, Bodies, Case
from scvi_codegen.systems.lagrangian import LagrangianSystem

SEED = 20261121
SPACING = 0.98 * 2 ** (2 / 3)
"""Lattice constant of an argon crystal in diameters of its atoms, slightly compressed."""


LONGEST = {"ring": 0.4, "field": 0.06, "bodies": 0.25, "atoms": 0.05}
"""Largest step sizes."""


def _case(
    name: str,
    q: Array,
    velocity: Array,
    span: float,
    *,
    parameters: Mapping[str, float] | None = None,
    by_hand: tuple[int, int, float] | None = None,
    bodies: Bodies | None = None,
) -> Case:
    """Return a system of the table at an initial state."""
    definition = SYSTEMS["lattices"][name]
    return Case(
        name=f"lattices:{name}:{len(q)}",
        system=LagrangianSystem.from_text(name=name, parameters=parameters, **definition),
        q=q.reshape(1, -1),
        velocity=velocity.reshape(1, -1),
        span=span,
        step=LONGEST[name],
        bodies=bodies,
        arrays=Arrays(shape=q.shape, by_hand=by_hand),
    )


def ring(count: int, span: float) -> Case:
    """Return a Fermi-Pasta-Ulam-Tsingou ring with random velocities."""
    beta, velocity = 0.25, np.random.default_rng(SEED).normal(size=count)
    return _case("ring", np.zeros(count), velocity, span, parameters={"beta": beta}, by_hand=(0, count, beta))


def field(side: int, span: float) -> Case:
    """Return the sine-Gordon equation on a torus with a smooth bump."""
    dx = 0.1
    x = dx * (np.arange(side) - side // 2)
    bump, w = 2.0 * np.exp(-(x[:, np.newaxis] ** 2 + x**2) / 4.0), 1 / dx**2
    return _case("field", bump, np.zeros((side, side)), span, parameters={"w": w}, by_hand=(1, side, w))


def bodies(count: int, span: float) -> Case:
    """Return a cluster with softened gravity."""
    e, numbers = 0.1, np.random.default_rng(SEED)
    q, velocity = numbers.normal(size=(count, 3)), 0.4 * numbers.normal(size=(count, 3))
    masses = Bodies(masses=(1 / count,) * count, gravity=1.0, fixed_centre=False, axes=3, softening=e)
    return _case("bodies", q, velocity, span, parameters={"m": 1 / count, "e": e}, bodies=masses)


def atoms(cells: int, span: float) -> Case:
    """Return a crystal of argon (face-centred cubic, free surfaces), slightly compressed, with random velocities."""
    corner = np.array([[0.0, 0, 0], [0.5, 0.5, 0], [0.5, 0, 0.5], [0, 0.5, 0.5]])
    q = SPACING * np.concatenate([corner + np.array(cell) for cell in np.ndindex(cells, cells, cells)])
    return _case("atoms", q, 0.5 * np.random.default_rng(SEED).normal(size=q.shape), span)
