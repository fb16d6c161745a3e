"""RATTLE and its generalisation to s + 1 Lobatto points, for constant masses: only multipliers are solved for.

If masses are constant and diagonal and forces depend on positions and time, positions at the s + 1 Lobatto points are
explicit in forces and multipliers (Lobatto IIIA and IIIB), which leaves s equations per constraint,

    g(u_i) = 0,   u_i = q0 + h c_i M^-1 p0 + h^2 sum_n a_in M^-1 (F_n + G_n^T lambda_n),   i = 1 .. s, n = 0 .. s - 1,

then one for the momentum at the end, G_s M^-1 (.. + h w_s G_s^T lambda_s) + g_t = 0. The first are solved by a
simplified Newton iteration with the matrix h^2 a_in G_i M^-1 G_n^T, a band matrix if the constraints form a chain,
factorised once per step. Changes of forces and derivatives with the positions are neglected, an error of order h^2 that
the iteration removes. SVI(1) is RATTLE.

Source: J.-P. Ryckaert, G. Ciccotti, H. J. C. Berendsen, J. Comput. Phys. 23 (1977); H. C. Andersen, ibid. 52 (1983).
"""

from __future__ import annotations

from scvi_codegen.ir.constraints import Rattle
from scvi_codegen.ir.numbers import lower_matrix, lower_vector
from scvi_codegen.lowering.kernels import system_kernel
from scvi_codegen.lowering.solvers.velocity_tables import velocity_tables
from scvi_codegen.mechanics.constraints import constraint_jacobian, nonholonomic_expressions
from scvi_codegen.mechanics.derived_expressions import forms_of
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.stage_system import StageSystem
from scvi_codegen.tables.basis import matrix_product, transpose

__all__ = ["rattle_of"]


def rattle_of(system: MechanicalSystem, stages: StageSystem) -> Rattle | None:
    """Return the tables of such steps; ``None`` if they are not applicable."""
    forms, tables = forms_of(system), velocity_tables(stages.shape)
    if not system.constraints or any(nonholonomic_expressions(system)) or not forms.separable or tables is None:
        return None
    partials = list(constraint_jacobian(system))
    at: dict[int, list[int]] = {}
    for e, (_, i) in enumerate(partials):
        at.setdefault(i, []).append(e)
    products = tuple((e, f) for own in at.values() for e in own for f in own)
    position, momentum = tables.position[1:], tuple(line[:-1] for line in tables.momentum)
    return Rattle(
        force=system_kernel(system, "constrained_force", forms.force, of=system.coordinates, purpose="L_q at u = q."),
        mass=system_kernel(system, "constrained_mass", forms.mass.values(), of=(), purpose="The constant masses."),
        products=products,
        entries=tuple((partials[e][0], partials[f][0]) for e, f in products),
        abscissae=lower_vector(tables.abscissae),
        weights=lower_vector(tables.end_momentum),
        position=lower_matrix(transpose(position)),
        start=lower_vector(tuple(line[0] / tables.end_momentum[0] - 1 for line in momentum)),
        momentum=lower_matrix(transpose(momentum)),
        response=lower_matrix(transpose(matrix_product(position, momentum))),
    )
