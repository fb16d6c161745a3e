"""Holonomic constraints g(q, t) = 0: rods, joints, surfaces, closed loops; what follows from them.

Motions are stationary among curves that meet them, with multipliers lambda as the forces that see to it,

    d/dt L_v = L_q + f + G^T lambda,        g = 0,        G = g_q,

and meet what follows, the hidden constraints g_q v + g_t = 0, too. No index is reduced: methods take g itself at the
points of a step (:mod:`scvi_codegen.methods.constraints`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Expr, Symbol

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.formulas.derivatives import gradient, jacobian
from scvi_codegen.formulas.tape import Tape
from scvi_codegen.formulas.writing import format_expression
from scvi_codegen.mechanics.regularity import sample_points

if TYPE_CHECKING:
    from scvi_codegen.mechanics.system import MechanicalSystem

__all__ = [
    "along_motion",
    "check_constraints",
    "constraint_multipliers",
    "constraint_rates",
    "constraints_of",
    "with_reactions",
]

DEPENDENT = 1e-10
"""Of the largest singular value."""


def constraints_of(given: Iterable[Any] | None, read: Callable[[Any], Expr]) -> tuple[Expr, ...]:
    """The g of a list of formulas; what is written ``left = right`` is left - right."""
    found = []
    for formula in given or ():
        sides = formula.split("=") if isinstance(formula, str) else [formula]
        if len(sides) > 2:
            raise SystemDefinitionError(f"the constraint '{formula}' has more than one '='")
        found.append(read(sides[0]) - read(sides[1]) if len(sides) == 2 else read(formula))
    return tuple(found)


def check_constraints(system: MechanicalSystem) -> None:
    """Raise :class:`SystemDefinitionError` for constraints in velocities, of nothing, or that depend on others."""
    names = [format_expression(g) for g in system.constraints]
    for name, g in zip(names, system.constraints, strict=True):
        if velocities := sorted(v.name for v in g.free_symbols & set(system.velocities)):
            raise SystemDefinitionError(
                f"the constraint '{name}' has the velocity {velocities[0]} in it: constraints are holonomic, "
                "g(q, t) = 0"
            )
        if g.free_symbols.isdisjoint(system.coordinates):
            raise SystemDefinitionError(f"there is no coordinate in the constraint '{name}'")
    if len(names) >= system.dimension:
        raise SystemDefinitionError(
            f"{len(names)} constraints leave nothing of the {system.dimension} coordinates free to move"
        )
    if dependent := _dependent(system):
        raise SystemDefinitionError(
            f"the constraint '{names[dependent]}' says nothing that those before it do not say: leave it out"
        )


def _dependent(system: MechanicalSystem) -> int:
    """The first constraint whose gradient depends on those before it at every point tried; 0 if there is none."""
    slopes, count = jacobian(system.constraints, system.coordinates), len(system.constraints)
    tape, first = None, 0
    for point in sample_points(system.coordinates, (system.time,), system.constants):
        tape = tape or Tape(list(slopes.values()), list(point))
        try:
            values = tape(list(point.values()))
        except ArithmeticError:
            continue
        matrix = np.zeros((count, system.dimension))
        for (i, j), value in zip(slopes, values, strict=True):
            matrix[i, j] = float(value)
        sizes = np.linalg.norm(matrix, axis=1, keepdims=True)
        matrix /= np.where(sizes > 0.0, sizes, 1.0)
        if _rank(matrix) == count:
            return 0
        first = max(first, next(k for k in range(count) if _rank(matrix[: k + 1]) <= k))
    return first


def _rank(matrix: NDArray[np.float64]) -> int:
    return int(np.linalg.matrix_rank(matrix, tol=DEPENDENT))


def constraint_multipliers(system: MechanicalSystem) -> tuple[Symbol, ...]:
    """The symbols of lambda, one a constraint."""
    return tuple(sympy.Symbol(f"lambda_{k}", real=True) for k in range(1, len(system.constraints) + 1))


def constraint_rates(system: MechanicalSystem) -> tuple[Expr, ...]:
    """G v + g_t."""
    return along_motion(system, system.constraints)


def along_motion(system: MechanicalSystem, functions: Sequence[Expr]) -> tuple[Expr, ...]:
    """d/dt of functions of (q, v, t) while velocities stay."""
    rates = dict(zip(system.coordinates, system.velocities, strict=True)) | {system.time: sympy.S.One}
    variables = tuple(rates)
    found = []
    for function in functions:
        slopes = gradient(function, variables)
        found.append(sympy.Add(*(slope * rates[variables[j]] for j, slope in slopes.items())))
    return tuple(found)


def with_reactions(system: MechanicalSystem, forces: Sequence[Expr]) -> tuple[Expr, ...]:
    """Forces and G^T lambda, m expressions."""
    terms: list[list[Expr]] = [[force] for force in forces]
    factors = constraint_multipliers(system)
    for (k, i), slope in jacobian(system.constraints, system.coordinates).items():
        terms[i].append(slope * factors[k])
    return tuple(sympy.Add(*row) for row in terms)
