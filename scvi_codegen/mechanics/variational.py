"""Variational equations: a system extended by tangent vectors of its trajectory.

For L = sum m_i v_i^2 / 2 - V(q, t) with total forces F(q, t), a tangent vector x of the trajectory satisfies
m x'' = F_q x: Newton's equations with the same masses, coordinates x and forces F_q x. Discretisation commutes with
differentiation, so the computed x and m x' are the derivatives of the computed q and p.
"""

from __future__ import annotations

from dataclasses import replace

import sympy
from sympy import Expr

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.formulas.expressions import jacobian
from scvi_codegen.formulas.symbols import DOT, symbol
from scvi_codegen.mechanics.derived_expressions import forms_of
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.mechanics.legendre import equivalent_lagrangian
from scvi_codegen.mechanics.system import SYSTEM, MechanicalSystem
from scvi_codegen.validation import checked_count, checks_arguments


@checks_arguments(system=SYSTEM)
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
    if not forms.separable or system.constraints or system.clock:
        return None
    word = "change"
    while any(f"_{word}" in each.name for each in (*system.coordinates, *system.parameters)):
        word += "s"
    lagrangian, forces = [system.lagrangian], [*(system.forces or [sympy.S.Zero] * system.dimension)]
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
