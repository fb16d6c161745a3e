"""Entry point of the command line; each command is a module of ``commands``, imported when it is called.

``--help`` and ``--version`` therefore import neither SymPy nor NumPy.
"""

import click

from scvi_codegen.interfaces.cli.command_group import Commands

__all__ = ["main"]

OVERVIEW = """Compile a Lagrangian into a variational integrator in C, integrate it, and print its equations.

MODEL is a model file (TOML) or a name of the catalogue ('scvi-codegen systems'). Options complete and override it.

\b
Examples:
  scvi-codegen run kepler                              integrate; report conserved quantities
  scvi-codegen run kepler --step 0.1 -o orbit.npz --plot orbit.png
  scvi-codegen run kepler --method gauss:4 --parameter mu=2 --q 1,0 --velocity 0,1.2
  scvi-codegen systems kepler > mine.toml              a model file to start from
  scvi-codegen run mine.toml --span 1000 --save-every 10 -o orbit.csv
  scvi-codegen run mine.toml --span 1e4 --save-every 1000 -o long.run    into a folder, with checkpoints
  scvi-codegen run --resume long.run                   restart from the last checkpoint
  scvi-codegen derive planar-pendulum --method svi:2 --quadrature gauss-legendre:2
  scvi-codegen derive kepler --html kepler.html        the derivation from L to the C code on one page
  scvi-codegen generate mine.toml -o mine_svi          C, a Makefile and a Python package in the folder mine_svi
  scvi-codegen reproduce all --html paper.html         figures, tables and claims of the paper, with verdicts
  scvi-codegen verify mine_svi                         measure its guaranteed properties
  scvi-codegen run ring.toml --size N=10000            an array model (lattice), of any size

With --json a command prints one JSON document, with --quiet only errors and warnings; files are written as usual.

Exit status: 0 on success; 1 if a step failed, a guaranteed property is violated, there is no C compiler or a file
cannot be written; 2 if the command line or a model is invalid; 130 after Ctrl-C.
"""

START = """scvi-codegen compiles a Lagrangian into a variational integrator in C. Begin with:

  scvi-codegen run kepler --plot orbit.png     integrate a problem of the catalogue, and draw it
  scvi-codegen systems kepler > mine.toml      write it as a model file, to change
  scvi-codegen run mine.toml                   integrate the model file

scvi-codegen --help lists all commands, scvi-codegen run --help the options of a run.
"""

ABOUT = {
    "cache": "Show or clear the cache of compiled integrators.",
    "doctor": "Check compiler and libraries of this machine.",
    "export": "Write the states of a run in a folder to one file.",
    "generate": "Generate C code and a Python package for MODEL.",
    "methods": "List the methods and their properties.",
    "run": "Integrate MODEL and report conserved quantities.",
    "systems": "List the catalogue, or print a system as a file.",
}
"""Commands of the core by the text of the overview; those of extras follow from the registry."""


@click.group(
    cls=Commands,
    folder="scvi_codegen.interfaces.cli.commands",
    about=ABOUT,
    help=OVERVIEW,
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"]},
)
@click.version_option(package_name="scvi-codegen", prog_name="scvi-codegen")
@click.pass_context
def main(context: click.Context) -> None:
    """Entry point of the command ``scvi-codegen``; without arguments it prints the commands to begin with."""
    if context.invoked_subcommand is None:
        click.echo(START, nl=False)
