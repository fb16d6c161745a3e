"""Columns of a stage system's tables, and the index that they depend on.

It follows from the names in a table: a column whose entries are called l_1_2, l_2_2, .. is l_2(tau_n) at point n.
Entries without a name are 0, 1 and -1: all of them alike, or a single one that is not 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import sympy
from sympy import Symbol

from scvi_codegen.methods.stage_system import Table

__all__ = ["Column", "column_of"]

CARDINAL = {"l": "l", "dl": "l_dot"}
"""Tables of functions at points tau_n."""
LINES = ("b", "bA", "beta", "gamma")
"""Tables of one line, q_(k+1), whose entries have one index."""
ANY_POINT = "n"


@dataclass(frozen=True, slots=True)
class Column:
    """A column over all points.

    Attributes:
        kind: ``"zero"``, ``"constant"``, ``"single"`` (one entry, the others 0), ``"leading"`` (ones for the first
            points, then zeros), ``"named"`` or ``"other"``.
        points: number of entries.
        factor: of all entries, or of the single one.
        prefix: of the names.
        index: of the column in its names; the number of the point of the single entry, or of the last leading one,
            counted from 1; or ``None``.
        transposed: whether names have the index of the column first.
    """

    kind: str
    points: int
    factor: sympy.Rational = sympy.S.One
    prefix: str = ""
    index: int | None = None
    transposed: bool = False

    def entry(self, index: object) -> sympy.Expr:
        """Return the entry at point n, with ``index`` instead of the column's own; constants do not depend on it."""
        if self.kind in ("constant", "single", "leading"):
            return self.factor
        suffix = [] if self.index is None else [str(index)]
        point = ANY_POINT if self.points > 1 else "1"
        if self.prefix in CARDINAL:
            return self.factor * sympy.Function("_".join([CARDINAL[self.prefix], *suffix]))(Symbol(f"tau_{point}"))
        row = [] if self.points == 1 and self.prefix in LINES else [point]
        indices = [*suffix, *row] if self.transposed else [*row, *suffix]
        return self.factor * Symbol("_".join([self.prefix, *indices]))


def column_of(table: Table, number: int) -> Column:
    """Return one column of a table."""
    names = [line[number] for line in table.names]
    values = [line[number] for line in table.entries]
    points, transposed = len(values), _is_transposed(table)
    parsed = {_parts(name, points, transposed=transposed) for name in names if name}
    if len(parsed) == 1:
        prefix, index, divisor = parsed.pop()
        return Column("named", points, sympy.Rational(1, divisor), prefix, index, transposed and index is not None)
    indices = [point for point, value in enumerate(values) if value != 0]
    if not indices:
        return Column("zero", points)
    if parsed or len({values[point] for point in indices}) > 1:
        return Column("other", points, prefix="G", index=number)
    factor = sympy.Integer(int(values[indices[0]]))
    if len(indices) == points:
        return Column("constant", points, factor)
    if len(indices) == 1:
        return Column("single", points, factor, index=indices[0] + 1)
    leading = indices == list(range(len(indices)))
    return Column("leading" if leading else "other", points, factor, "" if leading else "G", len(indices))


def _is_transposed(table: Table) -> bool:
    """Return whether the second index in the names is that of the point, and the first is not."""
    pairs = [
        (point, [int(index) for index in name.partition("/")[0].split("_")[1:]])
        for point, line in enumerate(table.names, 1)
        for name in line
        if name.count("_") == 2
    ]
    second = all(indices[1] == point for point, indices in pairs)
    return len(table.names) > 1 and bool(pairs) and second and any(indices[0] != point for point, indices in pairs)


def _parts(name: str, points: int, *, transposed: bool) -> tuple[str, int | None, int]:
    """Return prefix, index of the column or ``None``, divisor of a name: ``DD_1_0``, ``D_1_0/2``, ``-D_1_0``."""
    base, _, divisor = name.removeprefix("-").partition("/")
    prefix, *indices = base.split("_")
    index = int(indices[0 if transposed else -1]) if len(indices) == 2 or points == 1 else None
    return prefix, index, (-1 if name.startswith("-") else 1) * int(divisor or 1)
