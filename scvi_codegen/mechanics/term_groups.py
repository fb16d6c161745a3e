"""Systems of many similar terms in two parts: unrolled terms, and term groups that are evaluated in loops.

The potentials of lattices, nets and many bodies consist of groups of terms that differ only in their coordinates and
constants (:mod:`scvi_codegen.mechanics.similar_terms`). A group is differentiated once, for one term.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import compress, groupby

from sympy import Add, Expr, S, Symbol, factor_terms

from scvi_codegen.formulas.derivatives import gradient
from scvi_codegen.formulas.grammar import parse_expression
from scvi_codegen.formulas.symbols import symbol
from scvi_codegen.mechanics.similar_terms import SimilarTerms, similar_terms
from scvi_codegen.mechanics.system import MechanicalSystem

__all__ = ["MIN_GROUP_SIZE", "SplitSystem", "TermGroup", "rolled"]

MIN_GROUP_SIZE = 300
"""Minimum number of terms of a group; smaller ones are unrolled, which is short enough and shares subexpressions."""
MAX_GROUPS = 64


@dataclass(frozen=True, slots=True)
class TermGroup:
    """Group of similar terms of L that depend on coordinates, parameters and time.

    Attributes:
        formula: of one term, in ``slots``, ``given``, parameters and time.
        slots: symbols of coordinates.
        given: symbols of the constants that differ between terms.
        places: indices of the coordinates in ``slots``, for each term.
        values: numbers or parameters, for each of ``given`` and each term.
    """

    formula: Expr
    slots: tuple[Symbol, ...]
    given: tuple[Symbol, ...]
    places: tuple[tuple[int, ...], ...]
    values: tuple[tuple[Expr, ...], ...]

    def where(self, chosen: Sequence[bool]) -> TermGroup:
        """Return the group with only the chosen terms."""
        places, *values = (tuple(compress(column, chosen)) for column in (self.places, *self.values))
        return replace(self, places=places, values=tuple(values))

    @property
    def partials(self) -> tuple[Expr, ...]:
        """Derivatives of the formula by ``slots``, with common factors extracted, since many share the rest."""
        found = gradient(self.formula, self.slots)
        return tuple(factor_terms(found.get(k, S.Zero)) for k in range(len(self.slots)))


@dataclass(frozen=True, slots=True)
class SplitSystem:
    """System split into unrolled terms and term groups.

    Attributes:
        rest: the same system without the term groups.
        families: term groups of L, or of -H for a Hamiltonian.
    """

    rest: MechanicalSystem
    families: tuple[TermGroup, ...]


@lru_cache(maxsize=16)
def rolled(system: MechanicalSystem) -> SplitSystem | None:
    """Split a system; ``None`` without large term groups, with constraints, or with a time transformation."""
    terms = Add.make_args(system.formula)
    if len(terms) < MIN_GROUP_SIZE or system.constraints or system.clock:
        return None
    moving = {*system.velocities, *system.auxiliaries}
    known = {*system.coordinates}
    still = [term for term in terms if known & term.free_symbols and not moving & term.free_symbols]
    places = {q: ("", k) for k, q in enumerate(system.coordinates)}
    kinds = similar_terms(still, places, system.parameters, MAX_GROUPS)
    large = [kind for kind in kinds if len(kind.places) >= MIN_GROUP_SIZE]
    if not large:
        return None
    gathered = {term for kind in large for term in kind.terms}
    rest = Add(*(term for term in terms if term not in gathered))
    families = _merged([term_group for kind in large for term_group in _term_groups(kind, system)])
    return SplitSystem(replace(system, **{_FUNCTION[bool(system.auxiliaries)]: rest}), families)


_FUNCTION = {False: "lagrangian", True: "hamiltonian"}
"""Field of the defining function of a system, by whether it has momenta."""


def _term_groups(kind: SimilarTerms, system: MechanicalSystem) -> Iterator[TermGroup]:
    """Yield groups in which each constant is a number in all terms, or a parameter in all terms."""

    def pattern(constants: Sequence[Expr]) -> tuple[bool, ...]:
        return tuple(constant.is_Number for constant in constants)

    pairs = sorted(zip(kind.constants, kind.places, strict=True), key=lambda pair: (pattern(pair[0]), pair[1]))
    for _, found in groupby(pairs, lambda pair: pattern(pair[0])):
        constants, places = zip(*found, strict=True)
        yield _term_group(kind, constants, places, system)


def _term_group(
    kind: SimilarTerms,
    constants: Sequence[Sequence[Expr]],
    places: tuple[tuple[int, ...], ...],
    system: MechanicalSystem,
) -> TermGroup:
    columns = list(zip(*constants, strict=True))
    varying = [k for k, column in enumerate(columns) if len(set(column)) > 1]
    slot, given = (_stem(name, system.parameters) for name in ("slot", "given"))
    slots = tuple(symbol(f"{slot}{k}") for k in range(len(places[0])))
    different = {k: symbol(f"{given}{k}") for k in varying}
    text = kind.written(
        lambda k: slots[k].name, lambda k: different[k].name if k in different else f"({columns[k][0]})"
    )
    known = (*slots, *different.values(), *system.parameters, system.time)
    formula = parse_expression(text, {each.name: each for each in known})
    return TermGroup(
        formula=-formula if system.auxiliaries else formula,
        slots=slots,
        given=tuple(different.values()),
        places=places,
        values=tuple(columns[k] for k in varying),
    )


def _merged(families: Sequence[TermGroup]) -> tuple[TermGroup, ...]:
    """Merge groups with the same indices."""
    found: dict[tuple[tuple[int, ...], ...], TermGroup] = {}
    for term_group in families:
        other = found.setdefault(term_group.places, term_group)
        if other is not term_group:
            count = len(other.given)
            given = tuple(symbol(f"{each.name}_{count}") for each in term_group.given)
            formula = term_group.formula.xreplace(dict(zip(term_group.given, given, strict=True)))
            found[term_group.places] = replace(
                other,
                formula=other.formula + formula,
                given=(*other.given, *given),
                values=(*other.values, *term_group.values),
            )
    return tuple(found.values())


def _stem(name: str, parameters: Sequence[Symbol]) -> str:
    """Return a prefix of symbol names that no parameter has."""
    stem = f"{name}_"
    while any(parameter.name.startswith(stem) for parameter in parameters):
        stem += "_"
    return stem
