"""Sums over indices as data: which kernel is evaluated over which loops, on which entries of arrays."""

from __future__ import annotations

from dataclasses import dataclass

from scvi_codegen.indices import Access, Array, Loop
from scvi_codegen.ir.control import Control
from scvi_codegen.ir.kernel import Kernel
from scvi_codegen.ir.numbers import Number
from scvi_codegen.ir.sweeps import HamiltonianSweep, SeparableSweep, Splitting

__all__ = ["HeldSteps", "IndexedProgram", "LoopedKernel"]


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopedKernel:
    """A kernel evaluated over loops.

    Attributes:
        text: what is summed, for people.
        loops: outermost first.
        slots: the coordinates (for forces, velocities too) that are the kernel's arguments u.
        targets: what each value is added to; of a potential the slots.
        given: the entries of arrays that are its last parameters, behind those that are numbers.
        kernel: of a potential or a force: a value a target, what is added to the force there (of a momentum: to the
            velocity); of a mass: one value, added to that of the only target.
        scalar: of a potential: L itself.
        along: how many of the slots, the last, are those of a direction, not of the state.
    """

    text: str
    loops: tuple[Loop, ...]
    slots: tuple[Access, ...]
    targets: tuple[Access, ...]
    given: tuple[Access, ...]
    kernel: Kernel
    scalar: Kernel | None = None
    along: int = 0


@dataclass(frozen=True, slots=True, kw_only=True)
class HeldSteps:
    """Steps that constraints hold, by RATTLE.

    Attributes:
        conditions: values g, g_t and the slopes of g by each slot, at every element.
        bends: along velocities, d^2 g / dt^2 of a straight motion.
        parts: of a step, each of which is one of RATTLE.
    """

    conditions: tuple[LoopedKernel, ...]
    bends: tuple[LoopedKernel, ...]
    parts: tuple[Number, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class IndexedProgram:
    """An integrator of any number of coordinates, without syntax.

    Attributes:
        prefix, title, notes: of the text.
        order: of the method, for the error of its steps.
        sizes: names of the sizes of arrays.
        coordinates, fields, tables: arrays.
        momenta: of a Hamiltonian, behind the coordinates in the state.
        velocities: on which forces depend, behind the coordinates at the points.
        parameter_names, parameter_defaults: of the numbers.
        forces, masses: loops.
        constants: terms of L, or of -H, without coordinates and momenta, which the energy needs.
        sweep: the fixed-point iteration of one coordinate, of which the tables serve all; ``forces`` are its kernels.
        splitting: the kicks and drifts that replace it where the method is explicit.
        held: what replaces both where there are constraints.
        control: steps that choose their length, if they are wanted.
        products, diagonals: the derivatives of the forces times a direction, and their diagonals, where Newton's
            iteration takes the place of the sweeps.
        reach: of these, how far they couple places of lattices; 0 where they do not, or not at constant distances.
    """

    prefix: str
    title: str
    notes: tuple[str, ...]
    order: int
    sizes: tuple[str, ...]
    coordinates: tuple[Array, ...]
    momenta: tuple[Array, ...]
    velocities: tuple[Array, ...]
    fields: tuple[Array, ...]
    tables: tuple[Array, ...]
    parameter_names: tuple[str, ...]
    parameter_defaults: tuple[float, ...]
    forces: tuple[LoopedKernel, ...]
    masses: tuple[LoopedKernel, ...]
    constants: tuple[LoopedKernel, ...]
    sweep: SeparableSweep | HamiltonianSweep | None
    splitting: Splitting | None
    control: Control | None = None
    held: HeldSteps | None = None
    products: tuple[LoopedKernel, ...] = ()
    diagonals: tuple[LoopedKernel, ...] = ()
    reach: int = 0

    @property
    def error_power(self) -> int:
        """The power of h with which what a curve leaves unresolved goes; 0 where it tells nothing."""
        return 0 if self.sweep is None or (self.velocities and self.sweep.points == 1) else self.sweep.error_power
