"""What an ensemble integrates: initial states, parameters, inputs and steps of many trajectories."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from operator import attrgetter, itemgetter
from typing import Any, Self, cast

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.codegen.ir.variants import Lanes
from scvi_codegen.codegen.native.arguments import real_array
from scvi_codegen.codegen.native.option_table import in_words
from scvi_codegen.codegen.native.options import SolverOptions, checked_options
from scvi_codegen.common.errors import MethodError, StateError, of_trajectory
from scvi_codegen.common.validation import checked_count
from scvi_codegen.runs.driver.segments import (
    ALL,
    Input,
    breakpoints_until,
    checked_inputs,
    final_time,
    first_inner_time,
    inputs_of_slice,
    parameters_at,
)
from scvi_codegen.runs.ensembles.schedule import CommonSteps, common_steps
from scvi_codegen.runs.events.contacts import in_first_modes
from scvi_codegen.runs.results.dense_output import check_has_end, times_of_run
from scvi_codegen.runs.states.validation import (
    Array,
    Parameters,
    States,
    check_inputs_given,
    check_left_to_inputs,
    columns_of_inputs,
)
from scvi_codegen.runs.states.words import check_doubles, hashed, stacked
from scvi_codegen.runs.stepping.features import check_together, require
from scvi_codegen.runs.stepping.integrator import Integrator
from scvi_codegen.runs.stepping.noise import DEFAULT_NOISE, Noise, check_strengths, with_sequences
from scvi_codegen.runs.stepping.projection import make_consistent
from scvi_codegen.runs.stepping.state_functions import neither_or_both
from scvi_codegen.runs.stepping.step_plan import Adaptive, Span, Steps, check_max_step

RANGE = np.finfo(np.float32)
"""Range of single precision."""


def checked_ensemble(stepper: Integrator, q: States, other: States, name: str) -> tuple[Array, Array]:
    """Return validated (k, m) initial positions, and momenta or velocities ``name``."""
    positions, others = stepper._states.members(q, "q"), stepper._states.members(other, name)
    if positions.shape != others.shape:
        raise StateError(f"q and {name} must have equal shapes, not {positions.shape} and {others.shape}")
    return positions, others


def momenta_of_each(
    stepper: Integrator, q: States, p: States | None, velocity: States | None, t: float, parameters: Parameters
) -> States:
    """Return the momenta of states specified by p or by velocity, each with its own parameters."""
    if velocity is None and p is not None:
        return p
    if velocity is None or p is not None:
        raise neither_or_both(p)
    positions, velocities = checked_ensemble(stepper, q, velocity, "velocity")
    t, values = stepper._states.time(t), stepper._states.parameters_of_each(parameters, len(positions))
    interface = stepper.interface

    def momentum_of(j: int) -> Array:
        with of_trajectory(j):
            return stepper.initial_momentum(positions[j], velocities[j], t, values[j])

    if interface.words > 1 or interface.in_tau or interface.layout.momenta:
        return stacked([momentum_of(j) for j in range(len(positions))])
    momenta = np.empty_like(positions)  # p = dL/dv
    done = stepper.binding.of_each("momenta", t, values, positions, velocities, momenta)
    dropped = ((momenta[:done] == 0.0) & (velocities[:done] != 0.0)).any(axis=1)
    for j in (*np.flatnonzero(dropped).tolist(), *range(done, len(momenta))):
        momenta[j] = momentum_of(j)
    return momenta


def start_of_ensemble(
    stepper: Integrator, q: States, p: States, t: float, parameters: Parameters, durations: ArrayLike = 0.0
) -> tuple[Array, Array, Array]:
    """Return (k, m) positions and momenta, projected onto constraints, and (k, number of parameters) parameters.

    Args:
        stepper, q, p, t, parameters: of the start.
        durations: one or (k,) as of :func:`~scvi_codegen.runs.events.contacts.in_first_modes`.
    """
    check_inputs_given(stepper.interface, parameters)
    positions, momenta = checked_ensemble(stepper, q, p, "p")
    values = stepper._states.parameters_of_each(parameters, len(positions))
    if stepper.interface.constraints:
        if stepper.interface.words == 1:
            positions, momenta = map(np.ascontiguousarray, (positions, momenta))
        if stepper.interface.contacts and not stepper.by_steps:
            for k, lasts in enumerate(np.broadcast_to(durations, len(values)).tolist()):
                with of_trajectory(k):
                    positions[k], momenta[k] = in_first_modes(stepper, positions[k], momenta[k], t, values[k], lasts)
        elif stepper.interface.imposed:
            make_consistent(stepper, positions, momenta, t, values)
    return positions, momenta, values


@dataclass(slots=True)
class EnsembleSettings:
    """Arguments of ``integrate_ensemble`` but the initial state, for one stepper."""

    inputs: Mapping[str, Any] | None = None
    h: float | None = None
    steps: int | None = None
    t_end: ArrayLike | None = None
    tolerance: float | None = None
    absolute_tolerance: float | Mapping[str, float] | None = None
    max_step: float | None = None
    first_step: float | None = None
    save_every: int = 1
    t: float = 0.0
    t_eval: ArrayLike | None = None
    parameters: Parameters = None
    options: SolverOptions | None = None
    error: float | None = None
    observe: str | None = None
    seed: int = 0
    metropolis: bool = False
    precision: str = "double"
    trajectory: int = 0

    @property
    def size(self) -> Steps:
        """Sizes of the steps."""
        return tuple.__new__(Steps, size_in(self))

    def check(self, stepper: Any) -> None:
        """Raise an error for arguments that exclude each other, or that the stepper excludes."""
        self.inputs = self.inputs or None
        if self.precision != "double":
            self._check_precision(stepper)
        if self.observe is not None:
            check_together(observe=self.observe, inputs=self.inputs, error=self.error, t_eval=self.t_eval)
            require(stepper, "observe_ensemble")
        if self.records_events(stepper):
            check_together(events=stepper.events, observe_ensemble=self.observe)
            require(stepper, "ensemble_events")

    def _check_precision(self, stepper: Any) -> None:
        """Raise an error for an unknown precision, and for what single precision excludes."""
        if self.precision != "single":
            raise StateError(
                f"precision is {self.precision!r}: ensembles have 'double' and 'single'; compile the stepper with "
                "precision='double-double' for more digits"
            )
        require(stepper, "single")
        further = {"precision='single'": True, "adaptive": True if self.h is None else None, "error": self.error}
        further |= {"events": self.records_events(stepper) or None, "action": stepper.sums_action or None}
        check_together(**further, t_eval=self.t_eval, observe_ensemble=self.observe)
        if self.inputs is not None and stepper.interface.constraints:
            raise StateError("precision='single' is not available with inputs and constraints: omit precision")
        if stepper._variants[Lanes("single")] is None:
            raise MethodError(
                f"precision='single' is not available for '{stepper.title}', which was loaded without its source: "
                "compile the system, or omit precision"
            )

    def check_range(self, parameters: Array, *states: Array) -> None:
        """Raise :class:`StateError` for parameters or states outside the range of the precision."""
        if self.precision != "single":
            return
        smallest, tiny = RANGE.tiny / RANGE.eps, RANGE.tiny  # the low words of states are normal numbers, too
        sizes = [np.abs(values[values != 0.0]) for values in (np.append(parameters, cast(float, self.h)), *states)]
        limits = [(of.max(initial=0.0), tiny if of is sizes[0] else smallest) for of in sizes]
        limits.append((sizes[0].min(initial=1.0), tiny))
        for size, least in limits:
            if size > RANGE.max or 0.0 < size < least:
                raise StateError(
                    f"a parameter, step size or state of size {size:.3g} is outside the range of single precision, "
                    f"{least:.1e} to {RANGE.max:.1e}: choose other units, or precision='double'"
                )

    def records_events(self, stepper: Any) -> bool:
        """Return whether trajectories record the events of the stepper, which may be counted instead."""
        return bool(stepper.searched) and self.observe != "events"

    def steps_or_ends(self, stepper: Any, t: float) -> tuple[int | None, Array | None]:
        """Return the number of common steps or the final times; StateError for missing or contradictory arguments."""
        h, t_end = self.h, self.t_end
        check_doubles(stepper.interface.words, t_end=t_end, t_eval=self.t_eval)
        if self.t_eval is not None:
            check_together(inputs=self.inputs, t_eval=self.t_eval)
            check_has_end(self.t_eval, t, h, t_end)
            if h is not None:
                raise StateError(in_words("{t_eval} requires adaptive steps: give {t_end} without {h} and {steps}"))
        if h is not None and t_end is not None and np.ndim(t_end):
            raise StateError("with h all trajectories have one t_end: give one number, or omit h (adaptive step size)")
        ends = None if t_end is None else real_array(t_end, "t_end")
        if ends is not None and not ends.size:
            raise StateError("t_end has no final time: give one number, or one for each trajectory")
        first = None if ends is None else float(ends.flat[0])
        schedule = *self.size, *Span(self.steps, first), 1, 0.0 if first is None else hashed(t)
        try:
            stepper._planned(*schedule)
        except TypeError:  # of an argument that is not hashable, as an array
            stepper._planned.__wrapped__(*schedule)
        if h is None or (self.inputs is None and first is None):
            return self.steps, ends
        return None, np.array(final_time(t, h, self.steps, first))


size_in = attrgetter(*Steps._fields)
settings_in = itemgetter(*EnsembleSettings.__slots__[:-1])
"""The values of :class:`EnsembleSettings` among the arguments of ``integrate_ensemble``, in order."""


@dataclass(slots=True, eq=False)
class Ensemble:
    """Initial states, parameters, inputs and steps of k trajectories.

    Attributes:
        stepper: the compiled integrator.
        settings: the arguments of ``integrate_ensemble``, validated.
        t0: initial time.
        q, p: (k, m) initial positions and momenta.
        parameters: (k, number of parameters) values, zeros for the parameters of inputs.
        inputs: validated inputs.
        fixed: the fixed steps of all trajectories, ``None`` with adaptive steps.
        plan: adaptive steps, to the first of the final times; ``None`` with fixed steps.
        ends: (k,) final times of adaptive steps.
        save_every: steps between saved states.
        t_eval: output times of adaptive steps, ``None`` to save the ends of steps.
        noise: stream of the first trajectory; those of the others follow.
    """

    stepper: Any
    settings: EnsembleSettings
    t0: float
    q: Array
    p: Array
    parameters: Array
    inputs: Mapping[str, Input] = field(default_factory=dict)
    fixed: CommonSteps | None = None
    plan: Adaptive | None = None
    ends: Array = field(default_factory=lambda: np.empty(0))
    save_every: int = 1
    t_eval: Array | None = None
    noise: Noise = DEFAULT_NOISE

    @classmethod
    def of(
        cls, stepper: Any, q: States, p: States | None, settings: EnsembleSettings, *, velocity: States | None = None
    ) -> Self:
        """Return the ensemble of (k, m) states with p or velocity; StateError if invalid, or in transformed time."""
        settings.check(stepper)
        layout, parameters = stepper._states, settings.parameters
        t0 = layout.time(settings.t)
        require(stepper, "ensembles")
        steps, ends = settings.steps_or_ends(stepper, t0)
        if settings.h is None:
            require(stepper, "adaptive")
        checked_options(settings.options)
        inputs = dict[str, Input]()
        if settings.inputs is not None:
            count = len(layout.members(q, "q"))
            streams = settings.trajectory + np.arange(count)[:, np.newaxis]
            schedule = {"t": t0, "h": settings.h, "end": lambda: cast(float, ends)}
            by_name = with_sequences(stepper.interface.inputs, settings.inputs, settings.seed, streams, **schedule)
            inputs = checked_inputs(stepper.interface, by_name, count)
            check_left_to_inputs(stepper.interface, parameters)
            values = layout.parameters_of_each(parameters, len(layout.members(q, "q")))
            first_end = 0.0 if ends is None else float(ends.flat[0])
            parameters = parameters_at(stepper.interface.parameters, values, inputs, first_inner_time(t0, first_end))
        momenta = momenta_of_each(stepper, q, p, velocity, t0, parameters)
        save_every, fixed = checked_count(settings.save_every, "save_every", least=1), None
        if settings.h is not None:
            t_end = None if ends is None else float(ends)
            fixed = common_steps(t0, settings.h, save_every, steps, t_end, inputs, layout.words)
        durations = cast(Array, ends) - t0 if settings.h is None else settings.h
        positions, momenta, values = start_of_ensemble(stepper, q, momenta, t0, parameters, durations)
        settings.check_range(values, positions, momenta)
        noise = Noise(settings.seed, settings.trajectory, settings.metropolis).checked(stepper, settings.inputs)
        for member in np.unique(values, axis=0) if stepper.interface.temperature is not None else ():
            check_strengths(stepper, t0, settings.h, member)
        start = t0, positions, momenta, values
        ensemble = cls(stepper, settings, *start, inputs, fixed, save_every=save_every, noise=noise)
        if not stepper._has_energy(parameters):
            for member, at, momentum in zip(values, positions, momenta, strict=True):
                member[stepper.interface.energy_index] = stepper.energy(at, momentum, 0.0, member)
        if fixed is None:
            ensemble._set_ends(cast(Array, ends))
        if inputs:
            values[:, columns_of_inputs(stepper.interface)] = 0.0
        return ensemble

    def __len__(self) -> int:
        return len(self.q)

    def _set_ends(self, ends: Array) -> None:
        """Set the plan of adaptive steps, their final times and output times; all run forward or all backward."""
        t0, settings = self.t0, self.settings
        if ends.shape not in ((), (len(self),)):
            raise StateError(f"t_end must be one time or {len(self)} times, not of shape {ends.shape}")
        worst = int(np.argmin(np.isfinite(ends)))  # the first one that is not finite
        self.plan = settings.size.to(float(ends.flat[worst]))
        if (ends > t0).any() and (ends < t0).any():
            raise StateError(f"t_end lies on both sides of t = {t0:g}: split the ensemble into two")
        latest = replace(self.plan, t_end=float(ends.flat[np.abs(ends).argmax()]))
        check_max_step(latest, t0, self.stepper.interface.words)
        self.ends = ends if ends.ndim else np.full(len(self), ends)
        for end in self.ends if self.inputs else ():
            breakpoints_until(t0, float(end), self.inputs)
        if settings.t_eval is not None:
            check_together(t_eval=settings.t_eval, save_every=None if self.save_every == 1 else self.save_every)
            self.t_eval = times_of_run(settings.t_eval, t0, float(self.ends[np.abs(self.ends - t0).argmax()]))

    def values_at(self, t: float, part: slice = ALL) -> Array:
        """Return the parameters at a time, those of inputs included, one row for each of a slice of trajectories."""
        return parameters_at(self.stepper.interface.parameters, self.parameters, self.inputs, t, part)

    def some(self, part: Any) -> Self:
        """Return the ensemble of some of the trajectories with fixed steps, a slice or indices."""
        states = {"q": self.q[part], "p": self.p[part], "parameters": self.parameters[part]}
        return replace(self, **states, inputs=inputs_of_slice(self.inputs, part))

    def settings_of(self, part: slice) -> EnsembleSettings:
        """Return the arguments, besides the initial states, of the ensemble of a slice of the trajectories."""
        in_bath, inputs = self.stepper.interface.temperature is not None, inputs_of_slice(self.inputs, part)
        of_part: dict[str, Any] = {"parameters": self.parameters[part], "inputs": inputs}
        if self.fixed is None:
            of_part["t_end"] = self.ends[part]
        seed = self.settings.seed if in_bath else 0  # the inputs are values
        return replace(self.settings, **of_part, seed=seed, trajectory=self.noise.trajectory + part.start)
