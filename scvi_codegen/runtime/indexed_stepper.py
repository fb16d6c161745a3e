"""A compiled integrator of sums over indices, and what its runs give."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.counts import checked_count
from scvi_codegen.errors import StateError, StepFailedError
from scvi_codegen.kinds import FUNCTION, MAPPING, takes
from scvi_codegen.native.arguments import real_array
from scvi_codegen.native.binding import Binding
from scvi_codegen.native.building import TUNED_FLAGS, load
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.rendering.source import Source
from scvi_codegen.runtime.accuracy import warn_of_long_steps
from scvi_codegen.runtime.indexed_interface import IndexedInterface, Numbers
from scvi_codegen.runtime.indexed_run import IndexedRun

__all__ = ["IndexedStepper", "IndexedTrajectory"]


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


class IndexedStepper:
    """One method for one system of any number of coordinates, compiled once for all.

    Attributes:
        source: the C text.
        interface: names and shapes.
        flags: of the C compiler.
    """

    def __init__(self, source: Source, interface: IndexedInterface, *, flags: tuple[str, ...] = TUNED_FLAGS) -> None:
        self.source, self.interface, self.flags = source, interface, flags

    def __reduce__(self) -> tuple[Any, ...]:
        return (_rebuild, (self.source, self.interface, self.flags))

    def __repr__(self) -> str:
        return f"IndexedStepper({self.interface.title})"

    @property
    def momentum_map_names(self) -> tuple[str, ...]:
        """What symmetries conserve: shifts and turns of whole arrays."""
        return tuple(each.name for each in self.interface.maps)

    @cached_property
    def _binding(self) -> Binding:
        return Binding(load(self.source, flags=self.flags), self.interface.prefix)

    def start(
        self,
        q: ArrayLike | Mapping[str, ArrayLike],
        p: ArrayLike | Mapping[str, ArrayLike] | None = None,
        *,
        velocity: ArrayLike | Mapping[str, ArrayLike] | None = None,
        h: float,
        t: float = 0.0,
        parameters: Mapping[str, ArrayLike] | None = None,
        tables: Mapping[str, ArrayLike] | None = None,
        options: SolverOptions | None = None,
    ) -> IndexedRun:
        """A run; arguments as of :meth:`integrate`.

        Raises:
            StateError: on wrong names, shapes and numbers, and where an index would leave its array.
        """
        return IndexedRun(
            self.interface,
            self._binding,
            q=q,
            p=p,
            velocity=velocity,
            h=h,
            t=t,
            parameters=parameters,
            tables=tables,
            options=options,
        )

    def restore(self, saved: bytes, *, options: SolverOptions | None = None) -> IndexedRun:
        """The run whose :meth:`IndexedRun.save` gave these bytes, to go on exactly as it would have.

        Raises:
            StateError: for bytes that are no saved run, or one of another integrator.
        """
        return IndexedRun.restored(self.interface, self._binding, saved, options)

    @takes(StateError, parameters=MAPPING, tables=MAPPING, observe=FUNCTION, progress=FUNCTION)
    def integrate(
        self,
        q: ArrayLike | Mapping[str, ArrayLike],
        p: ArrayLike | Mapping[str, ArrayLike] | None = None,
        *,
        velocity: ArrayLike | Mapping[str, ArrayLike] | None = None,
        h: float,
        steps: int,
        every: int = 1,
        t: float = 0.0,
        parameters: Mapping[str, ArrayLike] | None = None,
        tables: Mapping[str, ArrayLike] | None = None,
        observe: Callable[[IndexedRun], ArrayLike] | None = None,
        options: SolverOptions | None = None,
        progress: Callable[[int], None] | None = None,
    ) -> IndexedTrajectory:
        """Run ``steps`` steps of h and keep every ``every``-th state, the initial one first.

        Args:
            q: initial positions: an array of the declared shape, or several by name. Their lengths are the sizes.
            p, velocity: momenta, or velocities in their place, in the same way; by default 0.
            h: step, negative to go back.
            steps, every: numbers of steps.
            t: initial time.
            parameters: numbers, and arrays of them, by name; others keep their defaults.
            tables: (rows, columns) whole numbers by name; (rows,) do for a single column.
            observe: what is kept of a state in place of all of it: a function of the run, whose ``t``, ``q``, ``p``,
                ``velocity``, ``energy`` are those of the moment; a number or an array, always of one shape.
            options: when sweeps end.
            progress: called now and then with the number of steps done.

        Returns:
            :class:`IndexedTrajectory`, steps // every + 1 states.

        Raises:
            StateError: on wrong names, shapes and numbers, where an index would leave its array, and for observations
                that are no real numbers or change their shape.
            StepFailedError: if a step fails; its ``trajectory`` holds the states before.
        """
        every = checked_count(every, "every", least=1)
        steps = checked_count(steps, "steps", least=0)
        run = self.start(q, p, velocity=velocity, h=h, t=t, parameters=parameters, tables=tables, options=options)
        kept = _Kept(run, observe)
        kept.take(keep=True)
        while run.steps < steps:
            try:
                run.advance(min(every, steps - run.steps), progress=progress)
            except StepFailedError as error:
                error.trajectory = kept.trajectory()
                raise
            if run.steps % every == 0:
                kept.take(keep=run.steps + every > steps)
        found = kept.trajectory()
        warn_of_long_steps(found, remedy="")
        return found


class _Kept:
    """What is kept of a run as it goes."""

    def __init__(self, run: IndexedRun, observe: Callable[[IndexedRun], ArrayLike] | None) -> None:
        self.run, self.observe = run, observe
        self.t: list[float] = []
        self.energies: list[tuple[float, float, float]] = []
        self.maps: list[Numbers] = []
        self.states: list[tuple[dict[str, Numbers], dict[str, Numbers]]] = []
        self.observed: list[Numbers] = []

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


def _rebuild(source: Source, interface: IndexedInterface, flags: tuple[str, ...]) -> IndexedStepper:
    return IndexedStepper(source, interface, flags=flags)
