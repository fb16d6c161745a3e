"""A flow as a function of the arrays of a framework: what of it is the same in all of them."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from scvi_codegen.errors import StateError
from scvi_codegen.frameworks.flow import Flow
from scvi_codegen.given.kinds import takes

__all__ = ["ArrayFlow", "Arrays"]


class Arrays(Protocol):
    """What a flow asks of the arrays of a framework, beside their shapes and indices."""

    def binary64(self, value: Any, name: str) -> Any:
        """An array; StateError for numbers of fewer digits, to which a flow would be rounded without a word."""

    def expanded(self, array: Any, shape: tuple[int, ...]) -> Any:
        """The array in a shape that its own fits."""

    def joined(self, parts: Sequence[Any]) -> Any:
        """(.., n) arrays, one behind the other along the last axis."""


class ArrayFlow(Flow):
    """The states of a motion, as a function that a framework differentiates."""

    @property
    @abstractmethod
    def _arrays(self) -> Arrays:
        """Those of the framework."""

    @abstractmethod
    def _along(self, x: Any) -> Any:
        """(.., kept, 2m) states of the flows from (.., given) numbers each."""

    @takes(StateError)
    def __call__(self, q: Any, p: Any, *, h: Any, t: Any = 0.0, parameters: Any = None) -> tuple[Any, Any]:
        """States at the end, or where every so-many-th is kept, at these.

        Args:
            q, p: (.., m) initial positions and momenta. Leading axes are broadcast against each other. Where there are
                constraints, states off them are taken as they are, and the first step leads to them.
            h: (..) step.
            t: (..) initial time.
            parameters: by name, (..) each, others keeping their defaults; or (.., k) in order.

        Returns:
            (q, p), (.., m) each; with ``every`` (.., n, m).

        Raises:
            StateError: for wrong shapes and names, and for anything but binary64.
            StepFailedError: if a step fails; in JAX its own error, with the time of the step.
        """
        m, values = self.stepper.dimension, self.parameter_values(parameters)
        count = len(self.stepper.parameters)
        given = (
            [self._number(value, "a parameter") for value in values]
            if isinstance(values, list)
            else [self._vector(values, count, "parameters")]
        )
        ends = [self._number(t, "t"), self._number(h, "h")]
        found = self._along(self._beside(self._vector(q, m, "q"), self._vector(p, m, "p"), *given, *ends))
        found = found if self.every else found[..., -1, :]
        return found[..., :m], found[..., m:]

    def _number(self, value: Any, name: str) -> Any:
        """(.., 1)."""
        return self._arrays.binary64(value, name)[..., None]

    def _vector(self, value: Any, length: int, name: str) -> Any:
        array = self._arrays.binary64(value, name)
        if tuple(array.shape[-1:]) != (length,):
            raise StateError(f"{name} must have shape (.., {length}), not {tuple(array.shape)}")
        return array

    def _beside(self, *parts: Any) -> Any:
        """(.., n) arrays, one behind the other."""
        try:
            batch = np.broadcast_shapes(*(tuple(part.shape[:-1]) for part in parts))
        except ValueError as error:
            raise StateError(f"the leading axes of q, p, parameters, t and h do not fit: {error}") from error
        return self._arrays.joined([self._arrays.expanded(part, (*batch, part.shape[-1])) for part in parts])
