"""Constraints of a program, besides the equations of a step: projections, multipliers, RATTLE."""

from __future__ import annotations

from dataclasses import dataclass

from scvi_codegen.ir.kernel import Kernel, LoopedKernel
from scvi_codegen.ir.numbers import Number, NumberTable

__all__ = ["ConstrainedSteps", "Constraints", "Rattle"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Rattle:
    """Tables of constrained steps on s + 1 Lobatto points for constant diagonal masses; RATTLE for s = 1.

    Attributes:
        force: L_q at u = q.
        mass: M (no arguments).
        products: (e, f) of derivatives of constraints with respect to the same coordinate.
        entries: of each product the two constraints (k, l).
        abscissae: (s + 1,) of the points; weights: (s + 1,), of p1 = p0 + h sum_n w_n F_n.
        start: (s,), 0 except for rounding, and momentum: (s, s), from forces at the points but the last to velocities,
            M V_b = (1 + start[b]) p0 + h sum_n momentum[n][b] F_n.
        position: (s, s) from them to the points but the first, u_i = q0 + h sum_b position[b][i] V_b.
        response: (s, s), the product of both, h^2 sum_n response[n][i] F_n / M.
    """

    force: Kernel
    mass: Kernel
    products: tuple[tuple[int, int], ...]
    entries: tuple[tuple[int, int], ...]
    abscissae: tuple[Number, ...]
    weights: tuple[Number, ...]
    start: tuple[Number, ...]
    momentum: NumberTable
    position: NumberTable
    response: NumberTable


@dataclass(frozen=True, slots=True, kw_only=True)
class Constraints:
    """Constraints g(q, t) = 0, ``count`` of them.

    Attributes:
        formulas: as text.
        kernel: g at u = q, then the nonzero derivatives g_q.
        entries: (k, i) of these derivatives.
        motion: at u = (q, v): L_vv a without constraints, m numbers; then g_q v + g_t, and the terms of its time
            derivative without a.
    """

    formulas: tuple[str, ...]
    kernel: Kernel
    entries: tuple[tuple[int, int], ...]
    motion: Kernel

    @property
    def count(self) -> int:
        """Number of constraints."""
        return len(self.formulas)


@dataclass(frozen=True, slots=True, kw_only=True)
class ConstrainedSteps:
    """Constrained steps by RATTLE.

    Attributes:
        conditions: g, g_t and the derivatives of g with respect to each slot, at every element.
        curvatures: d^2 g / dt^2 at constant velocities.
        parts: fractions of a step, each of which is a RATTLE step.
    """

    conditions: tuple[LoopedKernel, ...]
    curvatures: tuple[LoopedKernel, ...]
    parts: tuple[Number, ...]
