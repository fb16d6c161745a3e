"""Stage equations in compact form: sums over points and unknowns, one line for rows that differ in an index.

The names of table entries contain the indices of point and column: a column whose entries are l_1_2, l_2_2, .. is
l_2(tau_n) at point n. Entries without a name are 0, 1 and -1: all of them alike, or a single one that is not 0.
Arguments and results of kernels have symbols: q_n, L_q at point n, the Euler-Lagrange residual E_n.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import sympy
from sympy import Symbol

from scvi_codegen.api.formulas import Number
from scvi_codegen.api.methods import StageSystem
from scvi_codegen.api.program import Derivation
from scvi_codegen.api.systems import MechanicalSystem, forms_of
from scvi_codegen.extras.derivation.writing import Formula

ARGUMENTS = {"v": "q_dot", "a": "q_ddot", "j": "q_d3", "s": "q_d4"}
"""Time derivatives of the curve as they are typeset."""
RAISED = "QVP"
"""Letters whose first index counts nodes."""
PLACES = {"start": "k", "end": "k+1"}
MEANINGS = {
    "L": "L the Lagrangian, whose index says by what it is differentiated",
    "S": "E the Euler-Lagrange residual and S its product with the multipliers, whose index says by what it is "
    "differentiated",
    "E": "E the Euler-Lagrange residual",
    "L_dot": "L with a dot its time derivative along the curve, by what its index says",
}

MULTIPLIED_FORCES = (
    ", without forces f; these add -f to E, f_v lambda to S_v and its time derivative less f_q lambda to S_q, the "
    "adjoint of what they add to E"
)


def point_index(group: Any, point: object = "n") -> str:
    """Return the index of a point of a stage group: n, or k and k + 1 at an end of the step."""
    return PLACES.get(group.name, str(point if len(group.abscissae) > 1 else 1))


def argument_symbol(system: MechanicalSystem, gather: Any, suffix: str) -> Symbol:
    """Return the symbol of the arguments of a gather at a point."""
    name = Derivation.argument_name(system, gather)
    return Symbol(f"{ARGUMENTS.get(name, name)}_{suffix}")


def result_symbol(system: MechanicalSystem, group: Any, scatter: Any, suffix: str) -> Symbol:
    """Return the symbol of the results of a scatter at a point; for gradients, scatters are parallel to gathers."""
    forms = forms_of(system)
    if system.constraints and scatter.results == forms.position_conditions:
        return Symbol(f"g_{suffix}")
    if system.constraints and scatter.results in (forms.velocity_conditions, forms.constraint_rates):
        return Symbol(f"g_dot_{suffix}")
    if system.constraints and scatter.results == forms.idle_multipliers:
        return Symbol(f"lambda_open_{suffix}")
    if group.scalar is None:
        letters = {forms.force: "L_q", forms.momentum: "L_v", forms.euler_lagrange: "E", forms.constitutive: "L_p"}
        return Symbol(f"{letters[scatter.results]}_{suffix}")
    name = Derivation.argument_name(system, group.gathers[group.scatters.index(scatter)])
    return Symbol(f"E_{suffix}" if name == "lambda" else f"{scalar_name(group)}_{name}_{suffix}")


def scalar_name(group: Any) -> str:
    """Return L, its k-th time derivative along the curve, or S."""
    if group.name == "node":
        return "S"
    return {0: "L", 1: "L_dot"}.get(group.scalar_power, f"L_d{group.scalar_power}")


def meaning(group: Any) -> str:
    """Return the meaning of the letter of a stage group's results."""
    if group.scalar is not None:
        name = scalar_name(group)
        return MEANINGS[name[:5]] + (MULTIPLIED_FORCES if name == "S" and group.forced else "")
    return MEANINGS["E"] if group.name == "node" else MEANINGS["L"]


CARDINAL = {"l": "l", "dl": "l_dot"}
"""Tables of functions at points tau_n."""
LINES = ("bA", "beta", "gamma")
"""Tables of one line, q_(k+1), whose entries are shown with one index."""
ANY_POINT = "n"


@dataclass(frozen=True, slots=True)
class Column:
    """A column over all points.

    Attributes:
        kind: ``"zero"``, ``"constant"``, ``"single"`` (one entry, the others 0), ``"leading"`` (ones for the first
            points, then zeros), ``"named"`` or ``"other"``.
        points: number of entries.
        factor: of all entries, or of the single one.
        of: letter of the table of its numbers.
        index: of the column in that table; the number of the point of the single entry, or of the last leading one,
            counted from 1; or ``None``.
        at_points: whether its numbers have the index of the point.
        column_first: whether their index of the column is the first one.
    """

    kind: str
    points: int
    factor: sympy.Rational = sympy.S.One
    of: str = ""
    index: int | None = None
    at_points: bool = True
    column_first: bool = False

    def entry(self, index: object) -> sympy.Expr:
        """Return the entry at point n, with ``index`` instead of the column's own; constants do not depend on it."""
        if self.kind in ("constant", "single", "leading"):
            return self.factor
        suffix = [] if self.index is None else [str(index)]
        point = ANY_POINT if self.points > 1 else "1"
        if self.of in CARDINAL:
            return self.factor * sympy.Function("_".join([CARDINAL[self.of], *suffix]))(Symbol(f"tau_{point}"))
        row = [] if not self.at_points or (self.points == 1 and self.of in LINES) else [point]
        indices = [*suffix, *row] if self.column_first else [*row, *suffix]
        return self.factor * Symbol("_".join([self.of, *indices]))


def column_of(table: Any, number: int) -> Column:
    """Return one column of a table."""
    names = [line[number] for line in table.names]
    values = [line[number] for line in table.entries]
    points, named = len(values), [name for name in names if name]
    if named and len({(name.of, name.column, name.column_first, name.factor) for name in named}) == 1:
        first = named[0]
        factor = sympy.Rational(first.factor.numerator, first.factor.denominator)
        return Column("named", points, factor, first.of, first.column, first.point is not None, first.column_first)
    indices = [point for point, value in enumerate(values) if value != 0]
    if not indices:
        return Column("zero", points)
    if named or len({values[point] for point in indices}) > 1:
        return Column("other", points, of="G", index=number)
    factor = sympy.Integer(int(values[indices[0]]))
    if len(indices) == points:
        return Column("constant", points, factor)
    if len(indices) == 1:
        return Column("single", points, factor, index=indices[0] + 1)
    kind, of = ("leading", "") if indices == [*range(len(indices))] else ("other", "G")
    return Column(kind, points, factor, of, len(indices))


h, n, j = Symbol("h"), Symbol("n", integer=True), Symbol("j", integer=True)
RUNNING_ROW = "i"


def gather_formulas(system: MechanicalSystem, stages: StageSystem, group: Any) -> Iterator[Formula]:
    """Yield the arguments of the kernel of a stage group at point n, except those that are unknowns themselves."""
    for gather in group.gathers:
        total, left = gathered(gather.table, stages.blocks), argument_symbol(system, gather, point_index(group))
        scale = sympy.Rational(str(gather.scale))
        if scale == 1:
            right = sympy.Add(*(h**gather.power * term for term in sympy.Add.make_args(total)))
        else:
            right = sympy.Mul(scale, h**gather.power, total, evaluate=not total.is_Add)
        if right != left:
            yield Formula(right, left)


def row_formulas(system: MechanicalSystem, stages: StageSystem) -> Iterator[tuple[Any, Formula]]:
    """Yield the equations; rows that differ in an index alone are one, with the range of the index after the number."""
    lines = [_Line.of(system, stages, r) for r in range(len(stages.rows))]
    for _, alike in groupby(zip(stages.rows, lines, strict=True), key=lambda pair: pair[1].pattern):
        members = list(alike)
        row, first = members[0]
        if len(members) == 1:
            yield row, Formula(first.summed(first.base), sympy.S.Zero, row.number)
            continue
        number = re.sub(r"(?<=_)\d+$", RUNNING_ROW, row.number)
        last = members[-1][1].base
        bounds = f"{RUNNING_ROW} = {first.base}, {'.., ' if len(members) > 2 else ''}{last}"
        yield row, Formula(first.summed(RUNNING_ROW), sympy.S.Zero, f"{number}, {bounds}")


def end_formulas(system: MechanicalSystem, stages: StageSystem) -> tuple[Formula, Formula]:
    """Return q_(k+1) and p_(k+1)."""
    number_q, number_p = stages.end_numbers
    end = _Line.of(system, stages, len(stages.rows))
    return (
        Formula(gathered(stages.end_position, stages.blocks), Symbol("q_k+1"), number_q),
        Formula(end.summed(end.base), Symbol("p_k+1"), number_p),
    )


def gathered(table: Any, blocks: Sequence[Any]) -> sympy.Expr:
    """Return one line of a table times q_k and the unknowns, as sums over unknowns of one kind."""
    columns = [column_of(table, c) for c in range(len(blocks) + 1)]
    first = columns[0]
    if first.kind == "single" and [column.index for column in columns] == list(range(1, len(columns) + 1)):
        return _unknown(blocks[0].letter, "n-1")  # the points are the nodes, and number 0 is q_k
    entry = Symbol("G_n_0") if first.kind in ("single", "other") and first.points > 1 else first.entry(0)
    terms = [entry * Symbol("q_k")] if first.kind != "zero" else []
    numbered = list(zip(columns[1:], blocks, strict=True))
    for letter, group in groupby(numbered, key=lambda pair: pair[1].letter):
        terms += _group_terms(letter, list(group))
    return sympy.Add(*terms)


def _group_terms(letter: str, group: Sequence[tuple[Column, Any]]) -> Iterator[sympy.Expr]:
    """Yield unknowns of one kind times their coefficients."""
    pairs = [(column, int(block.index)) for column, block in group]
    columns, numbers = map(list, zip(*pairs, strict=True))
    factor, span = h ** group[0][1].power, (j, numbers[0], numbers[-1])
    kinds = {column.kind for column in columns}
    named = [(column, number) for column, number in pairs if column.kind == "named"]
    present = [(column, number) for column, number in pairs if column.kind != "zero"]
    if not present:
        return
    if len(present) == 1 and present[0][0].kind in ("named", "constant"):
        column, number = present[0]
        yield factor * column.entry(column.index) * _unknown(letter, number)
    elif named and "other" not in kinds and len({_ahead(column, number) for column, number in named}) == 1:
        ahead = _ahead(*named[0])
        yield factor * sympy.Sum(named[0][0].entry(f"j{ahead:+d}" if ahead else j) * _unknown(letter, j), span)
    elif kinds == {"constant"} and len(set(columns)) == 1:
        yield factor * columns[0].factor * sympy.Sum(_unknown(letter, j), span)
    elif kinds == {"single"} and [column.index for column in columns] == numbers:
        yield factor * columns[0].factor * _unknown(letter, n)
    else:
        yield factor * sympy.Sum(Symbol("G_n_j") * _unknown(letter, j), span)


def _ahead(column: Column, number: int) -> int:
    """Return the difference of the index of a column and that of its unknown."""
    return 0 if column.index is None else column.index - number


@dataclass(frozen=True, slots=True)
class _Part:
    """Contribution of a scatter to a line: the column of the table, and the result that it multiplies."""

    system: MechanicalSystem
    group: Any
    scatter: Any
    column: Column
    power: int

    @property
    def first(self) -> int:
        """Number of the first point, as in the names of the weights."""
        name = self.group.weight_names[0]
        return 1 if name is None else name.indices[0]

    @property
    def index(self) -> int | None:
        """Index of the column, or of the point of its single entry or its last leading one."""
        kind, index = self.column.kind, self.column.index
        return index + self.first - 1 if index is not None and kind in ("single", "leading") else index

    def product(self, index: object) -> sympy.Expr:
        """Return the entry times the result, without weight: at point n, or at the single point of the entry."""
        point = point_index(self.group, index if self.column.kind == "single" else n)
        factor = sympy.Rational(str(self.scatter.scale)) * h**self.power
        return factor * self.column.entry(index) * result_symbol(self.system, self.group, self.scatter, point)

    def weight(self, index: object) -> sympy.Expr:
        name = self.group.weight_names[0]
        return Symbol(f"{name.of}_{index}") if name else sympy.S.One


@dataclass(frozen=True, slots=True)
class _Line:
    """A row of the equations, or the line of p_(k+1)."""

    momentum: sympy.Expr | Column  # coefficient of p_k: a number, or the column of q_(k+1) whose entry it is
    parts: tuple[_Part, ...]
    kind: tuple[str, ...]  # number and kind of the row, without its own index
    base: int | None  # the index in which it differs from rows of the same pattern

    @classmethod
    def of(cls, system: MechanicalSystem, stages: StageSystem, r: int) -> _Line:
        """Return a row; ``r`` beyond the last one is the line of p_(k+1)."""
        row = stages.rows[r] if r < len(stages.rows) else None
        parts = tuple(
            _Part(system, group, scatter, column, scatter.power + (row.power if row else 0))
            for group in stages.stage_groups
            for scatter in group.scatters
            if (column := column_of(scatter.table, r)).kind != "zero"
        )
        indices = [part.index for part in parts if part.index is not None and part.column.points > 1]
        number = row.number if row else ""
        if suffix := re.search(r"_(\d+)$", number):
            indices.insert(0, int(suffix[1]))
        kind = (number.removesuffix(suffix[0]) if suffix else number, row.kind if row else "end")
        return cls(_momentum(stages, r), parts, kind, indices[0] if indices else None)

    @property
    def pattern(self) -> tuple[object, ...]:
        """Key that is equal for lines that differ in an index alone."""
        momentum = self.momentum
        if isinstance(momentum, Column):
            coefficient: tuple[object, ...] = (momentum.of, self._shift(momentum.index))
        else:
            coefficient = (momentum,)
        shapes = [
            (
                part.column.kind,
                part.column.factor,
                part.column.of,
                self._shift(part.index),
                id(part.scatter),
                part.power,
            )
            for part in self.parts
        ]
        return (self.kind, coefficient, tuple(shapes))

    def _shift(self, index: int | None) -> int | None:
        return None if index is None or self.base is None else index - self.base

    def summed(self, value: object) -> sympy.Expr:
        """Return the right side, with ``value`` instead of the line's own index."""

        def placed(index: int | None) -> object:
            shift = self._shift(index)
            if shift is None or value == self.base:
                return index
            return f"{value}{shift:+d}" if shift else value

        momentum = self.momentum
        factor = momentum.entry(placed(momentum.index)) if isinstance(momentum, Column) else momentum
        terms = [factor * Symbol("p_k")]
        sums: dict[tuple[str, object], list[tuple[_Part, sympy.Expr]]] = {}
        for part in self.parts:
            index = placed(part.index)
            product = part.product(index)
            if part.column.points == 1:
                terms.append(part.weight(part.first) * product)
            elif part.column.kind == "single":
                terms.append(part.weight(index) * product)
            else:
                last = index if part.column.kind == "leading" else part.first + part.column.points - 1
                sums.setdefault((part.group.name, last), []).append((part, product))
        for (_, last), products in sums.items():
            part = products[0][0]
            total = part.weight(n) * sympy.Add(*(product for _, product in products))
            terms.append(
                sympy.Sum(total, (n, part.first, sympy.sympify(last) if isinstance(last, int) else Symbol(str(last))))
            )
        return sympy.Add(*terms)


def _momentum(stages: StageSystem, r: int) -> sympy.Expr | Column:
    """Return the coefficient of p_k: the entry of the line of q_(k+1) if it is that, else a number."""
    if r == len(stages.rows):
        return _small(stages.end_momentum)
    value = stages.rows[r].momentum
    column = column_of(stages.end_position, r + 1)
    if column.of == "beta" and value == stages.end_position.entries[0][r + 1]:
        return column
    return _small(value)


def _small(value: Number) -> sympy.Expr:
    """Return halves exactly, other numbers in 17 digits."""
    doubled = 2 * value
    return sympy.Rational(int(doubled), 2) if doubled == int(doubled) else sympy.Float(str(value), 17)


def _unknown(letter: str, index: object) -> Symbol:
    return Symbol(f"{letter}{'__' if letter in RAISED else '_'}{index}")
