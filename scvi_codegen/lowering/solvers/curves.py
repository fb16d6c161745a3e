"""Tables of the fixed-point solvers with accelerations as unknowns: the nodes of a curve, and points along it."""

from __future__ import annotations

from collections.abc import Iterable

from sympy import S

from scvi_codegen.formulas.derivatives import gradient
from scvi_codegen.ir.curve_iterations import (
    CollocationIteration,
    NodeTables,
    PointTables,
    PrintedEnds,
    ShootingIteration,
)
from scvi_codegen.ir.kernel import Kernel
from scvi_codegen.lowering.kernels import system_kernel
from scvi_codegen.lowering.solvers.tables import (
    MOST_LANES,
    StepProblem,
    lane_count,
    pad_matrix,
    pad_vector,
    predictor_tables_of,
)
from scvi_codegen.mechanics.derived_expressions import accelerations, forms_of, multipliers
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.stage_structure import Accelerations, PrintedCurve, ShotCurve
from scvi_codegen.tables.basis import (
    cardinal_derivatives,
    cardinal_integrals,
    cardinal_values,
    matrix_product,
    transpose,
)
from scvi_codegen.tables.precision import Number, mp
from scvi_codegen.tables.quadrature import Quadrature
from scvi_codegen.tables.tableau import Tableau

__all__ = ["node_tables", "point_tables", "position_iteration", "printed_iteration", "shooting_iteration"]


def node_tables(tableau: Tableau, lanes: int) -> NodeTables:
    """Return the nodes of a curve: the stages of a tableau."""
    size = len(tableau.b)
    return NodeTables(
        count=size,
        abscissae=pad_vector(tableau.c, lanes, repeat=True),
        collocation=pad_matrix(tableau.A, lanes),
        end=pad_vector(tableau.b, lanes, repeat=True),
        mask=pad_vector((mp.one,) * size, lanes),
    )


def point_tables(system: MechanicalSystem, tableau: Tableau, rule: Quadrature, lanes: int) -> PointTables:
    """Return the points of a quadrature along a curve whose velocity is a polynomial through the nodes."""
    forms = forms_of(system)
    return PointTables(
        abscissae=pad_vector(rule.abscissae, lanes, repeat=True),
        position=pad_matrix(cardinal_integrals(tableau.c, rule.abscissae, 0), lanes),
        velocity=pad_matrix(cardinal_values(tableau.c, rule.abscissae), lanes),
        action=system_kernel(
            system,
            "action_lanes",
            (*forms.force, *forms.momentum),
            of=(*system.coordinates, *system.velocities),
            purpose="L_q and L_v at all points, u = (q, v).",
        ),
    )


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
        kernel=_residual_kernel(system),
        mass_entries=tuple(forms_of(system).lower_mass),
    )


def _residual_kernel(system: MechanicalSystem) -> Kernel:
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
