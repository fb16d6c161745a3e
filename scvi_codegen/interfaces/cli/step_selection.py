"""Step-size selection of ``scvi-codegen run``: ``--tolerance``, ``--error`` and ``--advise``."""

import math
import warnings
from dataclasses import replace
from typing import Any

import click

from scvi_codegen.codegen.native.option_table import OPTION
from scvi_codegen.codegen.rendering.source import DOUBLE_DOUBLE, PRECISIONS
from scvi_codegen.common.errors import AccuracyWarning, StateError
from scvi_codegen.common.registry import part
from scvi_codegen.common.representation import counted
from scvi_codegen.interfaces.cli.command_group import tell
from scvi_codegen.interfaces.cli.reports import duration
from scvi_codegen.interfaces.models.model import Model
from scvi_codegen.interfaces.models.model_files.ensemble_file import EnsembleStates
from scvi_codegen.interfaces.models.options import OF_ADAPTIVE_STEPS
from scvi_codegen.runs.accuracy.global_error import GlobalError
from scvi_codegen.runs.stepping.features import refusal, require

ROUND_OFF = 2.0**-52
"""Unit in the last place of 1 in double precision; smaller tolerances mean "as accurate as doubles allow"."""
MAX_STEPS = 10**9
"""Largest number of steps that is started without ``--step``: a quarter of an hour at one microsecond each."""


def model_with_adaptive_steps(model: Model, tolerance: float) -> Model:
    """Return the model with adaptive steps whose local error is bounded by the tolerance, or by round-off."""
    OPTION["tolerance"].checked(tolerance)
    if tolerance < ROUND_OFF and not model.in_double_double:
        click.echo(f"Warning: tolerance {tolerance:g} is below double precision: round-off is used instead", err=True)
    allowed = tolerance if tolerance >= ROUND_OFF or model.in_double_double else None
    return model._with_step_size(tolerance=allowed)


def model_with_global_error(model: Model, error: float) -> tuple[Model, GlobalError]:
    """Return the model with the steps that meet a global error bound, and the estimate of that error.

    The estimate is printed. Steps of one tolerance are reproducible to the last bit, so that the run that follows is
    the one whose error was estimated.
    """
    bounded = model._with_step_size(error=error)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", AccuracyWarning)  # reported in the line printed below
        result = bounded.confirmed(bounded.stepper())
    local = f"local tolerance of {'round-off' if result.tolerance is None else f'{result.tolerance:.1e}'}"
    local += "" if result.max_step == math.inf else f" and steps of at most {result.max_step:.3g}"
    local = local if result.h is None else f"step of tau of {result.h:.6g}"
    in_words = result.precision == DOUBLE_DOUBLE
    local += f" in {DOUBLE_DOUBLE}" if in_words else ""
    numbers = {
        "requested": error,
        "estimate": result.estimate,
        "digits": result.digits,
        "confirmed": result.confirmed,
        "confirmed_until": result.confirmed_until,
        "tolerance": result.tolerance,
        "max_step": None if result.max_step == math.inf else result.max_step,
        "h": result.h,
        "runs": result.runs,
        "precision": result.precision,
    }
    tell(
        f"global error: {result.estimate:.1e} (relative), of {counted(result.runs, 'run')}; the bound {error:g} "
        f"is confirmed until t = {result.confirmed_until:g}, with a {local}",
        global_error=numbers,
    )
    if result.h is not None:
        signed = math.copysign(result.h, bounded.covered)
        fixed: dict[str, Any] = dict.fromkeys(OF_ADAPTIVE_STEPS)
        return replace(bounded, h=signed, **fixed, span=abs(bounded.covered), error=None), result
    precision = DOUBLE_DOUBLE if in_words else bounded.precision
    steps: dict[str, Any] = dict(result.steps)
    return replace(bounded, **steps, error=None, precision=precision), result


def model_with_advised_step(model: Model, tolerance: float, states: EnsembleStates | None = None) -> tuple[Model, Any]:
    """Return the model with the fixed step size that errors of pilot runs recommend, and the advice.

    Of an ensemble it is the one for all of its initial states. Prints the recommendation and its pilot runs to stdout,
    warnings to stderr.
    """
    if model.has_time_transformation:
        raise refusal("advice", "with a time transformation")
    stepper = model.stepper()
    require(stepper, "advice")
    advice = part("services", "advise")(
        model.system,
        model.method,
        model.q if states is None else states.q,
        model.momenta(stepper) if states is None else states.momenta(stepper),
        model.covered,
        tolerance,
        parameters=None if states is None else states.parameters,
        t=model.t,
        solver=model.solver,
        options=model.solver_options,
        precision=DOUBLE_DOUBLE if model.in_double_double else PRECISIONS[0],
    )
    numbers = {"h": advice.h, "steps": advice.steps, "message": advice.message, "warnings": list(advice.warnings)}
    tell(_text(advice), advice=numbers)
    for warning in advice.warnings:
        click.echo(f"Warning: {warning}", err=True)
    if advice.steps > MAX_STEPS:
        raise StateError(
            f"the recommended run has {advice.steps} steps, more than {MAX_STEPS:g}: use a method of higher order, a "
            f"larger --advise or a shorter --span, or pass --step {advice.h:.6g} to run it"
        )
    steps = None if model.in_double_double else advice.steps
    return model._with_step_size(h=advice.h, steps=steps), advice


def _text(advice: Any) -> str:
    """Return the recommendation and one line for each pilot run."""
    lines = [f"  h = {row.h:<12.6g} {_outcome(row, abs(advice.h) * advice.steps)}" for row in advice.evidence]
    return "\n".join([advice.message, *lines, ""])


def _outcome(row: Any, span: float) -> str:
    if not math.isfinite(row.error):
        return "fails"
    error = f"error {row.error:.2g}" if row.error < 1.0 else "no correct digit"
    return f"{error:15} {duration(row.seconds * span)} for the whole span"
