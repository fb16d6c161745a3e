"""``scvi-codegen systems``: the catalogue of systems, or one of them as a model file."""

from __future__ import annotations

import click

from scvi_codegen.cli.choices import complete_model
from scvi_codegen.cli.wording import table
from scvi_codegen.models.model import Model
from scvi_codegen.models.model_file import dump_model
from scvi_codegen.models.problems import PROBLEMS, problem

__all__ = ["systems"]


@click.command()
@click.argument("name", required=False, shell_complete=complete_model)
def systems(name: str | None) -> None:
    """List the systems of the catalogue, or print the one called NAME as a model file.

    \b
    Example:
      scvi-codegen systems double-pendulum > mine.toml
    """
    if name is None:
        click.echo(systems_table())
    else:
        click.echo(dump_model(Model.from_problem(problem(name))), nl=False)


def systems_table() -> str:
    """A line for each problem: name, coordinates, what it is, parameters."""
    rows = [("name", "m", "description", "parameters")]
    for name, build in PROBLEMS.items():
        entry = build()
        parameters = ", ".join(
            f"{symbol}={value:g}" for symbol, value in zip(entry.system.parameters, entry.system.defaults, strict=True)
        )
        rows.append((name, str(entry.system.dimension), entry.title, parameters))
    return table(rows)
