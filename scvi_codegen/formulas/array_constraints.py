"""Parser for constraints of array systems: an equation, and loops over the elements for which it holds.

constraint = sum ["=" sum] ["for" loop ("," loop)*]      (r[b+1] - r[b])**2 = l[b]**2 for b in 0..N-2

Loops and indices are those of :mod:`scvi_codegen.indices`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import chain

from sympy import Symbol

from scvi_codegen.errors import ExpressionError
from scvi_codegen.formulas.arrays import ArrayParser, ArrayTerm, term_of
from scvi_codegen.formulas.grammar import parsed
from scvi_codegen.indices import Array, Loop

__all__ = ["parse_constraint"]

_FOR = re.compile(r"\bfor\b")


def parse_constraint(
    text: str, arrays: Sequence[Array], symbols: Mapping[str, Symbol], tables: Sequence[Array] = ()
) -> ArrayTerm:
    """Parse a constraint g = 0 for all elements of loops; for ``left = right`` g is left - right.

    Args:
        text: the constraint.
        arrays, symbols, tables: as of :func:`~scvi_codegen.formulas.arrays.parse_sums`.

    Raises:
        ExpressionError: as there, and for a sum over a whole array, which would couple all of its entries.

    >>> from scvi_codegen.formulas.arrays import parse_array
    >>> term = parse_constraint("(q[i+1] - q[i])**2 = 1 for i in 0..N-2", [parse_array("q[N]")], {})
    >>> print(term.formula, "for", *term.loops)
    (q[i+1] - q[i])**2 - 1 for i in 0..N-2
    """
    equation, *behind = _FOR.split(text)
    sides = equation.split("=")
    if len(sides) > 2 or len(behind) > 1:
        raise ExpressionError("a constraint may contain one '=' and one 'for'", text, 0)
    loops = tuple(chain(*(_Loops(each, symbols, arrays, tables).read() for each in behind)))
    parsers = [ArrayParser(side, symbols, arrays, tables) for side in sides]
    for parser in parsers:
        parser.in_scope = {loop.index: loop for loop in loops}
    left, *right = map(parsed, parsers)
    if any(parser.sums for parser in parsers):
        message = "a constraint must not contain a sum over a whole array: constraints couple few entries each"
        raise ExpressionError(message, text, text.find("sum"))
    accesses = dict(chain(*(parser.accesses.items() for parser in parsers)))
    return term_of(loops, left - right[0] if right else left, accesses)


class _Loops(ArrayParser):
    """Parser for loops alone, ``b in B, k in 0..N-2``."""

    def read(self) -> list[Loop]:
        """Parse all loops."""
        loops = self.loop()
        self.in_scope |= {loop.index: loop for loop in loops}
        while self.accept(","):
            loops += self.loop()
            self.in_scope |= {loop.index: loop for loop in loops}
        if self.peek().kind != "end":
            self.refuse(f"a comma or the end is expected here, not '{self.peek().text}'", self.peek().column)
        return loops
