"""The two tables of a method whose unknowns are velocities: positions from velocities, momenta from forces.

    q_n = q0 + h sum_b position[n][b] V_b,    P_b = p0 + h sum_n momentum[b][n] F_n,

with q1 and p1 by the rows ``end_position`` and ``end_momentum``. The fixed-point solvers of separable and of coupled
systems are both derived from them.
"""

from __future__ import annotations

from dataclasses import dataclass

from scvi_codegen.methods.stage_structure import Velocities
from scvi_codegen.methods.stage_system import Shape
from scvi_codegen.tables.basis import legendre_functional, matrix_product, transpose
from scvi_codegen.tables.precision import Matrix, Vector, mp

__all__ = ["VelocityTables", "resolved_degree", "tableau_tables", "velocity_tables"]

CONSISTENT = 1e-12


@dataclass(frozen=True, slots=True, kw_only=True)
class VelocityTables:
    """Tables in 60 digits.

    Attributes:
        abscissae: (g,) of the points; blocks: (s,) abscissae of the velocities.
        position: (g, s); momentum: (s, g); end_position: (s,); end_momentum: (g,).
        velocity, projection: (g, s) from the s velocities to those at the points, (s, g) back; empty if they are the
            same.
        variational: whether ``momentum`` is the adjoint of ``position``: beta_b momentum[b][n] = w_n (beta_b -
            position[n][b]) (summed over the projection, if there is one).
    """

    abscissae: Vector
    blocks: Vector
    position: Matrix
    momentum: Matrix
    end_position: Vector
    end_momentum: Vector
    velocity: Matrix
    projection: Matrix
    variational: bool


def velocity_tables(shape: Shape | None) -> VelocityTables | None:
    """Return the tables of stage equations; ``None`` for other shapes, or if velocities do not determine the curve."""
    if not isinstance(shape, Velocities):
        return None
    if shape.variational:
        return _variational_tables(shape)
    return tableau_tables(shape.abscissae, shape.position, shape.weights)


def resolved_degree(tables: VelocityTables) -> int:
    """Return the highest degree of the momenta along a step that forces reach; higher Legendre coefficients are 0.

    The momenta of a Lobatto IIIA-IIIB pair of s stages have degree s - 2. A coefficient that vanishes for all forces is
    no error estimate.
    """
    for degree in range(len(tables.blocks) - 1, 0, -1):
        (line,) = matrix_product((legendre_functional(tables.blocks, degree),), tables.momentum)
        if max(map(abs, line)) > CONSISTENT:
            return degree
    return 0


def tableau_tables(abscissae: Vector, A: Matrix, b: Vector) -> VelocityTables:
    """Return the tables of a Runge-Kutta method in phase space."""
    return VelocityTables(
        abscissae=abscissae,
        blocks=abscissae,
        position=A,
        momentum=A,
        end_position=b,
        end_momentum=b,
        velocity=(),
        projection=(),
        variational=False,
    )


def _variational_tables(shape: Velocities) -> VelocityTables | None:
    """Return the adjoint pair; if the velocities are not those at the points, with the projected equations."""
    beta, weights = shape.end, shape.weights
    if any(x == 0 for x in beta):
        return None
    rest = tuple(tuple(b - x for x in column) for b, column in zip(beta, transpose(shape.position), strict=True))
    projection: Matrix = ()
    if _is_identity(shape.velocity):
        adjoint: Matrix = tuple(tuple(x / b for x in line) for b, line in zip(beta, rest, strict=True))
    else:
        inverse = _inverse_stiffness(shape.velocity, weights)
        if inverse is None or max(abs(mp.fdot(line, beta) - 1) for line in inverse) > CONSISTENT:
            return None
        adjoint = matrix_product(inverse, rest)
        projection = _columns_scaled(matrix_product(inverse, transpose(shape.velocity)), weights)
    return VelocityTables(
        abscissae=shape.abscissae,
        blocks=shape.blocks if projection else shape.abscissae,
        position=shape.position,
        momentum=_columns_scaled(adjoint, weights),
        end_position=beta,
        end_momentum=weights,
        velocity=shape.velocity if projection else (),
        projection=projection,
        variational=True,
    )


def _is_identity(entries: Matrix) -> bool:
    square = len(entries) == len(entries[0])
    return square and all(x == int(n == b) for n, line in enumerate(entries) for b, x in enumerate(line))


def _inverse_stiffness(velocity: Matrix, weights: Vector) -> Matrix | None:
    """Return K^-1, K = l^T w l: it solves beta_b p1 = sum_n w_n (h a_nb L_q + l_nb L_v) for constant mass."""
    stiffness = mp.matrix(matrix_product(_columns_scaled(transpose(velocity), weights), velocity))
    try:
        inverse = mp.inverse(stiffness)
    except ZeroDivisionError:
        return None
    return tuple(tuple(inverse[i, j] for j in range(inverse.cols)) for i in range(inverse.rows))


def _columns_scaled(entries: Matrix, factors: Vector) -> Matrix:
    return tuple(tuple(x * w for x, w in zip(line, factors, strict=True)) for line in entries)
