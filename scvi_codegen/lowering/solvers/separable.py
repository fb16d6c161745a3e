"""Fixed-point solver for separable systems: points are lanes, and no matrix is factorised.

With a constant diagonal mass and forces of position and time the two tables of a method (positions from velocities,
momenta from forces) are multiplied into one, q_n = q0 + h c_n v0 + h^2 sum_j product[n][j] F_j / m, for every SVI, for
the Runge-Kutta methods, and for spectral collocation and the position forms as well.

A variational method is symplectic because its tables are adjoint; rounded to 53 bits they are not exactly, and the
energy drifts. So they have 106 bits, including the powers of h. The low words are only used where they matter: in the
last evaluation of the points and in the increments.
"""

from __future__ import annotations

from scvi_codegen.ir.iterations import SeparableIteration
from scvi_codegen.lowering.kernels import system_kernel
from scvi_codegen.lowering.solvers.base import StepProblem
from scvi_codegen.lowering.solvers.simd_padding import (
    MOST_LANES,
    lane_count,
    pad_matrix,
    pad_vector,
    predictor_tables_of,
)
from scvi_codegen.lowering.solvers.velocity_tables import VelocityTables, tableau_tables, velocity_tables
from scvi_codegen.mechanics.derived_expressions import forms_of
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.methods.stage_structure import Accelerations, Velocities
from scvi_codegen.tables.basis import matrix_product
from scvi_codegen.tables.precision import mp

__all__ = ["separable_iteration"]


def separable_iteration(problem: StepProblem, *, velocities: bool = False) -> SeparableIteration | None:
    """Return the fixed-point iteration of a separable system; ``None`` for others, and with too many points.

    With ``velocities`` it has the table of those at the points, and predicts forces instead of positions. Systems with
    integrals are excluded, since it does not store the velocities. Position form and phase-space form are the same for
    separable systems.
    """
    system, shape = problem.lagrangian, problem.shape
    if system is None or not forms_of(system).separable or system.integrands:
        return None
    if isinstance(shape, Accelerations):
        tables: VelocityTables | None = tableau_tables(shape.tableau.c, shape.tableau.A, shape.tableau.b)
    else:
        tables = velocity_tables(shape.unrounded or shape if isinstance(shape, Velocities) else None)
    return _fixed_point(system, tables, velocities=velocities) if tables else None


def _fixed_point(system: LagrangianSystem, tables: VelocityTables, *, velocities: bool) -> SeparableIteration | None:
    lanes = lane_count(len(tables.abscissae))
    if lanes > MOST_LANES:
        return None
    product = matrix_product(tables.position, tables.momentum)
    drift = tuple(mp.fsum(line) for line in tables.position)
    highest = min(len(tables.abscissae), len(tables.blocks)) - 1
    guess = predictor_tables_of(tables.abscissae, lanes, through=None if velocities else product, degree=highest)
    at_points = matrix_product(tables.velocity, tables.momentum) if tables.velocity else tables.momentum
    forms = forms_of(system)
    return SeparableIteration(
        points=len(tables.abscissae),
        lanes=lanes,
        abscissae=pad_vector(tables.abscissae, lanes, repeat=True),
        drift=pad_vector(drift, lanes, repeat=True),
        product=pad_matrix(product, lanes),
        end_position=pad_vector(matrix_product((tables.end_position,), tables.momentum)[0], lanes),
        end_momentum=pad_vector(tables.end_momentum, lanes),
        guess=guess,
        force=system_kernel(system, "force_lanes", forms.force, of=system.coordinates, purpose="L_q at all points."),
        mass=system_kernel(system, "mass", forms.mass.values(), of=(), purpose="The constant masses."),
        velocity=pad_matrix(at_points, lanes) if velocities else (),
    )
