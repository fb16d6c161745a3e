"""RATTLE and its generalisation to s + 1 Lobatto points: only multipliers, or these and velocities, are solved for.

If the mass matrix M is constant, positions at the s + 1 Lobatto points are explicit in forces and multipliers (Lobatto
IIIA and IIIB), which leaves s equations per constraint,

    g(u_i) = 0,   u_i = q0 + h c_i M^-1 p0 + h^2 sum_n a_in M^-1 (F_n + G_n^T lambda_n),   i = 1 .. s, n = 0 .. s - 1,

then one for the momentum at the end, G_s M^-1 (.. + h w_s G_s^T lambda_s) + g_t = 0. The first are solved iteratively:
with P_n = G_n M^-1 G_n^T, a band matrix if the constraints form a chain, and R = (a_in), the correction of lambda is
-P_n^-1 (R^-1 (g + G du))_n / h^2. Changes of forces and derivatives within the step are neglected, an error of order h
that the iteration removes. SVI(1) is RATTLE. Forces that depend on velocities are evaluated at those of the curve, also
explicit in forces and multipliers, M v_n = p0 + h sum_m b_nm (F_m + G_m^T lambda_m), in each iteration. Terms A of
momenta M v + A(q, t) act likewise: l^T w l M V = .. - l^T w A, l the velocities of the curve at the points of weight w.

If M depends on positions, or with uniform damping, unknowns are multipliers and velocities at the points: their
corrections follow from the residuals of the momenta and of g with M^-1 and G M^-1 G^T of each point
(``coupled_rattle.h``).

Constraints of systems of arrays are solved by RATTLE and its symmetric compositions. A step of h is, with G0 and G1 the
derivatives of the constraints at its ends,

    p = p0 + h/2 (F0 + G0^T lambda),  q1 = q0 + h M^-1 p  with  g(q1) = 0,
    p1 = p + h/2 (F1 + G1^T mu)                           with  G1 M^-1 p1 + g_t = 0,

symmetric and symplectic on the constrained phase space. Forces that depend on velocities are F(q0, v0) and F(q1, v1),
where v1 = M^-1 p1 is solved for together with mu. Compositions of such steps satisfy the constraints after each of them
and attain their order. Both systems of multipliers are solved iteratively with G M^-1 G^T at the start or end of the
step, a sparse matrix whose pattern is computed once per run.

Sources: J.-P. Ryckaert, G. Ciccotti, H. J. C. Berendsen, J. Comput. Phys. 23 (1977); H. C. Andersen, ibid. 52 (1983);
S. Reich, SIAM J. Numer. Anal. 33 (1996), on compositions; E. Barth, K. Kuczera, B. Leimkuhler, R. D. Skeel, J. Comput.
Chem. 16 (1995), on the iteration.
"""

from collections.abc import Container, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, TypeAlias

from sympy import Expr, Integer, Symbol
from sympy.utilities.iterables import connected_components

from scvi_codegen.codegen.ir.equations import (
    NO_CONSTRAINTS,
    NO_RATTLE,
    ConstrainedSteps,
    Constraints,
    IterationTable,
    Rattle,
)
from scvi_codegen.codegen.ir.kernel import Kernel, NumberTable, RolledKernel, lower_matrix, lower_vector
from scvi_codegen.codegen.lowering.solvers.tables import VelocityTables, velocity_tables
from scvi_codegen.codegen.lowering.stage_groups import rolled_kernel, system_kernel
from scvi_codegen.common.errors import MethodError
from scvi_codegen.common.precision import Matrix, Vector, mp
from scvi_codegen.methods.method import Method
from scvi_codegen.methods.stage_system import StageSystem, Velocities
from scvi_codegen.methods.tables.basis import matrix_product, rounded, transpose
from scvi_codegen.systems.arrays.system import (
    ArraySystem,
    constraint_gradient,
    constraint_second_rate,
    constraint_text,
    entries_of,
)
from scvi_codegen.systems.constraints import (
    constraint_jacobian,
    constraint_masks,
    constraint_rates,
    force_directions,
    masks_of_contacts,
    position_conditions,
    time_derivatives,
    velocity_conditions,
)
from scvi_codegen.systems.contact import coefficients
from scvi_codegen.systems.derived_expressions import forms_of
from scvi_codegen.systems.formulas.expressions import jacobian
from scvi_codegen.systems.lagrangian import LagrangianSystem
from scvi_codegen.systems.system import MechanicalSystem

MOST_COUPLED_MASSES = 48
"""Coordinates that masses couple; with more, whose M^-1 exceeds the cache, Newton's method solves for all unknowns."""


def rattle_of(system: MechanicalSystem, stages: StageSystem, predictor: NumberTable) -> Rattle:
    """Return the iteration for multipliers with (2 (s + 1), s + 1) tables as predictor; false if not applicable."""
    if not system.constraints or system.reactions:
        return NO_RATTLE
    forms, tables = forms_of(system), velocity_tables(stages.shape)
    if any(velocity_conditions(system)) or tables is None or not forms.has_quadratic_energy:
        return NO_RATTLE
    if forms.regular_legendre is not forms.legendre:  # massless coordinates: M has no inverse
        return NO_RATTLE
    groups = connected_components((range(system.dimension), list(forms.lower_mass)))  # that masses couple
    if max(map(len, groups)) > MOST_COUPLED_MASSES:
        return NO_RATTLE
    points = len(tables.blocks)
    velocities = tuple(row[:-1] for row in predictor[: points + 1])
    added = _for_constant_masses if forms.has_constant_mass_matrix else _for_masses_of_points
    part, kernels, macros, further = added(system, tables, velocities)
    return Rattle(
        part=part,
        kernels=kernels,
        macros=macros,
        inverse_masses=(
            *((i, i) for i in range(system.dimension)),
            *((i, j) for group in groups for i in group for j in group if i > j),
        ),
        mass_columns=tuple(next(g.index(i) for g in groups if i in g) for i in range(system.dimension)),
        lower_masses=() if forms.has_constant_mass_matrix else tuple(forms.lower_mass),
        points=points,
        tables=(
            IterationTable("RATTLE_ABSCISSA", lower_vector(tables.abscissae)),
            IterationTable("RATTLE_WEIGHT", lower_vector(tables.end_momentum)),
            IterationTable("RATTLE_INVERSE", lower_matrix(_inverse(_response(tables)))),
            IterationTable("RATTLE_MULTIPLIERS", tuple(row[:-1] for row in predictor[points + 1 :])),
            *further,
        ),
    )


def _response(tables: VelocityTables) -> Matrix:
    """Return the transpose of R: positions at the points but the first from forces at all but the last, in h^2 / M."""
    return transpose(matrix_product(tables.position[1:], _impulse(tables)))


def _impulse(tables: VelocityTables) -> Matrix:
    """Return the velocities from forces at all points but the last, whose coefficients are zero."""
    return tuple(line[:-1] for line in tables.momentum)


def _inverse(matrix: Matrix) -> Matrix:
    return rounded((mp.matrix(matrix) ** -1).tolist())


Part: TypeAlias = tuple[str, tuple[Kernel, ...], tuple[str, ...], tuple[IterationTable, ...]]
"""Header of an iteration, its kernels, macros and tables."""


def _for_constant_masses(system: MechanicalSystem, tables: VelocityTables, velocities: NumberTable) -> Part:
    """Return the iteration on accelerations; ``velocities``: predictor of V."""
    forms = forms_of(system)
    position, momentum = tables.position[1:], _impulse(tables)
    start = tuple(line[0] / tables.end_momentum[0] for line in momentum)
    response = _response(tables)
    at_points = tables.velocity if forms.forces_depend_on_velocities else ()
    others, u = at_points[:-1], (*system.coordinates, *(system.velocities if at_points else ()))
    purpose = "L_q + f at u = (q, v)." if at_points else "L_q at u = q."
    kernels = [system_kernel(system, "constrained_force", forms.force, u=u, purpose=purpose)]
    named: dict[str, Matrix] = {"MOMENTUM": transpose(momentum), "RESPONSE": response}
    vectors = {"START": tuple(x - 1 for x in start), "DRIFT": tuple(mp.fdot(line, start) for line in position)}
    if at_points:
        vectors["VELOCITY_START"] = tuple(mp.fdot(line, start) - 1 for line in others)
        vectors["LAST_VELOCITY"] = at_points[-1]
        named["VELOCITY"] = transpose(matrix_product(others, momentum))
    if any(forms.momentum_at_rest):
        projection = tuple(row[1:] for row in tables.projection)
        named["PROJECTION"] = transpose(projection)
        named["SHIFT"] = transpose(matrix_product(position, projection))
        named["SHIFT_RESPONSE"] = rounded(matrix_product(named["SHIFT"], _inverse(response)))
        if at_points:
            named["VELOCITY_SHIFT"] = transpose(matrix_product(others, projection))
        kernels.append(
            system_kernel(
                system,
                "constrained_momentum",
                forms.momentum_at_rest,
                u=system.coordinates,
                purpose="L_v at u = q, v = 0.",
            )
        )
    macros = (*(("MOMENTUM_TERMS",) if len(kernels) > 1 else ()), *(("VELOCITY_FORCES",) if at_points else ()))
    two_words = ("MOMENTUM", "DRIFT", "RESPONSE", "SHIFT", "VELOCITY")
    named["POSITIONS"] = matrix_product(velocities, transpose(position))
    return "rattle", tuple(kernels), macros, tuple(_tables(vectors, named, two_words))


def _for_masses_of_points(system: MechanicalSystem, tables: VelocityTables, velocities: NumberTable) -> Part:
    """Return the iteration on velocities at the points but the last; ``velocities``: predictor of V."""
    forms = forms_of(system)
    position, others = tables.position[1:], tables.velocity[:-1]
    unknowns = _inverse(others)
    mean = transpose(matrix_product(others, tables.projection))
    point = system_kernel(
        system,
        "constrained_point",
        (*forms.force, *forms.momentum),
        u=(*system.coordinates, *system.velocities),
        partials=forms.lower_mass.values(),
        purpose="L_q + f and L_v, and the lower half of L_vv, at u = (q, v).",
    )
    named = {
        "DISPLACEMENT": transpose(matrix_product(position, unknowns)),
        "IMPULSE": transpose(matrix_product(others, _impulse(tables))),
        "MEAN": mean[:-1],
        "UNKNOWNS": transpose(unknowns),
        "VELOCITIES": matrix_product(velocities, transpose(others)),
    }
    vectors = {"MEAN_OF_LAST": mean[-1], "LAST_VELOCITY": matrix_product(tables.velocity[-1:], unknowns)[0]}
    two_words = ("DISPLACEMENT", "IMPULSE", "MEAN", "MEAN_OF_LAST")
    return (
        "coupled_rattle",
        (point,),
        ("MASSES_OF_POINTS", "VELOCITY_FORCES"),
        tuple(_tables(vectors, named, two_words)),
    )


def _tables(
    vectors: Mapping[str, Vector], matrices: Mapping[str, Matrix], two_words: Container[str]
) -> Iterator[IterationTable]:
    for name, vector in vectors.items():
        yield IterationTable(f"RATTLE_{name}", lower_vector(vector), name in two_words)
    for name, matrix in matrices.items():
        yield IterationTable(f"RATTLE_{name}", lower_matrix(matrix), name in two_words)


def constrained_steps(system: ArraySystem, stages: StageSystem, method: Method) -> ConstrainedSteps | None:
    """Return kernels and fractions of RATTLE steps, ``None`` without constraints; MethodError for other methods."""
    if not system.constraints:
        return None
    pairs = list(_kernels(system))
    conditions, curvatures = (tuple(kernels) for kernels in zip(*pairs, strict=True))
    return ConstrainedSteps(conditions=conditions, curvatures=curvatures, parts=lower_vector(_parts(stages, method)))


def _parts(stages: StageSystem, method: Method) -> Vector:
    """Return the fractions of h of the RATTLE steps of which a step is composed."""
    if method.fractions and not method.drifts_first:
        return method.fractions
    if _is_trapezoid(stages):
        return (mp.one,)
    raise MethodError(
        f"{method.name} does not support constraints of array systems: use 'stoermer-verlet', which is "
        "RATTLE, as is SVI(1, 'gauss-lobatto:2'), or 'composition:8' of it"
    )


def _is_trapezoid(stages: StageSystem) -> bool:
    """Return whether a step is that of h/2 (L(q0, v) + L(q1, v)), v = (q1 - q0)/h: SVI(1) on two Lobatto points."""
    shape = stages.shape
    if not (isinstance(shape, Velocities) and shape.variational):
        return False
    return shape.abscissae == (0, 1) and len(shape.blocks) == 1


def _kernels(system: ArraySystem) -> Iterator[tuple[RolledKernel, RolledKernel]]:
    """Yield the condition of each constraint, and its second derivative in time at constant velocity."""
    for number, term in enumerate(system.constraints):
        u = entries_of(term, system.coordinates)
        v = [Symbol(f"{slot.name} along", real=True) for slot, _ in u]
        *partials, rate = constraint_gradient(term, system.coordinates, system.time)
        second = constraint_second_rate(term, system.coordinates, system.time, v)
        values, purpose = [term.formula, rate, *partials], "g, g_t, and the derivatives of g."
        rolled = partial(rolled_kernel, system, term=term, u=u, text=constraint_text(term))
        yield (
            rolled(f"condition_{number}", values, purpose=purpose),
            rolled(f"curvature_{number}", [second], along=v, purpose="d^2 g / dt^2 along v."),
        )


def lowered_constraints(system: MechanicalSystem, stages: StageSystem) -> Constraints:
    """Return the kernels of the constraints of a system, with a method's stages."""
    if not isinstance(system, LagrangianSystem) or not system.constraints:
        return NO_CONSTRAINTS
    partials, rates = constraint_jacobian(system), constraint_rates(system)
    regular = replace(system, lagrangian=system.lagrangian + system.gauge) if system.gauge != 0 else system
    return Constraints(
        formulas=system.constraint_texts,
        kernel=system_kernel(
            system,
            "constraints",
            position_conditions(system),
            u=system.coordinates,
            partials=partials.values(),
            purpose="The constraints g of positions, and their nonzero derivatives G, at u = q.",
        ),
        entries=tuple(partials),
        rounding=system_kernel(
            system,
            "constraint_rounding",
            position_conditions(system),
            u=system.coordinates,
            purpose="Rounding errors of the constraints g of positions at u = q, in units of the round-off.",
            of_rounding=True,
        ),
        motion=system_kernel(
            system,
            "constrained_motion",
            (*forms_of(regular).applied_force, *rates, *time_derivatives(system, rates)),
            u=(*system.coordinates, *system.velocities),
            purpose="L_q - L_vq v - L_vt + f, then rates G v + .., and their derivatives in time at constant v.",
        ),
        **(_reactions(system) if system.reactions else {}),
        **(_steps_of_contacts(regular) if system.reactions and _is_trapezoid(stages) else {}),
    )


def _reactions(system: LagrangianSystem) -> dict[str, Any]:
    """Return the kernel of the masks and directions of constraint forces, and the entries of the latter."""
    directions = force_directions(system)
    return {
        "reactions": system_kernel(
            system,
            "reactions",
            [1 - mask for mask in constraint_masks(system)],
            u=(*system.coordinates, *system.velocities),
            partials=directions.values(),
            purpose="1 - mask of the constraints; nonzero entries of D at u = (q, v): forces D^T lambda.",
        ),
        "directions": tuple(directions),
        "masked": len(system.reactions),
        "coefficients": system_kernel(
            system,
            "contact_coefficients",
            coefficients(system),
            u=(*system.coordinates, *system.velocities),
            purpose="Friction, static friction and restitution of each contact at u = (q, v).",
        ),
        "coefficient_rounding": system_kernel(
            system,
            "coefficient_rounding",
            coefficients(system),
            u=(*system.coordinates, *system.velocities),
            purpose="Rounding errors of these coefficients at u = (q, v), in units of the round-off.",
            of_rounding=True,
        ),
    }


def terms_of_steps(system: LagrangianSystem) -> tuple[Kernel, tuple[tuple[int, int], ...]]:
    """Return the kernel of the terms of contacts by steps, and the entries of their derivatives by all inputs.

    At u = (q, v, f) these are L_v, L_q + F without contacts, G^T f of all constraints, their values and rates, and the
    coefficients of contacts; inputs are q, v, parameters but modes, and time.
    """
    regular = replace(system, lagrangian=system.lagrangian + system.gauge) if system.gauge != 0 else system
    forms, modes = forms_of(regular), masks_of_contacts(system)
    idle, imposed = (dict.fromkeys(modes, Integer(n)) for n in (0, 0))
    imposed |= {reaction.active: Integer(1) for reaction in system.reactions}
    impulses = [Symbol(f"impulse_{k}_of_step", real=True) for k in range(len(system.constraints))]
    rates = [rate.xreplace(imposed) for rate in constraint_rates(system)]
    forces: list[Expr] = [Integer(0)] * system.dimension
    for (k, i), entry in jacobian(rates, system.velocities).items():
        forces[i] += impulses[k] * entry
    values = [
        *(value.xreplace(idle) for value in (*forms.momentum, *forms.force)),
        *forces,
        *(value.xreplace(imposed) for value in position_conditions(system)),
        *rates,
        *(value.xreplace(imposed) for value in coefficients(system)),
    ]
    parameters = [parameter for parameter in system.parameters if parameter not in modes]
    partials = jacobian(values, (*system.coordinates, *system.velocities, *parameters, system.time))
    purpose = "Terms of contacts by steps at u = (q, v, f), and their nonzero derivatives by q, v, parameters and time."
    u = (*system.coordinates, *system.velocities, *impulses)
    return system_kernel(system, "step_terms", values, u=u, partials=partials.values(), purpose=purpose), (*partials,)


def _steps_of_contacts(system: LagrangianSystem) -> dict[str, Any]:
    """Return the kernels of contacts by steps; none for kinetic energies that are not quadratic, and with damping."""
    idle = dict.fromkeys(masks_of_contacts(system), Integer(0))
    forms = forms_of(system)
    if not forms.has_quadratic_energy or system.damping != 0:
        return {}
    m, u = system.dimension, (*system.coordinates, *system.velocities)
    values = [value.xreplace(idle) for value in (*forms.momentum, *forms.force)]
    by_state = jacobian(values[:m], u)  # one for L_vq and L_vv, whose entries share terms
    masses = {i * m + j - m: entry for (i, j), entry in by_state.items() if m <= j <= i + m}
    mixed = {(m + i) * m + j: entry for (i, j), entry in by_state.items() if j < m}
    forces = [force.xreplace(idle) for force in system.forces]
    damping = {(2 * m + i) * m + j: entry for (i, j), entry in jacobian(forces, system.velocities).items()}
    partials = masses | mixed | damping
    still = {reaction.active: Integer(1) for reaction in system.reactions} | dict.fromkeys(
        system.velocities, Integer(0)
    )
    kernel = partial(system_kernel, system, u=u)
    return {
        "motion_by_steps": kernel(
            "motion_by_steps",
            values,
            partials=partials.values(),
            purpose="L_v and L_q + f without contacts, the lower half of L_vv, then L_vq and f_v, at u = (q, v).",
        ),
        "masses_by_steps": kernel(
            "masses_by_steps",
            values,
            partials=masses.values(),
            purpose="L_v and L_q + f without contacts, and the lower half of L_vv, at u = (q, v).",
        ),
        "motion_places": tuple(partials),
        "motion_masses": len(masses),
        "drifts": system_kernel(
            system,
            "drifts",
            [rate.xreplace(still) for rate in constraint_rates(system)],
            u=system.coordinates,
            purpose="Rates of the constraints at rest, by time, at u = q.",
        ),
    }
