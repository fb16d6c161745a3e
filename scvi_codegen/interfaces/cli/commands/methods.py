"""Command ``scvi-codegen methods``: list the methods and their properties, or print a tableau."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import click

from scvi_codegen.common.precision import mp
from scvi_codegen.interfaces.cli.command_group import reporting, tell
from scvi_codegen.interfaces.cli.reports import table
from scvi_codegen.methods import ARGUMENTS, METHODS, method_from_specification, size_of
from scvi_codegen.methods.tables.closed_forms import exact_tableau
from scvi_codegen.methods.tables.nodes import Expressions
from scvi_codegen.methods.tables.tableau import tableau_by_name

EXAMPLES: dict[str, dict[str, int | list[float]]] = {
    "svi": {"degree": 4},
    "scvi": {"degree": 4},
    "sc": {"degree": 4},
    "collocation": {"abscissae": [0.25, 0.75]},
    "composition": {"order": 8},
}
"""Arguments of the examples in the list; methods with stages that are absent here have ``EXAMPLE_STAGES``."""
EXAMPLE_STAGES = 3
LONGEST_EXACT = 32
"""Largest number of characters of an entry inside a tableau; tables with longer entries list them below."""


@click.command()
@click.option("--tableau", metavar="NAME:S", help="Print a Butcher tableau instead, as in gauss:3.")
@reporting
def methods(tableau: str | None) -> None:
    """List the methods with their arguments, and order, symplecticity and symmetry of an example.

    A name may include the degree, number of stages or order: --method svi:6 is --method svi --degree 6.
    """
    if tableau is None:
        entries = [entry for name in METHODS for entry in _entries_of(name)]
        tell(methods_table(entries), methods=entries)
    else:
        result = tableau_by_name(tableau)
        numbers: dict[str, Any] = {name: [_decimals(row) for row in getattr(result, name)] for name in "Abc"}
        tell(tableau_text(tableau), name=result.name, order=result.order, **numbers)


def _entries_of(name: str) -> Iterator[dict[str, Any]]:
    """Yield the properties of an example of a method, and of the printed form of the paper if there is one."""
    example: Mapping[str, Any] = EXAMPLES.get(name, {})
    if name not in EXAMPLES and "stages" in ARGUMENTS[name]:
        example = {"stages": EXAMPLE_STAGES}
    variants: list[dict[str, Any]] = [{}]
    if "variational" in ARGUMENTS[name]:
        variants.append({"variational": False})
    size = size_of(name)  # the argument after the colon, as the degree of svi:4
    for variant in variants:
        arguments = {**example, **variant}
        method = method_from_specification({"method": name, **arguments})
        yield {
            "name": name,
            "arguments": list(ARGUMENTS[name]),
            "number": size,
            "example": f"{name}:{arguments[size]}" if size and size in arguments else name,
            "options": _options(arguments),
            "order": method.order,
            "symplectic": method.symplectic,
            "symmetric": method.symmetric,
        }


def methods_table(entries: Iterable[Mapping[str, Any]]) -> str:
    """Return a line for each method with its arguments, and the properties of an example."""
    rows: list[Sequence[str]] = [("name", "arguments", "example", "order", "symplectic", "symmetric")]
    previous_method: str | None = None
    for entry in entries:
        name_and_arguments = ("", "")  # of a further example of the same method
        if entry["name"] != previous_method:
            name = f"{entry['name']}[:{entry['number']}]" if entry["number"] else entry["name"]
            name_and_arguments = (name, ", ".join(entry["arguments"]) or "none")
        order = "none claimed" if entry["order"] is None else str(entry["order"])
        holds = ("yes" if entry[claim] else "no" for claim in ("symplectic", "symmetric"))
        rows.append((*name_and_arguments, " ".join([entry["example"], *entry["options"]]), order, *holds))
        previous_method = entry["name"]
    return table(rows)


def tableau_text(name: str) -> str:
    """Return the Butcher tableau of a name such as ``gauss:3``, in radicals if known and short, else in 17 digits.

    Long radicals are listed below the decimal tableau, one entry a line.
    """
    tableau = tableau_by_name(name)
    rows = [[_decimal(c), *map(_decimal, line)] for c, line in zip(tableau.c, tableau.A, strict=True)]
    rows.append(["", *map(_decimal, tableau.b)])
    exact, below = exact_tableau(tableau), list[str]()
    if exact is not None:
        A, b, c = exact
        radicals = [[str(x), *map(str, line)] for x, line in zip(c, A, strict=True)] + [["", *map(str, b)]]
        if max(len(entry) for line in radicals for entry in line) <= LONGEST_EXACT:
            rows = radicals
        else:
            below = ["", *_entries(A, b, c)]
    widths = [max(len(line[k]) for line in rows) for k in range(len(rows[0]))]
    lines = [
        f"{line[0]:>{widths[0]}} | "
        + "  ".join(f"{entry:>{width}}" for entry, width in zip(line[1:], widths[1:], strict=True))
        for line in rows
    ]
    rule = "-" * (widths[0] + 1) + "+" + "-" * (len(lines[0]) - widths[0] - 2)
    facts = f"order {tableau.order}, {_yes_or_not(tableau.is_symplectic)}symplectic, "
    facts += f"{_yes_or_not(tableau.is_symmetric)}symmetric, {_yes_or_not(tableau.is_a_stable)}A-stable"
    return "\n".join([f"{tableau.name}: {facts}", *lines[:-1], rule, lines[-1], *below])


def _entries(A: Sequence[Expressions], b: Expressions, c: Expressions) -> Iterator[str]:
    yield from (f"c_{i} = {x}" for i, x in enumerate(c, 1))
    yield from (f"a_{i},{j} = {x}" for i, line in enumerate(A, 1) for j, x in enumerate(line, 1))
    yield from (f"b_{j} = {x}" for j, x in enumerate(b, 1))


def _options(arguments: Mapping[str, Any]) -> list[str]:
    abscissae = ["--abscissae", ",".join(map(str, arguments["abscissae"]))] if "abscissae" in arguments else []
    return abscissae if arguments.get("variational", True) else [*abscissae, "--printed"]


def _yes_or_not(holds: bool) -> str:
    return "" if holds else "not "


def _decimals(row: Any) -> Any:
    return [float(_decimal(x)) for x in row] if isinstance(row, Sequence) else float(_decimal(row))


def _decimal(value: object) -> str:
    return str(mp.nstr(value, 17))
