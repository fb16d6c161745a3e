"""Propagation of tangent vectors along chains of steps with QR factorisations.

Within a chunk the derivatives of the steps act on an orthonormal frame; the length of chunks is adapted so that the
images remain well conditioned. The initial frame is orthogonal and symplectic with ordered columns, so that R is
symplectic if the derivatives are (Iwasawa decomposition); Lyapunov exponents then occur in pairs of opposite sign to
round-off, at all times.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.errors import StateError
from scvi_codegen.native.arguments import real_array
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.runtime.chaos.growth import Growth, ill_conditioned, r_factors
from scvi_codegen.runtime.chaos.indicators import ChaosIndicators
from scvi_codegen.runtime.core.features import require
from scvi_codegen.runtime.core.integrator import Integrator
from scvi_codegen.runtime.core.validation import Array
from scvi_codegen.runtime.rotations.reduction import Reduction
from scvi_codegen.runtime.sensitivity.gradients import pieces, propagate, starts_of
from scvi_codegen.runtime.sensitivity.step_derivatives import Starts
from scvi_codegen.runtime.trajectory.saved_states import SavedStates
from scvi_codegen.validation import checked_count

FIRST, MOST = 8, 1024
"""Number of steps of the first and of the largest chunk."""
SEED = 1892
"""Random seed of the initial directions, for reproducibility."""
FORBIDDEN = 1e-8
"""Singular values below this fraction of the largest are directions forbidden by constraints."""
INADMISSIBLE = 1e-6
"""Largest component of given directions outside those admissible for the constraints."""

StepSegment = tuple[Starts, NDArray[np.intp]]
"""Consecutive steps, and (steps + 1,) indices of saved states at their ends, -1 if not saved."""


@dataclass(frozen=True, slots=True, eq=False)
class InitialTangents:
    """Initial tangent vectors, (size, k) of length 1: the first of a random frame, or given directions.

    Vectors have 2m entries, with rotations those of the reduced space, without gauge directions
    (:mod:`scvi_codegen.runtime.rotations.reduction`). With constraints the frame spans the admissible directions, the
    range of the derivative of a step.

    Attributes:
        directions: (2m, k) directions of (q, p), or ``None``.
        reduction: maps to the reduced space, ``None`` without rotations.
    """

    stepper: Integrator
    count: int | None
    directions: Array | None
    reduction: Reduction | None

    @classmethod
    def checked(cls, stepper: Integrator, count: int | None, directions: ArrayLike | None) -> InitialTangents:
        """Construct from user arguments; raise :class:`StateError` for invalid numbers or directions."""
        size = 2 * stepper.dimension
        require(stepper, "chaos")
        reduction = Reduction(stepper.interface) if stepper.interface.rotations else None
        if directions is None:
            most = reduction.size if reduction else size
            wanted = None if count is None else checked_count(count, "count", least=1, most=most)
            return cls(stepper, wanted, None, reduction)
        array = real_array(directions, "directions")
        columns = array[:, np.newaxis] if array.ndim == 1 else array
        if columns.ndim != 2 or len(columns) != size or not 0 < columns.shape[1] <= size:
            raise StateError(f"directions must have shape ({size},) or ({size}, k), k <= {size}, not {array.shape}")
        if count is not None:
            raise StateError("give either count or directions, not both")
        lengths = np.linalg.norm(columns, axis=0)
        if not np.isfinite(lengths).all() or not lengths.all():
            raise StateError("directions must be finite and not 0")
        return cls(stepper, None, columns / lengths, reduction)

    @property
    def size(self) -> int:
        """Number of entries of a tangent vector."""
        return self.reduction.size if self.reduction else 2 * self.stepper.dimension

    def entering(self, vectors: Array, q: Array, p: Array) -> Array:
        """Return (2m, k) changes of (q, p) of tangent vectors at a state."""
        return vectors if self.reduction is None else np.asarray(self.reduction.inward(q, p) @ vectors)

    def leaving(self, changes: Array, q: Array, p: Array) -> Array:
        """Return the (.., size, k) tangent vectors of (.., 2m, k) changes of (q, p) at (.., m) states."""
        return changes if self.reduction is None else np.asarray(self.reduction.outward(q, p) @ changes)

    def at(self, q: Array, p: Array, h: float, t: float, parameters: Array, options: SolverOptions | None) -> Array:
        """Return the tangent vectors at (q, p) for a first step of h."""
        directions = None if self.directions is None else self.leaving(self.directions, q, p)
        if self.reduction is not None and directions is not None:
            lengths = np.linalg.norm(directions, axis=0)
            if (lengths < FORBIDDEN).any():
                raise StateError("directions must change the rotations, not only the lengths of quaternions")
            directions = directions / lengths
        if not self.stepper.interface.constraints:
            return _frame(self.size // 2)[:, : self.count] if directions is None else directions
        before = self.stepper.step(q, p, -h, t, parameters, options=options)
        ends = self.stepper.jacobian(*before, h, t - h, parameters, options=options)
        ends = self.leaving(ends, q, p) @ self.entering(np.eye(self.size), *before)
        allowed, sizes, _ = np.linalg.svd(ends)
        frame = allowed[:, sizes > FORBIDDEN * sizes[0]]
        if directions is not None:
            if np.abs(directions - frame @ (frame.T @ directions)).max() > INADMISSIBLE:
                raise StateError("directions must be tangent to the constraints")
            return directions
        if self.count is not None and self.count > frame.shape[1]:
            raise StateError(f"count={self.count} exceeds the {frame.shape[1]} directions that the constraints allow")
        mixed, _ = np.linalg.qr(np.random.default_rng(SEED).normal(size=2 * frame.shape[1:]))
        return np.asarray((frame @ mixed)[:, : self.count])


def _frame(dimension: int) -> Array:
    """Return a (2m, 2m) orthogonal symplectic matrix from a unitary one, columns ordered q_1, .., q_m, p_m, .., p_1."""
    real, imaginary = np.random.default_rng(SEED).normal(size=(2, dimension, dimension))
    unitary = np.linalg.qr(real + 1j * imaginary)[0]
    first = np.vstack([unitary.real, -unitary.imag])
    second = np.vstack([unitary.imag, unitary.real])
    return np.hstack([first, second[:, ::-1]])


def along(states: SavedStates, tangents: InitialTangents) -> ChaosIndicators:
    """Return the deviations of a run at its saved states; steps between these are recomputed."""
    first = states.q[0], states.p[0], float(states.step_sizes[0]), float(states.t[0])
    propagation = TangentPropagation(tangents, tangents.at(*first, states.parameters, states.options), states.t)
    segments = (starts_of(states, first, last) for first, last in pieces(states))
    propagation.follow(segments, partial(propagate, states, back=False))
    return ChaosIndicators.of(states.t, propagation.growth.values)


class TangentPropagation:
    """Propagation of tangent vectors.

    Args:
        space: stepper and space of the vectors.
        tangents: (size, k) initial vectors of length 1.
        t: (n,) times of saved values.
    """

    def __init__(self, space: InitialTangents, tangents: Array, t: Array) -> None:
        self._frame, self._triangle = np.linalg.qr(tangents)
        self._space, self._size = space, FIRST
        with np.errstate(divide="ignore"):  # linearly dependent directions span zero volume: log 0 = -inf
            self.growth = Growth(t, np.log(np.abs(np.diag(self._triangle))))

    def follow(
        self, step_segments: Iterator[StepSegment], propagate_chunk: Callable[[Starts, NDArray[np.intp], Array], None]
    ) -> None:
        """Propagate to the end of the last step."""
        for starts, numbers in step_segments:
            done, steps = 0, len(starts.h)
            while done < steps:
                end = min(done + self._size, steps)
                part, saved = starts.part(done, end), numbers[done : end + 1]
                stepper = self._space.stepper
                vectors = np.zeros((end - done + 1, self._frame.shape[1], stepper._input_size))
                columns = slice(2 * stepper.dimension)
                vectors[0, :, columns] = self._space.entering(self._frame, part.q[0], part.p[0]).T
                propagate_chunk(part, saved, vectors)
                images = self._space.leaving(vectors[1:, :, columns].transpose(0, 2, 1), part.q[1:], part.p[1:])
                done += self._take(part, saved[1:], images)

    def _take(self, part: Starts, numbers: NDArray[np.intp], images: Array) -> int:
        """Accumulate as many (2m, k) images as are well conditioned, at least one; return their number."""
        reduced = r_factors(images)
        parted = ill_conditioned(reduced)
        taken = max(1, int(np.argmax(parted))) if parted.any() else len(images)
        sizes = np.linalg.norm(reduced[:taken] @ self._triangle, axis=1)
        ends = np.append(part.t[:taken], part.t[taken - 1] + part.h[taken - 1])
        with np.errstate(divide="ignore"):  # directions forbidden by constraints are mapped to 0
            diagonals = np.log(np.abs(np.diagonal(reduced[:taken], axis1=1, axis2=2)))
            self.growth.add(ends, numbers[:taken], np.log(sizes), diagonals)
        self._frame, last = np.linalg.qr(images[taken - 1])
        self._triangle = last @ self._triangle / sizes[-1]
        self._size = taken if taken < len(images) else min(2 * self._size, MOST)
        return taken
