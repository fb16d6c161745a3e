"""Result of a run with inputs: the trajectories between breakpoints, joined."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Self, TypeVar, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.files.export import States, to_dataframe, write_states
from scvi_codegen.files.labelled_arrays import to_dataset
from scvi_codegen.runtime.core.validation import Array, columns_of_inputs
from scvi_codegen.runtime.events.event import Crossings
from scvi_codegen.runtime.inputs.derivatives_with_inputs import DerivativesWithInputs
from scvi_codegen.runtime.run.descriptions import describe_states
from scvi_codegen.runtime.run.global_error import Confirmed, GlobalError
from scvi_codegen.runtime.trajectory.dense_output import checked_times, within
from scvi_codegen.runtime.trajectory.quantities import quantities
from scvi_codegen.runtime.trajectory.saved_states import checked_row, checked_rows
from scvi_codegen.runtime.trajectory.trajectory import Trajectory, relative_changes
from scvi_codegen.validation.argument_types import MAPPING, PATH, checks_arguments

if TYPE_CHECKING:
    import pandas
    import xarray

    from scvi_codegen.pictures.plots import Plots
    from scvi_codegen.runtime.core.integrator import Integrator

__all__ = ["DrivenTrajectory"]

Number = TypeVar("Number", bound=np.generic)


@dataclass(frozen=True, slots=True, eq=False)
class DrivenTrajectory(DerivativesWithInputs, Confirmed):
    """States along a run with inputs, and derived quantities evaluated with the parameters of each piece.

    Attributes:
        pieces: trajectories between breakpoints; the first state of each is the last of the previous one.
        confirmation: as of :class:`Trajectory`.
    """

    pieces: tuple[Trajectory, ...]
    confirmation: GlobalError | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        return describe_states(self, f", breakpoints between: {len(self.pieces) - 1}")

    @overload
    def __getitem__(self, rows: slice) -> Self: ...
    @overload
    def __getitem__(self, rows: int) -> tuple[float, Array, Array]: ...
    def __getitem__(self, rows: slice | int) -> Self | tuple[float, Array, Array]:
        """Return successive states as a trajectory, for a slice; (t, q, p) of one state, for a number.

        Slices must have stride 1, since pieces share the states at breakpoints; see :meth:`Trajectory.__getitem__`.

        Raises:
            IndexError: if a row is out of range, or a slice is empty, descending or has a stride.
        """
        if not isinstance(rows, slice):
            k = checked_row(rows, len(self))
            return float(self.t[k]), self.q[k], self.p[k]
        first, last, stride = checked_rows(rows, len(self))
        if stride > 1:
            raise IndexError(
                f"a slice of a run with inputs must have stride 1, unlike {rows}: omit the stride, or slice the arrays "
                "t, q and p"
            )
        chosen: list[Trajectory] = []
        start = 0
        for piece in self.pieces:
            low, high = max(first - start, 0), min(last - start, len(piece))
            start += len(piece) - 1
            if high - low > 1 or (high - low == 1 == last - first and not chosen):
                chosen.append(piece[low:high])
        return replace(self, pieces=tuple(chosen))

    @property
    def t(self) -> Array:
        """(n,) times."""
        return self._joined(lambda piece: piece.t)

    @property
    def q(self) -> Array:
        """(n, m) positions."""
        return self.stepper.named(self._joined(lambda piece: piece.q))

    @property
    def p(self) -> Array:
        """(n, m) momenta."""
        return self.stepper.named(self._joined(lambda piece: piece.p))

    @property
    def velocity(self) -> Array:
        """(n, m) velocities."""
        return self.stepper.named(self._joined(lambda piece: piece.velocity))

    @property
    def iterations(self) -> NDArray[np.int32]:
        """(n,) solver iterations since the previous saved state."""
        return self._joined(lambda piece: piece.iterations)

    @property
    def steps(self) -> int:
        """Number of steps since the start."""
        return self.pieces[-1].steps

    @property
    def stepper(self) -> Integrator:
        """The compiled integrator."""
        return self.pieces[0].stepper

    @property
    def h(self) -> float:
        """Size of the first step."""
        return self.pieces[0].h

    @property
    def parameters(self) -> Array:
        """(k,) parameter values of the first piece; those of inputs differ between pieces."""
        return self.pieces[0].parameters

    @property
    def events(self) -> tuple[Crossings, ...]:
        """The zero crossings found, parallel to ``stepper.events``."""
        return tuple(map(_joined_crossings, zip(*(piece.events for piece in self.pieces), strict=True)))

    @property
    def step_error(self) -> float:
        """Largest relative step error of the run, as of :class:`Trajectory`."""
        return self.pieces[-1].step_error

    @property
    def worst_step_time(self) -> float:
        """Start time of the step with the largest error."""
        return self.pieces[-1].worst_step_time

    def __len__(self) -> int:
        return len(self.t)

    def energy(self) -> Array:
        """Return (n,) energies p.v - L."""
        return self._joined(lambda piece: piece.energy())

    @property
    def observed(self) -> None:
        """``None``: runs with inputs save all states."""

    @property
    def energies(self) -> Array:
        """(n, 3) energies, as of :class:`Trajectory`."""
        return self._joined(lambda piece: piece.energies)

    def momentum_maps(self) -> Array:
        """Return (n, k) values of the conserved quantities."""
        return self._joined(lambda piece: piece.momentum_maps())

    def momentum_errors(self) -> Array:
        """Return (n, k) changes of the momentum maps since the first state, relative to their largest term."""
        errors = [
            self.stepper._momentum_maps_and_sizes(piece.q, piece.p, piece.t, piece.parameters) for piece in self.pieces
        ]
        values, sizes = (_concatenated(part) for part in zip(*errors, strict=True))
        return relative_changes(values, sizes)

    def constraint_values(self) -> tuple[Array, Array]:
        """Return (n, c) constraint residuals and (n, c) rates at the states."""
        values = zip(*(piece.constraint_values() for piece in self.pieces), strict=True)
        g, rate = (_concatenated(part) for part in values)
        return g, rate

    def multipliers(self) -> Array:
        """Return (n, c) Lagrange multipliers of the constraints."""
        return self._joined(lambda piece: piece.multipliers())

    def work(self) -> Array:
        """Return (n,) work of the forces since the first state."""
        return self._summed(lambda piece: piece.work())

    def impulses(self) -> Array:
        """Return (n, k) changes of the momentum maps by forces since the first state."""
        return self._summed(lambda piece: piece.impulses())

    def at(self, t: ArrayLike) -> tuple[Array, Array]:
        """Return dense output at times t, as :meth:`Trajectory.at`."""
        times = checked_times(t, "t")
        first, last = self.pieces[0].t[0], self.pieces[-1].t[-1]
        flat, m = within(times.ravel(), first, last), self.stepper.dimension
        q, p = np.empty((2, len(flat), m))
        forward = self.pieces[0].forward
        ends = forward * np.array([piece.t[-1] for piece in self.pieces])
        number = np.minimum(np.searchsorted(ends, forward * flat), len(ends) - 1)
        for k in np.unique(number):
            q[number == k], p[number == k] = self.pieces[k].at(flat[number == k])
        named = self.stepper.named
        return named(q.reshape(*times.shape, m)), named(p.reshape(*times.shape, m))

    @property
    def plot(self) -> Plots:
        """Plots, as of :attr:`Trajectory.plot`."""
        from scvi_codegen.pictures.plots import Plots

        return Plots(self)

    def states(self, units: Mapping[str, str] | None = None) -> States:
        """Return the states for :mod:`scvi_codegen.files.export`; the parameters of inputs are omitted."""
        input_parameters = {self.stepper.parameters[k] for k in columns_of_inputs(self.stepper.interface)}
        by_piece = [quantities(self.stepper, piece.parameters, piece.t, piece.q, piece.p) for piece in self.pieces]
        joined_quantities = {name: _concatenated([each[name] for each in by_piece]) for name in by_piece[0]}
        common, piece = self.pieces[0].states(units), (self.t, self.q, self.p, self.iterations)
        return replace(
            common,
            count=len(self),
            pieces=lambda: iter([piece]),
            parameters={name: value for name, value in common.parameters.items() if name not in input_parameters},
            quantities=lambda *_: joined_quantities,
        )

    @checks_arguments(path=PATH, units=MAPPING)
    def save(self, path: str | os.PathLike[str], *, units: Mapping[str, str] | None = None) -> None:
        """Write a file as :meth:`Trajectory.save` does."""
        write_states(self.states(units), path)

    def to_xarray(self, *, units: Mapping[str, str] | None = None) -> xarray.Dataset:
        """Return a dataset, as :meth:`Trajectory.to_xarray`."""
        return to_dataset(self.states(units).labelled())

    def to_dataframe(self) -> pandas.DataFrame:
        """Return a data frame, as :meth:`Trajectory.to_dataframe`."""
        return to_dataframe(self.states())

    def _joined(self, part: Callable[[Trajectory], NDArray[Number]]) -> NDArray[Number]:
        return _concatenated([part(piece) for piece in self.pieces])

    def _summed(self, part: Callable[[Trajectory], Array]) -> Array:
        parts = [part(piece) for piece in self.pieces]
        for before, after in pairwise(parts):
            after += before[-1]
        return _concatenated(parts)


def _concatenated(parts: Sequence[NDArray[Number]]) -> NDArray[Number]:
    """Concatenate arrays of successive pieces; the first state of each repeats the last of the previous one."""
    first, *others = parts
    return np.concatenate([first, *(other[1:] for other in others)])


def _joined_crossings(crossings: Sequence[Crossings]) -> Crossings:
    """Concatenate the crossings of one event over all pieces."""
    t, q, p = (np.concatenate([getattr(each, name) for each in crossings]) for name in ("t", "q", "p"))
    return Crossings(event=crossings[0].event, t=t, q=q, p=p)
