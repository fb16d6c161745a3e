"""Systems at random points: positions, momenta and their rates of change, as arrays of binary64 or in 60 digits.

Time derivatives of functions of (q, p, t) follow from these without solving for accelerations: along every trajectory
dq/dt = v and dp/dt = L_q with p = L_v for a Lagrangian, dq/dt = H_p and dp/dt = -H_q for a Hamiltonian. With random
v (or p), an analytic function that is zero at all points is identically zero. Coordinates are grouped by their names
into Cartesian positions of bodies; the forces of term groups are computed for all bodies at once.
"""

import functools
import math
import operator
import random
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Expr, Symbol

from scvi_codegen.common.precision import Number, mp
from scvi_codegen.systems.constraints import constraint_multipliers, with_constraint_forces
from scvi_codegen.systems.derived_expressions import forms_of
from scvi_codegen.systems.formulas.expressions import ATTEMPTS, LARGEST, Tape, evaluate
from scvi_codegen.systems.formulas.intermediates import parts
from scvi_codegen.systems.formulas.numpy_values import array_value
from scvi_codegen.systems.system import MechanicalSystem
from scvi_codegen.systems.term_groups import TermGroup

AXES = "xyz"
AXIS_FIRST = re.compile(r"^([xyz])_?(\w+)$")


@dataclass(frozen=True, slots=True, kw_only=True)
class Body:
    """Coordinates that are the Cartesian position of one body.

    Attributes:
        name: ``"jupiter"`` for jupiter_x, jupiter_y, jupiter_z, ``"1"`` for x1, y1, z1; empty for plain x, y, z.
        columns: their indices among all coordinates, x first; two or three.
    """

    name: str
    columns: tuple[int, ...]


def bodies(coordinates: Sequence[str]) -> tuple[Body, ...]:
    """Group names such as jupiter_x, jupiter_y, or x1, y1, x2, y2, or x_sun, y_sun, or x, y, into bodies.

    Returns:
        The bodies, all in the plane or all in space, or none if a coordinate belongs to no body.

    >>> [body.name for body in bodies(["sun_x", "sun_y", "moon_x", "moon_y"])]
    ['sun', 'moon']
    >>> [body.name for body in bodies(["x1", "y1", "x2", "y2"])]
    ['1', '2']
    >>> bodies(["theta", "x", "y"])
    ()
    """
    return _grouped(coordinates) or _grouped([AXIS_FIRST.sub(r"\2_\1", name) for name in coordinates])


def _grouped(coordinates: Sequence[str]) -> tuple[Body, ...]:
    """Group names that end in the axis."""
    groups: dict[str, dict[str, int]] = {}
    for index, name in enumerate(coordinates):
        stem, axis = (name[:-2], name[-1]) if name[-2:-1] == "_" else ("", name)
        groups.setdefault(stem, {})[axis] = index
    shapes = {"".join(sorted(group)) for group in groups.values()}
    if shapes not in ({"xy"}, {"xyz"}) or sum(map(len, groups.values())) != len(coordinates):
        return ()
    shape = shapes.pop()
    return tuple(Body(name=stem, columns=tuple(group[axis] for axis in shape)) for stem, group in groups.items())


FEW = 12
"""Number of bodies per term group that :func:`terms_among_few_bodies` selects."""


def terms_among_few_bodies(term_groups: Sequence[TermGroup], bodies: Sequence[Body]) -> tuple[TermGroup, ...]:
    """Return the terms among the first few bodies: what the system conserves, so does this system of few bodies."""
    body_of = {index: number for number, body in enumerate(bodies) for index in body.columns}
    nearest = dict[int, None]()
    for term_group in term_groups:
        occurring = dict.fromkeys(body_of.get(index, -1 - index) for row in term_group.places for index in row)
        nearest |= dict.fromkeys(list(occurring)[:FEW])
    return tuple(
        term_group.where([all(body_of.get(index, -1 - index) in nearest for index in row) for row in term_group.places])
        for term_group in term_groups
    )


def array_forces(
    term_groups: Sequence[TermGroup], coordinates: Sequence[Symbol], at_points: Mapping[Any, Any], count: int
) -> Sequence[Any]:
    """Return the force on each coordinate at ``count`` points; ``at_points``: positions, parameters and time there."""
    if not term_groups:
        return [0.0] * len(coordinates)
    q = np.array([at_points[coordinate] for coordinate in coordinates])
    force = np.zeros((len(coordinates), count))
    for term_group in term_groups:
        indices = np.array(term_group.places, dtype=int).reshape(-1, len(term_group.slots))
        values = dict(at_points)
        values |= {slot: q[indices[:, k]] for k, slot in enumerate(term_group.slots)}
        for symbol, column in zip(term_group.constants, term_group.values, strict=True):
            values[symbol] = np.array([at_points[x] if x in at_points else np.full(count, float(x)) for x in column])
        for k, derivative in enumerate(term_group.partials):
            np.add.at(force, indices[:, k], array_value(derivative, values) + np.zeros((len(indices), count)))
    return list(force)


def exact_forces(
    term_groups: Sequence[TermGroup], coordinates: Sequence[Symbol], at_points: Mapping[Any, Number]
) -> list[Number]:
    """Return the force on each coordinate at one point, in 60 digits."""
    force: list[Number] = [mp.zero] * len(coordinates)
    for term_group in term_groups:
        shared_symbols = [symbol for symbol in at_points if symbol not in coordinates]
        tape = Tape(term_group.partials, (*term_group.slots, *term_group.constants, *shared_symbols))
        shared, numbers = [at_points[symbol] for symbol in shared_symbols], dict[Expr, Number]()
        for row, *constants in zip(term_group.places, *term_group.values, strict=True):
            for x in constants:
                numbers.setdefault(x, at_points[x] if x in at_points else evaluate(x, {}))
            derivatives = tape(
                [*(at_points[coordinates[index]] for index in row), *(numbers[x] for x in constants), *shared]
            )
            for index, force_term in zip(row, derivatives, strict=True):
                force[index] += force_term
    return force


Array = NDArray[np.float64]

SEED = 20250101
SPREADS = (1.0, 0.3, 0.1)
"""Scales of velocities or momenta; some Lagrangians are defined for small ones only."""
VERIFIED_AT = 3
"""Number of points at which an identity is tested."""
LONGEST_NUMBER = 1000
"""Longest numerator or denominator of exact numbers; longer ones are treated as parameters (measured values)."""


@dataclass(frozen=True, slots=True)
class Sample:
    """Values at one point (numbers) or at many points (arrays).

    Attributes:
        t: time.
        state: q, then p, 2 m entries.
        rates: their time derivatives.
        value: evaluates an expression in q, p, time and parameters.
    """

    t: Any
    state: tuple[Any, ...]
    rates: tuple[Any, ...]
    value: Callable[[Expr], Any]


@dataclass(frozen=True)
class Rates:
    """Rates of a system: v and L_q, or H_p and -H_q, as expressions in ``arguments``, time and ``constants``.

    Attributes:
        arguments: (q, v) for a Lagrangian, (q, p) for a Hamiltonian, then the constraint multipliers, which are treated
        as
            arbitrary: a quantity conserved for arbitrary multipliers is conserved.
        momenta: symbols of p.
        transformed: p for a Lagrangian, v for a Hamiltonian.
        forces: dp/dt, including g_q^T lambda of constraints.
        hamiltonian: whether the system is a Hamiltonian.
        time: t.
        constants: default value by parameter; long numbers of the formula are parameters here.
        numbers: long numbers by the symbols of their values.
        term_groups: term groups that contribute to the forces.
    """

    arguments: tuple[Symbol, ...]
    momenta: tuple[Symbol, ...]
    transformed: tuple[Expr, ...]
    forces: tuple[Expr, ...]
    hamiltonian: bool
    time: Symbol
    constants: Mapping[Symbol, float]
    numbers: Mapping[Symbol, sympy.Rational]
    term_groups: tuple[TermGroup, ...] = ()

    @property
    def closed(self) -> bool:
        """True if the rates contain only arguments, time and constants, so that they have values at a point."""
        variables = {*self.arguments, self.time, *self.constants}
        return all(formula.free_symbols <= variables for formula in (*self.transformed, *self.forces))

    def arrays(self, parameters: Mapping[Symbol, Array], count: int) -> Sample:
        """Sample ``count`` points; NaN where the system is undefined. Parameters: one number, or one per point."""
        generator = np.random.default_rng(SEED)
        m = len(self.momenta)
        values: dict[Any, Any] = {**parameters, self.time: generator.uniform(-1.5, 1.5, count)}
        for k, argument in enumerate(self.arguments):
            size = 1.5 if k < m else generator.choice(SPREADS, count)
            values[argument] = size * generator.uniform(-1.0, 1.0, count)
        numbers: dict[Any, Any] = {**values, **self.in_formulas(parameters)}
        with np.errstate(all="ignore"):
            group_forces = array_forces(self.term_groups, self.arguments[:m], values, count)
            moved = [array_value(e, numbers) + np.zeros(count) for e in (*self.transformed, *self.forces)]
            return self._sample(
                values, lambda expression: array_value(expression, values) + np.zeros(count), moved, group_forces
            )

    def in_formulas(self, parameters: Mapping[Symbol, Any]) -> dict[Expr, Any]:
        """Return the values of parameters by the long numbers in formulas that they stand for."""
        return {sign * number: sign * parameters[x] for x, number in self.numbers.items() for sign in (1, -1)}

    def points(self, parameters: Mapping[Symbol, Number], count: int) -> Iterator[Sample]:
        """Yield at most ``count`` points at which the system is defined, in 60 digits."""
        generator = random.Random(SEED)
        moved = (*self.transformed, *self.forces)
        numbers: dict[Any, Any] = {**parameters, **self.in_formulas(parameters)}
        tape = Tape(moved, (*self.arguments, self.time, *numbers))
        for attempt in range(ATTEMPTS):
            if count == 0:
                return
            values: dict[Any, Any] = {**parameters, self.time: mp.mpf(generator.uniform(-1.5, 1.5))}
            for k, argument in enumerate(self.arguments):
                size = 1.5 if k < len(self.momenta) else SPREADS[attempt % len(SPREADS)]
                values[argument] = mp.mpf(size * generator.uniform(-1.0, 1.0))
            try:
                computed = tape([numbers[x] if x in numbers else values[x] for x in tape.symbols])
                group_forces = exact_forces(self.term_groups, self.arguments[: len(self.momenta)], values)
                points = self._sample(values, functools.partial(_value_of, values), computed, group_forces)
            except ArithmeticError:
                continue
            count -= 1
            yield points

    @functools.cached_property
    def verifying(self) -> list[Sample]:
        """Points in 60 digits, empty if the system is defined nowhere; one suffices for term groups."""
        count = 1 if self.term_groups else VERIFIED_AT
        for near in (False, True):
            parameters = drawn_parameters(self.constants, 1, near=near)
            points = list(self.points({x: mp.mpf(float(value[0])) for x, value in parameters.items()}, count))
            if points:
                return points
        return []

    def _sample(
        self, values: dict[Any, Any], value: Callable[[Expr], Any], moved: Sequence[Any], group_forces: Sequence[Any]
    ) -> Sample:
        m = len(self.momenta)
        transformed, forces = tuple(moved[:m]), tuple(map(operator.add, moved[m:], group_forces))
        halves = (self.arguments[:m], self.arguments[m : 2 * m])
        q, second = (tuple(values[argument] for argument in half) for half in halves)
        p, v = (second, transformed) if self.hamiltonian else (transformed, second)
        values |= dict(zip(self.momenta, p, strict=True))
        return Sample(t=values[self.time], state=(*q, *p), rates=(*v, *forces), value=value)


def drawn_parameters(constants: Mapping[Symbol, float], count: int, *, near: bool) -> dict[Symbol, Array]:
    """Draw ``count`` values of each parameter: near its default, or of size 1 with the sign of the default."""
    generator = np.random.default_rng(len(constants))
    if near:
        return {x: value + (abs(value) or 1.0) * generator.uniform(-0.1, 0.1, count) for x, value in constants.items()}
    return {x: math.copysign(1.0, value) * generator.uniform(0.6, 1.7, count) for x, value in constants.items()}


def _value_of(values: Mapping[Symbol, Number], expression: Expr) -> Number:
    return evaluate(expression, {x: values[x] for x in expression.free_symbols})


def rates_of(system: MechanicalSystem, term_groups: tuple[TermGroup, ...] = ()) -> Rates:
    """Return the rates of a system with term groups ``term_groups``; long numbers count as parameters."""
    arguments, transformed = forms_of(system).legendre_arguments, forms_of(system).legendre
    forces = with_constraint_forces(system, forms_of(system).momentum_rate)
    numbers = _long_numbers((*transformed, *forces))
    return Rates(
        arguments=(*arguments, *constraint_multipliers(system)),
        momenta=system.momentum_symbols,
        transformed=transformed,
        forces=forces,
        hamiltonian=bool(system.auxiliaries),
        time=system.time,
        constants=system.constants | {parameter: float(number) for parameter, number in numbers.items()},
        numbers=numbers,
        term_groups=term_groups,
    )


def _long_numbers(expressions: Sequence[Expr]) -> dict[Symbol, sympy.Rational]:
    rationals = (part for part in parts(*expressions) if part.is_Rational)
    sizes = {abs(x) for x in rationals if max(abs(x.p), x.q) > LONGEST_NUMBER and abs(x.p) <= int(LARGEST) * x.q}
    return {sympy.Dummy(real=True): number for number in sorted(sizes, key=lambda x: Fraction(x.p, x.q))}
