"""Reading of recorded runs: lazy arrays that load only the files in use."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, overload

import numpy as np
from numpy.typing import DTypeLike, NDArray

from scvi_codegen.common.errors import RecordingError
from scvi_codegen.common.labelled_arrays import checked_units
from scvi_codegen.common.representation import clipped
from scvi_codegen.common.validation import checks_arguments
from scvi_codegen.runs.driver.run import Run
from scvi_codegen.runs.driver.run_loop import first_step_size, trajectory_of
from scvi_codegen.runs.recording.manifest import Chunk, chunk_paths, no_states, read_chunk, read_manifest
from scvi_codegen.runs.results.export import COLUMNS, Piece, States, write_states
from scvi_codegen.runs.results.quantities import quantities_of
from scvi_codegen.runs.results.recorded import OfMethod
from scvi_codegen.runs.results.saved_states import checked_row
from scvi_codegen.runs.states.attitude_history import AttitudeHistory
from scvi_codegen.runs.states.rotation_quantities import named_quantities
from scvi_codegen.runs.states.times import times_after
from scvi_codegen.runs.states.words import check_keeps_words, low_words, scalar
from scvi_codegen.runs.stepper import Stepper
from scvi_codegen.runs.stepping.step_plan import Fixed
from scvi_codegen.runs.trajectory import Trajectory
from scvi_codegen.systems.event import Crossings

Array = NDArray[np.float64]
PIECES_IN_MEMORY = 2


@checks_arguments()
def load_run(folder: str | os.PathLike[str]) -> RecordedRun:
    """Return the run recorded in a folder, as far as it goes; another process may still be recording it.

    Args:
        folder: the folder.

    Raises:
        RecordingError: if there is none, or a file of it is missing or damaged.
    """
    return RecordedRun(Path(folder))


class RecordedRun(AttitudeHistory, OfMethod):
    """Run recorded in a folder; states are read on access.

    Indexing returns a :class:`Trajectory`: ``run[-1000:]``, ``run[::100]``; ``run.pieces()`` iterates over parts that
    fit into memory.

    Attributes:
        folder: the folder.
        manifest: description of the run.
        t, q, p, iterations: lazy arrays of shapes (n,), (n, m), (n, m), (n,); ``numpy.asarray`` reads them in full.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.manifest = folder, read_manifest(folder)
        try:
            self._paths = chunk_paths(folder)
        except OSError as error:
            raise RecordingError(f"'{folder}' cannot be read: {error.strerror or error}") from error
        if not self._paths:
            raise RecordingError(f"'{folder}' contains no states, not even the first: record the run again")
        self._last = self._read(self._paths[-1])
        self._recent: tuple[tuple[int, Piece], ...] = ()
        self.t, self.q, self.p, self.iterations = (LazyArray(self, i) for i in range(len(COLUMNS)))

    def __len__(self) -> int:
        """Return the number n of saved states."""
        return (len(self._paths) - 1) * self.manifest.rows + len(self._last)

    def __repr__(self) -> str:
        plan = self.manifest.plan
        if isinstance(plan, Fixed):
            end = f"step {self.steps} of {self.manifest.steps}"
        else:
            end = f"t = {self.t[-1]:g} of {plan.t_end:g}"
        return clipped(f"<RecordedRun '{self.folder}': {len(self)} states, {end}>")

    @overload
    def __getitem__(self, rows: slice) -> Trajectory: ...
    @overload
    def __getitem__(self, rows: int) -> tuple[float, Array, Array]: ...
    @overload
    def __getitem__(self, rows: str) -> Array: ...
    def __getitem__(self, rows: slice | int | str) -> Trajectory | tuple[float, Array, Array] | Array:
        """Return a trajectory in memory for a slice, (t, q, p) of one state for an index, or all values of a name.

        ``iterations`` counts as in the whole run.
        """
        if isinstance(rows, str):
            return self._quantity(rows)
        if not isinstance(rows, slice):
            k = checked_row(rows, len(self))
            return scalar(self.t[k]), self.q[k], self.p[k]
        numbers = self.rows(rows)
        return self._trajectory(tuple(self.gather(numbers, range(len(COLUMNS)))), numbers)

    @cached_property
    def mesh(self) -> Any:
        """Mesh of the fields of a density (:class:`~scvi_codegen.extras.fields.mesh.MeshSystem`), or ``None``."""
        return self.manifest.mesh_of_fields(self.folder)

    @property
    def fields(self) -> dict[str, Array]:
        """Fields of a density at the points of the mesh, (n, shape of the fields), by name; empty without a mesh."""
        return {} if self.mesh is None else self.mesh.fields_of(np.asarray(self.q), np.asarray(self.p))

    @cached_property
    def stepper(self) -> Stepper:
        """The integrator, compiled from the source in the manifest."""
        return self.manifest.stepper(self.mesh)

    @property
    def steps(self) -> int:
        """Number of completed steps; the last state is saved only at multiples of ``manifest.save_every``."""
        return self._last.step

    @property
    def finished(self) -> bool:
        """Return whether the run has reached its end."""
        plan, steps = self.manifest.plan, self.manifest.steps
        if isinstance(plan, Fixed):
            arrived = steps is not None and self.steps >= steps
        else:
            arrived = bool(self.t[-1] == plan.t_end)
        return arrived or (bool(self.manifest.events) and self._checkpointed_run.ended)

    @cached_property
    def events(self) -> tuple[Crossings, ...]:
        """Crossings of the events of the run."""
        paths, events = self._paths[:-1], self.manifest.events
        rows = [*(self._read(path).crossings for path in paths if events), self._last.crossings]
        crossings, half = np.concatenate(rows), 2 + self.manifest.interface.dimension
        t, q, p = crossings[:, 1], crossings[:, 2:half], crossings[:, half:]
        elements, numbers = np.divmod(np.asarray(crossings[:, 0], dtype=np.int64), max(1, len(events)))
        return tuple(
            Crossings(event=event, t=t[mine], q=q[mine], p=p[mine], element=elements[mine])
            for event, mine in ((event, numbers == k) for k, event in enumerate(events))
        )

    @cached_property
    def h(self) -> float:
        """Step size; for adaptive steps as of :class:`Trajectory`."""
        plan = self.manifest.plan
        return plan.h if isinstance(plan, Fixed) else first_step_size(plan, self.t[:2])

    def resumed(self) -> Run:
        """Return the run at its last checkpoint, to continue in memory; :func:`resume_run` continues in the folder.

        Raises:
            BuildError: if there is no C compiler.
        """
        manifest, plan, memory = self.manifest, self.manifest.plan, self._last.memory
        steps = {} if isinstance(plan, Fixed) else {"h": plan.size, **plan.record}
        steps = {name: value for name, value in steps.items() if name not in ("tau", "first_step")}
        return self.stepper.from_checkpoint(memory, **steps, parameters=manifest.values, options=manifest.options)

    @cached_property
    def _checkpointed_run(self) -> Run:
        """The run at its last checkpoint, for inspection only."""
        return self.resumed()

    def pieces(self) -> Iterator[Trajectory]:
        """Yield the run in consecutive parts."""
        first = 0
        for piece in self._pieces():
            yield self._trajectory(piece, np.arange(first, first + len(piece[0])))
            first += len(piece[0])

    def _pieces(self) -> Iterator[Piece]:
        for path in self._paths[:-1]:
            yield self._read_full(path)
        if len(self._last):
            yield self._last.piece

    def _read(self, path: Path) -> Chunk:
        return read_chunk(path, self.manifest.interface, self.manifest.rows)

    def _read_full(self, path: Path) -> Piece:
        """Read a file that is followed by others."""
        chunk = self._read(path)
        if len(chunk) != self.manifest.rows:
            raise RecordingError(f"'{path}' has {len(chunk)} states, but the manifest requires {self.manifest.rows}")
        return chunk.piece

    def piece(self, number: int) -> Piece:
        """Return the states of file ``number``; the files read last are cached."""
        if number == len(self._paths) - 1:
            return self._last.piece
        recent = dict(self._recent)  # replaced atomically, so that threads may read the run
        piece = recent.pop(number, None) or self._read_full(self._paths[number])
        self._recent = ((number, piece), *recent.items())[:PIECES_IN_MEMORY]
        return piece

    def rows(self, rows: Any) -> NDArray[np.int64]:
        """Return row numbers, or one number, from an index; raise IndexError if out of range."""
        if isinstance(rows, slice):
            return np.arange(*rows.indices(len(self)), dtype=np.int64)
        numbers = np.asarray(rows)
        if numbers.dtype == bool:
            if numbers.shape != (len(self),):
                raise IndexError(f"a boolean mask of rows must have shape ({len(self)},), not {numbers.shape}")
            return np.flatnonzero(numbers)
        if not np.issubdtype(numbers.dtype, np.integer) and numbers.size:
            raise IndexError(f"rows must be whole numbers, a slice or a boolean mask, not {rows!r}")
        outside = (numbers < -len(self)) | (numbers >= len(self))
        if outside.any():
            raise IndexError(f"the row {int(numbers[outside].flat[0])} is out of range: the run has {len(self)} states")
        return np.where(numbers < 0, numbers + len(self), numbers).astype(np.int64)

    def gather(self, rows: NDArray[np.int64], columns: Sequence[int]) -> list[NDArray[Any]]:
        """Return selected rows of some columns; each file is read once."""
        kinds = [no_states(self.manifest.interface)[column] for column in columns]
        results = [np.empty((len(rows), *kind.shape[1:]), dtype=kind.dtype) for kind in kinds]
        results = [array.view(type(kind)) for array, kind in zip(results, kinds, strict=True)]  # or of two words
        order = np.argsort(rows, kind="stable")
        files = rows[order] // self.manifest.rows
        for some in np.split(order, np.flatnonzero(np.diff(files)) + 1) if len(rows) else ():
            number, offsets = int(rows[some[0]]) // self.manifest.rows, rows[some] % self.manifest.rows
            for result, column in zip(results, columns, strict=True):
                result[some] = self.piece(number)[column][offsets]
        return results

    @property
    def velocity(self) -> Array:
        """(n, m) velocities."""
        return np.concatenate([piece.velocity for piece in self.pieces()])

    def energy(self) -> Array:
        """Return (n,) energies p.v - L."""
        return np.concatenate([piece.energy() for piece in self.pieces()])

    def unresolved(self) -> Array:
        """Return (n,) parts of the squared amplitude of fields in the highest modes, as :meth:`Trajectory.unresolved`.

        Raises:
            MethodError: if the fields are not those of a density.
        """
        return np.concatenate([piece.unresolved() for piece in self.pieces()])

    def states(self, units: Mapping[str, str] | None = None) -> States:
        """Return the states for :mod:`scvi_codegen.runs.results.export`, read file by file."""
        manifest, low = self.manifest, dict[str, Array]()
        if manifest.interface.words > 1:
            numbers = {"t": self.t, "q": self.q, "p": self.p, "parameters": manifest.values}
            low = {f"{name}_low": low_words(column[:]) for name, column in numbers.items()}
        return States(
            count=len(self),
            pieces=self._pieces,
            coordinates=manifest.interface.coordinates,
            momenta=manifest.interface.momentum_columns,
            parameters=dict(zip(manifest.interface.own_parameters, manifest.parameters, strict=False)),
            h=self.h,
            about=manifest.about(),
            maps=manifest.interface.map_names,
            attitudes=named_quantities(manifest.interface),
            quantities=lambda *of: quantities_of(self[:1], *of),
            units=checked_units(units),
            low=low,
        )

    @checks_arguments()
    def save(self, path: str | os.PathLike[str], *, units: Mapping[str, str] | None = None) -> None:
        """Write a file in parts; otherwise as :meth:`Trajectory.save`.

        A CSV file has no velocities and no energy, which would require compiling the C source of the recording.
        ``run[:].save(path)`` and HDF5 files have them.
        """
        check_keeps_words(self.manifest.interface.words, path)
        states, plain = self.states(units), Path(path).suffix.lower() == ".csv"
        write_states(replace(states, quantities=None) if plain else states, path)

    def _trajectory(self, piece: tuple[Any, ...], rows: NDArray[np.int64]) -> Trajectory:
        t, q, p, iterations = piece
        manifest, run = self.manifest, self._checkpointed_run
        taken = manifest.save_every * rows
        in_tau = manifest.interface.in_tau and isinstance(manifest.plan, Fixed)
        tau = times_after(0.0, self.h, taken)[0] if in_tau else None
        lengths, low, high = self._lengths(t, rows), t.min(initial=np.inf), t.max(initial=-np.inf)
        events = tuple(crossings.chosen((crossings.t >= low) & (crossings.t <= high)) for crossings in self.events)
        trajectory = trajectory_of(run, (t, q, p, iterations), lengths, tau=tau, events=events)
        trajectory.h = self.h
        return trajectory

    def _lengths(self, t: Array, rows: NDArray[np.int64]) -> Array:
        """Return (n,) sizes of the steps after the states; NaN for steps with states that are not saved."""
        if isinstance(self.manifest.plan, Fixed):
            changes = any(event.changes_state for event in self.manifest.events)
            return np.broadcast_to(np.nan if changes else self.manifest.plan.h, t.shape)
        sizes = np.where((np.diff(rows) == 1) & (self.manifest.save_every == 1), np.diff(t), np.nan)
        return np.append(sizes, np.nan)[: len(t)]


class LazyArray:
    """Column of a recorded run, read when indexed by a number, a slice, numbers or a boolean mask of rows.

    Further indices apply to the result, as in ``run.q[::10, 0]``. ``numpy.asarray`` reads the whole column,
    ``dask.array.from_array(run.q)`` a file at a time.
    """

    def __init__(self, run: RecordedRun, column: int) -> None:
        self._run, self._column = run, column
        self._like = no_states(run.manifest.interface)[column]

    @property
    def shape(self) -> tuple[int, ...]:
        """(n,) or (n, m)."""
        return (len(self._run), *self._like.shape[1:])

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the entries."""
        return self._like.dtype

    @property
    def ndim(self) -> int:
        """1 or 2."""
        return self._like.ndim

    @property
    def chunks(self) -> tuple[int, ...]:
        """Rows of a file, and all columns: the optimal chunk for reading."""
        return (min(self._run.manifest.rows, max(1, len(self))), *self._like.shape[1:])

    def __len__(self) -> int:
        return len(self._run)

    def __repr__(self) -> str:
        return clipped(f"<LazyArray {COLUMNS[self._column]}{self.shape} of '{self._run.folder}'>")

    def __iter__(self) -> Iterator[Any]:
        for number in range(-(-len(self) // self._run.manifest.rows)):
            yield from self._run.piece(number)[self._column]

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        if copy is False:
            raise ValueError("the states are in files: an array of them requires a copy")
        return np.asarray(self[:], dtype=dtype)

    def __getitem__(self, index: Any) -> Any:
        rows, *rest = index if isinstance(index, tuple) else (index,)
        numbers = self._run.rows(rows)
        (values,) = self._run.gather(np.atleast_1d(numbers), [self._column])
        return values[(slice(None), *rest)] if numbers.ndim else values[(0, *rest)]
