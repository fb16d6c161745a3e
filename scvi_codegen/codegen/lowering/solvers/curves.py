"""Fixed-point solvers on the accelerations of a curve, in SIMD lanes: nodes, and quadrature points along it.

With z = h a the curves are V = v0 + A z and q = q0 + h A V at the nodes, q1 = q0 + h sum b V and v1 = v0 + sum b z; at
the points q = q0 + h a V and v = l V, V being the velocities at the nodes.

**Collocation.** The Euler-Lagrange equations at the nodes of a curve from q0: z = h M^-1 (L_q - L_vq V - L_vt) is
iterated to convergence. Without points, p0 and p1 are L_v at the ends of the curve, and v0 is known; in the printed
form of the paper they are sums over the points, and v0 is corrected after z by M^-1 times the residual of p0:

    p0 = -sum (h start_force L_q + start_momentum L_v),     p1 = p0 + sum (h end_force L_q + end_momentum L_v),

the weights being w l_0, w l_0', w (l_0 + l_s), w (l_0' + l_s'), l_0 of the first node.

**Shooting.** Unknowns: v0, z at the nodes and the scaled multipliers m_i. One iteration is

    z -= h M^-1 E(q, V, z / h),          p1 = p0 + h sum w L_q + h^2 sum (m . E)_q,
    gamma = h a^T w L_q + l^T w L_v + h (m . E)_v + h^2 A^T (m . E)_q - b p1,
    v0 -= M^-1 sum gamma,                m = -M^-1 A^T (gamma - l^T w sum gamma).

The order of the updates (accelerations, then the action along the new curve, then momentum, initial velocity and
multipliers) makes it converge twice as fast as a simultaneous update. The equations are those of
``methods/shooting.py`` in these unknowns.
"""

import operator
from collections.abc import Iterator

from sympy import S

from scvi_codegen.codegen.ir.equations import FixedPointIteration, IterationTable, StoredValues
from scvi_codegen.codegen.ir.kernel import Kernel
from scvi_codegen.codegen.lowering.solvers.tables import (
    MOST_LANES,
    StepProblem,
    lane_count,
    pad_matrix,
    pad_vector,
    predictor_tables_of,
)
from scvi_codegen.codegen.lowering.stage_groups import system_kernel
from scvi_codegen.common.precision import mp
from scvi_codegen.methods.stage_system import Accelerations, PrintedCurve, ShotCurve
from scvi_codegen.methods.tables.basis import (
    cardinal_derivatives,
    cardinal_integrals,
    cardinal_values,
    matrix_product,
    transpose,
)
from scvi_codegen.methods.tables.quadrature import Quadrature
from scvi_codegen.methods.tables.tableau import Tableau
from scvi_codegen.systems.derived_expressions import accelerations, forms_of, multipliers
from scvi_codegen.systems.formulas.expressions import gradient_tuple
from scvi_codegen.systems.system import MechanicalSystem

LARGEST_DIMENSION = 8
"""Largest number of coordinates of shooting; beyond, the kernels take longer to compile than they save."""


def curve_iteration(problem: StepProblem) -> FixedPointIteration | None:
    """Return the fixed-point iteration on a curve through the stages of a tableau; ``None`` if it would be too large.

    Without a rule it is that of a tableau in position form, else of an SCVI of degree 2 or more: shooting, or printed.
    """
    system, shape = problem.lagrangian, problem.shape
    if system is None or not isinstance(shape, Accelerations | PrintedCurve | ShotCurve):
        return None
    tableau, rule = shape.tableau, None if isinstance(shape, Accelerations) else shape.rule
    size, shooting = len(tableau.b), isinstance(shape, ShotCurve)
    lanes = lane_count(max(size, len(rule) if rule else 0), in_groups=False)
    if lanes > MOST_LANES or (shooting and system.dimension > LARGEST_DIMENSION):
        return None
    nodes = (
        IterationTable("NODE_TIME", pad_vector(tableau.c, lanes, repeat=True)),
        IterationTable("COLLOCATION", pad_matrix(tableau.A, lanes)),
        IterationTable("NODE_END", pad_vector(tableau.b, lanes, repeat=True)),
        IterationTable("NODE_MASK", pad_vector((mp.one,) * size, lanes)),
    )
    kernel = _residual_kernel(system) if shooting else _node_kernel(system)
    return FixedPointIteration(
        name="shooting" if shooting else "collocation",
        points=size,
        lanes=lanes,
        own_tables=(*nodes, *(_point_tables(tableau, rule, lanes, shooting=shooting) if rule else ())),
        guess=predictor_tables_of(tableau.c, lanes),
        kernels=(kernel, _action_kernel(system)) if rule else (kernel,),
        kept=StoredValues.ACCELERATIONS,
        stored=(3 if shooting else 2) * lanes + 1,
        parts=("mass_matrix", "curve", f"{'shooting' if shooting else 'collocation'}_iteration"),
        macros=(("NODES", size) if rule else ("HAMILTONIAN", int(bool(problem.system.auxiliaries))),),
        mass_entries=tuple(forms_of(system).lower_mass),
        in_groups=False,
    )


def _point_tables(tableau: Tableau, rule: Quadrature, lanes: int, *, shooting: bool) -> Iterator[IterationTable]:
    """Yield the points of a quadrature along a curve whose velocity is a polynomial through the nodes."""
    position, velocity = cardinal_integrals(tableau.c, rule.abscissae, 0), cardinal_values(tableau.c, rule.abscissae)
    yield IterationTable("POINT_TIME", pad_vector(rule.abscissae, lanes, repeat=True))
    yield IterationTable("POINT_POSITION", pad_matrix(position, lanes))
    yield IterationTable("POINT_VELOCITY", pad_matrix(velocity, lanes))
    if not shooting:
        yield from _printed_ends(tableau, rule, lanes)
        return
    consistency = matrix_product((rule.unit_weights,), velocity)[0]
    yield IterationTable("COLLOCATION_T", pad_matrix(transpose(tableau.A), lanes))
    yield IterationTable("POINT_POSITION_T", pad_matrix(transpose(position), lanes))
    yield IterationTable("POINT_VELOCITY_T", pad_matrix(transpose(velocity), lanes))
    yield IterationTable("POINT_WEIGHT", pad_vector(rule.unit_weights, lanes))
    yield IterationTable("NODE_CONSISTENCY", pad_vector(consistency, lanes, repeat=True))


def _printed_ends(tableau: Tableau, rule: Quadrature, lanes: int) -> tuple[IterationTable, ...]:
    """Return the weights times the cardinal functions of the nodes at both ends, (34d) and (34e)."""
    nodes = (0, *tableau.c)
    values, partials = (cardinals(nodes, rule.abscissae) for cardinals in (cardinal_values, cardinal_derivatives))
    weighted = {
        "START_FORCE": [line[0] for line in values],
        "START_MOMENTUM": [line[0] for line in partials],
        "END_FORCE": [line[0] + line[-1] for line in values],
        "END_MOMENTUM": [line[0] + line[-1] for line in partials],
    }
    return tuple(
        IterationTable(name, pad_vector(tuple(w * x for w, x in zip(rule.unit_weights, line, strict=True)), lanes))
        for name, line in weighted.items()
    )


def _action_kernel(system: MechanicalSystem) -> Kernel:
    """Return the kernel of L_q and L_v."""
    forms = forms_of(system)
    return system_kernel(
        system,
        "action_lanes",
        (*forms.force, *forms.momentum),
        u=(*system.coordinates, *system.velocities),
        purpose="L_q and L_v at all points, u = (q, v).",
    )


def _node_kernel(system: MechanicalSystem) -> Kernel:
    """Return the kernel of L_q - L_vq v - L_vt and the lower triangle of the mass."""
    return system_kernel(
        system,
        "applied_force_lanes",
        forms_of(system).applied_force,
        u=(*system.coordinates, *system.velocities),
        partials=forms_of(system).lower_mass.values(),
        purpose="L_q - L_vq v - L_vt and the lower triangle of L_vv at all nodes, u = (q, v).",
    )


def _residual_kernel(system: MechanicalSystem) -> Kernel:
    """Return the kernel of E, (m . E)_q, (m . E)_v and the lower triangle of the mass."""
    forms, state = forms_of(system), (*system.coordinates, *system.velocities)
    partials = gradient_tuple(forms.multiplied_residual, state)
    adjoint = sum(forms.multiplied_forces[:2], ()) or (S.Zero,) * len(state)
    return system_kernel(
        system,
        "node_lanes",
        (*forms.euler_lagrange, *map(operator.add, partials, adjoint)),
        u=(*state, *accelerations(system), *multipliers(system)),
        partials=forms.lower_mass.values(),
        purpose="E, (m . E)_q, (m . E)_v and the lower triangle of L_vv at all nodes, u = (q, v, a, m).",
    )
