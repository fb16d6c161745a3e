"""Co-simulation interface of FMI 3.0 for an integrator, in C, by its public functions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from scvi_codegen.rendering.environment import support_text, template_environment
from scvi_codegen.rendering.program_source import ExampleRun
from scvi_codegen.rendering.source import Interface, Source, included
from scvi_codegen.rendering.target import DOUBLE

__all__ = ["with_fmu"]


def with_fmu(
    source: Source,
    interface: Interface,
    start: ExampleRun,
    *,
    by_velocity: bool,
    input_indices: Sequence[int],
    token: str,
) -> Source:
    """Return the source of an integrator with the functions of FMI.

    Args:
        source, interface: of the integrator.
        start: initial state, with velocities instead of p if ``by_velocity``; parameters, time, and the step size.
        by_velocity: whether initial velocities are set instead of momenta.
        input_indices: index of the first parameter of each input.
        token: instantiation token of the model description.
    """
    context = {
        "interface": interface,
        "prefix": interface.prefix,
        "start": start,
        "by_velocity": by_velocity,
        "places": input_indices,
        "token": token,
        "target": DOUBLE,
    }
    environment = template_environment()
    code = environment.get_template("fmu.c.jinja").render(context)
    beside = Source(
        prefix=f"{interface.prefix}_fmu",
        header=environment.get_template("fmu.h.jinja").render(context),
        code=code,
        declarations="",
        support=included(code, support_text),
    )
    return replace(source, beside=beside)
