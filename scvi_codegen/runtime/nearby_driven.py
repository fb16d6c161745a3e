"""Derivatives of runs whose inputs are data: those of its pieces, one behind the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.errors import StateError
from scvi_codegen.runtime.gradients import (
    Gradient,
    backward,
    changes_of,
    checked_slopes,
    finite,
    forward,
    seeds_of,
)
from scvi_codegen.runtime.hessians import bent_back, checked_function
from scvi_codegen.runtime.inputs import Array, columns_of_inputs
from scvi_codegen.runtime.kept_states import KeptStates
from scvi_codegen.runtime.linearised import LinearisedMethod

__all__ = ["DrivenGradient", "NearbyDrivenMotions"]

COEFFICIENTS = 4
"""Of a piece of an input; its fifth parameter is the time from which they count, which is held."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class DrivenGradient(Gradient):
    """A :class:`Gradient` of a run with inputs: ``parameters`` has not numbers for those of inputs, ``h`` is ``None``.

    Attributes:
        inputs: by the name of each, (k, 4) or (k, 4, c) slopes by its coefficients in each of its pieces that the run
            goes through, in the order of the run: of powers of the time since the piece began, ascending.
    """

    inputs: dict[str, Array]


@dataclass(frozen=True, slots=True, eq=False)
class NearbyDrivenMotions:
    """The exact derivatives of the computed states of a run with inputs, lengths of steps and breakpoints held.

    Attributes:
        pieces: from breakpoint to breakpoint, the first state of each the last of the one before.
    """

    pieces: tuple[KeptStates, ...]

    def tangent(self, directions: ArrayLike | None = None) -> Array:
        """(n, 2m, k) what becomes of (2m, k) directions of (q, p) at the first state; all 2m without any.

        Directions may be (2m + parameters + 2, k), too, of (q, p, parameters, t, h), with zeros for parameters of
        inputs and for h. Raises as :meth:`Trajectory.tangent`.
        """
        stepper = self._stepper
        given = np.eye(2 * stepper.dimension) if directions is None else finite(directions, "directions")
        changes, found = self._changes(given), list[Array]()
        for piece in self.pieces:
            part, changes = forward(piece, changes)
            found.append(part[1:] if found else part)
        return np.concatenate(found).reshape(-1, 2 * stepper.dimension, *given.shape[1:])

    def pullback(self, cotangents: ArrayLike) -> DrivenGradient:
        """The gradient of a function of the states, by what the run started from, and by what its inputs are.

        Args:
            cotangents: (n, 2m) slopes of the function by (q, p) of each state; (n, 2m, c) of c functions.

        Raises:
            StateError: for another shape, and states that do not stand at whole steps.
        """
        slopes = checked_slopes(self._stepper, self._places[-1] + 1, cotangents)
        seeds = seeds_of(self._stepper, slopes)
        now, by_pieces = np.zeros_like(seeds[0]), []
        for piece, own in self._back(seeds):
            by_pieces.append(backward(piece, own, self._without_inputs(now)))
            now = by_pieces[-1]
        return self._gradient(by_pieces[::-1], slopes.shape[2:])

    def hessian_product(
        self, cotangents: ArrayLike, directions: ArrayLike, curvatures: ArrayLike | None = None
    ) -> DrivenGradient:
        """The Hessian of a function of the states times directions: as :meth:`Trajectory.hessian_product`.

        Args:
            cotangents: (n, 2m) slopes of the function by (q, p) of each state.
            directions: as of :meth:`tangent`.
            curvatures: (n, 2m, 2m) its second slopes by (q, p) of each state.
        """
        slopes, bends = checked_function(self._stepper, self._places[-1] + 1, cotangents, curvatures)
        given = finite(directions, "directions")
        at_starts = [self._changes(given)]
        for piece in self.pieces[:-1]:
            at_starts.append(forward(piece, at_starts[-1])[1])
        now, by_pieces = np.zeros((2, *at_starts[0].shape)), []
        backward_pieces = zip(self._back(slopes), self._back(bends), reversed(at_starts), strict=True)
        for (piece, own), (_, curved), changes in backward_pieces:
            now = bent_back(piece, own, curved, changes, self._without_inputs(now))
            by_pieces.append(now[1])
        return self._gradient(by_pieces[::-1], given.shape[1:])

    @property
    def _stepper(self) -> LinearisedMethod:
        return self.pieces[0].stepper

    @property
    def _places(self) -> list[int]:
        """(pieces + 1,) numbers of the states at their ends."""
        return list(accumulate((len(piece) - 1 for piece in self.pieces), initial=0))

    @property
    def _columns(self) -> list[int]:
        """Where parameters of inputs stand among all that is given."""
        return [2 * self._stepper.dimension + k for k in columns_of_inputs(self._stepper.interface)]

    def _changes(self, directions: Array) -> Array:
        """(k, given) at the start; StateError for changes of data."""
        changes = changes_of(self._stepper, directions)
        if changes[:, [*self._columns, -1]].any():
            raise StateError("inputs and the lengths of steps are data of a driven run: directions are 0 there")
        return changes

    def _back(self, along: Array) -> list[tuple[KeptStates, Array]]:
        """Pieces from the last on, with what belongs to their states; what is between two, to the earlier one."""
        found: list[tuple[KeptStates, Array]] = []
        for piece, (first, last) in zip(self.pieces, pairwise(self._places), strict=True):
            own = along[first : last + 1].copy()
            if found:
                own[0] = 0.0
            found.append((piece, own))
        return found[::-1]

    def _without_inputs(self, slopes: Array) -> Array:
        """Slopes behind a piece, as the one before it has other inputs and lengths."""
        kept = slopes.copy()
        kept[..., [*self._columns, -1]] = 0.0
        return kept

    def _gradient(self, by_pieces: Sequence[Array], shape: tuple[int, ...]) -> DrivenGradient:
        """From (k, given) slopes at the start of each piece."""
        stepper, m = self._stepper, self._stepper.dimension
        found = by_pieces[0].T.copy()
        found[self._columns] = np.nan
        found = found.reshape(stepper.given, *shape)
        inputs = {}
        for name in stepper.interface.inputs:
            first = stepper.parameters.index(f"{name}_0")
            began = np.array([piece.parameters[first + COEFFICIENTS] for piece in self.pieces])
            starts = np.flatnonzero(np.diff(began, prepend=np.nan))
            rows = np.stack([slopes[:, 2 * m + first : 2 * m + first + COEFFICIENTS].T for slopes in by_pieces])
            inputs[name] = np.add.reduceat(rows, starts).reshape(len(starts), COEFFICIENTS, *shape)
        return DrivenGradient(
            q=found[:m], p=found[m : 2 * m], parameters=found[2 * m : -2], t=found[-2], h=None, inputs=inputs
        )
