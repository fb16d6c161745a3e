"""Result of an integration: arrays, diagnostics, files and tables."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import pairwise
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self, cast, overload

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.common.display.cards import Html, card, grid, listed, plain, sparkline
from scvi_codegen.common.errors import EventError, StateError, StepFailedError
from scvi_codegen.common.labelled_arrays import checked_units, to_dataset
from scvi_codegen.common.validation import checks_arguments
from scvi_codegen.runs.accuracy.global_error import Confirmed, GlobalError
from scvi_codegen.runs.accuracy.local_error import ADAPTIVE_REMEDY, TOLERABLE_ERROR, warn_of_large_steps
from scvi_codegen.runs.accuracy.resolution import unresolved_parts
from scvi_codegen.runs.accuracy.run_error import RunError, WithErrors
from scvi_codegen.runs.accuracy.size import relative
from scvi_codegen.runs.derivatives.actions import actions_until, shadow_energy
from scvi_codegen.runs.derivatives.trajectory_derivatives import TrajectoryDerivatives
from scvi_codegen.runs.events.contact_impulses import ContactModes
from scvi_codegen.runs.events.contacts import contact_forces, contact_modes
from scvi_codegen.runs.events.refinement import crossings_of
from scvi_codegen.runs.forwarding import OfRuns
from scvi_codegen.runs.results.dense_output import states_at, times_of_words, within
from scvi_codegen.runs.results.energy import EnergyAccount, energy_account
from scvi_codegen.runs.results.export import COLUMNS, States, to_dataframe, write_states
from scvi_codegen.runs.results.joining import (
    Number,
    accumulated,
    concatenated,
    joined,
    joined_crossings,
    relative_changes,
)
from scvi_codegen.runs.results.quantities import describe_states, describe_step_size, quantities_in_modes, quantities_of
from scvi_codegen.runs.results.recomputation import work_and_impulses_until, work_until
from scvi_codegen.runs.results.recorded import OfMethod, WithUnsetAttributes, changed, without
from scvi_codegen.runs.results.saved_states import Array, ContactsBySteps, ModeHistory, checked_row, in_modes
from scvi_codegen.runs.states.attitude_history import AttitudeHistory
from scvi_codegen.runs.states.rotation_quantities import named_quantities
from scvi_codegen.runs.states.validation import columns_of_inputs
from scvi_codegen.runs.states.words import TwoWords, Words, check_keeps_words, low_words, scalar
from scvi_codegen.runs.stepping.features import refusal, require
from scvi_codegen.runs.stepping.noise import NO_BATH, BathReport
from scvi_codegen.runs.stepping.projection import constraint_values, multipliers
from scvi_codegen.runs.stepping.state_functions import undefined_energy
from scvi_codegen.runs.stepping.step_plan import FixedSteps
from scvi_codegen.systems.event import Crossings, Event, EventLike, Kink, Switches, as_events

if TYPE_CHECKING:
    import pandas
    import xarray


MOST_DRAWN, MOST_CURVES = 400, 6
"""Largest numbers of states and of coordinates in the plot of a notebook."""


@dataclass(slots=True, kw_only=True, eq=False)
class Trajectory(
    WithUnsetAttributes, TrajectoryDerivatives, OfRuns, AttitudeHistory, Confirmed, WithErrors, TwoWords, OfMethod
):
    """States along a run, the initial state first.

    Attributes:
        t: (n,) times.
        q: (n, m) positions.
        p: (n, m) momenta.
        iterations: (n,) solver iterations since the previous state, 0 for the first.
        h: step size (negative: backward), the first one for adaptive steps.
        step_sizes: (n,) size of the step that follows each state; NaN for a state within a step, of ``t_eval`` or where
            an event ended the run.
        tau: (n,) values of tau in transformed time (:func:`~scvi_codegen.reparametrise`), where h and ``step_sizes``
            are steps of tau; else ``None``.
        parameters: (k,) values in the order of ``stepper.parameters``.
        stepper: the compiled integrator.
        options: convergence criterion of the solver, ``None`` for the defaults.
        events: zero crossings found, parallel to ``stepper.events``.
        transitions: ends of the modes of contacts, then of kinks, in the order of ``stepper.searched``.
        modes: values of ``stepper.modes`` along the run, ``None`` without them.
        plan: step sizes and target time of the run.
        steps, rejected_steps: numbers of completed and of rejected steps since the start of the run.
        fallback_steps: number of completed steps that the iteration did not solve, but its fallback, Newton's method.
        step_error, worst_step_time: estimated relative error of the worst step of the run, and its start time. The
            error is relative to the motion in the step, with a fixed step size to the largest one so far; infinite if
            parts of a step, by which it is estimated, have no solution; NaN for methods without an error estimate.
        confirmation: the comparison with a second run if ``error=`` was passed, else ``None``.
        observed: (n, ..) values that ``observe`` returned, else ``None``; q and p are then those of both ends.
        conserved: (n, 3 + k) energies and momentum maps with ``observe``, else ``None``.
        actions: (n,) action up to each state if the run summed it (``action=True``), else ``None``; see :meth:`action`.
        pieces: with inputs, the trajectories between their breakpoints, each with its parameters; the first state of
            each is the last of the previous one. ``parameters`` are then those of the first.
        bath: seed of the noise, heat and acceptance up to the end in a heat bath, else ``None``.
        began: (t, q, p) of the state from which the run began where it may not be saved, else ``None``: see
            :attr:`initial`.

    Trajectories of ensembles have no ``iterations``, ``bath``, ``step_error``, ``worst_step_time``, ``transitions`` and
    numbers of rejected steps, and raise :class:`StateError`, unless there is nothing to record.

    Positions and momenta of arrays are also indexed by name: ``q["u"]`` has the axes n and those of u.
    """

    iterations: NDArray[np.int32]
    events: tuple[Crossings, ...] = ()
    transitions: tuple[Switches, ...] = field(default=(), repr=False)
    modes: ModeHistory | None = None
    rejected_steps: int = 0
    fallback_steps: int = 0
    confirmation: GlobalError | None = field(default=None, repr=False)
    observed: Array | None = field(default=None, repr=False)
    conserved: Array | None = field(default=None, repr=False)
    actions: Array | None = field(default=None, repr=False)
    pieces: tuple[Self, ...] = field(default=(), repr=False)
    bath: BathReport | None = None
    began: tuple[float, Array, Array] | None = field(default=None, repr=False)
    _error: RunError | None = field(default=None, init=False, repr=False)
    _has_dense_output: ClassVar[bool] = True

    def __repr__(self) -> str:
        if self.pieces:
            return describe_states(self, f", breakpoints between: {len(self.pieces) - 1}")
        bath = getattr(self, "bath", None)
        seed = "" if bath is None else f", seed {bath.seed}"
        return describe_states(self, describe_step_size(self.h, self.plan, tau=self.tau is not None) + seed)

    @property
    def initial(self) -> tuple[float, Array, Array]:
        """State (t, q, p) from which the run began, since which its errors count: of a slice its first state."""
        return (scalar(self.t[0]), self.q[0], self.p[0]) if self.began is None else self.began

    @overload
    def __getitem__(self, rows: slice) -> Self: ...
    @overload
    def __getitem__(self, rows: int) -> tuple[float, Array, Array]: ...
    @overload
    def __getitem__(self, rows: str) -> Array: ...
    def __getitem__(self, rows: slice | int | str) -> Self | tuple[float, Array, Array] | Array:
        """Return a trajectory for a slice, (t, q, p) of one state for an index, or values for a name.

        ``run["x"]`` are the values (n,) of a coordinate x, ``run["p_x"]`` and ``run["x_dot"]`` those of its momentum
        and velocity; names of arrays, fields, rotations and their angular velocities, ``"t"`` and ``"energy"`` are
        accepted as well.

        Events outside the times of a slice are omitted; ``steps`` and ``step_error`` remain those of the whole run.
        Slices of a run with inputs must have stride 1, since pieces share the states at breakpoints.

        Raises:
            IndexError: if an index is out of range, or a slice is empty or descending.
            StateError: for an unknown name.
        """
        self._check_saved()
        if isinstance(rows, str):
            return self._quantity(rows)
        if not isinstance(rows, slice):
            k = checked_row(rows, len(self))
            return scalar(self.t[k]), self.q[k].copy(), self.p[k].copy()
        first, last, stride = rows.indices(len(self))
        if stride < 0 or first >= last:
            raise IndexError(f"a slice of {len(self)} states must be ascending and not empty, unlike {rows}")
        if self.pieces:
            return self._slice_of_pieces(first, last, stride, rows)
        lengths = self.step_sizes[rows]
        if stride > 1 and not isinstance(self.plan, FixedSteps):  # the next saved state is not the end of the step
            lengths = np.full_like(lengths, np.nan)
        low, high = sorted((self.t[first], self.t[range(first, last, stride)[-1]]))
        return changed(
            self,
            began=None,
            **{name: getattr(self, name)[rows] for name in ("t", "q", "p", "iterations") if hasattr(self, name)},
            tau=None if self.tau is None else self.tau[rows],
            actions=None if self.actions is None else self.actions[rows],
            step_sizes=lengths,
            events=tuple(crossings.chosen((crossings.t >= low) & (crossings.t <= high)) for crossings in self.events),
            modes=None if self.modes is None else self.modes.between(low, high),
            **(
                {"transitions": tuple(of.chosen((of.t >= low) & (of.t <= high)) for of in self.transitions)}
                if hasattr(self, "transitions")
                else {}
            ),
        )

    def _between_states(self, t: Array, q: Array, p: Array) -> Self:
        """Return states at other times of this run, as of dense output, whose iterations and steps are not recorded."""
        states: dict[str, Any] = {"t": t, "q": q, "p": p, "step_sizes": np.full(len(t), np.nan), "iterations": None}
        unknown: dict[str, Any] = {"tau": None, "pieces": (), "observed": None, "conserved": None}
        return without(changed(self, **states, **unknown), "iterations")

    def _slice_of_pieces(self, first: int, last: int, stride: int, rows: slice) -> Self:
        if stride > 1:
            raise IndexError(
                f"a slice of a run with inputs must have stride 1, unlike {rows}: omit the stride, or slice the arrays "
                "t, q and p"
            )
        slices: list[Self] = []
        start = 0
        for piece in self.pieces:
            low, high = max(first - start, 0), min(last - start, len(piece))
            start += len(piece) - 1
            if high - low > 1 or (high - low == 1 == last - first and not slices):
                slices.append(piece[low:high])
        return changed(joined(slices), confirmation=self.confirmation)

    def _joined(self, part: Callable[[Self], NDArray[Number]]) -> NDArray[Number]:
        """Return a quantity of the states, computed with the parameters of each piece."""
        return part(self) if not self.pieces else concatenated([part(piece) for piece in self.pieces])

    def _summed(self, part: Callable[[Self], Array]) -> Array:
        """Return a quantity that accumulates along the run."""
        parts = [part(piece) for piece in self._runs]
        for before, after in pairwise(parts):
            after += before[-1]
        return concatenated(parts)

    def _check_saved(self) -> None:
        """Raise :class:`StateError` if states were not saved."""
        if self.observed is not None:
            raise refusal("dense_output", "with observe")

    @classmethod
    def before(cls, failure: StepFailedError) -> Self:
        """Return the trajectory before a failed step; raise StateError if that was a single step."""
        if not isinstance(failure.trajectory, cls):
            raise StateError("a single step that failed has no trajectory")
        return failure.trajectory

    def warn_of_large_steps(self, remedy: str = ADAPTIVE_REMEDY) -> None:
        """Issue an :class:`AccuracyWarning` for the worst fixed step if its error is large; ``remedy`` ends it."""
        warn_of_large_steps(self, remedy=remedy)

    def energy(self) -> Array:
        """Return (n,) energies p.v - L, constant along exact trajectories if L does not depend on time."""
        if self.conserved is not None:
            return self.conserved[:, 2]
        return self._joined(lambda piece: in_modes(piece, piece.stepper.energy))

    @property
    def energies(self) -> Array:
        """(n, 3) kinetic, potential and total energy; parts of arrays of run-time sizes only, else NaN."""
        if self.conserved is not None:
            return self.conserved[:, :3]
        return self._joined(lambda piece: in_modes(piece, piece.stepper._energy_parts))

    def energy_account(self, *, limited: bool = False) -> EnergyAccount:
        """Return the change of the energy and the work along the run; ``limited``: the work of short runs only."""
        return energy_account(self, limited=limited)

    def energy_error(self) -> float:
        """Return the largest error of the energy, relative to the largest sum of its parts, abs(T) + abs(E - T).

        T is p.v/2 where parts are not known, the kinetic energy of quadratic ones: where the energy is 0, too, its
        parts have a size. They are those of saved states, and not below the largest abs(E) of all. Where forces,
        damping or impacts change the energy, the error is that of E - E0 - W.

        Raises:
            StateError: if the energy changes for another reason, or its work W is unknown: the change is no error.
        """
        account = energy_account(self)
        if not account.is_error:
            raise StateError(
                f"the energy of '{self.stepper.interface.system}' changes ({account.reason}), and the work is "
                "unknown, so that the change is no error: use energy(). Work requires a method with a curve, L or H "
                "without time, and of impacts and contacts all states of integrate(..), save_every=1: ensembles do not "
                "keep them"
            )
        if not np.isfinite(account.change).all():  # of arrays of run-time sizes
            raise undefined_energy(self.q, self.p)
        parts, energies = self.energies[:, :2], self.energies[:, 2:]
        if not np.isfinite(parts[0, 0]):
            kinetic = 0.5 * np.sum(self.p * self.velocity, axis=-1)
            stride = 1 if self.conserved is None else max(1, len(energies) - 1)  # with an observer both ends are saved
            parts = np.stack([kinetic, self.energy()[::stride] - kinetic], axis=1)
        size = max(np.max(np.abs(of).sum(axis=1)) for of in (parts, energies))
        return float(relative(np.max(np.abs(account.values)), size))

    @property
    def t_low(self) -> Array:
        """(n,) low words of the times; 0 in double precision."""
        return low_words(self.t)

    def momentum_maps(self) -> Array:
        """Return (n, k) conserved quantities, in the order of ``stepper.momentum_map_names``."""
        if self.conserved is not None:
            return self.conserved[:, 3:]
        return self._joined(lambda piece: in_modes(piece, piece.stepper.momentum_maps))

    def momentum_errors(self) -> Array:
        """Return (n, k) changes of the momentum maps since the first state, relative to their largest term."""

        def maps_of(run: Trajectory) -> tuple[Array, Array]:
            maps_and_sizes = run.stepper._momentum_maps_and_sizes
            if run.modes is None:
                return maps_and_sizes(run.q, run.p, run.t, run.parameters)
            first, second = (in_modes(run, lambda *of, k=k: maps_and_sizes(*of)[k]) for k in range(2))
            return first, second

        maps = [maps_of(run) for run in self._runs]
        values, sizes = (concatenated(part) for part in zip(*maps, strict=True))
        states = self.q, self.p, self.t, self.parameters
        return relative_changes(values, sizes, lambda _: self.stepper._momentum_bounds(*states))

    @overload
    def action(self, *, cumulative: Literal[False] = False) -> float: ...
    @overload
    def action(self, *, cumulative: Literal[True]) -> Array: ...
    def action(self, *, cumulative: bool = False) -> float | Array:
        """Return the action of the run, sum h b_i L along the curves of its steps; or (n,) actions up to each state.

        Without forces this is the sum of the discrete Lagrangians, so that dS = p1 . dq1 - p0 . dq0 for neighbouring
        runs, to round-off. With forces, damping, impacts and constraints it is the action of L alone, without their
        work and impulses. Sums are compensated. Unless the run summed it (``action=True``), the steps are computed
        again from the saved states.

        Raises:
            MethodError: if the method has no sum of L (Runge-Kutta methods other than Gauss), in transformed time, and
                for first-order systems.
            StateError: if the states are not at whole steps.
        """
        require(self.stepper, "action")
        sums = accumulated([actions_until(piece, piece.actions) for piece in self._runs])
        assert sums is not None  # since each piece has one
        return sums if cumulative else float(sums[-1])

    def heat(self) -> float:
        """Return the sum of the changes of the kinetic energy by the heat bath."""
        if self.bath is None:
            raise StateError(f"heat() {NO_BATH} '{self.stepper.interface.system}'")
        return self.bath.heat

    @property
    def acceptance(self) -> float:
        """Part of the steps that were accepted with ``metropolis=True``; 1 for other runs."""
        return 1.0 if self.bath is None else self.bath.acceptance

    def shadow_energy(self, order: int = 12) -> Array:
        """Return (n,) energies of the shadow Hamiltonian, of which the states are an exact solution.

        p . q' - S' with central differences of the states and the action (Skeel & Hardy, SIAM J. Sci. Comput. 23 (2001)
        1172): constant to round-off for small h, where the energy oscillates by O(h^r), so that slow damping or another
        defect of a run shows after few steps. For SVI of degree 1 and 2, Stoermer-Verlet and compositions.

        Args:
            order: of the differences, even, 2 to 24; NaN at the first and last ``order / 2`` states.

        Raises:
            MethodError: for other methods, whose long steps make the differences less accurate than the energy, and if
                the energy is not conserved.
            StateError: if the states are not those of all steps of one size.
        """
        require(self.stepper, "shadow_energy")
        return shadow_energy(self, order)

    def work(self) -> Array:
        """Return (n,) work of the forces since the first state: sum h b_i f . v along the curves of the steps.

        That of contacts is included: of sliding friction, of surfaces that move, and the energy lost at impacts. For
        time-independent L, E_n - E_0 - W_n is of the order of the method; for SCVI of order s + 1, that of its
        curve.

        Raises:
            MethodError: if no forces act, or the method has no curve of positions.
            StateError: if the states are not at whole steps.
        """
        return self._summed(work_until)

    def impulses(self) -> Array:
        """Return (n, k) changes by forces of the quantities that L alone conserves, ``stepper.impulse_names``.

        They equal J_n - J_0 to round-off for SVI and related methods, to order s + 1 for SCVI. Raises as
        :meth:`work`.
        """
        return self._summed(lambda piece: work_and_impulses_until(piece)[:, 1:])

    def multipliers(self) -> Array:
        """Return (n, c) Lagrange multipliers of the constraints; the constraint forces are g_q^T lambda.

        Raises:
            MethodError: if the system has no constraints.
        """
        return self._joined(lambda piece: in_modes(piece, partial(multipliers, piece.stepper)))

    @property
    def switches(self) -> tuple[Switches, ...]:
        """Crossings of each kink, with the side after them; those of contacts are :attr:`contact_modes`."""
        return tuple(of for of in self.transitions if isinstance(of.event, Kink))

    @property
    def contact_modes(self) -> ContactModes:
        """Times from which contacts have modes, ``"open"``, ``"stick"`` or ``"slip"`` of each, with these modes.

        The list has the ``directions`` of slips, and ``impacts`` with their impulses.
        """
        changes = [change for run in self._runs for change in contact_modes(run)]
        kept = (change for k, change in enumerate(changes) if not k or change[1] != changes[k - 1][1])
        return ContactModes(kept, self._runs)

    @property
    def _by_steps(self) -> ContactsBySteps:
        last = self._runs[-1].modes
        if last is None or last.by_steps is None:
            raise StateError("this is known of runs with contacts by steps: integrate(.., transitions='by steps')")
        return last.by_steps

    @property
    def contact_residual(self) -> float:
        """Largest residual of the contact problems of a run by steps, relative to their forces and rates."""
        return self._by_steps.residual

    @property
    def compliance(self) -> float:
        """Largest compliance of contacts of a run by steps, relative to that by inertia; 0 where they were rigid."""
        return self._by_steps.compliance

    @property
    def lost_energy(self) -> float:
        """Energy that contacts took in a run by steps, negative where surfaces that move supply more."""
        return self._by_steps.lost_energy

    def contact_forces(self) -> Array:
        """Return (n, k, 2) normal and tangential forces of the k contacts; at a transition those after it.

        Raises:
            MethodError: if the system has no contacts.
        """
        return concatenated([contact_forces(run) for run in self._runs])

    def constraint_values(self) -> tuple[Array, Array]:
        """Return (n, c) constraint residuals and (n, c) rates at the states, zero up to rounding."""
        values = self._joined(lambda run: in_modes(run, lambda *of: constraint_values(run.stepper, *of).swapaxes(0, 1)))
        return values[:, 0], values[:, 1]

    def states(self, units: Mapping[str, str] | None = None, *, error: bool = False) -> States:
        """Return the states for :mod:`scvi_codegen.runs.results.export`, with their errors if requested."""
        errors = self.error.arrays if error else {}
        interface, recorded = self.stepper.interface, tuple(name for name in COLUMNS if hasattr(self, name))
        columns = tuple(getattr(self, name) for name in recorded)
        by_name = dict(zip(interface.own_parameters, map(float, self.parameters), strict=False))
        derived: Callable[..., Any] = partial(quantities_of, self)
        if self.pieces:
            for k in columns_of_inputs(interface):
                del by_name[interface.parameters[k]]
        if self.pieces or self.modes is not None:
            by_piece = [quantities_in_modes(piece) for piece in self._runs]
            whole = {name: concatenated([values[name] for values in by_piece]) for name in by_piece[0]}
            derived = lambda *_: whole  # noqa: E731  (computed once)
        return States(
            count=len(self),
            pieces=lambda: iter([columns]),
            coordinates=interface.coordinates,
            momenta=interface.momentum_columns,
            parameters=by_name,
            h=self.h,
            about=interface.about(),
            maps=interface.map_names,
            attitudes=named_quantities(interface),
            quantities=derived,
            units=checked_units(units),
            low={f"{name}_low": low_words(getattr(self, name)) for name in ("t", "q", "p", "parameters")}
            if isinstance(self.q, Words)
            else {},
            errors=errors,
            recorded=recorded,
        )

    def unresolved(self) -> Array:
        """Return (n,) parts of the squared amplitude in the highest modes of the mesh of fields (resolution monitor).

        See :meth:`~scvi_codegen.extras.fields.mesh.Mesh.unresolved`; the largest of all fields.

        Raises:
            MethodError: if the system is not that of a mesh.
        """
        require(self.stepper, "unresolved")
        return cast(Array, unresolved_parts(self.stepper, self.q))

    @property
    def ended_by(self) -> Event | None:
        """Terminal event that ended the run, whose crossing is the last state; or ``None``."""
        for crossings in self.events:
            if crossings.event.terminal and len(crossings) >= int(crossings.event.terminal):
                return crossings.event
        return None

    @property
    def velocity(self) -> Array:
        """(n, m) velocities of the states, with an observer of those at both ends."""

        def of(piece: Self) -> Array:
            if piece.observed is None:
                return in_modes(piece, piece.stepper.velocity)
            values: Array = piece.stepper.velocity(
                piece.q, piece.p, piece.t[:: max(1, len(piece.t) - 1)], piece.parameters
            )
            return values

        values = self._joined(of)
        return self.stepper.named(values)

    def at(self, t: ArrayLike) -> tuple[Array, Array]:
        """Return dense output at times t, by partial steps: as accurate as the method and continuous in t.

        At the ends of steps it equals the saved states; steps between saved states are recomputed, equal to round-off.
        Backward runs are supported.

        Args:
            t: a time, or (n,) times in any order, within the trajectory.

        Returns:
            (q, p), each (m,) for a number and (n, m) for times.

        Raises:
            StateError: if a time is outside the trajectory, or this was made with ``t_eval``.
        """
        self._check_saved()
        times = times_of_words(t, self.stepper.interface.words)
        shape = *times.shape, self.stepper.dimension
        q, p = self._states_at(times.reshape(-1))
        return self.stepper.named(q.reshape(shape)), self.stepper.named(p.reshape(shape))

    def _states_at(self, times: Array) -> tuple[Array, Array]:
        if not self.pieces:
            return states_at(self, times)
        flat = within(times, self.t[0], self.t[-1])
        q, p = (self.stepper._states.missing((len(flat), self.stepper.dimension)) for _ in range(2))
        forward = self.pieces[0].forward
        ends = forward * np.array([piece.t[-1] for piece in self.pieces])
        number = np.minimum(np.searchsorted(ends, forward * flat), len(ends) - 1)
        for k in np.unique(number):
            q[number == k], p[number == k] = self.pieces[k].at(flat[number == k])
        return q, p

    def crossings(self, events: EventLike | Sequence[EventLike]) -> tuple[Crossings, ...]:
        """Return the zero crossings of functions along a trajectory with all states (``save_every=1``).

        Args:
            events: as of :meth:`Stepper.integrate`; terminal ones do not end the search.
        """
        if not (asked := as_events(events)):
            raise EventError("crossings requires at least one event, such as 'q' or Event('q', direction=1)")
        require(self.stepper, "crossings")
        stepper = self.stepper.with_events(asked)
        by_piece = [crossings_of(stepper, piece) for piece in self._runs]
        return tuple(map(joined_crossings, zip(*by_piece, strict=True)))

    def _repr_html_(self) -> str:
        save_every = max(1, -(-len(self) // MOST_DRAWN))
        series = list(zip(self.stepper.coordinates, self.q[::save_every].T, strict=True))[:MOST_CURVES]
        rows = [(plain(name), sparkline(values.tolist(), name), _range(values)) for name, values in series]
        with suppress(StateError):  # outside the domain of L
            energies = self.energy()[::save_every]
            rows.append((plain("energy"), sparkline(energies.tolist(), "energy"), _range(energies)))
        names = zip(self.stepper.parameters, self.parameters, strict=False)
        facts = (
            ("time", plain(f"{self.t[0]:g} to {self.t[-1]:g}, {self._steps()}")),
            ("states", plain(f"{len(self)}; q and p of shape {self.q.shape}")),
            ("coordinates", listed(self.stepper.coordinates)),
            ("parameters", listed([f"{name} = {value:g}" for name, value in names])),
            ("iterations", plain(f"{self.iterations.sum()}" if hasattr(self, "iterations") else "not recorded")),
            ("step error", plain(self._worst())),
        )
        return card(self.stepper.title, facts, grid(rows))

    def _steps(self) -> str:
        if not isinstance(self.plan, FixedSteps):
            rejected = f", {self.rejected_steps} rejected" if hasattr(self, "rejected_steps") else ""
            return f"{self.steps} adaptive steps{rejected}"
        return f"h = {self.h:g}"

    def _worst(self) -> str:
        if not hasattr(self, "step_error"):
            return "not recorded: ensembles estimate no errors of steps"
        if math.isnan(self.step_error):
            return "unknown: the method has no error estimate here"
        message = f"about {self.step_error:.1e} relative in the step from t = {self.worst_step_time:g}, the worst"
        return f"{message}; h is too large" if self.step_error > TOLERABLE_ERROR else message

    @checks_arguments()
    def save(
        self, path: str | os.PathLike[str], *, units: Mapping[str, str] | None = None, error: bool = False
    ) -> None:
        """Write a file in the format of its suffix, atomically; the error of an unknown suffix lists the formats.

        An ``.npz`` file has arrays t, q, p, iterations, h, parameters, coordinates, parameter_names, and strings title,
        system, method, version; in double-double arithmetic also t_low, q_low, p_low and parameters_low. A CSV file has
        columns t, coordinates x, momenta p_x, iterations, velocities x_dot and energy, NaN where undefined. HDF5 and
        Zarr files (``.h5``, ``.nc``, ``.zarr``) contain the variables of :meth:`to_xarray`. Trajectories of ensembles,
        whose iterations are not counted, have none in files and tables.

        Args:
            path: file.
            units: as of :meth:`to_xarray`.
            error: whether to write the arrays q_error, p_error, q_rounding and p_rounding of :attr:`error`, which CSV
                files do not hold.

        Raises:
            StateError: if the suffix is unknown, or the format has no units or errors.
            MissingLibraryError: if h5netcdf or zarr is not installed (extra ``data``).
        """
        check_keeps_words(self.stepper.interface.words, path)
        write_states(self.states(units, error=error), path)

    def to_xarray(self, *, units: Mapping[str, str] | None = None, error: bool = False) -> xarray.Dataset:
        """Return a dataset of q, p, velocity (t, coordinate), energy, iterations (t), momentum_map (t, symmetry).

        Attributes are h, parameters and titles, and a ``long_name`` of each variable. Undefined values are NaN.

        Args:
            units: units of t, q, p, velocity, energy or momentum_map, ``{"t": "day", "q": "au"}``; those of velocities
                follow.
            error: whether to add q_error, p_error, q_rounding and p_rounding of :attr:`error` (t, coordinate).

        Raises:
            StateError: if units name an unknown variable, or for states of two words.
            MissingLibraryError: if xarray is not installed (extra ``data``).
        """
        check_keeps_words(self.stepper.interface.words, "a dataset")
        return to_dataset(self.states(units, error=error).labelled())

    def to_dataframe(self) -> pandas.DataFrame:
        """Return one row per state, indexed by time, with the columns of a CSV file (:meth:`save`).

        Raises:
            StateError: for states of two words, of which it has one.
            MissingLibraryError: if pandas is not installed (extra ``data``).
        """
        check_keeps_words(self.stepper.interface.words, "a data frame")
        return to_dataframe(self.states())


def _range(values: Array) -> Html:
    """Format the smallest and the largest value and their difference."""
    low, high = float(np.min(values)), float(np.max(values))
    return plain(f"{low:.10g} to {high:.10g}, a difference of {high - low:.2g}")
