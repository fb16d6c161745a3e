"""Trajectory of a run over arrays: states, energies, momentum maps; and their recording during the run."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Self, overload

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.errors import StateError, StepFailedError
from scvi_codegen.files.export import write_whole
from scvi_codegen.native.arguments import real_array
from scvi_codegen.representation import LONGEST, clipped
from scvi_codegen.runtime.arrays.dense_output import Continuation, states_between
from scvi_codegen.runtime.arrays.events import ArrayCrossings, ArraySearch
from scvi_codegen.runtime.arrays.interface import Numbers
from scvi_codegen.runtime.arrays.run import ArrayRun
from scvi_codegen.runtime.arrays.run_time_sizes import RunTimeSizes
from scvi_codegen.runtime.events.event import Event
from scvi_codegen.runtime.run.global_error import Confirmed, GlobalError
from scvi_codegen.runtime.run.step_plan import StepPlan
from scvi_codegen.runtime.trajectory.dense_output import checked_times
from scvi_codegen.runtime.trajectory.saved_states import checked_row, checked_rows
from scvi_codegen.runtime.trajectory.trajectory import Trajectory

__all__ = ["ArrayRecord", "ArrayTrajectory", "check_npz"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ArrayTrajectory(Confirmed, RunTimeSizes):
    """States along a run at k times, beginning with the initial one.

    Attributes:
        t: (k,) times.
        q, p: positions and momenta by array name, (k, ..) each; only the first and the last state with ``observe``.
        observed: (k, ..) values that ``observe`` returned, or ``None``.
        energies: (k, 3) kinetic, potential and total energy.
        maps: (k, count) conserved quantities, in the order of ``stepper.momentum_map_names``.
        inverse_masses: 1/m of every coordinate, in the shape of one state; empty for a Hamiltonian.
        h: step size, that of the last step if adaptive.
        steps, iterations: numbers of steps and of solver iterations.
        step_error, worst_step_time: estimated error of the worst step, relative to the largest coordinate, and its
            start time; NaN for explicit methods.
        plan: step plan of adaptive steps, else ``None``.
        rejected_steps: number of rejected adaptive steps.
        events: crossings of each event, in their order.
        continuations: data for dense output after each state.
        confirmation: the comparison with a second run if ``error=`` was passed, else ``None``.
    """

    COUNTERPART: ClassVar[type] = Trajectory
    t: Numbers
    q: Mapping[str, Numbers]
    p: Mapping[str, Numbers]
    observed: Numbers | None
    energies: Numbers
    maps: Numbers
    inverse_masses: Mapping[str, Numbers]
    h: float
    steps: int
    iterations: int
    step_error: float
    worst_step_time: float
    plan: StepPlan | None = None
    rejected_steps: int = 0
    events: tuple[ArrayCrossings, ...] = ()
    continuations: tuple[Continuation, ...] = field(default=(), repr=False)
    confirmation: GlobalError | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        arrays = ", ".join(f"{name} {values.shape}" for name, values in self.q.items())
        lengths = "" if self.plan else f" of {self.h:g}"
        return clipped(f"<ArrayTrajectory of {self.steps} steps{lengths}: {arrays}>", LONGEST)

    def __len__(self) -> int:
        return len(self.t)

    @overload
    def __getitem__(self, rows: slice) -> Self: ...
    @overload
    def __getitem__(self, rows: int) -> tuple[float, dict[str, Numbers], dict[str, Numbers]]: ...
    def __getitem__(self, rows: slice | int) -> Self | tuple[float, dict[str, Numbers], dict[str, Numbers]]:
        """Return a trajectory for a slice, or t, q and p of one state for an index.

        Events outside the times of a slice are omitted; ``steps`` and ``step_error`` remain those of the whole run.

        Raises:
            IndexError: if an index is out of range, or a slice is empty or descending.
            StateError: if states were not saved.
        """
        if len(self.continuations) < len(self.t):
            raise StateError("a run with observe saves no states: omit observe, or index t and observed")
        if not isinstance(rows, slice):
            k = checked_row(rows, len(self))
            q, p = ({name: each[k].copy() for name, each in part.items()} for part in (self.q, self.p))
            return float(self.t[k]), q, p
        first, last, stride = checked_rows(rows, len(self))
        low, high = sorted((self.t[first], self.t[range(first, last, stride)[-1]]))
        return replace(
            self,
            **{name: getattr(self, name)[rows] for name in ("t", "energies", "maps", "continuations")},
            q={name: each[rows] for name, each in self.q.items()},
            p={name: each[rows] for name, each in self.p.items()},
            events=tuple(crossings.chosen((crossings.t >= low) & (crossings.t <= high)) for crossings in self.events),
        )

    def at(self, t: ArrayLike) -> tuple[dict[str, Numbers], dict[str, Numbers]]:
        """Return dense output: positions and momenta by array name, (n, ..) at (n,) times.

        Computed by steps of the method from the saved state before, the last of them shorter.

        Raises:
            StateError: if a time is outside the run, or states were not saved.
            StepFailedError: if such a step fails.
        """
        if len(self.continuations) < len(self.t):
            raise StateError("dense output requires all saved states in full: omit observe")
        return states_between(self.continuations, self.t, self.q, self.p, checked_times(t, "t"))

    @property
    def velocity(self) -> dict[str, Numbers]:
        """Velocities by the name of the coordinate array, in the shape of ``p``.

        Raises:
            StateError: if the system is defined by a Hamiltonian.
        """
        if not self.inverse_masses:
            raise StateError("velocities are unavailable for a system defined by a Hamiltonian: use the momenta p")
        return {name: p * self.inverse_masses[name] for name, p in self.p.items()}

    def energy(self) -> Numbers:
        """Return the (k,) energies p . v - L, or H."""
        return self.energies[:, 2]

    def energy_error(self) -> float:
        """Return the largest change of the energy, relative to the largest sum of its absolute parts."""
        largest = float(np.max(np.abs(self.energies[:, :2]).sum(axis=1)))
        return float(np.max(np.abs(self.energy() - self.energy()[0]))) / (largest or 1.0)

    def momentum_maps(self) -> Numbers:
        """Return the (k, count) conserved quantities."""
        return self.maps

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write ``.npz`` atomically: arrays t, q_NAME and p_NAME of every array, energies, maps, observed, h.

        Raises:
            StateError: if the suffix is another.
        """
        check_npz(path)
        states = {f"{key}_{name}": values for key in "qp" for name, values in getattr(self, key).items()}
        observed = {} if self.observed is None else {"observed": self.observed}
        arrays = {"t": self.t, "energies": self.energies, "maps": self.maps, **states, **observed}
        write_whole(path, lambda temporary: np.savez(temporary, h=self.h, **arrays))


class ArrayRecord:
    """Recorder of a run.

    Args:
        run: the run at its start.
        observe: function that returns the data to save instead of the whole state.
        events: events to detect.
    """

    def __init__(
        self,
        run: ArrayRun,
        observe: Callable[[ArrayRun], ArrayLike] | None = None,
        events: Sequence[Event] = (),
    ) -> None:
        self.run, self.observe = run, observe
        self.search = ArraySearch(run, events) if events else None
        self.continuations: list[Continuation] = []
        self.t: list[float] = []
        self.energies: list[tuple[float, float, float]] = []
        self.maps: list[Numbers] = []
        self.states: list[tuple[dict[str, Numbers], dict[str, Numbers]]] = []
        self.observed: list[Numbers] = []

    def follow(
        self,
        steps: float,
        save_every: int,
        *,
        progress: Callable[[int], None] | None = None,
        stop: Callable[[], bool] | None = None,
    ) -> None:
        """Record the initial state and every ``save_every``-th state up to step ``steps`` or the target time.

        Raises:
            StepFailedError: if a step fails; its ``trajectory`` contains the states before.
        """
        self.take(keep=True)
        self.continue_recording(steps, save_every, progress=progress, stop=stop)

    def continue_recording(
        self,
        steps: float,
        save_every: int,
        *,
        progress: Callable[[int], None] | None = None,
        stop: Callable[[], bool] | None = None,
        to_end: bool = False,
    ) -> None:
        """Continue recording as :meth:`follow`; with ``to_end`` the last state is saved as well."""
        run, last = self.run, self.run.steps
        self.continuations[-1] = Continuation.of(run)
        while run.steps < steps and not self.ended and not (stop and stop()):
            try:
                self._advance(int(min(save_every - run.steps % save_every, steps - run.steps)), progress, stop)
            except StepFailedError as error:
                error.trajectory = self.trajectory()
                raise
            arrived = self.ended or (to_end and run.steps >= steps)
            if run.steps % save_every == 0 or arrived:
                self.take(keep=arrived or run.steps + save_every > steps)
                last = run.steps
        if to_end and last != run.steps:
            self.take(keep=True)

    @property
    def ended(self) -> bool:
        """Return whether the run is at its target time or at a terminal event."""
        return self.run.arrived or (self.search is not None and self.search.ended)

    def _advance(self, steps: int, progress: Callable[[int], None] | None, stop: Callable[[], bool] | None) -> None:
        if self.search is None:
            self.run.advance(steps, progress=progress, stop=stop)
            return
        for _ in range(steps):
            self.search.step()
            if progress is not None:
                progress(self.run.steps)
            if self.ended or (stop and stop()):
                return

    def take(self, *, keep: bool) -> None:
        """Save the present state, in full without an observer or with ``keep``."""
        self.t.append(self.run.t)
        self.energies.append(self.run.energies)
        self.maps.append(self.run.momentum_maps)
        if self.observe is not None:
            self.observed.append(self._observed(self.observe(self.run)))
        if keep or self.observe is None:
            self.states.append((self.run.q, self.run.p))
            self.continuations.append(Continuation.of(self.run))

    def _observed(self, value: ArrayLike) -> Numbers:
        array, when = real_array(value, "the result of observe"), f"at t = {self.run.t:g}"
        if self.observed and array.shape != self.observed[0].shape:
            raise StateError(
                f"the result of observe must keep its shape: {array.shape} {when}, {self.observed[0].shape} before"
            )
        return array

    def trajectory(self) -> ArrayTrajectory:
        """Return the recorded trajectory."""
        run = self.run
        names = list(run.interface.coordinates)
        return ArrayTrajectory(
            t=np.array(self.t),
            q={name: np.array([q[name] for q, _ in self.states]) for name in names},
            p={name: np.array([p[name] for _, p in self.states]) for name in names},
            observed=np.array(self.observed) if self.observe is not None else None,
            energies=np.array(self.energies),
            maps=np.array(self.maps),
            inverse_masses=run.inverse_masses,
            h=run.h,
            steps=run.steps,
            iterations=run.iterations,
            step_error=run.step_error,
            worst_step_time=run.worst_step_time,
            plan=run.plan,
            rejected_steps=run.rejected_steps,
            events=self.search.crossings() if self.search else (),
            continuations=tuple(self.continuations),
        )


def check_npz(path: str | os.PathLike[str]) -> None:
    """Raise :class:`StateError` unless the suffix is ``.npz``."""
    if Path(path).suffix.lower() != ".npz":
        raise StateError(f"cannot save a trajectory of arrays as {str(path)!r}: use .npz")
