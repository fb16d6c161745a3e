"""Common interface of the fixed-point iterations: kernels, tables, stored values; adaptive step sizes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from enum import Enum, auto
from typing import Any, ClassVar

from scvi_codegen.ir.kernel import Kernel, LoopedKernel
from scvi_codegen.ir.numbers import Number, NumberTable

__all__ = [
    "AdaptivePredictor",
    "Control",
    "FixedPointIteration",
    "IterationTable",
    "PredictorTables",
    "StoredValues",
    "printed",
    "transposed",
]


class StoredValues(Enum):
    """Values at the points of a step that are stored for the predictor and the error estimate of the curve."""

    FORCES = auto()
    VELOCITIES = auto()
    ACCELERATIONS = auto()


@dataclass(frozen=True, slots=True)
class IterationTable:
    """A table by its name in C: one number per point, or rows of them; double-double if necessary."""

    name: str
    numbers: tuple[Number, ...] | NumberTable
    in_two_parts: bool = False

    @property
    def is_matrix(self) -> bool:
        """True if it has rows."""
        return isinstance(self.numbers[0], tuple)


def printed(name: str, *, in_two_parts: bool = False) -> Mapping[str, Any]:
    """Return the metadata of a field that is printed as a table of this name in C."""
    return {"name": name, "in_two_parts": in_two_parts}


@dataclass(frozen=True, slots=True, kw_only=True)
class PredictorTables:
    """(lanes, lanes) predictor tables for values at the points: ``last_alone``, or ``last`` and ``before``.

    Attributes:
        abscissae: of the stored values on a step, without padding.
        degree, highest, next: (lanes,) weights of the leading Legendre coefficient of the curve through them, and of
            the next lower one; zeros if there is none.
    """

    abscissae: tuple[Number, ...]
    degree: int
    highest: tuple[Number, ...]
    next: tuple[Number, ...]
    last_alone: NumberTable = field(metadata=printed("LAST_ALONE"))
    last: NumberTable = field(metadata=printed("LAST"))
    before: NumberTable = field(metadata=printed("BEFORE"))


class FixedPointIteration(ABC):
    """Fixed-point iteration whose kernels are evaluated at points on SIMD lanes: data, from which C is rendered.

    Attributes:
        lanes: a power of two, the number of points or more.
        guess: predictor of the stored values.
        mass_entries: (i, j), i >= j, of the derivatives of the kernel that computes the mass, if any.
        kept: values at the points of a step.
        final_iterations: number of iterations after the one that converges.
        in_groups: whether its C supports several vectors for the points of a step, besides one.
    """

    __slots__ = ()

    lanes: int
    guess: PredictorTables
    mass_entries: tuple[tuple[int, int], ...]
    kept: ClassVar[StoredValues]
    final_iterations: ClassVar[int] = 0
    in_groups: ClassVar[bool] = True

    @property
    @abstractmethod
    def kernels(self) -> tuple[Kernel, ...]:
        """Kernels that are evaluated on SIMD lanes."""

    @property
    def tables(self) -> Iterator[IterationTable]:
        """All tables, in the order in which they are printed: those of the predictor last."""
        yield from _tables(self)
        yield from _tables(self.guess)

    @property
    @abstractmethod
    def parts(self) -> tuple[str, ...]:
        """Support headers of its C, in order, after those of the meaning of a lane."""

    @abstractmethod
    def memory(self, dimension: int) -> int:
        """Return the number of doubles kept from step to step."""

    def with_forces(self, forces: tuple[LoopedKernel, ...]) -> FixedPointIteration | None:
        """Return the iteration with further forces L_q of positions; ``None`` if these also enter otherwise."""
        return None

    @property
    def facts(self) -> Mapping[str, int]:
        """Macros that its support headers require."""
        return {}

    @property
    def constant_mass(self) -> Kernel | None:
        """Kernel of the masses if they are constant and diagonal."""
        return None

    @property
    def derivatives_part(self) -> str:
        """Support header of tangent and adjoint vectors by fixed-point iteration; ``""`` if there is none."""
        return ""

    @property
    def derivatives_tables(self) -> tuple[IterationTable, ...]:
        """Tables that this header requires besides :attr:`tables`."""
        return ()

    @property
    def damping(self) -> Kernel | None:
        """Kernel of the rate of a uniform damping, a function of the parameters, if there is one."""
        return None

    @property
    def predictor_matrix(self) -> NumberTable:
        """Table between the stored values and the predicted ones; empty if they are the same."""
        return ()

    @property
    def serves_many(self) -> bool:
        """True if lanes may be trajectories."""
        return False

    @property
    def error_power(self) -> int:
        """Exponent of h in the squared leading displacement over that of the curvature (all but a mean velocity)."""
        return 2 * self.guess.degree + (0 if self.kept is StoredValues.VELOCITIES else 2)

    @property
    def diagonal(self) -> bool:
        """True if the mass matrix is diagonal."""
        return all(i == j for i, j in self.mass_entries)

    @property
    def mass_facts(self) -> Mapping[str, int]:
        """Macro DIAGONAL_MASS if the mass matrix is diagonal."""
        return {"DIAGONAL_MASS": 1} if self.diagonal else {}


def transposed(table: NumberTable, points: int) -> NumberTable:
    """Return the transpose of a padded table; lanes beyond the points remain 0."""
    padding = (0,) * (len(table) - points)
    columns = tuple(zip(*table[:points], strict=True))[:points]
    return (*((*column, *padding) for column in columns), *((0,) * len(table) for _ in padding))


def _tables(data: Any) -> Iterator[IterationTable]:
    """Yield the nonempty tables among the fields of data, and of groups of tables in them."""
    for each in fields(data):
        value = getattr(data, each.name)
        if each.metadata and value:
            yield IterationTable(numbers=value, **each.metadata)
        elif is_dataclass(value) and each.name != "guess":
            yield from _tables(value)


@dataclass(frozen=True, slots=True, kw_only=True)
class Control:
    """Adaptive steps with sizes h = 2^(k / levels), by fixed-point iteration or Newton's method; or a step density.

    Attributes:
        mantissas: 2^(k / levels) for the levels of an octave.
        predictor: predictor of the fixed-point iteration, ``None`` without one.
        stage_growth: factor of the error estimate per level for Newton's method; 0 if there is no estimate.
        density: 1/g and -d(log g)/dt at (q, v), or (q, p) of a Hamiltonian, of a time transformation g; instead of the
            predictor.
    """

    mantissas: tuple[float, ...] = ()
    predictor: AdaptivePredictor | None = None
    stage_growth: float = 0.0
    density: Kernel | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class AdaptivePredictor:
    """Predictor tables of the fixed-point iteration for varying step sizes, and the growth of the error estimate.

    Attributes:
        reach: largest change of level between successive steps.
        alone: by the change into the next step, -reach .. reach: from the last step to the next.
        last, before: by the changes into the last step and into the next: from these two steps.
        growth: factor of the error estimate per level.
    """

    reach: int
    alone: tuple[NumberTable, ...]
    last: tuple[tuple[NumberTable, ...], ...]
    before: tuple[tuple[NumberTable, ...], ...]
    growth: float
