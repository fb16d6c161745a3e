"""Holonomic constraints g(q, t) = 0 (rods, joints, loops) and nonholonomic ones A v + b = 0 (rolling, skates).

They enter the equations of motion with Lagrange multipliers lambda; constraint forces do no virtual work,

    d/dt L_v = L_q + f + G^T lambda,        g = 0 with G = g_q,        or A(q, t) v + b(q, t) = 0 with G = A

(holonomic; nonholonomic by the principle of Lagrange and d'Alembert). Both imply a velocity constraint G v = ..; for
holonomic constraints it is the hidden constraint g_q v + g_t = 0. The index is not reduced: methods impose g itself at
the points of a step (:mod:`scvi_codegen.methods.constraints`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import sympy
from sympy import Expr, Symbol

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.formulas.expressions import Tape, gradient, jacobian
from scvi_codegen.mechanics.regularity import row_rank, sample_points

if TYPE_CHECKING:
    from scvi_codegen.mechanics.system import MechanicalSystem


def constraints_of(constraints: Iterable[Any] | None, read: Callable[[Any], Expr]) -> tuple[Expr, ...]:
    """Return g of each formula; an equation, ``left = right`` or SymPy's ``Eq``, becomes left - right."""
    expressions = []
    for formula in constraints or ():
        equation = [formula.lhs, formula.rhs] if isinstance(formula, sympy.Eq) else [formula]
        sides = formula.split("=") if isinstance(formula, str) else equation
        if len(sides) > 2:
            raise SystemDefinitionError(
                f"the constraint '{formula}' has more than one '=': write one equation per constraint"
            )
        expressions.append(read(sides[0]) - read(sides[1]) if len(sides) == 2 else read(formula))
    return tuple(expressions)


def check_constraints(system: MechanicalSystem) -> None:
    """Raise :class:`SystemDefinitionError` for constraints that are dependent or nonlinear in velocities."""
    names = list(map(system.text_of, system.constraints))
    for name, g in zip(names, system.constraints, strict=True):
        if g.free_symbols.isdisjoint((*system.coordinates, *system.velocities)):
            raise SystemDefinitionError(
                f"the constraint '{name}' contains no coordinate: constraints are g(q, t) = 0, or A(q, t) "
                "v + b(q, t) = 0. Remove it, or write the condition in terms of the coordinates"
            )
    for k, i in jacobian(list(constraint_jacobian(system).values()), system.velocities):
        name = names[list(constraint_jacobian(system))[k][0]]
        raise SystemDefinitionError(
            f"the constraint '{name}' is not linear in the velocity {system.velocities[i]}: "
            "constraints must have the form g(q, t) = 0, or A(q, t) v + b(q, t) = 0"
        )
    if len(names) >= system.dimension:
        raise SystemDefinitionError(
            f"{len(names)} constraints on {system.dimension} coordinates of '{system.name}' leave no degree of "
            "freedom: the constraints alone determine the motion (a fully driven or overconstrained mechanism), and "
            "there is nothing to integrate. Fewer independent constraints than coordinates are required. Leave out "
            "redundant constraints; of a driven joint, replace the prescribed motion by a force or torque (an input "
            "can carry it)"
        )
    if dependent := _dependent(system):
        raise SystemDefinitionError(
            f"the constraint '{names[dependent]}' is redundant: it depends on the constraints before it. Remove it"
        )


def _dependent(system: MechanicalSystem) -> int:
    """Return the index of the first constraint dependent on earlier ones at every sampled point, or 0."""
    derivatives, count = constraint_jacobian(system), len(system.constraints)
    tape, first = None, 0
    for point in sample_points(system.coordinates, (system.time,), system.constants):
        tape = tape or Tape(list(derivatives.values()), list(point))
        try:
            values = tape(list(point.values()))
        except ArithmeticError:
            continue
        matrix = np.zeros((count, system.dimension))
        for (i, j), value in zip(derivatives, values, strict=True):
            matrix[i, j] = float(value)
        if row_rank(matrix) == count:
            return 0
        first = max(first, next(k for k in range(count) if row_rank(matrix[: k + 1]) <= k))
    return first


def constraint_multipliers(system: MechanicalSystem) -> tuple[Symbol, ...]:
    """Return the symbols of the Lagrange multipliers lambda, one per constraint."""
    return tuple(sympy.Symbol(f"lambda_{k}", real=True) for k in range(1, len(system.constraints) + 1))


def holonomic(system: MechanicalSystem, g: Expr) -> bool:
    """Return whether the constraint ``g`` contains no velocities."""
    return not g.free_symbols & set(system.velocities)


def holonomic_expressions(system: MechanicalSystem) -> tuple[Expr, ...]:
    """Return g of each holonomic constraint, and 0 for each nonholonomic one."""
    return tuple(g if holonomic(system, g) else sympy.S.Zero for g in system.constraints)


def nonholonomic_expressions(system: MechanicalSystem) -> tuple[Expr, ...]:
    """Return A v + b of each nonholonomic constraint, and 0 for each holonomic one."""
    return tuple(sympy.S.Zero if holonomic(system, g) else g for g in system.constraints)


def constraint_rates(system: MechanicalSystem) -> tuple[Expr, ...]:
    """Return the velocity form of each constraint: g_q v + g_t, or A v + b."""
    return tuple(
        map(sympy.Add, time_derivatives(system, holonomic_expressions(system)), nonholonomic_expressions(system))
    )


def constraint_jacobian(system: MechanicalSystem) -> dict[tuple[int, int], Expr]:
    """Return the non-zero entries of the constraint Jacobian G by (constraint, coordinate)."""
    return jacobian(constraint_rates(system), system.velocities)


def time_derivatives(system: MechanicalSystem, functions: Sequence[Expr]) -> tuple[Expr, ...]:
    """Return d/dt of functions of (q, t) along a trajectory, as expressions in (q, v, t); v is held constant."""
    rates = dict(zip(system.coordinates, system.velocities, strict=True)) | {system.time: sympy.S.One}
    variables = tuple(rates)
    results = []
    for function in functions:
        derivatives = gradient(function, variables)
        results.append(sympy.Add(*(derivative * rates[variables[j]] for j, derivative in derivatives.items())))
    return tuple(results)


def with_constraint_forces(system: MechanicalSystem, forces: Sequence[Expr]) -> tuple[Expr, ...]:
    """Return the forces plus the constraint forces G^T lambda, m expressions."""
    terms: list[list[Expr]] = [[force] for force in forces]
    factors = constraint_multipliers(system)
    for (k, i), derivative in constraint_jacobian(system).items():
        terms[i].append(derivative * factors[k])
    return tuple(sympy.Add(*row) for row in terms)
