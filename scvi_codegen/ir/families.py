"""Families of points in loops: what is gathered, which kernel is evaluated, where its results are scattered.

Unknowns and rows stand at *sites*: the m coordinates, then the components of what has another size (multipliers). A
loop is over so many ``sites`` from the ``first`` on.
"""

from __future__ import annotations

from dataclasses import dataclass

from scvi_codegen.ir.kernel import Kernel
from scvi_codegen.ir.numbers import Number, NumberTable

__all__ = ["Family", "GatherLoop", "ScatterLoop", "SlopeBlock"]


@dataclass(frozen=True, slots=True, kw_only=True)
class GatherLoop:
    """Arguments of a kernel: ``u[offset + i] = (q0[i] +) h^power sum_b table[n][b] z[b][first + i]``."""

    name: str
    first: int
    sites: int
    offset: int
    from_state: bool
    power: int
    table: NumberTable


@dataclass(frozen=True, slots=True, kw_only=True)
class ScatterLoop:
    """Results: ``rows[r][first + i] += weight_n h^power table[n][r] value[offset + i]``; p1 has the last column."""

    name: str
    first: int
    sites: int
    offset: int
    power: int
    table: NumberTable


@dataclass(frozen=True, slots=True, kw_only=True)
class SlopeBlock:
    """Non-zero slopes of a scatter by a gather: ``slope[first + e]`` is d value[i_e] / d u[j_e], i and j sites."""

    scatter: int
    gather: int
    first: int
    entries: tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Family:
    """Points of one kind with the loops around their kernel.

    Attributes:
        arguments: what the gathers give, m each.
        value, slope: the kernel, and the kernel with its derivatives.
        integrand: what is summed along the curve with h^(1 + integrand_power), or ``None``: to the discrete Lagrangian,
            or, where forces act, to what they give.
    """

    name: str
    arguments: tuple[str, ...]
    abscissae: tuple[Number, ...]
    weights: tuple[Number, ...]
    gathers: tuple[GatherLoop, ...]
    scatters: tuple[ScatterLoop, ...]
    value: Kernel
    slope: Kernel
    blocks: tuple[SlopeBlock, ...]
    integrand: Kernel | None
    integrand_power: int

    @property
    def points(self) -> int:
        """Number of points."""
        return len(self.abscissae)

    @property
    def uses_time(self) -> bool:
        """Whether the kernel depends on time explicitly (its slopes then can only do so, too)."""
        return self.value.uses_time or self.slope.uses_time

    @property
    def uses_step(self) -> bool:
        """Whether h occurs around the kernel."""
        powers = [loop.power for loop in self.gathers] + [loop.power for loop in self.scatters]
        return self.uses_time or any(powers)

    @property
    def scratch(self) -> int:
        """Arguments, values and slopes at all points."""
        return self.points * (self.slope.arguments + len(self.slope.results))
