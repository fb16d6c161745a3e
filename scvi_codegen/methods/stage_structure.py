"""Shapes of stage equations: the structure that a solver without a Newton matrix must know.

A method states the shape of its stage system (:attr:`~scvi_codegen.methods.stage_system.StageSystem.shape`); a solver
states which shapes it supports (:mod:`scvi_codegen.lowering.program`). A shape consists of numbers of the
method, in 60 digits, independent of the system. Stage equations without a shape are solved by Newton's iteration.
"""

from __future__ import annotations

from dataclasses import dataclass

from scvi_codegen.methods.stage_system import Shape
from scvi_codegen.tables.precision import Matrix, Vector
from scvi_codegen.tables.quadrature import Quadrature
from scvi_codegen.tables.tableau import Tableau


@dataclass(frozen=True, slots=True, kw_only=True)
class Velocities(Shape):
    """Unknown velocities V_b of a curve; positions and velocities at the points are linear in them.

        q_n = q0 + h sum_b position[n][b] V_b,    v_n = sum_b velocity[n][b] V_b,    q1 = q0 + h sum_b end[b] V_b,

    If ``variational``, h sum_n weights[n] L(q_n, v_n) is stationary. Otherwise the momenta at the points, which are the
    blocks, are p0 + h sum_j position[n][j] L_q, and p1 = p0 + h sum_n weights[n] L_q.

    Attributes:
        abscissae: (g,) of the points.
        blocks: (s,) abscissae of the velocities.
        position, velocity: (g, s) matrices.
        end: (s,) vector.
        weights: (g,) vector.
        variational: whether the equations are those of a stationary action.
        unrounded: the same shape in 60 digits, if these numbers are rounded to doubles.
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
    """Unknown accelerations at the stages of a tableau in position form; p0 and p1 are L_v at the ends (18)."""

    tableau: Tableau


@dataclass(frozen=True, slots=True)
class ShotCurve(Shape):
    """Accelerations and multipliers at the nodes of a curve; momenta are total derivatives of its action (SCVI)."""

    tableau: Tableau
    rule: Quadrature


@dataclass(frozen=True, slots=True)
class PrintedCurve(Shape):
    """Accelerations at the nodes of a curve; momenta as the paper prints them: (34a), (34d), (34e)."""

    tableau: Tableau
    rule: Quadrature
