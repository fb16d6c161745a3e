"""The result of an ensemble: states of many trajectories at common times, diagnostics and files."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StateError
from scvi_codegen.files.atomic import write_atomically
from scvi_codegen.files.export import LABELLED, check_format, write_whole
from scvi_codegen.files.labelled import Labelled, checked_units, to_dataset
from scvi_codegen.given.kinds import MAPPING, PATH, takes
from scvi_codegen.runtime.goal import Goal
from scvi_codegen.runtime.inputs import Array
from scvi_codegen.runtime.integrator import Integrator
from scvi_codegen.runtime.quantities import quantities
from scvi_codegen.runtime.trajectory import relative_changes

if TYPE_CHECKING:
    import xarray

__all__ = ["INTERRUPTED", "OK", "EnsembleTrajectory", "Span"]

OK, INTERRUPTED = "ok", "interrupted"

Span: TypeAlias = tuple[slice, slice, Callable[[slice], Array]]
"""Rows of states, the trajectories that they are of, and the parameters in them of a part of all trajectories."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EnsembleTrajectory:
    """States of k trajectories at common times, the initial one first.

    Attributes:
        t: (n,) times; where time is transformed tau, from 0; where each trajectory keeps the states at its own steps
            their numbers.
        q, p: (n, k, m) positions and momenta; NaN after a failure, and after the end of a trajectory of fewer states.
        status: (k,) ``"ok"``, or why the trajectory ended (``"not converged"``, ``"singular"``, ``"not finite"``,
            ``"vanished"``, ``"interrupted"``).
        steps: (k,) steps completed.
        h: step size, 0 where steps choose their length.
        spans: with inputs, rows of states of some of the trajectories, and the parameters in them of a part of all;
            ``parameters`` has zeros in place of inputs.
        goals: of each trajectory whose steps choose their length, else none.
        parameters: (k, number of parameters).
        stepper: the compiled integrator.
        times: (n, k) where every trajectory has its own (transformed time, steps of their own lengths), else ``None``.
    """

    t: Array
    q: Array
    p: Array
    status: NDArray[np.str_]
    steps: NDArray[np.int64]
    h: float
    parameters: Array
    stepper: Integrator = field(repr=False)
    times: Array | None = None
    goals: tuple[Goal, ...] = ()
    spans: tuple[Span, ...] = field(default=(), repr=False)

    def __len__(self) -> int:
        return len(self.status)

    def __repr__(self) -> str:
        states = f"{len(self.t)} states of each of {len(self)} trajectories, {np.count_nonzero(self.ok)} of them ok"
        return f"<EnsembleTrajectory of {self.stepper.title}; {states}>"

    @property
    def ok(self) -> NDArray[np.bool_]:
        """(k,) which trajectories reached the end."""
        reached: NDArray[np.bool_] = self.status == OK
        return reached

    @property
    def ends(self) -> tuple[Array, Array, Array]:
        """Time, positions and momenta of the last state of each trajectory: (k,), (k, m), (k, m)."""
        last = [each[0].size - 1 for each in self.each()]
        j = np.arange(len(self))
        return self._times()[last, j], self.q[last, j], self.p[last, j]

    def each(self) -> Iterator[tuple[Array, Array, Array, str, int]]:
        """Of each trajectory the times, positions and momenta of its states, why it ended, and its steps."""
        times = self._times()
        for j, (status, steps) in enumerate(zip(self.status.tolist(), self.steps.tolist(), strict=True)):
            good = self._reached(j)
            yield times[good, j], self.q[good, j], self.p[good, j], status, steps

    def _times(self) -> Array:
        """(n, k)."""
        return np.broadcast_to(self.t[:, np.newaxis], self.q.shape[:2]) if self.times is None else self.times

    def energy(self) -> Array:
        """(n, k) energies p.v - L; NaN after a failure, and for a trajectory with a state that has no energy."""
        energies = np.full(self.q.shape[:2], np.nan)
        for j, good, parameters in self._with_parameters():
            try:
                energies[good, j] = self.stepper.energy(
                    self.q[good, j], self.p[good, j], self._times()[good, j], parameters
                )
            except StateError:
                continue
        return energies

    def momentum_maps(self) -> Array:
        """(n, k, c) values of what symmetries conserve, named ``stepper.momentum_map_names``; NaN as above."""
        return self._momentum_maps()[0]

    def momentum_errors(self) -> Array:
        """(n, k, c) changes of the momentum maps since the first state, relative to the largest size of their terms."""
        return relative_changes(*self._momentum_maps())

    def _momentum_maps(self) -> tuple[Array, Array]:
        values, sizes = np.full((2, *self.q.shape[:2], len(self.stepper.momentum_map_names)), np.nan)
        for j, good, parameters in self._with_parameters():
            try:
                values[good, j], sizes[good, j] = self.stepper.momentum_maps_and_sizes(
                    self.q[good, j], self.p[good, j], self._times()[good, j], parameters
                )
            except StateError:
                continue
        return values, sizes

    def _with_parameters(self) -> Iterator[tuple[int, NDArray[np.intp], Array]]:
        """Trajectories, rows of states that there are, and the parameters in them."""
        for rows, some, parameters in self.spans or ((slice(None), slice(None), self.parameters.__getitem__),):
            for j, own in zip(range(*some.indices(len(self))), parameters(some), strict=True):
                good = np.flatnonzero(self._reached(j)[rows]) + (rows.start or 0)
                if good.size:
                    yield j, good, own

    @takes(path=PATH, units=MAPPING)
    def save(self, path: str | os.PathLike[str], *, units: Mapping[str, str] | None = None) -> None:
        """Write ``.npz``, ``.csv`` (a line a state: trajectory, t, q, p), ``.h5``, ``.nc`` or ``.zarr``, atomically.

        In a CSV file trajectories are numbered from 0, parameters that differ between them have columns too, and states
        after a failure are left out. HDF5 and Zarr hold what :meth:`to_xarray` gives.

        Raises:
            StateError: for another suffix, or units in a format that has none.
            MissingLibraryError: without h5netcdf or zarr (extra ``data``).
        """
        suffix, known = Path(path).suffix.lower(), checked_units(units)
        self._check_common_times()
        if suffix in LABELLED:
            check_format(path)
            write_whole(path, lambda made: LABELLED[suffix](self._labelled(known), made))
            return
        write = {".npz": self._write_npz, ".csv": self._write_csv}.get(suffix)
        if write is None:
            raise StateError(f"an ensemble is saved as .npz, .csv, {', '.join(LABELLED)}, not as {str(path)!r}")
        if known:
            raise StateError(f"a file {suffix} has no place for units; {', '.join(LABELLED)} have")
        write_atomically(path, write)

    def to_xarray(self, *, units: Mapping[str, str] | None = None) -> xarray.Dataset:
        """Variables q, p, velocity (t, trajectory, coordinate), energy, momentum_map, parameters, status, steps.

        Args:
            units: as of :meth:`Trajectory.to_xarray`.

        Raises:
            StateError: for units of something else.
            MissingLibraryError: without xarray (extra ``data``).
        """
        self._check_common_times()
        return to_dataset(self._labelled(checked_units(units)))

    def _check_common_times(self) -> None:
        if self.stepper.interface.energy_parameter:
            raise StateError("in transformed time trajectories have no common times: files of ensembles need them")

    def _labelled(self, units: Mapping[str, str]) -> Labelled:
        """The arrays with names for their dimensions."""
        interface, each = self.stepper.interface, ("t", "trajectory")
        dimensions: dict[str, tuple[str, ...]] = {"t": ("t",), "coordinate": ("coordinate",), "energy": each}
        dimensions |= dict.fromkeys(("q", "p", "velocity"), (*each, "coordinate"))
        dimensions |= {"status": ("trajectory",), "steps": ("trajectory",)}
        whole: dict[str, NDArray[Any]] = {
            "coordinate": np.array(interface.coordinates),
            "status": self.status,
            "steps": self.steps,
        }
        if interface.parameters:
            dimensions |= {"parameter": ("parameter",), "parameters": ("trajectory", "parameter")}
            whole |= {"parameter": np.array(interface.parameters), "parameters": self.parameters}
        if interface.map_names:
            dimensions |= {"symmetry": ("symmetry",), "momentum_map": (*each, "symmetry")}
            whole["symmetry"] = np.array(interface.map_names)
        states = {"t": self.t, "q": self.q, "p": self.p}
        if self.times is not None:
            dimensions["time"], states["time"] = each, self.times
        return Labelled(
            dimensions=dimensions,
            pieces=lambda: iter([states | self._quantities()]),
            whole=whole,
            count=len(self.t),
            units={name: unit for name, unit in units.items() if name in dimensions},
            attributes={**interface.about(), "h": self.h},
        )

    def _quantities(self) -> dict[str, Array]:
        times = np.nan_to_num(self._times())
        found: dict[str, Array] = {}
        for j, good, parameters in self._with_parameters():
            part = quantities(self.stepper, parameters, times[good, j], self.q[good, j], self.p[good, j])
            for name, values in part.items():
                shape = (*self.q.shape[:2], *values.shape[1:])
                found.setdefault(name, np.full(shape, np.nan))[good, j] = values
        return found

    def _reached(self, j: int) -> NDArray[np.bool_]:
        """(n,) which states of a trajectory there are."""
        return np.asarray(np.isfinite(self.q[:, j]).all(axis=1), dtype=np.bool_)

    def _write_npz(self, file: IO[bytes]) -> None:
        times: dict[str, Any] = {} if self.times is None else {"times": self.times}
        np.savez(
            file,
            t=self.t,
            q=self.q,
            p=self.p,
            status=self.status,
            steps=self.steps,
            h=self.h,
            parameters=self.parameters,
            coordinates=np.array(self.stepper.coordinates),
            parameter_names=np.array(self.stepper.parameters, dtype=str),
            title=self.stepper.title,
            **times,
        )

    def _write_csv(self, file: IO[bytes]) -> None:
        names = self.stepper.coordinates
        varied = [i for i, column in enumerate(self.parameters.T) if (column != column[0]).any()]
        header = ["trajectory", *(self.stepper.parameters[i] for i in varied), "t", *names, *(f"p_{n}" for n in names)]
        file.write((",".join(header) + "\n").encode())
        formats = ["%d"] + ["%.17g"] * (len(header) - 1)
        for j in range(len(self)):
            good = self._reached(j)
            label = np.broadcast_to([j, *self.parameters[j, varied]], (int(good.sum()), 1 + len(varied)))
            table = np.column_stack([label, self._times()[good, j], self.q[good, j], self.p[good, j]])
            np.savetxt(file, table, delimiter=",", fmt=formats)
