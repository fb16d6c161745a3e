"""Symmetries and what they conserve: Noether's theorem for affine point transformations.

A direction xi(q, t) is a symmetry if moving along it changes L by a total derivative only,

    L_q . xi + L_v . dxi/dt = df/dt,    and then    J = p . xi - f    is conserved,

its momentum map. Searched are xi = A(t) q + b(t) with f quadratic in q: A of degree 1 in t, b of degree 2. That is all
translations, rotations, boosts, and magnetic and uniform fields; a symmetry periodic in time, such as xi = cos(t) of an
oscillator, is not among them, nor one whose f is not quadratic. Where a Hamiltonian is given L is p . v - H; if in
addition velocities do not determine momenta (point vortices), J may be any quadratic polynomial in q and p.

Symmetries hold for all values of the parameters. With more than ``MOST_COORDINATES`` coordinates only cyclic ones,
and translations, rotations and boosts of all coordinates together, are tried. A direction that is known otherwise is
checked by :func:`check_symmetry`.

Which are kept exactly, to round-off, by which method: :func:`is_exact`.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import combinations, combinations_with_replacement
from typing import TypeAlias

import numpy as np
import sympy
from sympy import Expr, Symbol, primerange

from scvi_codegen.bodies import AXES, Body, bodies
from scvi_codegen.derivatives import gradient, jacobian
from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.expression_text import closest, evaluated, parse_expression, unsupported_part
from scvi_codegen.hamiltonian import HamiltonianSystem
from scvi_codegen.invariants import Column, Monomial, conserved
from scvi_codegen.mechanical_system import MechanicalSystem
from scvi_codegen.mechanics import legendre_map
from scvi_codegen.methods.collocation import RungeKutta
from scvi_codegen.methods.galerkin import SVI
from scvi_codegen.methods.method import Method
from scvi_codegen.methods.shooting import SCVI
from scvi_codegen.sampling import momentum_symbols, motion_of
from scvi_codegen.spaces import Polynomials

__all__ = ["Symmetry", "all_symmetries", "check_symmetry", "is_exact", "symmetries"]

Terms: TypeAlias = Mapping[Monomial, Expr]

MOST_COORDINATES = 12
MOST_CYCLIC = 12
LONGEST_SHOWN = 300
NAMED_TERMS = 4


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
        return f"{self.name} = {self.momentum_map}"

    def monomials(self) -> list[tuple[int, int, int]] | None:
        """Degrees in (t, q, p) of the terms of the momentum map, ``None`` if it is not a polynomial."""
        polynomial = self.momentum_map.as_poly(self.time, *self.coordinates, *self.momenta)
        if polynomial is None:
            return None
        m = len(self.coordinates)
        return [(powers[0], sum(powers[1 : m + 1]), sum(powers[m + 1 :])) for powers in polynomial.monoms()]


@lru_cache(maxsize=64)
def symmetries(system: MechanicalSystem) -> tuple[Symmetry, ...]:
    """The affine symmetries of a system, a basis with short momentum maps: translations, rotations, boosts, others.

    >>> from scvi_codegen.problems import kepler
    >>> print(*symmetries(kepler()))
    angular momentum = p_q2*q1 - p_q1*q2
    """
    return _distinct([_symmetry(system, terms) for terms in _found(system)])


def all_symmetries(system: MechanicalSystem, given: Sequence[Symmetry]) -> tuple[Symmetry, ...]:
    """Those that are found and those that are ``given``.

    Raises:
        SystemDefinitionError: if one given is of another system, or has the name of another one.
    """
    found = (*symmetries(system), *given)
    own = (system.coordinates, momentum_symbols(system))
    for symmetry in given:
        if (symmetry.coordinates, symmetry.momenta) != own:
            raise SystemDefinitionError(f"'{symmetry.name}' is no symmetry of '{system.name}': check it with check_symmetry")
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
        gauge: f with L_q . xi + L_v . dxi/dt = df/dt; by default one that is quadratic in q, if there is one.
        name: what the conserved quantity is called.

    Raises:
        SystemDefinitionError: with the change of L, if it is not the time derivative of f; naming the symbol, if one
            is unknown.

    >>> from scvi_codegen.problems import kepler
    >>> print(check_symmetry(kepler(), ["-q2", "q1"]))
    given symmetry = p_q2*q1 - p_q1*q2
    """
    if isinstance(direction, str) or len(direction) != system.dimension:
        names = ", ".join(q.name for q in system.coordinates)
        raise SystemDefinitionError(f"a direction has {system.dimension} components, one for each of {names}")
    xi = tuple(_expression(system, component) for component in direction)
    f = None if gauge is None else _expression(system, gauge)
    p, q, t = momentum_symbols(system), system.coordinates, system.time
    product = sympy.Add(*(a * b for a, b in zip(p, xi, strict=True)), -(f or 0))
    quadratic = system.dimension <= MOST_COORDINATES
    gauges = list(_gauge_columns(system.dimension, quadratic=quadratic)) if f is None else []
    rows = [row for row in conserved(system, motion_of(system), [product, *gauges]) if 0 in row]
    if not rows:
        raise SystemDefinitionError(_defect(system, xi, f, product))
    terms = _combined({c: x / rows[0][0] for c, x in rows[0].items() if c}, [product, *gauges])
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


def is_exact(symmetry: Symmetry, method: Method) -> bool:
    """Whether the method conserves the momentum map exactly, that is to round-off, for every step.

    A variational method of degree s does if the symmetry maps its curves to each other (A constant, b of degree s in
    t) and its quadrature is exact for df/dt along them (of degree d s + k - 1 for terms t^k q^d of f): then L_d changes
    by what f does from end to end. Runge-Kutta methods in phase space conserve what is linear in (t, q, p), symplectic
    ones what is quadratic. Of other methods nothing is claimed.
    """
    terms = symmetry.monomials()
    if terms is None:
        return False
    if max(sum(powers) for powers in terms) <= _conserved_degree(method):
        return True
    degree, order = _curves(method)
    return all(_is_kept(k, d, e, degree, order) for k, d, e in terms)


def _is_kept(k: int, d: int, e: int, degree: int, order: int) -> bool:
    """Whether a term t^k q^d p^e is one of the direction (e = 1) or gauge (e = 0) that the curves allow."""
    if e == 0:
        return d * degree + k <= order
    return e == 1 and ((d == 0 and k <= degree) or (d == 1 and k == 0 <= degree))


def _conserved_degree(method: Method) -> int:
    """Degree of the polynomials in (t, q, p) that are conserved exactly whenever they are conserved."""
    if isinstance(method, RungeKutta) and method.form == "phase-space":
        return 2 if method.symplectic else 1
    gauss = isinstance(method, SVI) and isinstance(method.curves, Polynomials) and len(method.rule) == method.degree
    return 2 if gauss and method.rule.order == 2 * method.degree else 0


def _curves(method: Method) -> tuple[int, int]:
    """Degree of the curves and order of the quadrature of a variational method; (-1, -1) for others."""
    if not method.symplectic:
        return -1, -1
    if isinstance(method, RungeKutta):
        stages = len(method.tableau.b)
        return (stages, 2 * stages) if method.tableau.order == 2 * stages else (-1, -1)
    if isinstance(method, SVI):
        return (method.degree, method.rule.order) if isinstance(method.curves, Polynomials) else (0, -1)
    if isinstance(method, SCVI):
        return method.degree, method.rule.order
    return 1, 2


def _found(system: MechanicalSystem) -> list[Terms]:
    """The momentum maps as polynomials."""
    motion, curved = motion_of(system), _is_curved(system)
    if system.dimension <= MOST_COORDINATES:
        columns = list(_columns(system.dimension, curved=curved))
    else:
        columns = list(_rigid_columns(system))
        rows = conserved(system, motion, columns)
        if not any(_is_shift(columns[min(row)]) for row in rows):
            return [_combined(row, columns) for row in rows]
        columns += _boost_columns(system, columns)
    found = [_combined(row, columns) for row in conserved(system, motion, columns, fractions=curved)]
    return _independent(found) if curved else found


def _is_curved(system: MechanicalSystem) -> bool:
    """Whether momenta are coordinates like others: a Hamiltonian without a Lagrangian."""
    return isinstance(system, HamiltonianSystem) and not system.is_regular


def _columns(m: int, *, curved: bool) -> Iterator[dict[Monomial, int]]:
    """All monomials of the ansatz, those first that are to occur in few momentum maps."""
    q, p = range(m), range(m, 2 * m)
    planes = sorted(combinations(q, 2), reverse=True)
    turns = [*planes, *((i, i) for i in q), *((j, i) for i, j in planes)]
    factors: list[tuple[int, tuple[int, ...]]] = [(0, (i,)) for i in p]
    factors += [(0, (i,)) for i in q] * curved
    factors += [(0, (i, m + j)) for i, j in turns]
    factors += [(k, pair) for k in (0, 1) for pair in (*combinations(p, 2), *((i, i) for i in p))] * curved
    factors += [(k, (i,)) for k in (1, 2) for i in p]
    factors += [(1, (i, m + j)) for i, j in turns]
    columns = [{Monomial(*factor): 1} for factor in factors]
    yield from columns
    yield from (column for column in _gauge_columns(m, quadratic=True) if column not in columns)


def _gauge_columns(m: int, *, quadratic: bool) -> Iterator[dict[Monomial, int]]:
    """Monomials of f: of degree 2 in q (1 in t), 1 in q (3 in t), 0 in q (4 in t)."""
    q = range(m)
    yield from ({Monomial(k, (i,)): 1} for k in range(4) for i in q)
    pairs = (*combinations(q, 2), *((i, i) for i in q)) if quadratic else ()
    yield from ({Monomial(k, pair): 1} for k in (0, 1) for pair in pairs)
    yield from ({Monomial(k, ()): 1} for k in range(1, 5))


def _rigid_columns(system: MechanicalSystem) -> Iterator[dict[Monomial, int]]:
    """Momenta of cyclic coordinates, translations and rotations of everything, and t."""
    m, free = system.dimension, system.formula.free_symbols
    cyclic = [i for i, q in enumerate(system.coordinates) if q not in free][:MOST_CYCLIC]
    yield from ({Monomial(0, (m + i,)): 1} for i in cyclic)
    found = _bodies(system)
    groups = zip(*(body.columns for body in found), strict=True) if found else [range(m)]
    yield from ({Monomial(0, (m + i,)): 1 for i in group} for group in groups)
    yield from (_turn(m, found, plane) for plane in _planes(found))
    yield {Monomial(1, ()): 1}


def _is_shift(column: Mapping[Monomial, int]) -> bool:
    return all(len(monomial.factors) == 1 for monomial in column)


def _boost_columns(system: MechanicalSystem, rigid: Sequence[Mapping[Monomial, int]]) -> list[dict[Monomial, int]]:
    """The translations among the columns times t, positions to go with them, and t^2."""
    shifts = [column for column in rigid if _is_shift(column)]
    moving = [{Monomial(1, monomial.factors): x for monomial, x in column.items()} for column in shifts]
    positions = [{Monomial(k, (i,)): 1} for k in (0, 1) for i in range(system.dimension)]
    return [*moving, *positions, {Monomial(2, ()): 1}]


def _bodies(system: MechanicalSystem) -> tuple[Body, ...]:
    """Bodies by names such as jupiter_x, x_jupiter or x1; two or three coordinates with other names are one body."""
    names = [q.name for q in system.coordinates]
    swapped = [re.sub(r"^([xyz])_?(\w+)$", r"\2_\1", name) for name in names]
    alone = (Body(name="", columns=tuple(range(len(names)))),) if 2 <= len(names) <= 3 else ()
    return bodies(names) or bodies(swapped) or alone


def _planes(found: Sequence[Body]) -> list[tuple[int, int]]:
    """Pairs of axes, in the sense of a right-handed rotation: about x, y, z; or the one of the plane."""
    size = len(found[0].columns) if found else 0
    return [(1, 2), (2, 0), (0, 1)] if size == 3 else [(0, 1)] if size == 2 else []


def _turn(m: int, found: Sequence[Body], plane: tuple[int, int]) -> dict[Monomial, int]:
    """The angular momentum of all bodies."""
    pairs = [(body.columns[plane[0]], body.columns[plane[1]]) for body in found]
    return {Monomial(0, (i, m + j)): 1 for i, j in pairs} | {Monomial(0, (j, m + i)): -1 for i, j in pairs}


def _combined(row: Mapping[int, Expr], columns: Sequence[Column]) -> Terms:
    """A combination of polynomials."""
    terms: dict[Monomial, Expr] = {}
    for c, coefficient in row.items():
        column = columns[c]
        assert not isinstance(column, Expr)
        for monomial, factor in column.items():
            terms[monomial] = terms.get(monomial, sympy.S.Zero) + factor * coefficient
    return {monomial: coefficient for monomial, coefficient in terms.items() if coefficient != 0}


def _independent(found: list[Terms]) -> list[Terms]:
    """Without those that are products of linear ones; ``found`` spans the products that it has."""
    linear = [terms for terms in found if all(len(monomial.factors) <= 1 for monomial in terms)]
    kept, known = list(linear), [*linear, *(_product(a, b) for a, b in combinations_with_replacement(linear, 2))]
    rank = _rank(known)
    for terms in sorted((terms for terms in found if terms not in linear), key=len):
        if _rank([*known, terms]) > rank:
            kept, known, rank = [*kept, terms], [*known, terms], rank + 1
    return kept


def _product(a: Terms, b: Terms) -> Terms:
    product: dict[Monomial, Expr] = {}
    for (one, x), (other, y) in itertools.product(a.items(), b.items()):
        both = Monomial(one.power + other.power, tuple(sorted(one.factors + other.factors)))
        product[both] = product.get(both, sympy.S.Zero) + x * y
    return product


def _rank(found: Sequence[Terms]) -> int:
    """Of polynomials, with numbers in place of the parameters."""
    places = {monomial: k for k, monomial in enumerate({monomial: None for terms in found for monomial in terms})}
    constants = sorted(set().union(*(x.free_symbols for terms in found for x in terms.values())), key=str)
    numbers = {constant: sympy.Rational(prime, 7) for constant, prime in zip(constants, primerange(11, 10**4))}
    matrix = np.zeros((len(found), len(places)))
    for k, terms in enumerate(found):
        for monomial, coefficient in terms.items():
            matrix[k, places[monomial]] = float(coefficient.xreplace(numbers))
    return int(np.linalg.matrix_rank(matrix))


def _polynomial(system: MechanicalSystem, terms: Terms) -> Expr:
    """In the symbols of the system."""
    state = (*system.coordinates, *momentum_symbols(system))
    return sympy.Add(
        *(
            sympy.Mul(coefficient, system.time**monomial.power, *(state[i] for i in monomial.factors))
            for monomial, coefficient in terms.items()
        )
    )


def _symmetry(system: MechanicalSystem, terms: Terms) -> Symmetry:
    """With its name, and the sign that goes with it."""
    m = system.dimension
    name, sign = _name(system, terms)
    signed = {monomial: sign * coefficient for monomial, coefficient in terms.items()}
    degrees = {monomial: sum(i >= m for i in monomial.factors) for monomial in signed}
    J, p = _polynomial(system, signed), momentum_symbols(system)
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


def _name(system: MechanicalSystem, terms: Terms) -> tuple[str, int]:
    """What the momentum map is called, and with which sign."""
    m = system.dimension
    turning = {a: x for a, x in terms.items() if len(a.factors) == 2 and a.factors[0] < m <= a.factors[1]}
    shifting = {
        k: {a.factors[0] - m: x for a, x in terms.items() if a.power == k and len(a.factors) == 1 and a.factors[0] >= m}
        for k in (0, 1, 2)
    }
    if turning:
        return _turning_name(system, turning)
    for k, kind in enumerate(("momentum", "boost", "acceleration")):
        if shifting[k]:
            return _shifting_name(system, kind, shifting[k]), -1 if k else 1
    return ("linear" if all(len(a.factors) <= 1 for a in terms) else "quadratic") + " invariant", 1


def _turning_name(system: MechanicalSystem, turning: Terms) -> tuple[str, int]:
    m, found = system.dimension, _bodies(system)
    for plane in _planes(found):
        turn = _turn(m, found, plane)
        axis = f" {AXES[3 - sum(plane)]}" if len(found[0].columns) == 3 else ""
        first = turning.get(next(iter(turn)), sympy.S.Zero)
        if turning == {monomial: first * x for monomial, x in turn.items()}:
            return f"angular momentum{axis}", -1 if first.could_extract_minus_sign() else 1
    q = [coordinate.name for coordinate in system.coordinates]
    touched = sorted({i % m for a in turning for i in a.factors})
    what = "angular momentum" if all(a.factors[0] != a.factors[1] - m for a in turning) else "scaling"
    return f"{what} of {_listed([q[i] for i in touched])}", 1


def _shifting_name(system: MechanicalSystem, kind: str, shifts: Mapping[int, Expr]) -> str:
    """``momentum of x``, ``linear momentum x`` of all bodies, ``momentum of q1 + q3``; the same for boosts."""
    found, equal = _bodies(system), set(shifts.values()) == {sympy.S.One}
    if len(found) > 1 and equal:
        for k, axis in enumerate(AXES[: len(found[0].columns)]):
            if set(shifts) == {body.columns[k] for body in found}:
                return f"{'linear momentum' if kind == 'momentum' else kind} {axis}"
    if equal and len(shifts) == system.dimension > 1:
        return f"{kind} of all coordinates"
    terms = [x * system.coordinates[i] for i, x in sorted(shifts.items())]
    return f"{kind} of {_joined([str(term) for term in terms])}"


def _listed(names: Sequence[str]) -> str:
    shown = names if len(names) <= NAMED_TERMS else [*names[: NAMED_TERMS - 1], "...", names[-1]]
    return ", ".join(shown)


def _joined(terms: Sequence[str]) -> str:
    shown = terms if len(terms) <= NAMED_TERMS else [*terms[: NAMED_TERMS - 1], "...", terms[-1]]
    return " + ".join(shown).replace("+ -", "- ")


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


def _defect(system: MechanicalSystem, xi: Sequence[Expr], f: Expr | None, product: Expr) -> str:
    """What L changes by along a direction that is no symmetry."""
    change = _change(system, xi)
    shown = str(change)
    shown = f" by {shown}" if len(shown) <= LONGEST_SHOWN else ""
    reason = (
        f"which is not the time derivative of {f}"
        if f is not None
        else "which is not the time derivative of a function f that is quadratic in the coordinates; another f can be given "
        "as gauge"
    )
    return f"({', '.join(map(str, xi))}) is no symmetry of '{system.name}': along it L changes{shown}, {reason}"


def _change(system: MechanicalSystem, xi: Sequence[Expr]) -> Expr:
    """L_q . xi + L_v . dxi/dt; of a Hamiltonian the rate of p . xi."""
    _, transformed = legendre_map(system)
    v = transformed if system.auxiliaries else system.velocities
    p = system.auxiliaries or transformed
    slopes = gradient(system.formula, system.coordinates)
    sign = -1 if system.auxiliaries else 1
    terms = [sign * slope * xi[i] for i, slope in slopes.items()]
    for (i, j), slope in jacobian(xi, (*system.coordinates, system.time)).items():
        terms.append(p[i] * slope * (*v, sympy.S.One)[j])
    return sympy.Add(*terms)
