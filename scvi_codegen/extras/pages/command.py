"""Command ``scvi-codegen page``: a page that computes the motion in the browser."""

from pathlib import Path
from typing import Any

import click

from scvi_codegen.api.commands import check_writable, model_arguments, read_model, reporting, tell
from scvi_codegen.extras.pages.page import as_written, page_of, sections_of

OF_FORMULAS = (
    *("q", "p", "velocity", "time", "time_transformation"),
    *("limits", "friction", "contacts", "actuators", "keyframe"),
)
"""Options that change the system and the initial state of a file."""


@click.command()
@model_arguments("solver")
@click.option("-o", "--output", type=click.Path(), required=True, metavar="FILE", help="HTML file to write.")
@click.option(
    "--range",
    "ranges",
    type=(str, float, float),
    multiple=True,
    metavar="NAME LOW HIGH",
    help="Range of the slider of a parameter, coordinate x or velocity x_dot; may be repeated.",
)
@reporting
def page(model_name: str, output: str, ranges: tuple[tuple[str, float, float], ...], **choices: Any) -> None:
    """Write a self-contained HTML page that computes the motion of MODEL in the browser.

    The page has sliders for parameters and initial values, plots, and a link to each state. It contains the generated
    C as WebAssembly (extra 'compiler'; its first use takes a minute or two) and needs no network.

    \b
    Examples:
      scvi-codegen page pendulum.toml -o pendulum.html
      scvi-codegen page arm.xml -o arm.html
      scvi-codegen page kinks.toml --range v 0.05 0.95 -o kinks.html
    """
    check_writable(Path(output), "'-o'")
    model = read_model(model_name, choices)
    changed = any(choices.get(name) is not None for name in OF_FORMULAS)
    document = as_written(model_name) if Path(model_name).is_file() and not changed else sections_of(model)
    page_of(model, document, {"ranges": {name: (low, high) for name, low, high in ranges}}).save(output)
    tell(f"wrote {output}", system=model.system.name, method=model.method.name, written=[output])
