"""Command ``scvi-codegen derive``: the equations of one step, or the page from L to C."""

from pathlib import Path
from typing import Any

import click

from scvi_codegen.api.commands import check_writable, model_arguments, note, read_model, reporting, tell
from scvi_codegen.api.text import write_text
from scvi_codegen.extras.derivation.equations import StepEquations
from scvi_codegen.extras.derivation.equations import derive as derive_equations
from scvi_codegen.extras.derivation.notation import events_text
from scvi_codegen.extras.derivation.page.document import derivation_html
from scvi_codegen.extras.fields.laws import derivation_of


@click.command()
@model_arguments()
@click.option("--latex", is_flag=True, help="LaTeX instead of text.")
@click.option("--radicals", is_flag=True, help="Print table entries as short rationals and radicals.")
@click.option("-o", "--output", type=click.Path(), metavar="FILE", help="Write to FILE instead of stdout.")
@click.option(
    "--html", type=click.Path(), metavar="FILE", help="Write an HTML page with the derivation from L to the C code."
)
@reporting
def derive(model_name: str, latex: bool, radicals: bool, output: str | None, html: str | None, **choices: Any) -> None:
    """Print the equations of one step of MODEL: unknowns, stage equations, end state.

    Of explicit and constrained steps and of heat baths also the statements that the C is generated from.

    --html writes a self-contained page with the whole derivation: equations of motion, trial curve, tables, equations
    with the paper's numbers, Jacobian, operation counts, and the C code next to its formulas.

    For fields first the equations and conservation laws of the density, and the semi-discrete system.

    For an array model: each term group with its derivatives with respect to its entries, masses, and the step; with
    --html and --radicals the equations for its sizes.

    \b
    Examples:
      scvi-codegen derive planar-pendulum --method svi:1 --quadrature gauss-lobatto:2 --radicals
      scvi-codegen derive kepler --html kepler.html
    """
    if html is not None:
        if latex or radicals or output is not None:
            raise click.UsageError("--html excludes --latex, --radicals and -o")
        check_writable(Path(html), "'--html'")
    model = read_model(model_name, choices)
    about = {"system": model.system.name, "method": model.method.name}
    if html is not None or radicals:
        model = model.with_known_sizes("--html" if html is not None else "--radicals")
    if html is not None:
        _emit(derivation_html(model.system, model.method, events=model.events), html, **about)
        return
    equations = derive_equations(model.system, model.method, radicals=radicals)
    text = equations.to_latex() if latex else equations.to_text()
    if not latex and (mesh := model.system.mesh) is not None:
        text = f"{derivation_of(mesh.field_system, model.system).to_text()}\n{text}"
    if not latex and model.events:
        text += f"\n{events_text(model.events, model.system)}\n"
    formulas = _formulas(equations) if isinstance(equations, StepEquations) else {}
    _emit(text, output, **about, **formulas, text=text)


def _emit(text: str, output: str | None, /, **numbers: Any) -> None:
    """Print a text, or write it to a file; with ``--json`` the numbers."""
    if output is None:
        tell(text, **numbers)
        return
    check_writable(Path(output), "'-o'")
    write_text(output, text.rstrip("\n") + "\n")
    tell(**numbers, written=[output])
    note(f"wrote {output}")


def _formulas(equations: StepEquations) -> dict[str, Any]:
    """Return the document of ``--json``: formulas as text, equations as residuals, the new state in order."""
    return {
        "unknowns": [symbol.name for symbol in equations.unknowns],
        "equations": [
            {"number": equation.number, "residual": str(equation.residual)} for equation in equations.equations
        ],
        "end": {
            "q": [str(equation.residual) for equation in equations.end_position],
            "p": [str(equation.residual) for equation in equations.end_momentum],
        },
        "initial_guess": {symbol.name: str(value) for symbol, value in equations.initial_guess.items()},
        "entries": {entry.symbol.name: float(entry.value) for entry in equations.entries},
        "statements": dict(equations.statements),
        "conserved": [str(symmetry) for symmetry in equations.symmetries],
    }
