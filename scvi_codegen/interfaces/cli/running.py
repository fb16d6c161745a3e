"""Integration for ``scvi-codegen run`` in short chunks, so that Ctrl-C and failed steps lose nothing; its summary."""

import math
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

import numpy as np

from scvi_codegen.codegen.rendering.source import Interface
from scvi_codegen.common.errors import AccuracyWarning, ScviCodegenError, StateError, StepFailedError, warn
from scvi_codegen.common.representation import counted
from scvi_codegen.interfaces.cli.reports import duration, energy_report, in_known_digits, momentum_report
from scvi_codegen.interfaces.cli.supervision import BAR_LENGTH, check_memory, interruptions, progress_bar
from scvi_codegen.interfaces.models.model import Model
from scvi_codegen.methods.discretise import is_symplectic
from scvi_codegen.runs.accuracy.local_error import TOLERABLE_ERROR
from scvi_codegen.runs.accuracy.run_error import RunError
from scvi_codegen.runs.accuracy.warning_switch import without_accuracy_warnings
from scvi_codegen.runs.driver.largest_step import accuracy_message
from scvi_codegen.runs.driver.run import Run
from scvi_codegen.runs.driver.segments import record_segments
from scvi_codegen.runs.nouns import Save
from scvi_codegen.runs.results.energy import EnergyAccount
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.states.words import Words, as_text
from scvi_codegen.runs.stepping.step_plan import Adaptive, FixedSteps, InTau
from scvi_codegen.runs.trajectory import Trajectory
from scvi_codegen.systems.event import Crossings

SHOWN_COORDINATES = 6
"""Largest number of coordinates that the final state lists."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunOutcome:
    """Result of a run.

    Attributes:
        trajectory: saved states, up to the last one computed.
        run: state of the integration after the last completed step.
        preparation: seconds to derive, compile and load the stepper.
        seconds: seconds spent in steps.
        failure: error of the step that failed, or ``None``.
        interrupted: True if a signal ended the run.
        missed: message if the steps of tau miss the tolerance that they were chosen for, else ``None``.
    """

    trajectory: Trajectory
    run: Run
    preparation: float
    seconds: float
    failure: StepFailedError | None
    interrupted: bool
    missed: str | None = None

    @property
    def end(self) -> tuple[float, Array, Array]:
        """Time, positions and momenta at the end.

        In transformed time the last saved state lies inside the last step, before the state of the run; after a shorter
        last step the run is left before that.
        """
        run, saved = self.run, self.trajectory
        inside = saved.t[-1] != run.t and (saved.t[-1] - run.t) * run._step_size > 0.0
        return (float(saved.t[-1]), saved.q[-1], saved.p[-1]) if inside else (run.t, run.q, run.p)


@without_accuracy_warnings()
def integrate_model(model: Model) -> RunOutcome:
    """Integrate a model with a progress bar until its end, a failed step or a signal."""
    check_memory(model)
    began = time.perf_counter()
    run = model.start()
    preparation = time.perf_counter() - began
    by_time = model.ends_at_time or bool(model.system.inputs)  # the number of steps is not known in advance
    length = BAR_LENGTH if by_time else model.step_count
    began, stopped, failure = time.perf_counter(), False, None
    with interruptions() as caught, progress_bar(length) as show_progress:

        def look(_: int) -> None:
            reached = int(BAR_LENGTH * (run.t - model.t) / model.covered) if by_time else run.steps
            show_progress(min(length, reached))

        def stop() -> bool:
            nonlocal stopped
            stopped = bool(caught)
            return stopped

        segments, in_segments = model.segments(run), bool(model.system.inputs)
        try:
            steps = None if in_segments else next(segments)
            save = Save(model.save_every, model.output_times(run, steps), progress=look)
            record = partial(run._recorded, save=save, stop=stop)
            trajectory = record_segments(run, segments, record, lambda: stopped) if in_segments else record(steps)
        except StepFailedError as error:
            failure, trajectory = error, Trajectory.before(error)
    missed = None
    if (allowed := model.allowed_error) is not None and model.has_time_transformation:  # the step of tau fits the start
        missed = accuracy_message(trajectory.step_error, trajectory.worst_step_time, allowed)
    return RunOutcome(
        trajectory=trajectory,
        run=run,
        preparation=preparation,
        seconds=time.perf_counter() - began,
        failure=failure,
        interrupted=stopped,
        missed=missed,
    )


def summary(
    model: Model, outcome: RunOutcome, final_error: RunError | None, account: EnergyAccount | None = None
) -> str:
    """Return a summary of a run in a few lines; shorter if no step was completed."""
    run, trajectory, method, arrays = outcome.run, outcome.trajectory, model.method_of_runs, model.array_system
    order = "no order claimed" if method.order is None else f"order {method.order}"
    sizes = [counted(model.dimension, "coordinate"), *(f"{name} = {size}" for name, size in model.sizes.items())]
    lines = [
        f"{model.system.name}: {', '.join(sizes)}" if arrays else model.system.name,
        f"{method.title}; {order}, {_geometry(model, run)}, {'' if method.symmetric else 'not '}symmetric",
        f"{counted(trajectory.steps, 'step')} {describe_step_size(model, run)} "
        f"from t = {model.t:g} to t = {outcome.end[0]:g}; "
        f"{counted(len(trajectory), 'state')} saved",
    ]
    if run.steps:
        lines.append(f"{_speed(outcome, model)}; prepared in {outcome.preparation:.2f} s")
        with np.errstate(all="ignore"):
            lines += conserved(trajectory, account)
        if model.action:
            lines.append(f"action: {trajectory.action():.15g}")
        lines += worst_step(trajectory)
    return "\n".join(
        [*lines, *event_counts(trajectory.events), *final_state(run.stepper.interface, *outcome.end[1:], final_error)]
    )


def event_counts(events: Iterable[Crossings]) -> Iterator[str]:
    """Yield a line for each event with its number of crossings."""
    for crossings in events:
        yield f"event {crossings.event.function}: {counted(len(crossings), 'crossing')}"


def _geometry(model: Model, run: Run) -> str:
    """Return whether the map is symplectic: not with noise, contacts, changes at events and adaptive steps."""
    system = model.array_system or model.system
    if system.bath or model.system.contacts or not is_symplectic(model.method_of_runs, model.system):
        return "not symplectic"
    if any(event.then or event.restitution not in (None, 1) for event in model.events):
        return "symplectic only between events"
    return "symplectic" if isinstance(run.plan, FixedSteps) else "symplectic only at fixed step size"


def known_at_end(model: Model, outcome: RunOutcome) -> RunError | None:
    """Return the error of a run; ``None`` if the run is incomplete, or its error is not known at the end."""
    run, trajectory = outcome.run, outcome.trajectory
    is_complete = run.steps and outcome.failure is None and not outcome.interrupted
    if not is_complete or model.array_system is not None or model.in_double_double:
        return None
    with suppress(ScviCodegenError):
        error: RunError = trajectory.error
        if trajectory.t[-1] == outcome.end[0] and all(np.isfinite(of[-1]).all() for of in error.bounds):
            return error
    return None


def describe_step_size(model: Model, run: Run) -> str:
    """Return a description of the step sizes of a run."""
    if model.in_transformed_time:
        return f"of {run.h:g} in tau"
    if isinstance(run.plan, InTau):
        return f"{run.plan.sizes} by the {model.controller or 'reversible'} controller"
    adaptive = isinstance(run.plan, Adaptive) or model.h is None
    return f"of adaptive size ({run.rejected_steps} rejected)" if adaptive else f"of {model.h:g}"


def _speed(outcome: RunOutcome, model: Model) -> str:
    seconds, trajectory = outcome.seconds / outcome.trajectory.steps, outcome.trajectory
    text = f"{outcome.seconds:.3g} s, {duration(seconds)} a step"
    if model.array_system is not None:
        text += f", {duration(seconds / model.dimension)} a step and coordinate"
    saved = trajectory.t[-1] == outcome.end[0]  # else iterations are known up to the last saved state
    watched = outcome.run.steps if saved else (len(trajectory) - 1) * model.save_every
    text += f", {int(np.sum(trajectory.iterations)) / watched:.2f} iterations a step" if watched else ""
    if not (fallbacks := trajectory.fallback_steps):
        return text
    remedy = "; a smaller step or --solver newton is faster" if fallbacks > outcome.run.steps // 10 else ""
    return f"{text}, {counted(fallbacks, 'step')} by Newton's method{remedy}"


def conserved(trajectory: Trajectory, account: EnergyAccount | None = None) -> Iterator[str]:
    """Yield a line for each quantity that should be conserved, with its error."""
    try:
        yield energy_report(trajectory, account)
    except StateError as error:
        yield f"energy: {error}"
    yield from momentum_report(trajectory)


def worst_step(trajectory: Trajectory) -> Iterator[str]:
    """Yield a line with the largest error estimate of a step; warn if that step is too large.

    The warning does not depend on options such as ``--quiet``.
    """
    error, begun = trajectory.step_error, f"from t = {trajectory.worst_step_time:g}"
    if math.isnan(error):
        yield "largest local error: unknown, this method has no error estimate here"
    else:
        too_long = error > TOLERABLE_ERROR
        size = f"{error:.1e} (relative, estimated), step {begun}" if error else "below rounding (estimated)"
        yield f"largest local error: {size}{': too large' if too_long else ''}"
        if too_long:
            warn(
                f"the step {begun} is too large: its estimated relative error is {error:.1e}; use a smaller --step or "
                "--tolerance",
                AccuracyWarning,
            )


def final_state(
    interface: Interface, positions: Array, momenta: Array, final_error: RunError | None = None
) -> Iterator[str]:
    """Yield lines with the final coordinates and momenta, in the digits that are known to be right."""
    names, columns = interface.coordinates, interface.momentum_columns
    shown, column = names[:SHOWN_COORDINATES], max(map(len, columns[:SHOWN_COORDINATES]))
    width = max(map(len, shown))
    if isinstance(positions, Words):
        yield "final state (in two words)"
        for name, q, other, p in zip(shown, as_text(positions), columns, as_text(momenta), strict=False):
            yield f"  {name:{width}} = {q:40} {other:{column}} = {p}"
        return
    yield f"final state ({_how_known(final_error)})"
    for i, (name, other, q, p) in enumerate(zip(shown, columns, positions, momenta, strict=False)):
        errors = [of[-1, i] for of in final_error.bounds] if final_error else [0.0, 0.0]
        sizes = final_error.sizes[:, i] if final_error else [0.0, 0.0]
        known_q, known_p = map(in_known_digits, (q, p), errors, sizes)
        yield f"  {name:{width}} = {known_q:24} {other:{column}} = {known_p}"
    if len(names) > SHOWN_COORDINATES:
        yield f"  and {len(names) - SHOWN_COORDINATES} more coordinates"


def _how_known(final_error: RunError | None) -> str:
    if final_error is None:
        return "accuracy unknown"
    lost = f"; no meaningful digits from t = {final_error.lost:g}" if final_error.lost is not None else ""
    return f"in the digits that the error of the run leaves{lost}"
