"""Runs in folders, with checkpoints: ``run -o FOLDER.run``, ``run --resume FOLDER`` and ``export``."""

import math
import os
import shlex
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import click
import numpy as np

from scvi_codegen.codegen.native.option_table import DURATION
from scvi_codegen.common.errors import ModelFileError, StepFailedError
from scvi_codegen.common.representation import counted
from scvi_codegen.interfaces.cli.command_group import check_writable
from scvi_codegen.interfaces.cli.model_options import check_exclusive
from scvi_codegen.interfaces.cli.reports import duration
from scvi_codegen.interfaces.cli.running import conserved, event_counts, final_state
from scvi_codegen.interfaces.cli.supervision import interruptions, progress_bar
from scvi_codegen.interfaces.models.model import Model
from scvi_codegen.interfaces.models.model_files.model_file import dump_model
from scvi_codegen.interfaces.models.options import OPTIONS
from scvi_codegen.interfaces.models.time_span import whole_steps_in
from scvi_codegen.runs.driver.run import Run
from scvi_codegen.runs.recording import RecordedRun, load_run, record_run, resume_run
from scvi_codegen.runs.results import export
from scvi_codegen.runs.stepping.step_plan import Adaptive, Fixed, FixedSteps, InTau

SUFFIX = ".run"
MAX_STATES = 10_000
"""Largest number of states used to summarise what was conserved."""
WITH_RESUME = {"resume", "checkpoint", *(option.name for option in OPTIONS if option.determines == DURATION)}
"""Options that are allowed with ``--resume``."""
OF_RUN = "the folder defines the run; only --steps or --span may extend it"


def is_run_folder(output: str) -> bool:
    """Return True if an output is a folder for a run: NAME.run, or a path that ends in a slash."""
    return output.endswith(("/", os.sep)) or Path(output).suffix.lower() == SUFFIX


def check_output(output: str, *, ensemble: bool = False) -> None:
    """Check that a file format exists, that its library is installed and that the file can be written."""
    if Path(output).suffix.lower() not in export.WRITERS:
        formats = f"an ensemble is written as {export.FORMATS}"
        if not ensemble:
            formats = f"a trajectory is written as {export.FORMATS} or into a folder {SUFFIX}"
        raise click.BadParameter(f"{formats}, not as '{output}'", param_hint="'-o'")
    check_writable(Path(output), "'-o'", states=True)


def check_resumed(context: click.Context) -> None:
    """Reject options that would change what ``--resume`` continues."""
    for name in context.params:
        passed = context.get_parameter_source(name) is not click.core.ParameterSource.DEFAULT
        if passed and name not in WITH_RESUME:
            word = "MODEL" if name == "model_name" else f"--{name.replace('_', '-')}"
            raise click.UsageError(f"{word} is not allowed with --resume: {OF_RUN}")


@dataclass(frozen=True, slots=True, kw_only=True)
class RecordedOutcome:
    """Result of a run in a folder.

    Attributes:
        recorded: contents of the folder.
        run: state of the integration at the last checkpoint.
        first: number of steps completed before this call.
        seconds: seconds spent in this call.
        failure: error of the step that failed, or ``None``.
        interrupted: True if a signal ended the run.
    """

    recorded: RecordedRun
    run: Run
    first: int
    seconds: float
    failure: StepFailedError | None
    interrupted: bool

    def summary(self) -> str:
        """Return a summary of the run in a few lines."""
        steps = self.run.steps - self.first
        lines = [describe_progress(self.recorded)]
        if steps:
            since = f" since step {self.first}" if self.first else ""
            lines.append(f"{self.seconds:.3g} s{since}, {duration(self.seconds / steps)} per step, including writing")
        end = final_state(self.run.stepper.interface, self.run.q, self.run.p)
        return "\n".join([*lines, *self._conserved(), *event_counts(self.recorded.events), *end])

    def _conserved(self) -> list[str]:
        """Return lines on conserved quantities if the folder names a model that determines them."""
        if self.recorded.manifest.model is None or not self.run.steps:
            return []
        stride = -(-len(self.recorded) // MAX_STATES)
        with np.errstate(all="ignore"):
            lines = list(conserved(self.recorded[::stride]))
        return [f"in every {stride}th saved state:", *lines] if stride > 1 else lines

    def continuation(self) -> str:
        """Return a line on what was written, and the command that continues the run unless a step failed."""
        folder = self.recorded.folder
        states = f"the {len(self.recorded)} states computed before are in '{folder}'"
        if self.failure is not None:
            return states
        return f"{states}; continue with: scvi-codegen run --resume {shlex.quote(str(folder))}"


def record_model(model: Model, folder: str, seconds: float | None) -> RecordedOutcome:
    """Integrate a model into a folder until its end, a failure or a signal; raises as :func:`record_run`.

    ``seconds`` between checkpoints, ``None`` for the default.
    """
    text = None
    with suppress(ModelFileError):
        text = dump_model(model)
    if model.system.clock is not None and model.ends_at_time:
        raise click.UsageError("a recorded run in transformed time needs a number of steps: give --step and --steps")
    run, target = model.start(), Path(folder)
    steps = model.whole_step_count() if isinstance(run.plan, FixedSteps) else None
    record = partial(record_run, run, target, save_every=model.save_every, model=text)
    return _with_progress(record, target, first=0, steps=steps, seconds=seconds)


def resume_folder(folder: str, *, steps: int | None, span: float | None, seconds: float | None) -> RecordedOutcome:
    """Continue the run in a folder; raises as :func:`resume_run`."""
    check_exclusive({"steps": steps, "span": span})
    recorded = load_run(folder)
    manifest, further = recorded.manifest, dict[str, Any]()
    match manifest.plan:
        case _ if span is None:
            pass
        case Adaptive(t_end=t_end) | InTau(t_end=t_end):
            further["t_end"] = manifest.t + math.copysign(span, t_end - manifest.t)
        case Fixed(h):
            if manifest.interface.in_tau:
                raise click.UsageError(
                    "a recorded run in transformed time needs a number of steps: give --steps, not --span"
                )
            steps = whole_steps_in(span, h, manifest.t)
    steps, target = manifest.steps if steps is None else steps, Path(folder)
    resume = partial(resume_run, target, **further)
    return _with_progress(resume, target, first=recorded.steps, steps=steps, seconds=seconds)


def _with_progress(
    write: Callable[..., RecordedRun], folder: Path, *, first: int, steps: int | None, seconds: float | None
) -> RecordedOutcome:
    """Record or resume with a progress bar; SIGINT and SIGTERM end the run at a checkpoint."""
    write = write if seconds is None else partial(write, checkpoint_seconds=seconds)
    failure, began = None, time.perf_counter()
    with interruptions() as caught, progress_bar(0 if steps is None else steps - first) as show_progress:
        try:
            write(steps=steps, progress=lambda done: show_progress(done - first), stop=lambda: bool(caught))
        except StepFailedError as error:
            failure = error
    recorded = load_run(folder)
    return RecordedOutcome(
        recorded=recorded,
        run=recorded.resumed(),
        first=first,
        seconds=time.perf_counter() - began,
        failure=failure,
        interrupted=bool(caught) and not recorded.finished,
    )


def describe_progress(recorded: RecordedRun) -> str:
    """Return two lines: the integrator of a run in a folder, and its progress."""
    manifest = recorded.manifest
    done = counted(recorded.steps, "step")
    if not isinstance(manifest.plan, Fixed):
        progress_text = f"{done} {manifest.plan.sizes} from t = {manifest.t:g} to t = {recorded.t[-1]:g}"
        progress_text += "" if recorded.finished else f" (of {manifest.plan.t_end:g})"
    else:
        h, t = manifest.plan.h, manifest.t + recorded.steps * manifest.plan.h
        far = "all" if recorded.finished else f"of {manifest.steps}"
        if manifest.interface.in_tau:
            done, t = f"{done} in tau", float(recorded.t[-1])
        progress_text = f"{done} ({far}) of {h:g} from t = {manifest.t:g} to t = {t:g}"
    continuation = f"{counted(len(recorded), 'state')} saved in '{recorded.folder}'"
    return f"{' '.join(manifest.interface.title.split())}\n{progress_text}; {continuation}"
