"""Groups of similar terms: terms that differ only in their coordinates, parameters and numbers.

The potentials of lattices, nets and many bodies consist of such groups. A group is differentiated once, for one term,
and evaluated in a loop. Terms are compared by their expression trees: arguments of sums and products are sorted by
their structure without names and numbers, so that similar terms have equal keys.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import chain, compress, filterfalse, groupby, repeat
from typing import TypeVar

from sympy import Add, Expr, Symbol, factor_terms

from scvi_codegen.systems.formulas.expressions import gradient_tuple
from scvi_codegen.systems.formulas.intermediates import inner_of
from scvi_codegen.systems.formulas.symbols import symbol
from scvi_codegen.systems.system import MechanicalSystem

MIN_GROUP_SIZE = 300
"""Minimum number of terms of a group; smaller ones are unrolled, which is short enough and shares subexpressions."""
MAX_GROUPS = 64
"""Maximum number of structures of terms; systems with more are not rolled."""

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class TermGroup:
    """Group of similar terms.

    Attributes:
        formula: of one term, in ``slots``, ``constants``, the symbols common to all terms, and time.
        slots: symbols of coordinates.
        constants: symbols of the constants that differ between terms.
        places: indices of the coordinates in ``slots``, for each term.
        values: numbers or parameters, for each of ``constants`` and each term.
    """

    formula: Expr
    slots: tuple[Symbol, ...]
    constants: tuple[Symbol, ...]
    places: tuple[tuple[int, ...], ...]
    values: tuple[tuple[Expr, ...], ...]

    def where(self, mask: Sequence[bool]) -> TermGroup:
        """Return the group with only the chosen terms."""
        indices, *values = (tuple(compress(column, mask)) for column in (self.places, *self.values))
        return replace(self, places=indices, values=tuple(values))

    @property
    def partials(self) -> tuple[Expr, ...]:
        """Derivatives of the formula by ``slots``, with common factors extracted, since many share the rest."""
        return tuple(map(factor_terms, gradient_tuple(self.formula, self.slots)))


@dataclass(frozen=True, slots=True)
class SplitSystem:
    """System split into unrolled terms, ``rest``, and term groups of L, or of -H for a Hamiltonian."""

    rest: MechanicalSystem
    term_groups: tuple[TermGroup, ...]


@dataclass(frozen=True, slots=True)
class SimilarTerms:
    """Terms of the same structure, and the leaves of each: coordinates and constants, in the same order."""

    terms: tuple[Expr, ...]
    leaves: tuple[_Leaves, ...]

    def __len__(self) -> int:
        return len(self.terms)

    @property
    def groups(self) -> Iterator[SimilarTerms]:
        """Groups in which each constant is a number in all terms, or a parameter in all terms."""

        def pattern(pair: tuple[Expr, _Leaves]) -> tuple[bool, ...]:
            return tuple(constant.is_Number for constant in pair[1].constants)

        pairs = zip(self.terms, self.leaves, strict=True)
        ordered = sorted(pairs, key=lambda pair: (pattern(pair), pair[1].places))
        for _, similar in groupby(ordered, pattern):
            yield SimilarTerms(*zip(*similar, strict=True))

    def group(self, slot: Callable[[str, int], Symbol], constant: Callable[[int], Symbol], sign: int = 1) -> TermGroup:
        """Return the term group: symbols of coordinates by array and column, of constants by number, and a sign."""
        first = self.leaves[0]
        columns = list(zip(*(leaf.constants for leaf in self.leaves), strict=True))
        varying = [k for k, column in enumerate(columns) if len(set(column)) > 1]
        symbols = [constant(k) if k in varying else column[0] for k, column in enumerate(columns)]
        return TermGroup(
            formula=sign * first.substituted(self.terms[0], slot, symbols),
            slots=tuple(slot("", k) for k in range(len(first.places))),
            constants=tuple(symbols[k] for k in varying),
            places=tuple(tuple(leaf.places) for leaf in self.leaves),
            values=tuple(columns[k] for k in varying),
        )


@lru_cache(maxsize=16)
def roll_terms(system: MechanicalSystem) -> SplitSystem | None:
    """Split a system; ``None`` without large term groups, or with constraints, a clock, or intermediate quantities."""
    terms = Add.make_args(system.formula)
    if len(terms) < MIN_GROUP_SIZE or system.constraints or system.clock or inner_of(system.formula):
        return None
    moving = {*system.velocities, *system.auxiliaries}
    positions = {*system.coordinates}
    still = [term for term in terms if positions & term.free_symbols and not moving & term.free_symbols]
    kinds = similar_terms(still, {q: ("", k) for k, q in enumerate(system.coordinates)}, system.parameters)
    large = [kind for kind in kinds if len(kind) >= MIN_GROUP_SIZE]
    if not large:
        return None
    slot, constant = (_stem(name, system.parameters) for name in ("slot", "given"))
    groups = [
        similar.group(
            lambda _, k: symbol(f"{slot}{k}"), lambda k: symbol(f"{constant}{k}"), -1 if system.auxiliaries else 1
        )
        for kind in large
        for similar in kind.groups
    ]
    function = "hamiltonian" if system.auxiliaries else "lagrangian"
    gathered = {*chain(*(kind.terms for kind in large))}
    rest = replace(system, **{function: Add(*filterfalse(gathered.__contains__, terms))})
    return SplitSystem(rest, _merged(groups))


def _merged(groups: Sequence[TermGroup]) -> tuple[TermGroup, ...]:
    """Return groups with the same places as one, the sum of their formulas."""
    merged: dict[tuple[tuple[int, ...], ...], TermGroup] = {}
    for group in groups:
        other = merged.setdefault(group.places, group)
        if other is not group:
            constants = tuple(symbol(f"{constant.name}_{len(other.constants)}") for constant in group.constants)
            merged[group.places] = replace(
                other,
                formula=other.formula + group.formula.xreplace(dict(zip(group.constants, constants, strict=True))),
                constants=(*other.constants, *constants),
                values=(*other.values, *group.values),
            )
    return tuple(merged.values())


def _stem(name: str, parameters: Sequence[Symbol]) -> str:
    stem = f"{name}_"
    while any(parameter.name.startswith(stem) for parameter in parameters):
        stem += "_"
    return stem


def similar_terms(
    terms: Iterable[Expr],
    indices: Mapping[Symbol, tuple[str, int]],
    names: Iterable[Symbol],
    first: Iterable[tuple[int, ...]] = repeat(()),
) -> tuple[SimilarTerms, ...]:
    """Return the terms by structure, in the order of their keys; nothing if there are more than ``MAX_GROUPS``.

    Args:
        terms: in canonical form.
        indices: array and index of each coordinate, velocity or momentum.
        names: parameters.
        first: indices that precede those of each term, such as the coordinate on which a force acts.
    """
    kinds: dict[str, list[tuple[Expr, _Leaves]]] = {}
    shapes, constants = dict[Expr, str](), set(names)
    for term, begun in zip(terms, first, strict=False):
        leaves = _Leaves(indices, constants, shapes, [*begun])
        kinds.setdefault(leaves.key(term), []).append((term, leaves))
        if len(kinds) > MAX_GROUPS:
            return ()
    return tuple(SimilarTerms(*zip(*similar, strict=True)) for _, similar in sorted(kinds.items()))


@dataclass(slots=True)
class _Leaves:
    """Coordinates (places) and constants of a term, without repetitions, in the order in which they occur."""

    arrays: Mapping[Symbol, tuple[str, int]]
    names: set[Symbol]
    shapes: dict[Expr, str]
    places: list[int] = field(default_factory=list)
    constants: list[Expr] = field(default_factory=list)

    def key(self, formula: Expr) -> str:
        """Return the structure of a formula with numbered leaves, which are collected."""
        if formula.is_Pow:
            exponent = str(formula.exp) if formula.exp.is_Number else self.key(formula.exp)
            return f"({self.key(formula.base)})**({exponent})"
        if formula.is_Add or formula.is_Mul:
            parts = [self.key(part) for part in sorted(formula.args, key=self.shape)]
            return f"({(' + ' if formula.is_Add else '*').join(parts)})"
        if formula.args:
            return f"{formula.func.__name__}({', '.join(self.key(part) for part in formula.args)})"
        if formula in self.arrays:
            array, index = self.arrays[formula]
            return f"{array}{{{_number(self.places, index)}}}"
        return f"[{_number(self.constants, formula)}]" if self._is_constant(formula) else str(formula)

    def shape(self, formula: Expr) -> str:
        """Return the structure of a formula without numbered leaves."""
        written = self.shapes.get(formula)
        if written is None:
            written = self.shapes[formula] = self._shape(formula)
        return written

    def _shape(self, formula: Expr) -> str:
        if formula.is_Pow:
            exponent = str(formula.exp) if formula.exp.is_Number else self.shape(formula.exp)
            return f"({self.shape(formula.base)})**({exponent})"
        if formula.args:
            return f"{formula.func.__name__}({', '.join(sorted(map(self.shape, formula.args)))})"
        if formula in self.arrays:
            return self.arrays[formula][0]
        return "c" if self._is_constant(formula) else str(formula)

    def _is_constant(self, formula: Expr) -> bool:
        return bool(formula.is_Number) or formula in self.names

    def substituted(self, formula: Expr, slot: Callable[[str, int], Symbol], constants: Sequence[Expr]) -> Expr:
        if formula.args:
            fixed = formula.args[1:] if formula.is_Pow and formula.exp.is_Number else ()
            parts = formula.args[: len(formula.args) - len(fixed)]
            return formula.func(*(self.substituted(part, slot, constants) for part in parts), *fixed)
        if formula in self.arrays:
            array, index = self.arrays[formula]
            return slot(array, self.places.index(index))
        return constants[self.constants.index(formula)] if self._is_constant(formula) else formula


def _number(items: list[Item], item: Item) -> int:
    """Return the index of an item in a list, appending the item if necessary."""
    if item not in items:
        items.append(item)
    return items.index(item)
