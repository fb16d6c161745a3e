"""RATTLE for constant masses: the multipliers of a step by themselves, without a matrix of positions and velocities.

SVI(1) with its two points of Lobatto's is RATTLE. Where masses are constant and diagonal and forces depend on positions
and time, its velocity is explicit in the multipliers, and what is left are two systems of one equation a constraint,

    g(q0 + h M^-1 (p0 + h/2 (F0 + G0^T lambda_0))) = 0,                 G1 M^-1 (.. + h/2 G1^T lambda_1) + g_t = 0,

the first by Newton's iteration with the matrix G1 M^-1 G0^T, a band where constraints are a chain. With more points the
forces between them would have to be iterated, too.

Source: J.-P. Ryckaert, G. Ciccotti, H. J. C. Berendsen, J. Comput. Phys. 23 (1977); H. C. Andersen, ibid. 52 (1983).
"""

from __future__ import annotations

from scvi_codegen.ir.constraints import Rattle
from scvi_codegen.lowering.kernels import system_kernel
from scvi_codegen.mechanics.constraints import constraint_slopes, velocities_held
from scvi_codegen.mechanics.forms import forms_of
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.shapes import Velocities
from scvi_codegen.methods.stage_system import StageSystem

__all__ = ["rattle_of"]


def rattle_of(system: MechanicalSystem, stages: StageSystem) -> Rattle | None:
    """What such steps need; ``None`` for others."""
    forms, shape = forms_of(system), stages.shape
    if not system.constraints or any(velocities_held(system)) or not forms.separable:
        return None
    if not isinstance(shape, Velocities) or shape.abscissae != (0, 1) or len(shape.blocks) != 1:
        return None
    slopes = list(constraint_slopes(system))
    at: dict[int, list[int]] = {}
    for e, (_, i) in enumerate(slopes):
        at.setdefault(i, []).append(e)
    products = tuple((e, f) for own in at.values() for e in own for f in own)
    return Rattle(
        force=system_kernel(system, "held_force", forms.force, of=system.coordinates, purpose="L_q at u = q."),
        mass=system_kernel(system, "held_mass", forms.mass.values(), of=(), purpose="The constant masses."),
        products=products,
        entries=tuple((slopes[e][0], slopes[f][0]) for e, f in products),
    )
