"""Euler-Lagrange equations and conservation laws of a density by Noether's theorem.

A variation ``du = Q`` of the fields that changes L by a divergence, ``dL = D_t K^t + sum_i D_i K^i``, implies the local
conservation law ``D_t J^t + sum_i D_i J^i = 0`` of every solution, with

    J^t = sum_u L_(u_t) Q - K^t,
    J^i = sum_u [L_(u_i) Q + sum_j (L_(u_ij) D_j Q - D_j L_(u_ij) Q)] - K^i

(P. J. Olver, Applications of Lie Groups to Differential Equations, Springer 1993, section 4.4). A Hamiltonian density H
has L = sum p u_t - H. Candidates for Q and K are tested: ``dL - D_t K^t - sum D_i K^i`` must be zero identically.

Along a run derivatives in space are those of the interpolant, on elements element by element with the prescribed values
at ends. Values at end points that elements share are means weighted by length.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Add, Derivative, Eq, Expr, Function, S, Symbol
from sympy.core.function import AppliedUndef

from scvi_codegen.api.formulas import TIME, Tape, symbol
from scvi_codegen.api.systems import MechanicalSystem
from scvi_codegen.api.text import summary
from scvi_codegen.common.errors import AccuracyWarning, StateError, StepFailedError, closest, warn
from scvi_codegen.extras.fields.axes import NATURAL, PERIODIC, Axis
from scvi_codegen.extras.fields.density import Density, place_text

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
        rates = {f"{variable}_{TIME}": (variable, {TIME: 1}) for variable in system.variables}
        derivatives = {**rates, **system.derivatives}
        self.system = system
        self.functions: dict[str, Expr] = {variable: Function(variable)(*places) for variable in system.variables}
        self.values = {symbol(variable): function for variable, function in self.functions.items()}
        for name, (variable, orders) in derivatives.items():
            self.values[symbol(name)] = derivative(self.functions[variable], orders)
        pairs = zip(system.fields, system.momenta, strict=False)
        products = Add(*(symbol(p) * symbol(f"{u}_{TIME}") for u, p in pairs))
        self.formula: Expr = products - system.density if system.momenta else system.density
        self.lagrangian = self.along(self.formula)
        self.used = {
            name: variable for name, variable in derivatives.items() if symbol(name) in self.formula.free_symbols
        }

    def along(self, formula: Expr) -> Expr:
        """Return a formula in symbols ``u``, ``u_x`` as one in functions of space and time."""
        return formula.xreplace(self.values)

    def partial(self, name: str) -> Expr:
        """Return the partial derivative of L with respect to ``u``, ``u_t``, ``u_x``, .. along the fields."""
        return self.along(self.formula.diff(symbol(name)))

    @cached_property
    def equations(self) -> dict[str, Expr]:
        """Highest derivative in time of each field, u_tt or of a Hamiltonian density u_t, in derivatives in space."""
        # dL/du - D_x L_(u_x) + D_xx L_(u_xx) = D_t L_(u_t).
        system, forces = self.system, {}
        for variable in system.variables:
            terms = [self.partial(variable)]
            for name, (field, orders) in self.used.items():
                if field == variable and TIME not in orders:
                    sign = (-1) ** sum(orders.values())
                    terms.append(sign * derivative(self.partial(name), orders))
            forces[variable] = Add(*terms).doit()
        if not system.momenta:
            masses = {field: self.along(system.density.diff(symbol(f"{field}_{TIME}"), 2)) for field in system.fields}
            return {field: shorter(forces[field] / masses[field]) for field in system.fields}
        pairs = [*zip(system.fields, system.momenta, strict=True)]
        # L = p u_t - H: the variation by p is u_t - dH/dp, that by u is -dH/du = p_t.
        rates = {u: sympy.expand(self.values[symbol(f"{u}_{TIME}")] - forces[p]) for u, p in pairs}
        return rates | {p: sympy.expand(forces[u]) for u, p in pairs}

    def laws(self) -> tuple[ConservationLaw, ...]:
        """Return the conservation laws of the candidates that are symmetries."""
        laws = {}
        for name, symmetry, variation, divergence in self._candidates():
            if name not in laws and self._is_symmetry(variation, divergence):
                laws[name] = self._law(name, symmetry, variation, divergence)
        return tuple(laws.values())

    def _is_symmetry(self, variation: Variation, divergence: Mapping[str, Expr]) -> bool:
        terms = [self.partial(variable) * change for variable, change in variation.items()]
        for name, (variable, orders) in self.used.items():
            terms.append(self.partial(name) * derivative(variation[variable], orders))
        terms += [-part.diff(symbol(axis)) for axis, part in divergence.items()]
        return vanishes(Add(*terms).doit())

    def _law(self, name: str, symmetry: str, variation: Variation, divergence: Mapping[str, Expr]) -> ConservationLaw:
        """Return the conservation law of a symmetry; rates of a Hamiltonian density are replaced by its equations."""
        current = {axis: -divergence.get(axis, S.Zero) for axis in (TIME, *self.system.space)}
        for derived, (variable, orders) in self.used.items():
            # L_(u_i) Q to J^i; of u_ij L_(u_ij) D_j Q to J^i and -D_i L_(u_ij) Q to J^j.
            axis, *second = (axis for axis, order in orders.items() for _ in range(order))
            change, factor = variation[variable], self.partial(derived)
            if not second:
                current[axis] += factor * change
                continue
            current[axis] += factor * change.diff(symbol(second[0]))
            current[second[0]] -= factor.diff(symbol(axis)) * change
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
            backward = {variable: -rate for variable, rate in self._rates(axis).items()}
            yield f"momentum_{axis}", f"translation in {axis}", backward, {axis: -self.lagrangian}
        variables = self.system.variables
        fields = self.system.fields
        momenta = self.system.momenta
        pairs = [*zip(fields, momenta, strict=True)] if momenta else [*combinations(fields, 2)]
        for pair in pairs:
            suffix = f"_{pair[0]}_{pair[1]}" if len(variables) > 2 else ""
            yield f"charge{suffix}", f"rotation of ({pair[0]}, {pair[1]})", *self._rotated([pair], S.One)
        if momenta and len(pairs) > 1:
            yield "charge", "rotation of all pairs", *self._rotated(pairs, S.One)
        for field in fields:
            shifted: Variation = {other: S.One if other == field else S.Zero for other in variables}
            yield f"shift_{field}" if len(variables) > 1 else "shift", f"shift of {field}", shifted, {}
        yield from self._boosts(pairs)

    def _rates(self, axis: str) -> Variation:
        return {variable: function.diff(symbol(axis)) for variable, function in self.functions.items()}

    def _rotated(self, pairs: list[tuple[str, str]], angle: Expr) -> tuple[Variation, dict[str, Expr]]:
        """Return the rotation of pairs (a, b) by an angle that may depend on space, and its K."""
        variation: Variation = dict.fromkeys(self.functions, S.Zero)
        part = S.Zero
        for first, second in pairs:
            a, b = self.functions[first], self.functions[second]
            variation |= {first: angle * b, second: -angle * a}
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
                moved = {variable: variation[variable] - time * along[variable] for variable in variation}
                products = Add(*(self.functions[u] * self.functions[p] for u, p in pairs))
                divergence |= {axis: -time * self.lagrangian - products / 2}
                yield f"boost_{axis}", f"Galilei transformation along {axis}", moved, divergence
            else:
                squared = -stiffness / self.system.density.diff(symbol(f"{first}_{TIME}"), 2)
                rates = self._rates(TIME)
                moved = {variable: x * rates[variable] + squared * time * along[variable] for variable in rates}
                divergence = {TIME: x * self.lagrangian, axis: squared * time * self.lagrangian}
                yield f"boost_{axis}", f"Lorentz transformation along {axis}", moved, divergence


def chosen_laws(system: Density, names: Collection[str]) -> list[ConservationLaw]:
    """Return the conservation laws of these names, all without names."""
    laws = {law.name: law for law in Variations(system).laws()}
    for name in names:
        if name not in laws:
            raise StateError(f"there is no conservation law '{name}'{closest(name, laws)} Known: {', '.join(laws)}")
    return [laws[name] for name in names or laws]


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
    return Tape.cancels(Add.make_args(plain))


def names_of(formula: Expr) -> dict[Expr, Symbol]:
    """Return the symbols ``u``, ``u_x``, ``u_tx`` of the functions and derivatives in a formula."""
    symbols: dict[Expr, Symbol] = {}
    for function in formula.atoms(Derivative, AppliedUndef):
        if isinstance(function, Derivative):
            orders = "".join(
                str(axis) * order for axis, order in sorted(function.variable_count, key=lambda v: str(v[0]) != TIME)
            )
            symbols[function] = symbol(f"{function.expr.func}_{orders}")
        else:
            symbols[function] = symbol(str(function.func))
    return symbols


Array = NDArray[np.float64]

RESOLVED, DOUBTFUL = 1e-9, 1e-3
"""Relative errors of derivatives in time up to which states suffice, and from which there is a warning."""
WINDOW = 9
"""States of the differences in time, of order 8 between equidistant states."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalLaw:
    """Values of a conservation law d/dt density + d/dx flux = 0 along a run of n states.

    Attributes:
        law: symbolic density and fluxes.
        t: (n,) times.
        density: (n, shape of the fields) conserved density at the points.
        flux: of the same shape, by axis.
        residual: d/dt density + sum over axes of d/dx flux, of the same shape; the derivative in time is that of the
            polynomial through 9 neighbouring states, or states of dense output where these are too far apart; the
            derivatives in space are spectral.
        total: (n,) integral of the density over space.
    """

    law: ConservationLaw
    t: Array
    density: Array
    flux: Mapping[str, Array]
    residual: Array
    total: Array

    __repr__ = summary("law")


def local_law(history: FieldHistory, law: ConservationLaw) -> LocalLaw:
    """Return the values of a conservation law along a run."""
    density = history.values(law.density)
    divergence = history.values(Add(*(part.diff(symbol(axis)) for axis, part in law.flux.items())).doit())
    return LocalLaw(
        law=law,
        t=history.t,
        density=history.at_points(density),
        flux={axis: history.at_points(history.values(part)) for axis, part in law.flux.items()},
        residual=history.at_points(_rate(history, law, density) + divergence),
        total=history.integral(density),
    )


def _rate(history: FieldHistory, law: ConservationLaw, density: Array) -> Array:
    """Return the derivative of a density in time: by the states if they are close enough, else by dense output."""
    rate = time_derivative(history.t, density)
    error = np.abs(rate - time_derivative(history.t, density, WINDOW - 2)).max()
    largest = np.abs(rate).max()
    if error <= RESOLVED * largest:
        return rate
    try:
        times, between = history.between
    except (StateError, StepFailedError) as failure:
        if error > DOUBTFUL * largest:
            warn(
                f"the residual of the law '{law.name}' is uncertain by {error:.1e}: the states are too far apart in "
                f"time, and there is no dense output ({failure})",
                AccuracyWarning,
            )
        return rate
    values = between.values(law.density).reshape(*times.shape, *density.shape[1:])
    return np.array([_derivative(*window) for window in zip(times, values, history.t, strict=True)])


def time_derivative(t: Array, values: Array, most: int = WINDOW) -> Array:
    """Return the derivative in time of values (n, ..), by polynomials through ``most`` neighbouring states."""
    if (count := len(t)) < 2:
        raise StateError("the residual of a conservation law needs at least two states")
    width = min(most, count)
    firsts = [min(max(k - width // 2, 0), count - width) for k in range(count)]
    windows = [slice(first, first + width) for first in firsts]
    return np.array([_derivative(t[window], values[window], time) for window, time in zip(windows, t, strict=True)])


def _derivative(t: Array, values: Array, time: float) -> Array:
    """Return the derivative at a time of the polynomial through values (k, ..) at times (k,)."""
    # Weights w with sum_i w_i (t_i - time)^r = [r = 1]: exact for all polynomials of degree k - 1.
    distance = t - time
    largest = np.abs(distance).max()
    scaled = distance / largest
    moments = np.zeros(len(t))
    moments[1] = 1 / largest
    weights = np.linalg.solve(np.vander(scaled, increasing=True).T, moments)
    return np.asarray(np.tensordot(weights, values, 1))


class FieldHistory:
    """Fields and their derivatives along a run, (n, points of the axes); points of elements one after the other."""

    def __init__(self, mesh: Any, run: Any) -> None:
        if run.observed is not None:
            raise StateError("a run with observe saves only its first and last state: run it without observe")
        self.mesh, self.system, self.run = mesh, mesh.field_system, run
        self.t = np.asarray(run.t, float)
        velocity = None if self.system.momenta else np.asarray(run.velocity)
        self.fields: dict[str, Array] = mesh.fields_of(np.asarray(run.q), np.asarray(run.p), velocity)
        by_name = run.stepper.parameters_by_name(run.parameters)
        self.known: dict[Expr, Any] = {parameter: by_name[str(parameter)] for parameter in self.system.parameters}
        self.axes: dict[str, tuple[int, Axis]] = {axis.name: (k + 1, axis) for k, axis in enumerate(mesh.axes)}
        coordinates = {TIME: self.t} | {axis.name: (axis.closed or axis).points for axis in mesh.axes}
        self.known |= zip(map(symbol, coordinates), np.ix_(*coordinates.values()), strict=True)
        self.shape = tuple(len(values) for values in coordinates.values())

    @cached_property
    def between(self) -> tuple[Array, FieldHistory]:
        """Times (n, 9) near each state, a twentieth of the distance of states apart, and the history at these times."""
        if not self.run._has_dense_output or self.run.pieces:
            raise StateError("recordings and runs with inputs have none here")
        count = len(self.t)
        steps = np.arange(WINDOW) - np.where(np.arange(count) == 0, 0, WINDOW // 2)[:, np.newaxis]
        steps[-1] -= WINDOW // 2
        gaps = np.diff(self.t)
        before, after = np.append(gaps[:1], gaps), np.append(gaps, gaps[-1:])
        spacing = np.where(np.abs(before) < np.abs(after), before, after) / 20
        times = self.t[:, np.newaxis] + steps * spacing[:, np.newaxis]
        q, p = self.run.at(times.ravel())
        return times, FieldHistory(self.mesh, self.run._between_states(times.ravel(), q, p))

    def values(self, formula: Expr) -> Array:
        """Return a formula in functions and their derivatives."""
        names = names_of(formula)
        arguments = {name: self._function(function) for function, name in names.items()} | self.known
        return np.broadcast_to(
            sympy.lambdify([*arguments], formula.xreplace(names), "numpy")(*arguments.values()), self.shape
        )

    def _function(self, function: Any) -> Array:
        """Return a field, or a derivative of it of order one in time and any order in space."""
        orders = {str(axis): int(order) for axis, order in getattr(function, "variable_count", ())}
        name, rate = str(getattr(function, "expr", function).func), orders.pop(TIME, 0)
        values = self.fields[f"{name}_{TIME}" if rate else name]
        for along, axis in self.axes.values():
            values = axis.in_elements(values, along, self._at_ends(axis.name, name, rate, values.ndim))
        for letter, order in orders.items():
            along, axis = self.axes[letter]
            for _ in range(order):
                values = axis.derivative(values, along)
        return values

    def _at_ends(self, axis: str, name: str, rate: int, dimension: int) -> list[Array | None]:
        """Return the prescribed values at both ends of an axis, (n, 1, ..) with one dimension less than fields."""
        result: list[Array | None] = []
        for end in () if self.system.boundary[axis] == PERIODIC else self.system.boundary[axis]:
            result.append(None)
            if end != NATURAL:
                formula = end[name].diff(symbol(TIME), rate)
                values = sympy.lambdify([*self.known], formula, "numpy")(*self.known.values())
                result[-1] = np.broadcast_to(values, (len(self.t), *(1,) * (dimension - 1)))[..., 0]
        return result

    def integral(self, values: Array) -> Array:
        """Return the integral over space, (n,)."""
        for _, axis in reversed(self.axes.values()):
            values = values @ (axis.closed or axis).weights
        return values

    def at_points(self, values: Array) -> Array:
        """Return values at the points of the mesh, (n, shape of the fields)."""
        for along, axis in self.axes.values():
            values = axis.from_elements(values, along)
        return values


@dataclass(frozen=True, slots=True, kw_only=True)
class FieldDerivation:
    """Equations of motion and local conservation laws of a density; of a mesh also its semi-discrete system.

    Attributes:
        field_system: the density.
        equations: Euler-Lagrange equation of each field; of a Hamiltonian density its equations of first order.
        laws: conservation laws of the symmetries of the density.
        semidiscrete: the semi-discrete L or H and its energy in index notation by name; empty without a mesh.
    """

    field_system: Density
    equations: Mapping[str, Eq]
    laws: tuple[ConservationLaw, ...]
    semidiscrete: Mapping[str, str]

    __repr__ = summary("field_system", "laws")

    def to_text(self) -> str:
        """Return plain text: density, equations, semi-discrete system, and conservation laws."""
        return "".join(f"{line}\n" for line in self._lines())

    def _lines(self) -> Iterator[str]:
        letter, title = ("H", "Hamilton") if self.field_system.momenta else ("L", "Euler-Lagrange")
        yield f"{self.field_system.name}: {letter} = {MechanicalSystem.formula_text(self.field_system.density)}"
        for place, formula in self.field_system.point_lagrangians:
            yield f"  at {place_text(place)}: {MechanicalSystem.formula_text(formula)}"
        yield ""
        yield f"{title} equations"
        for equation in self.equations.values():
            yield f"  {_written(equation.lhs)} = {_written(equation.rhs)}"
        for name, text in self.semidiscrete.items():
            yield f"\n{name}"
            yield from (f"  {line}" for line in text.split("\n"))
        divergence = " + ".join(f"d/d{axis} J{axis}" for axis in self.field_system.space)
        heading = f", d/d{TIME} J{TIME} + {divergence} = 0" if self.laws else ": none found"
        damped = "" if self.field_system.dissipation == 0 else ", the density is damped"
        yield f"\nconservation laws{heading}{damped}"
        for law in self.laws:
            yield f"  {law.name}: {law.symmetry}"
            yield f"    J{TIME} = {_written(law.density)}"
            yield from (f"    J{axis} = {_written(part)}" for axis, part in law.flux.items())


def derivation_of(system: Density, assembled: Any = None) -> FieldDerivation:
    """Return the derivation of a density, with its semi-discrete system."""
    variations = Variations(system)
    order = 1 if system.momenta else 2
    equations = {
        variable: Eq(variations.functions[variable].diff(symbol(TIME), order), formula)
        for variable, formula in variations.equations.items()
    }
    for field, rate in zip(system.fields, system.rates, strict=True) if system.dissipation != 0 else ():
        force = variations.along(system.dissipation.diff(rate) / system.density.diff(rate, 2))
        equations[field] = Eq(equations[field].lhs, sympy.expand(equations[field].rhs - force))
    return FieldDerivation(
        field_system=system,
        equations=equations,
        laws=variations.laws() if system.dissipation == 0 else (),
        semidiscrete={} if assembled is None else _semidiscrete(assembled),
    )


def _semidiscrete(assembled: Any) -> dict[str, str]:
    """Return the texts of the semi-discrete Lagrangian and of its energy, or of the semi-discrete Hamiltonian."""
    if assembled.momenta:
        return {"semi-discrete Hamiltonian": assembled.definition["hamiltonian"]}
    text = assembled.definition["lagrangian"]
    terms = text.split("\n+ ")
    kinetic = [term for term in terms if "_dot" in term]
    others = [term for term in terms if term not in kinetic]
    # E = T + V for L = T - V.
    energy = "\n+ ".join(kinetic) + "".join(f"\n- {term}" for term in others)
    return {"semi-discrete Lagrangian": text, "semi-discrete energy": energy}


def _written(formula: Expr) -> str:
    return MechanicalSystem.formula_text(formula.xreplace(names_of(formula)))
