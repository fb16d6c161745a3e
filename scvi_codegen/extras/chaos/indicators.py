"""Growth of tangent vectors along a trajectory, and chaos indicators: Lyapunov exponents, MEGNO, FLI, SALI, GALI.

Tangent vectors v_1, .., v_k are propagated by the exact derivatives of the steps. All indicators follow from the
logarithms of their norms and of the diagonal of R in their QR factorisation, which remain accurate to round-off when
the vectors themselves have become parallel or would overflow: R has columns of length 1 and separate logarithms of
norms. Within a chunk the derivatives of the steps act on an orthonormal frame; the length of chunks is adapted so that
the images remain well conditioned. The initial frame is orthogonal and symplectic with ordered columns, so that R is
symplectic if the derivatives are (Iwasawa decomposition); Lyapunov exponents then occur in pairs of opposite sign to
round-off, at all times.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.api.checks import checked_count
from scvi_codegen.api.states import Array, Starts, real_array
from scvi_codegen.api.text import summary
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.common.errors import StateError
from scvi_codegen.runs.stepper import Stepper
from scvi_codegen.runs.trajectory import Trajectory

SERIES = ("log_norms", "max_log_norms", "log_r_diagonal", "rates", "mean_rates")
"""Names of the accumulated series, defined in :class:`~scvi_codegen.extras.chaos.indicators.ChaosIndicators`."""

MOST_GROWTH_RATIO = 1e3
"""Largest ratio of growth between tangent vectors within a segment; bounds the loss of significant digits."""


class Growth:
    """Logarithms of norms and of the diagonal of R, and the integrals of MEGNO.

    Args:
        t: (n,) times of saved values.
        log_r_diagonal: (k,) or (K, k) logarithms of the diagonal of R at the start, where norms are 1.

    Attributes:
        values: (5, n, k) or (5, n, K, k) values of :data:`SERIES`; NaN at times that were not reached.
    """

    def __init__(self, t: Array, log_r_diagonal: Array) -> None:
        self.start, nothing = float(t[0]), np.zeros_like(log_r_diagonal)
        self.log_r_diagonal = log_r_diagonal
        self.log_norms = self.max_log_norms = self.moments = self.rates = self.areas = nothing
        self.values = np.full((len(SERIES), len(t), *log_r_diagonal.shape), np.nan)
        self.values[:, 0] = [nothing, nothing, log_r_diagonal, nothing, nothing]

    def add(self, t: Array, numbers: NDArray[np.intp], log_growth: Array, log_diagonals: Array) -> None:
        """Add consecutive steps; the integrals use the trapezoidal rule.

        MEGNO is the mean <Y> of Y (Cincotta & Simo, Astron. Astrophys. Suppl. 147 (2000) 205), here in the elapsed time
        T and with the norm d: Y(T) = (2 / T) integral of t d(ln d), the ``moments``, and
        <Y>(T) = (1 / T) integral of Y dt, the ``areas``; Y = 0 at the start.

        Args:
            t: (steps + 1,) times at their ends.
            numbers: (steps,) index of the saved value at the end of each step, -1 for none.
            log_growth, log_diagonals: (steps, .., k) logarithms relative to the start of the first step; of
                ``log_diagonals`` only the saved rows and the last are used.
        """
        times = np.abs(t - self.start).reshape(-1, *[1] * self.log_norms.ndim)
        log_norms = self.log_norms + log_growth
        max_log_norms = np.maximum(np.maximum.accumulate(log_norms, axis=0), self.max_log_norms)
        growth_of_steps = np.diff(log_norms, axis=0, prepend=self.log_norms[np.newaxis])
        moments = self.moments + np.cumsum((times[1:] + times[:-1]) / 2 * growth_of_steps, axis=0)
        rates = 2.0 * moments / times[1:]
        sums_of_rates = rates.copy()  # at both ends of each step
        sums_of_rates[1:] += rates[:-1]
        sums_of_rates[0] += self.rates
        areas = self.areas + np.cumsum(np.diff(times, axis=0) / 2 * sums_of_rates, axis=0)
        saved = np.flatnonzero(numbers >= 0)
        self.values[:, numbers[saved]] = [
            log_norms[saved],
            max_log_norms[saved],
            self.log_r_diagonal + log_diagonals[saved],
            rates[saved],
            areas[saved] / times[saved + 1],
        ]
        self.log_norms = log_norms[-1]
        self.max_log_norms = max_log_norms[-1]
        self.log_r_diagonal = self.log_r_diagonal + log_diagonals[-1]
        self.moments, self.rates, self.areas = moments[-1], rates[-1], areas[-1]


def r_factors(images: Array) -> Array:
    """Return the (.., k, k) factors R of (.., 2m, k) matrices."""
    if images.shape[-1] == 1:
        return np.asarray(np.linalg.norm(images, axis=-2)[..., np.newaxis])
    return np.asarray(np.linalg.qr(images, mode="r"))


def ill_conditioned(images: Array) -> NDArray[np.bool_]:
    """Return (..) flags of the factors R (.., k, k) whose tangent vectors lost too many significant digits."""
    largest = np.abs(images).max(axis=(-2, -1))
    least = np.abs(np.diagonal(images, axis1=-2, axis2=-1)).min(axis=-1)
    return np.asarray(~(np.maximum(largest, 1.0) <= MOST_GROWTH_RATIO * np.minimum(least, 1.0)))


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ChaosIndicators:
    """Chaos indicators of k tangent vectors at n saved states; for an ensemble of K trajectories of shape (n, K, k).

    Norms are Euclidean norms of the 2m entries of (q, p); use units in which these are of comparable size.

    Attributes:
        t: (n,) times.
        log_norms: (n, k) logarithms of the norms of the tangent vectors, which are 1 at the start.
        max_log_norms: (n, k) maxima of these logarithms over all steps so far.
        log_r_diagonal: (n, k) logarithms of the diagonal of R: the first i sum to the log volume of i tangent vectors.
        rates: (n, k) 2/T times the integral of T d(log_norms), T the elapsed time: MEGNO before averaging.
        mean_rates: (n, k) time averages of ``rates``.
        status: (K,) for an ensemble, ``"ok"`` or the reason of a failure, after which values are NaN; else ``None``.
    """

    t: Array
    log_norms: Array
    max_log_norms: Array
    log_r_diagonal: Array
    rates: Array
    mean_rates: Array
    status: NDArray[np.str_] | None = None

    __repr__ = summary("t", "log_norms")

    @classmethod
    def of(cls, t: Array, series: Array, status: NDArray[np.str_] | None = None) -> ChaosIndicators:
        """Construct from (n,) times and (5, n, .., k) values of :data:`SERIES`."""
        return cls(t=t, status=status, **dict(zip(SERIES, series, strict=True)))

    def lyapunov_exponents(self) -> Array:
        """Return (n, k) the k largest Lyapunov exponents up to each state, descending; NaN at the first state.

        QR method of Benettin et al., Meccanica 15 (1980) 9.
        """
        time = np.abs(self.t - self.t[0]).reshape(-1, *[1] * (self.log_r_diagonal.ndim - 1))
        return np.asarray(-np.sort(-self.log_r_diagonal / np.where(time > 0.0, time, np.nan), axis=-1))

    def megno(self) -> Array:
        """Return (n,) MEGNO, the time-averaged mean exponential growth of nearby orbits, of the first tangent vector.

        It tends to 2 for regular motion (to less near stable periodic orbits) and to lambda t / 2 for chaotic motion:
        Cincotta & Simo, Astron. Astrophys. Suppl. 147 (2000) 205.
        """
        return np.asarray(self.mean_rates[..., 0])

    def fli(self) -> Array:
        """Return (n,) the fast Lyapunov indicator: the logarithm of the largest norm of any tangent vector so far.

        It grows as log t for regular motion and as lambda t for chaotic motion: Froeschle, Lega & Gonczi, Celest. Mech.
        Dyn. Astron. 67 (1997) 41; Froeschle & Lega, ibid. 78 (2000) 167.
        """
        return np.asarray(self.max_log_norms.max(axis=-1))

    def log_gali(self, k: int = 2) -> Array:
        """Return (n,) natural logarithms of :meth:`gali`, also where GALI underflows."""
        most = self.log_norms.shape[-1]
        if checked_count(k, "k", least=1) > most:
            raise StateError(
                f"k = {k} exceeds the number of tangent vectors, {most}: compute deviations with count={k}"
            )
        return np.asarray((self.log_r_diagonal - self.log_norms)[..., :k].sum(axis=-1))

    def gali(self, k: int = 2) -> Array:
        """Return (n,) the generalised alignment index: the volume spanned by the first k tangent vectors, normalised.

        It decays as exp(-(sum over i = 2..k of lambda_1 - lambda_i) t) for chaotic motion; on regular tori of dimension
        m it is about constant for k <= m and decays as t^(-2(k - m)) for k > m: Skokos, Bountis & Antonopoulos, Physica
        D 231 (2007) 30.
        """
        return np.asarray(np.exp(self.log_gali(k)))

    def sali(self) -> Array:
        """Return (n,) the alignment index ``min(|u + v|, |u - v|)`` of the first two normalised tangent vectors.

        Skokos, J. Phys. A 34 (2001) 10029.
        """
        sine = np.minimum(self.gali(2), 1.0)
        return np.asarray(sine * np.sqrt(2.0 / (1.0 + np.sqrt(1.0 - sine**2))))


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
    (:mod:`scvi_codegen.runs.states.reduction`). With constraints the frame spans the admissible directions, the
    range of the derivative of a step.

    Attributes:
        directions: (2m, k) directions of (q, p), or ``None``.
        reduction: maps to the reduced space, ``None`` without rotations.
    """

    stepper: Stepper
    count: int | None
    directions: Array | None
    reduction: Any

    @classmethod
    def checked(cls, stepper: Stepper, count: int | None, directions: ArrayLike | None) -> InitialTangents:
        """Construct from user arguments; raise :class:`StateError` for invalid numbers or directions."""
        size = 2 * stepper.dimension
        stepper.products.require("chaos")
        reduction = stepper.products.reduction if stepper.interface.rotations else None
        if directions is None:
            most = reduction.size if reduction else size
            count = None if count is None else checked_count(count, "count", least=1, most=most)
            return cls(stepper, count, None, reduction)
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


def along(states: Trajectory, tangents: InitialTangents) -> ChaosIndicators:
    """Return the deviations of a run at its saved states; steps between these are recomputed."""
    first = states.q[0], states.p[0], float(states.step_sizes[0]), float(states.t[0])
    parameters = states.parameters_on_sides(first[3])
    propagation = TangentPropagation(tangents, tangents.at(*first, parameters, states.options), states.t)
    propagation.follow(states.tangent_segments(), states.propagate_tangents)
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
                vectors = np.zeros((end - done + 1, self._frame.shape[1], stepper.products.tangents))
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
