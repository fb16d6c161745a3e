"""Stage groups in loops: gather of arguments, kernel evaluation, scatter of results.

Unknowns and rows are located at *sites*: the m coordinates, then the components of blocks of another size
(multipliers). A loop covers ``sites`` sites from the ``first`` on.
"""

from __future__ import annotations

from dataclasses import dataclass

from scvi_codegen.ir.kernel import Kernel
from scvi_codegen.ir.numbers import Number, NumberTable

__all__ = ["DerivativeBlock", "GatherLoop", "LoweredStageGroup", "ScatterLoop"]


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
