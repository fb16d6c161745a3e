"""How the equations of a step depend on parameters and time: symbolic slopes of the kernels at all points."""

from __future__ import annotations

from scvi_codegen.formulas.derivatives import jacobian
from scvi_codegen.ir.derivatives import Derivatives, GivenSlopes
from scvi_codegen.ir.program import Program
from scvi_codegen.lowering.kernels import system_kernel
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.stage_system import PointFamily, StageSystem

__all__ = ["derivatives_of"]


def derivatives_of(system: MechanicalSystem, stages: StageSystem, program: Program) -> Derivatives:
    """What is differentiated beside the unknowns; ``program`` is that of the stage equations ``stages``."""
    return Derivatives(program=program, by_given=tuple(_given_slopes(system, family) for family in stages.families))


def _given_slopes(system: MechanicalSystem, family: PointFamily) -> GivenSlopes:
    entries = jacobian(family.results, (*system.parameters, system.time))
    if not entries:
        return GivenSlopes(entries=(), kernel=None)
    kernel = system_kernel(
        system,
        f"{family.name}_by_given",
        entries.values(),
        of=family.arguments,
        purpose="The non-zero derivatives with respect to parameters and time.",
    )
    return GivenSlopes(entries=tuple(entries), kernel=kernel)
