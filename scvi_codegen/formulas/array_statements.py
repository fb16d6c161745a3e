"""Parsers for the constraints and forces of array systems.

Constraints hold at every element of loops; forces act on all entries along an axis, on a single one, or on those in a
table:

constraint = sum ["=" sum] ["for" loop ("," loop)*]      (r[b+1] - r[b])**2 = l[b]**2 for b in 0..N-2
target     = array "[" (index | size | whole number | entry) ("," ..)* "]"        q[i], r[i, a], q[0], q[N-1]
entry      = table "[" index ("," whole number)? "]"                            q[pins[p]], r[bonds[b, 1], a]
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain

from sympy import Expr, Symbol

from scvi_codegen.errors import ExpressionError
from scvi_codegen.formulas.arrays import ArrayParser, ArrayTerm, Bound, term_of
from scvi_codegen.formulas.grammar import parsed
from scvi_codegen.indices import Access, Array, Loop, Size

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
        message = "a formula with 'for', and a constraint, must not contain a sum over a whole array"
        raise ExpressionError(message, text, text.find("sum"))
    accesses = dict(chain(*(parser.accesses.items() for parser in parsers)))
    return term_of(loops, left - right[0] if right else left, accesses)


class _Loops(ArrayParser):
    """Parser for loops alone, ``b in B, k in 0..N-2``."""

    def read(self) -> list[Loop]:
        loops = self.loop()
        self.in_scope |= {loop.index: loop for loop in loops}
        while self.accept(","):
            loops += self.loop()
            self.in_scope |= {loop.index: loop for loop in loops}
        if self.peek().kind != "end":
            self.refuse(f"a comma or the end is expected here, not '{self.peek().text}'", self.peek().column)
        return loops


@dataclass(frozen=True, slots=True, kw_only=True)
class ArrayForce:
    """Forces over loops.

    Attributes:
        loops, slots: as of :class:`ArrayTerm`, common to all formulas.
        targets: coordinates on which forces act, each with its formula.
    """

    loops: tuple[Loop, ...]
    slots: tuple[tuple[Symbol, Access], ...]
    targets: tuple[tuple[Access, Expr], ...]

    def __str__(self) -> str:
        loops = f" for {', '.join(map(str, self.loops))}" if self.loops else ""
        return ", ".join(f"{formula} on {access}" for access, formula in self.targets) + loops


def parse_force(
    target: str,
    text: str,
    coordinates: Sequence[Array],
    arrays: Sequence[Array],
    symbols: Mapping[str, Symbol],
    tables: Sequence[Array] = (),
) -> tuple[ArrayForce, ...]:
    """Parse the force on ``q[i]`` for all i along an axis, on a single entry, ``q[0]``, or on those of a table.

    Args:
        target: the coordinate that it acts on.
        text: its formula, in the indices of the target.
        coordinates: arrays of the target.
        arrays, symbols, tables: as of :func:`parse_sums`.

    Raises:
        ExpressionError: as :func:`parse_sums`.

    >>> from scvi_codegen.formulas.arrays import parse_array
    >>> from scvi_codegen.formulas.symbols import symbol
    >>> q, v = parse_array("q[N]"), parse_array("q_dot[N]")
    >>> [str(force) for force in parse_force("q[i]", "-c*q_dot[i]", [q], [q, v], {"c": symbol("c")})]
    ['-c*q_dot[i] on q[i] for i in N']
    """
    reader = _Target(target, {}, coordinates, tables)
    bounds = reader.read()
    rows: list[dict[str, Bound]] = [{}]
    for name, axis in bounds.items():
        values: list[Bound] = [Loop(index=name, first=Size("", 0), end=axis)] if axis.name else [*range(axis.number)]
        rows = [{**row, name: value} for row in rows for value in values]
    forces = []
    for row in rows:
        targets, formula = (ArrayParser(given, symbols, arrays, tables) for given in (target, text))
        targets.in_scope, formula.in_scope = dict(row), dict(row)
        slot, expression = parsed(targets), parsed(formula)
        loops = tuple(bound for bound in row.values() if isinstance(bound, Loop))
        term = term_of(loops, expression, formula.accesses)
        forces.append(ArrayForce(loops=loops, slots=term.slots, targets=((targets.accesses[slot], expression),)))
    return tuple(forces)


class _Target(ArrayParser):
    """Parser for the target of a force: an array entry whose indices run over whole axes."""

    def read(self) -> dict[str, Size]:
        token = self.take_name("an array of coordinates")
        if token.text not in self.arrays:
            known = ", ".join(map(str, self.arrays.values()))
            self.refuse(f"a force must act on coordinates, {known}, not on '{token.text}'", token.column)
        array, bounds = self.arrays[token.text], dict[str, Size]()
        for number, axis in enumerate(array.axes):
            if not self.accept("," if number else "["):
                some = f"write {array.entry} for all of them, or numbers as indices for some"
                self.refuse(f"a force must act on entries of the array {array}: {some}", token.column)
            place = self.peek()
            if place.text in self.tables:
                self.row(self.tables[self.take_name("a table").text], bounds)
            elif place.kind != "name" or place.text in self.sizes:
                self.size()
            else:
                self.index_along(axis, bounds)
        if array.axes:
            self.expect("]")
        return bounds

    def row(self, table: Array, bounds: dict[str, Size]) -> None:
        """Parse ``[b, 0]`` of a table; b runs over its rows."""
        self.expect("[")
        self.index_along(table.axes[0], bounds)
        if self.accept(","):
            self.size()
        self.expect("]")

    def index_along(self, axis: Size, bounds: dict[str, Size]) -> None:
        place = self.peek()
        self.check_index(place)
        if place.text in bounds:
            self.refuse(f"the index '{place.text}' is used for two axes: use two indices", place.column)
        bounds[self.take_name("an index").text] = axis
