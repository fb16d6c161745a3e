"""How the equations of a step depend on parameters and time: symbolic slopes of the kernels at all points."""

from __future__ import annotations

from collections.abc import Sequence

from sympy import Expr, Symbol

from scvi_codegen.formulas.derivatives import jacobian
from scvi_codegen.ir.derivatives import Derivatives, GivenSlopes
from scvi_codegen.ir.program import Program
from scvi_codegen.lowering.kernels import system_kernel
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.stage_system import StageSystem

__all__ = ["derivatives_of"]


def derivatives_of(system: MechanicalSystem, stages: StageSystem, program: Program) -> Derivatives:
    """What is differentiated beside the unknowns; ``program`` is that of the stage equations ``stages``."""
    given = tuple(_given_slopes(system, family.name, family.results, family.arguments) for family in stages.families)
    damping = _given_slopes(system, "damping", (stages.damping,), ()) if program.damping else None
    return Derivatives(program=program, by_given=given, damping=damping)


def _given_slopes(
    system: MechanicalSystem, name: str, results: Sequence[Expr], arguments: Sequence[Symbol]
) -> GivenSlopes:
    entries = jacobian(results, (*system.parameters, system.time))
    if not entries:
        return GivenSlopes(entries=(), kernel=None)
    kernel = system_kernel(
        system,
        f"{name}_by_given",
        entries.values(),
        of=arguments,
        purpose="The non-zero derivatives with respect to parameters and time.",
    )
    return GivenSlopes(entries=tuple(entries), kernel=kernel)
