"""Fixed-point solver of the shooting-based variational method: node and quadrature points are lanes.

The order of the updates in an iteration (accelerations, then the action along the new curve, then momentum, initial
velocity and multipliers) makes it converge twice as fast as a simultaneous update. The equations, those of
``methods/shooting.py`` in these unknowns, are in :class:`scvi_codegen.ir.curve_iterations.ShootingIteration`.
"""

from __future__ import annotations

from sympy import S

from scvi_codegen.formulas.derivatives import gradient
from scvi_codegen.ir.curve_iterations import ShootingIteration
from scvi_codegen.ir.kernel import Kernel
from scvi_codegen.lowering.kernels import system_kernel
from scvi_codegen.lowering.solvers.base import StepProblem
from scvi_codegen.lowering.solvers.curve_tables import node_tables, point_tables
from scvi_codegen.lowering.solvers.simd_padding import (
    MOST_LANES,
    lane_count,
    pad_matrix,
    pad_vector,
    predictor_tables_of,
)
from scvi_codegen.mechanics.derived_expressions import accelerations, forms_of, multipliers
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.stage_structure import ShotCurve
from scvi_codegen.tables.basis import cardinal_integrals, cardinal_values, matrix_product, transpose

__all__ = ["shooting_iteration"]

LARGEST_DIMENSION = 8
"""Largest number of coordinates; beyond, the kernels take longer to compile than they save."""


def shooting_iteration(problem: StepProblem) -> ShootingIteration | None:
    """Return the fixed-point iteration of a variational SCVI of degree 2 or more; ``None`` if it would be too large."""
    system, shape = problem.lagrangian, problem.shape
    if system is None or not isinstance(shape, ShotCurve):
        return None
    tableau, rule = shape.tableau, shape.rule
    lanes = lane_count(max(len(tableau.b), len(rule)))
    if lanes > MOST_LANES or system.dimension > LARGEST_DIMENSION:
        return None
    position = cardinal_integrals(tableau.c, rule.abscissae, 0)
    velocity = cardinal_values(tableau.c, rule.abscissae)
    return ShootingIteration(
        lanes=lanes,
        nodes=node_tables(tableau, lanes),
        guess=predictor_tables_of(tableau.c, lanes),
        points=point_tables(system, tableau, rule, lanes),
        collocation_transposed=pad_matrix(transpose(tableau.A), lanes),
        position_transposed=pad_matrix(transpose(position), lanes),
        velocity_transposed=pad_matrix(transpose(velocity), lanes),
        weights=pad_vector(rule.unit_weights, lanes),
        consistency=pad_vector(matrix_product((rule.unit_weights,), velocity)[0], lanes, repeat=True),
        kernel=_node_kernel(system),
        mass_entries=tuple(forms_of(system).lower_mass),
    )


def _node_kernel(system: MechanicalSystem) -> Kernel:
    """Return the kernel of E, (m . E)_q, (m . E)_v and the lower triangle of the mass."""
    forms, state = forms_of(system), (*system.coordinates, *system.velocities)
    partials = gradient(forms.multiplied_residual, state)
    adjoint = sum(forms.multiplied_forces[:2], ()) or (S.Zero,) * len(state)
    return system_kernel(
        system,
        "node_lanes",
        (*forms.euler_lagrange, *(partials.get(i, S.Zero) + force for i, force in enumerate(adjoint))),
        of=(*state, *accelerations(system), *multipliers(system)),
        partials=forms.lower_mass.values(),
        purpose="E, (m . E)_q, (m . E)_v and the lower triangle of L_vv at all nodes, u = (q, v, a, m).",
    )
