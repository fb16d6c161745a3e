"""Evaluation of formulas by NumPy, also at all elements of loops, without generated code."""

import math
from collections.abc import Collection, Mapping, Sequence
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sympy import Expr, Symbol

from scvi_codegen.common.errors import StateError
from scvi_codegen.systems.formulas.expressions import LARGEST, PIECEWISE_CONSTANT
from scvi_codegen.systems.formulas.indices import Access, Loop, periods_of
from scvi_codegen.systems.formulas.intermediates import Intermediate, inner_of, intermediates

VARYING = 1e-6
"""Smallest difference, relative to the formula, of second differences that vary."""
MAX_ELEMENTS = 5_000_000
"""Maximum number of elements of the loops of a term that are evaluated at once."""


def array_value(expression: Expr, values: dict[Expr, Any]) -> Any:
    """Return the values of an expression, with the broadcast shape of the arrays in ``values``; NaN where undefined.

    ``values`` has a number or an array for each symbol; values of subexpressions are added.

    >>> x = Symbol("x", real=True)
    >>> array_value(x**2 + 1, {x: np.arange(3.0)}).tolist()
    [1.0, 2.0, 5.0]
    """
    for quantity in intermediates(expression, without=values):
        _value_in(quantity, values)
    return _value_in(expression, values)


def varies(formula: Expr, variables: Sequence[Symbol], parameters: Collection[Symbol]) -> bool:
    """Return whether second differences of a formula with intermediate quantities vary, not only with parameters.

    l(.., x_i + 1, ..) - 2 l(.., x_i, ..) + l(.., x_i - 1, ..), which is constant if the second derivative is, is
    compared at two random points: the derivatives of long formulas take more time. ``False`` if unknown.
    """
    if not inner_of(formula):
        return False
    generator, shape = np.random.default_rng(0), (2, len(variables), 3)
    others = sorted(formula.free_symbols, key=str)
    values = {x: generator.uniform(0.5, 1.5, () if x in parameters else (2, 1, 1)) + np.zeros(shape) for x in others}
    for x, unit in zip(variables, np.eye(len(variables)), strict=True):
        values[x] = values.get(x, 0.0) + np.multiply.outer(unit, (-1.0, 0.0, 1.0))
    with np.errstate(all="ignore"):
        value = array_value(formula, dict(values)) + np.zeros(shape)
    first, second = value @ np.array([1.0, -2.0, 1.0])
    return bool(np.abs(first - second).max() > VARYING * np.abs(value).max())


def _value_in(expression: Expr, values: dict[Expr, Any]) -> Any:
    if expression not in values:
        values[expression] = _node_value(expression, values)
    return values[expression]


def _node_value(expression: Any, values: dict[Expr, Any]) -> Any:
    """Return the value of a node from those of its arguments."""
    if not expression.args:
        within = not expression.is_Rational or abs(expression.p) <= int(LARGEST) * expression.q
        return float(expression) if within else np.nan
    arguments = [_value_in(argument, values) for argument in expression.args]
    if isinstance(expression, Intermediate):
        return arguments[0]
    if expression.is_Add:
        return reduce(np.add, arguments)
    if expression.is_Mul:
        return reduce(np.multiply, arguments)
    if expression.is_Pow:
        return np.power(*arguments)
    name = type(expression).__name__
    if name in PIECEWISE_CONSTANT:
        return PIECEWISE_CONSTANT[name][1](*arguments)
    return getattr(np, f"arc{name[1:]}" if name.startswith("a") else name)(*arguments)


def convolved(values: NDArray[Any], access: Access, arrays: Mapping[str, NDArray[Any]], sign: int = 1) -> Any:
    """Return the convolutions of an array in an access, for ``sign`` -1 their transpose, by Fourier transforms."""
    for convolution in access.sums[::sign]:
        by = np.fft.fft(arrays[convolution.coefficients.name])
        by = (np.conj(by) if sign == 1 else by).reshape(-1, *(1,) * (values.ndim - 1 - convolution.axis))
        values = np.fft.ifft(by * np.fft.fft(values, axis=convolution.axis), axis=convolution.axis).real
    return values


class Elements:
    """Index values of all elements of loops, as arrays.

    Args:
        loops: of a term.
        sizes: value of each size.
        tables: index tables by name.

    Raises:
        StateError: if there are more than ``MAX_ELEMENTS``.
    """

    def __init__(self, loops: Sequence[Loop], sizes: Mapping[str, int], tables: Mapping[str, NDArray[Any]]) -> None:
        self.sizes, self.tables, self.periods = sizes, tables, periods_of(loops, sizes)
        pairs = {loop.behind: loop for loop in loops if loop.behind}
        spans = [(loop, np.arange(loop.first.at(sizes), loop.end.at(sizes))) for loop in loops if not loop.behind]
        counts = [len(span) * (len(span) - 1) // 2 if loop.index in pairs else len(span) for loop, span in spans]
        if (total := math.prod(counts)) > MAX_ELEMENTS:
            raise StateError(f"a sum has {total} elements, more than the {MAX_ELEMENTS} that can be evaluated by NumPy")
        grids = np.meshgrid(*(np.arange(count) for count in counts), indexing="ij")
        self.index: dict[str, NDArray[np.int64]] = {}
        for (loop, span), grid in zip(spans, grids, strict=True):
            if loop.index not in pairs:
                self.index[loop.index] = span[grid.reshape(-1)]
                continue
            first, second = np.triu_indices(len(span), 1)
            self.index[loop.index], self.index[pairs[loop.index].index] = (
                span[indices[grid.reshape(-1)]] for indices in (first, second)
            )

    @staticmethod
    def transposed(values: NDArray[Any], access: Access, arrays: Mapping[str, NDArray[Any]]) -> Any:
        """Return the transposed convolutions of an array in an access."""
        return convolved(values, access, arrays, -1)

    def of(self, access: Access) -> tuple[Any, ...]:
        """Return the indices of an access at all elements, one array or number per axis."""
        return tuple(place.at(self.index, self.sizes, self.tables, self.periods) for place in access.places)

    def values(
        self,
        formula: Expr,
        slots: Sequence[tuple[Symbol, Access]],
        arrays: Mapping[str, NDArray[np.float64]],
        numbers: Mapping[Expr, float],
    ) -> Any:
        """Return the values of a formula at every element, with arrays by name and numbers by symbol."""
        entries_by_slot: dict[Expr, Any] = {
            slot: convolved(arrays[access.array.name], access, arrays)[self.of(access)] for slot, access in slots
        }
        entries = array_value(formula, {**entries_by_slot, **numbers})
        count = next((len(values) for values in self.index.values()), 1)
        return np.broadcast_to(entries, (count,)) if self.index else entries
