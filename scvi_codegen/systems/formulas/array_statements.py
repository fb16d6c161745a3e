"""Parsers for the constraints and forces of array systems.

Constraints hold at every element of loops; forces act on all entries along an axis, on a single one, or on those in a
table:

constraint = sum ["=" sum] ["for" loop ("," loop)*]      (r[b+1] - r[b])**2 = l[b]**2 for b in 0..N-2
target     = array "[" (index | size | whole number | entry) ("," ..)* "]"        q[i], r[i, a], q[0], q[N-1]
entry      = table "[" index ("," whole number)? "]"                            q[pins[p]], r[bonds[b, 1], a]

Array formulas in LaTeX, and conversion of SymPy's ``Sum`` and ``Indexed`` to text of their grammar.

SymPy's own derivatives of such sums are not used, as they are sometimes wrong (repeated bound symbols, functions of
indices); a sum is read term by term.

    Sum(f, (i, 0, N - 1))                           sum(i in 0..N-1, f)
    Sum(f, (i, 0, N - 1)) with q[Mod(i + 1, N)]     sum(i in N periodic, f)
    Sum(f, (j, i + 1, N - 1), (i, 0, N - 2))        sum(i < j in N, f)

Entries of arrays of known sizes: formulas in index notation as formulas of q_0, q_1, ...
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain, islice

import numpy as np
from numpy.typing import NDArray
from sympy import Add, Expr, Idx, Indexed, Mod, S, Sum, Symbol, Tuple, latex
from sympy.printing.str import StrPrinter

from scvi_codegen.common.errors import ExpressionError, SystemDefinitionError
from scvi_codegen.systems.formulas.arrays import ArrayParser, ArrayTerm, Bound, term_of
from scvi_codegen.systems.formulas.expressions import derivative_along
from scvi_codegen.systems.formulas.grammar import parsed, sides_of
from scvi_codegen.systems.formulas.indices import Access, Array, Loop, Place, Size, elements, periods_of
from scvi_codegen.systems.formulas.kinks import OF_SYMPY
from scvi_codegen.systems.formulas.symbols import DOT, symbol

_FOR = re.compile(r"\bfor\b")
Combination = Callable[[Sequence[Expr], Callable[[Expr], Expr]], Expr]
"""Function of the formulas of the sides of an equation, and of a function that computes time derivatives."""


def plain_sides(equation: str) -> tuple[Sequence[str], Combination]:
    """Return the sides of ``left = right``, or the one formula that is 0, and the function left - right."""
    return sides_of(equation), lambda sides, _: Add(sides[0], *(-side for side in sides[1:]))


def parse_constraint(
    text: str,
    arrays: Sequence[Array],
    symbols: Mapping[str, Symbol],
    tables: Sequence[Array] = (),
    *,
    split: Callable[[str], tuple[Sequence[str], Combination]] = plain_sides,
    velocities: Mapping[Array, Array | None] | None = None,
) -> ArrayTerm:
    """Parse a constraint g = 0 for all elements of loops; for ``left = right`` g is left - right.

    Args:
        text: the constraint.
        arrays, symbols, tables: as of :func:`~scvi_codegen.systems.formulas.arrays.parse_sums`.
        split: returns the sides of an equation, and the function that computes g from their formulas and from a
            function that computes time derivatives.
        velocities: for such derivatives, the array of velocities by that of coordinates, ``None`` by constant ones.

    Raises:
        ExpressionError: as there, and for a sum over a whole array, which would couple all of its entries.

    >>> from scvi_codegen.systems.formulas.arrays import parse_array
    >>> term = parse_constraint("(q[i+1] - q[i])**2 = 1 for i in 0..N-2", [parse_array("q[N]")], {})
    >>> print(term.formula, "for", *term.loops)
    (q[i+1] - q[i])**2 - 1 for i in 0..N-2
    """
    equation, *behind = _FOR.split(text)
    sides, combination = split(equation)
    if len(sides) > 2 or len(behind) > 1:
        raise ExpressionError("a constraint may contain one '=' and one 'for'", text, 0)
    loops = tuple(chain(*(_Loops(clause, symbols, arrays, tables).read() for clause in behind)))
    parsers = [ArrayParser(side, symbols, arrays, tables) for side in sides]
    for parser in parsers:
        parser.in_scope = {loop.index: loop for loop in loops}
    formulas = [*map(parsed, parsers)]
    if any(parser.sums for parser in parsers):
        message = "a formula with 'for', and a constraint, must not contain a sum over a whole array"
        raise ExpressionError(message, text, text.find("sum"))
    accesses = dict(chain(*(parser.accesses.items() for parser in parsers)))
    velocities = velocities or {}
    moving = {slot: velocities.get(access.array) for slot, access in accesses.items()}
    pairs = {slot: replace(accesses[slot], array=array) for slot, array in moving.items() if array}
    rates = {symbol("t"): S.One, **{slot: symbol(str(access)) for slot, access in pairs.items()}}

    def rate(formula: Expr) -> Expr:
        for slot in formula.free_symbols & accesses.keys():
            if accesses[slot].array not in velocities:
                raise ExpressionError(
                    f"the time derivative of {accesses[slot]} is not available in constraints of arrays", text, 0
                )
        return derivative_along(formula, tuple(rates), tuple(rates.values()))

    accesses_of_rates = {symbol(str(access)): access for access in pairs.values()}
    return term_of(loops, combination(formulas, rate), accesses | accesses_of_rates)


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

    >>> from scvi_codegen.systems.formulas.arrays import parse_array
    >>> from scvi_codegen.systems.formulas.symbols import symbol
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
        targets, formula = (ArrayParser(part, symbols, arrays, tables) for part in (target, text))
        targets.in_scope, formula.in_scope, formula.has_loops = dict(row), dict(row), False
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
            coordinates = ", ".join(map(str, self.arrays.values()))
            self.refuse(f"a force must act on coordinates, {coordinates}, not on '{token.text}'", token.column)
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


def latex_sum(term: ArrayTerm) -> str:
    r"""Return a term in LaTeX.

    >>> from scvi_codegen.systems.formulas.arrays import parse_array, parse_sums
    >>> (term,) = parse_sums("sum(i in 0..N-2, (q[i+1] - q[i])**2/2)", [parse_array("q[N]")], {})
    >>> print(latex_sum(term))
    \sum_{i=0}^{N-2} \left(\frac{\left(q_{i+1} - q_{i}\right)^{2}}{2}\right)
    """
    formula = latex(term.formula, symbol_names={slot: latex_entry(access) for slot, access in term.slots})
    sums = latex_sums(term)
    return f"{sums} \\left({formula}\\right)" if sums else str(formula)


def latex_sums(term: ArrayTerm) -> str:
    """Return the summation signs of a term alone."""
    pairs = {loop.behind for loop in term.loops}
    return " ".join(_sum(loop) for loop in term.loops if loop.index not in pairs)


def _sum(loop: Loop) -> str:
    if loop.behind:
        listed = rf",\ \mathrm{{{loop.near}}}" if loop.near else ""
        return rf"\sum_{{0 \le {loop.behind} < {loop.index} < {loop.end}{listed}}}"
    if loop.periodic:
        return rf"\sum_{{{loop.index} \in \mathbb{{Z}}_{{{loop.end}}}}}"
    return rf"\sum_{{{loop.index}={loop.first}}}^{{{loop.end + -1}}}"


def latex_entry(access: Access) -> str:
    """Return an array entry with subscripts, with the summation signs of its convolutions."""
    name, places, before = access.array.name, [*map(_place_text, access.places)], ""
    for convolution in reversed(access.sums):
        j, place = convolution.index, places[convolution.axis]
        before += rf"\sum_{{{j}}} {_letter(convolution.coefficients.name)}_{{{j}-{place}}} "
        places[convolution.axis] = j
    letter = rf"\dot{{{_letter(name.removesuffix(DOT))}}}" if name.endswith(DOT) else _letter(name)
    entry = f"{letter}_{{{', '.join(places)}}}"
    return rf"\left({before}{entry}\right)" if before else entry


def _letter(name: str) -> str:
    return name if len(name) == 1 else rf"\mathrm{{{name}}}".replace("_", r"\_")


def _place_text(subscript: Place) -> str:
    return (
        rf"{_letter(subscript.table)}_{{{subscript.index} {subscript.column}}}" if subscript.table else str(subscript)
    )


def array_text(expression: Expr) -> str:
    """Return the text of a sum of sums; SystemDefinitionError for other limits than those above.

    >>> from sympy import IndexedBase, symbols
    >>> q, (i, N) = IndexedBase("q"), symbols("i N", integer=True)
    >>> array_text(-Sum((q[Mod(i + 1, N)] - q[i]) ** 2 / 2, (i, 0, N - 1)))
    '-sum(i in N periodic, (q[i + 1] - q[i])**2/2)'
    """
    for function, written in OF_SYMPY.items():
        expression = expression.replace(function, written)
    return str(_Printer({"full_prec": False}).doprint(expression))


class _Printer(StrPrinter):  # type: ignore[misc]  # SymPy has no types
    def _as_ordered_terms(self, expression: Expr, order: object = None) -> list[Expr]:
        """Return the terms in the order of their texts: results depend on it, and SymPy's order on its version."""
        texts = {term: self._print(term) for term in expression.args}
        return sorted(texts, key=lambda term: (bool(term.is_Number), texts[term].lstrip("-"), texts[term]))

    def _print_Sum(self, expression: Sum) -> str:
        wrapped = dict(map(_wrapped, expression.function.atoms(Mod)))
        for index in (place for entry in expression.function.atoms(Indexed) for place in entry.indices):
            if index.is_Add and index.free_symbols & set(wrapped):
                raise SystemDefinitionError(
                    f"{index} leaves a periodic axis: write Mod({index}, ..), as in its other indices"
                )
        loops = ", ".join(_loops(expression.limits, wrapped))
        return f"sum({loops}, {self._print(expression.function)})"

    def _print_Indexed(self, expression: Indexed) -> str:
        return f"{expression.base.label}[{', '.join(map(self._print, expression.indices))}]"

    def _print_Idx(self, expression: Idx) -> str:
        return str(expression.label)

    def _print_Mod(self, expression: Mod) -> str:
        _wrapped(expression)
        return str(self._print(expression.args[0]))


def _wrapped(expression: Mod) -> tuple[Symbol, Expr]:
    """Return the index in a periodic expression Mod(i + k, N), and the period."""
    index, length = expression.args
    indices = [variable for variable in index.free_symbols if variable not in length.free_symbols]
    if len(indices) != 1 or not (index - indices[0]).is_Integer:
        raise SystemDefinitionError(f"{expression} is not an index of a periodic axis: write Mod(i + 1, N)")
    return indices[0], length


def _loops(limits: Sequence[Tuple], wrapped: Mapping[Symbol, Expr]) -> list[str]:
    """Return the loops of a sum, outermost first; an index that begins at another plus 1 is the second of a pair."""
    if any(len(limit) != 3 for limit in limits):
        raise SystemDefinitionError(f"a sum must have an index and two bounds, as (i, 0, N - 1), not {limits}")
    spans = {index: (first, last) for index, first, last in reversed(limits)}
    pairs = {outer: inner for inner, (first, _) in spans.items() for outer in spans if first - outer == 1}
    loops = []
    for index, (first, last) in spans.items():
        if index in pairs:
            length = spans[pairs[index]][1] + 1
            if first != 0 or last - length not in (-1, -2):
                raise SystemDefinitionError(f"pairs must run over a whole axis, ({index}, 0, N - 2), not {limits}")
            loops.append(f"{index} < {pairs[index]} in {length}")
        elif index in wrapped:
            if first != 0 or wrapped[index] != last + 1:
                message = (
                    f"Mod(.., {wrapped[index]}) requires a sum over the whole periodic axis, "
                    f"({index}, 0, {wrapped[index] - 1}), not {limits}"
                )
                raise SystemDefinitionError(message)
            loops.append(f"{index} in {last + 1} periodic")
        elif index not in pairs.values():
            loops.append(f"{index} in {first}..{last}")
    return loops


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

    ``rules``: sizes, tables and names of entries; by default those of arrays whose sizes are numbers.
    """
    rules = rules or EntryRules(
        {}, {}, {array.name: entry_names(array, {}) for array in arrays if not array.name.endswith(DOT)}
    )
    parser = ArrayParser(text, symbols, arrays, tables)
    whole = parsed(parser)
    ((_, values),) = rules.rules(term_of((), whole, parser.accesses))
    for placeholder, (loops, formula, _) in parser.sums.items():
        term = term_of(loops, formula, parser.accesses)
        values[placeholder] = Add(*rules.formulas(term))
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

    def rules(self, term: ArrayTerm | ArrayForce) -> Iterator[tuple[Elements, dict[Symbol, Expr]]]:
        """Yield the values of the indices with the symbol that replaces each access."""
        for at in elements(term.loops, self.sizes):
            yield at, {slot: self.entry(access, at, term.loops) for slot, access in term.slots}

    def formulas(self, term: ArrayTerm) -> list[Expr]:
        """Return the formula of a term at each value of its indices, in symbols of entries."""
        return [term.formula.xreplace(rule) for _, rule in self.rules(term)]

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
        periods = periods_of(loops, self.sizes)
        try:
            indices = tuple(int(place.at(at, self.sizes, self.tables, periods)) for place in access.places)
        except IndexError as error:
            raise SystemDefinitionError(f"{access} at {dict(at)}: {error}") from error
        if any(not 0 <= index < length for index, length in zip(indices, access.array.shape(self.sizes), strict=True)):
            raise SystemDefinitionError(
                f"{access} has the index {list(indices)}, which is outside of {access.array}, at {dict(at)}"
            )
        if access.sums:
            *inner, last = access.sums
            by = self.names[last.coefficients.name]
            count = access.array.shape(self.sizes)[last.axis]
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
