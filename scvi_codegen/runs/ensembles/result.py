"""Result of an ensemble: states of many trajectories, diagnostics and files."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, TypeAlias, overload

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.native.options import FAILURES
from scvi_codegen.common.atomic import write_atomically
from scvi_codegen.common.display.cards import card, grid, listed, plain, sparkline
from scvi_codegen.common.errors import StateError
from scvi_codegen.common.labelled_arrays import AXES, Labelled, checked_units, to_dataset
from scvi_codegen.common.representation import one_line
from scvi_codegen.common.validation import checks_arguments
from scvi_codegen.runs.accuracy.global_error import ConfirmedEnsemble, GlobalError
from scvi_codegen.runs.forwarding import OfEnsembles
from scvi_codegen.runs.results.export import FORMATS, LABELLED, check_format, write_whole
from scvi_codegen.runs.results.joining import joined, relative_changes
from scvi_codegen.runs.results.quantities import quantities, short_title
from scvi_codegen.runs.results.recorded import NotRecordedError, OfMethod, changed, not_recorded, without
from scvi_codegen.runs.results.saved_states import ModeHistory, checked_row
from scvi_codegen.runs.states.attitude_history import AttitudeHistory
from scvi_codegen.runs.states.rotation_quantities import named_quantities
from scvi_codegen.runs.states.times import number_until
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.states.words import TwoWords, Words, check_keeps_words
from scvi_codegen.runs.stepping.integrator import Integrator
from scvi_codegen.runs.stepping.step_plan import Adaptive, Fixed

if TYPE_CHECKING:
    import xarray

    from scvi_codegen.runs.trajectory import Trajectory
    from scvi_codegen.systems.event import Crossings

OK, INTERRUPTED, EVENT_FAILED = "ok", "interrupted", "event failed"

MOST_DRAWN = 64
"""Largest number of trajectories in a picture."""
MOST_SHOWN = 3
"""Largest number of trajectories, and of coordinates, that a notebook shows."""

SpanOfRows: TypeAlias = tuple[slice, slice, Callable[[slice], Array]]
"""Rows of states, a slice of trajectories, and a function returning the parameters of trajectories in these rows."""


def failure_after(t: float, steps: int, status: str) -> str:
    """Return why a trajectory ended at time t after so many steps."""
    return f"after t = {t:.6g}, {steps} steps: {'. '.join(FAILURES[status])}"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class EnsembleTrajectory(AttitudeHistory, ConfirmedEnsemble, OfEnsembles, TwoWords, OfMethod):
    """States of k trajectories, the initial state first.

    Attributes:
        t: times of the states: (n,) if all trajectories have the same, else (n, k), as with adaptive steps, terminal
            events and in transformed time; NaN after the end of a trajectory.
        status: (k,) ``"ok"``, or the reason of the end (``"not converged"``, ``"singular"``, ``"not finite"``,
            ``"step size underflow"``, ``"interrupted"``, ``"too many states"`` for the memory).
        steps: (k,) completed steps.
        h: step size, ``None`` for adaptive steps.
        parameters: (k, number of parameters) values; zeros for the parameters of inputs.
        stepper: the compiled integrator.
        tau: in transformed time its values from 0, (n,) or with ``t_end`` (n, k), else ``None``.
        plans: step plan of each trajectory for adaptive steps, else empty.
        observed: with ``observe=``, over the states after all steps: (2, k, 2m) smallest and largest values of (q, p)
            (``"extremes"``), (2, k) energies (``"energy"``), or (k, number of events) changes of sign (``"events"``).
        q, p: (n, k, m) positions and momenta; NaN after a failure, and after the end of a shorter trajectory.
        actions: (n, k) actions up to each state if the runs summed them (``action=True``), else ``None``.
        fallback_steps: (k,) numbers of steps solved by Newton's method, as the iteration failed.
        spans: with inputs, rows of states of a slice of trajectories and their parameters.
        confirmations: with ``error=``, of each trajectory as of :class:`Trajectory`, ``None`` for one that fails; else
            empty.
        events: (k,) crossings of the events of each trajectory, parallel to ``stepper.events``; empty without events.
        modes: (k,) values of ``stepper.modes`` along each trajectory, as of :class:`Trajectory`; empty without modes.
        messages: of the errors of trajectories that were integrated one by one, by their numbers; see :attr:`failures`.
        initial: time, (k, m) positions and (k, m) momenta from which they began, which ``t_eval`` may omit.
    """

    t: Array
    q: Array
    p: Array
    status: NDArray[np.str_]
    steps: NDArray[np.int64]
    h: float | None
    parameters: Array
    stepper: Integrator = field(repr=False)
    initial: tuple[float, Array, Array] = field(repr=False)
    tau: Array | None = None
    plans: Sequence[Adaptive] = ()
    observed: Array | None = field(default=None, repr=False)
    actions: Array | None = field(default=None, repr=False)
    fallback_steps: NDArray[np.int64] | None = field(default=None, repr=False)
    spans: tuple[SpanOfRows, ...] = field(default=(), repr=False)
    confirmations: tuple[GlobalError | None, ...] = field(default=(), repr=False)
    events: tuple[tuple[Crossings, ...], ...] = field(default=(), repr=False)
    modes: tuple[ModeHistory | None, ...] = field(default=(), repr=False)
    messages: Mapping[int, str] = field(default_factory=dict, repr=False)

    def __len__(self) -> int:
        return len(self.status)

    def __getattr__(self, name: str) -> Any:
        """Raise an error that says whether a trajectory has what an ensemble lacks."""
        from scvi_codegen.runs.trajectory import Trajectory  # imported here: it makes ensembles

        if name in ("heat", *Trajectory.OPTIONAL):
            raise not_recorded(name)
        if not name.startswith("_") and hasattr(Trajectory, name):
            raise NotRecordedError(f"an ensemble has no {name}: read that of one of its trajectories, runs[0].{name}")
        raise AttributeError(f"'{type(self).__name__}' object has no attribute '{name}'")

    @property
    def times(self) -> Array:
        """(n, k) times of the states of each trajectory."""
        return self.t if self.t.ndim == 2 else np.broadcast_to(self.t[:, np.newaxis], (len(self.t), len(self)))

    @property
    def ok(self) -> NDArray[np.bool_]:
        """(k,) flags of the trajectories that reached the end."""
        return np.asarray(self.status == OK)

    @overload
    def __getitem__(self, j: int) -> Trajectory: ...
    @overload
    def __getitem__(self, j: str) -> Array: ...
    def __getitem__(self, j: int | str) -> Trajectory | Array:
        """Return trajectory j, or the values (n, k) of a name, as of :class:`Trajectory`: ``runs["x"]``."""
        if isinstance(j, str):
            return self._quantity(j)
        from scvi_codegen.runs.trajectory import Trajectory  # imported here: it makes ensembles

        j = checked_row(j, len(self))
        parts = [(good, parameters) for _, good, parameters in self._with_parameters([j])]
        times, tau = self.times[:, j], self.tau
        if tau is not None and tau.ndim == 2:
            tau = tau[:, j]
        plan, h = (self.plans[j], np.nan) if self.h is None else (Fixed(self.h), self.h)
        modes, pieces = self.modes[j] if self.modes else None, []
        changes = any(len(of.t) and of.event.changes_state for of in (self.events[j] if self.events else ()))
        divided = changes or (modes is not None and len(modes.t) > 0)  # fixed steps, at changes that are not states
        for number, (good, parameters) in enumerate(parts):
            rows = np.insert(good, 0, good[0] - 1) if number else good  # the state at a breakpoint belongs to both
            q, p = (self.stepper.named(states[rows, j].copy()) for states in (self.q, self.p))
            piece = Trajectory(
                t=times[rows],
                q=q,
                p=p,
                iterations=np.empty(0, np.int32),
                step_sizes=np.full(len(rows), np.nan if divided else h),
                h=h,
                tau=None if tau is None else tau[rows],
                actions=None if self.actions is None else self.actions[rows, j],
                modes=None if modes is None else modes.between(*sorted(times[rows[[0, -1]]])),
                parameters=parameters,
                stepper=self.stepper,
                plan=plan,
                steps=int(self.steps[j]),
                fallback_steps=0 if self.fallback_steps is None else int(self.fallback_steps[j]),
            )
            pieces.append(without(piece, *self._unset))
        whole, (t0, q0, p0) = joined(pieces) if len(pieces) > 1 else pieces[0], self.initial
        return changed(
            whole,
            began=(t0, self.stepper.named(q0[j]), self.stepper.named(p0[j])),
            events=self.events[j] if self.events else (),
            modes=modes,
            confirmation=self.confirmations[j] if self.confirmations else None,
        )

    @property
    def _unset(self) -> tuple[str, ...]:
        """Names of the attributes of trajectories that this ensemble does not record."""
        conditions = {
            "iterations": True,
            "rejected_steps": self.h is None,
            "bath": self.stepper.interface.temperature is not None,
            "fallback_steps": self.fallback_steps is None,
            "step_error": True,
            "worst_step_time": True,
            "transitions": bool(self.stepper.interface.contacts or self.stepper.interface.kinks),
        }
        return tuple(name for name, is_unset in conditions.items() if is_unset)

    def __repr__(self) -> str:
        states = f"{len(self.t)} states of each of {len(self)} trajectories, {np.count_nonzero(self.ok)} of them ok"
        return one_line(self, short_title(self.stepper.interface), states)

    def _repr_html_(self) -> str:
        interface, counts = self.stepper.interface, Counter(self.status.tolist())
        names = interface.coordinates[:MOST_SHOWN]
        steps = f"{self.steps.min()} to {self.steps.max()}" if len(self) else "0"
        size = "adaptive size" if self.h is None else f"size {self.h:g}"
        facts = (
            ("trajectories", plain(f"{len(self)}: {', '.join(f'{count} {word}' for word, count in counts.items())}")),
            ("steps", plain(f"{steps} of {size}")),
            ("states", plain(f"{len(self.t)} of each; q and p of shape {self.q.shape}")),
            ("coordinates", listed(interface.coordinates)),
            ("parameters", listed(interface.parameters)),
        )
        rows = []
        for j in range(min(len(self), MOST_SHOWN)):
            q = self.q[self._reached(j), j]
            curves = zip(names, q[:: max(1, -(-len(q) // MOST_DRAWN))].T, strict=False)
            rows.append([plain(f"trajectory {j}"), *(sparkline(values.tolist(), name) for name, values in curves)])
        return card(self.stepper.title, facts, grid(rows, head=("", *names)))

    @property
    def failures(self) -> dict[int, str]:
        """Why each trajectory that failed did, by its number: as a single run says, or the time and the cause."""
        failed, ends = np.flatnonzero(~self.ok & (self.status != INTERRUPTED)).tolist(), self.ends[0]

        def cause_of(j: int) -> str:
            steps = int(self.steps[j])
            t = ends[j] if self.h is None or self.tau is not None else self.initial[0] + steps * self.h
            return failure_after(t, steps, str(self.status[j]))

        return {j: self.messages.get(j) or cause_of(j) for j in failed}

    @property
    def ends(self) -> tuple[Array, Array, Array]:
        """Time, positions and momenta of the last state of each trajectory: (k,), (k, m), (k, m).

        At common times, as of ``t_eval``, it is the crossing of the terminal event that ended a trajectory, before a
        change by the event; NaN for a trajectory that reached no time and no such event.
        """
        reached = np.isfinite(self.q).all(axis=2).sum(axis=0)
        last, j = reached - 1, np.arange(len(self))
        t, q, p = self.times[last, j], self.q[last, j], self.p[last, j]
        t[reached == 0] = np.nan
        for k, crossings in enumerate(self.events if self.t.ndim == 1 else ()):
            for crossing in crossings:
                if 0 < int(crossing.event.terminal) <= len(crossing):  # the number of the crossing that ends a run
                    t[k], q[k], p[k] = crossing.t[-1], crossing.q[-1], crossing.p[-1]
        return t, q, p

    def each(self) -> Iterator[tuple[Array, Array, Array, str, int]]:
        """Yield the times, positions and momenta of each trajectory, its status and its number of steps."""
        return map(self._one, range(len(self)))

    def _one(self, j: int) -> tuple[Array, Array, Array, str, int]:
        """Return the times, positions and momenta of trajectory j, its status and its number of steps."""
        good = self._reached(j)
        return self.times[good, j], self.q[good, j], self.p[good, j], str(self.status[j]), int(self.steps[j])

    def energy(self) -> Array:
        """Return (n, k) energies p.v - L; NaN after a failure, and for trajectories that leave the domain of L."""
        energies = self.stepper._states.missing(self.q.shape[:2])
        for j, good, parameters in self._with_modes():
            with suppress(StateError):
                energies[good, j] = self.stepper.energy(
                    self.q[good, j], self.p[good, j], self.times[good, j], parameters
                )
        return energies

    def energy_error(self) -> Array:
        """Return (k,) errors of the energy as of :meth:`Trajectory.energy_error`; NaN where it is unknown."""
        energies, errors = np.asarray(self.energy(), float), np.full(len(self), np.nan)
        for j in range(len(self)):
            if (reached := self._reached(j)).any() and np.isfinite(energies[reached, j]).all():
                with suppress(StateError):  # work at impacts
                    errors[j] = self[j].energy_error()
        return errors

    def action(self, *, cumulative: bool = False) -> Array:
        """Return (k,) actions, or (n, k) up to each state, as of :meth:`Trajectory.action`; NaN after a failure."""
        actions = np.full(self.q.shape[:2], np.nan) if self.actions is None else self.actions.copy()
        for j in range(len(self)):
            if np.isfinite(actions[self._reached(j), j]).all():
                continue
            actions[self._reached(j), j] = self[j].action(cumulative=True)
        last = [int(self._reached(j).nonzero()[0].max(initial=0)) for j in range(len(self))]  # 0: reached no time
        return actions if cumulative else np.where(self.ok, actions[last, np.arange(len(self))], np.nan)

    def momentum_maps(self) -> Array:
        """Return (n, k, c) values of the momentum maps ``stepper.momentum_map_names``; NaN as for :meth:`energy`."""
        return self._momentum_maps()[0]

    def momentum_errors(self) -> Array:
        """Return (n, k, c) changes of the momentum maps since the first state, relative to their largest term."""

        def bounds(small: NDArray[np.bool_]) -> Array:
            terms = np.zeros(small.shape)
            for j, good, parameters in self._with_modes():
                if small[j].any():
                    states = self.q[good, j], self.p[good, j], self.times[good, j]
                    terms[j] = np.maximum(terms[j], self.stepper._momentum_bounds(*states, parameters))
            return terms

        return relative_changes(*self._momentum_maps(), bounds)

    def _momentum_maps(self) -> tuple[Array, Array]:
        shape = (*self.q.shape[:2], len(self.stepper.momentum_map_names))
        values, sizes = self.stepper._states.missing(shape), np.full(shape, np.nan)
        for j, good, parameters in self._with_modes():
            with suppress(StateError):
                values[good, j], sizes[good, j] = self.stepper._momentum_maps_and_sizes(
                    self.q[good, j], self.p[good, j], self.times[good, j], parameters
                )
        return values, sizes

    def _with_parameters(self, these: Container[int] | None = None) -> Iterator[tuple[int, NDArray[np.intp], Array]]:
        """Yield trajectories, all or these, with the rows of their states and the parameters in these rows."""
        these = range(len(self)) if these is None else these
        for rows, some, parameters in self.spans or ((slice(None), slice(None), self.parameters.__getitem__),):
            for j, values in zip(range(*some.indices(len(self))), parameters(some), strict=True):
                if j in these and (good := np.flatnonzero(self._reached(j)[rows]) + (rows.start or 0)).size:
                    yield j, good, values

    def _with_modes(self) -> Iterator[tuple[int, NDArray[np.intp], Array]]:
        """Yield what :meth:`_with_parameters` does, with the modes after each state, for the rows of each mode."""
        columns = self.stepper.mode_columns
        for j, good, parameters in self._with_parameters():
            history = self.modes[j] if self.modes else None
            if history is None:
                yield j, good, parameters
                continue
            t = self.times[self._reached(j), j]
            forward = np.copysign(1.0, t[-1] - t[0])
            changes = number_until(history.t, self.times[good, j], forward)
            for number in np.unique(changes):
                values = parameters.copy()
                values[columns] = history.values[number]
                yield j, good[changes == number], values

    @checks_arguments()
    def save(self, path: str | os.PathLike[str], *, units: Mapping[str, str] | None = None) -> None:
        """Write a file in the format of its suffix, one of those of :meth:`Trajectory.save`, atomically.

        CSV files have one state a line (trajectory, t, q, p), number trajectories from 0, have columns for parameters
        that differ between trajectories, and omit states after a failure. HDF5 and Zarr files contain the variables of
        :meth:`to_xarray`.

        Raises:
            StateError: if the suffix is unknown, or the format has no units.
            MissingLibraryError: if h5netcdf or zarr is not installed (extra ``data``).
        """
        suffix, units_of = Path(path).suffix.lower(), checked_units(units)
        self._check_common_times()
        check_keeps_words(self.stepper.interface.words, path)
        if suffix in LABELLED:
            check_format(path)
            write_whole(path, lambda new: LABELLED[suffix].write(self._labelled(units_of), new))
            return
        write = {".npz": self._write_npz, ".csv": self._write_csv}.get(suffix)
        if write is None:
            raise StateError(f"cannot save an ensemble as {str(path)!r}: use {FORMATS}")
        if units_of:
            raise StateError(f"{suffix} files cannot store units: use {', '.join(LABELLED)}, or omit units")
        write_atomically(path, write)

    def to_xarray(self, *, units: Mapping[str, str] | None = None) -> xarray.Dataset:
        """Return a dataset of q, p, velocity, energy, momentum_map, parameters, status and steps.

        Args:
            units: as of :meth:`Trajectory.to_xarray`.

        Raises:
            StateError: if units name an unknown variable, or for states of two words.
            MissingLibraryError: if xarray is not installed (extra ``data``).
        """
        self._check_common_times()
        check_keeps_words(self.stepper.interface.words, "a dataset")
        return to_dataset(self._labelled(checked_units(units)))

    def _check_common_times(self) -> None:
        if self.stepper.in_tau:
            raise StateError("ensembles in transformed time cannot be saved: their trajectories have no common times")

    def _labelled(self, units: Mapping[str, str]) -> Labelled:
        """Return the arrays with named dimensions."""
        interface, of_states = self.stepper.interface, ("t", "trajectory")
        time = {"t": ("t",)} if self.t.ndim == 1 else {"time": of_states}
        dimensions: dict[str, tuple[str, ...]] = {**time, "coordinate": ("coordinate",), "energy": of_states}
        dimensions |= dict.fromkeys(("q", "p", "velocity"), (*of_states, "coordinate"))
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
            dimensions |= {"symmetry": ("symmetry",), "momentum_map": (*of_states, "symmetry")}
            whole["symmetry"] = np.array(interface.map_names)
        attitudes = named_quantities(interface)
        if attitudes:
            dimensions |= {axis: (axis,) for axis in AXES} | {
                item.name: (*of_states, *item.dimensions) for item in attitudes
            }
            whole |= AXES
        states = {"t": self.t, "time": self.t, "q": self.q, "p": self.p}
        return Labelled(
            dimensions=dimensions,
            pieces=lambda: iter([states | self._quantities()]),
            whole=whole,
            count=len(self.t),
            units={name: unit for name, unit in units.items() if name in dimensions},
            attributes=interface.about() | ({} if self.h is None else {"h": self.h}),
            long_names={item.name: item.long_name for item in attitudes},
        )

    def _quantities(self) -> dict[str, Array]:
        times = np.nan_to_num(self.times)
        result: dict[str, Array] = {}
        for j, good, parameters in self._with_modes():
            part = quantities(self.stepper, parameters, times[good, j], self.q[good, j], self.p[good, j])
            for name, values in part.items():
                shape = (*self.q.shape[:2], *values.shape[1:])
                result.setdefault(name, np.full(shape, np.nan))[good, j] = values
        return result

    def _reached(self, j: int) -> NDArray[np.bool_]:
        """Return (n,) flags of the states that trajectory j reached."""
        return np.asarray(np.isfinite(self.q[:, j]).all(axis=1), dtype=np.bool_)

    def _write_npz(self, file: IO[bytes]) -> None:
        others = {"observed": self.observed, "h": self.h}
        optional: dict[str, Any] = {name: values for name, values in others.items() if values is not None}
        for name in ("t", "q", "p", "parameters"):
            if isinstance(values := getattr(self, name), Words):
                optional[f"{name}_low"] = values.low
        np.savez(
            file,
            t=self.t,
            q=self.q,
            p=self.p,
            status=self.status,
            steps=self.steps,
            parameters=self.parameters,
            coordinates=np.array(self.stepper.coordinates),
            parameter_names=np.array(self.stepper.interface.parameters, dtype=str),
            title=self.stepper.title,
            **optional,
        )

    def _write_csv(self, file: IO[bytes]) -> None:
        names = self.stepper.coordinates
        varied = [i for i, column in enumerate(self.parameters.T) if (column != column[0]).any()]
        varying = [self.stepper.interface.parameters[i] for i in varied]
        header = ["trajectory", *varying, "t", *names, *(f"p_{n}" for n in names)]
        file.write((",".join(header) + "\n").encode())
        formats = ["%d"] + ["%.17g"] * (len(header) - 1)
        for j in range(len(self)):
            good = self._reached(j)
            label = np.broadcast_to([j, *self.parameters[j, varied]], (int(good.sum()), 1 + len(varied)))
            table = np.column_stack([label, self.times[good, j], self.q[good, j], self.p[good, j]])
            np.savetxt(file, table, delimiter=",", fmt=formats)
