"""What pictures ask of a trajectory; :class:`scvi_codegen.Trajectory` and runs read from files answer it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StateError
from scvi_codegen.kinds import Kind

if TYPE_CHECKING:
    from scvi_codegen.rendering.source import Interface

__all__ = ["MOTION", "MOTIONS", "Array", "DrawnMotion", "Motions", "Mover", "column", "several"]

Array: TypeAlias = NDArray[np.float64]


class Mover(Protocol):
    """What a motion was computed by."""

    @property
    def interface(self) -> Interface:
        """Names of coordinates, parameters and momentum maps."""

    @property
    def events(self) -> Sequence[Any]:
        """Functions whose zero crossings are found."""

    def energy(self, q: Array, p: Array, t: Any, parameters: Any) -> Any:
        """(n,) energies of (n, m) states."""


class DrawnMotion(Protocol):
    """States along a run: t (n,), q (n, m), p (n, m), with step size h and parameters."""

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


Motions: TypeAlias = DrawnMotion | Sequence[DrawnMotion]
"""One, or several of the same system."""

MOTION = Kind("a trajectory", lambda value: hasattr(value, "stepper") and hasattr(value, "q"))
MOTIONS = Kind(
    "a trajectory or a list of them",
    lambda value: MOTION.holds(value) or (isinstance(value, Sequence) and all(map(MOTION.holds, value))),
)


def several(motions: Motions) -> Sequence[DrawnMotion]:
    """One or several motions as several.

    Raises:
        StateError: without any.
    """
    found = motions if isinstance(motions, Sequence) else [motions]
    if not found:
        raise StateError("there is no trajectory to draw")
    return found


def column(interface: Interface, states: Any, name: str) -> Array:
    """(n,) values of a coordinate or momentum of states with q and p (n, m).

    Raises:
        StateError: for another name.
    """
    columns = dict(zip(interface.momenta, states.p.T, strict=True))
    columns |= dict(zip(interface.coordinates, states.q.T, strict=True))
    if name not in columns:
        raise StateError(f"{name!r} is neither a coordinate nor a momentum; there are {', '.join(sorted(columns))}")
    values: Array = columns[name]
    return values
