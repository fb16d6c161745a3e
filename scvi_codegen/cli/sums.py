"""Integration of array systems for ``scvi-codegen run``, in chunks, so that Ctrl-C and a failed step lose nothing."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import click
import numpy as np

from scvi_codegen.cli.command_group import FAILURE, INTERRUPTED, CommandFailure, tell
from scvi_codegen.cli.formatting import counted, duration
from scvi_codegen.cli.memory import check_state_memory
from scvi_codegen.cli.progress import BAR_LENGTH, interruptions, progress_bar
from scvi_codegen.cli.running import worst_step
from scvi_codegen.errors import StepFailedError
from scvi_codegen.models.array_model import ArrayModel
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.pictures.arrays import plot_arrays
from scvi_codegen.runtime.arrays.interface import Numbers
from scvi_codegen.runtime.arrays.run import ArrayRun
from scvi_codegen.runtime.arrays.stepper import ArrayStepper
from scvi_codegen.runtime.arrays.trajectory import ArrayRecord, ArrayTrajectory, check_npz

__all__ = ["reject_options", "run_arrays", "with_solver"]

MAX_LISTED = 4
"""Largest number of entries of an array that the final state lists."""
ALTERNATIVES = {"advise": "give --tolerance"}
"""Alternatives to options that array systems do not have."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ArrayOutcome:
    """Result of a run: saved states, state of the run, seconds of preparation and of steps, and why it ended."""

    trajectory: ArrayTrajectory
    run: ArrayRun
    stepper: ArrayStepper
    preparation: float
    seconds: float
    failure: StepFailedError | None
    interrupted: bool


def reject_options(what: dict[str, object]) -> None:
    """Reject options, by name, that array systems do not have.

    Raises:
        click.UsageError: if one of them is set.
    """
    for name, value in what.items():
        if value not in (None, False):
            instead = ALTERNATIVES.get(name, "omit it, or write sizes as numbers, coordinates = ['q[8]']")
            raise click.UsageError(
                f"--{name.replace('_', '-')} is not available for arrays whose sizes are known at run time only: "
                f"{instead}"
            )


def with_solver(solver: str, model: ArrayModel) -> ArrayModel:
    """Return the model with the solver of the command line; with ``"auto"`` the model's own solver stays."""
    return model if solver == "auto" else replace(model, solver=solver)


def run_arrays(
    model: ArrayModel,
    output: str | None,
    plot: str | None,
    options: SolverOptions | None,
    threads: int | None = None,
) -> None:
    """Integrate an array system, print a summary and write the files asked for.

    Raises:
        CommandFailure: if a step failed or a signal ended the run; the states before are summarised and written.
    """
    if output is not None:
        check_npz(output)
    outcome = _integrate(model, options, threads)
    tell("\n".join(_summary(model, outcome)), **_numbers(model, outcome))
    if output is not None:
        outcome.trajectory.save(output)
    if plot is not None:
        plot_arrays(outcome.trajectory, plot)
    written = [path for path in (output, plot) if path is not None]
    tell(written=written)
    if outcome.failure is not None:
        raise CommandFailure(str(outcome.failure), FAILURE)
    if outcome.interrupted:
        raise CommandFailure(f"interrupted at t = {outcome.run.t:g}", INTERRUPTED)
    for path in written:
        tell(f"wrote {path}")


def _integrate(model: ArrayModel, options: SolverOptions | None, threads: int | None) -> ArrayOutcome:
    began, controlled = time.perf_counter(), model.h is None
    steps = math.inf if controlled else model.step_count
    if not controlled:
        check_state_memory(sum(np.size(values) for values in model.q.values()), model.step_count, model.save_every)
    stepper = model.stepper()
    run, failure = model.start(stepper, options=options, threads=threads), None
    preparation, began = time.perf_counter() - began, time.perf_counter()
    record = ArrayRecord(run)
    with interruptions() as caught, progress_bar(BAR_LENGTH if controlled else model.step_count) as show_progress:

        def report_progress(done: int) -> None:
            show_progress(int(BAR_LENGTH * (run.t - model.t) / model.covered) if controlled else done)

        try:
            record.take(keep=True)
            for segment in model.segments(run):
                until, last = math.inf if segment is None else run.steps + segment, model.has_shorter_last_step
                record.continue_recording(
                    until, model.save_every, progress=report_progress, stop=lambda: bool(caught), to_end=last
                )
        except StepFailedError as error:
            failure = error
    return ArrayOutcome(
        trajectory=record.trajectory(),
        run=run,
        stepper=stepper,
        preparation=preparation,
        seconds=time.perf_counter() - began,
        failure=failure,
        interrupted=bool(caught) and not (run.arrived or run.steps >= steps),
    )


def _summary(model: ArrayModel, outcome: ArrayOutcome) -> Iterator[str]:
    run, trajectory, method = outcome.run, outcome.trajectory, model.method
    sizes = ", ".join(f"{name} = {size}" for name, size in run.sizes.items())
    count = sum(values.size for values in run.q.values())
    order = "no order claimed" if method.order is None else f"order {method.order}"
    yield f"{model.system.name}: {counted(count, 'coordinate')}{f', {sizes}' if sizes else ''}"
    geometry = f"{'' if method.symplectic else 'not '}symplectic, {'' if method.symmetric else 'not '}symmetric"
    yield f"{method.title}; {order}, {geometry}"
    saved = counted(len(trajectory.t), "state")
    lengths = "of adaptive size" if run.plan else f"of {model.h:g}"
    yield f"{counted(run.steps, 'step')} {lengths} from t = {model.t:g} to t = {run.t:g}; {saved} saved"
    if run.steps:
        each = outcome.seconds / run.steps
        yield (
            f"{outcome.seconds:.3g} s, {duration(each)} a step, {duration(each / count)} a step and coordinate, "
            f"{run.iterations / run.steps:.2f} iterations a step; prepared in {outcome.preparation:.2f} s"
        )
        yield _energy(model, outcome)
        for name, change in _map_changes(outcome):
            yield f"{name}: changed by {change:.2e} at most"
        yield from worst_step(trajectory)
    yield "final state"
    for name, values in run.q.items():
        shown = ", ".join(f"{x:.9g}" for x in values.reshape(-1)[:MAX_LISTED])
        yield f"  {name} = {shown}{', ..' if values.size > MAX_LISTED else ''}"


def _energy(model: ArrayModel, outcome: ArrayOutcome) -> str:
    if why := model.system.changes_energy:
        energy = _energies(outcome)[:, 2]
        change = float(np.abs(energy - energy[0]).max())
        return f"energy: {why}, it changed by {change:.3g} at most"
    return f"relative energy error: {_energy_error(outcome):.2e} at most"


def _energies(outcome: ArrayOutcome) -> Numbers:
    """Return the energies of all saved states and of the final state, which may not be saved."""
    return np.vstack([outcome.trajectory.energies, outcome.run.energies])


def _energy_error(outcome: ArrayOutcome) -> float:
    return replace(outcome.trajectory, energies=_energies(outcome)).energy_error()


def _map_changes(outcome: ArrayOutcome) -> Iterator[tuple[str, float]]:
    """Return the largest change of each momentum map."""
    maps = np.vstack([outcome.trajectory.momentum_maps(), outcome.run.momentum_maps])
    changes = np.abs(maps - maps[0]).max(axis=0)
    return zip(outcome.stepper.momentum_map_names, changes.tolist(), strict=True)


def _numbers(model: ArrayModel, outcome: ArrayOutcome) -> dict[str, Any]:
    """Return the document of ``--json``."""
    run, trajectory = outcome.run, outcome.trajectory
    failure = "interrupted" if outcome.interrupted else None
    return {
        "system": model.system.name,
        "method": model.method.name,
        "order": model.method.order,
        "sizes": run.sizes,
        "steps": run.steps,
        "h": model.h,
        "tolerance": model.allowed_error,
        "states": len(trajectory.t),
        "seconds": outcome.seconds,
        "preparation_seconds": outcome.preparation,
        "iterations": run.iterations,
        "energy": trajectory.energy()[0],
        "energy_error": _energy_error(outcome),
        "momentum_changes": dict(_map_changes(outcome)),
        "step_error": trajectory.step_error,
        "worst_step_time": trajectory.worst_step_time,
        "final": {"t": run.t, "q": run.q, "p": run.p},
        "failure": failure if outcome.failure is None else str(outcome.failure),
    }
