"""What is kept of a run over arrays: states, energies, momentum maps; and how it is kept as the run goes on."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self, overload

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.errors import StateError, StepFailedError
from scvi_codegen.files.export import write_whole
from scvi_codegen.native.arguments import real_array
from scvi_codegen.runtime.dense_output import checked_times
from scvi_codegen.runtime.events import Event
from scvi_codegen.runtime.global_error import Confirmed, GlobalError
from scvi_codegen.runtime.goal import Goal
from scvi_codegen.runtime.indexed_between import Departure, states_between
from scvi_codegen.runtime.indexed_events import IndexedCrossings, IndexedSearch
from scvi_codegen.runtime.indexed_interface import Numbers
from scvi_codegen.runtime.indexed_run import IndexedRun
from scvi_codegen.runtime.kept_states import checked_row, checked_rows

__all__ = ["IndexedRecord", "IndexedTrajectory", "check_npz"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IndexedTrajectory(Confirmed):
    """States along a run of k kept states, the initial one first.

    Attributes:
        t: (k,) times.
        q, p: positions and momenta by the name of their array, (k, ..) each; where a run was observed, the first and
            the last state alone.
        observed: (k, ..) what the observer returned, or ``None``.
        energies: (k, 3) kinetic and potential energy, and their sum.
        maps: (k, count) what symmetries conserve, in the order of ``stepper.momentum_map_names``.
        inverse_masses: 1/m of every coordinate, of the shape of one state; nothing where a Hamiltonian is given.
        h: step, or that of the last where steps choose their length; steps: their number; iterations: sweeps of all.
        step_error, step_error_t: an estimate of the error of the end of the worst step, relative to the largest
            coordinate, and when it began; not numbers for explicit methods.
        goal: where steps lead that choose their length; rejected: those that were taken again, shorter.
        events: what was found of each event, in their order.
        departures: how the run goes on from each state, for those between.
        confirmation: the comparison with a second run where ``error=`` asked for one, else ``None``.
    """

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
    step_error_t: float
    goal: Goal | None = None
    rejected: int = 0
    events: tuple[IndexedCrossings, ...] = ()
    departures: tuple[Departure, ...] = field(default=(), repr=False)
    confirmation: GlobalError | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        arrays = ", ".join(f"{name} {values.shape}" for name, values in self.q.items())
        lengths = "" if self.goal else f" of {self.h:g}"
        return f"<IndexedTrajectory of {self.steps} steps{lengths}: {arrays}>"

    def __len__(self) -> int:
        return len(self.t)

    @overload
    def __getitem__(self, rows: slice) -> Self: ...
    @overload
    def __getitem__(self, rows: int) -> tuple[float, dict[str, Numbers], dict[str, Numbers]]: ...
    def __getitem__(self, rows: slice | int) -> Self | tuple[float, dict[str, Numbers], dict[str, Numbers]]:
        """Return some of the states as a trajectory, for a slice; t, and q and p by array, of one state, for a number.

        Events outside the times of a slice are left out; ``steps`` and ``step_error`` stay those of the whole run.

        Raises:
            IndexError: for a state that is not there, and for a slice that is empty or goes backward.
            StateError: where states were not kept.
        """
        if len(self.departures) < len(self.t):
            raise StateError("states of an observed run are not kept: leave out observe, or index t and observed")
        if not isinstance(rows, slice):
            k = checked_row(rows, len(self))
            q, p = ({name: each[k].copy() for name, each in part.items()} for part in (self.q, self.p))
            return float(self.t[k]), q, p
        first, last, stride = checked_rows(rows, len(self))
        low, high = sorted((self.t[first], self.t[range(first, last, stride)[-1]]))
        return replace(
            self,
            **{name: getattr(self, name)[rows] for name in ("t", "energies", "maps", "departures")},
            q={name: each[rows] for name, each in self.q.items()},
            p={name: each[rows] for name, each in self.p.items()},
            events=tuple(found.chosen((found.t >= low) & (found.t <= high)) for found in self.events),
        )

    def at(self, t: ArrayLike) -> tuple[dict[str, Numbers], dict[str, Numbers]]:
        """Positions and momenta at (n,) times between those kept, (n, ..) by the name of their array.

        By steps of the method itself from the kept state before, the last of them shorter.

        Raises:
            StateError: for times outside, and where states were not kept.
            StepFailedError: if such a step fails.
        """
        if len(self.departures) < len(self.t):
            raise StateError("states between need all that were kept whole: leave out observe")
        return states_between(self.departures, self.t, self.q, self.p, checked_times(t, "t"))

    @property
    def velocity(self) -> dict[str, Numbers]:
        """Velocities by the name of the array of their coordinates, of the shape of ``p``.

        Raises:
            StateError: where a Hamiltonian is given.
        """
        if not self.inverse_masses:
            raise StateError("where a Hamiltonian is given, a state is positions and momenta: velocities are not known")
        return {name: p * self.inverse_masses[name] for name, p in self.p.items()}

    def energy(self) -> Numbers:
        """Energy p . v - L, or H, at each state (k,)."""
        return self.energies[:, 2]

    def energy_error(self) -> float:
        """The largest change of the energy over all kept states, relative to the sizes of its two parts."""
        largest = float(np.max(np.abs(self.energies[:, :2]).sum(axis=1)))
        return float(np.max(np.abs(self.energy() - self.energy()[0]))) / (largest or 1.0)

    def momentum_maps(self) -> Numbers:
        """What symmetries conserve, at each state (k, count)."""
        return self.maps

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write ``.npz``, whole or not at all: arrays t, q_NAME and p_NAME of every array, energies, maps, observed, h.

        Raises:
            StateError: for another suffix.
        """
        check_npz(path)
        states = {f"{key}_{name}": values for key in "qp" for name, values in getattr(self, key).items()}
        observed = {} if self.observed is None else {"observed": self.observed}
        arrays = {"t": self.t, "energies": self.energies, "maps": self.maps, **states, **observed}
        write_whole(path, lambda place: np.savez(place, h=self.h, **arrays))


class IndexedRecord:
    """What is kept of a run as it goes.

    Args:
        run: at its start.
        observe: what is kept of a state in place of all of it.
        events: zeros of functions to look for.
    """

    def __init__(
        self,
        run: IndexedRun,
        observe: Callable[[IndexedRun], ArrayLike] | None = None,
        events: Sequence[Event] = (),
    ) -> None:
        self.run, self.observe = run, observe
        self.search = IndexedSearch(run, events) if events else None
        self.departures: list[Departure] = []
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
        """The first state, every so many-th of so many steps or of those that lead to a goal, and the one there.

        Raises:
            StepFailedError: if one fails; its ``trajectory`` holds the states before.
        """
        self.take(keep=True)
        self.go_on(steps, save_every, progress=progress, stop=stop)

    def go_on(
        self,
        steps: float,
        save_every: int,
        *,
        progress: Callable[[int], None] | None = None,
        stop: Callable[[], bool] | None = None,
        to_end: bool = False,
    ) -> None:
        """The same without the first state; the last is kept, too, if it is wanted."""
        run, last = self.run, self.run.steps
        self.departures[-1] = Departure.of(run)
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
        """Whether the run is at its goal, or at an event that ends it."""
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
        """The present state, whole if nobody observes or it is to be kept."""
        self.t.append(self.run.t)
        self.energies.append(self.run.energies)
        self.maps.append(self.run.momentum_maps)
        if self.observe is not None:
            self.observed.append(self._observed(self.observe(self.run)))
        if keep or self.observe is None:
            self.states.append((self.run.q, self.run.p))
            self.departures.append(Departure.of(self.run))

    def _observed(self, given: ArrayLike) -> Numbers:
        found, when = real_array(given, "what observe returns"), f"at t = {self.run.t:g}"
        if self.observed and found.shape != self.observed[0].shape:
            raise StateError(f"observe returns the shape {found.shape} {when}, {self.observed[0].shape} at the start")
        return found

    def trajectory(self) -> IndexedTrajectory:
        """All of it."""
        run = self.run
        names = [array.name for array in run.interface.coordinates]
        return IndexedTrajectory(
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
            step_error_t=run.step_error_t,
            goal=run.goal,
            rejected=run.rejected,
            events=self.search.crossings() if self.search else (),
            departures=tuple(self.departures),
        )


def check_npz(path: str | os.PathLike[str]) -> None:
    """Raise :class:`StateError` for a file of another format."""
    if Path(path).suffix.lower() != ".npz":
        raise StateError(f"trajectories of arrays are saved as .npz, not as {str(path)!r}")
