"""Variants of a compiled method: the further C sources of one integrator, each derived on first use."""

from dataclasses import dataclass
from typing import ClassVar, Literal, TypeAlias, get_args

from scvi_codegen.systems.event import Event

Sums: TypeAlias = Literal["compensated", "plain"]
"""Sums of the increments of explicit steps: with their rounding errors, or rounded."""

SUMS: tuple[Sums, ...] = get_args(Sums)

BY_STEPS = "by steps"
"""Solver of contacts by steps alone, without stage equations, and how these treat transitions."""


@dataclass(frozen=True, slots=True)
class Variant:
    """A further C source of a method, not every method has each; its representation is part of the key in the cache.

    Attributes:
        of_known_sizes: whether arrays of run-time sizes take it from the stepper compiled with their sizes.
        of_one_word: whether double-double arithmetic lacks it; others it takes from the method in double.
    """

    of_known_sizes: ClassVar[bool] = False
    of_one_word: ClassVar[bool] = False


@dataclass(frozen=True, slots=True)
class Lanes(Variant):
    """Trajectories of an ensemble in SIMD lanes, whose numbers have this precision."""

    precision: Literal["double", "single"] = "double"


@dataclass(frozen=True, slots=True)
class NewtonFallback(Variant):
    """Newton's iteration, for steps whose fixed-point iteration does not converge."""

    of_one_word = True


@dataclass(frozen=True, slots=True)
class Derivatives(Variant):
    """Derivatives of steps with respect to all their arguments, up to the ``order`` 1 or 2."""

    of_known_sizes = True
    order: int = 1


@dataclass(frozen=True, slots=True)
class StepTerms(Variant):
    """Derivatives of the terms of contacts by steps, from which those of steps follow."""

    of_known_sizes = True


@dataclass(frozen=True, slots=True)
class Acting(Variant):
    """Runs that sum the action of their steps; ``in_lanes``: of trajectories in SIMD lanes."""

    in_lanes: bool = False


@dataclass(frozen=True, slots=True)
class TangentVectors(Variant):
    """Trajectories in SIMD lanes with ``count`` tangent vectors each."""

    of_known_sizes = True
    count: int


@dataclass(frozen=True, slots=True)
class Observing(Variant):
    """Trajectories in SIMD lanes that save functions of their states instead of the states."""

    of_one_word = True


@dataclass(frozen=True, slots=True)
class Extremes(Observing):
    """Smallest and largest positions and momenta."""


@dataclass(frozen=True, slots=True)
class Energies(Observing):
    """Smallest and largest energies."""


@dataclass(frozen=True, slots=True)
class Crossings(Observing):
    """Numbers of zero crossings of event functions, whose formulas are ``functions``."""

    functions: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class WithEvents(Variant):
    """The integrator with event detection, of a package that is loaded."""

    events: tuple[Event, ...]
