"""Command ``scvi-codegen systems``: list the catalogue, or print one system as a model file."""

from collections.abc import Mapping, Sequence
from typing import Any

import click

from scvi_codegen.interfaces.cli.command_group import reporting, tell
from scvi_codegen.interfaces.cli.model_options import complete_model
from scvi_codegen.interfaces.cli.reports import table
from scvi_codegen.interfaces.models.model import Model
from scvi_codegen.interfaces.models.model_files.document import document_of
from scvi_codegen.interfaces.models.model_files.model_file import dump_model
from scvi_codegen.interfaces.models.problems import PROBLEMS, problem


@click.command()
@click.argument("name", required=False, shell_complete=complete_model)
@reporting
def systems(name: str | None) -> None:
    """List the systems of the catalogue, or print the one called NAME as a model file.

    \b
    Example:
      scvi-codegen systems double-pendulum > mine.toml
    """
    if name is None:
        entries = [_entry(name) for name in PROBLEMS]
        tell(systems_table(entries), systems=entries)
    else:
        model = Model.from_problem(problem(name))
        tell(dump_model(model), nl=False, **document_of(model))


def _entry(name: str) -> dict[str, Any]:
    """Return name, description, coordinates and parameter values of a system of the catalogue."""
    entry = problem(name)
    coordinates, values = [coordinate.name for coordinate in entry.system.coordinates], entry.system.constants_by_name
    return {"name": name, "description": entry.title, "coordinates": coordinates, "parameters": values}


def systems_table(entries: Sequence[Mapping[str, Any]]) -> str:
    """Return a line for each system: name, number of coordinates, description, parameters."""
    rows = [("name", "m", "description", "parameters")]
    for entry in entries:
        parameters = ", ".join(f"{name}={value:g}" for name, value in entry["parameters"].items())
        rows.append((entry["name"], str(len(entry["coordinates"])), entry["description"], parameters))
    return table(rows)
