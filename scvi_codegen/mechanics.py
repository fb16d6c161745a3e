"""What the kernels compute: momentum, force, the Euler-Lagrange residual, and the scalar behind the shooting method.

Everything is differentiated term by term with :mod:`scvi_codegen.derivatives`; nothing is simplified and no mass matrix
is inverted. Accelerations and multipliers are symbols of their own, so a kernel is a function of plain numbers.
"""

from __future__ import annotations

import sympy

from scvi_codegen.derivatives import gradient, jacobian
from scvi_codegen.system import LagrangianSystem

__all__ = [
    "accelerations",
    "applied_force",
    "energy",
    "euler_lagrange",
    "force",
    "is_separable",
    "mass_entries",
    "momentum",
    "multiplied_residual",
    "multipliers",
]


def accelerations(system: LagrangianSystem) -> tuple[sympy.Symbol, ...]:
    """The m symbols that stand for second time derivatives."""
    return tuple(sympy.Symbol(f"{q.name}_ddot", real=True) for q in system.coordinates)


def multipliers(system: LagrangianSystem) -> tuple[sympy.Symbol, ...]:
    """The m multiplier symbols of a collocation node (shooting-based methods)."""
    return tuple(sympy.Symbol(f"{q.name}_multiplier", real=True) for q in system.coordinates)


def _dense(entries: dict[int, sympy.Expr], size: int) -> tuple[sympy.Expr, ...]:
    return tuple(entries.get(i, sympy.S.Zero) for i in range(size))


def momentum(system: LagrangianSystem) -> tuple[sympy.Expr, ...]:
    """P = dL/dv, m expressions."""
    return _dense(gradient(system.lagrangian, system.velocities), system.dimension)


def force(system: LagrangianSystem) -> tuple[sympy.Expr, ...]:
    """dL/dq, m expressions."""
    return _dense(gradient(system.lagrangian, system.coordinates), system.dimension)


def mass_entries(system: LagrangianSystem) -> dict[tuple[int, int], sympy.Expr]:
    """Non-zero entries of the mass matrix d2L/dv2 by (row, column), ascending."""
    return jacobian(momentum(system), system.velocities)


def energy(system: LagrangianSystem) -> sympy.Expr:
    """dL/dv . v - L, conserved when L does not depend on time."""
    products = [p * v for p, v in zip(momentum(system), system.velocities, strict=True)]
    return sympy.Add(*products, -system.lagrangian)


def euler_lagrange(system: LagrangianSystem) -> tuple[sympy.Expr, ...]:
    """E = L_vv a + L_vq v + L_vt - L_q, m expressions in (q, v, a, t), zero on trajectories (paper (2))."""
    p, f = momentum(system), force(system)
    variables = (*system.velocities, *system.coordinates, system.time)
    rates = (*accelerations(system), *system.velocities, sympy.S.One)
    terms: list[list[sympy.Expr]] = [[-f_i] for f_i in f]
    for (i, j), slope in jacobian(p, variables).items():
        terms[i].append(slope * rates[j])
    return tuple(sympy.Add(*row) for row in terms)


def applied_force(system: LagrangianSystem) -> tuple[sympy.Expr, ...]:
    """F = L_q - L_vq v - L_vt, m expressions in (q, v, t), equal to L_vv a on trajectories."""
    at_rest = dict.fromkeys(accelerations(system), sympy.S.Zero)
    return tuple(-residual.xreplace(at_rest) for residual in euler_lagrange(system))


def multiplied_residual(system: LagrangianSystem) -> sympy.Expr:
    """Lambda . E: the scalar whose stationarity makes a collocation residual vanish, with its multipliers."""
    terms: list[sympy.Expr] = []
    for multiplier, residual in zip(multipliers(system), euler_lagrange(system), strict=True):
        terms.extend(multiplier * term for term in sympy.Add.make_args(residual))
    return sympy.Add(*terms)


def is_separable(system: LagrangianSystem) -> bool:
    """Whether L = sum m_i v_i^2 / 2 - V(q, t) with constant masses, as seen in the structure of its derivatives."""
    momenta, mass = momentum(system), mass_entries(system)
    constant = set(system.parameters)
    if any(i != j or not entry.free_symbols <= constant for (i, j), entry in mass.items()):
        return False
    at_rest = dict.fromkeys(system.velocities, sympy.S.Zero)
    return all(p.xreplace(at_rest) == 0 for p in momenta) and not jacobian(force(system), system.velocities)
