"""Forces, damping and constraints of a system; the derivations are in docs/theory/forces.md.

**Forces** f, by coordinate or by Rayleigh's function, follow the principle of Lagrange and d'Alembert: d/dt L_v = L_q +
f. For a Hamiltonian they are forces on momenta, p' = -H_q + f(q, p, t).

**Uniform damping** at the rate gamma makes the action of e^(gamma t) L stationary: d/dt L_v = L_q - gamma L_v. The map
of a step contracts areas and momentum maps of L by e^(-gamma h), both to round-off, for any step size.

**Constraints** are holonomic, g(q, t) = 0 with G = g_q, or nonholonomic, A(q, t) v + b(q, t) = 0 with G = A:
d/dt L_v = L_q + f + G^T lambda. The index is not reduced (:mod:`scvi_codegen.methods.constraints`).

Sources: C. Kane, J. E. Marsden, M. Ortiz, M. West, Int. J. Numer. Meth. Eng. 49 (2000); J. E. Marsden, M. West, Acta
Numerica 10 (2001), sections 1.3 and 3; C. M. Campos, S. Ober-Bloebaum, Math. Model. Numer. Anal. 49 (2015);
P. Caldirola, Nuovo Cimento 18 (1941); E. Kanai, Prog. Theor. Phys. 3 (1948); R. McLachlan, M. Perlmutter, J. Geom.
Phys. 39 (2001).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import sympy
from sympy import Expr, Symbol

from scvi_codegen.errors import SystemDefinitionError, closest
from scvi_codegen.formulas.expressions import gradient, jacobian
from scvi_codegen.formulas.symbols import name_of_key

if TYPE_CHECKING:
    from scvi_codegen.mechanics.system import MechanicalSystem


def forces_by_coordinate(
    coordinates: Sequence[Symbol], by_name: Mapping[Any, Any], read: Callable[[Any], Expr]
) -> tuple[Expr, ...]:
    """Return the m forces, 0 for coordinates without one; an empty tuple if all are 0.

    Args:
        coordinates: of the system.
        by_name: force by coordinate, which is a symbol or its name.
        read: converts a value to an expression in canonical symbols.

    Raises:
        SystemDefinitionError: for keys that are not coordinates.
    """
    if not isinstance(by_name, Mapping):
        raise SystemDefinitionError(f"forces must be a mapping from coordinates to formulas, not {by_name!r}")
    names = [q.name for q in coordinates]
    forces = {name_of_key(key): value for key, value in by_name.items()}
    for name in forces:
        if name not in names:
            hint = f"{closest(name, names)} Coordinates: {', '.join(names)}"
            raise SystemDefinitionError(f"there is a force on '{name}', which is not a coordinate{hint}")
    ordered = tuple(read(forces[name]) if name in forces else sympy.S.Zero for name in names)
    return ordered if any(f != 0 for f in ordered) else ()


def dissipative_forces(dissipation: Expr, velocities: Sequence[Symbol]) -> tuple[Expr, ...]:
    """Return the forces -dD/dv of Rayleigh's dissipation function D(q, v, t)."""
    derivatives = gradient(dissipation, velocities)
    if not derivatives:
        raise SystemDefinitionError(
            f"the dissipation {dissipation} contains no velocity: Rayleigh's function D(q, v) defines "
            "the forces -dD/dv. Add velocities, or remove it"
        )
    return tuple(-derivatives.get(i, sympy.S.Zero) for i in range(len(velocities)))


def damping_rate(damping: Any, read: Callable[[Any], Expr]) -> Expr:
    """Return the damping rate gamma, 0 if it is ``None``."""
    return sympy.S.Zero if damping is None else read(damping)


def check_damping(name: str, damping: Expr, parameters: Sequence[Symbol]) -> None:
    """Raise :class:`SystemDefinitionError` unless the damping rate depends on parameters only."""
    others = sorted(free.name for free in damping.free_symbols.difference(parameters))
    if others:
        raise SystemDefinitionError(
            f"the damping {damping} of '{name}' depends on '{others[0]}': damping is one rate for all "
            "momenta, a number or a formula of parameters. Write damping that varies, or differs "
            "between momenta, as forces"
        )


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
