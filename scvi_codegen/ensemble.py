"""Many trajectories at once: a trajectory a vector lane, blocks of lanes over the processor's cores.

Each block of eight runs in C without Python's lock, so threads share the work. One trajectory cannot spoil another: a
lane whose step fails keeps its last good state and is continued alone by the single integrator (which has Newton's
iteration to fall back on); if that fails too, its later states are NaN and its status says so.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen import building
from scvi_codegen.arguments import checked_count, checked_number, checked_step
from scvi_codegen.errors import StateError, StepFailedError
from scvi_codegen.source import Source

if TYPE_CHECKING:
    from scvi_codegen.stepper import SolverOptions, Stepper

__all__ = ["EnsembleTrajectory", "integrate_ensemble"]

Array = NDArray[np.float64]
EnsembleParameters = Mapping[str, ArrayLike] | Sequence[Any] | Array | None
LANES = 8
SLICE_SECONDS = 0.1
"""Time between looks at the keyboard and calls of ``progress``."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EnsembleTrajectory:
    """States of k trajectories at common times, the initial one first.

    Attributes:
        t: (n,) times.
        q, p: (n, k, m) positions and momenta; NaN after a failure.
        status: (k,) ``"ok"``, or why the trajectory ended (``"not converged"``, ``"singular"``, ``"not finite"``).
        steps: (k,) steps completed.
        h: step size.
        parameters: (k, number of parameters).
        stepper: the compiled integrator.
    """

    t: Array
    q: Array
    p: Array
    status: NDArray[np.str_]
    steps: NDArray[np.int64]
    h: float
    parameters: Array
    stepper: Stepper = field(repr=False)

    def __len__(self) -> int:
        return self.q.shape[1]

    @property
    def ok(self) -> NDArray[np.bool_]:
        """(k,) which trajectories reached the end."""
        return self.status == "ok"

    def energy(self) -> Array:
        """(n, k) energies p.v - L; NaN after a failure."""
        energies = np.full(self.q.shape[:2], np.nan)
        for j in range(len(self)):
            good = np.isfinite(self.q[:, j]).all(axis=1)
            energies[good, j] = self.stepper.energy(self.q[good, j], self.p[good, j], self.t[good], self.parameters[j])
        return energies


def integrate_ensemble(
    stepper: Stepper,
    q: ArrayLike,
    p: ArrayLike,
    *,
    h: float,
    steps: int,
    every: int = 1,
    t: float = 0.0,
    parameters: EnsembleParameters = None,
    options: SolverOptions | None = None,
    progress: Callable[[int], None] | None = None,
    threads: int | None = None,
) -> EnsembleTrajectory:
    """See :meth:`scvi_codegen.stepper.Stepper.integrate_ensemble`."""
    work = _Ensemble(stepper, q, p, h, steps, every, t, parameters, options)
    work.run(progress, threads or os.cpu_count() or 1)
    return work.result()


class _Ensemble:
    """Arrays of one call, shared by the blocks that fill them."""

    def __init__(
        self,
        stepper: Stepper,
        q: ArrayLike,
        p: ArrayLike,
        h: float,
        steps: int,
        every: int,
        t: float,
        parameters: EnsembleParameters,
        options: SolverOptions | None,
    ) -> None:
        self.stepper, self.options = stepper, options
        self.h, self.t0 = checked_step(h), checked_number(t, "the time t")
        self.steps = checked_count(steps, "steps", least=0)
        self.every = checked_count(every, "every", least=1)
        start_q, start_p = _states(stepper, q, "q"), _states(stepper, p, "p")
        if start_q.shape != start_p.shape:
            raise StateError(f"q has shape {start_q.shape}, p {start_p.shape}")
        self.count = len(start_q)
        self.parameters = _parameters(stepper, parameters, self.count)
        kept = self.steps // self.every + 1
        self.q = np.full((kept, self.count, stepper.dimension), np.nan)
        self.p = np.full_like(self.q, np.nan)
        self.q[0], self.p[0] = start_q, start_p
        self.status = np.full(self.count, "ok", dtype="<U16")
        self.done = np.zeros(self.count, dtype=np.int64)

    def run(self, progress: Callable[[int], None] | None, threads: int) -> None:
        """All blocks, by ``threads`` workers, in slices short enough to be interrupted."""
        blocks = [_block(self, first) for first in range(0, self.count, LANES)]
        with ThreadPoolExecutor(threads) as pool:
            finished, portion = 0, self.every
            while finished < self.steps:
                size = min(portion, self.steps - finished)
                began = time.perf_counter()
                list(pool.map(lambda block, at=finished, n=size: block.advance(at, n), blocks))
                finished += size
                if progress is not None:
                    progress(finished)
                elapsed = max(time.perf_counter() - began, 1e-6)
                portion = self.every * max(1, int(min(8.0 * size, size * SLICE_SECONDS / elapsed) / self.every))
            list(pool.map(lambda block: block.finish(), blocks))

    def result(self) -> EnsembleTrajectory:
        """The arrays, with their times."""
        number = self.every * np.arange(len(self.q))
        return EnsembleTrajectory(
            t=self.t0 + number * self.h,
            q=self.q,
            p=self.p,
            status=self.status,
            steps=self.done,
            h=self.h,
            parameters=self.parameters,
            stepper=self.stepper,
        )

    def continue_alone(self, j: int, step: int, q: Array, p: Array, carries: tuple[Array, Array] | None) -> None:
        """Trajectory j from its state after ``step`` steps to the end, by the single integrator."""
        run = self.stepper.start(q, p, h=self.h, t=self.t0, parameters=self.parameters[j], options=self.options)
        run.resume_at(step, carries)
        first = step // self.every + 1
        try:
            trajectory = run.record(self.steps - step, every=self.every)
        except StepFailedError as failure:
            self.status[j], trajectory = failure.status, failure.recorded
        self.done[j] = run.steps
        self.q[first : first + len(trajectory) - 1, j] = trajectory.q[1:]
        self.p[first : first + len(trajectory) - 1, j] = trajectory.p[1:]


class _LaneBlock:
    """Up to eight trajectories in one C block."""

    def __init__(self, work: _Ensemble, first: int, module: Any, source: Source) -> None:
        self.work, self.first = work, first
        self.count = min(LANES, work.count - first)
        self.ffi, self.lib, self.prefix = module.ffi, module.lib, source.prefix
        self.memory = self.ffi.new(f"{self.prefix}_block *")
        self._call("start")(self.memory, work.t0, work.h)
        self.alone = [False] * self.count
        for lane in range(LANES):
            self._fill(lane, first + min(lane, self.count - 1))

    def _fill(self, lane: int, j: int) -> None:
        work = self.work
        q, p = work.q[0, j].copy(), work.p[0, j].copy()
        try:
            v = work.stepper.velocity(q, p, work.t0, work.parameters[j])
        except StateError:
            v = np.zeros_like(q)
            if lane < self.count:
                self.alone[lane] = True
        pointers = (self.ffi.from_buffer("double[]", array) for array in (q, p, v))
        values = work.parameters[j].copy()
        given = self.ffi.from_buffer("double[]", values) if values.size else self.ffi.NULL
        self._call("set")(self.memory, lane, *pointers, given)
        if lane < self.count and self.alone[lane]:
            self.memory.active[lane] = 0.0

    def _call(self, name: str) -> Callable[..., Any]:
        function: Callable[..., Any] = getattr(self.lib, f"{self.prefix}_{name}")
        return function

    def advance(self, finished: int, size: int) -> None:
        """``size`` steps on from ``finished``."""
        work = self.work
        row = finished // work.every + 1
        kept = (finished + size) // work.every - finished // work.every
        m = work.stepper.dimension
        out_q, out_p = np.empty((max(kept, 1), self.count, m)), np.empty((max(kept, 1), self.count, m))
        self._call("advance")(
            self.memory,
            self.count,
            size,
            work.every,
            self._options(),
            self.ffi.from_buffer("double[]", out_q),
            self.ffi.from_buffer("double[]", out_p),
            self.count * m,
        )
        columns = slice(self.first, self.first + self.count)
        work.q[row : row + kept, columns], work.p[row : row + kept, columns] = out_q[:kept], out_p[:kept]

    def _options(self) -> Any:
        options = self.work.options
        if options is None:
            return self.ffi.NULL
        values = [options.tolerance, options.max_iterations, int(options.absolute)]
        return self.ffi.new(f"{self.prefix}_options *", values)

    def finish(self) -> None:
        """Continue the trajectories that left the block, each alone."""
        for lane in range(self.count):
            j = self.first + lane
            self.work.done[j] = self.memory.last_step[lane]
            if self.memory.active[lane] > 0.0:
                continue
            step = int(self.memory.last_step[lane])
            self.work.q[step // self.work.every + 1 :, j] = np.nan
            self.work.p[step // self.work.every + 1 :, j] = np.nan
            q, p, *carries = (
                np.array([row[lane] for row in getattr(self.memory, name)]) for name in ("q", "p", "carry_q", "carry_p")
            )
            self.work.continue_alone(j, step, q, p, (carries[0], carries[1]))


class _SingleBlock:
    """Up to eight trajectories, one after the other: methods without a fixed-point iteration."""

    def __init__(self, work: _Ensemble, first: int) -> None:
        self.work, self.first, self.count = work, first, min(LANES, work.count - first)
        self.runs = [
            work.stepper.start(
                work.q[0, j], work.p[0, j], h=work.h, t=work.t0, parameters=work.parameters[j], options=work.options
            )
            for j in range(first, first + self.count)
        ]

    def advance(self, finished: int, size: int) -> None:
        """``size`` steps on from ``finished`` of those that have not failed."""
        work = self.work
        row = finished // work.every + 1
        for j, run in enumerate(self.runs, self.first):
            if work.status[j] != "ok":
                continue
            try:
                trajectory = run.record(size, every=work.every)
            except StepFailedError as failure:
                work.status[j], trajectory = failure.status, failure.recorded
            work.done[j] = run.steps
            work.q[row : row + len(trajectory) - 1, j] = trajectory.q[1:]
            work.p[row : row + len(trajectory) - 1, j] = trajectory.p[1:]

    def finish(self) -> None:
        """Nothing is left to do."""


def _block(work: _Ensemble, first: int) -> _LaneBlock | _SingleBlock:
    source = work.stepper.ensemble
    if source is None:
        return _SingleBlock(work, first)
    return _LaneBlock(work, first, building.load(source, flags=work.stepper.flags), source)


def _states(stepper: Stepper, value: ArrayLike, name: str) -> Array:
    """(k, m) finite numbers."""
    try:
        array = np.array(value, dtype=float, ndmin=2)
    except (TypeError, ValueError) as error:
        raise StateError(f"{name} must be an array of real numbers: {error}") from error
    if array.ndim != 2 or array.shape[1] != stepper.dimension or len(array) == 0:
        raise StateError(f"{name} must have shape (k, {stepper.dimension}), not {array.shape}")
    if not np.isfinite(array).all():
        j, i = (int(index[0]) for index in np.nonzero(~np.isfinite(array)))
        raise StateError(f"{name}[{j}, {i}] ({stepper.coordinates[i]}) is {array[j, i]}")
    return array


def _parameters(stepper: Stepper, given: EnsembleParameters, count: int) -> Array:
    """(k, number of parameters): defaults, by name (a number or k numbers each), or a whole array."""
    names = stepper.parameters
    values = np.tile(stepper.defaults, (count, 1))
    if given is None:
        return values
    if isinstance(given, Mapping):
        for name, value in given.items():
            column = np.asarray(value, dtype=float)
            if column.shape not in ((), (count,)):
                raise StateError(f"the parameter {name} must be one number or {count}, not of shape {column.shape}")
            values[:, stepper.parameter_index(name)] = column
    else:
        array = np.array(given, dtype=float)
        if array.shape not in ((len(names),), (count, len(names))):
            raise StateError(f"parameters must have shape ({count}, {len(names)}), not {array.shape}")
        values[:] = array
    if not np.isfinite(values).all():
        j, i = (int(index[0]) for index in np.nonzero(~np.isfinite(values)))
        raise StateError(f"the parameter {names[i]} of trajectory {j} is {values[j, i]}")
    return values
