"""Changes of the initial state carried along chains of steps: as many steps in C as leave them apart, then QR.

Within a piece the changes are what the derivatives of the steps make of an orthonormal frame; its length adapts itself,
so that these stay far enough apart for each to be known. The start is symplectic and orthonormal, columns ordered so
that R is symplectic, too, where the derivatives are (the Iwasawa decomposition): exponents are then opposite in pairs
to round-off, at all times.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.counts import checked_count
from scvi_codegen.errors import StateError, StepFailedError
from scvi_codegen.native.arguments import real_array
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.runtime.deviations import Deviations
from scvi_codegen.runtime.gradients import carry, pieces, starts_of
from scvi_codegen.runtime.inputs import Array
from scvi_codegen.runtime.integrator import Integrator
from scvi_codegen.runtime.kept_states import KeptStates
from scvi_codegen.runtime.linearised import Starts

__all__ = ["Changes", "ahead", "along"]

APART = 1e3
"""How much longer one change may grow than another within a piece: what it costs of their digits."""
FIRST, MOST = 8, 1024
"""Steps of a piece."""
SEED = 1892
"""Of the directions to begin with: in general position, the same in every run."""
NOTHING = 1e-8
"""Beside the largest singular value of a derivative: what constraints leave of the directions they forbid."""

Stretch = tuple[Starts, NDArray[np.intp]]
"""Steps that follow each other, and (steps + 1,) the number of the kept state at each of their ends, -1 where none."""


@dataclass(frozen=True, slots=True, eq=False)
class Changes:
    """The changes that a motion begins with, (2m, k) of length 1: the first of a frame in general position, or given.

    With constraints the frame is of what these allow: of the changes that a step ends with.
    """

    stepper: Integrator
    count: int | None
    directions: Array | None

    @classmethod
    def checked(cls, stepper: Integrator, count: int | None, directions: ArrayLike | None) -> Changes:
        """Raise :class:`StateError` for more than 2m, and directions of another shape, or of no length."""
        size = 2 * stepper.dimension
        if directions is None:
            wanted = None if count is None else checked_count(count, "the number of changes", least=1, most=size)
            return cls(stepper, wanted, None)
        given = real_array(directions, "directions")
        columns = given[:, np.newaxis] if given.ndim == 1 else given
        if columns.ndim != 2 or len(columns) != size or not 0 < columns.shape[1] <= size:
            raise StateError(f"directions have shape ({size},) or ({size}, k), k <= {size}, not {given.shape}")
        if count is not None:
            raise StateError("a number of changes, or directions: give one of them")
        lengths = np.linalg.norm(columns, axis=0)
        if not np.isfinite(lengths).all() or not lengths.all():
            raise StateError("directions are finite, and not 0")
        return cls(stepper, None, columns / lengths)

    def at(self, q: Array, p: Array, h: float, t: float, parameters: Array, options: SolverOptions | None) -> Array:
        """Those of a motion from (q, p) by a first step of h."""
        if self.directions is not None:
            return self.directions
        if not self.stepper.interface.constraints:
            return _frame(self.stepper.dimension)[:, : self.count]
        before = self.stepper.step(q, p, -h, t, parameters, options=options)
        ends = self.stepper.jacobian(*before, h, t - h, parameters, options=options)
        allowed, sizes, _ = np.linalg.svd(ends)
        frame = allowed[:, sizes > NOTHING * sizes[0]]
        if self.count is not None and self.count > frame.shape[1]:
            raise StateError(f"constraints leave {frame.shape[1]} independent changes of the state, not {self.count}")
        mixed, _ = np.linalg.qr(np.random.default_rng(SEED).normal(size=2 * frame.shape[1:]))
        changes: Array = (frame @ mixed)[:, : self.count]
        return changes


def _frame(dimension: int) -> Array:
    """(2m, 2m) orthonormal and symplectic: a unitary matrix, its columns ordered q_1, .., q_m, p_m, .., p_1."""
    real, imaginary = np.random.default_rng(SEED).normal(size=(2, dimension, dimension))
    unitary = np.linalg.qr(real + 1j * imaginary)[0]
    first = np.vstack([unitary.real, -unitary.imag])
    second = np.vstack([unitary.imag, unitary.real])
    return np.hstack([first, second[:, ::-1]])


def along(states: KeptStates, changes: Changes) -> Deviations:
    """Of a run, at its kept states; the steps between them are taken again."""

    def carried(steps: Starts, numbers: NDArray[np.intp], vectors: Array) -> None:
        carry(states, steps, numbers, vectors, back=False)

    first = states.q[0], states.p[0], float(states.lengths[0]), float(states.t[0])
    spreading = _Spreading(changes.at(*first, states.parameters, states.options), states.stepper.given, states.t)
    spreading.follow((starts_of(states, first, last) for first, last in pieces(states)), carried)
    return spreading.result()


def ahead(
    changes: Changes,
    q: Array,
    p: Array,
    parameters: Array,
    *,
    t: Array,
    h: float,
    every: int,
    options: SolverOptions | None,
    heed: Callable[[int], None],
) -> tuple[Deviations, StepFailedError | None]:
    """Of a motion from (q, p) by steps of h at (n + 1,) times t, told here only, at every so-many-th state.

    Args:
        heed: called before each piece, may raise.

    Returns:
        Not numbers after a step that failed, and the failure.
    """
    stepper, steps = changes.stepper, len(t) - 1

    def carried(part: Starts, numbers: NDArray[np.intp], vectors: Array) -> None:
        heed(int(numbers[-1]))
        stepper.linearise(part, vectors, parameters, options, chained=True)

    def stretches() -> Iterator[Stretch]:
        now = q, p
        for first in range(0, steps, MOST):
            last = min(first + MOST, steps)
            starts = Starts.chain(*now, t[first:last], np.full(last - first, h))
            at = np.arange(first, last + 1)
            yield starts, np.where(at % every, -1, at // every)
            now = starts.q[-1], starts.p[-1]

    spreading = _Spreading(changes.at(q, p, h, float(t[0]), parameters, options), stepper.given, t[::every])
    try:
        spreading.follow(stretches(), carried)
    except StepFailedError as failure:
        return spreading.result(), failure
    return spreading.result(), None


@dataclass(slots=True, eq=False)
class _Sums:
    """What has been summed over the steps, (k,) each."""

    lengths: Array
    stretches: Array
    moments: Array
    rates: Array
    areas: Array


class _Spreading:
    """Changes on their way: Q R of them, Q orthonormal, R with columns of length 1 and the logarithms of what they had.

    Args:
        changes: (2m, k) of length 1.
        given: numbers that a step starts from.
        t: (n,) times to keep.
    """

    def __init__(self, changes: Array, given: int, t: Array) -> None:
        count = changes.shape[1]
        self._frame, self._triangle = np.linalg.qr(changes)
        self._given, self._t, self._size = given, t, FIRST
        with np.errstate(divide="ignore"):  # directions that depend on each other span nothing
            diagonal = np.log(np.abs(np.diag(self._triangle)))
        self._sums = _Sums(np.zeros(count), diagonal, *np.zeros((3, count)))
        self._found = np.full((4, len(t), count), np.nan)
        self._found[:, 0] = [self._sums.lengths, diagonal, self._sums.rates, self._sums.rates]

    def follow(self, stretches: Iterator[Stretch], carried: Callable[[Starts, NDArray[np.intp], Array], None]) -> None:
        """To the end of the last step."""
        for starts, numbers in stretches:
            done, steps = 0, len(starts.h)
            while done < steps:
                end = min(done + self._size, steps)
                part, kept = starts.part(done, end), numbers[done : end + 1]
                vectors = np.zeros((end - done + 1, self._frame.shape[1], self._given))
                vectors[0, :, : len(self._frame)] = self._frame.T
                carried(part, kept, vectors)
                done += self._take(part, kept[1:], vectors[1:, :, : len(self._frame)].transpose(0, 2, 1))

    def result(self) -> Deviations:
        """What was found; not numbers where nothing was reached."""
        lengths, stretched, rates, mean_rates = self._found
        return Deviations(t=self._t, lengths=lengths, stretches=stretched, rates=rates, mean_rates=mean_rates)

    def _take(self, part: Starts, numbers: NDArray[np.intp], images: Array) -> int:
        """Sum over as many steps as left (2m, k) images of the frame apart, at least one: how many these are."""
        triangles = _triangles(images)
        diagonals = np.abs(np.diagonal(triangles, axis1=1, axis2=2))
        largest, least = np.abs(triangles).max(axis=(1, 2)), diagonals.min(axis=1)
        together = ~(np.maximum(largest, 1.0) <= APART * np.minimum(least, 1.0))
        taken = max(1, int(np.argmax(together))) if together.any() else len(images)
        whole = triangles[:taken] @ self._triangle
        sizes = np.linalg.norm(whole, axis=1)
        with np.errstate(divide="ignore"):  # a change that constraints do not allow vanishes
            self._sum(part, numbers[:taken], np.log(sizes), np.log(diagonals[:taken]))
        self._frame, last = np.linalg.qr(images[taken - 1])
        self._triangle = last @ self._triangle / sizes[-1]
        self._size = taken if taken < len(images) else min(2 * self._size, MOST)
        return taken

    def _sum(self, part: Starts, numbers: NDArray[np.intp], grown: Array, stretched: Array) -> None:
        """Add (steps, k) logarithms since the start of a piece; the moment of each step is taken at its middle."""
        before, now = self._sums, len(numbers)
        times = np.abs(np.append(part.t[:now], part.t[now - 1] + part.h[now - 1]) - self._t[0])[:, np.newaxis]
        lengths = np.vstack([before.lengths, before.lengths + grown])
        moments = (times[1:] + times[:-1]) / 2 * np.diff(lengths, axis=0)
        moments = before.moments + np.cumsum(moments, axis=0)
        rates = np.vstack([before.rates, 2.0 * moments / times[1:]])
        areas = before.areas + np.cumsum(np.diff(times, axis=0) * (rates[1:] + rates[:-1]) / 2, axis=0)
        stretches = before.stretches + stretched
        kept = np.flatnonzero(numbers >= 0)
        self._found[:, numbers[kept]] = [
            series[kept] for series in (lengths[1:], stretches, rates[1:], areas / times[1:])
        ]
        self._sums = _Sums(lengths[-1], stretches[-1], moments[-1], rates[-1], areas[-1])


def _triangles(images: Array) -> Array:
    """(n, k, k) the R of each of (n, 2m, k)."""
    if images.shape[2] == 1:
        triangles: Array = np.linalg.norm(images, axis=1)[:, :, np.newaxis]
    else:
        triangles = np.asarray(np.linalg.qr(images, mode="r"))
    return triangles
