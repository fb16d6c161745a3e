"""Kernels of constraints: values, derivatives, and the terms of the equation for the Lagrange multipliers."""

from __future__ import annotations

from scvi_codegen.ir.constraints import Constraints
from scvi_codegen.lowering.kernels import system_kernel
from scvi_codegen.mechanics.constraints import (
    constraint_jacobian,
    constraint_rates,
    holonomic_expressions,
    time_derivatives,
)
from scvi_codegen.mechanics.derived_expressions import forms_of
from scvi_codegen.mechanics.system import MechanicalSystem

__all__ = ["lowered_constraints"]


def lowered_constraints(system: MechanicalSystem) -> Constraints | None:
    """Return the kernels of the constraints of a system, ``None`` if it has none."""
    if not system.constraints:
        return None
    partials, rates = constraint_jacobian(system), constraint_rates(system)
    return Constraints(
        formulas=tuple(map(system.text_of, system.constraints)),
        kernel=system_kernel(
            system,
            "constraints",
            holonomic_expressions(system),
            of=system.coordinates,
            partials=partials.values(),
            purpose="The constraints g of positions, and their nonzero derivatives G, at u = q.",
        ),
        entries=tuple(partials),
        motion=system_kernel(
            system,
            "constrained_motion",
            (*forms_of(system).applied_force, *rates, *time_derivatives(system, rates)),
            of=(*system.coordinates, *system.velocities),
            purpose="L_q - L_vq v - L_vt + f, then rates G v + .., and their derivatives in time at constant v.",
        ),
    )
