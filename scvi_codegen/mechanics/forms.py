"""What the kernels compute: momentum, force, the Euler-Lagrange residual, and the scalar behind the shooting method.

L stands for the function of :class:`~scvi_codegen.mechanics.system.MechanicalSystem`: where a Hamiltonian is given it
is p . v - H, p its auxiliaries, and the results below depend on p, for which ``constitutive`` = v - H_p = 0 is solved.
Everything is differentiated term by term with :mod:`scvi_codegen.formulas.derivatives`; nothing is simplified and no
mass matrix is inverted. Accelerations and multipliers are symbols of their own, so a kernel is a function of plain
numbers.
"""

from __future__ import annotations

from collections.abc import Sequence

import sympy

from scvi_codegen.formulas.derivatives import gradient, jacobian
from scvi_codegen.mechanics.system import MechanicalSystem

__all__ = [
    "accelerations",
    "applied_force",
    "auxiliary_multipliers",
    "constitutive",
    "curve_rates",
    "energy",
    "euler_lagrange",
    "force",
    "is_separable",
    "lagrangian_rates",
    "legendre_map",
    "mass_entries",
    "momentum",
    "multiplied_residual",
    "multipliers",
]


def accelerations(system: MechanicalSystem) -> tuple[sympy.Symbol, ...]:
    """The m symbols that stand for second time derivatives."""
    return tuple(sympy.Symbol(f"{q.name}_ddot", real=True) for q in system.coordinates)


def curve_rates(system: MechanicalSystem, count: int) -> tuple[tuple[sympy.Symbol, ...], ...]:
    """The symbols of the second and ``count - 1`` higher time derivatives of q, m each."""
    higher = [[sympy.Symbol(f"{q.name}_d{k}", real=True) for q in system.coordinates] for k in range(3, count + 2)]
    return (accelerations(system), *map(tuple, higher))[:count]


def multipliers(system: MechanicalSystem) -> tuple[sympy.Symbol, ...]:
    """The m multiplier symbols of a collocation node (shooting-based methods)."""
    return tuple(sympy.Symbol(f"{q.name}_multiplier", real=True) for q in system.coordinates)


def auxiliary_multipliers(system: MechanicalSystem) -> tuple[sympy.Symbol, ...]:
    """The multipliers of ``constitutive`` at a collocation node: m, or none without auxiliaries."""
    return tuple(sympy.Symbol(f"{p.name}_multiplier", real=True) for p in system.auxiliaries)


def _dense(entries: dict[int, sympy.Expr], size: int) -> tuple[sympy.Expr, ...]:
    return tuple(entries.get(i, sympy.S.Zero) for i in range(size))


def momentum(system: MechanicalSystem) -> tuple[sympy.Expr, ...]:
    """P = dL/dv, m expressions."""
    return _dense(gradient(system.lagrangian, system.velocities), system.dimension)


def force(system: MechanicalSystem) -> tuple[sympy.Expr, ...]:
    """dL/dq, m expressions."""
    return _dense(gradient(system.lagrangian, system.coordinates), system.dimension)


def mass_entries(system: MechanicalSystem) -> dict[tuple[int, int], sympy.Expr]:
    """Non-zero entries of the mass matrix d2L/dv2 by (row, column), ascending."""
    return jacobian(momentum(system), system.velocities)


def constitutive(system: MechanicalSystem) -> tuple[sympy.Expr, ...]:
    """DL/dp = v - H_p by the auxiliaries p, m expressions that vanish (paper (35f)); none without auxiliaries."""
    return _dense(gradient(system.lagrangian, system.auxiliaries), len(system.auxiliaries))


def legendre_map(system: MechanicalSystem) -> tuple[tuple[sympy.Symbol, ...], tuple[sympy.Expr, ...]]:
    """What the system gives in closed form, with its arguments: p = L_v at (q, v), or v = H_p at (q, p)."""
    if not system.auxiliaries:
        return (*system.coordinates, *system.velocities), momentum(system)
    slopes = gradient(system.formula, system.auxiliaries)
    return (*system.coordinates, *system.auxiliaries), _dense(slopes, system.dimension)


def energy(system: MechanicalSystem) -> sympy.Expr:
    """DL/dv . v - L, or H where it is given; conserved when time does not occur in it."""
    if system.auxiliaries:
        return system.formula
    products = [p * v for p, v in zip(momentum(system), system.velocities, strict=True)]
    return sympy.Add(*products, -system.lagrangian)


def euler_lagrange(system: MechanicalSystem) -> tuple[sympy.Expr, ...]:
    """E = L_vv a + L_vq v + L_vt - L_q, m expressions in (q, v, a, t), zero on trajectories (paper (2)).

    Of a Hamiltonian: d/dt (v - H_p) = a - H_pq v + H_pp H_q - H_pt, in (q, v, a, p, t) with v = H_p.
    """
    variables = (*system.velocities, *system.coordinates, system.time, *system.auxiliaries)
    rates = (*accelerations(system), *system.velocities, sympy.S.One, *force(system))
    if system.auxiliaries:
        return _rate(constitutive(system), variables, rates)
    return tuple(rate - f for rate, f in zip(_rate(momentum(system), variables, rates), force(system), strict=True))


def _rate(
    expressions: Sequence[sympy.Expr], variables: Sequence[sympy.Symbol], rates: Sequence[sympy.Expr]
) -> tuple[sympy.Expr, ...]:
    """Time derivatives by the chain rule."""
    terms: list[list[sympy.Expr]] = [[] for _ in expressions]
    for (i, j), slope in jacobian(expressions, variables).items():
        terms[i].append(slope * rates[j])
    return tuple(sympy.Add(*row) for row in terms)


def applied_force(system: MechanicalSystem) -> tuple[sympy.Expr, ...]:
    """F = L_q - L_vq v - L_vt, m expressions in (q, v, t), equal to L_vv a on trajectories."""
    at_rest = dict.fromkeys(accelerations(system), sympy.S.Zero)
    return tuple(-residual.xreplace(at_rest) for residual in euler_lagrange(system))


def multiplied_residual(system: MechanicalSystem) -> sympy.Expr:
    """Lambda . E: the scalar whose stationarity makes a collocation residual vanish, with its multipliers.

    Of a Hamiltonian also the product of ``constitutive`` with its multipliers.
    """
    terms: list[sympy.Expr] = []
    residuals = (*euler_lagrange(system), *constitutive(system))
    for multiplier, residual in zip((*multipliers(system), *auxiliary_multipliers(system)), residuals, strict=True):
        terms.extend(multiplier * term for term in sympy.Add.make_args(residual))
    return sympy.Add(*terms)


def lagrangian_rates(system: MechanicalSystem, count: int) -> tuple[sympy.Expr, ...]:
    """DL/dt, .., d^count L/dt^count along a curve, in (q, v, t) and :func:`curve_rates`."""
    curve = (system.coordinates, system.velocities, *curve_rates(system, count))
    variables = (*(symbol for group in curve[:-1] for symbol in group), system.time)
    rates = (*(symbol for group in curve[1:] for symbol in group), sympy.S.One)
    found = [system.lagrangian]
    for _ in range(count):
        found.append(_rate(found[-1:], variables, rates)[0])
    return tuple(found[1:])


def is_separable(system: MechanicalSystem) -> bool:
    """Whether L = sum m_i v_i^2 / 2 - V(q, t) with constant masses, as seen in the structure of its derivatives."""
    if system.auxiliaries:
        return False
    momenta, mass = momentum(system), mass_entries(system)
    constant = set(system.parameters)
    if any(i != j or not entry.free_symbols <= constant for (i, j), entry in mass.items()):
        return False
    at_rest = dict.fromkeys(system.velocities, sympy.S.Zero)
    return all(p.xreplace(at_rest) == 0 for p in momenta) and not jacobian(force(system), system.velocities)
