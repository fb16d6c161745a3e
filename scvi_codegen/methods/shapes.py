"""The shapes that stage equations have: what a solver must know of them to do without a Newton matrix.

A method says with its stage system which of these it is (:attr:`~scvi_codegen.methods.stage_system.StageSystem.shape`);
a solver says which of these it serves (:mod:`scvi_codegen.lowering.solvers.choice`). A shape is numbers of the method
alone, in 60 digits, whatever the system. Stage equations of no shape are solved by Newton's iteration.
"""

from __future__ import annotations

from dataclasses import dataclass

from scvi_codegen.methods.stage_system import Shape
from scvi_codegen.tables.precision import Matrix, Vector
from scvi_codegen.tables.quadrature import Quadrature
from scvi_codegen.tables.tableau import Tableau

__all__ = ["Accelerations", "PrintedCurve", "ShotCurve", "Velocities"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Velocities(Shape):
    """Unknown velocities V_b of a curve; positions and velocities at the points are linear in them.

        q_n = q0 + h sum_b position[n][b] V_b,    v_n = sum_b velocity[n][b] V_b,    q1 = q0 + h sum_b end[b] V_b,

    ``variational``: stationary is h sum_n weights[n] L(q_n, v_n). Otherwise the momenta at the points, which are the
    blocks, are p0 + h sum_j position[n][j] L_q, and p1 = p0 + h sum_n weights[n] L_q.

    Attributes:
        abscissae: (g,) of the points; blocks: (s,) of the velocities.
        position, velocity: (g, s); end: (s,); weights: (g,).
        variational: which of the two it is.
        unrounded: the same, where these numbers are doubles that belong together.
    """

    abscissae: Vector
    blocks: Vector
    position: Matrix
    velocity: Matrix
    end: Vector
    weights: Vector
    variational: bool
    unrounded: Velocities | None = None


@dataclass(frozen=True, slots=True)
class Accelerations(Shape):
    """Unknown accelerations at the stages of a tableau in position form, p0 and p1 being L_v at the ends (18)."""

    tableau: Tableau


@dataclass(frozen=True, slots=True)
class ShotCurve(Shape):
    """Accelerations and multipliers at the nodes of a curve, its action by a quadrature, differentiated in full."""

    tableau: Tableau
    rule: Quadrature


@dataclass(frozen=True, slots=True)
class PrintedCurve(Shape):
    """The same curve, its momenta at both ends as the paper prints them: (34a), (34d), (34e)."""

    tableau: Tableau
    rule: Quadrature
