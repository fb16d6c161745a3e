"""The co-simulation interface of FMI 3.0 behind an integrator: C beside its text, of its public functions alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from scvi_codegen.rendering.environment import support_text, template_environment
from scvi_codegen.rendering.source import Interface, Source, included
from scvi_codegen.rendering.target import DOUBLE
from scvi_codegen.rendering.text import ExampleRun

__all__ = ["with_fmu"]


def with_fmu(
    source: Source, interface: Interface, start: ExampleRun, *, by_velocity: bool, places: Sequence[int], token: str
) -> Source:
    """The text of an integrator with FMI's functions beside it.

    Args:
        source, interface: of the integrator.
        start: initial state, velocities in the place of p if ``by_velocity``; parameters, time, and the step.
        by_velocity: whether an importer gives velocities at the start, not momenta.
        places: where the parameters of each input begin.
        token: by which the FMU knows its own description.
    """
    context = {
        "interface": interface,
        "prefix": interface.prefix,
        "start": start,
        "by_velocity": by_velocity,
        "places": places,
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
        support=tuple((name, support_text(name)) for name in included(code)),
    )
    return replace(source, beside=beside)
