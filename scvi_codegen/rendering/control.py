"""Steps that choose their own length, behind the text of an integrator."""

from __future__ import annotations

from scvi_codegen.ir.control import Control
from scvi_codegen.ir.program import Program
from scvi_codegen.rendering.environment import template_environment
from scvi_codegen.rendering.source import Source
from scvi_codegen.rendering.text import lane_context

__all__ = ["with_control"]

LAST_STEP = 1e-6
"""A step that ends so near the end, as a part of it, ends there."""

FIRST_STEP = 2.0**-52
"""Of the whole span: the first step tried."""

VANISHING = 2.0**-52 * 1e-6
"""Relative to the time: time is kept in twice the precision, but a motion with such steps ends in a singularity."""

ROUND_OFF = 2.0**-55
"""The least relative error of a step, and the one where none is given: many of them stay below rounding."""

ITERATION_PART = 2.0**-8
"""Of the error allowed to a step: that of its stage equations."""


def with_control(source: Source, program: Program, control: Control) -> Source:
    """The same source with ``<prefix>_advance_to`` behind it."""
    environment = template_environment()
    context = lane_context(program.sweep) | {
        "prefix": program.prefix,
        "program": program,
        "control": control,
        "mantissas": control.mantissas,
        "last_step": LAST_STEP,
        "first_step": FIRST_STEP,
        "vanishing": VANISHING,
        "iteration_part": ITERATION_PART,
        "round_off": ROUND_OFF,
    }
    declarations = environment.get_template("parts/control_declarations.h.jinja").render(context)
    code = environment.get_template("parts/control.c.jinja").render(context)
    return source.followed_by(declarations, code)
