"""What the derivative of a step needs beside its program: how the kernels depend on parameters and time."""

from __future__ import annotations

from dataclasses import dataclass

from scvi_codegen.ir.families import Family
from scvi_codegen.ir.kernel import Kernel
from scvi_codegen.ir.program import Program

__all__ = ["Derivatives", "GivenSlopes", "LinearClock", "SweptSlopes"]


@dataclass(frozen=True, slots=True, kw_only=True)
class GivenSlopes:
    """Non-zero slopes of the results of a family by parameters and time.

    Attributes:
        entries: (i, j) of each: the result, and the parameter, or their number for time.
        kernel: their values at u; ``None`` without any.
    """

    entries: tuple[tuple[int, int], ...]
    kernel: Kernel | None


@dataclass(frozen=True, slots=True, kw_only=True)
class LinearClock:
    """Of transformed time: how the time that a step takes, and the energy on whose level it is taken, change.

    Attributes:
        entries: of each non-zero slope of the rate of time: the argument of the first points, or, behind these, the
            parameter.
        kernel: the rate at u, then these slopes.
        level: slopes of the energy of a state by q, p and parameters, at u as of the Legendre transform.
    """

    entries: tuple[int, ...]
    kernel: Kernel
    level: Kernel


@dataclass(frozen=True, slots=True, kw_only=True)
class SweptSlopes:
    """What steps by sweeps need to carry changes and slopes by sweeps, too; entries are never empty.

    Attributes:
        slopes: what slopes have at the points, each value of them once, behind ``beside`` other values; with lanes.
        products: at u = (changes, these) their matrix times changes, and its transpose; of a potential the same twice.
        given: of forces, or behind these of momenta, with lanes.
        masses: constant ones by parameters, where they are; numbers.
        steps: that are solved before vectors are carried over them.
    """

    slopes: Kernel
    beside: int
    products: tuple[Kernel, Kernel]
    given: GivenSlopes
    masses: GivenSlopes | None = None
    steps: int = 32

    @property
    def count(self) -> int:
        """Different slopes."""
        return self.slopes.values - self.beside


@dataclass(frozen=True, slots=True, kw_only=True)
class Derivatives:
    """Steps of a program with their derivative by all they start from.

    Attributes:
        program: solved by Newton's iteration.
        by_given: one a family.
        curvatures: one a family, or none where first derivatives are all that is wanted. Of results phi and all that
            they depend on, y = (u, parameters, time): at (u, multipliers mu of phi, changes dy) the slopes of mu . phi
            by y, as they change along dy; ``None`` where phi is linear.
        damping: slopes of the rate of a damping, by parameters.
        clock: of time where it is transformed.
        swept: where its sweeps carry changes, too; ``None`` where Newton's factors do so alone.
        lanes: changes that are carried along at a time.
    """

    program: Program
    by_given: tuple[GivenSlopes, ...]
    curvatures: tuple[Kernel | None, ...] = ()
    damping: GivenSlopes | None = None
    clock: LinearClock | None = None
    swept: SweptSlopes | None = None
    lanes: int = 8

    @property
    def families(self) -> tuple[tuple[Family, GivenSlopes, Kernel | None], ...]:
        """Points with the slopes of their kernels, and what bends these, if it is wanted and not zero."""
        bends = self.curvatures or (None,) * len(self.by_given)
        return tuple(zip(self.program.families, self.by_given, bends, strict=True))

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        """Those that the program lacks."""
        given: tuple[GivenSlopes, ...] = (*self.by_given, *((self.damping,) if self.damping else ()))
        clock = (self.clock.kernel, self.clock.level) if self.clock else ()
        given += (self.swept.masses,) if self.swept and self.swept.masses else ()
        return tuple(each for each in (*(slopes.kernel for slopes in given), *self.curvatures, *clock) if each)

    @property
    def lane_kernels(self) -> tuple[Kernel, ...]:
        """Those with lanes that its sweep lacks."""
        kernels = (self.swept.slopes, self.swept.given.kernel, *self.swept.products) if self.swept else ()
        return tuple(dict.fromkeys(kernel for kernel in kernels if kernel))

    @property
    def bent(self) -> tuple[int, int]:
        """Most numbers that a kernel of second derivatives is given, and that it gives; 0 and 0 without any."""
        kernels = [each for each in self.curvatures if each]
        return max((k.arguments for k in kernels), default=0), max((k.values for k in kernels), default=0)

    @property
    def given(self) -> int:
        """Numbers that a step starts from: q0, p0, parameters, t and h."""
        return 2 * self.program.dimension + len(self.program.parameter_names) + 2

    @property
    def slopes(self) -> int:
        """Numbers at all points: by h, by arguments, by parameters and time, by a damping."""
        damped = bool(self.damping)
        return sum(
            family.points
            * (family.slope.arguments + len(family.slope.results) + len(given.entries) + damped * family.slope.values)
            for family, given, _ in self.families
        )

    @property
    def at_points(self) -> int:
        """Changes of arguments and results at the points of a family."""
        return max(family.points * (family.slope.arguments + family.slope.values) for family in self.program.families)

    @property
    def memory(self) -> int:
        """Doubles beside those of a step: slopes; changes of what is given, of unknowns, twice, of rows and points."""
        program = self.program
        wide = self.given + 2 * program.unknowns + program.sites * (program.blocks + 1) + self.at_points
        wide += bool(self.damping)  # changes of gamma h
        if self.curvatures:
            wide += 4 * self.given + 2 * program.unknowns + 3 * self.at_points
        return self.slopes + wide * self.lanes + self.places

    @property
    def kept(self) -> int:
        """Doubles behind these: of a piece of steps by sweeps how the points stand from q0, and the increments."""
        sweep = self.program.sweep
        return self.swept.steps * self.program.dimension * (sweep.lanes + 2) if self.swept and sweep else 0

    @property
    def places(self) -> int:
        """Arguments of all points of a family, the most of them, where second derivatives are wanted."""
        wanted = self.program.families if self.curvatures else ()
        return max((family.points * family.slope.arguments for family in wanted), default=0)
