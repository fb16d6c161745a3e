"""What forces and damping give a system along its motion: work, and impulses in the directions of symmetries.

Where L alone has a symmetry xi its momentum map J changes by what the force does in that direction, and the energy of
an L without time by the work of the force,

    J1 - J0 = int f . xi dt,                        E1 - E0 = int f . v dt.

SVI and their kin keep the first to round-off, with the integral by the method's own quadrature along its own curve
(forced discrete Noether theorem: J. E. Marsden, M. West, Acta Numerica 10 (2001), theorem 3.2.1), and meet the second
with their order. Damping is in both the force -gamma p; of a momentum map what it takes is known beforehand, all but
exp(-gamma h) of it a step, and the integral has the order of the method. The curve of SCVI(s) is no stationary one: it
meets both with the order of the curve, s + 1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import sympy
from sympy import Expr

from scvi_codegen.mechanics.forms import forms_of
from scvi_codegen.mechanics.symmetry.symmetry import symmetries
from scvi_codegen.mechanics.system import MechanicalSystem

__all__ = ["Exchange", "exchanges"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Exchange:
    """What flows in per unit of time: power, or the force along a symmetry of the system without forces."""

    name: str
    rate: Expr


def exchanges(system: MechanicalSystem) -> tuple[Exchange, ...]:
    """The power, then what each momentum map that forces or damping touch receives; none without these."""
    if not system.forces and system.damping == 0:
        return ()
    found = [Exchange(name="energy", rate=_along(system, system.velocities))]
    for symmetry in symmetries(replace(system, forces=(), damping=sympy.S.Zero)):
        moved = set().union(*(xi.free_symbols for xi in symmetry.direction))
        rate = _along(system, symmetry.direction)
        if moved.isdisjoint(symmetry.momenta) and rate != 0:
            found.append(Exchange(name=symmetry.name, rate=rate))
    return tuple(found)


def _along(system: MechanicalSystem, direction: tuple[Expr, ...]) -> Expr:
    forces = system.forces or (sympy.S.Zero,) * system.dimension
    acting = (f - system.damping * p for f, p in zip(forces, forms_of(system).momentum, strict=True))
    return sympy.Add(*(f * xi for f, xi in zip(acting, direction, strict=True)))
