"""Indexed systems as data: kernels, their loops, and the entries of arrays that they read and write."""

from __future__ import annotations

from dataclasses import dataclass

from scvi_codegen.indices import Array
from scvi_codegen.ir.control import Control
from scvi_codegen.ir.iterations import HamiltonianIteration, SeparableIteration, Splitting
from scvi_codegen.ir.kernel import LoopedKernel
from scvi_codegen.ir.numbers import Number

__all__ = ["ConstrainedSteps", "IndexedProgram"]


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


@dataclass(frozen=True, slots=True, kw_only=True)
class IndexedProgram:
    """Intermediate representation of the integrator of an indexed system.

    Attributes:
        prefix, title, notes: of the source.
        order: of the method, for the error of its steps.
        sizes: names of the sizes of arrays.
        coordinates, fields, tables: arrays.
        momenta: of a Hamiltonian, after the coordinates in the state.
        velocities: on which forces depend, after the coordinates at the points.
        parameter_names, parameter_defaults: of the numbers.
        forces, masses: loops.
        constants: terms of L, or of -H, without coordinates and momenta, which the energy needs.
        iteration: the fixed-point iteration of one coordinate, whose tables serve all; ``forces`` are its kernels.
        splitting: the kicks and drifts of an explicit method, instead.
        held: constrained steps, instead of both.
        control: adaptive steps, if requested.
        products, diagonals: the Jacobian of the forces times a direction, and its diagonal, if Newton's method replaces
            the fixed-point iteration.
        reach: largest distance of lattice places that these couple; 0 if none, or if distances are not constant.
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
    fixed_point: SeparableIteration | HamiltonianIteration | None
    splitting: Splitting | None
    control: Control | None = None
    held: ConstrainedSteps | None = None
    products: tuple[LoopedKernel, ...] = ()
    diagonals: tuple[LoopedKernel, ...] = ()
    reach: int = 0

    @property
    def error_power(self) -> int:
        """Exponent of h in the error estimate of a curve; 0 if there is no estimate."""
        return (
            0
            if self.fixed_point is None or (self.velocities and self.fixed_point.points == 1)
            else self.fixed_point.error_power
        )
