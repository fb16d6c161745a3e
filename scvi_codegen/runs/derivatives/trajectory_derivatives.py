"""Derivatives of a trajectory with respect to its initial state and parameters.

With J the Jacobian of all states and F', F'' the derivatives of a function F of the states, the Hessian of F with
respect to the initial data times a direction v is J^T F'' J v plus F' contracted with the second derivative of the
states along v: tangent propagation, then second-order adjoints.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.common.errors import StateError
from scvi_codegen.runs.derivatives.gradients import (
    Gradient,
    backward,
    checked_cotangents,
    finite,
    forward,
    gradient_of,
    pieces,
    propagate,
    seeds_of,
    sensitivity,
    starts_of,
    tangents_from,
    tangents_from_directions,
)
from scvi_codegen.runs.results.recomputation import changes_by_events
from scvi_codegen.runs.results.saved_states import SavedStates
from scvi_codegen.runs.states.validation import Array, columns_of_inputs
from scvi_codegen.runs.stepping.features import require
from scvi_codegen.runs.stepping.step_derivatives import LinearisedMethod, Sensitivity, Starts
from scvi_codegen.systems.event import Crossings


def checked_function(
    stepper: LinearisedMethod, count: int, cotangents: ArrayLike, curvatures: ArrayLike | None
) -> tuple[Array, Array]:
    """Return validated (n, 2m) first and (n, 2m, 2m) second derivatives of one function of ``count`` states."""
    size, derivatives = 2 * stepper.dimension, checked_cotangents(stepper, count, cotangents)
    if derivatives.ndim == 3:
        raise StateError(f"cotangents of one function must have shape ({count}, {size}), not {derivatives.shape}")
    shape = (count, size, size)
    hessian_blocks = np.broadcast_to(0.0, shape) if curvatures is None else finite(curvatures, "curvatures")
    if hessian_blocks.shape != shape:
        raise StateError(
            f"curvatures, Hessians by (q, p) of each state, must have shape {shape}, not {hessian_blocks.shape}"
        )
    return derivatives, hessian_blocks


def second_order_adjoints(
    states: SavedStates, derivatives: Array, hessian_blocks: Array, tangents: Array, now: Array
) -> Array:
    """Return (2, k, variables) adjoints at the start and their tangents, from those ``now`` after the last state.

    Args:
        derivatives, hessian_blocks: (n, 2m) and (n, 2m, 2m) derivatives of the function.
        tangents: (k, variables) tangent vectors at the start.
        now: (2, k, variables) adjoints and their tangents after the last state.
    """
    between = list(pieces(states))
    at_starts = _tangents_at_starts(states, between, tangents)
    for (first, last), start in zip(reversed(between), reversed(at_starts), strict=True):
        starts, numbers, moved = tangents_from(states, first, last, start)
        vectors = np.zeros((len(numbers), 2, *tangents.shape))
        saved = np.flatnonzero(numbers[1:] > 0) + 1
        vectors[saved] = _seeds(derivatives[numbers[saved]], hessian_blocks[numbers[saved]], moved[saved])
        vectors[-1] += now
        states.stepper._second_order_adjoint(starts, moved, vectors, states.parameters, states.options)
        now = vectors[0]
    return np.asarray(now + _seeds(derivatives[:1], hessian_blocks[:1], tangents[np.newaxis])[0])


def _tangents_at_starts(states: SavedStates, between: list[tuple[int, int]], tangents: Array) -> list[Array]:
    tangents_at = [tangents]
    for first, last in between[:-1]:
        tangents_at.append(tangents_from(states, first, last, tangents_at[-1])[2][-1])
    return tangents_at if between else []


def _seeds(derivatives: Array, hessian_blocks: Array, moved: Array) -> Array:
    """Return (n, 2, k, variables) derivatives of F with respect to n states, and their tangents."""
    size = derivatives.shape[1]
    seeds = np.zeros((len(derivatives), 2, *moved.shape[1:]))
    seeds[:, 0, :, :size] = derivatives[:, np.newaxis]
    seeds[:, 1, :, :size] = np.einsum("nij,nkj->nki", hessian_blocks, moved[:, :, :size])
    return seeds


COEFFICIENTS = 4
"""Number of coefficients of a piece of an input; its fifth parameter is the reference time, which is held fixed."""


@dataclass(slots=True, kw_only=True, eq=False)
class TrajectoryDerivatives(SavedStates):
    """:class:`SavedStates` with the exact derivatives of the computed map at fixed step sizes.

    Derivatives require states at whole steps; states of ``t_eval`` have none. After a terminal event the size of the
    last, partial step is also held fixed: the variation of the crossing time is not included. In transformed time the
    steps of tau are fixed and the times of states vary, except the final time of a run (t_end or an event).
    """

    pieces: tuple[Self, ...]

    @property
    def _runs(self) -> tuple[Self, ...]:
        """Trajectories between the breakpoints of inputs, this one without inputs; each begins where the last ends."""
        return self.pieces or (self,)

    def _require(self, operation: str) -> None:
        """Raise the error of an operation that the stepper or the inputs of the run exclude."""
        require(self.stepper, operation, *["inputs"] * (operation == "sensitivity" and self._runs != (self,)))
        if self.stepper.by_steps:
            from scvi_codegen.runs.derivatives.mode_changes import check_modes  # here: few runs have contacts

            check_modes(self._runs)

    def tangent(self, directions: ArrayLike | None = None) -> Array:
        """Return (n, 2m, k) tangent vectors at the states, from (2m, k) initial directions of (q, p), by default all.

        They are exact derivatives of the computed states at fixed step sizes (:meth:`Stepper.jacobian`). Directions
        may also be (2m + parameters + 2, k), of (q, p, parameters, t, h), with zeros for the parameters of inputs and,
        with inputs, for h. In transformed time the energy is that of
        the first state and varies with it; a direction of the energy parameter is added.

        Raises:
            StateError: if the directions have another shape, or the states are not at whole steps.
        """
        self._require("tangent")
        size = 2 * self.stepper.dimension
        columns = np.eye(size) if directions is None else finite(directions, "directions")
        tangents, parts = self._initial_tangents(columns), list[Array]()
        for run in self._runs:
            part, tangents = forward(run, tangents)
            parts.append(part[1:] if parts else part)
        return np.concatenate(parts)[:, :size].reshape(-1, size, *columns.shape[1:])

    def sensitivity(self) -> Sensitivity:
        """Return the derivatives of all states with respect to the initial state, the parameters, t and h.

        Steps are recomputed from the saved states; derivatives are exact to round-off. For few functions of the states
        :meth:`pullback` is cheaper. In transformed time ``times`` contains the derivatives of the times. Raises as
        :meth:`tangent`.
        """
        self._require("sensitivity")
        return sensitivity(self)

    def pullback(self, cotangents: ArrayLike) -> Gradient:
        """Return the gradient of a function of the states with respect to the initial state, parameters, t and h.

        Discrete adjoint: one pass backward along the run, independent of the number of parameters, exact to round-off
        for the computed states. Steps between saved states (``save_every``) are recomputed.

        Args:
            cotangents: (n, 2m) derivatives of the function with respect to (q, p) of each state; (n, 2m, c) of c
                functions. In transformed time also (n, 2m + 1) or (n, 2m + 1, c), with those with respect to t.

        Raises:
            StateError: if the shape is another, or the states are not at whole steps.
        """
        self._require("pullback")
        derivatives = checked_cotangents(self.stepper, len(self), cotangents)
        seeds = seeds_of(self.stepper, derivatives)
        now, by_runs = np.zeros_like(seeds[0]), list[Array]()
        for run, run_seeds in self._back(seeds):
            now = backward(run, run_seeds, self._without_inputs(now))
            by_runs.append(now)
        return self._gradient(by_runs[::-1], derivatives.shape[2:])

    def hessian_product(
        self, cotangents: ArrayLike, directions: ArrayLike, curvatures: ArrayLike | None = None
    ) -> Gradient:
        """Return the Hessian of a function F of the states, with respect to the initial data, times directions.

        This is the derivative of :meth:`pullback` along the directions, exact to round-off, computed in one forward
        and one backward pass for all of them; with the identity of size 2m + k + 2 it is the whole Hessian.

        Args:
            cotangents: (n, 2m) gradient of F with respect to (q, p) of each state.
            directions: (2m,) or (2m, k) of (q, p), or (2m + parameters + 2,) or (.., k) of (q, p, parameters, t, h).
            curvatures: (n, 2m, 2m) Hessian of F with respect to (q, p) of each state; by default 0 (linear F).

        Returns:
            A :class:`Gradient` of the products, (m,) or (m, k) for q, and so on.

        Raises:
            MethodError: if time is transformed, or the system is damped.
            StateError: if a shape is another, or the states are not at whole steps.
        """
        require(self.stepper, "hessian")
        derivatives, hessian_blocks = checked_function(self.stepper, len(self), cotangents, curvatures)
        columns = finite(directions, "directions")
        at_starts = [self._initial_tangents(columns)]
        for run in self._runs[:-1]:
            at_starts.append(forward(run, at_starts[-1])[1])
        now, by_runs = np.zeros((2, *at_starts[0].shape)), list[Array]()
        backward_runs = zip(self._back(derivatives), self._back(hessian_blocks), reversed(at_starts), strict=True)
        for (part, run_seeds), (_, curved), tangents in backward_runs:
            now = second_order_adjoints(part, run_seeds, curved, tangents, self._without_inputs(now))
            by_runs.append(now[1])
        return self._gradient(by_runs[::-1], columns.shape[1:])

    def tangent_segments(self) -> Iterator[tuple[Starts, NDArray[np.intp]]]:
        """Yield the steps of segments, and (steps + 1,) indices of the saved states at their ends, -1 for others."""
        return (starts_of(self, first, last) for first, last in pieces(self))

    def propagate_tangents(self, starts: Starts, numbers: NDArray[np.intp], vectors: Array) -> None:
        """Fill (steps + 1, k, variables) tangent vectors from the first ones, and compare the steps with the run."""
        propagate(self, starts, numbers, vectors, back=False)

    def changes_by_events(self) -> Iterator[tuple[Crossings, NDArray[np.intp]]]:
        """Yield the crossings of each event that changes the state, and the rows of the states after them."""
        return changes_by_events(self)

    def tangents_at(self, tangents: Array) -> tuple[Array, Array]:
        """Return (n, outputs, k) tangent vectors at the states and (k, variables) at the end, from (k, variables)."""
        return forward(self, tangents)

    @property
    def _fixed_indices(self) -> list[int]:
        """Indices among all variables of the parameters of inputs and of h in a run with inputs; empty without."""
        if self._runs == (self,):
            return []
        return [*(2 * self.stepper.dimension + k for k in columns_of_inputs(self.stepper.interface)), -1]

    def _initial_tangents(self, directions: Array) -> Array:
        """Return (k, variables) initial variations; raise ``StateError`` if they vary inputs, or h with inputs."""
        tangents = tangents_from_directions(self.stepper, directions)
        if tangents[:, self._fixed_indices].any():
            raise StateError("directions must be 0 for the parameters of inputs and for h, which are fixed with inputs")
        return tangents

    def _back(self, along: Array) -> list[tuple[SavedStates, Array]]:
        """Return the runs in reverse with the rows of their states; a shared state belongs to the earlier run."""
        ends, result = accumulate((len(run) - 1 for run in self._runs), initial=0), list[tuple[SavedStates, Array]]()
        for run, (first, last) in zip(self._runs, pairwise(ends), strict=True):
            run_seeds = along[first : last + 1].copy()
            if result:
                run_seeds[0] = 0.0
            result.append((run, run_seeds))
        return result[::-1]

    def _without_inputs(self, derivatives: Array) -> Array:
        """Return adjoints without those of inputs and h, which differ in the previous piece."""
        masked = derivatives.copy()
        masked[..., self._fixed_indices] = 0.0
        return masked

    def _gradient(self, by_runs: Sequence[Array], shape: tuple[int, ...]) -> Gradient:
        """Construct from (k, variables) adjoints at the start of each run."""
        stepper, m = self.stepper, self.stepper.dimension
        columns = by_runs[0].T.copy()
        columns[self._fixed_indices] = np.nan
        gradient = gradient_of(self, columns.reshape(stepper._input_size, *shape))
        if not self._fixed_indices:
            return gradient
        inputs = {}
        for name in stepper.interface.inputs:
            first = stepper.interface.parameters.index(f"{name}_0")
            began = np.array([run.parameters[first + COEFFICIENTS] for run in self._runs])
            starts, piece = (
                np.flatnonzero(np.diff(began, prepend=np.nan)),
                slice(2 * m + first, 2 * m + first + COEFFICIENTS),
            )
            rows = np.stack([derivatives[:, piece].T for derivatives in by_runs])
            inputs[name] = np.add.reduceat(rows, starts).reshape(len(starts), COEFFICIENTS, *shape)
        return replace(gradient, h=None, inputs=inputs)
