"""Command ``scvi-codegen export``: write the states of a run in a folder to one file."""

import click

from scvi_codegen.interfaces.cli.command_group import reporting, tell
from scvi_codegen.interfaces.cli.json_documents import recorded_numbers
from scvi_codegen.interfaces.cli.recording import check_output, describe_progress
from scvi_codegen.runs.recording import load_run
from scvi_codegen.runs.results.export import FORMATS


@click.command()
@click.argument("folder", type=click.Path())
@click.option("-o", "--output", type=click.Path(), metavar="FILE", help=f"Trajectory: {FORMATS}.")
@reporting
def export(folder: str, output: str | None) -> None:
    """Write the states of the run in FOLDER to one file, or print its progress.

    The run may be in progress: the states recorded so far are written. Memory use does not depend on its length. HDF5
    and Zarr need 'scvi-codegen[data]'; xarray.open_dataset and xarray.open_zarr read them.

    \b
    Example:
      scvi-codegen export long.run -o long.csv
    """
    if output is not None:
        check_output(output)
    recorded = load_run(folder)
    tell(describe_progress(recorded), **recorded_numbers(recorded))
    if output is not None:
        recorded.save(output)
        tell(f"wrote {output}", written=[output])
