"""What is kept of a run over arrays: states, energies, momentum maps; and how it is kept as the run goes on."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.errors import StateError, StepFailedError
from scvi_codegen.files.export import write_whole
from scvi_codegen.native.arguments import real_array
from scvi_codegen.runtime.indexed_interface import Numbers
from scvi_codegen.runtime.indexed_run import IndexedRun

__all__ = ["IndexedRecord", "IndexedTrajectory", "check_npz"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IndexedTrajectory:
    """States along a run of k kept states, the initial one first.

    Attributes:
        t: (k,) times.
        q, p: positions and momenta by the name of their array, (k, ..) each; where a run was observed, the first and
            the last state alone.
        observed: (k, ..) what the observer returned, or ``None``.
        energies: (k, 3) kinetic and potential energy, and their sum.
        maps: (k, count) what symmetries conserve, in the order of ``stepper.momentum_map_names``.
        inverse_masses: 1/m of every coordinate, of the shape of one state; nothing where a Hamiltonian is given.
        h: step; steps: their number; iterations: sweeps of all of them.
        step_error, step_error_t: an estimate of the error of the end of the worst step, relative to the largest
            coordinate, and when it began; not numbers for explicit methods.
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
    goal: None = None

    def __repr__(self) -> str:
        arrays = ", ".join(f"{name} {values.shape}" for name, values in self.q.items())
        return f"<IndexedTrajectory of {self.steps} steps of {self.h:g}: {arrays}>"

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
    """What is kept of a run as it goes."""

    def __init__(self, run: IndexedRun, observe: Callable[[IndexedRun], ArrayLike] | None = None) -> None:
        self.run, self.observe = run, observe
        self.t: list[float] = []
        self.energies: list[tuple[float, float, float]] = []
        self.maps: list[Numbers] = []
        self.states: list[tuple[dict[str, Numbers], dict[str, Numbers]]] = []
        self.observed: list[Numbers] = []

    def follow(
        self,
        steps: int,
        every: int,
        *,
        progress: Callable[[int], None] | None = None,
        stop: Callable[[], bool] | None = None,
    ) -> None:
        """The first state, and every so many-th of so many steps.

        Raises:
            StepFailedError: if one fails; its ``trajectory`` holds the states before.
        """
        self.take(keep=True)
        while self.run.steps < steps and not (stop and stop()):
            try:
                self.run.advance(
                    min(every - self.run.steps % every, steps - self.run.steps), progress=progress, stop=stop
                )
            except StepFailedError as error:
                error.trajectory = self.trajectory()
                raise
            if self.run.steps % every == 0:
                self.take(keep=self.run.steps + every > steps)

    def take(self, *, keep: bool) -> None:
        """The present state, whole if nobody observes or it is to be kept."""
        self.t.append(self.run.t)
        self.energies.append(self.run.energies)
        self.maps.append(self.run.momentum_maps)
        if self.observe is not None:
            self.observed.append(self._observed(self.observe(self.run)))
        if keep or self.observe is None:
            self.states.append((self.run.q, self.run.p))

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
        )


def check_npz(path: str | os.PathLike[str]) -> None:
    """Raise :class:`StateError` for a file of another format."""
    if Path(path).suffix.lower() != ".npz":
        raise StateError(f"trajectories of arrays are saved as .npz, not as {str(path)!r}")
