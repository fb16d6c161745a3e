"""What every fixed-point iteration declares: its kernels and tables, what it keeps, what its C is put together from."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import Enum, auto
from typing import ClassVar

from scvi_codegen.ir.kernel import IndexedSum, Kernel
from scvi_codegen.ir.numbers import Number, NumberTable

__all__ = ["GuessTables", "Kept", "Sweep", "SweepTable", "transposed"]


class Kept(Enum):
    """What a sweep keeps at the points of a step, from which the next is guessed and the error of its curve is told."""

    FORCES = auto()
    VELOCITIES = auto()
    ACCELERATIONS = auto()


@dataclass(frozen=True, slots=True)
class SweepTable:
    """A table by its name in C: numbers, one a point, or rows of them; in two parts where one is not exact enough."""

    name: str
    numbers: tuple[Number, ...] | NumberTable
    in_two_parts: bool = False

    @property
    def is_matrix(self) -> bool:
        """Whether it has rows."""
        return isinstance(self.numbers[0], tuple)


@dataclass(frozen=True, slots=True, kw_only=True)
class GuessTables:
    """(lanes, lanes) tables that continue what was kept at the points: ``last_alone``, or ``last`` and ``before``.

    Attributes:
        abscissae: where the kept values stand on a step, without padding.
        degree, highest, next: (lanes,) what gives the highest Legendre coefficient of the curve through them, and the
            one below; that is zeros where there is none.
    """

    abscissae: tuple[Number, ...]
    degree: int
    highest: tuple[Number, ...]
    next: tuple[Number, ...]
    last_alone: NumberTable
    last: NumberTable
    before: NumberTable

    @property
    def tables(self) -> Iterator[SweepTable]:
        """By their names in C."""
        yield SweepTable("LAST_ALONE", self.last_alone)
        yield SweepTable("LAST", self.last)
        yield SweepTable("BEFORE", self.before)


class Sweep(ABC):
    """A fixed-point iteration whose kernels are evaluated at points that are lanes: data, of which rendering makes C.

    Attributes:
        lanes: a power of two, that of the points or more.
        guess: of what is kept at the points.
        mass_entries: (i, j), i >= j, of the slopes of the kernel that gives the mass, if one does.
        kept: at the points of a step.
        sweeps_after: how many sweeps follow the one after which nothing moves.
        in_groups: whether its C is written for all points in one vector and for a vector a point.
    """

    __slots__ = ()

    lanes: int
    guess: GuessTables
    mass_entries: tuple[tuple[int, int], ...]
    kept: ClassVar[Kept]
    sweeps_after: ClassVar[int] = 0
    in_groups: ClassVar[bool] = True

    @property
    @abstractmethod
    def kernels(self) -> tuple[Kernel, ...]:
        """Those with lanes."""

    @property
    @abstractmethod
    def tables(self) -> Iterator[SweepTable]:
        """All, in the order in which they are printed."""

    @property
    @abstractmethod
    def parts(self) -> tuple[str, ...]:
        """What its C is put together from, in order: support headers behind those of the meaning of a lane."""

    @abstractmethod
    def memory(self, dimension: int) -> int:
        """Numbers kept from step to step."""

    def with_forces(self, forces: tuple[IndexedSum, ...]) -> Sweep | None:
        """The same with further forces L_q of positions; ``None`` where these enter in other ways, too."""
        return None

    @property
    def facts(self) -> Mapping[str, int]:
        """Macros that its parts ask for."""
        return {}

    @property
    def constant_mass(self) -> Kernel | None:
        """The masses, where they are constant and diagonal."""
        return None

    @property
    def changes_part(self) -> str:
        """The part that carries changes, and slopes back, by the same sweeps; ``""`` where Newton's factors do."""
        return ""

    @property
    def changes_tables(self) -> tuple[SweepTable, ...]:
        """What that takes beside :attr:`tables`."""
        return ()

    @property
    def damping(self) -> Kernel | None:
        """The rate of a uniform damping, a number of the parameters, where there is one."""
        return None

    @property
    def integral_part(self) -> str:
        """The part that integrates along the curve; ``""`` where nothing is integrated."""
        return ""

    @property
    def guess_through(self) -> NumberTable:
        """The table through which what is kept enters the guess; empty where it does so itself."""
        return ()

    @property
    def serves_many(self) -> bool:
        """Whether lanes may be trajectories."""
        return False

    @property
    def error_power(self) -> int:
        """Of h in the square of the displacement by the highest coefficient over that by all but a mean velocity."""
        return 2 * self.guess.degree + (0 if self.kept is Kept.VELOCITIES else 2)

    @property
    def diagonal(self) -> bool:
        """Whether the mass matrix is diagonal."""
        return all(i == j for i, j in self.mass_entries)

    @property
    def mass_part(self) -> str:
        """The part that solves with the mass."""
        return "diagonal_mass" if self.diagonal else "full_mass"


def transposed(table: NumberTable, points: int) -> NumberTable:
    """Of a padded table; lanes beyond the points neither give nor take."""
    padding = (0,) * (len(table) - points)
    columns = tuple(zip(*table[:points], strict=True))[:points]
    return (*((*column, *padding) for column in columns), *((0,) * len(table) for _ in padding))
