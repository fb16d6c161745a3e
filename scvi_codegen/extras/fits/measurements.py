"""Measurements of a trajectory, and steps that end at the measurement times, with derivatives.

Between measurements the trajectory takes equal steps no longer than h. Breakpoints of inputs are also ends of steps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.api.states import Array, Fixed, checked_number, real_array
from scvi_codegen.common.errors import StateError, closest
from scvi_codegen.extras.fits.fixed_steps import tangents_along
from scvi_codegen.runs.stepper import Stepper


@dataclass(frozen=True, eq=False)
class Measurements:
    """Measurements, and the steps between them.

    Attributes:
        measured, used: (n, c) values, and mask of the values that exist.
        columns: (c,) indices of the measured quantities in (q, p) and the entries of rotations, directions and spins.
        pieces: times and sizes of the steps, grouped by pieces of the inputs.
        step_numbers: (n,) number of steps up to each measurement.
    """

    stepper: Stepper
    t: Array
    start: float
    measured: Array
    observed: tuple[str, ...]
    columns: NDArray[np.intp]
    deviations: Array
    inputs: Mapping[str, Any]
    pieces: tuple[tuple[Array, Array], ...]
    step_numbers: NDArray[np.intp]

    @classmethod
    def checked(
        cls,
        stepper: Stepper,
        t: ArrayLike,
        measured: ArrayLike,
        observed: Sequence[str] | None,
        deviations: ArrayLike | None,
        start: float | None,
        h: float,
        inputs: Mapping[str, Any],
    ) -> Measurements:
        """Construct from validated arguments of :func:`~scvi_codegen.fit`."""
        stepper.products.require("fit")
        times, values = real_array(t, "t"), real_array(measured, "measured")
        for time in times[~np.isfinite(times)]:
            checked_number(float(time), "a value in t")
        if times.ndim != 1 or not len(times) or (np.diff(times) <= 0.0).any():
            raise StateError("t must be a one-dimensional array of ascending times")
        names = distinct(observed or stepper.coordinates, "observed")
        if np.isinf(values).any():
            raise StateError("a value in measured is infinite: use NaN for missing measurements")
        values = values[:, np.newaxis] if values.ndim == 1 and len(names) == 1 else values
        if values.shape != (len(times), len(names)):
            required = f"({len(times)}, {len(names)}) for {', '.join(names)}"
            raise StateError(
                f"measured must have shape {required}, not {values.shape}; observed=[..] names its columns"
            )
        sizes = np.ones(len(names)) if deviations is None else real_array(deviations, "deviations")
        if sizes.shape not in ((), (len(names),)) or not ((sizes > 0.0) & np.isfinite(sizes)).all():
            raise StateError(f"deviations must be a positive number, or one for each of {', '.join(names)}")
        first = float(times[0]) if start is None else checked_number(start, "the time start")
        if first > times[0]:
            raise StateError(f"start = {first:g} must not be after the first measurement, at t = {times[0]:g}")
        pieces, step_numbers = _steps(first, times, Fixed.checked(h).h, inputs)
        columns = np.array([_column(stepper, name) for name in names])
        sizes = np.broadcast_to(sizes, (len(names),)).copy()
        return cls(stepper, times, first, values, names, columns, sizes, inputs, pieces, step_numbers)

    def halved(self) -> Measurements:
        """Return the measurements with half the step size."""
        pieces = tuple((np.stack([t, t + h / 2], axis=1).ravel(), np.repeat(h / 2, 2)) for t, h in self.pieces)
        return replace(self, pieces=pieces, step_numbers=2 * self.step_numbers)

    @cached_property
    def used(self) -> NDArray[np.bool_]:
        """(n, c) mask of the values that exist."""
        return np.isfinite(self.measured)

    def cut(self, count: int) -> tuple[Measurements, ...]:
        """Divide into at most n - 1 segments of about equally many measurements, each from the end of the previous."""
        firsts = np.unique(np.linspace(0, len(self.t), count, endpoint=False).astype(int))
        nodes = [0, *self.step_numbers[firsts[1:]].tolist(), int(self.step_numbers[-1])]
        return tuple(self._part(begin, end, last=end == nodes[-1]) for begin, end in pairwise(dict.fromkeys(nodes)))

    def _part(self, begin: int, end: int, *, last: bool) -> Measurements:
        """Return the measurements within the steps ``begin`` to ``end`` - 1."""
        pieces, done = [], 0
        for t, h in self.pieces:
            of = slice(max(begin - done, 0), max(end - done, 0))
            pieces.append((t[of], h[of]))
            done += len(h)
        rows = (self.step_numbers >= begin) & ((self.step_numbers < end) | last)
        steps = tuple(piece for piece in pieces if len(piece[1]))
        start = float(steps[0][0][0])
        part = replace(self, t=self.t[rows], measured=self.measured[rows], step_numbers=self.step_numbers[rows] - begin)
        return replace(part, pieces=steps, start=start)

    def motion(self, state: Array, tangents: Array, parameters: Array) -> tuple[Array, Array, Array, Array]:
        """Integrate and return the computed measurements and the final state, with derivatives.

        Returns:
            (n, c) computed values, (n, c, k) their derivatives along the (k, variables) initial variations, (2m,) final
            state, (k, variables) final variations.
        """
        done = 0
        values, derivatives = self._observed(state[np.newaxis], tangents[np.newaxis])  # where no step follows
        values, derivatives = np.tile(values, (len(self.t), 1)), np.tile(derivatives, (len(self.t), 1, 1))
        for t, h in self.pieces:
            at = self.stepper.products.parameters_at(float(t[0]) + 0.5 * float(h[0]), parameters, self.inputs)
            states, vectors, tangents = tangents_along(self.stepper, state, t, h, tangents, at)
            here = np.flatnonzero((self.step_numbers >= done) & (self.step_numbers <= done + len(h)))
            rows = self.step_numbers[here] - done
            values[here], derivatives[here] = self._observed(states[rows], vectors[rows])
            state, done = states[-1], done + len(h)
        return values, derivatives, state, tangents

    def _observed(self, states: Array, vectors: Array) -> tuple[Array, Array]:
        """Return the (n, c) measured quantities of states (n, 2m), and their (n, c, k) derivatives by vectors."""
        interface, size = self.stepper.interface, states.shape[1]
        if interface.rotations:
            observed, by_states = self.stepper.products.observables(states)
            states = np.concatenate([states, observed], axis=1)
            vectors = np.concatenate([vectors[..., :size], vectors[..., :size] @ by_states.swapaxes(1, 2)], axis=2)
        return states[:, self.columns], vectors[:, :, self.columns].transpose(0, 2, 1)


def _steps(
    start: float, t: Array, h: float, inputs: Mapping[str, Any]
) -> tuple[tuple[tuple[Array, Array], ...], NDArray[np.intp]]:
    """Return the steps to all times, split at breakpoints of inputs, and the number of steps up to each time."""
    breaks = np.concatenate([np.empty(0), *(data.breakpoints for data in inputs.values())])
    breaks = np.unique(breaks[(breaks > start) & (breaks < t[-1])])
    nodes = np.unique(np.concatenate([[start], t, breaks]))
    spans = np.diff(nodes)
    counts = Fixed(h).number_in(spans)
    ends = np.concatenate([[0], np.cumsum(counts)])
    within = np.arange(ends[-1]) - np.repeat(ends[:-1], counts)
    lengths = np.repeat(spans / counts, counts)
    starts = np.repeat(nodes[:-1], counts) + within * lengths
    cuts = ends[np.searchsorted(nodes, breaks)]
    pieces = zip(np.split(starts, cuts), np.split(lengths, cuts), strict=True)
    return tuple(piece for piece in pieces if len(piece[1])), ends[np.searchsorted(nodes, t)]


def state_names(stepper: Stepper) -> tuple[str, ...]:
    """Return the names of coordinates and momenta."""
    return (*stepper.coordinates, *stepper.interface.momenta)


def distinct(names: Sequence[str], kind: str) -> tuple[str, ...]:
    """Return the names; raise ``StateError`` if one occurs twice."""
    for k, name in enumerate(names):
        if name in names[:k]:
            raise StateError(f"{kind} names '{name}' twice")
    return tuple(names)


def _column(stepper: Stepper, name: str) -> int:
    names = (*state_names(stepper), *stepper.products.observable_names)
    if name not in names:
        raise StateError(f"'{name}' cannot be observed{closest(name, names)} Possible: {', '.join(names[:99])}")
    return names.index(name)
