"""Symmetries and what they conserve: Noether's theorem for affine point transformations.

A direction xi(q, t) is a symmetry if moving along it changes L by a total derivative only,

    L_q . xi + L_v . dxi/dt = df/dt,    and then    J = p . xi - f    is conserved,

its momentum map. Searched are xi = A(t) q + b(t) with f quadratic in q: A of degree 1 in t, b of degree 2. That is all
translations, rotations, boosts, and magnetic and uniform fields; a symmetry periodic in time, such as xi = cos(t) of an
oscillator, is not among them, nor one whose f is not quadratic. Where a Hamiltonian is given L is p . v - H; if in
addition velocities do not determine momenta (point vortices), J may be any quadratic polynomial in q and p.

Symmetries hold for all values of the parameters; one that needs special values is found when these stand in the formula
as numbers. With more than ``MOST_COORDINATES`` coordinates only cyclic ones, and translations, rotations and boosts of
all coordinates together, are tried. A direction that is known otherwise is checked by :func:`check_symmetry`.

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
from scvi_codegen.errors import SystemDefinitionError, closest
from scvi_codegen.formulas.canonical import evaluated, unsupported_part
from scvi_codegen.formulas.derivatives import gradient
from scvi_codegen.formulas.grammar import parse_expression
from scvi_codegen.mechanics.forms import forms_of
from scvi_codegen.mechanics.hamiltonian import HamiltonianSystem
from scvi_codegen.mechanics.symmetry.ansatz import (
    Terms,
    boost_columns,
    combined,
    gauge_columns,
    independent,
    is_shift,
    monomial_columns,
    rigid_columns,
)
from scvi_codegen.mechanics.symmetry.gauge import integrated, is_total_derivative
from scvi_codegen.mechanics.symmetry.invariants import Polynomial, conserved
from scvi_codegen.mechanics.symmetry.names import name_of
from scvi_codegen.mechanics.symmetry.sampling import rates_of
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.tables.precision import mp

__all__ = ["Symmetry", "all_symmetries", "check_symmetry", "symmetries"]

MOST_COORDINATES = 12
LONGEST_SHOWN = 300
DECIDED_AT = 3
"""Points at which the change of L is looked at."""


MOST_SHOWN = 12
"""Components of a direction that a notebook shows."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Symmetry:
    """A direction in which the action does not change, and what it conserves.

    Attributes:
        name: for people: ``"angular momentum z"``, ``"momentum of phi"``, ``"boost of x"``.
        coordinates, momenta, time: the symbols q, p, t of the expressions; ``p_`` and the coordinate for a Lagrangian.
        direction: xi, m expressions in (q, t), or in (q, p, t) where a Hamiltonian without Lagrangian is given.
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
        moved = zip(self.coordinates, self.direction, strict=True)
        changes = [f"{mathml(Symbol('delta'))}{mathml(q)} = {mathml(xi)}" for q, xi in moved if xi != 0]
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


@lru_cache(maxsize=64)
def symmetries(system: MechanicalSystem) -> tuple[Symmetry, ...]:
    """The affine symmetries of a system, a basis with short momentum maps: translations, rotations, boosts, others.

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


def check_symmetry(
    system: MechanicalSystem,
    direction: Sequence[Expr | str],
    *,
    gauge: Expr | str | None = None,
    name: str = "given symmetry",
) -> Symmetry:
    """The symmetry with a direction of the user's, whatever its form, if it is one.

    Args:
        system: what moves.
        direction: xi, m expressions in coordinates, time and parameters, as SymPy or as text.
        gauge: f with L_q . xi + L_v . dxi/dt = df/dt; left out, it is searched among those quadratic in q and, of a
            Lagrangian, integrated.
        name: what the conserved quantity is called.

    Raises:
        SystemDefinitionError: with the change of L, if it is not the time derivative of f, or if that is not decided;
            naming the symbol, if one is unknown.

    >>> from scvi_codegen.models.systems import kepler
    >>> print(check_symmetry(kepler(), ["-q2", "q1"]))
    given symmetry = q1*p_q2 - q2*p_q1
    """
    if isinstance(direction, str) or len(direction) != system.dimension:
        names = ", ".join(q.name for q in system.coordinates)
        raise SystemDefinitionError(f"a direction has {system.dimension} components, one for each of {names}")
    xi = tuple(_expression(system, component) for component in direction)
    f = None if gauge is None else _expression(system, gauge)
    p, q, t = system.momentum_symbols, system.coordinates, system.time
    product = sympy.Add(*(a * b for a, b in zip(p, xi, strict=True)), -(f or 0))
    quadratic = system.dimension <= MOST_COORDINATES
    gauges = list(gauge_columns(system.dimension, quadratic=quadratic)) if f is None else []
    rows = [row for row in conserved(system, rates_of(system), [product, *gauges]) if 0 in row]
    if not rows and f is None and not system.auxiliaries:
        f = _integrated_gauge(system, xi)
        product, gauges, rows = product - f, [], [{0: sympy.S.One}]
    if not rows:
        raise SystemDefinitionError(_defect(system, xi, f))
    terms = combined({c: x / rows[0][0] for c, x in rows[0].items() if c}, [product, *gauges])
    added = _polynomial(system, terms)
    return Symmetry(
        name=name,
        coordinates=q,
        momenta=p,
        time=t,
        direction=xi,
        gauge=(f or sympy.S.Zero) - added,
        momentum_map=product + added,
    )


def _integrated_gauge(system: MechanicalSystem, xi: Sequence[Expr]) -> Expr:
    """The f of a direction whose f is not quadratic."""
    change, motion = _change(system, xi), rates_of(system)
    f = integrated(system, change)
    if f is not None:
        product = sympy.Add(*(a * b for a, b in zip(system.momentum_symbols, xi, strict=True)), -f)
        if conserved(system, motion, [product]):
            return f
    parameters = {x: mp.mpf(value) for x, value in motion.constants.items()}
    if is_total_derivative(system, change, motion.points(parameters, DECIDED_AT)) is False:
        raise SystemDefinitionError(_defect(system, xi, None))
    raise SystemDefinitionError(
        f"whether ({', '.join(map(str, xi))}) is a symmetry of '{system.name}' is not decided: along it L changes by "
        f"{_cut(change)}, whose f was not found; give it as gauge"
    )


def _found(system: MechanicalSystem) -> list[Terms]:
    """The momentum maps as polynomials."""
    motion, curved = rates_of(system), _is_curved(system)
    if system.dimension <= MOST_COORDINATES:
        columns: list[Polynomial] = list(monomial_columns(system.dimension, curved=curved))
    else:
        columns = list(rigid_columns(system))
        if any(is_shift(columns[min(row)]) for row in conserved(system, motion, columns)):
            columns += boost_columns(system, columns)
    found = [combined(row, columns) for row in conserved(system, motion, columns, fractions=curved)]
    return independent(found) if curved else [terms for terms in found if terms]


def _is_curved(system: MechanicalSystem) -> bool:
    """Whether momenta are coordinates like others: a Hamiltonian without a Lagrangian."""
    return isinstance(system, HamiltonianSystem) and not system.is_regular


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


def _polynomial(system: MechanicalSystem, terms: Terms) -> Expr:
    """In the symbols of the system."""
    state = (*system.coordinates, *system.momentum_symbols)
    return sympy.Add(
        *(
            sympy.Mul(coefficient, system.time**monomial.power, *(state[i] for i in monomial.factors))
            for monomial, coefficient in terms.items()
        )
    )


def _symmetry(system: MechanicalSystem, terms: Terms) -> Symmetry:
    """With its name, the sign that goes with it, and no fractions in the direction at t = 0."""
    m = system.dimension
    name, sign = name_of(system, terms)
    degrees = {monomial: sum(i >= m for i in monomial.factors) for monomial in terms}
    numbers = [x.as_coeff_Mul()[0] for a, x in terms.items() if degrees[a] == 1 and a.power == 0]
    factor = sign * sympy.ilcm(1, 1, *(number.q for number in numbers if number.is_Rational))
    signed = {monomial: factor * coefficient for monomial, coefficient in terms.items()}
    J, p = _polynomial(system, signed), system.momentum_symbols
    slopes = gradient(J, p)
    return Symmetry(
        name=name,
        coordinates=system.coordinates,
        momenta=p,
        time=system.time,
        direction=tuple(slopes.get(i, sympy.S.Zero) for i in range(m)),
        gauge=_polynomial(system, {a: (degrees[a] - 1) * x for a, x in signed.items()}),
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


def _expression(system: MechanicalSystem, given: Expr | str) -> Expr:
    """A function of coordinates, time and parameters, from text or SymPy."""
    known = {x.name: x for x in (*system.coordinates, system.time, *system.parameters)}
    if isinstance(given, str):
        return parse_expression(given, known)
    expression = sympy.sympify(given) if isinstance(given, int | float) else given
    if not isinstance(expression, Expr):
        raise SystemDefinitionError(f"a component of a direction is text or a SymPy expression, not {given!r}")
    unknown = sorted(free.name for free in expression.free_symbols if free.name not in known)
    if unknown:
        raise SystemDefinitionError(
            f"'{unknown[0]}' is not a coordinate, time or parameter of '{system.name}'{closest(unknown[0], known)} "
            "Directions and gauges depend on nothing else"
        )
    expression = evaluated(expression, {free: known[free.name] for free in expression.free_symbols})
    problem = unsupported_part(expression)
    if problem:
        raise SystemDefinitionError(f"in a direction or gauge: {problem}")
    return expression


def _defect(system: MechanicalSystem, xi: Sequence[Expr], f: Expr | None) -> str:
    """What L changes by along a direction that is no symmetry."""
    change, what = _change(system, xi), "along it L changes by"
    if f is None:
        searched = "a polynomial f quadratic in q; any other f can be given as gauge"
        reason = f"not the time derivative of {searched if system.auxiliaries else 'any f(q, t)'}"
    else:
        change, what = change - _rate(system, f), "the change of L is not the derivative of the gauge but differs by"
        reason = "not 0"
    return f"({', '.join(map(str, xi))}) is no symmetry of '{system.name}': {what} {_cut(change)}, {reason}"


def _cut(change: Expr) -> str:
    text = str(change)
    return text if len(text) <= LONGEST_SHOWN else f"{text[:LONGEST_SHOWN]} ..."


def _change(system: MechanicalSystem, xi: Sequence[Expr]) -> Expr:
    """L_q . xi + L_v . dxi/dt; of a Hamiltonian the rate of p . xi."""
    p = system.auxiliaries or forms_of(system).legendre
    sign = -1 if system.auxiliaries else 1
    terms = [sign * slope * xi[i] for i, slope in gradient(system.formula, system.coordinates).items()]
    return sympy.Add(*terms, *(momentum * _rate(system, component) for momentum, component in zip(p, xi, strict=True)))


def _rate(system: MechanicalSystem, f: Expr) -> Expr:
    """f_t + f_q . v, with v = H_p of a Hamiltonian."""
    v = forms_of(system).legendre if system.auxiliaries else system.velocities
    slopes = gradient(f, (*system.coordinates, system.time))
    return sympy.Add(*(slope * (*v, sympy.S.One)[i] for i, slope in slopes.items()))
