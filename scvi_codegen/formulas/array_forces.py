"""Parser for forces of array systems: on all entries along an axis, on a single one, or on those in a table.

target   = array "[" (index | size | whole number | entry) ("," ..)* "]"        q[i], r[i, a], q[0], q[N-1]
entry    = table "[" index ("," whole number)? "]"                            q[pins[p]], r[bonds[b, 1], a]
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from sympy import Expr, Symbol

from scvi_codegen.formulas.arrays import ArrayParser, Bound, term_of
from scvi_codegen.formulas.grammar import parsed
from scvi_codegen.indices import Access, Array, Loop, Size

__all__ = ["ArrayForce", "parse_force"]


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
        """Return the axis of each index."""
        token = self.take_name("an array of coordinates")
        if token.text not in self.arrays:
            known = ", ".join(map(str, self.arrays.values()))
            self.refuse(f"a force must act on coordinates, {known}, not on '{token.text}'", token.column)
        array, bounds = self.arrays[token.text], dict[str, Size]()
        if not array.axes:
            return bounds
        self.expect("[")
        for number, axis in enumerate(array.axes):
            if number:
                self.expect(",")
            place = self.peek()
            if place.text in self.tables:
                self.row(self.tables[self.take_name("a table").text], bounds)
            elif place.kind != "name" or place.text in self.sizes:
                self.size()
            else:
                self.index_along(axis, bounds)
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
        """Parse an index of its own along an axis."""
        place = self.peek()
        self.check_index(place)
        if place.text in bounds:
            self.refuse(f"the index '{place.text}' is used for two axes: use two indices", place.column)
        bounds[self.take_name("an index").text] = axis
