"""Sums over indices as data: which kernel is evaluated over which loops, on which entries of arrays."""

from __future__ import annotations

from dataclasses import dataclass

from scvi_codegen.indices import Access, Array, Loop
from scvi_codegen.ir.kernel import Kernel
from scvi_codegen.ir.sweeps import SeparableSweep, Splitting

__all__ = ["IndexedProgram", "IndexedSweep", "LoopedKernel"]


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopedKernel:
    """A kernel evaluated over loops.

    Attributes:
        text: what is summed, for people.
        loops: outermost first.
        slots: the coordinates that are the kernel's arguments u.
        given: the entries of arrays that are its last parameters, behind those that are numbers.
        kernel: of a potential: a value a slot, what is added to the force there; of a mass: one value, added to that of
            the only slot.
        scalar: of a potential: L itself.
    """

    text: str
    loops: tuple[Loop, ...]
    slots: tuple[Access, ...]
    given: tuple[Access, ...]
    kernel: Kernel
    scalar: Kernel | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class IndexedSweep(SeparableSweep):
    """The iteration of :class:`SeparableSweep` where forces are sums of several kernels."""

    terms: tuple[Kernel, ...]

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        """Those of the sums."""
        return self.terms

    @property
    def parts(self) -> tuple[str, ...]:
        """One."""
        return ("indexed_sweep",)

    @property
    def constant_mass(self) -> None:  # type: ignore[override]
        """Masses are sums, too."""
        return None


@dataclass(frozen=True, slots=True, kw_only=True)
class IndexedProgram:
    """An integrator of any number of coordinates, without syntax.

    Attributes:
        prefix, title, notes: of the text.
        order: of the method, for the error of its steps.
        sizes: names of the sizes of arrays.
        coordinates, fields, tables: arrays.
        parameter_names, parameter_defaults: of the numbers.
        forces, masses: loops.
        sweep: the fixed-point iteration of one coordinate, whose kernels are those of ``forces``.
        splitting: the kicks and drifts that replace it where the method is explicit.
    """

    prefix: str
    title: str
    notes: tuple[str, ...]
    order: int
    sizes: tuple[str, ...]
    coordinates: tuple[Array, ...]
    fields: tuple[Array, ...]
    tables: tuple[Array, ...]
    parameter_names: tuple[str, ...]
    parameter_defaults: tuple[float, ...]
    forces: tuple[LoopedKernel, ...]
    masses: tuple[LoopedKernel, ...]
    sweep: IndexedSweep | None
    splitting: Splitting | None
