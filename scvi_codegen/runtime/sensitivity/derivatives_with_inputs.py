"""Derivatives of runs with inputs: those of the pieces between breakpoints, composed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.errors import StateError
from scvi_codegen.runtime.core.validation import Array, columns_of_inputs
from scvi_codegen.runtime.sensitivity.gradients import (
    Gradient,
    backward,
    checked_cotangents,
    finite,
    forward,
    seeds_of,
    tangents_from_directions,
)
from scvi_codegen.runtime.sensitivity.hessians import checked_function, second_order_adjoints
from scvi_codegen.runtime.sensitivity.step_derivatives import LinearisedMethod
from scvi_codegen.runtime.trajectory.saved_states import SavedStates

COEFFICIENTS = 4
"""Number of coefficients of a piece of an input; its fifth parameter is the reference time, which is held fixed."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class GradientWithInputs(Gradient):
    """:class:`Gradient` of a run with inputs: NaN in ``parameters`` for those of inputs, ``h`` is ``None``.

    Attributes:
        inputs: by name, (k, 4) or (k, 4, c) derivatives with respect to the coefficients of each piece that the run
            passes, in the order of the run: ascending powers of the time since the start of the piece.
    """

    inputs: dict[str, Array]


@dataclass(frozen=True, slots=True, eq=False)
class DerivativesWithInputs:
    """Exact derivatives of the computed states of a run with inputs, at fixed step sizes and breakpoints.

    Attributes:
        pieces: trajectories between breakpoints; the first state of each is the last of the previous one.
    """

    pieces: tuple[SavedStates, ...]

    def tangent(self, directions: ArrayLike | None = None) -> Array:
        """Return (n, 2m, k) tangent vectors at the states, from (2m, k) initial directions of (q, p), by default all.

        Directions may also be (2m + parameters + 2, k), of (q, p, parameters, t, h), with zeros for the parameters of
        inputs and for h. Raises as :meth:`Trajectory.tangent`.
        """
        stepper = self._stepper
        columns = np.eye(2 * stepper.dimension) if directions is None else finite(directions, "directions")
        tangents, parts = self._initial_tangents(columns), list[Array]()
        for piece in self.pieces:
            part, tangents = forward(piece, tangents)
            parts.append(part[1:] if parts else part)
        return np.concatenate(parts).reshape(-1, 2 * stepper.dimension, *columns.shape[1:])

    def pullback(self, cotangents: ArrayLike) -> GradientWithInputs:
        """Return the gradient of a function of the states with respect to the initial data and the inputs.

        Args:
            cotangents: (n, 2m) derivatives of the function with respect to (q, p) of each state; (n, 2m, c) of c
                functions.

        Raises:
            StateError: if the shape is another, or the states are not at whole steps.
        """
        derivatives = checked_cotangents(self._stepper, self._end_indices[-1] + 1, cotangents)
        seeds = seeds_of(self._stepper, derivatives)
        now, by_pieces = np.zeros_like(seeds[0]), []
        for piece, piece_seeds in self._back(seeds):
            by_pieces.append(backward(piece, piece_seeds, self._without_inputs(now)))
            now = by_pieces[-1]
        return self._gradient(by_pieces[::-1], derivatives.shape[2:])

    def hessian_product(
        self, cotangents: ArrayLike, directions: ArrayLike, curvatures: ArrayLike | None = None
    ) -> GradientWithInputs:
        """Return the Hessian of a function of the states times directions, as :meth:`Trajectory.hessian_product`.

        Args:
            cotangents: (n, 2m) gradient of the function with respect to (q, p) of each state.
            directions: as of :meth:`tangent`.
            curvatures: (n, 2m, 2m) Hessian of the function with respect to (q, p) of each state.
        """
        derivatives, hessian_blocks = checked_function(self._stepper, self._end_indices[-1] + 1, cotangents, curvatures)
        columns = finite(directions, "directions")
        at_starts = [self._initial_tangents(columns)]
        for piece in self.pieces[:-1]:
            at_starts.append(forward(piece, at_starts[-1])[1])
        now, by_pieces = np.zeros((2, *at_starts[0].shape)), []
        backward_pieces = zip(self._back(derivatives), self._back(hessian_blocks), reversed(at_starts), strict=True)
        for (piece, piece_seeds), (_, curved), tangents in backward_pieces:
            now = second_order_adjoints(piece, piece_seeds, curved, tangents, self._without_inputs(now))
            by_pieces.append(now[1])
        return self._gradient(by_pieces[::-1], columns.shape[1:])

    @property
    def _stepper(self) -> LinearisedMethod:
        return self.pieces[0].stepper

    @property
    def _end_indices(self) -> list[int]:
        """(pieces + 1,) indices of the states at their ends."""
        return list(accumulate((len(piece) - 1 for piece in self.pieces), initial=0))

    @property
    def _input_indices(self) -> list[int]:
        """Indices of the parameters of inputs among all variables."""
        return [2 * self._stepper.dimension + k for k in columns_of_inputs(self._stepper.interface)]

    def _initial_tangents(self, directions: Array) -> Array:
        """Return (k, variables) initial variations; raise ``StateError`` if they vary inputs or h."""
        tangents = tangents_from_directions(self._stepper, directions)
        if tangents[:, [*self._input_indices, -1]].any():
            raise StateError("directions must be 0 for the parameters of inputs and for h, which are fixed with inputs")
        return tangents

    def _back(self, along: Array) -> list[tuple[SavedStates, Array]]:
        """Return the pieces in reverse with the rows of their states; a shared state belongs to the earlier piece."""
        result: list[tuple[SavedStates, Array]] = []
        for piece, (first, last) in zip(self.pieces, pairwise(self._end_indices), strict=True):
            piece_seeds = along[first : last + 1].copy()
            if result:
                piece_seeds[0] = 0.0
            result.append((piece, piece_seeds))
        return result[::-1]

    def _without_inputs(self, derivatives: Array) -> Array:
        """Return adjoints without those of inputs and h, which differ in the previous piece."""
        masked = derivatives.copy()
        masked[..., [*self._input_indices, -1]] = 0.0
        return masked

    def _gradient(self, by_pieces: Sequence[Array], shape: tuple[int, ...]) -> GradientWithInputs:
        """Construct from (k, variables) adjoints at the start of each piece."""
        stepper, m = self._stepper, self._stepper.dimension
        gradient = by_pieces[0].T.copy()
        gradient[self._input_indices] = np.nan
        gradient = gradient.reshape(stepper._input_size, *shape)
        inputs = {}
        for name in stepper.interface.inputs:
            first = stepper.parameters.index(f"{name}_0")
            began = np.array([piece.parameters[first + COEFFICIENTS] for piece in self.pieces])
            starts = np.flatnonzero(np.diff(began, prepend=np.nan))
            rows = np.stack(
                [derivatives[:, 2 * m + first : 2 * m + first + COEFFICIENTS].T for derivatives in by_pieces]
            )
            inputs[name] = np.add.reduceat(rows, starts).reshape(len(starts), COEFFICIENTS, *shape)
        return GradientWithInputs(
            q=gradient[:m],
            p=gradient[m : 2 * m],
            parameters=gradient[2 * m : -2],
            t=gradient[-2],
            h=None,
            inputs=inputs,
        )
