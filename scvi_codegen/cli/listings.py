"""``scvi-codegen systems`` and ``scvi-codegen methods``: the catalogues as tables."""

from __future__ import annotations

from collections.abc import Sequence

from scvi_codegen.methods import ARGUMENTS, METHODS, Method, method_from_specification
from scvi_codegen.models.problems import PROBLEMS
from scvi_codegen.tables.precision import mp
from scvi_codegen.tables.tableau import exact_tableau, tableau_by_name

__all__ = ["methods_table", "systems_table", "tableau_text"]

EXAMPLES: dict[str, dict[str, int | list[float]]] = {
    "svi": {"degree": 4},
    "scvi": {"degree": 4},
    "sc": {"degree": 4},
    "collocation": {"abscissae": [0.25, 0.75]},
    "composition": {"order": 8},
}
EXAMPLE_STAGES = 3
LONGEST_EXACT = 24


def systems_table() -> str:
    """A line for each problem: name, coordinates, what it is, parameters."""
    rows = [("name", "m", "description", "parameters")]
    for name, build in PROBLEMS.items():
        entry = build()
        parameters = ", ".join(
            f"{symbol}={value:g}" for symbol, value in zip(entry.system.parameters, entry.system.defaults, strict=True)
        )
        rows.append((name, str(entry.system.dimension), entry.title, parameters))
    return _table(rows)


def methods_table() -> str:
    """A line for each method with its arguments, and the properties of an example."""
    rows = [("name", "arguments", "example", "order", "symplectic", "symmetric")]
    for name in METHODS:
        method = _example(name)
        rows.append((name, ", ".join(ARGUMENTS[name]) or "none", method.name, *_properties(method)))
        if "variational" in ARGUMENTS[name]:
            printed = method_from_specification({"method": name, **EXAMPLES[name], "variational": False})
            rows.append(("", "", printed.name, *_properties(printed)))
    return _table(rows)


def tableau_text(name: str) -> str:
    """Butcher tableau of a name such as ``gauss:3``, in radicals where they are short, else in 17 digits.

    Raises:
        MethodError: if there is no such tableau.
    """
    tableau = tableau_by_name(name)
    rows = [[_decimal(c), *map(_decimal, line)] for c, line in zip(tableau.c, tableau.A, strict=True)]
    rows.append(["", *map(_decimal, tableau.b)])
    exact = exact_tableau(tableau)
    if exact is not None:
        A, b, c = exact
        radicals = [[str(x), *map(str, line)] for x, line in zip(c, A, strict=True)] + [["", *map(str, b)]]
        if max(len(entry) for line in radicals for entry in line) <= LONGEST_EXACT:
            rows = radicals
    widths = [max(len(line[k]) for line in rows) for k in range(len(rows[0]))]
    lines = [
        f"{line[0]:>{widths[0]}} | "
        + "  ".join(f"{entry:>{width}}" for entry, width in zip(line[1:], widths[1:], strict=True))
        for line in rows
    ]
    rule = "-" * (widths[0] + 1) + "+" + "-" * (len(lines[0]) - widths[0] - 2)
    facts = f"order {tableau.order}, {_yes_or_not(tableau.is_symplectic)}symplectic, "
    facts += f"{_yes_or_not(tableau.is_symmetric)}symmetric, {_yes_or_not(tableau.is_a_stable)}A-stable"
    return "\n".join([f"{tableau.name}: {facts}", *lines[:-1], rule, lines[-1]])


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


def _table(rows: Sequence[Sequence[str]]) -> str:
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return "\n".join(
        "  ".join(f"{cell:{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )
