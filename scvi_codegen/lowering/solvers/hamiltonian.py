"""Fixed-point solver for Hamiltonian systems: no mass matrix, no Legendre transform, in lanes.

With positions and momenta at the points by the two tables of a method, one iteration computes forces, momenta,
velocities and positions in turn, each from the latest of the others (Gauss-Seidel). Its convergence rate is h^2 if H =
T(p) + V(q), and h at worst. H need not be regular. The tables are those of
:mod:`scvi_codegen.lowering.solvers.coupled`: the rounded map of a variational method still has a generating function.
"""

from __future__ import annotations

from scvi_codegen.ir.iterations import HamiltonianIteration
from scvi_codegen.lowering.kernels import integrand_kernel, system_kernel
from scvi_codegen.lowering.solvers.base import StepProblem
from scvi_codegen.lowering.solvers.coupled import over, weighted_tables
from scvi_codegen.lowering.solvers.simd_padding import (
    MOST_LANES,
    lane_count,
    pad_matrix,
    pad_vector,
    predictor_tables_of,
)
from scvi_codegen.lowering.solvers.velocity_tables import resolved_degree, velocity_tables
from scvi_codegen.mechanics.derived_expressions import forms_of

__all__ = ["hamiltonian_iteration"]


def hamiltonian_iteration(problem: StepProblem) -> HamiltonianIteration | None:
    """Return the fixed-point iteration of a Hamiltonian; ``None`` with too many or other points than velocities."""
    system = problem.system
    tables = velocity_tables(problem.shape) if system.auxiliaries else None
    if tables is None or tables.velocity or system.damping != 0:
        return None
    lanes = lane_count(len(tables.abscissae))
    if lanes > MOST_LANES:
        return None
    position, position_weights, momenta, momentum_weights = weighted_tables(tables)
    forms = forms_of(system)
    of = forms.legendre_arguments
    return HamiltonianIteration(
        points=len(tables.abscissae),
        lanes=lanes,
        abscissae=pad_vector(tables.abscissae, lanes, repeat=True),
        position=pad_matrix(position, lanes),
        position_weights=pad_vector(position_weights, lanes),
        momentum=pad_matrix(momenta, lanes),
        momentum_weights=pad_vector(momentum_weights, lanes),
        end_position=pad_vector(over(tables.end_position, position_weights), lanes),
        end_momentum=pad_vector(over(tables.end_momentum, momentum_weights), lanes),
        guess=predictor_tables_of(tables.blocks, lanes, degree=resolved_degree(tables)),
        kernel=system_kernel(system, "velocity_lanes", forms.legendre, of=of, purpose="H_p at all points, u = (q, p)."),
        force=system_kernel(system, "force_lanes", forms.force, of=of, purpose="-H_q at all points, u = (q, p)."),
        integrands=integrand_kernel(system, "integrand_lanes", of),
    )
