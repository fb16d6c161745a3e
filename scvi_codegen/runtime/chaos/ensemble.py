"""Chaos indicators of many initial states: tangent vectors propagated along each trajectory, in parallel threads.

In SIMD lanes the variations are additional coordinates (:mod:`scvi_codegen.mechanics.derived_systems`) of an ensemble.
After each block of steps the tangent frame of every lane is replaced by Q of its QR factorisation; a block is repeated
with half as many steps if its R shows that the tangent vectors became nearly parallel. Systems without variational
equations in lanes, and lanes whose step fails, are computed trajectory by trajectory. Only the indicators are stored.
"""

from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.errors import MethodError, StateError, StepFailedError
from scvi_codegen.native import building
from scvi_codegen.native.arguments import checked_number, checked_step
from scvi_codegen.native.binding import Binding
from scvi_codegen.native.cuda import constant
from scvi_codegen.native.options import SolverOptions, checked_options
from scvi_codegen.rendering.source import Source
from scvi_codegen.runtime.chaos.indicators import MOST as LARGEST_CHUNK
from scvi_codegen.runtime.chaos.indicators import (
    SERIES,
    ChaosIndicators,
    Growth,
    InitialTangents,
    StepSegment,
    TangentPropagation,
    ill_conditioned,
    r_factors,
)
from scvi_codegen.runtime.core.features import require
from scvi_codegen.runtime.core.integrator import Integrator
from scvi_codegen.runtime.core.validation import Array, States
from scvi_codegen.runtime.ensemble.device import DeviceRuns
from scvi_codegen.runtime.ensemble.initial_states import EnsembleParameters, start_of_ensemble
from scvi_codegen.runtime.ensemble.result import OK
from scvi_codegen.runtime.ensemble.schedule import CommonSteps
from scvi_codegen.runtime.ensemble.thread_pool import StopCheck, run_jobs
from scvi_codegen.runtime.run.accuracy import warn_of_large_steps
from scvi_codegen.runtime.run.memory import Memory
from scvi_codegen.runtime.run.run_loop import record
from scvi_codegen.runtime.run.step_plan import StepPlan
from scvi_codegen.runtime.run.times import times_after
from scvi_codegen.runtime.sensitivity.step_derivatives import Starts
from scvi_codegen.validation import checked_count

TRAJECTORIES_TOGETHER = 256
"""Number of trajectories integrated together, so that the output of a block of steps fits into the cache."""
FIRST, MOST = 8, 32
"""Number of steps of the first and of the largest block."""
CHECKED_STRIDE: Final = 64
"""Stride of the trajectories whose step error is estimated."""


class ChaosIndicatorsEnsemble:
    """Computation of the chaos indicators of many initial states; arguments as of ``chaos_indicators_ensemble``."""

    def __init__(
        self,
        stepper: Integrator,
        q: States,
        p: States,
        *,
        h: float,
        steps: int,
        count: int | None,
        directions: ArrayLike | None,
        save_every: int | None,
        t: float,
        parameters: EnsembleParameters,
        options: SolverOptions | None,
        device: str | None = None,
    ) -> None:
        require(stepper, "chaos_ensemble")
        self.device = device
        self.stepper, self.options = stepper, checked_options(options)
        self.h, steps = checked_step(h), checked_count(steps, "steps", least=1)
        self.save_every = steps if save_every is None else checked_count(save_every, "save_every", least=1)
        if steps % self.save_every:
            raise StateError(
                f"steps={steps} must be a multiple of save_every={self.save_every}, so that the last value is saved"
            )
        start = checked_number(t, "the time t")
        self.t = times_after(start, self.h, np.arange(steps + 1))[0]
        self.q, self.p, self.parameters = start_of_ensemble(stepper, q, p, start, parameters)
        self.changes = InitialTangents.checked(stepper, count, directions)
        self.status = np.full(len(self.q), OK, dtype="<U32")
        self.values = np.full((len(SERIES), len(self.t[:: self.save_every]), len(self.q), self._width()), np.nan)

    def run(self, *, progress: Callable[[int], None] | None, threads: int | None) -> ChaosIndicators:
        """Compute the indicators; ``progress`` is called with the number of finished trajectories and may raise.

        Trajectories without SIMD support, or whose SIMD steps failed, use the derivatives of single steps.
        """
        report, left = progress or (lambda _: None), np.arange(len(self.q))
        if self.device is not None:
            left = self._on_device(report, threads)
        elif (binding := self._lanes()) is not None:
            left = self._all_in_lanes(binding, report, threads)
        if len(left):
            self.stepper.tangent  # noqa: B018  (compiled once, before threads ask for it)
            before = len(self.q) - len(left)
            run_jobs(
                len(left),
                lambda k, check_stop: self._follow(int(left[k]), check_stop),
                progress=lambda done: report(before + done),
                threads=threads,
            )
        self._warn_of_long_steps()
        return ChaosIndicators.of(self.t[:: self.save_every], self.values, self.status)

    def _warn_of_long_steps(self) -> None:
        """Warn of too large steps: rerun every ``CHECKED_STRIDE``-th trajectory, as SIMD steps estimate no error.

        Of trajectories on a GPU at most about ``CHECKED_STRIDE`` are run.
        """
        steps, runs = len(self.t) - 1, {}
        stride = CHECKED_STRIDE if self.device is None else max(CHECKED_STRIDE, len(self.q) // CHECKED_STRIDE)
        for j in range(0, len(self.q), stride):
            start = self.q[j], self.p[j]
            arguments: dict[str, Any] = {"t": self.t[0], "parameters": self.parameters[j], "options": self.options}
            memory = Memory.started(self.stepper, *start, plan=StepPlan(h=self.h), **arguments)
            with suppress(StepFailedError):
                runs[j] = record(memory, steps, save_every=steps)
        worst = max(runs, key=lambda j: np.nan_to_num(runs[j].step_error), default=None)
        if worst is not None:
            warn_of_large_steps(runs[worst], remedy=f" (trajectory {worst} of {len(self.q)})")

    def _source(self) -> Source | None:
        """Return the source of an ensemble with tangent vectors, or ``None``."""
        if self.stepper.interface.constraints or self.stepper.interface.rotations:
            return None
        return self.stepper._variants[f"changes {self.values.shape[-1]}"]

    def _on_device(self, report: Callable[[int], None], threads: int | None) -> NDArray[np.intp]:
        """Process all trajectories on a GPU; return those that failed."""
        source = self._source()
        if source is None or constant(source, f"{source.prefix.upper()}_NEEDS_VELOCITIES"):
            raise MethodError(
                f"chaos indicators on a GPU are not available for '{self.stepper.title}': they require constant "
                "diagonal masses, forces of positions and time, and SVI or collocation; omit device"
            )
        count, steps, first = len(self.q), len(self.t) - 1, self._first(0)
        growth = _ThreadGrowth(source, first, count)
        plan = CommonSteps(self.t[0], self.h, steps=steps, t_end=None, inputs={}, save_every=self.save_every)
        start = [np.hstack([x, np.tile(growth.frame(part), (count, 1))]) for part, x in enumerate((self.q, self.p))]
        arguments = self.stepper, self.options, (start[0], start[1]), self.parameters
        runs = DeviceRuns(*arguments, lambda _, part: self.parameters[part], plan, record=growth)
        runs.run(progress=lambda done: report(done * count // steps), threads=threads)
        ended = runs.done == steps
        values = runs.device.copy_out(runs.q).reshape(len(plan.numbers), count, len(SERIES), -1)
        self.values[:, :, ended] = values.transpose(2, 0, 1, 3)[:, :, ended]
        return np.flatnonzero(~ended)

    def _lanes(self) -> Binding | None:
        """Return the compiled ensemble library with tangent vectors, or ``None``."""
        source = self._source()
        return None if source is None else Binding(building.load(source, flags=self.stepper.flags), source.prefix)

    def _all_in_lanes(self, binding: Binding, report: Callable[[int], None], threads: int | None) -> NDArray[np.intp]:
        """Process all trajectories in SIMD lanes, ``TRAJECTORIES_TOGETHER`` at a time; return those that failed."""
        count, changes = len(self.q), self._first(0)
        done = np.zeros(count, dtype=bool)

        def follow(k: int, check_stop: StopCheck) -> None:
            part = slice(k * TRAJECTORIES_TOGETHER, min((k + 1) * TRAJECTORIES_TOGETHER, count))
            self.values[:, :, part], done[part] = self._in_lanes(binding, changes, part, check_stop)

        run_jobs(
            -(-count // TRAJECTORIES_TOGETHER), follow, progress=lambda _: report(int(done.sum())), threads=threads
        )
        return np.flatnonzero(~done)

    def _width(self) -> int:
        """Return the number of tangent vectors of the first trajectory that can be started (constraints reduce it)."""
        for j in range(len(self.q)):
            with suppress(StepFailedError):
                return int(self._first(j).shape[1])
        return self.changes.count or self.changes.size

    def _first(self, j: int) -> Array:
        """Return the (2m, k) initial tangent vectors of trajectory j."""
        start = self.q[j], self.p[j], self.h, float(self.t[0])
        return self.changes.at(*start, self.parameters[j], self.options)

    def _in_lanes(
        self, binding: Binding, tangents: Array, part: slice, check_stop: StopCheck
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Return the (5, n, K, k) series of K trajectories from (2m, k) tangents, and (K,) flags of complete ones."""
        t, lanes = self.t, _TangentLanes(self, binding, part, tangents.shape[1])
        frame, triangle = (np.broadcast_to(factor, (lanes.size, *factor.shape)) for factor in np.linalg.qr(tangents))
        with np.errstate(divide="ignore"):  # linearly dependent directions span zero volume: log 0 = -inf
            growth = Growth(t[:: self.save_every], np.log(np.abs(np.diagonal(triangle, axis1=1, axis2=2))))
        done, steps, size, most = 0, len(t) - 1, FIRST, MOST
        lanes.take(frame)
        memory = binding.buffer(lanes.memory)
        while done < steps:
            check_stop(done)
            size = min(size, most, self.save_every - done % self.save_every, steps - done)
            before = bytes(memory)
            images = lanes.advance(size)
            running = lanes.running
            frame, last = _factors(np.where(running[:, np.newaxis, np.newaxis], images[-1], frame))
            if size > 1 and ill_conditioned(last).any():
                memory[:] = before
                most = size // 2
                continue
            done += size
            sizes = _lengths(images, triangle)
            numbers = np.full(size, -1)
            numbers[-1] = done // self.save_every if done % self.save_every == 0 else -1
            with np.errstate(divide="ignore"):
                diagonals = np.log(np.abs(np.diagonal(last, axis1=1, axis2=2)))
                stretched = np.broadcast_to(diagonals, (size, *diagonals.shape))
                growth.add(t[done - size : done + 1], numbers, np.log(sizes), stretched)
            triangle = last @ triangle / sizes[-1][:, np.newaxis]
            lanes.take(frame)
            size *= 2
        return growth.values, lanes.running

    def _follow(self, j: int, check_stop: StopCheck) -> None:
        """Integrate trajectory j with tangent vectors, by derivatives of single steps; NaN after a failed step."""
        stepper, steps = self.stepper, len(self.t) - 1

        def propagate_chunk(part: Starts, numbers: NDArray[np.intp], vectors: Array) -> None:
            check_stop(int(numbers[-1]))
            stepper._propagate(part, vectors, self.parameters[j], self.options)

        def step_segments() -> Iterator[StepSegment]:
            now = self.q[j], self.p[j]
            for first in range(0, steps, LARGEST_CHUNK):
                last = min(first + LARGEST_CHUNK, steps)
                starts = Starts.chain(*now, self.t[first:last], np.full(last - first, self.h))
                reached = np.arange(first, last + 1)
                yield starts, np.where(reached % self.save_every, -1, reached // self.save_every)
                now = starts.q[-1], starts.p[-1]

        propagation = None
        try:
            propagation = TangentPropagation(self.changes, self._first(j), self.t[:: self.save_every])
            propagation.follow(step_segments(), propagate_chunk)
        except StepFailedError as failure:
            self.status[j] = failure.status
        self.values[:, :, j] = np.nan if propagation is None else propagation.growth.values


def _lengths(images: Array, triangle: Array) -> Array:
    """Return (steps, K, k) norms of the tangent vectors, whose images in the frame are (steps, K, 2m, k)."""
    whole = images if images.shape[-1] == 1 else images @ triangle
    return np.asarray(np.sqrt(np.einsum("skij,skij->skj", whole, whole)))


def _factors(images: Array) -> tuple[Array, Array]:
    """Return the QR factors, (K, 2m, k) and (K, k, k)."""
    if images.shape[-1] > 1:
        orthonormal, upper = np.linalg.qr(images)
        return np.asarray(orthonormal), np.asarray(upper)
    lengths = r_factors(images)
    return images / lengths, lengths


class _ThreadGrowth:
    """Growth of the same initial tangent vectors (2m, k) of K trajectories, in the memory of threads of a GPU."""

    def __init__(self, source: Source, tangents: Array, count: int) -> None:
        self.source, (self.orthonormal, triangle) = source, np.linalg.qr(tangents)
        k = tangents.shape[1]
        with np.errstate(divide="ignore"):  # linearly dependent directions span zero volume
            diagonal = np.log(np.abs(np.diagonal(triangle)))
        numbers = np.concatenate([np.zeros(2 * k), diagonal, np.zeros(3 * k), triangle.ravel()])
        self.rows = np.tile(numbers[:, np.newaxis], count)
        self.saved: Array | None = np.tile(numbers[: len(SERIES) * k], (count, 1))

    def frame(self, part: int) -> Array:
        """Return the (m k,) positions or momenta of the orthonormal tangent vectors, one after the other."""
        return np.split(self.orthonormal, 2)[part].T.ravel()


class _TangentLanes:
    """SIMD blocks of K trajectories with k tangent vectors each; surplus lanes hold inactive copies of the last one."""

    def __init__(self, work: ChaosIndicatorsEnsemble, binding: Binding, part: slice, count: int) -> None:
        q, p, parameters = work.q[part], work.p[part], work.parameters[part]
        (self.size, self.dimension), self.count = q.shape, count
        self.width = len(binding.new("block *").active)
        blocks = -(-self.size // self.width)
        self.binding, self.options = binding, binding.options(work.options)
        self.memory = binding.new(f"block[{blocks}]")
        for k in range(blocks):
            binding.function("start")(self.memory + k, float(work.t[0]), work.h)
        self.lanes = binding.records(self.memory)
        lane_numbers = np.arange(blocks * self.width)
        self.lane_indices = np.minimum(lane_numbers, self.size - 1)
        self.lanes["q"][:, : self.dimension], self.lanes["p"][:, : self.dimension] = map(self._across, (q, p))
        self.lanes["parameters"][:, : parameters.shape[1]] = self._across(parameters)
        self.lanes["active"] = (lane_numbers < self.size).reshape(blocks, self.width)

    def _across(self, rows: Array) -> Array:
        """Transpose (K, n) rows to (blocks, n, lanes)."""
        lanes = rows[self.lane_indices].reshape(len(self.lanes), self.width, rows.shape[1])
        return np.asarray(lanes.transpose(0, 2, 1))

    @property
    def running(self) -> NDArray[np.bool_]:
        """(K,) flags of the trajectories without a failed step."""
        return np.asarray(self.lanes["active"].ravel()[: self.size] > 0.0)

    def take(self, frame: Array) -> None:
        """Set (K, 2m, k) tangent vectors, clear their compensation terms and discard the predictor."""
        m = self.dimension
        for name, part in (("q", frame[:, :m]), ("p", frame[:, m:])):
            self.lanes[name][:, m:] = self._across(part.transpose(0, 2, 1).reshape(self.size, -1))
            self.lanes[f"carry_{name}"][:, m:] = 0.0
        self.lanes["guess"] = 0

    def advance(self, steps: int) -> Array:
        """Advance all trajectories and return the (steps, K, 2m, k) tangent vectors after each step."""
        advance, size = self.binding.function("advance"), self.dimension * (self.count + 1)
        q, p = np.empty((2, steps, len(self.lane_indices), size))
        row, (at_q, at_p) = len(self.lane_indices) * size, map(self.binding.pointer, (q, p))
        for k in range(len(self.lanes)):
            offset = k * self.width * size
            advance(self.memory + k, self.width, steps, 1, self.options, at_q + offset, at_p + offset, row)
        shape = steps, self.size, self.count, self.dimension
        parts = [x[:, : self.size, self.dimension :].reshape(shape).transpose(0, 1, 3, 2) for x in (q, p)]
        return np.concatenate(parts, axis=2)
