"""Command ``scvi-codegen generate``: C, a Makefile and a Python package in a folder; or an FMU."""

from typing import Any

import click

from scvi_codegen.codegen.native.building import TARGETS
from scvi_codegen.codegen.rendering.program_source import Embedded
from scvi_codegen.interfaces.cli.command_group import reporting, tell
from scvi_codegen.interfaces.cli.model_options import model_arguments, read_model
from scvi_codegen.interfaces.models.packages.fmu import generate_fmu
from scvi_codegen.interfaces.models.packages.package import generate_package


@click.command()
@model_arguments("solver")
@click.option(
    "-o",
    "--output",
    type=click.Path(),
    required=True,
    metavar="DIR",
    help="Folder, or NAME.fmu; the name is the C prefix.",
)
@click.option("--force", is_flag=True, help="Overwrite existing files that were edited or not generated.")
@click.option(
    "--embedded",
    type=click.Choice(["double", "single"]),
    help="C for a microcontroller, in this precision, without a Python package.",
)
@click.option(
    "--single-file", is_flag=True, help="One source, all names with the prefix: other C files can include it."
)
@click.option("--fmu", is_flag=True, help="Write an FMU 3.0 for co-simulation: -o NAME.fmu.")
@click.option(
    "--platform",
    "platforms",
    type=click.Choice([*TARGETS]),
    multiple=True,
    help="With --fmu: further platform to compile for; may be repeated (extra 'compiler').",
)
@reporting
def generate(
    model_name: str,
    output: str,
    force: bool,
    embedded: Embedded | None,
    single_file: bool,
    fmu: bool,
    platforms: tuple[str, ...],
    **choices: Any,
) -> None:
    """Generate C code for MODEL, with an example and a Makefile, in a folder that is also a Python package.

    With --embedded the C code is small: Newton's method alone, or an explicit method; a macro bounds the iterations.

    For an array model the folder has C code for any array sizes and the initial state as text files; with --embedded
    and --fmu, and with adaptive steps, the C code is for the sizes of the model.

    With --fmu the output is one file for Modelica tools, Simulink and FMPy: the compiled library, the C code, and the
    description of its variables.

    \b
    Example:
      scvi-codegen generate planar-pendulum -o pendulum_svi
      make -C pendulum_svi run
      python -c "import pendulum_svi; print(pendulum_svi.stepper.step([0.5], [0.0], 0.1))"
    """
    model = read_model(model_name, choices)
    if fmu and (embedded or single_file):
        raise click.UsageError("--fmu excludes --embedded and --single-file")
    if platforms and not fmu:
        raise click.UsageError("--platform requires --fmu: C code in a folder is for any platform")
    for option, needed in (("--fmu", fmu), ("--embedded", embedded), ("an adaptive step size", model.h is None)):
        model = model.with_known_sizes(option) if needed else model
    if fmu:
        folder, python = generate_fmu(model, output, platforms=platforms, force=force), ""
    else:
        folder = generate_package(model, output, force=force, embedded=embedded, single_file=single_file)
        python = "" if embedded else f", or 'import {folder.resolve().name}'"
    tell(f"{model.system.name}: {model.method.title}", system=model.system.name, method=model.method.name)
    use = "" if fmu else f"; run the C example with 'make -C {folder} run'{python}"
    tell(f"wrote {folder}{use}", written=[folder])
