"""What the derivative of a step needs beside its program: how the kernels depend on parameters and time."""

from __future__ import annotations

from dataclasses import dataclass

from scvi_codegen.ir.families import Family
from scvi_codegen.ir.kernel import Kernel
from scvi_codegen.ir.program import Program

__all__ = ["Derivatives", "GivenSlopes"]


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
class Derivatives:
    """Steps of a program with their derivative by all they start from.

    Attributes:
        program: solved by Newton's iteration.
        by_given: one a family.
        damping: slopes of the rate of a damping, by parameters.
        lanes: changes that are carried along at a time.
    """

    program: Program
    by_given: tuple[GivenSlopes, ...]
    damping: GivenSlopes | None = None
    lanes: int = 8

    @property
    def families(self) -> tuple[tuple[Family, GivenSlopes], ...]:
        """Points with the slopes of their kernels."""
        return tuple(zip(self.program.families, self.by_given, strict=True))

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        """Those that the program lacks."""
        slopes = (*self.by_given, *((self.damping,) if self.damping else ()))
        return tuple(each.kernel for each in slopes if each.kernel)

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
            for family, given in self.families
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
        return self.slopes + wide * self.lanes
