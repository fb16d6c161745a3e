"""Flow map as a function of the arrays of a framework."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from scvi_codegen.errors import StateError
from scvi_codegen.frameworks.flow import Flow
from scvi_codegen.validation.argument_types import checks_arguments

__all__ = ["ArrayFlow", "Arrays"]


class Arrays(Protocol):
    """Array operations of a framework that a flow needs."""

    def binary64(self, value: Any, name: str) -> Any:
        """Return an array in double precision; raise StateError for lower precision."""

    def expanded(self, array: Any, shape: tuple[int, ...]) -> Any:
        """Return the array broadcast to a shape."""

    def joined(self, parts: Sequence[Any]) -> Any:
        """Concatenate (.., n) arrays along the last axis."""


class ArrayFlow(Flow):
    """States of a trajectory as a differentiable function of a framework."""

    @property
    @abstractmethod
    def _arrays(self) -> Arrays:
        """Array operations of the framework."""

    @abstractmethod
    def _along(self, x: Any) -> Any:
        """Return (.., saved, 2m) states of the flows from (.., n) arguments each."""

    @checks_arguments(StateError)
    def __call__(self, q: Any, p: Any, *, h: Any, t: Any = 0.0, parameters: Any = None) -> tuple[Any, Any]:
        """Return the final state, or with ``save_every`` all saved states.

        Args:
            q, p: (.., m) initial positions and momenta. Leading axes are broadcast. States that violate the constraints
                are not projected; the first step moves them onto the constraint manifold.
            h: (..) step size.
            t: (..) initial time.
            parameters: by name, (..) each, others keep their defaults; or (.., k) in order.

        Returns:
            (q, p), (.., m) each; with ``save_every`` (.., n, m).

        Raises:
            StateError: for wrong shapes and names, and for anything but binary64.
            StepFailedError: if a step fails; in JAX its own error, with the time of the step.
        """
        m, values = self.stepper.dimension, self.parameter_values(parameters)
        count = len(self.stepper.parameters)
        arguments = (
            [self._number(value, "a parameter") for value in values]
            if isinstance(values, list)
            else [self._vector(values, count, "parameters")]
        )
        ends = [self._number(t, "t"), self._number(h, "h")]
        result = self._along(self._concatenated(self._vector(q, m, "q"), self._vector(p, m, "p"), *arguments, *ends))
        result = result if self.save_every else result[..., -1, :]
        return result[..., :m], result[..., m:]

    def _number(self, value: Any, name: str) -> Any:
        """Return a number as an array (.., 1)."""
        return self._arrays.binary64(value, name)[..., None]

    def _vector(self, value: Any, length: int, name: str) -> Any:
        array = self._arrays.binary64(value, name)
        if tuple(array.shape[-1:]) != (length,):
            raise StateError(f"{name} must have shape (.., {length}), not {tuple(array.shape)}")
        return array

    def _concatenated(self, *parts: Any) -> Any:
        """Broadcast (.., n) arrays and concatenate them along the last axis."""
        try:
            batch = np.broadcast_shapes(*(tuple(part.shape[:-1]) for part in parts))
        except ValueError as error:
            raise StateError(f"the leading axes of q, p, parameters, t and h cannot be broadcast: {error}") from error
        return self._arrays.joined([self._arrays.expanded(part, (*batch, part.shape[-1])) for part in parts])
