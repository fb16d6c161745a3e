"""Tables: splines through points as functions of formulas, declared ``{"F": Table(x, y)}`` and called ``F(x - 1)``.

In a cell of breakpoints a spline is a polynomial of the distance to the first of them. With the unit step s, a mask m_i
is 1 in cell i and 0 in all others,

    m_i = s(u - x_i) - s(u - x_i+1),      F(u) = sum_k c_k (u - x)^k,      x = sum_i m_i x_i,      c_k = sum_i m_i c_ik,

so that no sum rounds, every breakpoint is a kink that runs locate, and derivatives and code are those of formulas.
A function of two arguments is a sum of products of B-splines in each (C. de Boor, A Practical Guide to Splines, 2001).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import reduce
from itertools import pairwise
from math import factorial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from sympy import Add, Expr, Mul, Rational, S, sin

from scvi_codegen.systems.formulas.intermediates import Intermediate, intermediate, parts
from scvi_codegen.systems.formulas.kinks import unit_step
from scvi_codegen.systems.formulas.table import Outside, Table

if TYPE_CHECKING:
    from scipy.interpolate import BSpline

SHORT = 8
"""Largest number of parts of an argument that its switching functions contain written out."""
ROUNDING = 1e-12
"""Distance beyond the range of a table, relative to its length, up to which its value is that of the last piece."""


class NamedTable(NamedTuple):
    """Table with its name, a function among the names that formulas may contain."""

    name: str
    table: Table

    def __call__(self, *arguments: Expr) -> Expr:
        """Return the value at one or two arguments, a number at numbers."""
        definition = _value(self.table, arguments)
        return definition if definition.is_number else Tabulated.of(definition, self, arguments)


class Tabulated(Intermediate):
    """Value of a table, written as in formulas."""

    function: NamedTable

    @classmethod
    def of(cls, definition: Expr, function: NamedTable, arguments: Sequence[Expr]) -> Tabulated:
        """Return the value of a function at arguments."""
        value: Tabulated = cls(definition)
        value.function, value.arguments = function, tuple(arguments)
        return value

    @property
    def func(self) -> type[Intermediate]:
        """Class by which SymPy rebuilds it from its definition."""
        return Intermediate

    def __reduce_ex__(self, protocol: Any) -> tuple[Any, ...]:
        return Tabulated.of, (self.definition, self.function, self.arguments)

    def _replaced(self, definition: Expr, rule: Any) -> Expr:
        return Tabulated.of(definition, self.function, [argument.xreplace(rule) for argument in self.arguments])

    def _sympystr(self, printer: Any, *_: Any) -> str:
        return f"{self.function.name}({', '.join(map(printer._print, self.arguments))})"

    def _latex(self, printer: Any, *_: Any) -> str:
        name = self.function.name.replace("_", r"\_")
        return rf"\mathrm{{{name}}}\left({', '.join(map(printer._print, self.arguments))}\right)"


def tables_in(*formulas: Expr) -> list[Tabulated]:
    """Return the tables in formulas, in the order of their texts."""
    return sorted((part for part in parts(*formulas) if isinstance(part, Tabulated)), key=str)


def table_with_corners(formula: Expr) -> str | None:
    """Return the first table in a formula whose first derivatives are not continuous."""
    tables = {value: value.function.table for value in tables_in(formula)}
    return next((str(x) for x, table in tables.items() if table.degree == 1 or table.outside == "constant"), None)


def without_tables(formula: Expr) -> Expr:
    """Return a formula with a smooth function in place of each table, which is known to be continuous."""
    return formula.xreplace({value: sin(Add(*value.arguments)) for value in tables_in(formula)})


def _value(table: Table, arguments: Sequence[Expr]) -> Expr:
    """Return the value of a table as an expression; of two arguments by B-splines in the second one."""
    from scipy.interpolate import BSpline, make_interp_spline  # here: slow to import

    short = [u if len(parts(u)) <= SHORT else intermediate(u) for u in arguments]
    values, degree, outside = np.array(table.y)[:, None], table.degree, table.outside
    if len(short) == 1:
        (value,) = _pieces(short[0], make_interp_spline(table.axes[0], values, degree), outside)
    else:
        second = make_interp_spline(table.axes[1], values[:, 0].T, degree)
        basis = _pieces(short[1], BSpline(second.t, np.eye(len(second.c)), degree), outside)
        columns = _pieces(short[0], make_interp_spline(table.axes[0], second.c.T, degree), outside)
        value = Add(*(intermediate(b) * intermediate(column) for b, column in zip(basis, columns, strict=True)))
    if outside != "refuse":
        return value
    ends = [
        unit_step(side * (u - _exact(end - side * ROUNDING * (x[-1] - x[0]))))
        for u, x in zip(short, table.axes, strict=True)
        for side, end in ((1, x[0]), (-1, x[-1]))
    ]
    return Mul(intermediate(value), *(1 / step for step in ends))  # not finite outside


def _pieces(u: Expr, splines: BSpline, outside: Outside) -> list[Expr]:
    """Return splines with common breakpoints as expressions in u."""
    starts, ends = np.unique(splines.t)[:-1], splines.t[[0, -1]]
    coefficients = np.array([splines(starts, k) / factorial(k) for k in range(splines.k + 1)])
    if outside == "constant" or (outside == "linear" and splines.k > 1):
        orders = 1 if outside == "constant" else 2
        beyond = np.array([splines(ends, k) * (k < orders) for k in range(splines.k + 1)])
        coefficients = np.concatenate([beyond[:, :1], coefficients, beyond[:, 1:]], axis=1)
        starts = np.array([ends[0], *starts, ends[1]])
    steps = [S.One, *(unit_step(u - _exact(start)) for start in starts[1:]), S.Zero]
    masks = [intermediate(step - following) for step, following in pairwise(steps)]
    distance = intermediate(u - _sum(starts, masks))
    return [
        reduce(lambda value, c: _sum(c, masks) + distance * value, column[::-1], S.Zero)
        for column in np.moveaxis(coefficients, 2, 0)
    ]


def _sum(numbers: Iterable[float], factors: Sequence[Expr]) -> Expr:
    return Add(*(_exact(number) * factor for number, factor in zip(numbers, factors, strict=True) if number != 0.0))


def _exact(value: float) -> Expr:
    return Rational(repr(float(value)))  # the shortest decimal number that rounds to it
