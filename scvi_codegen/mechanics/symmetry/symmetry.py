"""Symmetries and what they conserve: Noether's theorem for affine point transformations.

A direction xi(q, t) is a symmetry if moving along it changes L by a total derivative only,

    L_q . xi + L_v . dxi/dt = df/dt,    and then    J = p . xi - f    is conserved,

its momentum map. Searched are xi = A(t) q + b(t) with f quadratic in q: A of degree 1 in t, b of degree 2. That is all
translations, rotations, boosts, and magnetic and uniform fields; a symmetry periodic in time, such as xi = cos(t) of an
oscillator, is not among them, nor one whose f is not quadratic. Where a Hamiltonian is given L is p . v - H, and J may
be any polynomial quadratic in (q, p), of degree 1 in t, but H itself: J generates a symmetry of phase space, moving
q by J_p and p by -J_q, if its bracket {J, H} + J_t vanishes. Rotations of phase space are of this kind, and what the
angular impulse of point vortices generates.

Symmetries hold for all values of the parameters; one that needs special values is found when these stand in the formula
as numbers. With more than ``MOST_COORDINATES`` coordinates only cyclic ones, and translations, rotations and boosts of
all coordinates together, are tried. A direction or a generator known otherwise is checked by
:func:`~scvi_codegen.mechanics.symmetry.checking.check_symmetry`.

Which are kept exactly, to round-off, by which method: :func:`~scvi_codegen.methods.exactness.Exactness.keeps`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import sympy
from sympy import Expr, Symbol

from scvi_codegen.display.cards import Html, card
from scvi_codegen.display.mathml import mathml
from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.formulas.derivatives import gradient
from scvi_codegen.given.kinds import several, takes
from scvi_codegen.mechanics.hamiltonian import HamiltonianSystem
from scvi_codegen.mechanics.rolled import rolled
from scvi_codegen.mechanics.symmetry.ansatz import (
    Terms,
    bodies_of,
    boost_columns,
    combined,
    independent,
    is_shift,
    monomial_columns,
    polynomial_in,
    rigid_columns,
)
from scvi_codegen.mechanics.symmetry.invariants import Monomial, Polynomial, confirmed, conserved
from scvi_codegen.mechanics.symmetry.names import name_of
from scvi_codegen.mechanics.symmetry.pulls import among_few
from scvi_codegen.mechanics.symmetry.sampling import Rates, rates_of
from scvi_codegen.mechanics.system import SYSTEM, MechanicalSystem

__all__ = ["SYMMETRIES", "Symmetry", "all_symmetries", "symmetries"]

MOST_COORDINATES = 12
MOST_SHOWN = 12
"""Components of a direction that a notebook shows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Symmetry:
    """A direction in which the action does not change, and what it conserves.

    Attributes:
        name: for people: ``"angular momentum z"``, ``"momentum of phi"``, ``"boost of x"``.
        coordinates, momenta, time: the symbols q, p, t of the expressions; ``p_`` and the coordinate for a Lagrangian.
        direction: xi, m expressions in (q, t); dJ/dp, in (q, p, t), of a symmetry of phase space.
        gauge: f, of which the change of L is the time derivative; 0 if L does not change.
        momentum_map: J = p . xi - f.
    """

    name: str
    coordinates: tuple[Symbol, ...]
    momenta: tuple[Symbol, ...]
    time: Symbol
    direction: tuple[Expr, ...]
    gauge: Expr
    momentum_map: Expr

    def __str__(self) -> str:
        return f"{self.name} = {self.formula}"

    @property
    def formula(self) -> str:
        """The momentum map as text, factors and terms in the order in which they are usually written."""
        terms = self._terms()
        if terms is None:
            return str(self.momentum_map)
        terms.sort(key=lambda term: (_sign(term[0]) < 0, [(i, -power) for i, power in term[1].items()]))
        variables = (*self.coordinates, *self.momenta, self.time)
        texts = [_term_text(x, [variables[i] ** power for i, power in powers.items()]) for x, powers in terms]
        return " + ".join(texts).replace("+ -", "- ")

    def _repr_html_(self) -> str:
        moved = [*zip(self.coordinates, self.direction, strict=True)]
        if (
            not set()
            .union(self.gauge.free_symbols, *(xi.free_symbols for xi in self.direction))
            .isdisjoint(self.momenta)
        ):
            slopes = gradient(self.momentum_map, self.coordinates)
            moved += [(p, -slopes.get(i, sympy.S.Zero)) for i, p in enumerate(self.momenta)]
        changes = [f"{mathml(Symbol('delta'))}{mathml(x)} = {mathml(xi)}" for x, xi in moved if xi != 0]
        facts = [("conserves", Html(mathml(self.momentum_map))), ("direction", Html("; ".join(changes[:MOST_SHOWN])))]
        facts += [("gauge", Html(mathml(self.gauge)))] if self.gauge != 0 else []
        return card(f"Symmetry: {self.name}", facts)

    def degrees(self) -> set[tuple[int, int, int]] | None:
        """Degrees in (t, q, p) of the terms of the momentum map, ``None`` if it is not a polynomial."""
        terms, m = self._terms(), len(self.coordinates)
        if terms is None:
            return None
        return {
            (
                powers.get(2 * m, 0),
                sum(power for i, power in powers.items() if i < m),
                sum(power for i, power in powers.items() if m <= i < 2 * m),
            )
            for _, powers in terms
        }

    def _terms(self) -> list[tuple[Expr, dict[int, int]]] | None:
        """Coefficient, and powers by index of (q, p, t), of each term; ``None`` if it is not a polynomial."""
        places = {x: i for i, x in enumerate((*self.coordinates, *self.momenta, self.time))}
        found = _monomials(self.momentum_map, places)
        return _monomials(sympy.expand(self.momentum_map), places) if found is None else found


SYMMETRIES = several("a list of symmetries", Symmetry)
"""For :func:`~scvi_codegen.given.kinds.takes`."""


@takes(system=SYSTEM)
@lru_cache(maxsize=64)
def symmetries(system: MechanicalSystem) -> tuple[Symmetry, ...]:
    """The affine symmetries of a system, a basis with short momentum maps: translations, rotations, boosts, others.

    Affine in q and t of a Lagrangian, in (q, p) and t of a Hamiltonian.

    >>> from scvi_codegen.models.systems import kepler
    >>> print(*symmetries(kepler()))
    angular momentum = q1*p_q2 - q2*p_q1
    """
    return _distinct([_symmetry(system, terms) for terms in _found(system)])


def all_symmetries(system: MechanicalSystem, given: Sequence[Symmetry]) -> tuple[Symmetry, ...]:
    """Those that are found and those that are ``given``.

    Raises:
        SystemDefinitionError: if one given is of another system, or has the name of another one.
    """
    found = (*symmetries(system), *given)
    own = (system.coordinates, system.momentum_symbols)
    for symmetry in given:
        if (symmetry.coordinates, symmetry.momenta) != own:
            raise SystemDefinitionError(
                f"'{symmetry.name}' is a symmetry of another system: check it for '{system.name}' with check_symmetry"
            )
    names = [symmetry.name for symmetry in found]
    for name in names:
        if names.count(name) > 1:
            raise SystemDefinitionError(f"two symmetries are called '{name}': give yours a name of its own")
    return found


def _found(system: MechanicalSystem) -> list[Terms]:
    """The momentum maps as polynomials."""
    if system.dimension > MOST_COORDINATES:
        return _rigid(system)
    motion = rates_of(system)
    if not motion.closed:  # of one-forms p . v with other momenta than the auxiliaries, forces depend on v, too
        return []
    if not isinstance(system, HamiltonianSystem):
        return _spanned(system, motion, curved=False)
    mixed = _spanned(system, motion, curved=True)
    if not system.is_regular or not mixed:
        return independent(mixed)
    return independent(mixed, first=_spanned(system, motion, curved=False), trivial=_energy(system))


def _rigid(system: MechanicalSystem) -> list[Terms]:
    """Those of everything as a whole; of like terms looked for with those of a few bodies, then held against all."""
    parts, columns = rolled(system), list[Polynomial](rigid_columns(system))
    if parts is None:
        return _combined(*_conserved_by(system, rates_of(system), columns))
    motion = rates_of(parts.rest, parts.families)
    of_few = replace(motion, families=among_few(parts.families, bodies_of(system)))
    rows, known = _conserved_by(parts.rest, of_few, columns)
    if not all(confirmed(motion, known, row) for row in rows):
        rows, known = _conserved_by(parts.rest, motion, columns)
    return _combined(rows, known)


def _conserved_by(
    system: MechanicalSystem, motion: Rates, columns: Sequence[Polynomial]
) -> tuple[list[dict[int, Expr]], Sequence[Polynomial]]:
    """Conserved combinations of columns, and of the boosts where there is a translation among them."""
    rows = conserved(system, motion, columns)
    if any(is_shift(columns[min(row)]) for row in rows):
        columns = [*columns, *boost_columns(system, columns)]
        rows = conserved(system, motion, columns)
    return rows, columns


def _combined(rows: Sequence[Mapping[int, Expr]], columns: Sequence[Polynomial]) -> list[Terms]:
    return [terms for terms in (combined(row, columns) for row in rows) if terms]


def _spanned(system: MechanicalSystem, motion: Rates, *, curved: bool) -> list[Terms]:
    """A basis of the conserved polynomials, those in which p has degree 2 among them if ``curved``."""
    columns = list(monomial_columns(system.dimension, curved=curved))
    found = (combined(row, columns) for row in conserved(system, motion, columns, fractions=curved))
    return [terms for terms in found if terms]


def _energy(system: MechanicalSystem) -> list[Terms]:
    """H, if it is a conserved polynomial: no symmetry but time's."""
    places = {x: i for i, x in enumerate((*system.coordinates, *system.momentum_symbols))}
    found = (
        None
        if system.changes_energy or system.formula.has(system.time)
        else _monomials(sympy.expand(system.formula), places)
    )
    if found is None:
        return []
    factors = [(x, tuple(i for i, power in powers.items() for _ in range(power))) for x, powers in found]
    return [{Monomial(0, own): x for x, own in factors}]


def _monomials(expression: Expr, places: Mapping[Symbol, int]) -> list[tuple[Expr, dict[int, int]]] | None:
    """The terms of a sum of monomials."""
    found = []
    for term in sympy.Add.make_args(expression):
        own = [factor.as_base_exp() for factor in sympy.Mul.make_args(term)]
        powers = {places[base]: int(power) for base, power in own if base in places and power.is_Integer and power > 0}
        rest = sympy.Mul(*(base**power for base, power in own if base not in places))
        if len(powers) < sum(base in places for base, _ in own) or not rest.free_symbols.isdisjoint(places):
            return None
        found.append((rest, dict(sorted(powers.items()))))
    return found


def _sign(coefficient: Expr) -> int:
    return -1 if coefficient.could_extract_minus_sign() else 1


def _term_text(coefficient: Expr, factors: list[Expr]) -> str:
    """One term, its sign first."""
    sign = _sign(coefficient)
    numerator, denominator = (sign * coefficient).as_numer_denom()
    if numerator != 1 or not factors:
        factors = [numerator, *factors]
    text = "*".join(f"({factor})" if factor.is_Add else str(factor) for factor in factors)
    divisor = f"({denominator})" if denominator.is_Mul or denominator.is_Add else str(denominator)
    return ("-" if sign < 0 else "") + (text if denominator == 1 else f"{text}/{divisor}")


def _symmetry(system: MechanicalSystem, terms: Terms) -> Symmetry:
    """With its name, the sign that goes with it, and no fractions in the direction at t = 0."""
    m = system.dimension
    name, sign = name_of(system, terms)
    degrees = {monomial: sum(i >= m for i in monomial.factors) for monomial in terms}
    numbers = [x.as_coeff_Mul()[0] for a, x in terms.items() if degrees[a] == 1 and a.power == 0]
    factor = sign * sympy.ilcm(1, 1, *(number.q for number in numbers if number.is_Rational))
    signed = {monomial: factor * coefficient for monomial, coefficient in terms.items()}
    J, p = polynomial_in(system, signed), system.momentum_symbols
    slopes = gradient(J, p)
    return Symmetry(
        name=name,
        coordinates=system.coordinates,
        momenta=p,
        time=system.time,
        direction=tuple(slopes.get(i, sympy.S.Zero) for i in range(m)),
        gauge=polynomial_in(system, {a: (degrees[a] - 1) * x for a, x in signed.items()}),
        momentum_map=J,
    )


def _distinct(found: Sequence[Symmetry]) -> tuple[Symmetry, ...]:
    """With a number after each name that occurred before."""
    seen: dict[str, int] = {}
    named = []
    for symmetry in found:
        count = seen[symmetry.name] = seen.get(symmetry.name, 0) + 1
        named.append(symmetry if count == 1 else replace(symmetry, name=f"{symmetry.name} ({count})"))
    return tuple(named)
