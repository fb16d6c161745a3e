"""A system of many like terms in two parts: what is written out, and families of terms that stand in loops.

The potentials of lattices, nets and many bodies are families of terms that differ in their coordinates and constants
alone (:mod:`scvi_codegen.mechanics.like_terms`). What is derived of a family is derived of one term.
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
from scvi_codegen.mechanics.like_terms import LikeTerms, like_terms
from scvi_codegen.mechanics.system import MechanicalSystem

__all__ = ["LEAST_ROLLED", "Rolled", "RolledTerms", "rolled"]

LEAST_ROLLED = 300
"""Terms of one kind: of fewer the code is short enough written out, and shares what they have in common."""
MOST_KINDS = 64


@dataclass(frozen=True, slots=True)
class RolledTerms:
    """Terms of L that depend on coordinates, parameters and time.

    Attributes:
        formula: of one, of ``slots`` and ``given``, parameters and time.
        slots: symbols of coordinates.
        given: symbols of what differs from term to term.
        places: the coordinates in the slots, by their number, of each term.
        values: of each of ``given`` what it is in each term: numbers, or parameters.
    """

    formula: Expr
    slots: tuple[Symbol, ...]
    given: tuple[Symbol, ...]
    places: tuple[tuple[int, ...], ...]
    values: tuple[tuple[Expr, ...], ...]

    def where(self, chosen: Sequence[bool]) -> RolledTerms:
        """Some of the terms."""
        places, *values = (tuple(compress(column, chosen)) for column in (self.places, *self.values))
        return replace(self, places=places, values=tuple(values))

    @property
    def slopes(self) -> tuple[Expr, ...]:
        """The derivatives of the formula by its slots, factors of sums taken out: many share the rest."""
        found = gradient(self.formula, self.slots)
        return tuple(factor_terms(found.get(k, S.Zero)) for k in range(len(self.slots)))


@dataclass(frozen=True, slots=True)
class Rolled:
    """The two parts.

    Attributes:
        rest: the same system without the families.
        families: of L; of -H where a Hamiltonian is given.
    """

    rest: MechanicalSystem
    families: tuple[RolledTerms, ...]


@lru_cache(maxsize=16)
def rolled(system: MechanicalSystem) -> Rolled | None:
    """The parts of a system; ``None`` of one that has no families so large, and with constraints or in other time."""
    terms = Add.make_args(system.formula)
    if len(terms) < LEAST_ROLLED or system.constraints or system.clock:
        return None
    moving = {*system.velocities, *system.auxiliaries}
    known = {*system.coordinates}
    still = [term for term in terms if known & term.free_symbols and not moving & term.free_symbols]
    places = {q: ("", k) for k, q in enumerate(system.coordinates)}
    kinds = like_terms(still, places, system.parameters, MOST_KINDS)
    large = [kind for kind in kinds if len(kind.places) >= LEAST_ROLLED]
    if not large:
        return None
    gathered = {term for kind in large for term in kind.terms}
    rest = Add(*(term for term in terms if term not in gathered))
    families = _merged([family for kind in large for family in _families(kind, system)])
    return Rolled(replace(system, **{_FUNCTION[bool(system.auxiliaries)]: rest}), families)


_FUNCTION = {False: "lagrangian", True: "hamiltonian"}
"""What gives a system, by whether it has momenta."""


def _families(kind: LikeTerms, system: MechanicalSystem) -> Iterator[RolledTerms]:
    """Those of a kind: in each a constant is a number, or a parameter, of all terms."""

    def pattern(constants: Sequence[Expr]) -> tuple[bool, ...]:
        return tuple(constant.is_Number for constant in constants)

    pairs = sorted(zip(kind.constants, kind.places, strict=True), key=lambda pair: (pattern(pair[0]), pair[1]))
    for _, found in groupby(pairs, lambda pair: pattern(pair[0])):
        constants, places = zip(*found, strict=True)
        yield _family(kind, constants, places, system)


def _family(
    kind: LikeTerms, constants: Sequence[Sequence[Expr]], places: tuple[tuple[int, ...], ...], system: MechanicalSystem
) -> RolledTerms:
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
    return RolledTerms(
        formula=-formula if system.auxiliaries else formula,
        slots=slots,
        given=tuple(different.values()),
        places=places,
        values=tuple(columns[k] for k in varying),
    )


def _merged(families: Sequence[RolledTerms]) -> tuple[RolledTerms, ...]:
    """Families of the same places as one."""
    found: dict[tuple[tuple[int, ...], ...], RolledTerms] = {}
    for family in families:
        other = found.setdefault(family.places, family)
        if other is not family:
            count = len(other.given)
            given = tuple(symbol(f"{each.name}_{count}") for each in family.given)
            formula = family.formula.xreplace(dict(zip(family.given, given, strict=True)))
            found[family.places] = replace(
                other,
                formula=other.formula + formula,
                given=(*other.given, *given),
                values=(*other.values, *family.values),
            )
    return tuple(found.values())


def _stem(name: str, parameters: Sequence[Symbol]) -> str:
    """The beginning of names that no parameter has."""
    stem = f"{name}_"
    while any(parameter.name.startswith(stem) for parameter in parameters):
        stem += "_"
    return stem
