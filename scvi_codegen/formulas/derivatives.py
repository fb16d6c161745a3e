"""Sparse symbolic derivatives by forward accumulation: each node carries only its own non-zero partial derivatives.

The Lagrangian of a lattice has a thousand terms and hundreds of variables, but each term depends on two or three.
Nothing is simplified; entries that SymPy's constructors evaluate to 0 are omitted. Every distinct node is
differentiated once, with respect to all variables, which is much faster than ``Expr.diff``, term by term.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache

from sympy import Add, Expr, Function, Mul, Pow, S, Symbol, log

_Gradient = dict[int, Expr]


def gradient(expression: Expr, variables: Sequence[Symbol]) -> dict[int, Expr]:
    """Return the non-zero first derivatives of ``expression``, by index into ``variables``, ascending.

    >>> from sympy.abc import x, y, z
    >>> gradient(x**2 * z + z, [x, y, z])
    {0: 2*x*z, 2: x**2 + 1}
    """
    return dict(sorted(_accumulation(tuple(variables)).of(expression).items()))


def jacobian(
    expressions: Sequence[Expr] | Mapping[int, Expr], variables: Sequence[Symbol]
) -> dict[tuple[int, int], Expr]:
    """Return the non-zero first derivatives of several expressions, by (row, column), ascending.

    Args:
        expressions: the rows, as a sequence or by index (what ``gradient`` returns).
        variables: the columns.

    >>> from sympy.abc import x, y
    >>> jacobian([x * y, y**2], [x, y])
    {(0, 0): y, (0, 1): x, (1, 1): 2*y}
    """
    rows = expressions if isinstance(expressions, Mapping) else dict(enumerate(expressions))
    accumulation = _accumulation(tuple(variables))
    entries = {(row, column): entry for row in rows for column, entry in accumulation.of(rows[row]).items()}
    return dict(sorted(entries.items()))


def hessian(expression: Expr, variables: Sequence[Symbol]) -> dict[tuple[int, int], Expr]:
    """Return the non-zero second derivatives by (row, column), ascending; both triangles, which share their entries.

    >>> from sympy.abc import x, y
    >>> hessian(x**2 * y, [x, y])
    {(0, 0): 2*y, (0, 1): 2*x, (1, 0): 2*x}
    """
    entries = jacobian(gradient(expression, variables), variables)
    upper = {(row, column): entry for (row, column), entry in entries.items() if row <= column}
    lower = {(column, row): entry for (row, column), entry in upper.items()}
    return dict(sorted((upper | lower).items()))


@lru_cache(maxsize=4)
def _accumulation(variables: tuple[Symbol, ...]) -> _Accumulation:
    """Return the shared cache for these variables, since the derivatives of a system are requested repeatedly."""
    return _Accumulation(variables)


class _Accumulation:
    """Cache of the non-zero partial derivatives of every visited node, by index of the variable."""

    def __init__(self, variables: Sequence[Symbol]) -> None:
        self.known: dict[Expr, _Gradient] = {variable: {index: S.One} for index, variable in enumerate(variables)}

    def of(self, node: Expr) -> _Gradient:
        if not node.args:
            return self.known.get(node, {})
        derivative = self.known.get(node)
        if derivative is None:
            derivative = self.known[node] = self.derived(node)
        return derivative

    def derived(self, node: Expr) -> _Gradient:
        inner = [self.of(argument) for argument in node.args]
        return _combined(
            [
                (factor, derivatives)
                for position, derivatives in enumerate(inner)
                if derivatives and (factor := _partial(node, position)) is not S.Zero
            ]
        )


def _combined(pairs: Sequence[tuple[Expr, _Gradient]]) -> _Gradient:
    """Return the sum of factor times gradient: the chain rule."""
    parts: dict[int, list[Expr]] = {}
    for factor, derivatives in pairs:
        for index, derivative in derivatives.items():
            parts.setdefault(index, []).append(derivative if factor is S.One else Mul(factor, derivative))
    total = {index: Add(*terms) for index, terms in parts.items()}
    return {index: entry for index, entry in total.items() if entry is not S.Zero}


def _partial(node: Expr, position: int) -> Expr:
    """Return the derivative of a node with respect to its argument in ``position``."""
    if isinstance(node, Add):
        return S.One
    if isinstance(node, Mul):
        return Mul(*node.args[:position], *node.args[position + 1 :])
    if isinstance(node, Pow):
        base, exponent = node.args
        return Mul(exponent, Pow(base, exponent - 1)) if position == 0 else Mul(node, log(base))
    if isinstance(node, Function):
        return node.fdiff(position + 1)
    raise TypeError(f"cannot differentiate a {type(node).__name__}")
