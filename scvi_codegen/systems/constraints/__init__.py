"""Constraints of a system: kinds, reading, conditions, and constraint forces.

d/dt L_v = L_q + f + G^T lambda with the rates G v + .. = 0 of all constraints. The index is not reduced
(:mod:`scvi_codegen.methods.constraints`). Constraints with reactions (:class:`.kind.Reaction`) are multiplied by their
masks, and have forces in directions of their own.
"""

import re
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
import sympy
from sympy import Expr, Symbol
from sympy.core.function import AppliedUndef

from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.systems.constraints.kind import HOLONOMIC, NONHOLONOMIC, Constrained, ConstraintKind
from scvi_codegen.systems.formulas.expressions import derivative_along, jacobian, tangents
from scvi_codegen.systems.formulas.grammar import sides_of
from scvi_codegen.systems.formulas.symbols import DOT, symbol

CONSTRAINT_KINDS = {
    "holonomic": HOLONOMIC,  # plain equations have its notation; conditions are those of the first kind that applies
    "nonholonomic": NONHOLONOMIC,
}
"""Kinds of constraints by name."""

Rate = Callable[[Expr], Expr]


def forms_of_constraints() -> str:
    """Return the general forms of all kinds, for messages."""
    return ", or ".join(kind.form for kind in CONSTRAINT_KINDS.values())


def without_coordinate(shown: str) -> str:
    """Return the message for a constraint without coordinates."""
    return (
        f"the constraint '{shown}' contains no coordinate: constraints are {forms_of_constraints()}. Remove it, or "
        "write the condition in terms of the coordinates"
    )


def constraint_sides(formula: Any) -> tuple[list[Any], Callable[[Sequence[Expr], Rate], Expr]]:
    """Return the sides of a constraint, and the function that returns its expression from them.

    Equations are ``left = right``, or SymPy's ``Eq``; a function on the left, ``function(f)``, denotes the kind, and
    its argument is the first side.
    """
    equation = [formula.lhs, formula.rhs] if isinstance(formula, sympy.Eq) else [formula]
    sides = sides_of(formula) if isinstance(formula, str) else equation
    if len(sides) > 2:
        raise SystemDefinitionError(
            f"the constraint '{formula}' has more than one '=': write one equation per constraint"
        )
    left = sides[0]
    called = re.fullmatch(r"\s*(\w+)\s*\((.*)\)\s*", left, re.DOTALL) if isinstance(left, str) else None
    function, argument = called.groups() if called else ("", left)
    if isinstance(left, AppliedUndef) and len(left.args) == 1:
        function, argument = left.func.__name__, left.args[0]
    for kind in CONSTRAINT_KINDS.values():
        if kind.function and kind.function == function:
            return [argument, *sides[1:]], kind.expression
    return sides, next(iter(CONSTRAINT_KINDS.values())).expression


def constraints_of(constraints: Iterable[Any] | None, read: Callable[[Any], Expr], rate: Rate) -> tuple[Expr, ...]:
    """Return the expressions of constraints, formulas that are 0 or equations, with sides by ``read``."""
    result = []
    for formula in constraints or ():
        sides, expression = constraint_sides(formula)
        read_sides = [read(side) for side in sides]
        if all(side.is_number for side in read_sides):
            raise SystemDefinitionError(without_coordinate(str(formula)))
        result.append(expression(read_sides, rate))
    return tuple(result)


def kind_of(system: Constrained, expression: Expr) -> ConstraintKind:
    """Return the kind of a constraint of a system."""
    velocities = set(system.velocities)
    return next(kind for kind in CONSTRAINT_KINDS.values() if kind.applies(expression, velocities))


def constraint_multipliers(system: Constrained) -> tuple[Symbol, ...]:
    """Return the symbols of the Lagrange multipliers lambda, one per constraint."""
    return tuple(sympy.Symbol(f"lambda_{k}", real=True) for k in range(1, len(system.constraints) + 1))


def constraint_masks(system: Constrained) -> tuple[Expr, ...]:
    """Return the mask of each constraint, 1 for those that are always imposed."""
    always = len(system.constraints) - len(system.reactions)
    return (*(sympy.S.One,) * always, *(reaction.active for reaction in system.reactions))


def position_conditions(system: Constrained) -> tuple[Expr, ...]:
    """Return g(q, t) of each constraint times its mask, 0 for those without a condition on positions."""
    masked = zip(constraint_masks(system), system.constraints, strict=True)
    return tuple(mask * kind_of(system, g).position(g) for mask, g in masked)


def velocity_conditions(system: Constrained) -> tuple[Expr, ...]:
    """Return A v + b of each constraint times its mask, 0 for those whose condition is one on positions."""
    masked = zip(constraint_masks(system), system.constraints, strict=True)
    return tuple(mask * kind_of(system, g).velocity(g) for mask, g in masked)


def idle_multipliers(system: Constrained) -> tuple[Expr, ...]:
    """Return (1 - mask) lambda of each constraint, which is 0 where the constraint is not imposed."""
    return tuple(
        (1 - mask) * factor
        for mask, factor in zip(constraint_masks(system), constraint_multipliers(system), strict=True)
    )


def constraint_rates(system: Constrained) -> tuple[Expr, ...]:
    """Return the velocity form of each constraint: g_q v + g_t, or A v + b."""
    return tuple(map(sympy.Add, time_derivatives(system, position_conditions(system)), velocity_conditions(system)))


def constraints_work(system: Constrained) -> bool:
    """Return whether constraint forces can do work: the rate of a constraint at zero velocity is not 0, or friction."""
    return bool(constraint_power(system) != 0)


def constraint_power(system: Constrained) -> Expr:
    """Return the power of the constraint forces D^T lambda, lambda . ((D - G) v - b), where rates are G v + b = 0."""
    imposed = {reaction.active: sympy.S.One for reaction in system.reactions}
    at_rest = imposed | dict.fromkeys(system.velocities, sympy.S.Zero)
    ideal, oblique = constraint_jacobian(system), force_directions(system)
    terms = [
        -factor * rate.xreplace(at_rest)
        for factor, rate in zip(constraint_multipliers(system), constraint_rates(system), strict=True)
    ]
    for k, i in sorted({*ideal, *oblique}):
        apart = oblique.get((k, i), sympy.S.Zero) - ideal.get((k, i), sympy.S.Zero).xreplace(imposed)
        terms.append(constraint_multipliers(system)[k] * apart * system.velocities[i])
    return sympy.Add(*terms)


def dissipates(system: Any) -> bool:
    """Return whether energy cannot grow: by ideal constraints, friction, and forces -C v of numbers C >= 0."""
    friction = {x: sympy.S.Zero for x in system.parameters if re.fullmatch(r"contact_\d+_(direction|slides)", x.name)}
    at_rest = dict.fromkeys(system.velocities, sympy.S.Zero)
    forces = [force.xreplace(friction) for force in system.forces or at_rest.values()]
    rates = [force.diff(v) for force in forces for v in system.velocities]
    acts_at_rest = any(x.xreplace(at_rest) for x in (*forces, *velocity_conditions(system)))
    if system.depends_on_time or system.damping != 0 or system.inputs or acts_at_rest:
        return False
    matrix = np.array(rates, float).reshape(system.dimension, -1) if all(x.is_number for x in rates) else np.eye(1)
    return bool(np.linalg.eigvalsh(matrix + matrix.T).max() <= 1e-12 * np.abs(matrix).max())


def constraint_jacobian(system: Constrained) -> dict[tuple[int, int], Expr]:
    """Return the non-zero entries of the constraint Jacobian G by (constraint, coordinate)."""
    return jacobian(constraint_rates(system), system.velocities)


def masks_of_contacts(system: Any) -> list[Symbol]:
    """Return the parameters of the modes of contacts."""
    return [x for x in system.parameters if re.match(r"contact_\d+_(?!quantity_)", x.name)]


def has_oblique_forces(system: Constrained) -> bool:
    """Return whether the force of a constraint is not in the direction of G^T: sliding friction, which does work."""
    if not system.reactions:
        return False
    imposed = {reaction.active: sympy.S.One for reaction in system.reactions}
    ideal = {place: entry.xreplace(imposed) for place, entry in constraint_jacobian(system).items()}
    return force_directions(system) != ideal


def force_directions(system: Constrained) -> dict[tuple[int, int], Expr]:
    """Return the non-zero entries of D by (constraint, coordinate): D^T lambda are the forces of the constraints."""
    always = len(system.constraints) - len(system.reactions)
    directions = {
        (always + k, i): component
        for k, reaction in enumerate(system.reactions)
        for i, component in enumerate(reaction.direction)
        if component != 0
    }
    return {place: entry for place, entry in constraint_jacobian(system).items() if place[0] < always} | directions


def time_derivative(function: Expr, coordinates: Sequence[Symbol], time: Symbol) -> Expr:
    """Return df/dt of a function of (q, t) along a trajectory, as an expression in (q, v, t); v is held constant."""
    rates = [*(symbol(q.name + DOT) for q in coordinates), sympy.S.One]
    return derivative_along(function, (*coordinates, time), rates)


def rate_of_positions(function: Expr, coordinates: Sequence[Symbol], time: Symbol) -> Expr:
    """Return df/dt as :func:`time_derivative`; raise if the function contains velocities, whose rates are unknown."""
    if moving := sorted(function.free_symbols & {symbol(q.name + DOT) for q in coordinates}, key=str):
        raise SystemDefinitionError(
            f"the time derivative of {function} contains the acceleration of {moving[0]}: constraints are "
            f"{forms_of_constraints()}"
        )
    return time_derivative(function, coordinates, time)


def time_derivatives(system: Constrained, functions: Sequence[Expr]) -> tuple[Expr, ...]:
    """Return df/dt of functions of (q, v, t), at constant v."""
    return tangents(functions, (*system.coordinates, system.time), (*system.velocities, sympy.S.One))


def with_constraint_forces(system: Constrained, forces: Sequence[Expr]) -> tuple[Expr, ...]:
    """Return the forces plus the constraint forces, G^T lambda of ideal constraints, m expressions."""
    terms: list[list[Expr]] = [[force] for force in forces]
    factors = constraint_multipliers(system)
    for (k, i), direction in force_directions(system).items():
        terms[i].append(direction * factors[k])
    return tuple(sympy.Add(*row) for row in terms)
