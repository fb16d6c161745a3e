"""Interface of trajectories that can be plotted: :class:`scvi_codegen.Trajectory` and runs read from files."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StateError
from scvi_codegen.validation import ArgumentType

if TYPE_CHECKING:
    from scvi_codegen.rendering.source import Interface

Drawn = TypeVar("Drawn")

Array: TypeAlias = NDArray[np.float64]


class EnergyHistory(Protocol):
    """Times and energies: of a :class:`DrawnMotion` or an array system."""

    @property
    def t(self) -> Array: ...  # noqa: D102
    def energy(self) -> Array: ...  # noqa: D102


class Mover(Protocol):
    """Stepper of a trajectory, as far as plots need it."""

    @property
    def interface(self) -> Interface:
        """Names of coordinates, parameters and momentum maps."""

    @property
    def events(self) -> Sequence[Any]:
        """Event functions whose zero crossings were located."""

    def energy(self, q: Array, p: Array, t: Any, parameters: Any) -> Any:
        """Return (n,) energies of (n, m) states."""


class DrawnMotion(Protocol):
    """States of a trajectory: t (n,), q (n, m), p (n, m), with step size h and parameters."""

    @property
    def t(self) -> Array: ...  # noqa: D102
    @property
    def q(self) -> Array: ...  # noqa: D102
    @property
    def p(self) -> Array: ...  # noqa: D102
    @property
    def h(self) -> float: ...  # noqa: D102
    @property
    def parameters(self) -> Array: ...  # noqa: D102
    @property
    def events(self) -> Sequence[Any]: ...  # noqa: D102
    @property
    def stepper(self) -> Mover: ...  # noqa: D102
    def energy(self) -> Array: ...  # noqa: D102
    def momentum_errors(self) -> Array: ...  # noqa: D102
    def rotation(self, name: str) -> Array: ...  # noqa: D102
    def direction(self, name: str) -> Array: ...  # noqa: D102
    def spin(self, name: str) -> Array: ...  # noqa: D102


Motions: TypeAlias = DrawnMotion | Sequence[DrawnMotion]
"""One trajectory, or several of the same system."""

MOTION = ArgumentType("a trajectory", lambda value: hasattr(value, "stepper") and hasattr(value, "q"))


def _one_or_several(kind: ArgumentType) -> ArgumentType:
    return ArgumentType(
        f"{kind.words} or a list of them",
        lambda value: kind.accepts(value) or (isinstance(value, Sequence) and all(map(kind.accepts, value))),
    )


MOTIONS = _one_or_several(MOTION)
HISTORIES = _one_or_several(ArgumentType(MOTION.words, lambda value: hasattr(value, "t") and hasattr(value, "energy")))


def several(motions: Drawn | Sequence[Drawn]) -> Sequence[Drawn]:
    """Return one or several trajectories as a sequence.

    Raises:
        StateError: if there is none.
    """
    result = motions if isinstance(motions, Sequence) else [motions]
    if not result:
        raise StateError("there is no trajectory to draw")
    return result


def column(interface: Interface, states: Any, name: str) -> Array:
    """Return (n,) values of a coordinate or momentum of states with q and p (n, m).

    Raises:
        StateError: for another name.
    """
    columns = dict(zip(interface.momenta, states.p.T, strict=True))
    columns |= dict(zip(interface.coordinates, states.q.T, strict=True))
    if name not in columns:
        raise StateError(f"{name!r} is neither a coordinate nor a momentum; known are {', '.join(sorted(columns))}")
    values: Array = columns[name]
    return values
