"""Systems derived from a Lagrangian system: coordinate changes and variational equations.

**Coordinate changes** are point transformations: L is a scalar, so q = q(u, t) is substituted.

**Variational equations** extend a system by tangent vectors of its trajectory.
For L = sum m_i v_i^2 / 2 - V(q, t) with total forces F(q, t), a tangent vector x of the trajectory satisfies
m x'' = F_q x: Newton's equations with the same masses, coordinates x and forces F_q x. Discretisation commutes with
differentiation, so the computed x and m x' are the derivatives of the computed q and p.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import sympy
from sympy import Expr, Symbol

from scvi_codegen.common.errors import SystemDefinitionError, closest
from scvi_codegen.common.validation import checked_count, checks_arguments, of
from scvi_codegen.systems.constraints import time_derivative
from scvi_codegen.systems.derived_expressions import forms_of
from scvi_codegen.systems.formulas.expressions import gradient, jacobian
from scvi_codegen.systems.formulas.grammar import parse_expression
from scvi_codegen.systems.formulas.symbols import DOT, check_names, symbol
from scvi_codegen.systems.lagrangian import LagrangianSystem
from scvi_codegen.systems.legendre.transform import equivalent_lagrangian
from scvi_codegen.systems.system import MechanicalSystem


@checks_arguments(system=of("a LagrangianSystem", LagrangianSystem))
def change_coordinates(
    system: LagrangianSystem, old: Mapping[str, str], *, coordinates: Sequence[str]
) -> LagrangianSystem:
    """Return the system in other coordinates, by a point transformation q = q(u, t): v = q_u u' + q_t.

    Momenta change by the transposed derivative, p_u = q_u^T p_q; energy and Lagrangian keep their values.

    Args:
        system: in the old coordinates.
        old: each old coordinate that is replaced, as text in the new ones, those that stay, parameters and ``t``.
        coordinates: names of the new coordinates, in order; together with those that stay as many as before.

    Raises:
        SystemDefinitionError: naming the coordinate or symbol at fault; and where the new mass matrix is singular.

    >>> plane = LagrangianSystem.from_text(
    ...     name="plane", coordinates=["x", "y"], lagrangian="(x_dot**2 + y_dot**2)/2 - x**2 - y**2")
    >>> polar = change_coordinates(plane, {"x": "r*cos(phi)", "y": "r*sin(phi)"}, coordinates=["r", "phi"])
    >>> expected = LagrangianSystem.from_text(
    ...     name="expected", coordinates=["r", "phi"], lagrangian="(r_dot**2 + r**2*phi_dot**2)/2 - r**2")
    >>> sympy.simplify(polar.lagrangian - expected.lagrangian)
    0
    """
    if system.has_contacts:
        raise SystemDefinitionError(
            f"the contacts of '{system.name}' are in its coordinates: pass contacts= in the new ones to compile_stepper"
        )
    names = [q.name for q in system.coordinates]
    for name in old:
        if name not in names:
            raise SystemDefinitionError(f"'{system.name}' has no coordinate '{name}'{closest(name, names)}")
    staying = [name for name in names if name not in old]
    new = [*coordinates, *staying]
    check_names(new, tuple(parameter.name for parameter in system.parameters))
    if len(new) != len(names):
        raise SystemDefinitionError(
            f"{len(old)} coordinates are replaced by {len(coordinates)}: the numbers of old and new "
            "coordinates must be equal"
        )
    variables = tuple(symbol(name) for name in new)
    symbols = {symbol.name: symbol for symbol in (*variables, *system.parameters, system.time)}
    positions = {symbol(name): parse_expression(text, symbols) for name, text in old.items()}
    replaced: dict[Expr, Expr] = {**positions}
    replaced |= {symbol(q.name + DOT): time_derivative(f, variables, system.time) for q, f in positions.items()}
    return LagrangianSystem(
        name=f"{system.name} in {', '.join(coordinates)}",
        coordinates=variables,
        time=system.time,
        parameters=system.parameters,
        defaults=system.defaults,
        lagrangian=system.lagrangian.xreplace(replaced),
        clock=system.clock and replace(system.clock, rate=system.clock.rate.xreplace(replaced)),
        forces=_projected(system, positions, replaced, variables),
        constraints=tuple(g.xreplace(replaced) for g in system.constraints),
        functions=system.functions,
        inputs=system.inputs,
        input_ranges=system.input_ranges,
        damping=system.damping,
    )


def _projected(
    system: LagrangianSystem, positions: Mapping[Symbol, Expr], replaced: Mapping[Expr, Expr], new: tuple[Symbol, ...]
) -> tuple[Expr, ...]:
    """Return the generalised forces on the new coordinates, f_u = q_u^T f_q (equal virtual work)."""
    forces = [sympy.S.Zero] * len(new) if system.forces else []
    for q, force in zip(system.coordinates, system.forces, strict=False):
        for i, derivative in gradient(positions.get(q, q), new).items():
            forces[i] += derivative * force.xreplace(replaced)
    return tuple(forces)


@checks_arguments(system=MechanicalSystem.KIND)
def variational_system(system: MechanicalSystem, count: int) -> LagrangianSystem:
    """Return the system extended by ``count`` tangent vectors of its trajectory, as coordinates named ``x_change_1``.

    With SVI and collocation methods they are the exact directional derivatives of the computed trajectory, equal to
    :meth:`Trajectory.tangent` at about a third of a step per vector: they are solved by the same fixed-point iteration
    as the trajectory. Initial q is followed by the directions of q, one vector after another; likewise p.

    Args:
        system: with constant masses, one per coordinate, and forces of position and time only.
        count: number of tangent vectors, at least 1.

    Raises:
        SystemDefinitionError: for other systems; use :meth:`Trajectory.tangent` for them.
    """
    if system.bath:
        raise SystemDefinitionError(
            f"'{system.name}' has a heat bath, whose noise is that of one trajectory: omit temperature= and noise="
        )
    twin, number = equivalent_lagrangian(system), checked_count(count, "count", least=1)
    system_of_both = with_tangent_vectors(twin, number) if twin else None
    if system_of_both is None:
        raise SystemDefinitionError(
            f"the variational equations of '{system.name}' cannot be solved by fixed-point iteration "
            "together with the trajectory: that requires constant masses, one per coordinate, forces "
            "of position and time only, and no constraints. Use run.tangent(), which supports all "
            "systems"
        )
    return system_of_both


def with_tangent_vectors(system: LagrangianSystem, count: int) -> LagrangianSystem | None:
    """Return the system extended by ``count`` groups of m coordinates.

    ``None`` unless it is separable and unconstrained. The momenta of a tangent vector are variations of p.
    """
    forms = forms_of(system)
    if not forms.separable or system.constrained_at_nodes or system.clock:
        return None
    word = "change"
    while any(f"_{word}" in variable.name for variable in (*system.coordinates, *system.parameters)):
        word += "s"
    lagrangian = [system.lagrangian]
    forces = [*(system.forces or [sympy.S.Zero] * system.dimension)]
    coordinates = [*system.coordinates]
    for j in range(count):
        names = [f"{q.name}_{word}_{j + 1}" for q in system.coordinates]
        changes = [symbol(name) for name in names]
        masses = (forms.mass[i, i] for i in range(system.dimension))
        lagrangian += [mass * symbol(name + DOT) ** 2 / 2 for mass, name in zip(masses, names, strict=True)]
        terms: list[list[Expr]] = [[] for _ in changes]
        for (i, k), derivative in jacobian(forms.force, system.coordinates).items():
            terms[i].append(derivative * changes[k])
        forces += [sympy.Add(*row) for row in terms]
        coordinates += changes
    return replace(system, coordinates=tuple(coordinates), lagrangian=sympy.Add(*lagrangian), forces=tuple(forces))
