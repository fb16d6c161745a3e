"""Stage equations of a step: stage groups in loops, constraints, and the data of RATTLE.

A stage group consists of points with the same kernel, and loops that gather its arguments and scatter its results.
Unknowns and rows are located at *sites*: the m coordinates, then the components of blocks of another size
(multipliers). A loop covers ``sites`` sites from the ``first`` on.
"""

from __future__ import annotations

from dataclasses import dataclass

from scvi_codegen.ir.kernel import Kernel, LoopedKernel
from scvi_codegen.ir.numbers import Number, NumberTable


@dataclass(frozen=True, slots=True, kw_only=True)
class GatherLoop:
    """Loop for arguments of a kernel: ``u[offset + i] = (q0[i] +) h^power sum_b table[n][b] z[b][first + i]``."""

    name: str
    first: int
    sites: int
    offset: int
    from_state: bool
    power: int
    table: NumberTable


@dataclass(frozen=True, slots=True, kw_only=True)
class ScatterLoop:
    """Loop for results: ``rows[r][first + i] += weight_n h^power table[n][r] value[offset + i]``; p1 is last."""

    name: str
    first: int
    sites: int
    offset: int
    power: int
    table: NumberTable


@dataclass(frozen=True, slots=True, kw_only=True)
class DerivativeBlock:
    """Nonzero derivatives of a scatter by a gather: ``derivative[first + e]`` is d value[i_e] / d u[j_e]."""

    scatter: int
    gather: int
    first: int
    entries: tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class LoweredStageGroup:
    """Stage group: points with the same kernel and the loops around it.

    Attributes:
        arguments: names of the gathers, m each.
        value, derivative: the kernel, and the kernel with its derivatives.
        integrand: summed along the curve with h^(1 + integrand_power), or ``None``: the discrete Lagrangian, or with
            forces their work and impulse.
    """

    name: str
    arguments: tuple[str, ...]
    abscissae: tuple[Number, ...]
    weights: tuple[Number, ...]
    gathers: tuple[GatherLoop, ...]
    scatters: tuple[ScatterLoop, ...]
    value: Kernel
    derivative: Kernel
    blocks: tuple[DerivativeBlock, ...]
    integrand: Kernel | None
    integrand_power: int

    @property
    def points(self) -> int:
        """Number of points."""
        return len(self.abscissae)

    @property
    def uses_time(self) -> bool:
        """True if the kernel depends on time explicitly, in its values or derivatives."""
        return self.value.uses_time or self.derivative.uses_time

    @property
    def uses_step(self) -> bool:
        """True if h occurs in the loops around the kernel."""
        powers = [loop.power for loop in self.gathers] + [loop.power for loop in self.scatters]
        return self.uses_time or any(powers)

    @property
    def scratch(self) -> int:
        """Number of arguments, values and derivatives at all points."""
        return self.points * (self.derivative.arguments + len(self.derivative.results))


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
