"""``scvi-codegen methods``: the methods and their properties, or a tableau."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import click

from scvi_codegen.cli.wording import table
from scvi_codegen.methods import ARGUMENTS, METHODS, Method, method_from_specification, size_of
from scvi_codegen.tables.closed_forms import exact_tableau
from scvi_codegen.tables.nodes import Expressions
from scvi_codegen.tables.precision import mp
from scvi_codegen.tables.tableau import tableau_by_name

__all__ = ["methods"]

EXAMPLES: dict[str, dict[str, int | list[float]]] = {
    "svi": {"degree": 4},
    "scvi": {"degree": 4},
    "sc": {"degree": 4},
    "collocation": {"abscissae": [0.25, 0.75]},
    "composition": {"order": 8},
}
EXAMPLE_STAGES = 3
LONGEST_EXACT = 32
"""Characters of an entry that stands in a tableau; longer ones stand below it."""


@click.command()
@click.option("--tableau", metavar="NAME:S", help="Print a Butcher tableau instead, as in gauss:3.")
def methods(tableau: str | None) -> None:
    """List the methods with their arguments, and order, symplecticity and symmetry of an example of each.

    A degree, number of stages or order may follow the name: --method svi:6 is --method svi --degree 6.
    """
    click.echo(methods_table() if tableau is None else tableau_text(tableau))


def methods_table() -> str:
    """A line for each method with its arguments, and the properties of an example."""
    rows = [("name", "arguments", "example", "order", "symplectic", "symmetric")]
    for name in METHODS:
        method = _example(name)
        size = size_of(name)
        rows.append(
            (
                f"{name}[:{size}]" if size else name,
                ", ".join(ARGUMENTS[name]) or "none",
                method.name,
                *_properties(method),
            )
        )
        if "variational" in ARGUMENTS[name]:
            printed = method_from_specification({"method": name, **EXAMPLES[name], "variational": False})
            rows.append(("", "", printed.name, *_properties(printed)))
    return table(rows)


def tableau_text(name: str) -> str:
    """Butcher tableau of a name such as ``gauss:3``, in radicals where these are known, else in 17 digits.

    Radicals that are too long for a tableau stand below that of 17 digits, an entry a line.

    Raises:
        MethodError: if there is no such tableau.
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
    """A line for each."""
    yield from (f"c_{i} = {x}" for i, x in enumerate(c, 1))
    yield from (f"a_{i},{j} = {x}" for i, line in enumerate(A, 1) for j, x in enumerate(line, 1))
    yield from (f"b_{j} = {x}" for j, x in enumerate(b, 1))


def _example(name: str) -> Method:
    arguments = EXAMPLES.get(name, {"stages": EXAMPLE_STAGES} if "stages" in ARGUMENTS[name] else {})
    return method_from_specification({"method": name, **arguments})


def _properties(method: Method) -> tuple[str, str, str]:
    order = "none claimed" if method.order is None else str(method.order)
    return order, "yes" if method.symplectic else "no", "yes" if method.symmetric else "no"


def _yes_or_not(holds: bool) -> str:
    return "" if holds else "not "


def _decimal(value: object) -> str:
    return str(mp.nstr(value, 17))
