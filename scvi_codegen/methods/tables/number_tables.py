"""Tables of nodes, quadratures and Runge-Kutta tableaux: radicals if they are short, and decimals."""

from collections.abc import Iterator, Sequence
from functools import singledispatch
from typing import TypeAlias

import sympy

from scvi_codegen.common.display.cards import Html, grid, plain
from scvi_codegen.common.display.mathml import Typeset
from scvi_codegen.common.display.tables import TableBlock
from scvi_codegen.common.precision import Number, Vector, mp
from scvi_codegen.methods.tables.closed_forms import exact_points, exact_rule, exact_tableau
from scvi_codegen.methods.tables.nodes import Nodes
from scvi_codegen.methods.tables.quadrature import Quadrature
from scvi_codegen.methods.tables.tableau import Tableau

Part: TypeAlias = Nodes | Quadrature | Tableau
"""Parts of a method with numbers."""
_Column: TypeAlias = tuple[str, Vector, Sequence[sympy.Expr] | None]
"""Heading, numbers and, if known, exact forms."""
SHORT = 40
"""Largest number of characters of an exact form that is shown."""
SIGNIFICANT = 17
MOST_ROWS = 12
"""Largest number of rows of a table in a notebook."""


@singledispatch
def number_table(part: Part) -> TableBlock:
    """Return all numbers of a part of a method, named by its title."""
    raise TypeError(f"{part!r} must be Nodes, a Quadrature or a Tableau")


@number_table.register
def _(nodes: Nodes) -> TableBlock:
    series = range(len(nodes.points))
    return _listed(f"Nodes: {nodes.name}, degree {nodes.degree}", series, [("node", nodes.points, exact_points(nodes))])


@number_table.register
def _(quadrature: Quadrature) -> TableBlock:
    points, weights = exact_rule(quadrature) or (None, None)
    columns: list[_Column] = [("point", quadrature.points, points), ("weight", quadrature.weights, weights)]
    columns += [(f"weight of derivative {k}", w, None) for k, w in enumerate(quadrature.derivative_weights, 1)]
    title = f"Quadrature: {quadrature.name}, of order {quadrature.order}"
    return _listed(title, range(1, len(quadrature) + 1), columns)


def _listed(title: str, series: range, columns: Sequence[_Column]) -> TableBlock:
    """Return a table with one row per point, numbered by the ``series``."""
    written = [written for column in columns for written in _columns(*column)]
    return TableBlock(
        name=title,
        columns=("", *(name for name, _ in written)),
        rows=tuple((str(number), *(cells[k] for _, cells in written)) for k, number in enumerate(series)),
    )


def numbers_html(table: TableBlock) -> Html:
    """Return the first rows of a table for a notebook."""
    shown = table.rows[:MOST_ROWS]
    rows = [[plain(cell) if isinstance(cell, str) else Html(Typeset.whole(cell)) for cell in row] for row in shown]
    left_out = len(table.rows) - len(rows)
    title = f"{table.name} (the first {MOST_ROWS} of {len(table.rows)} rows)" if left_out else table.name
    return grid(rows, head=table.columns, caption=title)


def positions(part: Part) -> Vector:
    """Return the abscissae on the step, in [0, 1]."""
    return part.c if isinstance(part, Tableau) else part.abscissae


def decimal(value: Number) -> str:
    """Return 17 digits, which identify a double."""
    return str(mp.nstr(value, SIGNIFICANT))


def short(exact: sympy.Expr | None) -> bool:
    """Return whether an exact form is short enough to be shown."""
    return exact is not None and len(str(exact)) <= SHORT


def _columns(
    name: str, values: Vector, exact: Sequence[sympy.Expr] | None
) -> Iterator[tuple[str, tuple[str | sympy.Expr, ...]]]:
    """Yield the exact column if all its entries are short, and the decimal one unless all of these are rational."""
    if exact is not None and all(map(short, exact)):
        yield name, tuple(exact)
        if all(x.is_Rational for x in exact):
            return
    yield name, tuple(map(decimal, values))


@number_table.register
def _(tableau: Tableau) -> TableBlock:
    exact = exact_tableau(tableau)
    rows: list[tuple[str | sympy.Expr, ...]]
    if exact is not None and all(short(x) for part in (*exact[0], *exact[1:]) for x in part):
        A, b, c = exact
        rows = [(c[i], *A[i]) for i in range(tableau.stages)] + [("", *b)]
    else:
        rows = [(decimal(tableau.c[i]), *map(decimal, tableau.A[i])) for i in range(tableau.stages)]
        rows.append(("", *map(decimal, tableau.b)))
    labels = [*(str(i) for i in range(1, tableau.stages + 1)), "b"]
    return TableBlock(
        name=f"Runge-Kutta tableau: {tableau.name}, of order {tableau.order}",
        columns=("", "c", *(f"a_i{k}" for k in range(1, tableau.stages + 1))),
        rows=tuple((label, *row) for label, row in zip(labels, rows, strict=True)),
    )
