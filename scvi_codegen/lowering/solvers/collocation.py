"""Fixed-point solver of collocation in position form: accelerations at the nodes are SIMD lanes.

It applies to non-variational collocation of the Euler-Lagrange equations: spectral collocation and Runge-Kutta methods
in position form, whose momenta at both ends are those of the velocities there, and the shooting-based method as
printed, whose momenta at both ends are quadratures. The equations, those of ``methods/collocation.py`` and
``methods/shooting.py`` solved for accelerations, are in :class:`scvi_codegen.ir.curve_iterations.CollocationIteration`.
"""

from __future__ import annotations

from collections.abc import Iterable

from scvi_codegen.ir.curve_iterations import CollocationIteration, PrintedEnds
from scvi_codegen.ir.kernel import Kernel
from scvi_codegen.lowering.kernels import system_kernel
from scvi_codegen.lowering.solvers.base import StepProblem
from scvi_codegen.lowering.solvers.curve_tables import node_tables, point_tables
from scvi_codegen.lowering.solvers.simd_padding import MOST_LANES, lane_count, pad_vector, predictor_tables_of
from scvi_codegen.mechanics.derived_expressions import forms_of
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.stage_structure import Accelerations, PrintedCurve
from scvi_codegen.tables.basis import cardinal_derivatives, cardinal_values
from scvi_codegen.tables.precision import Number
from scvi_codegen.tables.quadrature import Quadrature
from scvi_codegen.tables.tableau import Tableau

__all__ = ["position_iteration", "printed_iteration"]


def position_iteration(problem: StepProblem) -> CollocationIteration | None:
    """Return the fixed-point iteration of a tableau in position form; ``None`` with too many stages."""
    system, shape = problem.lagrangian, problem.shape
    if system is None or not isinstance(shape, Accelerations):
        return None
    tableau = shape.tableau
    lanes = lane_count(len(tableau.b))
    if lanes > MOST_LANES:
        return None
    return CollocationIteration(
        lanes=lanes,
        nodes=node_tables(tableau, lanes),
        guess=predictor_tables_of(tableau.c, lanes),
        points=None,
        kernel=_node_kernel(system),
        mass_entries=tuple(forms_of(system).lower_mass),
        ends=None,
        hamiltonian=bool(problem.system.auxiliaries),
    )


def printed_iteration(problem: StepProblem) -> CollocationIteration | None:
    """Return the fixed-point iteration of an SCVI as printed, of degree 2 or more; ``None`` with too many points."""
    system, shape = problem.lagrangian, problem.shape
    if system is None or not isinstance(shape, PrintedCurve):
        return None
    lanes = lane_count(max(len(shape.tableau.b), len(shape.rule)))
    if lanes > MOST_LANES:
        return None
    return CollocationIteration(
        lanes=lanes,
        nodes=node_tables(shape.tableau, lanes),
        guess=predictor_tables_of(shape.tableau.c, lanes),
        points=point_tables(system, shape.tableau, shape.rule, lanes),
        kernel=_node_kernel(system),
        mass_entries=tuple(forms_of(system).lower_mass),
        ends=_printed_ends(shape.tableau, shape.rule, lanes),
        hamiltonian=bool(problem.system.auxiliaries),
    )


def _printed_ends(tableau: Tableau, rule: Quadrature, lanes: int) -> PrintedEnds:
    """Return the weights times the cardinal functions of the nodes at both ends, (34d) and (34e)."""
    nodes = (0, *tableau.c)
    values, partials = (cardinals(nodes, rule.abscissae) for cardinals in (cardinal_values, cardinal_derivatives))

    def weighted(numbers: Iterable[Number]) -> tuple[Number, ...]:
        return pad_vector(tuple(w * x for w, x in zip(rule.unit_weights, numbers, strict=True)), lanes)

    return PrintedEnds(
        start_force=weighted(line[0] for line in values),
        start_momentum=weighted(line[0] for line in partials),
        end_force=weighted(line[0] + line[-1] for line in values),
        end_momentum=weighted(line[0] + line[-1] for line in partials),
    )


def _node_kernel(system: MechanicalSystem) -> Kernel:
    """Return the kernel of L_q - L_vq v - L_vt and the lower triangle of the mass."""
    return system_kernel(
        system,
        "applied_force_lanes",
        forms_of(system).applied_force,
        of=(*system.coordinates, *system.velocities),
        partials=forms_of(system).lower_mass.values(),
        purpose="L_q - L_vq v - L_vt and the lower triangle of L_vv at all nodes, u = (q, v).",
    )
