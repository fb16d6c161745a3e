"""Grouping of similar terms: terms that differ only in their coordinates, parameters and numbers.

Terms are compared by their expression trees: arguments of sums and products are sorted by their structure without
names and numbers, so that similar terms have equal texts.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import repeat
from typing import TypeVar

from sympy import Expr, Symbol

from scvi_codegen.formulas.vocabulary import NAME_OF

__all__ = ["SimilarTerms", "similar_terms"]

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True, kw_only=True)
class SimilarTerms:
    """Group of similar terms.

    Attributes:
        text: formula common to all: ``q{0}`` is the entry of the array q at its first index, ``[0]`` a constant.
        terms: the original expressions.
        places: indices of the coordinates, for each term.
        constants: numbers or parameters, for each term.
    """

    text: str
    terms: tuple[Expr, ...]
    places: tuple[tuple[int, ...], ...]
    constants: tuple[tuple[Expr, ...], ...]

    def written(self, place: Callable[[int], str], constant: Callable[[int], str]) -> str:
        """Return the text with its placeholders replaced by ``place`` and ``constant``."""
        text = re.sub(r"\[(\d+)\]", lambda found: constant(int(found[1])), self.text)
        return re.sub(r"\{(\d+)\}", lambda found: place(int(found[1])), text)


def similar_terms(
    terms: Iterable[Expr],
    places: Mapping[Symbol, tuple[str, int]],
    names: Iterable[Symbol],
    most: int,
    first: Iterable[tuple[int, ...]] = repeat(()),
) -> tuple[SimilarTerms, ...]:
    """Group terms by structure, in the order of their texts; return no groups if there are more than ``most``.

    Args:
        terms: in canonical form.
        places: array and index of each coordinate, velocity or momentum.
        names: parameters.
        most: maximum number of groups.
        first: indices that precede those of each term, such as the coordinate on which a force acts.
    """
    shapes, known = dict[Expr, str](), set(names)
    kinds: dict[str, list[tuple[Expr, _Term]]] = {}
    for term, begun in zip(terms, first, strict=False):
        read = _Term(places, known, shapes, [*begun])
        kinds.setdefault(read.write(term), []).append((term, read))
        if len(kinds) > most:
            return ()
    return tuple(
        SimilarTerms(
            text=text,
            terms=tuple(term for term, _ in found),
            places=tuple(tuple(read.rows) for _, read in found),
            constants=tuple(tuple(read.constants) for _, read in found),
        )
        for text, found in sorted(kinds.items())
    )


@dataclass(slots=True)
class _Term:
    """Conversion of a term to text with numbered leaves.

    Attributes:
        places: array and index of each coordinate and velocity.
        names: parameters.
        shapes: cache of the structure of formulas.
        rows: indices of the coordinates that occur, in order.
        constants: numbers and parameters that occur, in order, without repetitions.
    """

    places: Mapping[Symbol, tuple[str, int]]
    names: set[Symbol]
    shapes: dict[Expr, str]
    rows: list[int] = field(default_factory=list)
    constants: list[Expr] = field(default_factory=list)

    def write(self, formula: Expr) -> str:
        """Return the text of a formula; an index is {0}, a constant [0]."""
        if formula.is_Pow:
            exponent = str(formula.exp) if formula.exp.is_Number else self.write(formula.exp)
            return f"({self.write(formula.base)})**({exponent})"
        if formula.is_Add or formula.is_Mul:
            parts = [self.write(part) for part in sorted(formula.args, key=self.shape)]
            return f"({(' + ' if formula.is_Add else '*').join(parts)})"
        if formula.args:
            return f"{NAME_OF[formula.func]}({', '.join(self.write(part) for part in formula.args)})"
        if formula in self.places:
            array, place = self.places[formula]
            return f"{array}{{{_number(self.rows, place)}}}"
        if formula.is_Number or formula in self.names:
            return f"[{_number(self.constants, formula)}]"
        return str(formula)

    def shape(self, formula: Expr) -> str:
        """Return the structure of a formula: its text without numbered leaves."""
        found = self.shapes.get(formula)
        if found is None:
            found = self.shapes[formula] = self._shape(formula)
        return found

    def _shape(self, formula: Expr) -> str:
        if formula.is_Pow:
            exponent = str(formula.exp) if formula.exp.is_Number else self.shape(formula.exp)
            return f"({self.shape(formula.base)})**({exponent})"
        if formula.args:
            return f"{formula.func.__name__}({', '.join(sorted(map(self.shape, formula.args)))})"
        if formula in self.places:
            return self.places[formula][0]
        return "c" if formula.is_Number or formula in self.names else str(formula)


def _number(known: list[Item], item: Item) -> int:
    """Return the index of an item in a list, appending the item if necessary."""
    if item not in known:
        known.append(item)
    return known.index(item)
