"""Elimination of holonomic constraints: point masses on rigid rods in a plane, described by the angles of the rods.

A rod of length l from a support (A, B) to the point (x, y) is the constraint k ((x - A)^2 + (y - B)^2 - l^2) = 0. It
holds identically in the angle a with x = A + l sin a, y = B - l cos a, which is 0 where the rod points along -y. Rods
that form trees replace two coordinates by one and one constraint by none; a rod that closes a loop stays a constraint
of the angles. For points of constant mass on rods of constant length, |v|^2 is the sum over the rods j, k that carry
it of l_j l_k cos(a_j - a_k) a_j' a_k', in which terms are collected by pairs of rods (for two rods: L. D. Landau and
E. M. Lifshitz, *Mechanics*, section 5, problem 1).
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from typing import Any, NamedTuple

import numpy as np
import sympy
from numpy.typing import ArrayLike, NDArray
from sympy import Expr, Symbol

from scvi_codegen.common.errors import StateError, SystemDefinitionError
from scvi_codegen.common.representation import summary
from scvi_codegen.common.validation import checks_arguments
from scvi_codegen.systems.arrays.system import SYSTEM_OR_ARRAYS, ArraySystem
from scvi_codegen.systems.constraints import kind_of
from scvi_codegen.systems.constraints.holonomic import HOLONOMIC
from scvi_codegen.systems.derived_systems import in_other_coordinates, rate_of
from scvi_codegen.systems.formulas.expressions import gradient, gradient_tuple
from scvi_codegen.systems.formulas.numpy_values import array_value
from scvi_codegen.systems.formulas.symbols import DOT, input_parameters, symbol
from scvi_codegen.systems.lagrangian import LagrangianSystem
from scvi_codegen.systems.rolling import unroll_sums
from scvi_codegen.systems.system import MechanicalSystem

Array = NDArray[np.float64]
LARGEST_VIOLATION = 1e-6
"""Largest relative violation of a rod by initial values, that of typed numbers; smaller ones vanish in the angles."""


class Rod(NamedTuple):
    """Rod from the support (A, B) to the point (x, y), in the original coordinates.

    Attributes:
        constraint: its number in the original system.
        x, y: coordinates that its angle replaces.
        support: A and B, expressions in other coordinates, parameters and time.
        length: l, an expression in parameters and time.
        angle: the angle.
    """

    constraint: int
    x: Symbol
    y: Symbol
    support: tuple[Expr, Expr]
    length: Expr
    angle: Symbol


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class EliminatedRods:
    """Maps between a system with constraints and the same system in the angles of its rods.

    Attributes:
        original: the system with constraints.
        rods: the rods that became angles, each after the rods that carry it.
        positions: the original coordinates as expressions in the new ones, parallel to ``original.coordinates``.
        remaining: reason why it remains, by the text of each remaining constraint.
    """

    original: LagrangianSystem
    rods: tuple[Rod, ...]
    positions: tuple[Expr, ...]
    remaining: Mapping[str, str]

    __repr__ = summary("original", "rods", "remaining")

    @property
    def coordinates(self) -> tuple[Symbol, ...]:
        """The new coordinates: angles in the place of x, without y, and those of points without a rod."""
        replaced = {rod.x: rod.angle for rod in self.rods}
        dropped = {rod.y for rod in self.rods}
        return tuple(replaced.get(q, q) for q in self.original.coordinates if q not in dropped)

    @property
    def replaced(self) -> dict[Symbol, Expr]:
        """Coordinates that became expressions, and their velocities, as expressions in the new coordinates."""
        new, time = self.coordinates, self.original.time
        moved = {q: f for q, f in zip(self.original.coordinates, self.positions, strict=True) if q != f}
        return {**moved, **{symbol(q.name + DOT): rate_of(f, new, time) for q, f in moved.items()}}

    def to_original(
        self, q: ArrayLike, velocity: ArrayLike, t: ArrayLike = 0.0, parameters: Mapping[str, float] | None = None
    ) -> tuple[Array, Array]:
        """Return states (q, p) of the original system, at which its ``multipliers`` are the forces in the joints.

        Args:
            q, velocity: (m,) coordinates and velocities of the system in angles, or (n, m) of a trajectory.
            t: time, or (n,) times.
            parameters: values by name; others have the default values of the system.

        Returns:
            (m0,) or (n, m0) coordinates and momenta in the order of ``original.coordinates``.
        """
        velocities = self.replaced
        known = self._known(self.coordinates, q, velocity, t, parameters)
        position = self._values(self.positions, known)
        rates = [velocities.get(v, v) for v in self.original.velocities]
        speed = self._values(rates, known)
        original = self._known(self.original.coordinates, position, speed, t, parameters)
        momenta = gradient_tuple(self.original.lagrangian, self.original.velocities)
        return position, self._values(momenta, original)

    def from_original(
        self,
        q: ArrayLike,
        p: ArrayLike | None = None,
        *,
        velocity: ArrayLike | None = None,
        t: float = 0.0,
        parameters: Mapping[str, float] | None = None,
    ) -> dict[str, Any]:
        """Return the initial state in angles, ``{"q": .., "p": ..}`` or ``{"q": .., "velocity": ..}``.

        Angles are between -pi and pi.

        Args:
            q: (m0,) coordinates of the original system.
            p, velocity: (m0,) momenta, or velocities; one of them.
            t, parameters: as of :meth:`to_original`.

        Raises:
            StateError: naming the constraint that the state violates.
        """
        if (p is None) == (velocity is None):
            raise StateError("from_original: give either p (momenta) or velocity of the original system")
        moving = velocity if velocity is not None else self._velocities(q, p, t, parameters)
        known = self._known(self.original.coordinates, q, moving, t, parameters)
        for rod in self.rods:
            known |= self._angle(rod, known)
        new = np.array([known[each] for each in self.coordinates])
        rates = np.array([known[symbol(each.name + DOT)] for each in self.coordinates])
        if p is None:
            return {"q": new, "velocity": rates}
        known = self._known(self.coordinates, new, rates, t, parameters)
        derivatives = [gradient(f, self.coordinates) for f in self.positions]
        p_new = np.zeros(len(new))
        for k, row in enumerate(derivatives):
            for i, derivative in row.items():
                p_new[i] += array_value(derivative, known) * np.asarray(p, dtype=float)[k]
        return {"q": new, "p": p_new}

    def _angle(self, rod: Rod, known: dict[Expr, Any]) -> dict[Expr, Any]:
        """Return the values of the angle of a rod and its rate; raise if it has another length."""
        coordinates, time = self.original.coordinates, self.original.time
        values = dict(known)
        x, y = known[rod.x], known[rod.y]
        a, b = (array_value(f, values) for f in rod.support)
        length = array_value(rod.length, values)
        here, text = (x - a, y - b), self.original.constraint_texts[rod.constraint]
        if not abs(np.hypot(*here) / abs(length) - 1.0) <= LARGEST_VIOLATION:
            raise StateError(
                f"the initial values violate the constraint '{text}': the distance of ({rod.x}, {rod.y}) = ({x:.9g}, "
                f"{y:.9g}) from ({a:.9g}, {b:.9g}) is {np.hypot(*here):.9g} and must be {abs(length):.9g}. Change one "
                "of them, or use project(q, p) of a stepper of the original system for the nearest consistent state"
            )
        sine, minus_cosine = here[0] / length, here[1] / length
        sine, cosine = np.array([sine, -minus_cosine]) / np.hypot(sine, minus_cosine)
        rates = [array_value(rate_of(f, coordinates, time), values) for f in (*rod.support, rod.length)]
        u, v = known[symbol(rod.x.name + DOT)], known[symbol(rod.y.name + DOT)]
        along = (u - rates[0]) * sine - (v - rates[1]) * cosine - rates[2]
        size = max(map(abs, (u, v, *rates)))
        if not abs(along) <= LARGEST_VIOLATION * size:
            raise StateError(
                f"the initial velocities violate the constraint '{text}': its length would change at the rate "
                f"{along:.3g}. Change the velocities of {rod.x} and {rod.y}, or use project(q, p) of a stepper of the "
                "original system for the nearest consistent state"
            )
        rate = ((u - rates[0]) * cosine + (v - rates[1]) * sine) / length
        return {rod.angle: np.arctan2(sine, cosine), symbol(rod.angle.name + DOT): rate}

    def _velocities(self, q: ArrayLike, p: ArrayLike | None, t: float, parameters: Any) -> Array:
        """Return the velocities with these momenta, by Newton's iteration from rest (one step for a quadratic L)."""
        momenta = gradient_tuple(self.original.lagrangian, self.original.velocities)
        mass = [gradient_tuple(each, self.original.velocities) for each in momenta]
        v = np.zeros(self.original.dimension)
        wanted = np.asarray(p, dtype=float)
        for _ in range(50):
            known = self._known(self.original.coordinates, q, v, t, parameters)
            residual = wanted - self._values(momenta, known)
            change = np.linalg.solve(np.array([self._values(row, known) for row in mass]), residual)
            v = v + change
            if np.abs(change).max() <= 1e-14 * np.abs(v).max():
                return v
        raise StateError(f"no velocities of '{self.original.name}' have the momenta {p!r}: give velocity instead")

    def _known(self, names: Sequence[Symbol], q: Any, v: Any, t: Any, parameters: Any) -> dict[Expr, Any]:
        """Return the values of all symbols: coordinates along the last axis."""
        arrays = [np.asarray(each, dtype=float) for each in (q, v)]
        for what, array in zip(("q", "velocity"), arrays, strict=True):
            if array.ndim not in (1, 2) or array.shape[-1] != len(names):
                raise StateError(f"{what} has shape {array.shape}: its last axis must be {', '.join(map(str, names))}")
        constants: dict[str, float] = {each.name: value for each, value in self.original.constants.items()}
        if unknown := sorted({*(parameters or ())} - {*constants}):
            raise StateError(f"'{self.original.name}' has no parameter '{unknown[0]}': it has {', '.join(constants)}")
        known: dict[Expr, Any] = {symbol(name): x for name, x in (constants | dict(parameters or {})).items()}
        known[self.original.time] = np.asarray(t, dtype=float)
        for array, suffix in zip(arrays, ("", DOT), strict=True):
            known |= {symbol(each.name + suffix): x for each, x in zip(names, np.moveaxis(array, -1, 0), strict=True)}
        return known

    @staticmethod
    def _values(expressions: Sequence[Expr], known: dict[Expr, Any]) -> Array:
        values = dict(known)
        rows = [np.asarray(array_value(each, values), dtype=float) for each in expressions]
        return np.stack(np.broadcast_arrays(*rows), axis=-1)


@checks_arguments(system=SYSTEM_OR_ARRAYS)
def eliminate_constraints(
    system: MechanicalSystem | ArraySystem,
    *,
    sizes: Mapping[str, int] | None = None,
    tables: Mapping[str, ArrayLike] | None = None,
) -> LagrangianSystem:
    """Return the system with the angles of its rods as coordinates, and without the constraints that they satisfy.

    A rod is a constraint k ((x - A)**2 + (y - B)**2 - l**2) = 0, or sqrt((x - A)**2 + (y - B)**2) = l, between a point
    (x, y) and a support (A, B), which is fixed, moves with time, or is another point. Its angle is called as the point,
    ``angle_1`` of ``x1``, ``y1``, and 0 where the rod points along -y. Rods that close loops and all other constraints
    are kept. Coordinates without a rod, forces, damping, parameters and inputs are carried over; functions of events
    and time transformations may use the original names. The result has fewer unknowns than the original system and is
    integrated faster for few rods; the mass matrix of a chain is full, so that constraints are faster for many.

    Args:
        system: a Lagrangian system with constraints.
        sizes, tables: sizes and index tables of arrays whose sizes are known at run time, as of
            :func:`~scvi_codegen.compile_stepper`.

    Returns:
        The system in angles. Its ``elimination`` maps states to the original system and back, and lists the kept
        constraints with their reasons.

    Raises:
        SystemDefinitionError: if no constraint is such a rod, naming each with the reason; for Hamiltonians, rotations
            and systems in transformed time.

    >>> points = LagrangianSystem.from_text(
    ...     name="pendulum", coordinates=["x", "y"], parameters={"l": 2, "g": 9.81},
    ...     lagrangian="(x_dot**2 + y_dot**2)/2 - g*y", constraints=["x**2 + y**2 = l**2"])
    >>> pendulum = eliminate_constraints(points)
    >>> pendulum.lagrangian
    angle_dot**2*l**2/2 + g*l*cos(angle)
    >>> pendulum.elimination.positions
    (l*sin(angle), -l*cos(angle))
    """
    known: Any = system
    if isinstance(known, ArraySystem):
        if sizes is None:
            raise SystemDefinitionError(
                f"the number of rods of '{known.name}' depends on the sizes {', '.join(known.sizes)}: give them, "
                f"eliminate_constraints(system, sizes={{'{known.sizes[0]}': 8}})"
            )
        known = unroll_sums(known, sizes, tables=tables)
    if not isinstance(known, LagrangianSystem) or type(known) is not LagrangianSystem:
        raise SystemDefinitionError(f"eliminate_constraints requires a Lagrangian with constraints, not {known!r}")
    for what, present in (
        ("has no constraints", not known.constraints),
        ("has rotations or directions, which angles of rods in a plane do not replace", bool(known.rotations)),
        ("is in transformed time: eliminate its constraints before reparametrise", known.clock is not None),
    ):
        if present:
            raise SystemDefinitionError(f"no constraints of '{known.name}' can be eliminated: it {what}")
    found, reasons = _RodSearch(known).rods()
    if not found:
        listed = "; ".join(f"'{text}' {reason}" for text, reason in reasons.items())
        raise SystemDefinitionError(
            f"no constraint of '{known.name}' is a rod in a plane that an angle can replace: {listed}. Write rods as "
            "(x1 - x2)**2 + (y1 - y2)**2 = l**2, or integrate the system with its constraints"
        )
    return _in_angles(known, found, reasons)


def eliminable_rods(system: MechanicalSystem) -> int:
    """Return the number of constraints that :func:`eliminate_constraints` would replace by angles."""
    plain = type(system) is LagrangianSystem and system.constraints and not (system.rotations or system.clock)
    return len(_RodSearch(system).rods()[0]) if plain and isinstance(system, LagrangianSystem) else 0


def _in_angles(system: LagrangianSystem, rods: Sequence[Rod], reasons: Mapping[str, str]) -> LagrangianSystem:
    places: dict[Symbol, Expr] = {}
    for rod in rods:
        a, b = (f.xreplace(places) for f in rod.support)
        places |= {rod.x: a + rod.length * sympy.sin(rod.angle), rod.y: b - rod.length * sympy.cos(rod.angle)}
    elimination = EliminatedRods(
        original=system,
        rods=tuple(rods),
        positions=tuple(places.get(q, q) for q in system.coordinates),
        remaining=dict(reasons),
    )
    moved = in_other_coordinates(
        system,
        places,
        elimination.coordinates,
        name=f"{system.name} in angles",
        lagrangian=lambda replaced: _lagrangian(system, rods, replaced, elimination.coordinates),
        omitted={rod.constraint for rod in rods},
    )
    return replace(moved, eliminated=elimination, indices=system.indices)


def _lagrangian(
    system: LagrangianSystem, rods: Sequence[Rod], replaced: Mapping[Expr, Expr], new: tuple[Symbol, ...]
) -> Expr:
    """Return L in the angles, with the kinetic energy and linear potentials of points on rods collected by rods.

    Terms m (x'^2 + y'^2)/2 and c x + d y of points on chains of rods of constant length, with m, c, d free of
    coordinates, are collected; in all others the positions are substituted.
    """
    coefficients: dict[Expr, Expr] = {}
    others: list[Expr] = []
    collected = {power: q for q in replaced for power in (q, q**2)}
    for term in _terms(system):
        constant, rest = term.as_independent(*system.velocities, *system.coordinates, as_Add=False)
        if rest in collected and (rest.is_Pow or rest in system.coordinates):
            coefficients[rest] = coefficients.get(rest, sympy.S.Zero) + constant
        else:
            others.append(term.xreplace(replaced))
    by_rods: dict[Expr, Expr] = {}
    for rod in rods:
        chain, support = _chain(rod, rods, system)
        foot = [f.xreplace(replaced) for f in support]
        for x, at, side in ((rod.x, foot[0], sympy.sin), (rod.y, foot[1], lambda angle: -sympy.cos(angle))):
            if c := coefficients.get(x, sympy.S.Zero):
                others.append(c * at)
                _add(by_rods, {side(each.angle): c * each.length for each in chain})
        squares = [symbol(x.name + DOT) ** 2 for x in (rod.x, rod.y)]
        mass, other = (coefficients.get(each, sympy.S.Zero) for each in squares)
        if mass != other or any(each.length.has(system.time) for each in chain):
            others += [c * each.xreplace(replaced) for c, each in zip((mass, other), squares, strict=True)]
        elif mass != 0:
            rates = [rate_of(f, new, system.time) for f in foot]
            others += [mass * rate**2 for rate in rates]
            for k, each in enumerate(chain):
                spin = symbol(each.angle.name + DOT)
                turned = rates[0] * sympy.cos(each.angle) + rates[1] * sympy.sin(each.angle)
                others.append(2 * mass * each.length * spin * turned)
                for before in chain[: k + 1]:
                    pair = symbol(before.angle.name + DOT) * spin * sympy.cos(before.angle - each.angle)
                    _add(by_rods, {pair: mass * before.length * each.length * (1 if before is each else 2)})
    return sympy.Add(*others, *(sympy.factor_terms(c) * each for each, c in by_rods.items()))


def _add(sums: dict[Expr, Expr], terms: Mapping[Expr, Expr]) -> None:
    for each, coefficient in terms.items():
        sums[each] = sums.get(each, sympy.S.Zero) + coefficient


def _terms(system: LagrangianSystem) -> Iterator[Expr]:
    """Yield the terms of L; polynomials in velocities alone, and linear ones in coordinates, are expanded."""
    for term in sympy.Add.make_args(system.lagrangian):
        v, q = (term.free_symbols.intersection(each) for each in (system.velocities, system.coordinates))
        alone = not (v and q) and term.is_polynomial(*v, *q)
        if alone and (v or all(not term.diff(x).free_symbols & q for x in q)):
            yield from sympy.Add.make_args(sympy.expand(term))
        else:
            yield term


def _chain(rod: Rod, rods: Sequence[Rod], system: LagrangianSystem) -> tuple[list[Rod], tuple[Expr, Expr]]:
    """Return the rods that carry the end of a rod, the outermost last, and the support of the first one."""
    chain, offset = [rod], (sympy.S.Zero, sympy.S.Zero)
    support = rod.support
    while True:
        below = [each for each in rods if support[0].coeff(each.x) == 1 and support[1].coeff(each.y) == 1]
        if not below:
            return chain[::-1], (support[0] + offset[0], support[1] + offset[1])
        inner = below[0]
        rest = support[0] - inner.x, support[1] - inner.y
        if _coordinates(rest, dict.fromkeys(system.coordinates, 0)):
            return chain[::-1], (support[0] + offset[0], support[1] + offset[1])
        offset = offset[0] + rest[0], offset[1] + rest[1]
        chain.append(inner)
        support = inner.support


class _RodSearch:
    """Search for rods: first those on supports whose position is known, then those of points that move freely."""

    def __init__(self, system: LagrangianSystem) -> None:
        self.system = system
        self.order = {q: k for k, q in enumerate(system.coordinates)}
        self.candidates = [list(self._candidates(g)) for g in system.constraints]
        self.forms: dict[int, str] = {}

    def rods(self) -> tuple[list[Rod], dict[str, str]]:
        """Return the rods, and the reason of each constraint that is none or closes a loop, by its text."""
        settled: set[Symbol] = set()
        rods: list[Rod] = []
        left = dict(enumerate(self.candidates))
        names = {each.name for each in (*self.system.coordinates, *self.system.parameters)}

        def waiting(rod: Rod) -> tuple[int, ...]:
            """Return the coordinates of the support that are not settled, by number."""
            return tuple(sorted(self.order[q] for q in _coordinates(rod.support, self.order) - settled))

        while True:
            usable = [rod for each in left.values() for rod in each if settled.isdisjoint((rod.x, rod.y))]
            if not usable:
                break
            best = min(usable, key=lambda rod: (len(waiting(rod)), *self._unlike(rod), waiting(rod), rod.constraint))
            settled |= {self.system.coordinates[k] for k in waiting(best)} | {best.x, best.y}
            names.add(name := _angle_name(best.x.name, best.y.name, names))
            rods.append(best._replace(angle=symbol(name)))
            del left[best.constraint]
        texts = self.system.constraint_texts
        return rods, {texts[k]: self._reason(k) for k in left}

    def _candidates(self, g: Expr) -> Iterator[Rod]:
        """Yield the rods that a constraint may be, one for each pair of coordinates that may be its end."""
        if kind_of(self.system, g) is not HOLONOMIC:
            return
        inputs = {symbol(name) for name in input_parameters(self.system.inputs)}
        squared = sympy.expand(_without_root(g, self.order))
        own = [q for q in self.system.coordinates if q in squared.free_symbols]
        first = {q: squared.diff(q) for q in own}
        for x, y in permutations(own, 2):
            k = first[x].diff(x) / 2
            if self.order[x] > self.order[y] or k == 0 or _coordinates([k], self.order):
                continue
            if sympy.expand(first[y].diff(y) / 2 - k) != 0 or first[x].diff(y) != 0:
                continue
            at_zero = {x: sympy.S.Zero, y: sympy.S.Zero}
            support = tuple(sympy.expand(-first[z].xreplace(at_zero) / (2 * k)) for z in (x, y))
            square = sympy.expand(support[0] ** 2 + support[1] ** 2 - squared.xreplace(at_zero) / k)
            formulas = (*support, square)
            if (
                square == 0
                or _coordinates([square], self.order)
                or inputs & set().union(*(f.free_symbols for f in formulas))
            ):
                continue
            yield Rod(self.system.constraints.index(g), x, y, (support[0], support[1]), _root(square), x)

    def _unlike(self, rod: Rod) -> tuple[bool, int]:
        """Return whether the names of an end differ by more than one letter, and the distance of its coordinates."""
        return _label(rod.x.name, rod.y.name) is None, self.order[rod.y] - self.order[rod.x]

    def _reason(self, k: int) -> str:
        g = self.system.constraints[k]
        if self.candidates[k]:
            return "closes a loop"
        if kind_of(self.system, g) is not HOLONOMIC:
            return "contains velocities"
        if {symbol(name) for name in input_parameters(self.system.inputs)} & g.free_symbols:
            return "contains an input"
        own = _coordinates([g], self.order)
        if len(own) < 2:
            return f"contains {len(own)} coordinate" + "s" * (len(own) != 1)
        squared = sympy.expand(_without_root(g, self.order))
        squares = [q for q in own if (second := squared.diff(q, 2)) != 0 and not _coordinates([second], self.order)]
        if len(squares) in (3, 6):
            return f"contains the squares of {len(squares)} coordinates: a rod in space, not in a plane"
        return "is not of the form (x1 - x2)**2 + (y1 - y2)**2 = l**2 with a length that depends on no coordinate"


def _coordinates(expressions: Sequence[Expr], coordinates: Mapping[Symbol, int]) -> set[Symbol]:
    return set().union(*(each.free_symbols for each in expressions)) & coordinates.keys()


def _without_root(g: Expr, coordinates: Mapping[Symbol, int]) -> Expr:
    """Return D - (b/c)^2 for c sqrt(D) + b, where b and c contain no coordinates; other expressions unchanged."""
    moving = [term for term in sympy.Add.make_args(g) if _coordinates([term], coordinates)]
    if len(moving) != 1:
        return g
    factor, root = moving[0].as_independent(*coordinates, as_Add=False)
    if root.is_Pow and root.exp == sympy.Rational(1, 2):
        return root.base - ((g - moving[0]) / factor) ** 2
    return g


def _root(square: Expr) -> Expr:
    """Return the square root of l^2, without the sign of l."""
    factored = sympy.factor(square)
    constant, rest = factored.as_coeff_Mul()
    powers = sympy.Mul.make_args(rest)
    if constant.is_positive and all(each.is_Pow and each.exp.is_Integer and each.exp % 2 == 0 for each in powers):
        return sympy.sqrt(constant) * sympy.Mul(*(each.base ** (each.exp / 2) for each in powers))
    return sympy.sqrt(square)


def _label(x: str, y: str) -> str | None:
    """Return what the names of two coordinates of a point have in common besides one letter each, else ``None``."""
    found = re.fullmatch(r"(\w*?)\w?(\w*)\|\1\w?\2", f"{x}|{y}")
    return None if found is None else "_".join(part for each in found.groups() if (part := each.strip("_")))


def _angle_name(x: str, y: str, taken: set[str]) -> str:
    label = _label(x, y)
    name = "_".join(part for part in ("angle", f"{x}_{y}" if label is None else label) if part)
    while name in taken or name + DOT in taken:
        name += "_"
    return name
