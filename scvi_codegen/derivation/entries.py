"""Named numbers of a method's tables, with their short exact forms."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache

import sympy

from scvi_codegen.derivation.notation import TableEntry
from scvi_codegen.methods.method import Method
from scvi_codegen.methods.stage_system import StageSystem, Table
from scvi_codegen.tables.closed_forms import exact_points, exact_rule, exact_tableau
from scvi_codegen.tables.precision import Number
from scvi_codegen.tables.quadrature import Quadrature
from scvi_codegen.tables.radicals import radical_basis, recognised
from scvi_codegen.tables.tableau import Tableau

__all__ = ["entries", "table_entries"]


def entries(values: Mapping[sympy.Symbol, Number], method: Method) -> tuple[TableEntry, ...]:
    """Return numbers of a method's tables by symbol, sorted by name and index, with their radicals."""
    basis = _basis(method)
    return tuple(
        TableEntry(symbol, value, recognised(value, basis)) for symbol, value in sorted(values.items(), key=_by_name)
    )


def table_entries(stages: StageSystem, method: Method) -> tuple[TableEntry, ...]:
    """Return the named numbers of all tables of a method's equations, also those that do not occur in the equations."""
    tables = [stages.end_position]
    values: dict[sympy.Symbol, Number] = {}
    for group in stages.stage_groups:
        tables += [gather.table for gather in group.gathers] + [scatter.table for scatter in group.scatters]
        tables.append(Table(entries=(group.weights,), names=(group.weight_names,)))
    for table in tables:
        for names, numbers in zip(table.names, table.entries, strict=True):
            for name, value in zip(names, numbers, strict=True):
                base, _, divisor = name.removeprefix("-").partition("/")
                if base:
                    sign = -1 if name.startswith("-") else 1
                    values[sympy.Symbol(base, real=True)] = value * sign * int(divisor or 1)
    return entries(values, method)


def _by_name(item: tuple[sympy.Symbol, Number]) -> tuple[object, ...]:
    prefix, *indices = item[0].name.lstrip("_").split("_")
    return (prefix, *(int(index) for index in indices))


@lru_cache(maxsize=64)
def _basis(method: Method) -> tuple[sympy.Expr, ...]:
    """Return 1 and the roots in the method's nodes and points with their products; () if one has no closed form."""
    forms = list(_closed_forms(method))
    return () if None in forms else radical_basis(x for form in forms for x in form or ())


def _closed_forms(method: Method) -> Iterator[Sequence[sympy.Expr] | None]:
    """Yield the exact points, weights and coefficients of the method's tables."""
    for part in method.parts:
        if isinstance(part, Tableau):
            exact = exact_tableau(part)
            yield None if exact is None else [x for row in exact[0] for x in row] + list(exact[1]) + list(exact[2])
        elif isinstance(part, Quadrature):
            rule = exact_rule(part)
            yield None if rule is None else [x for group in rule for x in group]
        else:
            yield exact_points(part)
