"""The command line. SymPy, NumPy and the rest are imported by the commands that need them: ``--help`` is quick."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

import click

from scvi_codegen.cli.choices import Choices, model_arguments, read_model

if TYPE_CHECKING:
    from scvi_codegen.cli.recording import RecordedOutcome
    from scvi_codegen.cli.running import Outcome
    from scvi_codegen.models.model_file import Model
    from scvi_codegen.native.options import SolverOptions
    from scvi_codegen.rendering.text import Embedded

__all__ = ["main"]

FAILURE, USAGE, INTERRUPTED = 1, 2, 130
"""Exit statuses: numerical failure or no compiler; faulty input; Ctrl-C."""

OVERVIEW = """Compile a Lagrangian into a variational integrator in C, run it, look at its equations.

MODEL is a model file (TOML) or a name of the catalogue ('scvi-codegen systems'). Options override what it says.

\b
Examples:
  scvi-codegen run kepler                              integrate it, print what was conserved
  scvi-codegen run kepler --step 0.1 -o orbit.npz --plot orbit.png
  scvi-codegen run kepler --method gauss --stages 4 --parameter mu=2 --q 1,0 --velocity 0,1.2
  scvi-codegen systems kepler > mine.toml              a model file to start from
  scvi-codegen run mine.toml --span 1000 --every 10 -o orbit.csv
  scvi-codegen run mine.toml --span 1e4 --every 1000 -o long.run    a folder: the run can be interrupted
  scvi-codegen run --resume long.run                                and goes on where it was
  scvi-codegen derive planar-pendulum --method svi --degree 2 --quadrature gauss-legendre:2
  scvi-codegen derive kepler --html kepler.html        from L to the C on one page
  scvi-codegen generate mine.toml -o mine_svi          C, a Makefile and a Python package in the folder mine_svi
  scvi-codegen reproduce all --html paper.html         every figure, table and claim of the paper, with a verdict
  scvi-codegen verify mine_svi                         measure whether it keeps what it promises

Exit status: 0; 2 if the command line or a model is at fault; 1 if a step failed, a promise is broken, there is
no C compiler or a file cannot be written; 130 after Ctrl-C.
"""


SOLVER_OPTION = click.option(
    "--solver",
    type=click.Choice(["auto", "fixed-point", "newton", "explicit"]),
    default="auto",
    show_default=True,
    help="Of the stage equations; auto: explicit or fixed point where there is one, Newton where that fails.",
)


class _Failure(click.ClickException):
    def __init__(self, message: str, status: int) -> None:
        super().__init__(message)
        self.status = status

    @property
    def exit_code(self) -> int:  # type: ignore[override]  # click's is a class variable
        return self.status


class _Commands(click.Group):
    """Turns the errors a user can meet into one message and an exit status."""

    def invoke(self, ctx: click.Context) -> Any:
        from scvi_codegen.errors import BuildError, RecordingError, ScviCodegenError, StepFailedError

        try:
            with _warnings_as_lines():
                return super().invoke(ctx)
        except (StepFailedError, BuildError, RecordingError) as error:
            raise _Failure(str(error), FAILURE) from error
        except ScviCodegenError as error:
            raise _Failure(str(error), USAGE) from error
        except BrokenPipeError:
            raise
        except OSError as error:
            raise _Failure(str(error), FAILURE) from error
        except MemoryError as error:
            raise _Failure("there is not enough memory for that", FAILURE) from error


@click.group(cls=_Commands, help=OVERVIEW, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="scvi-codegen", prog_name="scvi-codegen")
def main() -> None:
    """Entry point of the command ``scvi-codegen``."""


@main.command(short_help="Integrate MODEL and sum up what was conserved.")
@partial(model_arguments, required=False)
@click.option(
    "-o",
    "--output",
    type=click.Path(),
    metavar="PATH",
    help="Trajectory: .npz, .csv, .h5 or .zarr; or a folder, NAME.run or NAME/, for a run of any length.",
)
@click.option("--resume", type=click.Path(), metavar="FOLDER", help="Go on with the run in a folder, without MODEL.")
@click.option(
    "--checkpoint",
    type=float,
    metavar="SECONDS",
    help="Into a folder what is computed is written at least so often [10].",
)
@click.option("--checkpoint-steps", type=int, metavar="N", help="And every so many steps.")
@click.option("--certificate", type=click.Path(), metavar="FILE", help="JSON file to keep in the folder.")
@click.option("--plot", type=click.Path(), metavar="FILE", help="Picture, .png or .svg (needs matplotlib).")
@click.option(
    "--ensemble", type=click.Path(), metavar="FILE", help="Many initial states: a grid (.toml) or a table (.csv)."
)
@click.option(
    "--tolerance",
    type=float,
    metavar="X",
    help="Choose the step for this error of the positions at the end, relative to their size.",
)
@SOLVER_OPTION
@click.option(
    "--solver-tolerance", type=float, metavar="X", help="Relative size of the last update of the stages [round-off]."
)
@click.option("--max-iterations", type=int, metavar="N", help="Iterations after which a step fails [50].")
def run(
    model_name: str | None,
    output: str | None,
    resume: str | None,
    checkpoint: float | None,
    checkpoint_steps: int | None,
    certificate: str | None,
    plot: str | None,
    ensemble: str | None,
    tolerance: float | None,
    solver: str,
    solver_tolerance: float | None,
    max_iterations: int | None,
    **choices: Any,
) -> None:
    """Integrate MODEL and print what was conserved and where it ended.

    A step that fails, or Ctrl-C, ends the run early: what was computed so far is summed up, and written to the files
    asked for.

    With --tolerance the step is chosen by short pilot runs, for the error wanted at the end; advice and evidence are
    printed. With --ensemble MODEL is run from many initial states. A grid has one section, every combination is run:

    \b
      [grid]
      q1 = { from = 0.5, to = 1.5, count = 11 }
      q2_dot = [0.9, 1.0, 1.1]
      mu = 2.0

    A table is a CSV file with the names in its first line. Names are those of coordinates, velocities (q1_dot) or
    momenta (p_q1), and parameters; MODEL gives the others. An .npz file has arrays q and p of shape (states,
    trajectories, coordinates); a .csv file has a line a state.

    Into a folder (-o long.run) the states are written as they are computed, with all that the run needs to go on. It
    may be killed at any time; --resume continues it bit for bit, with --steps or --span further than it was meant to
    go. The memory in use does not grow. 'scvi-codegen export' makes one file of it.

    \b
    Examples:
      scvi-codegen run outer-solar-system --plot orbits.png
      scvi-codegen run kepler --step 0.1 --steps 100000 --every 100 -o orbit.npz
      scvi-codegen run kepler --tolerance 1e-9
    """  # noqa: D301  (click wants the character \b)
    from scvi_codegen.cli.recording import Recording, check_resumed, is_folder

    recording = Recording(seconds=checkpoint, steps=checkpoint_steps, certificate=certificate)
    if resume is not None:
        check_resumed(click.get_current_context())
        _finish_recording(recording.resume(resume, steps=choices["steps"], span=choices["span"]))
        return
    if model_name is None:
        raise click.UsageError("Missing argument 'MODEL', or --resume FOLDER.")
    recorded = output is not None and is_folder(output)
    recording.check(recorded)
    _check_outputs(output, plot, ensemble)
    _check_combination(choices, plot=plot, ensemble=ensemble, tolerance=tolerance, folder=output if recorded else None)
    model = read_model(model_name, Choices(**choices))
    from scvi_codegen.native.options import SolverOptions

    given = {"tolerance": solver_tolerance, "max_iterations": max_iterations}
    chosen: dict[str, Any] = {key: value for key, value in given.items() if value is not None}
    options = SolverOptions(**chosen)
    if ensemble is not None:
        _run_ensemble(model, ensemble, output, solver, options)
        return
    if tolerance is not None:
        from scvi_codegen.cli.advising import advised_model

        model = advised_model(model, tolerance, solver=solver, options=options)
    if output is not None and recorded:
        _finish_recording(recording.record(model, output, solver=solver, options=options))
        return
    _run_one(model, output, plot, solver, options)


@main.command(short_help="Make one file of a run in a folder.")
@click.argument("folder", type=click.Path())
@click.option("-o", "--output", type=click.Path(), metavar="FILE", help="Trajectory: .npz, .csv, .h5 (HDF5) or .zarr.")
def export(folder: str, output: str | None) -> None:
    """Write the states of the run in FOLDER to one file, or say what is in it.

    The run may be under way: what is in the folder is written. Memory does not depend on its length. HDF5 and Zarr need
    'scvi-codegen[data]'; xarray.open_dataset and xarray.open_zarr read them.

    \b
    Example:
      scvi-codegen export long.run -o long.csv
    """  # noqa: D301  (click wants the character \b)
    from scvi_codegen.cli.recording import standing
    from scvi_codegen.results.recording import load_run

    if output is not None:
        _check_outputs(output, None, None)
    recorded = load_run(folder)
    click.echo(standing(recorded))
    if output is not None:
        recorded.save(output)
        click.echo(f"wrote {output}")


@main.command(short_help="Write MODEL as C and as a Python package.")
@model_arguments
@click.option(
    "-o", "--output", type=click.Path(), required=True, metavar="DIR", help="Folder; its name is the C prefix."
)
@SOLVER_OPTION
@click.option("--force", is_flag=True, help="Overwrite files of the same names that were edited or are not ours.")
@click.option(
    "--embedded",
    type=click.Choice(["double", "single"]),
    help="C for a microcontroller, in this precision, without a Python package.",
)
def generate(model_name: str, output: str, solver: str, force: bool, embedded: Embedded | None, **choices: Any) -> None:
    """Write MODEL as C with an example and a Makefile, in a folder that is also a Python package.

    With --embedded the C is small: Newton's iteration alone, or an explicit method, iterations bounded by a macro.

    \b
    Example:
      scvi-codegen generate planar-pendulum -o pendulum_svi
      make -C pendulum_svi run
      python -c "import pendulum_svi; print(pendulum_svi.stepper.step([0.5], [0.0], 0.1))"
    """  # noqa: D301  (click wants the character \b)
    model = read_model(model_name, Choices(**choices))
    from scvi_codegen.models.package import generate_package

    folder = generate_package(model, output, solver=solver, force=force, embedded=embedded)
    click.echo(f"{model.system.name}: {model.method.title}")
    python = "" if embedded else f", or 'import {folder.resolve().name}'"
    click.echo(f"wrote {folder}; run the C example with 'make -C {folder} run'{python}")


@main.command(short_help="Print the equations of one step of MODEL.")
@model_arguments
@click.option("--latex", is_flag=True, help="LaTeX instead of text.")
@click.option("--radicals", is_flag=True, help="Table entries as rationals and radicals where they are short.")
@click.option("-o", "--output", type=click.Path(), metavar="FILE", help="Write here instead of to the screen.")
@click.option(
    "--html", type=click.Path(), metavar="FILE", help="Write a page: everything from L to the C, side by side."
)
def derive(model_name: str, latex: bool, radicals: bool, output: str | None, html: str | None, **choices: Any) -> None:
    """Print the equations of one step of MODEL: unknowns, stage equations, end state.

    With --html everything between the Lagrangian and the C goes to a page that needs no network: equations of motion,
    trial curve, tables, equations with the paper's numbers, Jacobian, operation counts, C beside its formulas.

    \b
    Examples:
      scvi-codegen derive planar-pendulum --method svi --degree 1 --quadrature gauss-lobatto:2 --radicals
      scvi-codegen derive kepler --html kepler.html
    """  # noqa: D301  (click wants the character \b)
    if html is not None:
        if latex or radicals or output is not None:
            raise click.UsageError("--html writes a page of its own: leave out --latex, --radicals and -o")
        _check_writable(Path(html), "'--html'")
    model = read_model(model_name, Choices(**choices))
    if html is not None:
        from scvi_codegen.derivation import derivation_html

        _emit(derivation_html(model.system, model.method), html)
        return
    from scvi_codegen.derivation.equations import derive as derive_equations

    equations = derive_equations(model.system, model.method, radicals=radicals)
    _emit(equations.to_latex() if latex else equations.to_text(), output)


@main.command(short_help="Measure whether the integrator of MODEL keeps what it promises.")
@model_arguments
@click.option("-o", "--output", type=click.Path(), metavar="FILE", help="The certificate as JSON.")
@SOLVER_OPTION
def verify(model_name: str, output: str | None, solver: str, **choices: Any) -> None:
    """Build the integrator of MODEL and measure what it promises; exit status 1 if a promise is broken.

    MODEL may also be a folder written by 'generate': then the C code in it is what is measured. A step is held against
    the paper's equations in 60 digits and these against the exact motion; order, symplecticity, reversal, momenta,
    Newton's matrix and identities between methods are measured. The JSON goes into the folder or beside the model file.

    \b
    Examples:
      scvi-codegen verify kepler --method scvi --degree 3
      scvi-codegen verify mine.toml
      scvi-codegen generate mine.toml -o mine_svi
      scvi-codegen verify mine_svi
    """  # noqa: D301  (click wants the character \b)
    from scvi_codegen.cli.verifying import certificate_path, verified

    path = certificate_path(model_name) if output is None else Path(output)
    if path is not None:
        _check_writable(path, "'-o'")
    certificate = verified(model_name, Choices(**choices), solver=solver)
    click.echo(certificate.to_text(), nl=False)
    if path is not None:
        certificate.save(path)
        click.echo(f"wrote {path}", err=True)
    if not certificate.passed:
        raise _Failure(f"broken: {', '.join(check.name for check in certificate.broken)}", FAILURE)


@main.command(short_help="List the catalogue, or print an entry as a file.")
@click.argument("name", required=False)
def systems(name: str | None) -> None:
    """List the systems of the catalogue, or print the one called NAME as a model file.

    \b
    Example:
      scvi-codegen systems double-pendulum > mine.toml
    """  # noqa: D301  (click wants the character \b)
    if name is None:
        from scvi_codegen.cli.listings import systems_table

        click.echo(systems_table())
    else:
        from scvi_codegen.models.model_file import Model, dump_model
        from scvi_codegen.models.problems import problem

        click.echo(dump_model(Model.from_problem(problem(name))), nl=False)


@main.command(short_help="List the methods and their properties.")
@click.option("--tableau", metavar="NAME:S", help="Print a Butcher tableau instead, as in gauss:3.")
def methods(tableau: str | None) -> None:
    """List the methods with their arguments, and order, symplecticity and symmetry of an example of each."""
    from scvi_codegen.cli.listings import methods_table, tableau_text

    click.echo(methods_table() if tableau is None else tableau_text(tableau))


@main.command(short_help="Show or clear the cache of compiled integrators.")
@click.argument("action", type=click.Choice(["info", "clear", "path"]), default="info")
def cache(action: str) -> None:
    """Show what is in the cache of compiled integrators (info), empty it (clear), or print where it is (path).

    SCVI_CODEGEN_CACHE names another folder. When the entries are larger than SCVI_CODEGEN_CACHE_SIZE (as in 500M or 2G;
    1G if it is not set; 0 for no limit), those used least recently are removed.

    \b
    Example:
      scvi-codegen cache info
    """  # noqa: D301  (click wants the character \b)
    from scvi_codegen.files.cache import cache_folder, cache_info, clear_cache

    if action == "clear":
        count = clear_cache()
        click.echo(f"removed {count:,} bytes from {cache_folder()}")
    else:
        click.echo(cache_folder() if action == "path" else cache_info())


@main.command(short_help="Measure this project against other integrators.")
@click.argument("sections", nargs=-1, metavar="[SECTION ...]")
@click.option("--peers", metavar="NAME,..", help="Only these of heyoka, rebound, cyrk, jitcode, scipy; none: ''.")
@click.option("--json", "json_path", type=click.Path(), metavar="FILE", help="All measurements as JSON.")
@click.option("--plot", type=click.Path(), metavar="FILE", help="Work-precision plot, .png or .svg.")
@click.option("--repeats", type=int, default=5, show_default=True, help="Timed rounds.")
@click.option("--quick", is_flag=True, help="Short spans and few settings, to see that everything works.")
def bench(
    sections: tuple[str, ...], peers: str | None, json_path: str | None, plot: str | None, repeats: int, quick: bool
) -> None:
    """Time this project and the installed peers in turn, and compare them at equal error.

    SECTION is a problem (planar-pendulum, duffing, kepler:0.2, kepler:0.5, henon-heiles, outer-solar-system,
    double-pendulum, relativistic-particle, fput-chain:8, :64, :256), 64 trajectories of one at once
    (ensemble:planar-pendulum, ensemble:kepler:0.2, ensemble:outer-solar-system), drift (the energy over ten million
    steps), tables (6 and 7 of the paper), compositions (explicit ones), hand-written (C) or start-up; by default all.
    Install the peers with 'scvi-codegen[bench]'. Ctrl-C ends it with what was measured.

    \b
    Examples:
      scvi-codegen bench kepler:0.5 --peers heyoka --plot kepler.svg
      scvi-codegen bench drift hand-written --json measured.json
    """  # noqa: D301  (click wants the character \b)
    for path, hint in ((json_path, "'--json'"), (plot, "'--plot'")):
        if path is not None:
            _check_writable(Path(path), hint)
    from scvi_codegen.benchmark import PEERS, Plan, benchmark

    names = tuple(PEERS) if peers is None else tuple(filter(None, peers.split(",")))
    plan, say = Plan(peers=names, repeats=repeats, quick=quick), partial(click.echo, err=True)
    report = benchmark(sections, plan, json_path=json_path, plot_path=plot, say=say)
    click.echo(report.text())
    if report.interrupted:
        raise _Failure(f"interrupted in '{report.interrupted}'; what was measured before is above", INTERRUPTED)


@main.command(short_help="Run the paper's experiments again, with a verdict on each claim.")
@click.argument("names", nargs=-1, metavar="[WHAT ...]")
@click.option(
    "-o", "--output", default="reproduced", show_default=True, type=click.Path(), metavar="DIR", help="Folder of files."
)
@click.option("--html", type=click.Path(), metavar="FILE", help="All results on one page that needs no network.")
@click.option("--jobs", type=click.IntRange(min=1), metavar="N", help="Experiments at a time [as many as processors].")
@click.option("--list", "listing", is_flag=True, help="Print the names, and run nothing.")
def reproduce(names: tuple[str, ...], output: str, html: str | None, jobs: int | None, listing: bool) -> None:
    """Run figures, tables and claims of the paper again, and judge them by what is measured (needs matplotlib).

    WHAT is 'all' or names of experiments ('--list' prints them); what they need is run too. Each result is written to
    the folder when it is there: NAME.txt with the verdicts, NAME.svg and NAME.png, NAME.csv with all numbers, and
    NAME.html where there are formulas.

    That a claim of the paper does not hold is a finding, not a failure: the exit status is 0 when everything ran, 1 if
    an experiment failed to run, 130 after Ctrl-C, which leaves what was written.

    \b
    Examples:
      scvi-codegen reproduce --list
      scvi-codegen reproduce all --html paper.html
      scvi-codegen reproduce figure-4 figure-5 -o figures --jobs 1
    """  # noqa: D301  (click wants the character \b)
    from scvi_codegen.cli.reproducing import experiments_table, reproduce_experiments

    if listing:
        click.echo(experiments_table(names or ("all",)))
        return
    if not names:
        raise click.UsageError("say what to reproduce: 'all', or names that 'scvi-codegen reproduce --list' prints")
    folder = Path(output)
    if folder.exists() and not folder.is_dir():
        raise click.BadParameter(f"'{folder}' is not a folder", param_hint="'-o'")
    if html is not None:
        _check_writable(Path(html), "'--html'")
    done = reproduce_experiments(names, folder, Path(html) if html is not None else None, jobs)
    if done.files:
        click.echo(f"\n{done.summary()}")
    if done.interrupted:
        raise _Failure("interrupted; what was written before is kept", INTERRUPTED)
    if done.failures:
        raise _Failure(done.failed(), FAILURE)


@contextmanager
def _warnings_as_lines() -> Iterator[None]:
    """Show the warnings of this package as one line each, once."""
    from scvi_codegen.errors import MethodWarning

    shown: set[str] = set()

    def show(message: Warning | str, category: type[Warning], *place: Any, **more: Any) -> None:
        if str(message) not in shown:
            shown.add(str(message))
            click.echo(f"Warning: {message}", err=True)

    with warnings.catch_warnings():
        warnings.simplefilter("always", MethodWarning)
        warnings.showwarning = show
        yield


def _check_outputs(output: str | None, plot: str | None, ensemble: str | None) -> None:
    """Find out before a long run whether its results can be written."""
    from scvi_codegen.cli.recording import check_format, is_folder

    if output is not None and not (ensemble is None and is_folder(output)):
        check_format(output, ensemble=ensemble is not None)
        _check_writable(Path(output), "'-o'")
    if plot is not None:
        _check_writable(Path(plot), "'--plot'")
    if plot is not None:
        from scvi_codegen.results.plotting import check_plot_path

        check_plot_path(plot)


def _check_combination(
    choices: dict[str, Any],
    *,
    plot: str | None,
    ensemble: str | None,
    tolerance: float | None,
    folder: str | None,
) -> None:
    if folder is not None and plot is not None:
        raise click.UsageError("--plot is for a trajectory in memory, not for a run in a folder")
    if tolerance is not None:
        for name in ("step", "steps"):
            if choices[name] is not None:
                raise click.UsageError(f"--tolerance chooses the step: leave out --{name} (--span is the length)")
    for name, value in (("plot", plot), ("tolerance", tolerance)):
        if ensemble is not None and value is not None:
            raise click.UsageError(f"--{name} is for one trajectory, not for --ensemble")


def _run_one(model: Model, output: str | None, plot: str | None, solver: str, options: SolverOptions) -> None:
    from scvi_codegen.cli.running import integrate_model, summary

    outcome = integrate_model(model, solver=solver, options=options)
    click.echo(summary(model, outcome))
    written = _write_outputs(outcome, output, plot)
    if outcome.failure is not None:
        raise _Failure(f"{outcome.failure}\n{_kept(outcome, written)}", FAILURE)
    if outcome.interrupted:
        raise _Failure(f"interrupted at t = {outcome.run.t:g}\n{_kept(outcome, written)}", INTERRUPTED)
    for path in written:
        click.echo(f"wrote {path}")


def _finish_recording(outcome: RecordedOutcome) -> None:
    """Say what came of a recorded run, and how to go on with it."""
    click.echo(outcome.summary())
    if outcome.failure is not None:
        raise _Failure(f"{outcome.failure}\n{outcome.kept()}", FAILURE)
    if outcome.interrupted:
        raise _Failure(f"interrupted at t = {outcome.run.t:g}\n{outcome.kept()}", INTERRUPTED)
    click.echo(f"wrote {outcome.recorded.folder}")


def _run_ensemble(model: Model, path: str, output: str | None, solver: str, options: SolverOptions) -> None:
    from scvi_codegen.cli.ensembles import ensemble_summary, integrate_states
    from scvi_codegen.models.ensemble_file import load_ensemble

    outcome = integrate_states(load_ensemble(path, model), solver=solver, options=options)
    click.echo(ensemble_summary(model, outcome))
    kept = "the states computed were not written to a file (-o)"
    if output is not None:
        outcome.result.save(output)
        kept = f"the states computed were kept: {output}"
    if outcome.interrupted:
        raise _Failure(f"interrupted after {outcome.result.steps.mean():.0f} steps on average\n{kept}", INTERRUPTED)
    if not outcome.result.ok.any():
        raise _Failure(f"every trajectory failed\n{kept}", FAILURE)
    if output is not None:
        click.echo(f"wrote {output}")


def _check_writable(path: Path, hint: str) -> None:
    if path.is_dir() and path.suffix.lower() != ".zarr":
        raise click.BadParameter(f"'{path}' is a folder", param_hint=hint)
    if not path.parent.is_dir():
        raise click.BadParameter(f"there is no folder '{path.parent}'", param_hint=hint)
    if not os.access(path.parent, os.W_OK):
        raise click.BadParameter(f"the folder '{path.parent}' cannot be written", param_hint=hint)


def _write_outputs(outcome: Outcome, output: str | None, plot: str | None) -> list[str]:
    if output is not None:
        outcome.trajectory.save(output)
    if plot is not None:
        from scvi_codegen.results.plotting import plot_trajectory

        plot_trajectory(outcome.trajectory, plot)
    return [path for path in (output, plot) if path is not None]


def _kept(outcome: Outcome, written: list[str]) -> str:
    count = len(outcome.trajectory)
    states = "the initial state was" if count == 1 else f"the {count} states up to there were"
    return f"{states} kept: {' and '.join(written)}" if written else f"{states} not written to a file (-o, --plot)"


def _emit(text: str, output: str | None) -> None:
    if output is None:
        click.echo(text)
        return
    from scvi_codegen.files.atomic import write_atomically

    _check_writable(Path(output), "'-o'")
    write_atomically(output, partial(_write, text.rstrip("\n") + "\n"))
    click.echo(f"wrote {output}", err=True)


def _write(text: str, file: IO[bytes]) -> None:
    file.write(text.encode())
