"""Entries of arrays of known sizes: formulas in index notation as formulas of q_0, q_1, ..."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
from numpy.typing import NDArray
from sympy import Add, Expr, Symbol

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.formulas.array_statements import ArrayForce
from scvi_codegen.formulas.arrays import ArrayParser, ArrayTerm, term_of
from scvi_codegen.formulas.grammar import parsed
from scvi_codegen.formulas.symbols import DOT, symbol
from scvi_codegen.indices import Access, Array, Loop, Place, Size

Elements = Mapping[str, int]
Tables = Mapping[str, NDArray[np.int64]]


def is_indexed(text: str) -> bool:
    """Return whether a formula contains entries or sums of arrays, which the grammar of named coordinates lacks."""
    return "[" in text or "sum(" in text


def formula_of_entries(
    text: str,
    arrays: Sequence[Array],
    symbols: Mapping[str, Symbol],
    tables: Sequence[Array] = (),
    rules: EntryRules | None = None,
) -> Expr:
    """Return a formula in index notation, which may be nonlinear in its sums, as a formula of the entries of arrays.

    Args:
        text, arrays, symbols, tables: as of :func:`~scvi_codegen.formulas.arrays.parse_sums`.
        rules: sizes, index tables and names of entries, those of velocity arrays left out; by default those of arrays
            whose sizes are numbers.

    Raises:
        SystemDefinitionError: for anything outside the grammar, and for an index outside its array.
    """
    rules = rules or EntryRules(
        {}, {}, {array.name: entry_names(array, {}) for array in arrays if not array.name.endswith(DOT)}
    )
    parser = ArrayParser(text, symbols, arrays, tables)
    whole = parsed(parser)
    ((_, values),) = rules.rules(term_of((), whole, parser.accesses))
    for placeholder, (loops, formula, _) in parser.sums.items():
        term = term_of(loops, formula, parser.accesses)
        values[placeholder] = Add(*(formula.xreplace(rule) for _, rule in rules.rules(term)))
    return whole.xreplace(values)


def momentum_arrays(arrays: Sequence[Array], names: Iterable[str]) -> Iterator[Array]:
    """Yield the arrays of momenta with these names, parallel to the first of these arrays of known sizes."""
    remaining = iter(names)
    for array in arrays:
        first, *_ = [*islice(remaining, len(array.elements)), ""]
        suffix = array.elements[0].removeprefix(array.name)
        if first and first.endswith(suffix):
            yield Array(first.removesuffix(suffix), array.axes)


def known_array(array: Array, sizes: Mapping[str, int]) -> Array:
    """Return the declaration with whole numbers as sizes."""
    return replace(array, axes=tuple(Size("", length) for length in array.shape(sizes)))


def entry_names(array: Array, sizes: Mapping[str, int]) -> NDArray[np.str_]:
    """Return the names of the entries of an array, in its shape."""
    return np.array(known_array(array, sizes).elements, dtype=np.str_).reshape(array.shape(sizes))


def _elements(loops: Sequence[Loop], sizes: Mapping[str, int]) -> Iterator[Elements]:
    """Yield the values of all indices."""
    if not loops:
        yield {}
        return
    last = loops[-1]
    for outer in _elements(loops[:-1], sizes):
        first = outer[last.behind] + 1 if last.behind else last.first.at(sizes)
        for k in range(first, last.end.at(sizes)):
            yield {**outer, last.index: k}


@dataclass(frozen=True, slots=True)
class EntryRules:
    """Substitution of array accesses by symbols, at given values of the indices.

    Attributes:
        sizes, tables: value of every size; index tables.
        names: names of the entries of each array.
    """

    sizes: Mapping[str, int]
    tables: Tables
    names: Mapping[str, NDArray[np.str_]]

    def rules(self, of: ArrayTerm | ArrayForce) -> Iterator[tuple[Elements, dict[Symbol, Expr]]]:
        """Yield the values of the indices with the symbol that replaces each access."""
        for at in _elements(of.loops, self.sizes):
            yield at, {slot: self.entry(access, at, of.loops) for slot, access in of.slots}

    def forces(self, forces: Sequence[ArrayForce]) -> dict[Symbol, list[Expr]]:
        """Return the contributions to the force on each coordinate."""
        by_coordinate: dict[Symbol, list[Expr]] = {}
        for force in forces:
            for at, rule in self.rules(force):
                for access, formula in force.targets:
                    by_coordinate.setdefault(self.entry(access, at, force.loops), []).append(formula.xreplace(rule))
        return by_coordinate

    def entry(self, access: Access, at: Elements, loops: Sequence[Loop]) -> Expr:
        """Return the symbol of an array entry, or the sum of a convolution."""
        periods = {loop.index: loop.end.at(self.sizes) for loop in loops if loop.periodic}
        try:
            indices = tuple(_place(each, at, periods, self.sizes, self.tables) for each in access.places)
        except IndexError as error:
            raise SystemDefinitionError(f"{access} at {dict(at)}: {error}") from error
        if any(not 0 <= each < length for each, length in zip(indices, access.array.shape(self.sizes), strict=True)):
            raise SystemDefinitionError(
                f"{access} has the index {list(indices)}, which is outside of {access.array}, at {dict(at)}"
            )
        if access.sums:
            *inner, last = access.sums
            by, count = self.names[last.coefficients.name], access.array.shape(self.sizes)[last.axis]
            terms = []
            for k in range(count):
                places = [*access.places]
                places[last.axis] = Place(base=Size("", k))
                factor = symbol(str(by[(k - indices[last.axis]) % count]))
                terms.append(factor * self.entry(replace(access, places=tuple(places), sums=tuple(inner)), at, loops))
            return Add(*terms)
        name = access.array.name
        if name in self.names:
            return symbol(str(self.names[name][indices]))
        return symbol(str(self.names[name.removesuffix(DOT)][indices]) + DOT)


def _place(subscript: Place, at: Elements, periods: Mapping[str, int], sizes: Mapping[str, int], tables: Tables) -> int:
    if subscript.table:
        return int(tables[subscript.table][at[subscript.index], subscript.column])
    if not subscript.index:
        return subscript.base.at(sizes)
    k = at[subscript.index] + subscript.base.number - (at[subscript.minus] if subscript.minus else 0)
    return k % periods[subscript.index] if subscript.index in periods else k
