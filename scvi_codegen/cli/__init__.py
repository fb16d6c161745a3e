"""Entry point of the command line; each command is a module of ``commands``, imported when it is called.

``--help`` and ``--version`` therefore import neither SymPy nor NumPy.
"""

from __future__ import annotations

import click

from scvi_codegen.cli.frame import Commands

__all__ = ["main"]

OVERVIEW = """Compile a Lagrangian into a variational integrator in C, run it, look at its equations.

MODEL is a model file (TOML) or a name of the catalogue ('scvi-codegen systems'). Options supply what it lacks and
replace what it says.

\b
Examples:
  scvi-codegen run kepler                              integrate it, print what was conserved
  scvi-codegen run kepler --step 0.1 -o orbit.npz --plot orbit.png
  scvi-codegen run kepler --method gauss:4 --parameter mu=2 --q 1,0 --velocity 0,1.2
  scvi-codegen systems kepler > mine.toml              a model file to start from
  scvi-codegen run mine.toml --span 1000 --save-every 10 -o orbit.csv
  scvi-codegen run mine.toml --span 1e4 --save-every 1000 -o long.run    a folder: the run can be interrupted
  scvi-codegen run --resume long.run                                and goes on where it was
  scvi-codegen derive planar-pendulum --method svi:2 --quadrature gauss-legendre:2
  scvi-codegen derive kepler --html kepler.html        from L to the C on one page
  scvi-codegen generate mine.toml -o mine_svi          C, a Makefile and a Python package in the folder mine_svi
  scvi-codegen reproduce all --html paper.html         every figure, table and claim of the paper, with a verdict
  scvi-codegen verify mine_svi                         measure whether it keeps what it promises
  scvi-codegen run ring.toml --size N=10000            a model of sums over indices, of any size

With --json a command prints one JSON document, with --quiet nothing but errors, warnings and files asked for.

Exit status: 0; 2 if the command line or a model is at fault; 1 if a step failed, a promise is broken, there is
no C compiler or a file cannot be written; 130 after Ctrl-C.
"""

ABOUT = {
    "bench": "Measure this project against other integrators.",
    "cache": "Show or clear the cache of compiled integrators.",
    "derive": "Print the equations of one step of MODEL.",
    "doctor": "Say what this machine has and lacks, and what to install.",
    "export": "Make one file of a run in a folder.",
    "generate": "Write MODEL as C and as a Python package.",
    "methods": "List the methods and their properties.",
    "reproduce": "Run the paper's experiments again, with a verdict on each claim.",
    "run": "Integrate MODEL and sum up what was conserved.",
    "systems": "List the catalogue, or print an entry as a file.",
    "verify": "Measure whether the integrator of MODEL keeps what it promises.",
}


@click.group(
    cls=Commands,
    folder="scvi_codegen.cli.commands",
    about=ABOUT,
    help=OVERVIEW,
    context_settings={"help_option_names": ["-h", "--help"]},
)
@click.version_option(package_name="scvi-codegen", prog_name="scvi-codegen")
def main() -> None:
    """Entry point of the command ``scvi-codegen``."""
