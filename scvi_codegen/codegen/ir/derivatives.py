"""Derivatives of a step, besides its program: kernels of derivatives with respect to parameters and time."""

from dataclasses import dataclass

from scvi_codegen.codegen.ir.equations import LoweredStageGroup
from scvi_codegen.codegen.ir.kernel import Kernel, NumberTable
from scvi_codegen.codegen.ir.program import Program


@dataclass(frozen=True, slots=True, kw_only=True)
class InputDerivatives:
    """Nonzero derivatives of results i of a stage group by parameters j, the last one of time, as (i, j); if any."""

    entries: tuple[tuple[int, int], ...]
    kernel: Kernel | None


@dataclass(frozen=True, slots=True, kw_only=True)
class TimeDerivatives:
    """Derivatives of the time of a time-transformed step, and of the energy that is its parameter.

    Attributes:
        entries: for each nonzero derivative of the rate of time: the argument of the first points, or, after these, the
            parameter.
        kernel: the rate at u, then these derivatives.
        level: gradient of the energy of a state with respect to q, p and parameters, at u as of the Legendre transform.
    """

    entries: tuple[int, ...]
    kernel: Kernel
    level: Kernel


@dataclass(frozen=True, slots=True, kw_only=True)
class PointDerivatives:
    """Kernels of tangent and adjoint vectors by fixed-point iteration; entries are never empty.

    Attributes:
        partials: derivatives at the points, each distinct value once, after ``beside`` other values; on lanes.
        products: at u = (vectors, these) the matrix times the vectors, and its transpose; the same for a symmetric
            matrix.
        by_inputs: derivatives of forces, then momenta, with respect to parameters and time, on lanes.
        masses: derivatives of constant masses with respect to parameters, if any.
        steps: number of steps that are solved before vectors are propagated over them.
        unknowns: (B, points) table from the displacements at the points, divided by h, or from the velocities there, to
            the unknowns; empty if they do not determine these.
        in_pairs: kernels on lanes that a correction to two words evaluates: forces, or forces and momenta; integrands.
    """

    partials: Kernel
    beside: int
    products: tuple[Kernel, Kernel]
    by_inputs: InputDerivatives
    masses: InputDerivatives | None = None
    steps: int = 32
    unknowns: NumberTable = ()
    in_pairs: tuple[Kernel, ...] = ()

    @property
    def count(self) -> int:
        """Number of distinct derivatives."""
        return self.partials.values - self.beside


@dataclass(frozen=True, slots=True, kw_only=True)
class Derivatives:
    """Steps of a program with their derivatives with respect to all inputs.

    Attributes:
        program: solved by Newton's method.
        by_inputs: one per stage group.
        curvatures: second derivatives, one per stage group, or none if only first derivatives are requested. For
            results phi of y = (u, parameters, time): at (u, multipliers mu of phi, variations dy) the derivative of the
            gradient of mu . phi along dy; ``None`` if phi is linear.
        damping: derivatives of the rate of a damping with respect to parameters.
        clock: of the time of a time-transformed system.
        momenta: derivatives of the momenta of a first-order system with respect to q, y, parameters and time.
        iterated: if vectors are propagated by fixed-point iteration, too; ``None`` if only by Newton's factors.
        lanes: vectors that are propagated at a time.
    """

    program: Program
    by_inputs: tuple[InputDerivatives, ...]
    curvatures: tuple[Kernel | None, ...] = ()
    damping: InputDerivatives | None = None
    clock: TimeDerivatives | None = None
    momenta: InputDerivatives | None = None
    iterated: PointDerivatives | None = None
    lanes: int = 8

    @property
    def stage_groups(self) -> tuple[tuple[LoweredStageGroup, InputDerivatives, Kernel | None], ...]:
        """Stage groups with the derivatives of their kernels, and second derivatives, if requested and nonzero."""
        curvatures = self.curvatures or (None,) * len(self.by_inputs)
        return tuple(zip(self.program.equations.stage_groups, self.by_inputs, curvatures, strict=True))

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        """Kernels that the program lacks."""
        masses = self.iterated.masses if self.iterated else None
        partials = (*self.by_inputs, self.damping, self.momenta, masses)
        first = (derivatives.kernel for derivatives in partials if derivatives)
        clock = (self.clock.kernel, self.clock.level) if self.clock else ()
        return tuple(kernel for kernel in (*first, *self.curvatures, *clock) if kernel)

    @property
    def lane_kernels(self) -> tuple[Kernel, ...]:
        """Kernels on lanes that its fixed-point iteration lacks."""
        kernels = (
            (self.iterated.partials, self.iterated.by_inputs.kernel, *self.iterated.products) if self.iterated else ()
        )
        return tuple(dict.fromkeys(kernel for kernel in kernels if kernel))

    @property
    def curvature(self) -> tuple[int, int]:
        """Largest numbers of arguments and of values of a kernel of second derivatives; 0 and 0 without any."""
        kernels = [kernel for kernel in self.curvatures if kernel]
        return max((k.arguments for k in kernels), default=0), max((k.values for k in kernels), default=0)

    @property
    def inputs(self) -> int:
        """Number of inputs of a step: q0, p0, parameters, t and h."""
        return 2 * self.program.dimension + len(self.program.layout.parameters) + 2

    @property
    def momentum_numbers(self) -> int:
        """Number of derivatives of momenta at both ends of a step, of their factors and pivots, and of momenta."""
        m = self.program.dimension
        return 2 * len(self.momenta.entries) + m * (m + 2) if self.momenta else 0

    @property
    def partials(self) -> int:
        """Number of derivatives: at all points by h, arguments, parameters and time, a damping; of momenta."""
        damped = bool(self.damping)
        return self.momentum_numbers + sum(
            group.points
            * (
                group.derivative.arguments
                + group.derivative.values
                + group.derivative.partials
                + len(by_inputs.entries)
                + damped * group.derivative.values
            )
            for group, by_inputs, _ in self.stage_groups
        )

    @property
    def at_points(self) -> int:
        """Largest number of arguments and results at the points of a stage group."""
        return max(
            group.points * (group.derivative.arguments + group.derivative.values)
            for group in self.program.equations.stage_groups
        )

    @property
    def memory(self) -> int:
        """Doubles besides those of a step: derivatives; vectors of inputs, of unknowns (twice), of rows and points."""
        program = self.program
        wide = (
            self.inputs
            + program.equations.unknowns
            + 2 * program.equations.sites * (program.equations.blocks + 1)
            + self.at_points
        )
        wide += bool(self.damping)  # vectors of gamma h
        if self.curvatures:
            wide += 4 * self.inputs + 2 * program.equations.unknowns + 3 * self.at_points
        return self.partials + wide * self.lanes + self.places

    @property
    def kept(self) -> int:
        """Doubles after these: displacements of the points, and increments, for a block of iterated steps."""
        fixed_point = self.program.fixed_point
        return (
            self.iterated.steps * self.program.dimension * (fixed_point.lanes + 2)
            if self.iterated and fixed_point
            else 0
        )

    @property
    def places(self) -> int:
        """Largest number of arguments of all points of a stage group, if second derivatives are requested."""
        groups = self.program.equations.stage_groups if self.curvatures else ()
        return max((group.points * group.derivative.arguments for group in groups), default=0)
