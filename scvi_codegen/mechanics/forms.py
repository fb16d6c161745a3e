"""What the kernels compute: momentum, force, mass, the Euler-Lagrange residual, the scalar behind the shooting method.

L stands for the function of :class:`~scvi_codegen.mechanics.system.MechanicalSystem`: where a Hamiltonian is given it
is p . v - H, p its auxiliaries, and the results below depend on p, for which ``constitutive`` = v - H_p = 0 is solved.
Everything is differentiated term by term with :mod:`scvi_codegen.formulas.derivatives`; nothing is simplified and no
mass matrix is inverted. Accelerations and multipliers are symbols of their own, so a kernel is a function of plain
numbers.

All of it is derived once a system, when it is asked for: :func:`forms_of` gives equal systems the same :class:`Forms`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import sympy
from sympy import Expr, Symbol

from scvi_codegen.formulas.derivatives import gradient, jacobian
from scvi_codegen.mechanics.system import MechanicalSystem

__all__ = ["Entries", "Forms", "accelerations", "auxiliary_multipliers", "curve_rates", "forms_of", "multipliers"]

Entries = dict[tuple[int, int], Expr]
"""The non-zero entries of a matrix by (row, column), ascending."""


def accelerations(system: MechanicalSystem) -> tuple[Symbol, ...]:
    """The m symbols that stand for second time derivatives."""
    return tuple(sympy.Symbol(f"{q.name}_ddot", real=True) for q in system.coordinates)


def curve_rates(system: MechanicalSystem, count: int) -> tuple[tuple[Symbol, ...], ...]:
    """The symbols of the second and ``count - 1`` higher time derivatives of q, m each."""
    higher = [[sympy.Symbol(f"{q.name}_d{k}", real=True) for q in system.coordinates] for k in range(3, count + 2)]
    return (accelerations(system), *map(tuple, higher))[:count]


def multipliers(system: MechanicalSystem) -> tuple[Symbol, ...]:
    """The m multiplier symbols of a collocation node (shooting-based methods)."""
    return tuple(sympy.Symbol(f"{q.name}_multiplier", real=True) for q in system.coordinates)


def auxiliary_multipliers(system: MechanicalSystem) -> tuple[Symbol, ...]:
    """The multipliers of ``constitutive`` at a collocation node: m, or none without auxiliaries."""
    return tuple(sympy.Symbol(f"{p.name}_multiplier", real=True) for p in system.auxiliaries)


@dataclass(frozen=True)
class Forms:
    """What follows from the function of a system, each derived when it is first asked for, and kept."""

    system: MechanicalSystem

    @cached_property
    def momentum(self) -> tuple[Expr, ...]:
        """P = L_v, m expressions."""
        return self._slopes(self.system.lagrangian, self.system.velocities)

    @cached_property
    def force(self) -> tuple[Expr, ...]:
        """L_q, m expressions, and the forces beside it."""
        slopes = self._slopes(self.system.lagrangian, self.system.coordinates)
        return tuple(map(sympy.Add, slopes, self.system.forces)) if self.system.forces else slopes

    @cached_property
    def thrust(self) -> tuple[Expr, ...]:
        """What momenta change by in a unit of time, m expressions: :attr:`force` less their damping."""
        if self.system.damping == 0:
            return self.force
        return tuple(f - self.system.damping * p for f, p in zip(self.force, self.momentum, strict=True))

    @cached_property
    def mass(self) -> Entries:
        """L_vv."""
        return jacobian(self.momentum, self.system.velocities)

    @cached_property
    def lower_mass(self) -> Entries:
        """The lower triangle of L_vv, which is symmetric: all that a solver needs of it."""
        return {(i, j): entry for (i, j), entry in self.mass.items() if i >= j}

    @cached_property
    def constitutive(self) -> tuple[Expr, ...]:
        """L_p = v - H_p by the auxiliaries p, m expressions that vanish (paper (35f)); none without auxiliaries."""
        return self._slopes(self.system.lagrangian, self.system.auxiliaries)

    @cached_property
    def legendre_arguments(self) -> tuple[Symbol, ...]:
        """(q, v), or (q, p) of a Hamiltonian: what ``legendre`` and the formula of the system are functions of."""
        return (*self.system.coordinates, *(self.system.auxiliaries or self.system.velocities))

    @cached_property
    def legendre(self) -> tuple[Expr, ...]:
        """What the system gives in closed form, m expressions: p = L_v at (q, v), or v = H_p at (q, p)."""
        if not self.system.auxiliaries:
            return self.momentum
        return self._slopes(self.system.formula, self.system.auxiliaries)

    @cached_property
    def legendre_slopes(self) -> Entries:
        """L_vv, or H_pp."""
        return jacobian(self.legendre, self.system.auxiliaries) if self.system.auxiliaries else self.mass

    @cached_property
    def energy(self) -> Expr:
        """L_v . v - L, or H where it is given; conserved when time does not occur in it."""
        if self.system.auxiliaries:
            return self.system.formula
        products = [p * v for p, v in zip(self.momentum, self.system.velocities, strict=True)]
        return sympy.Add(*products, -self.system.lagrangian)

    @cached_property
    def euler_lagrange(self) -> tuple[Expr, ...]:
        """E = L_vv a + L_vq v + L_vt - L_q + gamma L_v, m expressions in (q, v, a, t), 0 on trajectories (paper (2)).

        Of a Hamiltonian: d/dt (v - H_p) = a - H_pq v + H_pp H_q - H_pt, in (q, v, a, p, t) with v = H_p.
        """
        system = self.system
        variables = (*system.velocities, *system.coordinates, system.time, *system.auxiliaries)
        rates = (*accelerations(system), *system.velocities, sympy.S.One, *self.thrust)
        if system.auxiliaries:
            return _along(self.constitutive, variables, rates)
        return tuple(rate - f for rate, f in zip(_along(self.momentum, variables, rates), self.thrust, strict=True))

    @cached_property
    def applied_force(self) -> tuple[Expr, ...]:
        """F = L_q - L_vq v - L_vt - gamma L_v, m expressions in (q, v, t), equal to L_vv a on trajectories."""
        at_rest = dict.fromkeys(accelerations(self.system), sympy.S.Zero)
        return tuple(-residual.xreplace(at_rest) for residual in self.euler_lagrange)

    @cached_property
    def multiplied_residual(self) -> Expr:
        """Lambda . E: the scalar whose stationarity makes a collocation residual vanish, with its multipliers.

        Of a Hamiltonian also the product of ``constitutive`` with its multipliers. Forces are left out of E: they stand
        in :attr:`multiplied_forces`.
        """
        terms: list[Expr] = []
        factors = (*multipliers(self.system), *auxiliary_multipliers(self.system))
        forces = self.system.forces or (sympy.S.Zero,) * self.system.dimension
        unforced = tuple(map(sympy.Add, self.euler_lagrange, forces))
        for factor, residual in zip(factors, (*unforced, *self.constitutive), strict=True):
            terms.extend(factor * term for term in sympy.Add.make_args(residual))
        return sympy.Add(*terms)

    @cached_property
    def multiplied_forces(self) -> tuple[tuple[Expr, ...], ...]:
        """What forces add to the slopes of ``multiplied_residual`` by q, v, a and lambda, m expressions each; or none.

        The variations of a curve that a multiplier rules follow the adjoint of the linearised equations of motion:
        only then is the error of the curve felt in second order, and the order of the method kept. The adjoint of
        -f_q x - f_v x' is -f_q^T x + (f_v^T x)', and E of L alone is its own.
        """
        system, m = self.system, self.system.dimension
        if not system.forces:
            return ()
        factors = multipliers(system)
        by_position = _along(system.forces, system.coordinates, factors)
        by_velocity = _along(system.forces, system.velocities, factors)
        variables = (*system.velocities, *system.coordinates, system.time)
        rates = (*accelerations(system), *system.velocities, sympy.S.One)
        swept = _along(by_velocity, variables, rates)
        still = (sympy.S.Zero,) * m
        return (
            tuple(x - y for x, y in zip(swept, by_position, strict=True)),
            by_velocity,
            still,
            tuple(-f for f in system.forces),
        )

    @cached_property
    def separable(self) -> bool:
        """Whether L = sum m_i v_i^2 / 2 - V(q, t) with constant masses, as seen in the structure of its derivatives.

        Not with damping: velocities at points are then other sums of forces than those in the tables of a method.
        """
        if self.system.auxiliaries or self.system.damping != 0:
            return False
        constant = set(self.system.parameters)
        if any(i != j or not entry.free_symbols <= constant for (i, j), entry in self.mass.items()):
            return False
        at_rest = dict.fromkeys(self.system.velocities, sympy.S.Zero)
        still = all(p.xreplace(at_rest) == 0 for p in self.momentum)
        return still and not jacobian(self.force, self.system.velocities)

    @cached_property
    def split(self) -> bool:
        """Whether H = T(p) + V(q, t), as seen in the structure of its derivatives; forces may depend on q and t."""
        system = self.system
        if (
            not system.auxiliaries
            or system.damping != 0
            or system.time in set().union(*(v.free_symbols for v in self.legendre))
        ):
            return False
        return not jacobian(self.legendre, system.coordinates) and not jacobian(
            self.force, (*system.velocities, *system.auxiliaries)
        )

    def rates(self, count: int) -> tuple[Expr, ...]:
        """First dL/dt, .., d^count L/dt^count along a curve, in (q, v, t) and :func:`curve_rates`."""
        system = self.system
        curve = (system.coordinates, system.velocities, *curve_rates(system, count))
        variables = (*(symbol for group in curve[:-1] for symbol in group), system.time)
        rates = (*(symbol for group in curve[1:] for symbol in group), sympy.S.One)
        found = [system.lagrangian]
        for _ in range(count):
            found.append(_along(found[-1:], variables, rates)[0])
        return tuple(found[1:])

    @staticmethod
    def _slopes(scalar: Expr, variables: Sequence[Symbol]) -> tuple[Expr, ...]:
        slopes = gradient(scalar, variables)
        return tuple(slopes.get(i, sympy.S.Zero) for i in range(len(variables)))


@lru_cache(maxsize=64)
def forms_of(system: MechanicalSystem) -> Forms:
    """The forms of a system."""
    return Forms(system)


def _along(expressions: Sequence[Expr], variables: Sequence[Symbol], direction: Sequence[Expr]) -> tuple[Expr, ...]:
    """Derivatives along a direction; the time derivatives, along the rates of the variables."""
    terms: list[list[Expr]] = [[] for _ in expressions]
    for (i, j), slope in jacobian(expressions, variables).items():
        terms[i].append(slope * direction[j])
    return tuple(sympy.Add(*row) for row in terms)
