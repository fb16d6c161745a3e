"""What keeps a motion on its constraints, beside the equations of a step: projections, and the forces that do it."""

from __future__ import annotations

from dataclasses import dataclass

from scvi_codegen.ir.kernel import Kernel

__all__ = ["Constraints", "Rattle"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Rattle:
    """What steps of RATTLE need where masses are constant and diagonal.

    Attributes:
        force: L_q at u = q.
        mass: M (no arguments).
        products: (e, f) of slopes of constraints by the same coordinate.
        entries: of each product the two constraints (k, l).
    """

    force: Kernel
    mass: Kernel
    products: tuple[tuple[int, int], ...]
    entries: tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Constraints:
    """Constraints g(q, t) = 0, ``count`` of them.

    Attributes:
        formulas: for people.
        kernel: g at u = q, then the slopes g_q that are not 0.
        entries: (k, i) of these slopes.
        motion: at u = (q, v): what L_vv a is without them, m numbers; then g_q v + g_t, and what it grows by without a.
    """

    formulas: tuple[str, ...]
    kernel: Kernel
    entries: tuple[tuple[int, int], ...]
    motion: Kernel

    @property
    def count(self) -> int:
        """How many there are."""
        return len(self.formulas)
