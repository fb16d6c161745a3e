"""Euler-Lagrange equations and conservation laws of a density by Noether's theorem.

A variation ``du = Q`` of the fields that changes L by a divergence, ``dL = D_t K^t + sum_i D_i K^i``, implies the local
conservation law ``D_t J^t + sum_i D_i J^i = 0`` of every solution, with

    J^t = sum_u L_(u_t) Q - K^t,
    J^i = sum_u [L_(u_i) Q + sum_j (L_(u_ij) D_j Q - D_j L_(u_ij) Q)] - K^i

(P. J. Olver, Applications of Lie Groups to Differential Equations, Springer 1993, section 4.4). A Hamiltonian density H
has L = sum p u_t - H. Candidates for Q and K are tested: ``dL - D_t K^t - sum D_i K^i`` must be zero identically.
"""

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations

import sympy
from sympy import Add, Derivative, Expr, Function, S, Symbol
from sympy.core.function import AppliedUndef

from scvi_codegen.errors import StateError, closest
from scvi_codegen.fields.density import Density
from scvi_codegen.formulas.symbols import TIME, symbol
from scvi_codegen.mechanics.arrays.symmetry import sums_to_zero
from scvi_codegen.representation import summary

Variation = dict[str, Expr]


@dataclass(frozen=True, slots=True, kw_only=True)
class ConservationLaw:
    """Local conservation law d/dt density + sum over axes of d/dx flux = 0 of the solutions of a field system.

    Attributes:
        name: ``"energy"``, ``"momentum_x"``, ``"charge"``, ``"shift"`` or ``"boost_x"``; of several fields with
            that of the fields, ``"shift_u"``.
        symmetry: transformation that the law follows from.
        density: conserved density in the fields, functions of the axes and of the time, and their derivatives.
        flux: flux by axis.
    """

    name: str
    symmetry: str
    density: Expr
    flux: Mapping[str, Expr]

    __repr__ = summary("name", "symmetry")


class Variations:
    """Fields of a density as functions of space and time, their equations and conservation laws."""

    def __init__(self, system: Density) -> None:
        places = [symbol(axis) for axis in (*system.space, TIME)]
        rates = {f"{each}_{TIME}": (each, {TIME: 1}) for each in system.variables}
        derivatives = {**rates, **system.derivatives}
        self.system = system
        self.functions: dict[str, Expr] = {each: Function(each)(*places) for each in system.variables}
        self.values = {symbol(each): function for each, function in self.functions.items()}
        for name, (each, orders) in derivatives.items():
            self.values[symbol(name)] = derivative(self.functions[each], orders)
        pairs = zip(system.fields, system.momenta, strict=False)
        products = Add(*(symbol(p) * symbol(f"{u}_{TIME}") for u, p in pairs))
        self.formula: Expr = products - system.density if system.momenta else system.density
        self.lagrangian = self.along(self.formula)
        self.used = {name: each for name, each in derivatives.items() if symbol(name) in self.formula.free_symbols}

    def along(self, formula: Expr) -> Expr:
        """Return a formula in symbols ``u``, ``u_x`` as one in functions of space and time."""
        return formula.xreplace(self.values)

    def partial(self, name: str) -> Expr:
        """Return the partial derivative of L with respect to ``u``, ``u_t``, ``u_x``, .. along the fields."""
        return self.along(self.formula.diff(symbol(name)))

    @cached_property
    def equations(self) -> dict[str, Expr]:
        """Highest derivative in time of each field, u_tt or of a Hamiltonian density u_t, in derivatives in space."""
        system, forces = self.system, {}
        for each in system.variables:
            terms = [self.partial(each)]
            for name, (of, orders) in self.used.items():
                if of == each and TIME not in orders:
                    sign = (-1) ** sum(orders.values())
                    terms.append(sign * derivative(self.partial(name), orders))
            forces[each] = Add(*terms).doit()
        if not system.momenta:
            masses = {each: self.along(system.density.diff(symbol(f"{each}_{TIME}"), 2)) for each in system.fields}
            return {each: shorter(forces[each] / masses[each]) for each in system.fields}
        pairs = [*zip(system.fields, system.momenta, strict=True)]
        rates = {u: u_t for u, p in pairs for u_t in [sympy.expand(self.values[symbol(f"{u}_{TIME}")] - forces[p])]}
        return rates | {p: sympy.expand(forces[u]) for u, p in pairs}

    def laws(self) -> tuple[ConservationLaw, ...]:
        """Return the conservation laws of the candidates that are symmetries."""
        found = {}
        for name, symmetry, variation, divergence in self._candidates():
            if name not in found and self._is_symmetry(variation, divergence):
                found[name] = self._law(name, symmetry, variation, divergence)
        return tuple(found.values())

    def _is_symmetry(self, variation: Variation, divergence: Mapping[str, Expr]) -> bool:
        terms = [self.partial(each) * change for each, change in variation.items()]
        for name, (each, orders) in self.used.items():
            terms.append(self.partial(name) * derivative(variation[each], orders))
        terms += [-part.diff(symbol(axis)) for axis, part in divergence.items()]
        return vanishes(Add(*terms).doit())

    def _law(self, name: str, symmetry: str, variation: Variation, divergence: Mapping[str, Expr]) -> ConservationLaw:
        current = {axis: -divergence.get(axis, S.Zero) for axis in (TIME, *self.system.space)}
        for derived, (each, orders) in self.used.items():
            along = [axis for axis, order in orders.items() for _ in range(order)]
            change, factor = variation[each], self.partial(derived)
            current[along[0]] += factor * (change.diff(symbol(along[1])) if len(along) == 2 else change)
            if len(along) == 2:
                current[along[1]] -= factor.diff(symbol(along[0])) * change
        rates = {self.values[symbol(f"{u}_{TIME}")]: self.equations[u] for u in self.system.variables}
        reduced = {}
        for axis, part in current.items():
            formula = part.doit()
            reduced[axis] = sympy.expand(formula.subs(rates).doit() if self.system.momenta else formula)
        return ConservationLaw(name=name, symmetry=symmetry, density=reduced.pop(TIME), flux=reduced)

    def _candidates(self) -> Iterator[tuple[str, str, Variation, dict[str, Expr]]]:
        """Yield name, description, Q by field and K by axis of transformations that may be symmetries."""
        yield "energy", f"translation in {TIME}", self._rates(TIME), {TIME: self.lagrangian}
        for axis in self.system.space:
            backward = {each: -rate for each, rate in self._rates(axis).items()}
            yield f"momentum_{axis}", f"translation in {axis}", backward, {axis: -self.lagrangian}
        variables, fields, momenta = self.system.variables, self.system.fields, self.system.momenta
        pairs = [*zip(fields, momenta, strict=True)] if momenta else [*combinations(fields, 2)]
        for pair in pairs:
            suffix = f"_{pair[0]}_{pair[1]}" if len(variables) > 2 else ""
            yield f"charge{suffix}", f"rotation of ({pair[0]}, {pair[1]})", *self._rotated([pair], S.One)
        if momenta and len(pairs) > 1:
            yield "charge", "rotation of all pairs", *self._rotated(pairs, S.One)
        for each in fields:
            shifted: Variation = {other: S.One if other == each else S.Zero for other in variables}
            yield f"shift_{each}" if len(variables) > 1 else "shift", f"shift of {each}", shifted, {}
        yield from self._boosts(pairs)

    def _rates(self, axis: str) -> Variation:
        return {each: function.diff(symbol(axis)) for each, function in self.functions.items()}

    def _rotated(self, pairs: list[tuple[str, str]], angle: Expr) -> tuple[Variation, dict[str, Expr]]:
        """Return the rotation of pairs (a, b) by an angle that may depend on space, and its K."""
        variation: Variation = dict.fromkeys(self.functions, S.Zero)
        part = S.Zero
        for one, two in pairs:
            a, b = self.functions[one], self.functions[two]
            variation |= {one: angle * b, two: -angle * a}
            part += angle * (b**2 - a**2) / 2 if self.system.momenta else S.Zero
        return variation, {TIME: part}

    def _boosts(self, pairs: list[tuple[str, str]]) -> Iterator[tuple[str, str, Variation, dict[str, Expr]]]:
        """Yield Lorentz boosts with the wave speed of the first field, or Galilei boosts of complex fields."""
        first, time = self.system.fields[0], symbol(TIME)
        for axis in self.system.space:
            along, x = self._rates(axis), symbol(axis)
            stiffness = self.system.density.diff(symbol(f"{first}_{axis}"), 2)
            if stiffness == 0 or stiffness.free_symbols - set(self.system.parameters):
                continue
            if self.system.momenta:
                variation, divergence = self._rotated(pairs, -x / (2 * stiffness))
                moved = {each: variation[each] - time * along[each] for each in variation}
                products = Add(*(self.functions[u] * self.functions[p] for u, p in pairs))
                divergence |= {axis: -time * self.lagrangian - products / 2}
                yield f"boost_{axis}", f"Galilei transformation along {axis}", moved, divergence
            else:
                squared = -stiffness / self.system.density.diff(symbol(f"{first}_{TIME}"), 2)
                rates = self._rates(TIME)
                moved = {each: x * rates[each] + squared * time * along[each] for each in rates}
                divergence = {TIME: x * self.lagrangian, axis: squared * time * self.lagrangian}
                yield f"boost_{axis}", f"Lorentz transformation along {axis}", moved, divergence


def chosen_laws(system: Density, names: Collection[str]) -> list[ConservationLaw]:
    """Return the conservation laws of these names, all without names."""
    known = {law.name: law for law in Variations(system).laws()}
    for name in names:
        if name not in known:
            raise StateError(f"there is no conservation law '{name}'{closest(name, known)} Known: {', '.join(known)}")
    return [known[name] for name in names or known]


def derivative(formula: Expr, orders: Mapping[str, int]) -> Expr:
    """Return the derivative of a formula in functions, with orders by axis and time."""
    return formula.diff(*((symbol(axis), order) for axis, order in orders.items()))


def shorter(formula: Expr) -> Expr:
    """Return an expression expanded, or factored if that halves its length."""
    expanded, factored = sympy.expand(formula), sympy.factor(formula)
    return factored if 2 * factored.count_ops() < expanded.count_ops() else expanded


def vanishes(formula: Expr) -> bool:
    """Return whether an expression in functions and their derivatives is zero identically, by evaluation."""
    plain = sympy.expand(formula).xreplace(names_of(formula))
    return sums_to_zero(Add.make_args(plain), sorted(plain.free_symbols, key=str))


def names_of(formula: Expr) -> dict[Expr, Symbol]:
    """Return the symbols ``u``, ``u_x``, ``u_tx`` of the functions and derivatives in a formula."""
    found: dict[Expr, Symbol] = {}
    for each in formula.atoms(Derivative, AppliedUndef):
        if isinstance(each, Derivative):
            orders = "".join(
                str(axis) * order for axis, order in sorted(each.variable_count, key=lambda v: str(v[0]) != TIME)
            )
            found[each] = symbol(f"{each.expr.func}_{orders}")
        else:
            found[each] = symbol(str(each.func))
    return found
