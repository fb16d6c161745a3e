"""A motion beside small changes of it, as one system: what becomes of these is then a matter of steps alone.

For L = sum m_i v_i^2 / 2 - V(q, t) and forces of position and time, F in all, a change x of q follows m x'' = F_q x:
Newton's equations with the same masses, x among the coordinates, F_q x among the forces. Steps commute with
differentiation, so that what a method makes of x, and of m x', is the derivative of what it makes of q and p.
"""

from __future__ import annotations

from dataclasses import replace

import sympy
from sympy import Expr

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.formulas.derivatives import jacobian
from scvi_codegen.formulas.symbols import DOT, symbol
from scvi_codegen.given.counts import checked_count
from scvi_codegen.given.kinds import takes
from scvi_codegen.mechanics.forms import forms_of
from scvi_codegen.mechanics.hamiltonian import lagrangian_twin
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.mechanics.system import SYSTEM, MechanicalSystem

__all__ = ["vary", "with_changes"]


@takes(system=SYSTEM)
def vary(system: MechanicalSystem, count: int) -> LagrangianSystem:
    """The system, and beside it ``count`` small changes of its motion, as coordinates of their own: ``x_change_1``.

    By SVI and collocation they are the exact derivatives of the computed motion along so many directions, as
    :meth:`Trajectory.tangent` has them, at a third of a step each: solved by the sweeps of the motion itself. A run
    starts from q with the directions of q behind it, one after the other, and from p with those of p.

    Args:
        system: with constant masses, one a coordinate, and forces of position and time alone.
        count: of changes, at least 1.

    Raises:
        SystemDefinitionError: for other systems; their changes are told by :meth:`Trajectory.tangent` alone.
    """
    twin, number = lagrangian_twin(system), checked_count(count, "count", least=1)
    found = with_changes(twin, number) if twin else None
    if found is None:
        raise SystemDefinitionError(
            f"changes of '{system.name}' do not follow by its own sweeps: that takes constant masses, one a "
            "coordinate, forces of position and time alone, and no constraints. Take run.tangent(), which all have"
        )
    return found


def with_changes(system: LagrangianSystem, count: int) -> LagrangianSystem | None:
    """The system, and behind its m coordinates m for each of so many changes; ``None`` where masses are not constant.

    The momenta of a change are those of p.
    """
    forms = forms_of(system)
    if not forms.separable or system.constraints or system.clock:
        return None
    word = "change"
    while any(f"_{word}" in given.name for given in (*system.coordinates, *system.parameters)):
        word += "s"
    lagrangian, forces = [system.lagrangian], [*(system.forces or [sympy.S.Zero] * system.dimension)]
    coordinates = [*system.coordinates]
    for j in range(count):
        names = [f"{q.name}_{word}_{j + 1}" for q in system.coordinates]
        changes = [symbol(name) for name in names]
        masses = (forms.mass[i, i] for i in range(system.dimension))
        lagrangian += [mass * symbol(name + DOT) ** 2 / 2 for mass, name in zip(masses, names, strict=True)]
        terms: list[list[Expr]] = [[] for _ in changes]
        for (i, k), slope in jacobian(forms.force, system.coordinates).items():
            terms[i].append(slope * changes[k])
        forces += [sympy.Add(*row) for row in terms]
        coordinates += changes
    return replace(system, coordinates=tuple(coordinates), lagrangian=sympy.Add(*lagrangian), forces=tuple(forces))
