"""Fixed-point solver for any regular Lagrangian: velocities are corrected by the mass matrix at each point, in lanes.

The equations are L_v(q_n, V_n) = P_n with q_n and P_n from the two tables of a method. If the points are not those of
the velocities (an SVI with another quadrature), the s velocities z_b give V_n = sum_b l_nb z_b and the equations are
projected: a correction is interpolated by l, solved with the mass at each point, and projected back.

If masses depend on positions, a correction changes forces and momenta about as much as the residual it removes. So it
is computed twice, the second time including its own first-order effect, by F_q, F_v and L_vq of the same kernel: one
iteration then converges like two, and the final forces include the last correction. This saves a quarter of the time of
a step of a swinging Atwood machine, 8 to 25 % for pendulums, carts and time-transformed systems.

For a variational method the two tables are adjoint. With mu_nj = a_nj / beta_j, the scaled weights h beta_j rounded
once and used in stages and updates alike, and A_nj / w_j = 1 - mu_jn, exact since mu is a multiple of 2^-51, the
rounded map still has a generating function: its energy error does not drift.
"""

from __future__ import annotations

import sympy
from sympy import Expr

from scvi_codegen.formulas.derivatives import jacobian
from scvi_codegen.ir.iterations import CoupledIteration
from scvi_codegen.lowering.kernels import damping_kernel, integrand_kernel, system_kernel
from scvi_codegen.lowering.solvers.base import StepProblem
from scvi_codegen.lowering.solvers.simd_padding import (
    MOST_LANES,
    lane_count,
    pad_matrix,
    pad_vector,
    predictor_tables_of,
)
from scvi_codegen.lowering.solvers.velocity_tables import VelocityTables, resolved_degree, velocity_tables
from scvi_codegen.mechanics.derived_expressions import forms_of
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.tables.basis import transpose
from scvi_codegen.tables.precision import Matrix, Vector, mp

__all__ = ["coupled_iteration", "over", "weighted_tables"]

FRACTION_BITS = 51
MOST_LINEARISED = 8
"""Largest number of coordinates with linearised forces; beyond, their derivatives cost more than they save."""


def coupled_iteration(problem: StepProblem) -> CoupledIteration | None:
    """Return the fixed-point iteration of a Lagrangian; ``None`` with too many points."""
    system, tables = problem.lagrangian, velocity_tables(problem.shape)
    return _fixed_point(system, tables) if system and tables else None


def _fixed_point(system: LagrangianSystem, tables: VelocityTables) -> CoupledIteration | None:
    points, blocks = len(tables.abscissae), len(tables.blocks)
    lanes = lane_count(max(points, blocks))
    if lanes > MOST_LANES:
        return None
    position, position_weights, momenta, momentum_weights = weighted_tables(tables)
    guess = predictor_tables_of(tables.blocks, lanes, degree=resolved_degree(tables))
    forms, of = forms_of(system), (*system.coordinates, *system.velocities)
    followed = () if tables.projection else _linearised_forces(system)
    evaluated = "L_q, L_v, their derivatives F_q, F_v and L_vq" if followed else "L_q, L_v"
    return CoupledIteration(
        points=points,
        blocks=blocks,
        lanes=lanes,
        abscissae=pad_vector(tables.abscissae, lanes, repeat=True),
        position=pad_matrix(position, lanes),
        position_weights=pad_vector(position_weights, lanes),
        momentum=pad_matrix(momenta, lanes),
        momentum_weights=pad_vector(momentum_weights, lanes),
        end_position=pad_vector(over(tables.end_position, position_weights), lanes),
        end_momentum=pad_vector(over(tables.end_momentum, momentum_weights), lanes),
        velocity=pad_matrix(tables.velocity, lanes) if tables.velocity else (),
        projection=pad_matrix(tables.projection, lanes) if tables.projection else (),
        guess=guess,
        kernel=system_kernel(
            system,
            "point_lanes",
            (*forms.force, *forms.momentum, *followed),
            of=of,
            partials=forms.lower_mass.values(),
            purpose=f"{evaluated} and the lower triangle of L_vv at all points, u = (q, v).",
        ),
        force=system_kernel(system, "force_lanes", forms.force, of=of, purpose="L_q at all points."),
        mass_entries=tuple(forms.lower_mass),
        followed=bool(followed),
        integrands=integrand_kernel(system, "integrand_lanes", of),
        damping=damping_kernel(system),
    )


def _linearised_forces(system: LagrangianSystem) -> tuple[Expr, ...]:
    """Return F_q, F_v and L_vq by rows, with their zeros, for few coordinates with position-dependent masses.

    Nothing for other systems, whose iterations converge quickly.
    """
    forms, m, zero = forms_of(system), system.dimension, sympy.Integer(0)
    if m > MOST_LINEARISED or not any(
        entry.free_symbols & {*system.coordinates} for entry in forms.lower_mass.values()
    ):
        return ()
    matrices = (
        jacobian(forms.force, system.coordinates),
        jacobian(forms.force, system.velocities),
        jacobian(forms.momentum, system.coordinates),
    )
    return tuple(matrix.get((i, j), zero) for matrix in matrices for i in range(m) for j in range(m))


def weighted_tables(tables: VelocityTables) -> tuple[Matrix, Vector, Matrix, Vector]:
    """Return position table and weights, momentum table and weights, whose products are the method's own tables."""
    beta, weights = tables.end_position, tables.end_momentum
    if not tables.variational:
        ones = (mp.one,) * len(beta)
        return tables.position, ones, tables.momentum, ones
    unit = mp.ldexp(1, FRACTION_BITS)
    mu = tuple(tuple(mp.nint(x * unit) / unit for x in over(line, beta)) for line in tables.position)
    if tables.projection:
        return mu, beta, tuple(over(line, weights) for line in tables.momentum), weights
    return mu, beta, transpose(tuple(tuple(1 - x for x in line) for line in mu)), weights


def over(numbers: Vector, divisors: Vector) -> Vector:
    """Return quotients, entry by entry."""
    return tuple(x / y for x, y in zip(numbers, divisors, strict=True))
