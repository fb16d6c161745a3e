"""Picard iteration on the equations of a step, from a constant guess: (18) of SC and (30) of SVI in NumPy.

Both are Q = q0 + h c v0 + h^2 B f(E Q): E maps Q at the nodes to the points where forces are evaluated, the nodes
themselves for SC, and B solves for Q. Unlike the package's solvers it starts anew in each step, as the counts of the
paper do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.tables.basis import cardinal_derivatives, cardinal_values, differentiation_matrix
from scvi_codegen.tables.nodes import chebyshev_lobatto
from scvi_codegen.tables.quadrature import gauss_legendre

__all__ = ["Equations", "Force", "NotSolvedError", "galerkin", "picard_step", "spectral_collocation"]

Array = NDArray[np.float64]
Force: TypeAlias = Callable[[Array], Array]
"""Function that returns accelerations (points, m) at positions (points, m); masses are 1."""


class NotSolvedError(Exception):
    """The iteration did not converge."""


@dataclass(frozen=True, slots=True)
class Equations:
    """Step of h = 1 on nodes that end at c = 1.

    Attributes:
        c: (s,) nodes without the first, in [0, 1].
        at: (points, s + 1) matrix from positions at all nodes to those where the force is evaluated.
        solution: (s, points) B, from forces to their contribution to the positions.
        momentum: (points,) from forces to their contribution to the momentum.
    """

    c: Array
    at: Array
    solution: Array
    momentum: Array


@lru_cache(maxsize=64)
def spectral_collocation(degree: int) -> Equations:
    """Return (18) on Chebyshev nodes: A^2 Q = F(Q) - a0 v0 - (A a0) q0."""
    nodes = chebyshev_lobatto(degree).points
    inverse = np.linalg.inv(2.0 * _array(differentiation_matrix(nodes))[1:, 1:])
    return Equations(_unit(nodes), np.eye(degree + 1)[1:], inverse @ inverse, inverse[-1])


@lru_cache(maxsize=64)
def galerkin(degree: int, points: int) -> Equations:
    """Return (30) on Chebyshev nodes with Gauss points: the first s rows of the stiffness (29), solved for Q."""
    nodes, rule = chebyshev_lobatto(degree).points, gauss_legendre(points)
    weights = _array([rule.weights])[0] / 2.0
    values, derivatives = (_array(table(nodes, rule.points)) for table in (cardinal_values, cardinal_derivatives))
    stiffness = 4.0 * (derivatives.T * weights) @ derivatives
    return Equations(_unit(nodes), values, -np.linalg.solve(stiffness[:-1, 1:], (values.T * weights)[:-1]), weights)


def picard_step(
    equations: Equations, force: Force, q: Array, p: Array, *, h: float, tolerance: float, max_iterations: int
) -> tuple[Array, Array, int]:
    """Return (q, p) after a step of h, and the number of iterations until max |dQ| < tolerance.

    Raises:
        NotSolvedError: if there are more than ``max_iterations``, or numbers overflow.
    """
    line = q + h * np.outer(equations.c, p)
    positions = np.tile(q, (len(line), 1))
    for count in range(1, max_iterations + 1):
        forces = force(equations.at @ np.vstack([q, positions]))
        updated = line + h**2 * (equations.solution @ forces)
        size = np.abs(updated - positions).max()
        positions = updated
        if size < tolerance:
            forces = force(equations.at @ np.vstack([q, positions]))
            return positions[-1], p + h * (equations.momentum @ forces), count
        if not np.isfinite(size):
            break
    raise NotSolvedError


def _array(table: object) -> Array:
    return np.array(table, dtype=float)


def _unit(nodes: object) -> Array:
    return (_array([nodes])[0, 1:] + 1.0) / 2.0
