"""``scvi-codegen run --tolerance``: the model with the step that its advice gives, and the evidence for people."""

from __future__ import annotations

import math
from dataclasses import replace

import click

from scvi_codegen.advice import Advice, advise
from scvi_codegen.binding import SolverOptions
from scvi_codegen.cli.running import duration
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.model_file import Model

__all__ = ["advised_model"]


def advised_model(model: Model, tolerance: float, *, solver: str, options: SolverOptions) -> Model:
    """The model with step and number of steps for an error at the end; prints why, and warnings to stderr.

    Raises:
        StateError: if the tolerance is not positive, or every pilot run fails.
    """
    span = model.span if model.span is not None else abs(model.h) * model.step_count
    stepper = compile_stepper(model.system, model.method, solver=solver)
    advice = advise(
        model.system,
        model.method,
        model.q,
        model.momenta(stepper),
        math.copysign(span, model.h),
        tolerance,
        t=model.t,
        solver=solver,
        options=options,
    )
    click.echo(_text(advice))
    for warning in advice.warnings:
        click.echo(f"Warning: {warning}", err=True)
    return replace(model, h=advice.h, steps=advice.steps, span=None)


def _text(advice: Advice) -> str:
    """The message and a line a pilot run."""
    lines = [
        f"  h = {row.h:<12.6g} error {row.error:<9.2g} {duration(row.seconds)} a unit of time"
        if math.isfinite(row.error)
        else f"  h = {row.h:<12.6g} fails"
        for row in advice.evidence
    ]
    return "\n".join([advice.message, *lines, ""])
