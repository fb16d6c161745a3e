"""Work and impulse: the energy and momentum that forces and damping transfer to a system along its trajectory.

If L alone has a symmetry xi, its momentum map J changes by the impulse of the force along xi, and the energy of an
autonomous L by the work of the force,

    J1 - J0 = int f . xi dt,                        E1 - E0 = int f . v dt.

Variational methods satisfy the first to round-off, with the integral by the method's own quadrature along its own
curve (forced discrete Noether theorem: J. E. Marsden, M. West, Acta Numerica 10 (2001), theorem 3.2.1), and the second
to their order. Damping acts as the force -gamma p; its effect on a momentum map is known in closed form (a factor
exp(-gamma h) per step), and the integral is accurate to the order of the method. SCVI(s) curves are not stationary
points of the action: both balances hold to the order of the curve, s + 1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import sympy
from sympy import Expr

from scvi_codegen.mechanics.derived_expressions import forms_of
from scvi_codegen.mechanics.symmetry.symmetry import symmetries
from scvi_codegen.mechanics.system import MechanicalSystem


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkRate:
    """Rate of work (power) or of impulse: the force along a symmetry of the unforced system."""

    name: str
    rate: Expr


def work_rates(system: MechanicalSystem) -> tuple[WorkRate, ...]:
    """Return the power, then the rate of each momentum map that forces or damping change; empty without forces."""
    if not system.forces and system.damping == 0:
        return ()
    rates = [WorkRate(name="energy", rate=_along(system, system.velocities))]
    for symmetry in symmetries(replace(system, forces=(), damping=sympy.S.Zero)):
        direction_symbols = set().union(*(xi.free_symbols for xi in symmetry.direction))
        rate = _along(system, symmetry.direction)
        if direction_symbols.isdisjoint(symmetry.momenta) and rate != 0:
            rates.append(WorkRate(name=symmetry.name, rate=rate))
    return tuple(rates)


def _along(system: MechanicalSystem, direction: tuple[Expr, ...]) -> Expr:
    forces = system.forces or (sympy.S.Zero,) * system.dimension
    applied = (f - system.damping * p for f, p in zip(forces, forms_of(system).momentum, strict=True))
    return sympy.Add(*(f * xi for f, xi in zip(applied, direction, strict=True)))
