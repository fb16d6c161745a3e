"""The result of an integration: arrays, diagnostics, files and tables."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Self, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.display.cards import Html, card, grid, listed, plain, sparkline
from scvi_codegen.errors import EventError, StateError, StepFailedError
from scvi_codegen.files.export import States, to_dataframe, write_states
from scvi_codegen.files.labelled import checked_units, to_dataset
from scvi_codegen.given.kinds import MAPPING, PATH, takes
from scvi_codegen.runtime.accuracy import TOLERABLE_ERROR
from scvi_codegen.runtime.constraints import constraint_values, multipliers
from scvi_codegen.runtime.dense_output import checked_times, states_at
from scvi_codegen.runtime.event_search import crossings_of
from scvi_codegen.runtime.events import Crossings, Event, EventLike, as_events
from scvi_codegen.runtime.exchanges import exchanged_until
from scvi_codegen.runtime.global_error import Confirmed, GlobalError
from scvi_codegen.runtime.kept_states import Array, checked_row, checked_rows
from scvi_codegen.runtime.nearby import NearbyMotions
from scvi_codegen.runtime.quantities import quantities
from scvi_codegen.runtime.standing import holds, lengths_of

if TYPE_CHECKING:
    import pandas
    import xarray

    from scvi_codegen.pictures.animation import Film
    from scvi_codegen.pictures.plots import Plots

__all__ = ["Trajectory", "relative_changes"]

MOST_DRAWN, MOST_CURVES = 400, 6
"""States, and coordinates, that a notebook draws."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Trajectory(NearbyMotions, Confirmed):
    """States along a run, the initial one first.

    Attributes:
        t: (n,) times.
        q: (n, m) positions.
        p: (n, m) momenta.
        iterations: (n,) Newton iterations since the state before, 0 for the first.
        h: step size (negative: backward).
        lengths: (n,) of the step that follows each state, h for steps that are all the same; not a number for a state
            between two steps, of ``t_eval`` or where an event ended the run.
        tau: (n,) of a system in transformed time (:func:`~scvi_codegen.reparametrise`): h and lengths are steps of it;
            else ``None``.
        parameters: (k,) values in the order of ``stepper.parameters``.
        stepper: the compiled integrator.
        options: convergence of the stage equations, ``None`` for the defaults.
        events: the zero crossings found, parallel to ``stepper.events``.
        goal: where steps that choose their length led, and their tolerance; ``h`` is then the first of them.
        steps, rejected: taken since the start of the run; tried, and repeated shorter.
        step_error, step_error_t: an estimate of the relative error of the worst step of the run, beside its state, or
            beside the largest of the run where that is near rest at the origin; and when it began. Not numbers for
            methods without a curve to tell them from, or with curves that are no polynomials.
        confirmation: the comparison with a second run where ``error=`` asked for one, else ``None``.
    """

    iterations: NDArray[np.int32]
    events: tuple[Crossings, ...] = ()
    steps: int = 0
    rejected: int = 0
    step_error: float = np.nan
    step_error_t: float = np.nan
    confirmation: GlobalError | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        return holds(self, lengths_of(self.h, self.goal, tau=self.tau is not None))

    @overload
    def __getitem__(self, rows: slice) -> Self: ...
    @overload
    def __getitem__(self, rows: int) -> tuple[float, Array, Array]: ...
    def __getitem__(self, rows: slice | int) -> Self | tuple[float, Array, Array]:
        """Return some of the states as a trajectory, for a slice; (t, q, p) of one state, for a number.

        Events outside the times of a slice are left out; ``steps`` and ``step_error`` stay those of the whole run.

        Raises:
            IndexError: for a state that is not there, and for a slice that is empty or goes backward.
        """
        if not isinstance(rows, slice):
            k = checked_row(rows, len(self))
            return float(self.t[k]), self.q[k].copy(), self.p[k].copy()
        first, last, stride = checked_rows(rows, len(self))
        lengths = self.lengths[rows]
        if stride > 1 and self.goal is not None:  # the next state kept is not the end of the step
            lengths = np.full_like(lengths, np.nan)
        low, high = sorted((self.t[first], self.t[range(first, last, stride)[-1]]))
        return replace(
            self,
            **{name: getattr(self, name)[rows] for name in ("t", "q", "p", "iterations")},
            tau=None if self.tau is None else self.tau[rows],
            lengths=lengths,
            events=tuple(found.chosen((found.t >= low) & (found.t <= high)) for found in self.events),
        )

    @classmethod
    def before(cls, failure: StepFailedError) -> Self:
        """What an integration kept before the step that failed; StateError if that was a single step."""
        if not isinstance(failure.trajectory, cls):
            raise StateError("a single step that failed has no trajectory")
        return failure.trajectory

    def energy(self) -> Array:
        """(n,) energies p.v - L, constant along exact trajectories when L does not depend on time."""
        energies: Array = self.stepper.energy(self.q, self.p, self.t, self.parameters)
        return energies

    def momentum_maps(self) -> Array:
        """(n, k) values of what symmetries conserve, in the order of ``stepper.momentum_map_names``."""
        return self.stepper.momentum_maps(self.q, self.p, self.t, self.parameters)

    def momentum_errors(self) -> Array:
        """(n, k) changes of the momentum maps since the first state, relative to the largest size of their terms."""
        values, sizes = self.stepper.momentum_maps_and_sizes(self.q, self.p, self.t, self.parameters)
        return relative_changes(values, sizes)

    def work(self) -> Array:
        """(n,) work of the forces since the first state: sum h b_i f . v along the steps' own curves.

        E_n - E_0 - W_n is of the order of the method where L does not depend on time; of SCVI, whose curve is of order
        s + 1, of that.

        Raises:
            MethodError: where no forces act, and for methods that do not integrate along a curve.
            StateError: if the states do not stand at whole steps.
        """
        return exchanged_until(self)[:, 0]

    def impulses(self) -> Array:
        """(n, k) what forces gave since the first state to what L alone would conserve, ``stepper.impulse_names``.

        J_n - J_0 is that, to round-off for SVI and their kin, to order s + 1 for SCVI. Raises as
        :meth:`work`.
        """
        return exchanged_until(self)[:, 1:]

    def multipliers(self) -> Array:
        """(n, c) multipliers of the constraints: g_q^T lambda are the forces that keep the states on them.

        Raises:
            MethodError: for a system without constraints.
        """
        return multipliers(self.stepper, self.q, self.p, self.t, self.parameters)

    def constraint_values(self) -> tuple[Array, Array]:
        """(n, c) values of the constraints, and of their rates, at the states: zeros but for rounding."""
        g, rate = constraint_values(self.stepper, self.q, self.p, self.t, self.parameters)
        return g, rate

    def states(self, units: Mapping[str, str] | None = None) -> States:
        """The states as :mod:`scvi_codegen.files.export` writes them."""
        interface = self.stepper.interface
        piece = (self.t, self.q, self.p, self.iterations)
        return States(
            count=len(self),
            pieces=lambda: iter([piece]),
            coordinates=interface.coordinates,
            parameters=dict(zip(interface.parameters, map(float, self.parameters), strict=True)),
            h=self.h,
            about=interface.about(),
            maps=interface.map_names,
            quantities=partial(quantities, self.stepper, self.parameters),
            units=checked_units(units),
        )

    @property
    def ended_by(self) -> Event | None:
        """The terminal event that ended the run, at whose crossing the last state is, or ``None``."""
        for found in self.events:
            if found.event.terminal and len(found) >= int(found.event.terminal):
                return found.event
        return None

    @property
    def velocity(self) -> Array:
        """(n, m) velocities of the states."""
        return self.stepper.velocity(self.q, self.p, self.t, self.parameters)

    def at(self, t: ArrayLike) -> tuple[Array, Array]:
        """States between those kept: steps of a part of h, as accurate as the method and continuous in t.

        A whole step is the state kept there, so nothing jumps; where only every so-many-th was kept, the steps between
        are taken again, to round-off. Backward runs as well.

        Args:
            t: a time, or (n,) times in any order, within the trajectory.

        Returns:
            (q, p), each (m,) for a number and (n, m) for times.

        Raises:
            StateError: for times outside, and of a trajectory made with ``t_eval``.
        """
        times = checked_times(t, "t")
        q, p = states_at(self, times.ravel())
        return q.reshape(*times.shape, self.stepper.dimension), p.reshape(*times.shape, self.stepper.dimension)

    def crossings(self, events: EventLike | Sequence[EventLike]) -> tuple[Crossings, ...]:
        """Zero crossings of functions along the trajectory, looked for now; it needs all states (``save_every=1``).

        Args:
            events: as of :meth:`Stepper.integrate`; terminal ones do not end the search.
        """
        if not (asked := as_events(events)):
            raise EventError("events to look for are wanted, as 'q' or Event('q', direction=1)")
        return crossings_of(self.stepper.with_events(asked), self)

    def _repr_html_(self) -> str:
        save_every = max(1, -(-len(self) // MOST_DRAWN))
        series = list(zip(self.stepper.coordinates, self.q[::save_every].T, strict=True))[:MOST_CURVES]
        energies = self._energies(save_every)
        rows = [(plain(name), sparkline(values.tolist(), name), _range(values)) for name, values in series]
        if energies is not None:
            rows.append((plain("energy"), sparkline(energies.tolist(), "energy"), _range(energies)))
        names = zip(self.stepper.parameters, self.parameters, strict=True)
        facts = (
            ("time", plain(f"{self.t[0]:g} to {self.t[-1]:g}, {self._steps()}")),
            ("states", plain(f"{len(self)}; q and p of shape {self.q.shape}")),
            ("coordinates", listed(self.stepper.coordinates)),
            ("parameters", listed([f"{name} = {value:g}" for name, value in names])),
            ("iterations", plain(f"{self.iterations.sum()}")),
            ("step error", plain(self._worst())),
        )
        return card(self.stepper.title, facts, grid(rows))

    def _steps(self) -> str:
        return f"{self.steps} steps of their own lengths, {self.rejected} rejected" if self.goal else f"h = {self.h:g}"

    def _worst(self) -> str:
        if math.isnan(self.step_error):
            return "not known: nothing tells it here"
        said = f"about {self.step_error:.1e} relative in the step from t = {self.step_error_t:g}, the worst"
        return f"{said}; too long" if self.step_error > TOLERABLE_ERROR else said

    def _energies(self, save_every: int) -> Array | None:
        """Of each so many states, ``None`` where a state has no energy."""
        try:
            energies: Array = self.stepper.energy(
                self.q[::save_every], self.p[::save_every], self.t[::save_every], self.parameters
            )
        except StateError:
            return None
        return energies

    @property
    def plot(self) -> Plots:
        """Pictures: ``run.plot()`` shows all at a glance, ``run.plot.energy("energy.png")`` one thing in a file.

        There are ``motion``, ``phase``, ``energy``, ``momentum_maps`` and ``section``; each returns Matplotlib axes.
        """
        from scvi_codegen.pictures.plots import Plots

        return Plots(self)

    def animate(
        self,
        path: str | os.PathLike[str] | None = None,
        *,
        seconds: float = 8.0,
        positions: Callable[[Array], Array] | None = None,
    ) -> Film:
        """An animation, which a notebook shows, or a file .gif, .html or .mp4; see :func:`scvi_codegen.animate`."""
        from scvi_codegen.pictures.animation import animate

        return animate(self, path, seconds=seconds, positions=positions)

    @takes(path=PATH, units=MAPPING)
    def save(self, path: str | os.PathLike[str], *, units: Mapping[str, str] | None = None) -> None:
        """Write ``.npz``, ``.csv``, ``.h5`` (or ``.nc``) or ``.zarr``, atomically.

        An ``.npz`` file has arrays t, q, p, iterations, h, parameters, coordinates, parameter_names, and texts title,
        system, method, version. A CSV file has columns t, coordinates x, momenta p_x, iterations, velocities x_dot,
        energy, which are nan where they cannot be computed. HDF5 and Zarr hold what :meth:`to_xarray` gives.

        Raises:
            StateError: for another suffix, or units in a format that has none.
            MissingLibraryError: without h5netcdf or zarr (extra ``data``).
        """
        write_states(self.states(units), path)

    def to_xarray(self, *, units: Mapping[str, str] | None = None) -> xarray.Dataset:
        """Variables q, p, velocity (t, coordinate), energy, iterations (t), momentum_map (t, symmetry).

        Attributes are h, parameters and titles, and a ``long_name`` of each variable. What cannot be computed for a
        state is NaN there.

        Args:
            units: of t, q, p, velocity, energy or momentum_map, as in ``{"t": "day", "q": "au"}``; those of velocities
                follow.

        Raises:
            StateError: for units of something else.
            MissingLibraryError: without xarray (extra ``data``).
        """
        return to_dataset(self.states(units).labelled())

    def to_dataframe(self) -> pandas.DataFrame:
        """Return one row per state, indexed by time, with the columns of a CSV file (:meth:`save`).

        Raises:
            MissingLibraryError: without pandas (extra ``data``).
        """
        return to_dataframe(self.states())


def relative_changes(values: Array, sizes: Array) -> Array:
    """Changes since the first along axis 0, relative to the largest size; NaN where sizes are beyond all numbers."""
    with np.errstate(invalid="ignore", over="ignore"):
        scales = np.fmax.reduce(sizes, axis=0)
        changes: Array = (values - values[0]) / np.where(scales > 0.0, scales, 1.0)
    return np.where(np.isinf(scales), np.nan, changes)


def _range(values: Array) -> Html:
    """From the least to the greatest value, and by how much they differ."""
    low, high = float(np.min(values)), float(np.max(values))
    return plain(f"{low:.10g} to {high:.10g}, a difference of {high - low:.2g}")
