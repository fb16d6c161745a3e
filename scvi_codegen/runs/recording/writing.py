"""Recording of a run into a folder, and restart from it."""

from __future__ import annotations

import math
import os
import shlex
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.native.arguments import checked_number
from scvi_codegen.codegen.native.compilers import check_flags
from scvi_codegen.codegen.native.option_table import check_agreement
from scvi_codegen.common.atomic import sync_folder
from scvi_codegen.common.errors import EventError, RecordingError, RecordingWarning, StateError, StepFailedError, warn
from scvi_codegen.common.validation import REAL, checked_count, checks_arguments, of
from scvi_codegen.runs.accuracy.local_error import warn_of_energy_error, warn_of_large_steps
from scvi_codegen.runs.accuracy.resolution import warn_of_unresolved_fields
from scvi_codegen.runs.driver.observation import Observation, Saver
from scvi_codegen.runs.driver.run import Run
from scvi_codegen.runs.driver.run_loop import record
from scvi_codegen.runs.recording.manifest import (
    MANIFEST,
    Build,
    Chunk,
    Manifest,
    chunk_paths,
    no_crossings,
    no_states,
    read_chunk,
    read_manifest,
    unfinished,
    write_chunk,
    write_manifest,
)
from scvi_codegen.runs.recording.reading import RecordedRun, load_run
from scvi_codegen.runs.results.export import Piece, chunk_rows
from scvi_codegen.runs.states.words import low_words
from scvi_codegen.runs.stepping.chunks import drive
from scvi_codegen.runs.stepping.features import require
from scvi_codegen.runs.stepping.step_plan import Fixed, FixedSteps, StepPlan
from scvi_codegen.runs.trajectory import Trajectory

LOCK = ".lock"
CHECKPOINT_SECONDS = 10.0
SHORTEST_CHUNK_SECONDS, LONGEST_CHUNK_SECONDS = 0.01, 0.1
"""Bounds of the duration of a chunk in seconds, which limits the loss when a process is killed."""


@checks_arguments(run=of("a Run, as stepper.start gives it", Run), checkpoint_seconds=REAL)
def record_run(
    run: Run,
    folder: str | os.PathLike[str],
    *,
    steps: int | None = None,
    save_every: int = 1,
    checkpoint_seconds: float = CHECKPOINT_SECONDS,
    checkpoint_steps: int | None = None,
    rows: int | None = None,
    model: str | None = None,
    progress: Callable[[int], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> RecordedRun:
    """Advance a run by ``steps``, or to its target time, and record every ``save_every``-th state in a folder.

    Args:
        run: a run at its start, from ``stepper.start(q, p, h=h)`` or ``start(q, p, t_end=..., tolerance=...)``. Arrays
            of run-time sizes are recorded by the stepper compiled with their sizes, for at most 2000 coordinates; this
            run then remains at its start.
        folder: created if missing; it must be empty, or contain a run that ended before its first state.
        steps: number of steps; omitted for adaptive steps, which end at the target time.
        save_every: steps between saved states; the state at the target time is also saved.
        checkpoint_seconds: largest time between checkpoints; no more is lost if the process is killed.
        checkpoint_steps: write a checkpoint also after every multiple of this number of steps.
        rows: states per file, by default about 16 MiB.
        model: text of a model file (:func:`dump_model`) to store with the states.
        progress: called with the number of completed steps.
        stop: called regularly; the run ends if it returns true, after a checkpoint.

    Returns:
        The recorded run; ``finished`` unless ``stop`` ended it.

    Raises:
        StateError: if a number is invalid, the run has already started, or an input is not set.
        RecordingError: if the folder contains a run or cannot be written; the message reports the last checkpoint.
        StepFailedError: if a step fails; the states before it are in the folder.
    """
    target = Path(folder)
    require(run.stepper, "recording")
    if run.steps:
        raise StateError(f"record_run requires a run at its start, but this run has {run.steps} steps: start a new one")
    _check_inputs(run)
    run = _of_known_sizes(run)
    check_flags(run.stepper.flags, StateError)
    manifest = Manifest(
        source=run.stepper._plain,
        events=run.stepper.events,
        fallback=run.stepper.fallback,
        interface=run.stepper.interface,
        flags=run.stepper.flags,
        options=run.options,
        parameters=tuple(map(float, run.parameters)),
        parameters_low=tuple(low_words(run.parameters).tolist()) if run.stepper.interface.words > 1 else (),
        double=_double(run.stepper),
        t=run.t,
        save_every=checked_count(save_every, "save_every", least=1),
        steps=_checked_steps(run, steps),
        plan=Fixed(run._step_size) if isinstance(run.plan, FixedSteps) else run.plan,
        rows=chunk_rows(run.stepper.dimension * run.stepper.interface.words)
        if rows is None
        else checked_count(rows, "rows", least=1),
        model=model,
        builds=(Build.of(run.stepper, 0),),
        mesh=_mesh(run),
    )
    recorder = _Recorder(target, manifest, run, *_checked_checkpoints(checkpoint_seconds, checkpoint_steps))
    with recorder.reporting_recovery():
        _prepare(target)
    with _locked(target), run.alone():
        with recorder.reporting_recovery():
            _clear(target)
            recorder.keep(record(run, 0), 0)
            recorder.write()
            write_manifest(target, manifest)
            sync_folder(target)
        recorder.advance(progress, stop)
    return _checked(target, run)


@checks_arguments(checkpoint_seconds=REAL)
def resume_run(
    folder: str | os.PathLike[str],
    *,
    steps: int | None = None,
    t_end: float | None = None,
    checkpoint_seconds: float = CHECKPOINT_SECONDS,
    checkpoint_steps: int | None = None,
    progress: Callable[[int], None] | None = None,
    stop: Callable[[], bool] | None = None,
) -> RecordedRun:
    """Restart a recorded run from its last checkpoint, bitwise equal to an uninterrupted run.

    Args:
        folder: folder of :func:`record_run`.
        steps: new number of steps of the whole run.
        t_end: new target time of an adaptive run, not before its current time. A run that had arrived continues from
            there; its shortened last step remains.
        checkpoint_seconds, checkpoint_steps, progress, stop: as of :func:`record_run`.

    Returns:
        The recorded run.

    Raises:
        RecordingError: if the folder contains no run, is in use by another process, or cannot be written.
        StateError: if ``steps`` is passed for an adaptive run, or ``t_end`` for fixed steps.
        StepFailedError: if a step fails.

    Warns:
        RecordingWarning: if another build continues the run (another compiler, processor or flags); states may differ
            in the last bits. The manifest records the step.
    """
    target = Path(folder)
    read_manifest(target)  # a folder without one is not locked
    with _locked(target):
        recorded = load_run(target)
        run, manifest = recorded.resumed(), recorded.manifest
        continued = manifest.continued_by(Build.of(run.stepper, run.steps))
        if len(continued.builds) > len(manifest.builds):
            before, now = manifest.builds[-1], continued.builds[-1]
            warn(
                f"from step {now.step} on another build is used ({now.compiler}; before: {before.compiler}): another "
                "compiler, processor or Python. States may differ in the last bits from those of an uninterrupted run; "
                "the manifest records this",
                RecordingWarning,
            )
        continued, run.plan = _extended(continued, run, steps, t_end)
        recorder = _Recorder(target, continued, run, *_checked_checkpoints(checkpoint_seconds, checkpoint_steps))
        recorder.load_last_file(target)
        with recorder.reporting_recovery():
            _remove(unfinished(target))
            write_manifest(target, continued)  # fails early if the folder cannot be written
        recorder.advance(progress, stop)
    return _checked(target, run)


def _mesh(run: Run) -> dict[str, Any] | None:
    """Return the mesh of the fields of a density for the manifest."""
    mesh, names = run.stepper.interface.layout.mesh, run.stepper.interface.parameters
    if mesh is None:
        return None
    values = dict(zip(names, map(float, run.parameters), strict=True))
    return {
        "field": mesh.to_section(),
        "parameters": {name: values[name] for name in map(str, mesh.field_system.parameters)},
    }


def _double(stepper: Any) -> tuple[Any, ...]:
    """Return the source, the interface and the fallback in double of events in double-double runs."""
    if stepper.interface.words == 1 or not stepper.events:
        return ()
    double = stepper._in_double
    return double._plain, double.interface, double.fallback


def _checked(folder: Path, run: Run) -> RecordedRun:
    """Return the run in a folder, with the accuracy warnings of a run in memory."""
    recorded = load_run(folder)
    if not run._leaving:
        warn_of_large_steps(cast(Any, run))
    warn_of_energy_error(recorded[:: max(1, len(recorded) - 1)], run)
    warn_of_unresolved_fields(cast(Any, recorded))
    return recorded


class _Recorder:
    """Recorder of a run: the states of the current file, and how much of them is on disk."""

    def __init__(self, folder: Path, manifest: Manifest, run: Run, seconds: float, steps: int | None) -> None:
        self.folder, self.manifest, self.run = folder, manifest, run
        self.seconds, self.steps = seconds, steps
        self.number, self.written, self.written_t = 0, -1, run.t
        self.crossings = no_crossings(run.stepper.interface)
        self.pending: tuple[list[Piece], NDArray[np.float64], int, float, bytes]
        self.pending = [], self.crossings, run.steps, run.t, run.checkpoint()

    def load_last_file(self, folder: Path) -> None:
        paths = chunk_paths(folder)
        chunk = read_chunk(paths[-1], self.manifest.interface, self.manifest.rows)
        full = len(chunk) == self.manifest.rows
        self.number = len(paths) - 1 + full
        pieces, crossings = ([], self.crossings) if full else ([chunk.piece], chunk.crossings)
        self.pending = (pieces, crossings, chunk.step, self.run.t, chunk.memory)
        self.written = chunk.step

    def advance(self, progress: Callable[[int], None] | None, stop: Callable[[], bool] | None) -> None:
        """Advance to the end; write a checkpoint also on any exception."""
        manifest, run, checked, stopped = self.manifest, self.run, time.monotonic(), False

        def take(size: int) -> int:
            nonlocal checked
            before = run.steps
            self._advance(min(size, self._most_steps()))
            due = self.steps is not None and run.steps % self.steps == 0
            if due or self._rows() == manifest.rows or time.monotonic() - checked >= self.seconds:
                self.checkpoint()
                checked = time.monotonic()
            return run.steps - before

        def look(_: int) -> None:
            nonlocal stopped
            if progress is not None:
                progress(run.steps)
            stopped = stop is not None and stop()

        try:
            drive(
                take,
                math.inf,
                seconds=min(LONGEST_CHUNK_SECONDS, max(SHORTEST_CHUNK_SECONDS, self.seconds)),
                ended=lambda: stopped or manifest.reached(run),
                progress=look,
            )
        except RecordingError:
            raise
        except BaseException:
            self.checkpoint()
            raise
        self.checkpoint()

    def _advance(self, steps: int) -> None:
        run, save_every = self.run, self.manifest.save_every
        try:
            if run.stepper.searched:
                trajectory = Observation(run, Saver(save_every, within_steps=False)).advance(steps)
            else:
                trajectory = record(run, steps, save_every=save_every)
        except (StepFailedError, EventError) as error:
            if isinstance(error.trajectory, Trajectory):
                self.keep(error.trajectory, 1)
            raise
        self.keep(trajectory, 1)

    def _most_steps(self) -> int:
        """Return the number of steps to the end, the end of the current file, or the next checkpoint."""
        done, save_every, manifest = self.run.steps, self.manifest.save_every, self.manifest
        last = (done // save_every + manifest.rows - self._rows()) * save_every
        ends = [last] if manifest.steps is None else [last, manifest.steps]
        if self.steps is not None:
            ends.append((done // self.steps + 1) * self.steps)
        return min(ends) - done

    def _rows(self) -> int:
        return sum(len(piece[0]) for piece in self.pending[0])

    def keep(self, trajectory: Trajectory, first: int) -> None:
        """Store states from row ``first`` on and memory in one assignment, consistent after an interruption."""
        run, (pieces, crossings, *_) = self.run, self.pending
        piece = trajectory.t[first:], trajectory.q[first:], trajectory.p[first:], trajectory.iterations[first:]
        events = trajectory.events
        for k, crossing in enumerate(events):
            numbers = (k + len(events) * crossing.element)[:, np.newaxis]
            rows = np.concatenate([numbers, crossing.t[:, np.newaxis], crossing.q, crossing.p], axis=1)
            crossings = np.concatenate([crossings, rows])
        self.pending = ([*pieces, piece], crossings, run.steps, run.t, run.checkpoint())

    def checkpoint(self) -> None:
        """Write the states since the last checkpoint; RecordingError with the last step in the folder if that fails."""
        with self.reporting_recovery():
            self.write()

    def write(self) -> None:
        """Replace the current file, and begin the next one if it is full."""
        pieces, crossings, step, reached, memory = self.pending
        if (step, reached) == (self.written, self.written_t):
            return
        t, q, p, iterations = map(np.concatenate, zip(no_states(self.manifest.interface), *pieces, strict=True))
        piece = (t, q, p, iterations)
        write_chunk(self.folder, self.number, Chunk(piece, step, memory, crossings))
        self.written, self.written_t = step, reached
        full = len(t) == self.manifest.rows
        pieces, crossings = ([], self.crossings) if full else ([piece], crossings)
        self.number, self.pending = self.number + full, (pieces, crossings, step, reached, memory)

    @contextmanager
    def reporting_recovery(self) -> Iterator[None]:
        """Convert system errors to :class:`RecordingError` with the state of the folder and a remedy."""
        try:
            yield
        except RecordingError:
            raise
        except OSError as error:
            problem = f"'{self.folder}' cannot be written: {error.strerror or error}"
            if self.written < 0 or not (self.folder / MANIFEST).exists():
                remedy = "Nothing was recorded: when it can be written, start the run again"
                raise RecordingError(f"{problem}. {remedy}") from error
            raise RecordingError(
                f"{problem}. It contains the run up to step {self.written} (t = {self.written_t:g}); "
                f"{self.run.steps - self.written} later steps are not saved. When it can be written, continue with "
                f"'scvi-codegen run --resume {shlex.quote(str(self.folder))}' or resume_run"
            ) from error


def _check_inputs(run: Run) -> None:
    """Raise ``StateError`` unless all inputs are constant: a folder does not store pieces of input data."""
    try:
        run.check_inputs()
    except StateError as error:
        raise StateError(
            f"{error}. record_run supports only constant inputs; for inputs given as data use "
            "stepper.integrate(..., inputs=...).save('run.npz')"
        ) from error


def _checked_steps(run: Run, steps: int | None) -> int | None:
    """Return the number of fixed steps; ``None`` for adaptive steps."""
    if isinstance(run.plan, FixedSteps):
        return checked_count(steps, "steps", least=0)
    check_agreement({"steps": steps})
    return None


def _extended(manifest: Manifest, run: Run, steps: int | None, t_end: float | None) -> tuple[Manifest, StepPlan]:
    if isinstance(run.plan, FixedSteps):
        if t_end is not None:
            raise StateError(f"the run has fixed steps h = {run._step_size:g}: give steps instead of t_end")
        count = manifest.steps if steps is None else steps
        return replace(manifest, steps=checked_count(count, "steps", least=0)), run.plan
    _checked_steps(run, steps)
    assert not isinstance(manifest.plan, Fixed)  # as that of the run
    plan = run.plan if t_end is None else replace(run.plan, t_end=checked_number(t_end, "t_end"))
    if (plan.t_end - run.t) * (run.plan.t_end - manifest.t) < 0.0:
        raise StateError(f"the run is at t = {run.t:g}, already beyond t_end = {plan.t_end:g}: give a later t_end")
    return replace(manifest, plan=plan), plan


def _of_known_sizes(run: Run) -> Run:
    """Return the run of the stepper with known sizes from the same state."""
    if run.stepper.known is run.stepper:
        return run
    stepper = run.stepper._known_with_events
    return Run.started(stepper, run.q, run.p, plan=run.plan, t=run.t, parameters=run.parameters, options=run.options)


def _checked_checkpoints(seconds: float, steps: int | None) -> tuple[float, int | None]:
    if not seconds >= 0.0:
        raise StateError(f"checkpoint_seconds must be at least 0, not {seconds!r}")
    return seconds, None if steps is None else checked_count(steps, "checkpoint_steps", least=1)


def _prepare(folder: Path) -> None:
    folder.mkdir(exist_ok=True)
    if (folder / MANIFEST).exists():
        raise RecordingError(
            f"'{folder}' already contains a run: continue it ('scvi-codegen run --resume "
            f"{shlex.quote(str(folder))}', resume_run), or choose another folder"
        )
    run_files = {*chunk_paths(folder), *unfinished(folder), folder / LOCK}
    for path in folder.iterdir():
        if path not in run_files:
            raise RecordingError(f"'{folder}' is not empty (it has '{path.name}'): choose another folder")


def _clear(folder: Path) -> None:
    """Remove the files of a process that was killed before it wrote a manifest."""
    if (folder / MANIFEST).exists():
        raise RecordingError(f"another process has just started a run in '{folder}': choose another folder")
    _remove([*chunk_paths(folder), *unfinished(folder)])


def _remove(paths: Iterable[Path]) -> None:
    for path in paths:
        path.unlink()


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Lock the folder against other processes; the operating system releases the lock however the process ends."""
    from filelock import FileLock, Timeout  # loads asyncio

    lock = FileLock(folder / LOCK, timeout=0, fallback_to_soft=False)
    try:
        lock.acquire()
    except Timeout as error:
        raise RecordingError(f"another process is recording into '{folder}': wait for it, or end it") from error
    except OSError:  # some network disks have no locks; an unwritable folder fails when the first state is written
        yield
        return
    try:
        yield
    finally:
        with suppress(OSError):  # Windows removes it on release
            (folder / LOCK).unlink()
        lock.release()
