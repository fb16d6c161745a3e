"""Derivatives of the stage equations with respect to parameters and time, and their second derivatives, as kernels."""

from __future__ import annotations

from collections.abc import Sequence

from sympy import Add, Expr, Mul, S, Symbol

from scvi_codegen.formulas.derivatives import gradient, jacobian
from scvi_codegen.ir.derivatives import Derivatives, InputDerivatives, TimeDerivatives
from scvi_codegen.ir.kernel import Kernel
from scvi_codegen.ir.program import Program
from scvi_codegen.lowering.kernels import system_kernel
from scvi_codegen.lowering.point_derivatives import point_derivatives_of
from scvi_codegen.mechanics.derived_expressions import forms_of
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.stage_system import StageGroup, StageSystem

__all__ = ["derivatives_of"]


def derivatives_of(
    system: MechanicalSystem, stages: StageSystem, program: Program, *, second: bool = False
) -> Derivatives:
    """Return the derivatives of ``program``, the program of the stage equations ``stages``, with respect to all inputs.

    Args:
        second: whether second derivatives are included.
    """
    given = tuple(
        _input_derivatives(system, group.name, group.results, group.arguments) for group in stages.stage_groups
    )
    return Derivatives(
        program=program,
        by_given=given,
        curvatures=tuple(_curvature(system, group) for group in stages.stage_groups) if second else (),
        damping=_input_derivatives(system, "damping", (stages.damping,), ()) if program.damping else None,
        clock=_time_derivatives(system, stages.stage_groups[0].arguments) if system.clock else None,
        iterated=point_derivatives_of(system, program.fixed_point) if program.fixed_point else None,
    )


def _input_derivatives(
    system: MechanicalSystem, name: str, results: Sequence[Expr], arguments: Sequence[Symbol]
) -> InputDerivatives:
    entries = jacobian(results, (*system.parameters, system.time))
    if not entries:
        return InputDerivatives(entries=(), kernel=None)
    kernel = system_kernel(
        system,
        f"{name}_by_inputs",
        entries.values(),
        of=arguments,
        purpose="Nonzero derivatives with respect to parameters and time.",
    )
    return InputDerivatives(entries=tuple(entries), kernel=kernel)


def _time_derivatives(system: MechanicalSystem, arguments: Sequence[Symbol]) -> TimeDerivatives:
    assert system.clock is not None
    rate = system.clock.rate
    partials = gradient(rate, (*arguments, *system.parameters))
    return TimeDerivatives(
        entries=tuple(partials),
        kernel=system_kernel(
            system,
            "rate_derivatives",
            (rate,),
            of=arguments,
            partials=partials.values(),
            purpose="The rate of time and its nonzero derivatives with respect to arguments and parameters.",
        ),
        level=_energy_derivatives(system),
    )


def _energy_derivatives(system: MechanicalSystem) -> Kernel:
    """Return the kernel of the gradient of the energy E of a state: since K = rate (H - E) = 0, dE = dK / rate."""
    assert system.clock is not None
    m, energy = system.dimension, system.clock.energy
    partials = gradient(system.formula, (*system.coordinates, *system.parameters))
    sign = 1 if system.auxiliaries else -1
    by_others = [sign * partials.get(j, S.Zero) for j in range(m + len(system.parameters))]
    by_others[m + system.parameters.index(energy)] = S.Zero
    by_p = forms_of(system).legendre if system.auxiliaries else system.velocities
    return system_kernel(
        system,
        "energy_derivatives",
        [derivative / system.clock.rate for derivative in (*by_others[:m], *by_p, *by_others[m:])],
        of=forms_of(system).legendre_arguments,
        purpose="Gradient of the energy with respect to q, p and parameters at "
        f"u = (q, {'p' if system.auxiliaries else 'v'}).",
    )


def _curvature(system: MechanicalSystem, group: StageGroup) -> Kernel | None:
    """Return the kernel of the Hessian-vector product of multipliers . results: gradient of a derivative."""
    depends = (*group.arguments, *system.parameters, system.time)
    multipliers = [Symbol(f"multiplier[{i}]", real=True) for i in range(len(group.results))]
    changes = [Symbol(f"change[{j}]", real=True) for j in range(len(depends))]
    entries = jacobian(group.results, depends)
    along = Add(*(Mul(multipliers[i], entry, changes[j]) for (i, j), entry in entries.items()))
    partials = gradient(along, depends)
    if not partials:
        return None
    return system_kernel(
        system,
        f"{group.name}_curvature",
        [partials.get(j, S.Zero) for j in range(len(depends))],
        of=(*group.arguments, *multipliers, *changes),
        purpose="Hessian-vector product of multipliers . results with a variation of all arguments.",
    )
