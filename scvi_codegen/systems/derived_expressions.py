"""Expressions that generated kernels evaluate: momentum, force, mass matrix, Euler-Lagrange residual and its product.

L denotes the function of :class:`~scvi_codegen.systems.system.MechanicalSystem`. For a Hamiltonian it is p . v - H
with p as auxiliary variables; the expressions below then depend on p, which solves ``constitutive`` = v - H_p = 0.
Everything is differentiated term by term with :mod:`scvi_codegen.systems.formulas.expressions`; nothing is simplified
and no mass matrix is inverted. Accelerations and multipliers are separate symbols, so a kernel is a function of plain
numbers.

Each expression is derived on first use, once per system: :func:`forms_of` returns the same :class:`Forms` for equal
systems. The regularity of the mass matrix d2L/dv2, or of d2H/dp2, is tested in 60 digits at random points.
"""

import random
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import tee
from typing import Any

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Expr, Matrix, Symbol
from sympy.utilities.iterables import connected_components

from scvi_codegen.common.precision import Number, mp
from scvi_codegen.systems import constraints
from scvi_codegen.systems.formulas.expressions import (
    NEGLIGIBLE,
    Tape,
    dot,
    gradient_tuple,
    hessian,
    jacobian,
    kinks_of,
    tangents,
)
from scvi_codegen.systems.formulas.intermediates import separated
from scvi_codegen.systems.system import MechanicalSystem

Entries = dict[tuple[int, int], Expr]
"""The non-zero entries of a matrix by (row, column), ascending."""


def accelerations(system: MechanicalSystem) -> tuple[Symbol, ...]:
    """Return the m symbols of the second time derivatives."""
    return tuple(sympy.Symbol(f"{q.name}_ddot", real=True) for q in system.coordinates)


def curve_rates(system: MechanicalSystem, count: int) -> tuple[tuple[Symbol, ...], ...]:
    """Return the symbols of the time derivatives of q of orders 2 to ``count + 1``, m per order."""
    higher = [[sympy.Symbol(f"{q.name}_d{k}", real=True) for q in system.coordinates] for k in range(3, count + 2)]
    return (accelerations(system), *map(tuple, higher))[:count]


def multipliers(system: MechanicalSystem) -> tuple[Symbol, ...]:
    """Return the m multiplier symbols of a collocation node (shooting-based methods)."""
    return tuple(sympy.Symbol(f"{q.name}_multiplier", real=True) for q in system.coordinates)


def auxiliary_multipliers(system: MechanicalSystem) -> tuple[Symbol, ...]:
    """Return the multipliers of ``constitutive`` at a collocation node: m, or none without auxiliary variables."""
    return tuple(sympy.Symbol(f"{p.name}_multiplier", real=True) for p in system.auxiliaries)


@dataclass(frozen=True, slots=True)
class InverseMass:
    """Solution of L_vv v = p in two parts, of which the first depends on positions only.

    Attributes:
        velocities: v = L_vv^-1 p in (q, p).
        terms: expressions in q that occur in it, such as gains and inverse pivots.
        symbols: symbols of their values.
        solution: v in these symbols and p.
    """

    velocities: tuple[Expr, ...]
    terms: tuple[Expr, ...]
    symbols: tuple[Symbol, ...]
    solution: tuple[Expr, ...]


@dataclass(frozen=True)
class Forms:
    """Expressions derived from the function of a system, each computed on first access and cached."""

    system: MechanicalSystem

    @cached_property
    def momentum(self) -> tuple[Expr, ...]:
        """P = L_v, m expressions."""
        return gradient_tuple(self.system.lagrangian, self.system.velocities)

    @cached_property
    def force(self) -> tuple[Expr, ...]:
        """L_q plus the generalised forces, m expressions."""
        partials = gradient_tuple(self.system.lagrangian, self.system.coordinates)
        return tuple(map(sympy.Add, partials, self.system.forces)) if self.system.forces else partials

    @cached_property
    def momentum_rate(self) -> tuple[Expr, ...]:
        """Rate of change of the momenta, m expressions: :attr:`force` minus the damping gamma p."""
        if self.system.damping == 0:
            return self.force
        return tuple(f - self.system.damping * p for f, p in zip(self.force, self.momentum, strict=True))

    @cached_property
    def multipliers(self) -> tuple[Symbol, ...]:
        """Lagrange multipliers lambda, one for each constraint."""
        return multipliers(self.system)

    @cached_property
    def auxiliary_multipliers(self) -> tuple[Symbol, ...]:
        """Multipliers nu of the constitutive equations, one for each auxiliary variable."""
        return auxiliary_multipliers(self.system)

    @cached_property
    def position_conditions(self) -> tuple[Expr, ...]:
        """See :func:`~scvi_codegen.systems.constraints.position_conditions`: g(q, t) of each constraint."""
        return constraints.position_conditions(self.system)

    @cached_property
    def velocity_conditions(self) -> tuple[Expr, ...]:
        """See :func:`~scvi_codegen.systems.constraints.velocity_conditions`: A v + b of each constraint."""
        return constraints.velocity_conditions(self.system)

    @cached_property
    def constraint_rates(self) -> tuple[Expr, ...]:
        """See :func:`~scvi_codegen.systems.constraints.constraint_rates`: g_q v + g_t, or A v + b."""
        return constraints.constraint_rates(self.system)

    @cached_property
    def force_directions(self) -> Entries:
        """See :func:`~scvi_codegen.systems.constraints.force_directions`: D of the forces D^T lambda."""
        return constraints.force_directions(self.system)

    @cached_property
    def idle_multipliers(self) -> tuple[Expr, ...]:
        """See :func:`~scvi_codegen.systems.constraints.idle_multipliers`: 0 where the constraint is imposed."""
        return constraints.idle_multipliers(self.system)

    def with_constraint_forces(self, forces: Sequence[Expr]) -> tuple[Expr, ...]:
        """Return m forces plus those of the constraints."""
        return constraints.with_constraint_forces(self.system, forces)

    @property
    def masses_of_groups(self) -> tuple[tuple[int, int], ...]:
        """Entries (i, j), i >= j, of the mass matrix to which term groups add that are not in the formula."""
        return getattr(self.system, "further_masses", ())

    @cached_property
    def mass(self) -> Entries:
        """Mass matrix L_vv; entries of term groups, whose values loops add, are 0."""
        entries = jacobian(self.momentum, self.system.velocities, symmetric=True)
        pairs = self.masses_of_groups
        further = dict.fromkeys((*pairs, *((j, i) for i, j in pairs)), sympy.S.Zero)
        return dict(sorted((further | entries).items())) if further else entries

    @cached_property
    def lower_mass(self) -> Entries:
        """Lower triangle of the symmetric mass matrix L_vv; solvers need only this part."""
        return {(i, j): entry for (i, j), entry in self.mass.items() if i >= j}

    @cached_property
    def inverse_mass(self) -> InverseMass | None:
        """Solution with a variable mass matrix by the derivative of the dual energy; ``None`` if that is unknown.

        The dual energy of another Lagrangian, which a copy of a system may still have, is detected at a random point,
        and not used. Constant rotations of bodies are orthogonal only to round-off, and so is the agreement.
        """
        system, momenta = self.system, self.system.momentum_symbols
        energy = system.dual_energy
        if energy == 0 or system.constraints or system.damping != 0 or system.clock:
            return None
        velocities = gradient_tuple(energy, momenta)
        point = next(sample_points(momenta, system.coordinates, system.constants))
        values = dict(zip(system.velocities, Tape(velocities, list(point))(list(point.values())), strict=True))
        again = Tape(self.momentum, [*point, *values])([*point.values(), *values.values()])
        if any(abs(p - point[symbol]) > SAME_MOMENTUM for p, symbol in zip(again, momenta, strict=True)):
            return None
        solution, parts = separated(velocities, frozenset(momenta))
        return InverseMass(velocities, tuple(parts), tuple(parts.values()), tuple(solution)) if parts else None

    @cached_property
    def mass_terms(self) -> tuple[Expr, ...]:
        """Expressions from which systems with the mass matrix are solved: terms of its inverse, or its lower half."""
        return self.inverse_mass.terms if self.inverse_mass else tuple(self.lower_mass.values())

    @cached_property
    def constitutive(self) -> tuple[Expr, ...]:
        """Constitutive residual L_p = v - H_p, m expressions (paper (35f)); empty for a Lagrangian."""
        return gradient_tuple(self.system.lagrangian, self.system.auxiliaries)

    @cached_property
    def legendre_arguments(self) -> tuple[Symbol, ...]:
        """Arguments of ``legendre`` and of the system's formula: (q, v), or (q, p) for a Hamiltonian."""
        return (*self.system.coordinates, *(self.system.auxiliaries or self.system.velocities))

    @cached_property
    def one_form(self) -> tuple[Expr, ...]:
        """Momenta theta(q, y, t) of a first-order system, functions of its auxiliary variables y; else empty.

        Empty also if theta = y: such a system is Hamiltonian in the usual sense.
        """
        return () if self.system.is_canonical else self.momentum

    @cached_property
    def legendre(self) -> tuple[Expr, ...]:
        """Legendre transform in closed form, m expressions: p = L_v at (q, v), or v = H_p at (q, p).

        Of a first-order system the momenta theta(q, y, t).
        """
        if not self.system.auxiliaries or self.one_form:
            return self.momentum
        return gradient_tuple(self.system.formula, self.system.auxiliaries)

    @cached_property
    def regular_legendre(self) -> tuple[Expr, ...]:
        """Legendre transform with the gauge energy, by which it is invertible: (H + gauge)_p, or (L + gauge)_v."""
        energy = self.system.gauge
        if energy == 0:
            return self.legendre
        gauge = gradient_tuple(energy, self.legendre_arguments[self.system.dimension :])
        return tuple(map(sympy.Add, self.legendre, gauge))

    @cached_property
    def legendre_jacobian(self) -> Entries:
        """Jacobian of ``regular_legendre``: L_vv, or H_pp; empty if the inverse of L_vv is known."""
        if self.inverse_mass:
            return {}
        if not self.system.auxiliaries and self.regular_legendre is self.momentum:
            return self.mass
        return jacobian(self.regular_legendre, self.legendre_arguments[self.system.dimension :])

    @cached_property
    def energy(self) -> Expr:
        """Energy L_v . v - L, or H for a Hamiltonian; conserved if it does not depend on time."""
        if self.system.auxiliaries:
            return self.system.formula
        return dot(self.momentum, self.system.velocities) - self.system.lagrangian

    @cached_property
    def euler_lagrange(self) -> tuple[Expr, ...]:
        """Euler-Lagrange residual d/dt L_v - L_q + gamma L_v in (q, v, a, t), m expressions (paper (2)).

        For a Hamiltonian: d/dt (v - H_p) = a - H_pq v + H_pp H_q - H_pt, in (q, v, a, p, t) with v = H_p.
        """
        system = self.system
        variables = (*system.velocities, *system.coordinates, system.time, *system.auxiliaries)
        rates = (*accelerations(system), *system.velocities, sympy.S.One, *self.momentum_rate)
        if system.auxiliaries:
            return tangents(self.constitutive, variables, rates)
        return tuple(
            rate - f for rate, f in zip(tangents(self.momentum, variables, rates), self.momentum_rate, strict=True)
        )

    @cached_property
    def applied_force(self) -> tuple[Expr, ...]:
        """F = L_q - L_vq v - L_vt - gamma L_v, m expressions in (q, v, t), equal to L_vv a on trajectories."""
        at_rest = dict.fromkeys(accelerations(self.system), sympy.S.Zero)
        return tuple(-residual.xreplace(at_rest) for residual in self.euler_lagrange)

    @cached_property
    def multiplied_residual(self) -> Expr:
        """Scalar lambda . E whose derivatives with respect to the multipliers lambda are the collocation residuals.

        For a Hamiltonian it includes the product of ``constitutive`` with its multipliers. Forces are not part of E
        here; see :attr:`multiplied_forces`.
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
        """Contributions of forces to the derivatives of ``multiplied_residual`` by q, v, a and lambda, m each.

        Empty without forces. The multipliers must satisfy the adjoint of the linearised equations of motion: only then
        is the effect of the error of the curve quadratic, and the order preserved. The adjoint of -f_q x - f_v x'
        is -f_q^T x + (f_v^T x)'; the E of an unforced L is self-adjoint.
        """
        system, m = self.system, self.system.dimension
        if not system.forces:
            return ()
        factors = multipliers(system)
        by_position = tangents(system.forces, system.coordinates, factors)
        by_velocity = tangents(system.forces, system.velocities, factors)
        variables = (*system.velocities, *system.coordinates, system.time)
        rates = (*accelerations(system), *system.velocities, sympy.S.One)
        rates_by_velocity = tangents(by_velocity, variables, rates)
        still = (sympy.S.Zero,) * m
        return (
            tuple(x - y for x, y in zip(rates_by_velocity, by_position, strict=True)),
            by_velocity,
            still,
            tuple(-f for f in system.forces),
        )

    @cached_property
    def separable(self) -> bool:
        """True if L = sum m_i v_i^2 / 2 - V(q, t) with constant masses, without forces that depend on velocities."""
        return self.has_constant_masses and not self.forces_depend_on_velocities

    @cached_property
    def forces_depend_on_velocities(self) -> bool:
        """True if :attr:`force` depends on velocities, judged by its derivatives, or by them across a jump."""
        moving = set(self.system.velocities)
        jumps = any(kink.free_symbols & moving for kink in kinks_of(self.force))
        return jumps or bool(jacobian(self.force, self.system.velocities))

    @cached_property
    def has_constant_masses(self) -> bool:
        """True if L = sum m_i v_i^2 / 2 - V(q, t) with constant masses, judged by the structure of its derivatives."""
        return self.has_constant_mass_matrix and all(i == j for i, j in self.mass) and not any(self.momentum_at_rest)

    @cached_property
    def has_constant_mass_matrix(self) -> bool:
        """True if L = v^T M v / 2 + A(q, t) v - V(q, t) with constant M, judged by the structure of its derivatives.

        False with damping: velocities at the points are then not the sums of forces in the tables of a method.
        """
        if self.system.auxiliaries or self.system.damping != 0 or self.inverse_mass or self.masses_of_groups:
            return False
        constant = set(self.system.parameters)
        return all(entry.free_symbols <= constant for entry in self.mass.values())

    @cached_property
    def has_quadratic_energy(self) -> bool:
        """True if L = v^T M(q, t) v / 2 + A(q, t) v - V(q, t), judged by the structure of its derivatives."""
        if self.system.auxiliaries or self.inverse_mass:
            return False
        velocities = set(self.system.velocities)
        return not any(entry.free_symbols & velocities for entry in self.mass.values())

    @cached_property
    def momentum_at_rest(self) -> tuple[Expr, ...]:
        """L_v at v = 0, m expressions: the A(q, t) of terms A v of L."""
        at_rest = dict.fromkeys(self.system.velocities, sympy.S.Zero)
        return tuple(p.xreplace(at_rest) for p in self.momentum)

    def rates(self, count: int) -> tuple[Expr, ...]:
        """Return dL/dt, .., d^count L/dt^count along a curve, in (q, v, t) and :func:`curve_rates`."""
        system = self.system
        curve = (system.coordinates, system.velocities, *curve_rates(system, count))
        variables = (*(symbol for group in curve[:-1] for symbol in group), system.time)
        rates = (*(symbol for group in curve[1:] for symbol in group), sympy.S.One)
        derivatives_of_l = [system.lagrangian]
        for _ in range(count):
            derivatives_of_l.append(tangents(derivatives_of_l[-1:], variables, rates)[0])
        return tuple(derivatives_of_l[1:])


@lru_cache(maxsize=64)
def forms_of(system: MechanicalSystem) -> Forms:
    """Return the :class:`Forms` of a system; equal systems share one."""
    return Forms(system)


LARGEST_NULL_SPACE = 8
SAME_MOMENTUM = 1e-12
"""Largest difference of momenta of order 1/10 that may be due to rounded constants."""


def dense(places: Iterable[tuple[int, int]], values: Iterable[Any], shape: tuple[int, int]) -> NDArray[np.float64]:
    """Return the matrix of double precision with these entries, 0 elsewhere."""
    matrix = np.zeros(shape)
    for place, value in zip(places, values, strict=True):
        matrix[place] = float(value)
    return matrix


def singular_part(
    scalar: Expr, variables: Sequence[Symbol], others: Sequence[Symbol], constants: Mapping[Symbol, float]
) -> tuple[tuple[Symbol, ...], Entries] | None:
    """Return coupled variables whose block of the Hessian is singular at every sampled point, and the block.

    Args:
        scalar: L or H.
        variables: with respect to which it is differentiated twice.
        others: other variables that it may depend on.
        constants: values of parameters.

    Returns:
        ``None`` if every block is regular at one point at least, or could not be evaluated at any. An empty block means
        that the Hessian is structurally singular.
    """
    entries = hessian(scalar, variables)
    size = len(variables)
    if not all((index, index) in entries for index in range(size)) and _structural_rank(entries, size) < size:
        rows = {row for row, _ in entries}
        missing = tuple(variable for index, variable in enumerate(variables) if index not in rows)
        return missing, {}
    points = sample_points(variables, others, constants)
    for block in coupled_blocks(entries, size):
        local = {
            (i, j): entries[row, column]
            for i, row in enumerate(block)
            for j, column in enumerate(block)
            if (row, column) in entries
        }
        points, same = tee(points)  # points are drawn lazily, and shared by all blocks
        if _is_singular(local, len(block), same):
            return tuple(variables[index] for index in block), local
    return None


def _is_singular(entries: Entries, size: int, points: Iterable[dict[Symbol, Number]]) -> bool:
    """Return whether a block is singular at every point where it has values, of which there is at least one."""
    if size == 1 and entries[0, 0].is_Rational:
        return False
    evaluated = False
    for values in values_at(points, list(entries.values())):
        evaluated = True
        if _regular(dict(zip(entries, values, strict=True)), size):
            return False
    return evaluated


def null_direction(entries: Entries, variables: Sequence[Symbol]) -> str:
    """Return a null vector of a singular block as text; empty for large blocks and irrational entries."""
    size = len(variables)
    if not entries or size > LARGEST_NULL_SPACE or not all(entry.is_Rational for entry in entries.values()):
        return ""
    vectors = Matrix(size, size, lambda row, column: entries.get((row, column), 0)).nullspace()
    return ", ".join(f"{variable} = {value}" for variable, value in zip(variables, vectors[0], strict=True))


def sample_points(
    variables: Sequence[Symbol], others: Sequence[Symbol], constants: Mapping[Symbol, float]
) -> Iterator[dict[Symbol, Number]]:
    """Yield reproducible random points: ``others`` of order 1/2, 1 and 10, ``variables`` from 1/1000 to 1."""
    generator = random.Random(20250101)
    fixed = {constant: mp.mpf(value) for constant, value in constants.items()}

    def spread(symbols: Sequence[Symbol], scale: float) -> dict[Symbol, Number]:
        return {symbol: mp.mpf(scale * generator.uniform(-1, 1)) for symbol in symbols}

    for own_scale in (0.1, 1e-3, 1.0):
        for scale in (1.0, 0.5, 10.0):
            yield fixed | spread(others, scale) | spread(variables, own_scale)


def values_at(points: Iterable[dict[Symbol, Number]], expressions: Sequence[Expr]) -> Iterator[list[Number]]:
    """Yield the values of expressions at the points at which they are defined."""
    tape = None
    for point in points:
        tape = tape or Tape(expressions, list(point))
        with suppress(ArithmeticError):
            yield tape(list(point.values()))


def _structural_rank(entries: Entries, size: int) -> int:
    # imported here because SciPy is slow to import and rarely needed
    from scipy.sparse import csr_matrix
    from scipy.sparse.csgraph import structural_rank

    rows, columns = np.array(list(entries), dtype=np.int64).reshape(-1, 2).T
    return int(structural_rank(csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(size, size))))


def inverse_by_minors(matrix: Matrix) -> Matrix:
    """Return adjugate / determinant: undefined only where a matrix is singular, while pivots may vanish elsewhere."""
    return matrix.adjugate() / matrix.det(method="berkowitz")


def coupled_blocks(entries: Entries, size: int) -> list[list[int]]:
    """Return the connected components of the variables, coupled by non-zero entries, as lists of indices."""
    return [sorted(block) for block in connected_components((range(size), list(entries)))]


def _regular(matrix: dict[tuple[int, int], Number], size: int) -> bool:
    """Return whether a matrix is regular, by elimination with complete pivoting in 60 digits on sparse, scaled rows."""
    rows: list[dict[int, Number]] = [{} for _ in range(size)]
    for (row, column), value in matrix.items():
        rows[row][column] = value
    rows = [{column: value / scale for column, value in row.items()} for row in rows if (scale := _largest(row))]
    if len(rows) < size:
        return False
    while rows:
        best = max(range(len(rows)), key=lambda index: _largest(rows[index]))
        pivot_row = rows.pop(best)
        if _largest(pivot_row) < NEGLIGIBLE:
            return False
        pivot = max(pivot_row, key=lambda column: abs(pivot_row[column]))
        rows = [_eliminated(row, pivot_row, pivot) if pivot in row else row for row in rows]
    return True


def _largest(row: Mapping[int, Number]) -> Number:
    return max(map(abs, row.values()), default=mp.zero)


def _eliminated(row: Mapping[int, Number], pivot_row: Mapping[int, Number], pivot: int) -> dict[int, Number]:
    factor = row[pivot] / pivot_row[pivot]
    result = dict(row)
    for column, value in pivot_row.items():
        result[column] = result.get(column, mp.zero) - factor * value
    del result[pivot]
    return result
