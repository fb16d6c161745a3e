"""A compiled integrator of sums over indices, and what its runs give."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cached_property
from typing import Any

from numpy.typing import ArrayLike

from scvi_codegen.counts import checked_count
from scvi_codegen.errors import StateError
from scvi_codegen.kinds import FUNCTION, MAPPING, takes
from scvi_codegen.native.binding import Binding
from scvi_codegen.native.building import TUNED_FLAGS, load
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.rendering.source import Source
from scvi_codegen.runtime.accuracy import warn_of_long_steps
from scvi_codegen.runtime.indexed_interface import IndexedInterface
from scvi_codegen.runtime.indexed_run import IndexedRun
from scvi_codegen.runtime.indexed_trajectory import IndexedRecord, IndexedTrajectory

__all__ = ["IndexedStepper"]


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
        kept = IndexedRecord(run, observe)
        kept.follow(steps, every, progress=progress)
        found = kept.trajectory()
        warn_of_long_steps(found, remedy="")
        return found


def _rebuild(source: Source, interface: IndexedInterface, flags: tuple[str, ...]) -> IndexedStepper:
    return IndexedStepper(source, interface, flags=flags)
