"""Command ``scvi-codegen run``: integrate a model or an ensemble, in memory or into a folder, and print a summary."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from scvi_codegen.codegen.native.option_table import STEP_SIZE, check_available
from scvi_codegen.codegen.rendering.source import AUTO, DOUBLE_DOUBLE
from scvi_codegen.common.errors import ScviCodegenError
from scvi_codegen.common.registry import part
from scvi_codegen.interfaces.cli.command_group import (
    INTERRUPTED,
    CommandFailure,
    check_writable,
    is_quiet,
    reporting,
    tell,
)
from scvi_codegen.interfaces.cli.ensembles import energy_balance, ensemble_summary, integrate_states
from scvi_codegen.interfaces.cli.json_documents import ensemble_numbers, outcome_numbers, run_numbers
from scvi_codegen.interfaces.cli.model_options import check_exclusive, model_arguments, read_model
from scvi_codegen.interfaces.cli.recording import (
    SUFFIX,
    RecordedOutcome,
    check_output,
    check_resumed,
    is_run_folder,
    record_model,
    resume_folder,
)
from scvi_codegen.interfaces.cli.reports import known_account
from scvi_codegen.interfaces.cli.running import RunOutcome, integrate_model, known_at_end, summary
from scvi_codegen.interfaces.cli.step_selection import (
    model_with_adaptive_steps,
    model_with_advised_step,
    model_with_global_error,
)
from scvi_codegen.interfaces.models.model import Model
from scvi_codegen.interfaces.models.model_files.ensemble_file import EnsembleStates, load_ensemble
from scvi_codegen.interfaces.models.options import (
    IN_ENSEMBLE,
    OF_ADAPTIVE_STEPS,
    OPTIONS,
    ROWS,
    RUN_FIELDS,
    WITH_INPUTS,
)
from scvi_codegen.runs.accuracy.global_error import GlobalError
from scvi_codegen.runs.results.export import FORMATS

ABOUT = """\
Integrate MODEL; report conserved quantities and the final state.

If a step fails, or after Ctrl-C, the states computed so far are summarised and written to the output files.

Step size: fixed with --step; adaptive with --tolerance, the relative local error. --error bounds the global error of
the whole run: the local tolerance is reduced until runs with other step sizes confirm the bound; if they confirm it
only in part, the exit status is 1 and the time until which they do is printed. --advise chooses one fixed step size
for an error at the end, by short pilot runs; the recommendation is printed, and if the run does not meet it, the exit
status is 1.

--time-transformation makes the step constant in a transformed time tau, dt = G dtau (smaller steps where the motion is
fast); the map remains symplectic. --step is then the step of tau; without it one is chosen for --tolerance or
round-off. --span and all times are of t. For systems with explicit time or forces use --controller reversible, a
time-reversible step-size controller.

An array model (array coordinates, q[N]) takes sizes from its arrays, [sizes] or --size; its plot is an image over
index and time. With --ensemble, --advise, --time-transformation, and a folder as output, it is compiled for its sizes.

A system with inputs (measured or commanded signals) takes their values from the section [inputs] of its file or from
--input: a table with columns t and value, or a number. Steps end at breakpoints of the inputs.

With --ensemble MODEL is run from many initial states. A grid has one section; every combination is run:

\b
  [grid]
  q1 = { from = 0.5, to = 1.5, count = 11 }
  q2_dot = [0.9, 1.0, 1.1]
  mu = 2.0

A table is a CSV file with the names in its first line. Names are those of coordinates, velocities (q1_dot) or
momenta (p_q1), and parameters; the others are as in MODEL. An .npz file has arrays q and p of shape (states,
trajectories, coordinates); a .csv file has one line per state.

Checkpoint and restart: with a folder as output (-o long.run) states and checkpoints are written during the run, in
constant memory. It may be killed at any time; --resume continues it bit for bit, optionally beyond its original end
(--steps, --span). 'scvi-codegen export' writes its states to one file.

\b
Examples:
  scvi-codegen run outer-solar-system --plot orbits.png
  scvi-codegen run kepler --step 0.1 --steps 100000 --save-every 100 -o orbit.npz
  scvi-codegen run kepler --tolerance 1e-12
  scvi-codegen run kepler --error 1e-9
  scvi-codegen run kepler --advise 1e-9
  scvi-codegen run kepler --time-transformation frequency --span 1000
  scvi-codegen run kepler --time-transformation frequency --controller reversible --step 0.2
  scvi-codegen run kepler --json > kepler.json
  scvi-codegen run ring.toml --size N=10000 --plot ring.png
"""

OWN = tuple(option for option in OPTIONS if not (option.common or option.section in ("path", "family")))
"""Options that other commands do not have."""
ERRORS = {option.name: option for option in OWN if option.determines == STEP_SIZE}
"""Those of an error that determines the step size."""


@click.command(help=ABOUT)
@model_arguments(*(option.name for option in OWN), required=False)
@click.option(
    "-o",
    "--output",
    type=click.Path(),
    metavar="PATH",
    help=f"Trajectory: {FORMATS}; or a folder, NAME.run or NAME/, for a run of any length.",
)
@click.option("--resume", type=click.Path(), metavar="FOLDER", help="Continue the run in a folder (without MODEL).")
@click.option(
    "--checkpoint", type=float, metavar="SECONDS", help="Longest time between checkpoints of a run in a folder [10]."
)
@click.option("--plot", type=click.Path(), metavar="FILE", help="Plot (.png, .svg, .pdf) or film (.gif, .html, .mp4).")
@click.option(
    "--ensemble", type=click.Path(), metavar="FILE", help="Many initial states: a grid (.toml) or a table (.csv)."
)
@click.option(
    "--error-bars", is_flag=True, help="Print the final state with its uncertain digits, write errors with -o."
)
@reporting
def run(
    model_name: str | None,
    output: str | None,
    resume: str | None,
    checkpoint: float | None,
    plot: str | None,
    ensemble: str | None,
    error_bars: bool,
    **choices: Any,
) -> None:
    """Integrate MODEL; the help text is ``ABOUT``."""
    if resume is not None:
        check_resumed(click.get_current_context())
        _finish_recording(resume_folder(resume, steps=choices["steps"], span=choices["span"], seconds=checkpoint))
        return
    if model_name is None:
        raise click.UsageError("Missing argument 'MODEL', or --resume FOLDER.")
    recorded = output is not None and is_run_folder(output)
    _check_error_bars(error_bars, recorded, ensemble)
    _check_outputs(output, plot, ensemble, checkpoint)
    check_exclusive(choices)
    requested = {name: choices.pop(name) for name in ERRORS}
    errors = {name: requested[name] for name in ("tolerance", "error") if requested[name] is not None}
    is_adaptive = any(choices.get(name) is not None for name in (*OF_ADAPTIVE_STEPS, "span"))
    model = read_model(model_name, choices, errors if is_adaptive else None)
    _check_output_of_words(model, output)
    if model.precision in (DOUBLE_DOUBLE, AUTO):
        model = model.with_known_sizes()
    _check_kind(model, requested, in_ensemble=ensemble is not None, recorded=recorded)
    for option, needed in (
        ("--ensemble", ensemble is not None),
        ("--advise", requested["advise"] is not None),
        (f"-o {output}", recorded),
    ):
        model = model.with_known_sizes(option) if needed else model
    states = None if ensemble is None else load_ensemble(ensemble, model)
    model, confirmation, member = _with_steps(model, requested, states)
    _check_output_of_words(model, output)  # with precision = "auto"
    if states is not None:
        _run_ensemble(replace(states, model=model), (output, plot), advised=requested["advise"], member=member)
        return
    if output is not None and recorded:
        _finish_recording(record_model(model, output, checkpoint))
    else:
        _run_one(model, output, plot, advised=requested["advise"], error_bars=error_bars)
    _check_confirmed(confirmation)


def _check_error_bars(error_bars: bool, recorded: bool, ensemble: str | None) -> None:
    if error_bars and (recorded or ensemble is not None):
        where = "for a run recorded in a folder" if recorded else "with --ensemble"
        raise click.UsageError(f"--error-bars is not available {where}: use runs in memory (Python: run.error)")


def _check_kind(model: Model, requested: dict[str, float | None], *, in_ensemble: bool, recorded: bool) -> None:
    """Reject models and options that ensembles, or single runs, in memory or in a folder, do not have."""
    values = {row.field: getattr(model, row.field) for row in RUN_FIELDS} | {
        name: value for name, value in requested.items() if value is not None
    }
    if model.system.inputs:
        check_available(values, WITH_INPUTS, ROWS)
    if not in_ensemble:
        model._check_alone()
    elif model.has_time_transformation:
        raise click.UsageError(
            "--ensemble is not available with a time transformation: each trajectory has its own times"
        )
    else:
        check_available(values, IN_ENSEMBLE, ROWS)
    if recorded:
        check_available(values, "for a run recorded in a folder", ROWS)
        if model.system.inputs:
            raise click.UsageError("a run with inputs cannot be recorded in a folder: write it to a file (-o NAME.npz)")


def _check_output_of_words(model: Model, output: str | None) -> None:
    """Reject outputs that cannot hold states of two words, if those of the model have two."""
    if output is not None and not is_run_folder(output) and Path(output).suffix.lower() != ".npz":
        model._check_double(f"-o {output} (write a file NAME.npz)")


def _check_confirmed(confirmation: GlobalError | None) -> None:
    """End with exit status 1 if a global error bound was requested and is not confirmed."""
    if confirmation is not None and not confirmation.confirmed:
        end = confirmation.confirmed_until
        _fail_for(f"the bound {confirmation.requested:g} on the global error is confirmed only until t = {end:g}")


def _fail_for(missed: str, where: str = "") -> None:
    """End with exit status 1 if a run misses an error bound; ``missed``: how, or ""."""
    if missed:
        tell(missed=missed)
        raise CommandFailure(f"{where}{missed}")


def _with_steps(
    model: Model, requested: dict[str, float | None], states: EnsembleStates | None
) -> tuple[Model, GlobalError | None, int]:
    """Return the model with the steps that one of the requested errors determines, and the estimated global error.

    The third value is the index of the trajectory that determines the step of an ensemble.
    """
    tolerance, error, advise = requested["tolerance"], requested["error"], requested["advise"]
    if tolerance is not None:
        return model_with_adaptive_steps(model, tolerance), None, 0
    if advise is not None:
        model, advice = model_with_advised_step(model, advise, states)
        return model, None, advice.member or 0
    bound = model.error if error is None else error
    if bound is not None:
        return *model_with_global_error(model, bound), 0
    return model, None, 0


def _check_outputs(output: str | None, plot: str | None, ensemble: str | None, checkpoint: float | None) -> None:
    """Check before a long run that its files can be written."""
    if checkpoint is not None and not (output is not None and is_run_folder(output)):
        raise click.UsageError(f"--checkpoint requires a run recorded in a folder (-o NAME{SUFFIX})")
    in_folder = output is not None and ensemble is None and is_run_folder(output)
    if output is not None and not in_folder:
        check_output(output, ensemble=ensemble is not None)
    if plot is not None:
        if in_folder:
            raise click.UsageError("--plot is not available for a run recorded in a folder: omit one of them")
        check_writable(Path(plot), "'--plot'")
        part("services", "check_picture")(plot, films=True)


def _run_one(
    model: Model, output: str | None, plot: str | None, *, advised: float | None, error_bars: bool = False
) -> None:
    outcome = integrate_model(model)
    final_error = known_at_end(model, outcome)
    account = known_account(outcome.trajectory)
    tell(summary(model, outcome, final_error, account), **run_numbers(model, outcome, final_error, account))
    result = outcome.trajectory
    with_error = {"error": True} if error_bars else {}
    if error_bars:
        _tell_error(result)
    written = _write_outputs(model, result, output, plot, **with_error)
    tell(written=written)
    if outcome.failure is not None:
        raise CommandFailure(f"{outcome.failure}\n{_kept(outcome, written)}") from outcome.failure
    if outcome.interrupted:
        raise CommandFailure(f"interrupted at t = {outcome.run.t:g}\n{_kept(outcome, written)}", INTERRUPTED)
    if outcome.missed is not None:
        raise CommandFailure(f"{outcome.missed}\n{_kept(outcome, written)}")
    for path in written:
        tell(f"wrote {path}")
    if advised is not None:
        _fail_for(part("services", "missed_tolerance")(outcome.trajectory, advised))


def _finish_recording(outcome: RecordedOutcome) -> None:
    """Print the summary of a run in a folder, and how to continue it."""
    tell(outcome.summary(), **outcome_numbers(outcome))
    if outcome.failure is not None:
        raise CommandFailure(f"{outcome.failure}\n{outcome.continuation()}") from outcome.failure
    if outcome.interrupted:
        raise CommandFailure(f"interrupted at t = {outcome.run.t:g}\n{outcome.continuation()}", INTERRUPTED)
    tell(f"wrote {outcome.recorded.folder}", written=[outcome.recorded.folder])


def _run_ensemble(
    states: EnsembleStates, outputs: tuple[str | None, str | None], *, advised: float | None, member: int
) -> None:
    model = states.model
    outcome = integrate_states(states)
    balance = energy_balance(outcome.result)
    tell(ensemble_summary(model, outcome, balance), **ensemble_numbers(model, outcome, balance))
    written = _write_outputs(model, outcome.result, *outputs, overview=True)
    stored = f"written: {' and '.join(written)}" if written else "not written to a file (-o)"
    continuation = f"the computed states were {stored}"
    if outcome.interrupted:
        raise CommandFailure(
            f"interrupted after {outcome.result.steps.mean():.0f} steps on average\n{continuation}", INTERRUPTED
        )
    if not outcome.result.ok.any():
        raise CommandFailure(f"every trajectory failed\n{continuation}")
    for path in written:
        tell(f"wrote {path}", written=written)
    if advised is not None and outcome.result.ok[member]:
        missed = part("services", "missed_tolerance")(outcome.result[member], advised)
        _fail_for(missed, f"trajectory {member}: ")


def _tell_error(trajectory: Any) -> None:
    """Print the final state with the uncertain digits of its error, or why that is unknown."""
    try:
        error = trajectory.error
    except ScviCodegenError as unknown:
        raise CommandFailure(f"--error-bars: {unknown}") from unknown
    numbers = {"relative": error.relative[-1], "lost": error.lost, "reason": error.reason}
    tell(str(error), error=numbers | {"q": error.q[-1].tolist(), "p": error.p[-1].tolist()})


def _write_outputs(
    model: Model, result: Any, output: str | None, plot: str | None, *, overview: bool = False, **saved: bool
) -> list[str]:
    """Write states and picture; of arrays a picture is one of their fields, unless an ``overview`` is drawn."""
    if output is not None:
        result.save(output, **saved)
    if plot is not None and part("services", "is_film")(plot):
        progress = (lambda *_: None) if is_quiet() else None
        result.animate(plot, picture=model.picture or None, progress=progress)
    elif plot is not None and (overview or model.array_system is None):
        result.plot(plot, **saved)
    elif plot is not None:
        result.plot.field(plot)
    return [path for path in (output, plot) if path is not None]


def _kept(outcome: RunOutcome, written: list[str]) -> str:
    count = len(outcome.trajectory)
    states = "the initial state was" if count == 1 else f"the {count} states computed before were"
    return f"{states} written: {' and '.join(written)}" if written else f"{states} not written to a file (-o, --plot)"
