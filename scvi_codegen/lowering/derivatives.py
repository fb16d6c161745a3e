"""How the equations of a step depend on parameters and time, and how their slopes do: the kernels, differentiated."""

from __future__ import annotations

from sympy import Add, Mul, S, Symbol

from scvi_codegen.formulas.derivatives import gradient, jacobian
from scvi_codegen.ir.derivatives import Derivatives, GivenSlopes
from scvi_codegen.ir.kernel import Kernel
from scvi_codegen.ir.program import Program
from scvi_codegen.lowering.kernels import system_kernel
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.stage_system import PointFamily, StageSystem

__all__ = ["derivatives_of"]


def derivatives_of(
    system: MechanicalSystem, stages: StageSystem, program: Program, *, second: bool = False
) -> Derivatives:
    """What is differentiated beside the unknowns; ``program`` is that of the stage equations ``stages``.

    Args:
        second: whether second derivatives are wanted, too.
    """
    return Derivatives(
        program=program,
        by_given=tuple(_given_slopes(system, family) for family in stages.families),
        curvatures=tuple(_curvature(system, family) for family in stages.families) if second else (),
    )


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


def _curvature(system: MechanicalSystem, family: PointFamily) -> Kernel | None:
    """The change of a gradient: first along dy, then by each y, so that the Hessian itself is never written out."""
    depends = (*family.arguments, *system.parameters, system.time)
    multipliers = [Symbol(f"multiplier[{i}]", real=True) for i in range(len(family.results))]
    changes = [Symbol(f"change[{j}]", real=True) for j in range(len(depends))]
    entries = jacobian(family.results, depends)
    along = Add(*(Mul(multipliers[i], entry, changes[j]) for (i, j), entry in entries.items()))
    slopes = gradient(along, depends)
    if not slopes:
        return None
    return system_kernel(
        system,
        f"{family.name}_curvature",
        [slopes.get(j, S.Zero) for j in range(len(depends))],
        of=(*family.arguments, *multipliers, *changes),
        purpose="Slopes of all results times multipliers, as they change along a change of all they depend on.",
    )
