"""Systems at random points: positions, momenta and their rates of change, as arrays of binary64 or in 60 digits.

Time derivatives of functions of (q, p, t) follow from these without solving for accelerations: along every trajectory
dq/dt = v and dp/dt = L_q with p = L_v for a Lagrangian, dq/dt = H_p and dp/dt = -H_q for a Hamiltonian. With random
v (or p), an analytic function that is zero at all points is identically zero.
"""

from __future__ import annotations

import functools
import math
import random
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Expr, Symbol

from scvi_codegen.formulas.subexpressions import parts
from scvi_codegen.formulas.tape import Tape, evaluate
from scvi_codegen.mechanics.constraints import constraint_multipliers, with_constraint_forces
from scvi_codegen.mechanics.derived_expressions import forms_of
from scvi_codegen.mechanics.symmetry.group_forces import LARGEST, array_forces, array_value, exact_forces
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.mechanics.term_groups import TermGroup
from scvi_codegen.tables.precision import Number, mp

Array = NDArray[np.float64]

SEED = 20250101
SPREADS = (1.0, 0.3, 0.1)
"""Scales of velocities or momenta; some Lagrangians are defined for small ones only."""
ATTEMPTS = 24
VERIFIED_AT = 3
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
        numbers: long numbers by the symbols that replace them.
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
        known = {*self.arguments, self.time, *self.constants}
        return all(formula.free_symbols <= known for formula in (*self.transformed, *self.forces))

    def arrays(self, parameters: Mapping[Symbol, Array], count: int) -> Sample:
        """Sample ``count`` points; NaN where the system is undefined. Parameters: one number, or one per point."""
        generator = np.random.default_rng(SEED)
        m = len(self.momenta)
        values: dict[Any, Any] = {**parameters, self.time: generator.uniform(-1.5, 1.5, count)}
        for k, argument in enumerate(self.arguments):
            size = 1.5 if k < m else generator.choice(SPREADS, count)
            values[argument] = size * generator.uniform(-1.0, 1.0, count)
        with np.errstate(all="ignore"):
            group_forces = array_forces(self.term_groups, self.arguments[:m], values, count)
            return self._sample(
                values, lambda expression: array_value(expression, values) + np.zeros(count), group_forces
            )

    def points(self, parameters: Mapping[Symbol, Number], count: int) -> Iterator[Sample]:
        """Yield at most ``count`` points at which the system is defined, in 60 digits."""
        generator = random.Random(SEED)
        moved = (*self.transformed, *self.forces)
        tape = Tape(moved, (*self.arguments, self.time, *parameters))
        for attempt in range(ATTEMPTS):
            if count == 0:
                return
            values: dict[Any, Any] = {**parameters, self.time: mp.mpf(generator.uniform(-1.5, 1.5))}
            for k, argument in enumerate(self.arguments):
                size = 1.5 if k < len(self.momenta) else SPREADS[attempt % len(SPREADS)]
                values[argument] = mp.mpf(size * generator.uniform(-1.0, 1.0))
            try:
                known = dict(zip(moved, tape([values[x] for x in tape.symbols]), strict=True))
                group_forces = exact_forces(self.term_groups, self.arguments[: len(self.momenta)], values)
                points = self._sample(values, functools.partial(_known_or_evaluated, known, values), group_forces)
            except ArithmeticError:
                continue
            count -= 1
            yield points

    @functools.cached_property
    def verifying(self) -> list[Sample]:
        """Points in 60 digits, empty if the system is defined nowhere; one suffices for term groups."""
        count = 1 if self.term_groups else VERIFIED_AT
        for near in (False, True):
            drawn = drawn_parameters(self.constants, 1, near=near)
            points = list(self.points({x: mp.mpf(float(value[0])) for x, value in drawn.items()}, count))
            if points:
                return points
        return []

    def _sample(self, values: dict[Any, Any], value: Callable[[Expr], Any], group_forces: Sequence[Any]) -> Sample:
        m = len(self.momenta)
        transformed, forces = (tuple(map(value, expressions)) for expressions in (self.transformed, self.forces))
        forces = tuple(force + pull for force, pull in zip(forces, group_forces, strict=True))
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


def _known_or_evaluated(known: Mapping[Expr, Number], values: Mapping[Symbol, Number], expression: Expr) -> Number:
    if expression in known:
        return known[expression]
    return evaluate(expression, {x: values[x] for x in expression.free_symbols})


def rates_of(system: MechanicalSystem, term_groups: tuple[TermGroup, ...] = ()) -> Rates:
    """Return the rates of a system with term groups ``term_groups``; long numbers are replaced by parameters."""
    arguments, transformed = forms_of(system).legendre_arguments, forms_of(system).legendre
    forces = with_constraint_forces(system, forms_of(system).momentum_rate)
    numbers = _long_numbers((*transformed, *forces))
    if numbers:
        replaced = {sign * number: sign * parameter for parameter, number in numbers.items() for sign in (1, -1)}
        transformed, forces = (tuple(e.xreplace(replaced) for e in part) for part in (transformed, forces))
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
    """Return a symbol for each absolute value of a long number."""
    rationals = (part for part in parts(*expressions) if part.is_Rational)
    sizes = {abs(x) for x in rationals if max(abs(x.p), x.q) > LONGEST_NUMBER and abs(x) < LARGEST}
    return {sympy.Dummy(real=True): number for number in sorted(sizes)}
