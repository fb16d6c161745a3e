"""Groups of similar terms: terms that differ only in their coordinates, parameters and numbers.

The potentials of lattices, nets and many bodies consist of such groups, and so do kinetic energies of chains and beams
with full mass matrices, sums of c_ij cos(q_i - q_j) v_i v_j. A group is differentiated once, for one term, and
evaluated in a loop. Terms are compared by their expression trees: arguments of sums and products are sorted by
their structure without names and numbers, so that similar terms have equal keys.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from itertools import chain, compress, filterfalse, groupby, repeat
from typing import TypeVar, cast

from sympy import Add, Expr, Symbol, factor_terms

from scvi_codegen.systems.formulas.expressions import gradient_tuple, hessian
from scvi_codegen.systems.formulas.intermediates import inner_of
from scvi_codegen.systems.formulas.symbols import symbol
from scvi_codegen.systems.lagrangian import LagrangianSystem
from scvi_codegen.systems.system import MechanicalSystem

MIN_GROUP_SIZE = 300
"""Minimum number of terms of a group; smaller ones are unrolled, which is short enough and shares subexpressions.

Chains of 16, 20, 30 and 40 angles take 1.16, 1.07, 1.13 and 1.23 times the time of a step in loops (AVX2), of 40 and
100 angles .38 and .16 of the time to derive and compile.
"""
RATE = "~"
"""Name of the array of velocities in the structure of a term, last in order: functions of positions number these."""
MAX_GROUPS = 64
"""Maximum number of structures of terms; systems with more are not rolled."""

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class TermGroup:
    """Group of similar terms.

    Attributes:
        formula: of one term, in ``slots``, ``rates``, ``constants``, the symbols common to all terms, and time.
        slots: symbols of coordinates.
        rates: symbols of the velocities of the same coordinates, none of a potential.
        constants: symbols of the constants that differ between terms.
        places: indices of the coordinates in ``slots``, for each term.
        values: numbers or parameters, for each of ``constants`` and each term.
    """

    formula: Expr
    slots: tuple[Symbol, ...]
    constants: tuple[Symbol, ...]
    places: tuple[tuple[int, ...], ...]
    values: tuple[tuple[Expr, ...], ...]
    rates: tuple[Symbol, ...] = ()

    def where(self, mask: Sequence[bool]) -> TermGroup:
        """Return the group with only the chosen terms."""
        indices, *values = (tuple(compress(column, mask)) for column in (self.places, *self.values))
        return replace(self, places=indices, values=tuple(values))

    @property
    def partials(self) -> tuple[Expr, ...]:
        """Derivatives of the formula by ``slots``, with common factors extracted, since many share the rest."""
        return tuple(map(factor_terms, gradient_tuple(self.formula, self.slots)))

    @property
    def momenta(self) -> tuple[Expr, ...]:
        """Derivatives of the formula by ``rates``."""
        return gradient_tuple(self.formula, self.rates)

    @property
    def masses(self) -> dict[tuple[int, int], Expr]:
        """Nonzero second derivatives of the formula by ``rates``, (i, j) with i >= j."""
        entries = hessian(self.formula, self.rates)
        return {(i, j): entry for (i, j), entry in entries.items() if i >= j}

    @property
    def mass_places(self) -> Iterator[tuple[tuple[int, int], ...]]:
        """Row and column of each of ``masses`` in the mass matrix, in its lower triangle, for each term."""
        pairs = tuple(self.masses)
        for row in self.places:
            yield tuple((max(row[i], row[j]), min(row[i], row[j])) for i, j in pairs)


@dataclass(frozen=True, slots=True, kw_only=True)
class RestOfTerms(LagrangianSystem):
    """Lagrangian of the other terms of a system, whose mass matrix has further entries, of its term groups.

    It is not checked: its own mass matrix may be singular.
    """

    further_masses: tuple[tuple[int, int], ...] = ()

    def __post_init__(self) -> None:
        pass

    @classmethod
    def of(cls, system: LagrangianSystem, lagrangian: Expr, masses: Iterable[tuple[int, int]]) -> RestOfTerms:
        """Return the rest of a system, with the entries (i, j), i >= j, of the masses of its term groups."""
        own = {each.name: getattr(system, each.name) for each in fields(system) if each.init}
        return cls(**{**own, "lagrangian": lagrangian, "further_masses": tuple(sorted(masses))})


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
            rates=tuple(slot(RATE, k) for k in range(len(first.places))) if first.has(RATE) else (),
            constants=tuple(symbols[k] for k in varying),
            places=tuple(tuple(leaf.places) for leaf in self.leaves),
            values=tuple(columns[k] for k in varying),
        )


@lru_cache(maxsize=16)
def roll_terms(system: MechanicalSystem, *, moving: bool = False) -> SplitSystem | None:
    """Split a system; ``None`` without large term groups, or with constraints, a clock, or intermediate quantities.

    ``moving``: with the groups of a Lagrangian that contain velocities; ``None`` if it has none.
    """
    terms = Add.make_args(system.formula)
    if len(terms) < MIN_GROUP_SIZE or system.constraints or system.clock or inner_of(system.formula):
        return None
    if moving and not _has_dense_masses(system):
        return None
    large = _large_kinds(system, terms, moving=moving)
    groups = _groups(system, large)
    gathered = {*chain(*(kind.terms for kind in large))}
    rest = Add(*filterfalse(gathered.__contains__, terms))
    if not groups:
        return None
    if not moving:
        function = "hamiltonian" if system.auxiliaries else "lagrangian"
        return SplitSystem(replace(system, **{function: rest}), _merged(groups))
    kinetic = [group for group in groups if group.rates]
    if not kinetic or any(entry.free_symbols & {*group.rates} for group in kinetic for entry in group.masses.values()):
        return None
    coupled = {pair for group in kinetic for row in group.mass_places for pair in row}
    return SplitSystem(RestOfTerms.of(cast("LagrangianSystem", system), rest, coupled), _merged(groups))


def _large_kinds(system: MechanicalSystem, terms: Iterable[Expr], *, moving: bool) -> list[SimilarTerms]:
    """Return similar terms of positions, and of velocities if ``moving``, that are many."""
    positions = {*system.coordinates}
    others = {*system.auxiliaries} if moving else {*system.velocities, *system.auxiliaries}
    chosen = [term for term in terms if positions & term.free_symbols and not others & term.free_symbols]
    indices = {q: ("", k) for k, q in enumerate(system.coordinates)}
    if moving:
        indices |= {v: (RATE, k) for k, v in enumerate(system.velocities)}
    kinds = similar_terms(chosen, indices, system.parameters)
    return [kind for kind in kinds if len(kind) >= MIN_GROUP_SIZE]


def _groups(system: MechanicalSystem, kinds: Iterable[SimilarTerms]) -> list[TermGroup]:
    slot, constant = (_stem(name, system.parameters) for name in ("slot", "given"))
    sign = -1 if system.auxiliaries else 1
    return [
        similar.group(
            lambda array, k: symbol(f"{slot}{'dot' if array else ''}{k}"), lambda k: symbol(f"{constant}{k}"), sign
        )
        for kind in kinds
        for similar in kind.groups
    ]


def _has_dense_masses(system: MechanicalSystem) -> bool:
    """Return whether steps of a system may add masses of term groups to those of its other terms."""
    return (
        isinstance(system, LagrangianSystem)
        and not (system.depends_on_time or system.bath or system.integrands)
        and system.dual_energy == 0
        and system.gauge == 0
    )


def _merged(groups: Sequence[TermGroup]) -> tuple[TermGroup, ...]:
    """Return groups with the same places as one, the sum of their formulas."""
    merged: dict[tuple[tuple[int, ...], ...], TermGroup] = {}
    for group in groups:
        other = merged.setdefault(group.places, group)
        if other is not group:
            constants = tuple(symbol(f"{constant.name}_{len(other.constants)}") for constant in group.constants)
            merged[group.places] = replace(
                other,
                rates=other.rates or group.rates,
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
    found: set[str] = field(default_factory=set)

    def key(self, formula: Expr) -> str:
        """Return the structure of a formula with numbered leaves, which are collected."""
        if formula.is_Pow:
            exponent = str(formula.exp) if formula.exp.is_Number else self.key(formula.exp)
            return f"({self.key(formula.base)})**({exponent})"
        if formula.is_Add or formula.is_Mul:
            parts = [self.key(part) for part in self.ordered(formula.args)]
            return f"({(' + ' if formula.is_Add else '*').join(parts)})"
        if formula.args:
            return f"{formula.func.__name__}({', '.join(self.key(part) for part in formula.args)})"
        if formula in self.arrays:
            array, index = self.arrays[formula]
            self.found.add(array)
            return f"{array}{{{_number(self.places, index)}}}"
        return f"[{_number(self.constants, formula)}]" if self._is_constant(formula) else str(formula)

    def ordered(self, arguments: Iterable[Expr]) -> Iterator[Expr]:
        """Yield arguments by their structure; leaves of one structure in the order in which they were collected."""
        for _, alike in groupby(sorted(arguments, key=self.shape), self.shape):
            yield from sorted(alike, key=self.number)

    def number(self, formula: Expr) -> int:
        """Return the number of a leaf that was collected before, or that of the next one."""
        index = self.arrays[formula][1] if formula in self.arrays else None
        return self.places.index(index) if index in self.places else len(self.places)

    def has(self, array: str) -> bool:
        """Return whether entries of an array were collected."""
        return array in self.found

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
