"""Term groups rolled into loops, added to the program of the remaining terms."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from sympy import Expr

from scvi_codegen.ir.arithmetic import lower_kernel
from scvi_codegen.ir.kernel import Constant, Load, LoopedKernel
from scvi_codegen.ir.numbers import exact_number
from scvi_codegen.ir.program import Program
from scvi_codegen.mechanics.term_groups import SplitSystem, TermGroup

__all__ = ["with_sums"]


def with_sums(program: Program, of: SplitSystem) -> Program | None:
    """Return the program of ``of.rest`` with the forces and the energy of the term groups.

    ``None`` if forces enter otherwise than as values of kernels: in Newton's method, in shooting.
    """
    forces = tuple(_forces(of, family, number) for number, family in enumerate(of.families))
    energies = tuple(_energy(of, family, number) for number, family in enumerate(of.families))
    fixed_point, splitting = program.fixed_point and program.fixed_point.with_forces(forces), program.splitting
    if program.newton or not (fixed_point or splitting):
        return None
    return replace(
        program,
        energy=program.energy.with_sums(energies),
        fixed_point=fixed_point,
        splitting=replace(splitting, force=splitting.force.with_sums(forces)) if splitting else None,
    )


def _forces(of: SplitSystem, family: TermGroup, number: int) -> LoopedKernel:
    return _summed(of, f"pull_{number}", family, family.partials, ())


def _energy(of: SplitSystem, family: TermGroup, number: int) -> LoopedKernel:
    value = -family.formula if of.rest.auxiliaries else family.formula
    return _summed(of, f"term_{number}", family, (value,), ((0,),) * len(family.places))


def _summed(
    of: SplitSystem, name: str, family: TermGroup, values: Sequence[Expr], targets: tuple[tuple[int, ...], ...]
) -> LoopedKernel:
    system = of.rest
    places = {parameter: k for k, parameter in enumerate(system.parameters)}

    def constant(value: Expr) -> Constant | Load:
        return Load("parameters", places[value]) if value in places else Constant(exact_number(value))

    term = lower_kernel(
        name,
        arguments=(*family.slots, *family.given),
        time=system.time,
        parameters=system.parameters,
        values=tuple(values),
        constants=len(family.given),
    )
    given = tuple(tuple(map(constant, column)) for column in family.values)
    return LoopedKernel.over_rows(term, family.places, given, targets)
