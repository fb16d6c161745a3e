"""Fixed-point solvers on velocities, forces or momenta at the points of a step, in SIMD lanes.

**Separable systems.** With a constant diagonal mass and forces of position and time the two tables of a method
(positions from velocities, momenta from forces) are multiplied into one, q_n = q0 + h c_n v0 + h^2 sum_j product[n][j]
F_j / m, for every SVI, for the Runge-Kutta methods, and for spectral collocation and the position forms as well:

    q_n = q0 + h drift[n] v0 + h^2 sum_j product[n][j] F_j / m,     v0 = p0 / m,
    q1 = q0 + h v0 + h^2 sum_j end_position[j] F_j / m,             p1 = p0 + h sum_j end_momentum[j] F_j,
    V_n = v0 + h sum_j velocity[n][j] F_j / m,                      if forces depend on velocities;

no matrix is factorised. A variational method is symplectic because its tables are adjoint; rounded to 53 bits they are
not exactly, and the energy drifts. So they have 106 bits, including the powers of h. The low words are only used where
they matter: in the last evaluation of the points and in the increments.

**Other systems** have velocities as unknowns, and scaled weights h w_j, F being L_q (-H_q) at the points:

    q_n = q0 + sum_j position[n][j] (h position_weights[j] V_j),    q1 = q0 + sum_j end_position[j] (h .. V_j),
    P_n = p0 + sum_j momentum[n][j] (h momentum_weights[j] F_j),    p1 = p0 + sum_j end_momentum[j] (h .. F_j).

**Hamiltonians.** No mass matrix, no Legendre transform: with positions and momenta at the points, one iteration
computes forces, momenta, velocities and positions in turn, each from the latest of the others (Gauss-Seidel). Its
convergence rate is h^2 if H = T(p) + V(q), and h at worst. H need not be regular. Rotations share most operations of
forces and velocities and have the rate h either way: both are evaluated at once (Jacobi), in a fifth more iterations
with half the latency; kernels then add terms in pairs. Turns of axially symmetric bodies follow the iteration, and turn
its predictor (:mod:`scvi_codegen.systems.rotations`).

**Any regular Lagrangian.** Velocities are corrected by the mass matrix at each point: the equations are L_v(q_n, V_n) =
P_n. If the points are not those of the velocities (an SVI with another quadrature), the s velocities z_b give V_n =
sum_b l_nb z_b and the equations are projected: a correction is interpolated by l, solved with the mass at each point,
and projected back. If masses depend on positions, a correction changes forces and momenta about as much as the residual
it removes. So it is computed twice, the second time including its own first-order effect, by F_q, F_v and L_vq of the
same kernel: one iteration then converges like two, and the final forces include the last correction. This saves a
quarter of the time of a step of a swinging Atwood machine, 8 to 25 % for pendulums, carts and time-transformed systems,
and a tenth in a plane rotating frame (momenta that depend on positions, and forces that are no polynomials).

For a variational method the two tables are adjoint. With mu_nj = a_nj / beta_j, the scaled weights h beta_j rounded
once and used in stages and updates alike, and A_nj / w_j = 1 - mu_jn, exact since mu is a multiple of 2^-51, the
rounded map still has a generating function: its energy error does not drift.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from sys import float_info
from typing import Any

import numpy as np
import sympy
from sympy import Add, Expr, Symbol

from scvi_codegen.codegen.ir.equations import (
    FixedPointIteration,
    IterationName,
    IterationTable,
    LinearPart,
    StoredValues,
)
from scvi_codegen.codegen.ir.kernel import Kernel
from scvi_codegen.codegen.lowering.solvers.tables import (
    MOST_LANES,
    StepProblem,
    VelocityTables,
    lane_count,
    pad_matrix,
    pad_vector,
    predictor_tables_of,
    remainder_tables,
    resolved_degree,
    shift_tables,
    tableau_tables,
    velocity_tables,
)
from scvi_codegen.codegen.lowering.stage_groups import (
    bandwidth,
    bandwidth_ordering,
    damping_kernel,
    integrand_kernel,
    system_kernel,
)
from scvi_codegen.common.precision import Matrix, Vector, mp
from scvi_codegen.methods.stage_system import Accelerations, Shape, Velocities, words_of_tables
from scvi_codegen.methods.tables.basis import matrix_product, transpose
from scvi_codegen.systems.derived_expressions import InverseMass, dense, forms_of
from scvi_codegen.systems.formulas.expressions import gradient_tuple, jacobian
from scvi_codegen.systems.formulas.intermediates import inner_of
from scvi_codegen.systems.formulas.symbols import symbol
from scvi_codegen.systems.lagrangian import LagrangianSystem
from scvi_codegen.systems.splittings.axial import Turn, axial_turns, frame_potential
from scvi_codegen.systems.system import MechanicalSystem

LEAST_LINEAR_PART, WIDEST_LINEAR_PART = 8, 4
"""Fewest coordinates and largest bandwidth with which steps are solved implicitly for the linear part of the forces."""
ROUNDING = 1e-12
INPUT_PARAMETERS = 5
"""Number of parameters of a tabulated input."""


def separable_iteration(problem: StepProblem, *, velocities: bool = False) -> FixedPointIteration | None:
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
    return _separable(system, tables, velocities=velocities) if tables else None


def _separable(system: LagrangianSystem, tables: VelocityTables, *, velocities: bool) -> FixedPointIteration | None:
    points = len(tables.abscissae)
    lanes = lane_count(points)
    if lanes > MOST_LANES:
        return None
    product = matrix_product(tables.position, tables.momentum)
    drift = tuple(mp.fsum(line) for line in tables.position)
    end_position = matrix_product((tables.end_position,), tables.momentum)[0]
    highest = min(points, len(tables.blocks)) - 1
    at_points = matrix_product(tables.velocity, tables.momentum) if tables.velocity else tables.momentum
    forms, padded, matrix = forms_of(system), pad_matrix(product, lanes), product
    if velocities:
        matrix = at_points if _nearly_equal(matrix_product(at_points, at_points), product) else ()
    return FixedPointIteration(
        name="separable",
        points=points,
        lanes=lanes,
        own_tables=(
            IterationTable("ABSCISSA", pad_vector(tables.abscissae, lanes, repeat=True)),
            IterationTable("DRIFT", pad_vector(drift, lanes, repeat=True), in_two_parts=True),
            IterationTable("PRODUCT", padded, in_two_parts=True),
            IterationTable("POINT_END_POSITION", pad_vector(end_position, lanes), in_two_parts=True),
            IterationTable("POINT_END_MOMENTUM", pad_vector(tables.end_momentum, lanes), in_two_parts=True),
            *((IterationTable("VELOCITY", pad_matrix(at_points, lanes)),) if velocities else ()),
        ),
        guess=predictor_tables_of(tables.abscissae, lanes, through=None if velocities else product, degree=highest),
        kernels=(
            system_kernel(system, "force_lanes", forms.force, u=system.coordinates, purpose="L_q at all points."),
        ),
        forces=("force_lanes",),
        kept=StoredValues.FORCES,
        stored=2 * lanes,
        parts=("separable_iteration",),
        constant_mass=system_kernel(system, "mass", forms.mass.values(), u=(), purpose="The constant masses."),
        predictor_matrix=padded,
        matrix=matrix,
        derivatives_part="" if velocities else "separable_derivatives",
        serves_many=True,
        final_iterations=1,  # the final one, with double-double coefficients
        linear_part=None if velocities or points < 2 else _linear_part(system, product, lanes),
        remainder=remainder_tables(product, end_position, tables.end_momentum, lanes),
    )


def _linear_part(system: LagrangianSystem, product: Matrix, lanes: int) -> LinearPart | None:
    """Return the derivatives of the forces at q = 0 if steps are to be solved for them, else ``None``.

    They must be finite, constant, symmetric with a narrow band and, with the default parameters, a stable equilibrium,
    so that the systems for all eigenvalues are regular at any step size.
    """
    force, rest = forms_of(system).force, dict.fromkeys(system.coordinates, sympy.S.Zero)
    diagonal = {(i, i) for i in range(len(force))}
    few = all(len(F.free_symbols & rest.keys()) <= 2 * WIDEST_LINEAR_PART + 1 for F in force)
    if len(force) < LEAST_LINEAR_PART or not few or not all(_is_finite(F.xreplace(rest)) for F in force):
        return None
    derivatives = jacobian(force, system.coordinates)
    entries = {place: derivatives.get(place, sympy.S.Zero).xreplace(rest) for place in diagonal | derivatives.keys()}
    entries = {place: entry for place, entry in sorted(entries.items()) if entry != 0 or place in diagonal}
    symmetric = all(entries.get((j, i), 0) == entry for (i, j), entry in entries.items())
    if not symmetric or not all(_is_finite(entry) for entry in entries.values()) or not _is_stable(system, entries):
        return None
    order, shifts = bandwidth_ordering(entries, len(force)), shift_tables(product, lanes)
    if bandwidth(entries, order) > WIDEST_LINEAR_PART or not (shifts and shifts.is_accurate):
        return None
    lower = {(order[i], order[j]): entry for (i, j), entry in entries.items() if order[i] >= order[j]}
    purpose = "Derivatives of the forces L_q at q = 0."
    return LinearPart(
        kernel=system_kernel(system, "linear_forces", lower.values(), u=(), purpose=purpose),
        entries=tuple(lower),
        coordinates=tuple(sorted(range(len(force)), key=order.__getitem__)),
        bandwidth=bandwidth(entries, order),
        shifts=shifts,
    )


def _is_stable(system: LagrangianSystem, entries: Mapping[tuple[int, int], Expr]) -> bool:
    """Return whether derivatives F_q of forces depend on constant parameters alone and are negative semidefinite.

    With the default parameters q'' = M^-1 F_q q is stable then: no eigenvalue of F_q is above rounding, relative to the
    smallest, which must be negative.
    """
    inputs = {symbol(f"{name}_{k}") for name in system.inputs for k in range(INPUT_PARAMETERS)}
    values = system.constants
    if any(entry.free_symbols - (values.keys() - inputs) for entry in entries.values()):
        return False
    numbers = (entry.xreplace(values) for entry in entries.values())
    rates = np.linalg.eigvalsh(dense(entries, numbers, (system.dimension, system.dimension)))
    return bool(rates[0] < 0 and rates[-1] <= ROUNDING * -rates[0])


def _is_finite(value: Expr) -> bool:
    """Return whether a value at q = 0 is a number that C computes; sqrt(e**2) becomes an absolute value."""
    return not value.has(sympy.nan, sympy.zoo, sympy.oo, -sympy.oo, sympy.Abs, sympy.sign)


def _point_iteration(
    name: IterationName, tables: VelocityTables, lanes: int, kernels: Iterable[Kernel | None], **further: Any
) -> FixedPointIteration:
    """Return an iteration on velocities at the points; ``kernels``: without those that are ``None``."""
    names = ("POSITION", "POSITION_WEIGHT", "MOMENTUM", "MOMENTUM_WEIGHT")
    position, position_weights, momenta, momentum_weights = weighted_tables(tables)
    padded = (
        pad_matrix(position, lanes),
        pad_vector(position_weights, lanes),
        pad_matrix(momenta, lanes),
        pad_vector(momentum_weights, lanes),
    )
    extra = (("VELOCITY", tables.velocity), ("PROJECTION", tables.projection))
    return FixedPointIteration(
        name=name,
        points=len(tables.abscissae),
        lanes=lanes,
        own_tables=(
            IterationTable("ABSCISSA", pad_vector(tables.abscissae, lanes, repeat=True)),
            *map(IterationTable, names, padded),
            IterationTable("POINT_END_POSITION", pad_vector(over(tables.end_position, position_weights), lanes)),
            IterationTable("POINT_END_MOMENTUM", pad_vector(over(tables.end_momentum, momentum_weights), lanes)),
            *(IterationTable(name, pad_matrix(table, lanes)) for name, table in extra if table),
        ),
        guess=predictor_tables_of(tables.blocks, lanes, degree=resolved_degree(tables)),
        kernels=tuple(kernel for kernel in kernels if kernel),
        kept=StoredValues.VELOCITIES,
        **further,
    )


def hamiltonian_iteration(problem: StepProblem) -> FixedPointIteration | None:
    """Return the fixed-point iteration of a Hamiltonian; ``None`` with too many or other points than velocities."""
    system, turns = axial_turns(problem.system)
    tables = velocity_tables(problem.shape) if system.auxiliaries else None
    if tables is None or tables.velocity or system.damping != 0:
        return None
    lanes, forms = lane_count(len(tables.abscissae)), forms_of(system)
    if lanes > MOST_LANES:
        return None
    arguments, turning = forms.legendre_arguments, bool(system.rotations)
    joint = (
        turning and lanes > 2 and sum(len(rotation.coordinates) for rotation in system.rotations) == system.dimension
    )
    kernel, potential = partial(system_kernel, system, u=arguments, paired=turning), frame_potential(problem.system)
    in_space = (
        kernel("velocity_lanes", forms.legendre, purpose="H_p at all points, u = (q, p)."),
        kernel("force_lanes", forms.force, purpose="-H_q at all points, u = (q, p)."),
        kernel("rate_lanes", (*forms.legendre, *forms.force), purpose="(H_p, -H_q) at all points, u = (q, p).")
        if joint
        else None,
        integrand_kernel(system, "integrand_lanes", arguments),
        _turn_kernel(system, turns, lanes=True),
    )
    macros = {"JOINT_RATES": int(joint), "TURNS": len(turns), "MOVING_FRAME": int(potential is not None)}
    return _point_iteration(
        "Hamiltonian",
        tables,
        lanes,
        in_space if potential is None else (_frame_kernel(system, turns, potential),),
        constant_mass=_turn_kernel(system, turns, lanes=False),
        forces=() if joint or potential is not None else ("force_lanes",),
        stored=4 * lanes,
        parts=("point_weights", "hamiltonian_iteration"),
        macros=tuple((name, value) for name, value in macros.items() if value),
        serves_many=not turns,
        matrix=tables.position if _nearly_equal(tables.position, tables.momentum) else (),
    )


def _frame_kernel(system: MechanicalSystem, turns: Sequence[Turn], potential: Expr) -> Kernel:
    """Return the kernel of the gradient of the potential and of the factors of angles, as a function of q and |q|^2."""
    q, squares = system.coordinates, [Symbol(f"square_{k}", real=True) for k in range(len(turns))]
    sums = {Add(*(x**2 for x in q[4 * k : 4 * k + 4])): square for k, square in enumerate(squares)}
    values = [derivative.xreplace(sums) for derivative in gradient_tuple(potential, q)] + [
        turn.rate / 4 for turn in turns
    ]
    purpose = "V_q and 1/(4 A) at all points, u = (q, |q|^2 of each body)."
    return system_kernel(system, "frame_lanes", values, u=(*q, *squares), paired=True, purpose=purpose)


def _turn_kernel(system: MechanicalSystem, turns: Sequence[Turn], *, lanes: bool) -> Kernel | None:
    """Return the kernel of the rotations that end a step, or of their effect on vectors; ``None`` without turns."""
    q, p = (tuple(Symbol(f"{name}_{i}", real=True) for i in range(system.dimension)) for name in "qp")
    if not turns:
        return None
    if not lanes:
        values = sum((turn.rotation(q, p) for turn in turns), ())
        return system_kernel(
            system, "rotations", values, u=(*q, *p), purpose="exp(kappa h Pi_k e_k/2) - 1, u = (q, h p)."
        )
    rotations = [tuple(Symbol(f"g_{k}_{i}", real=True) for i in range(4)) for k in range(len(turns))]
    changes = ((*t.change(q, g), *t.change(p, g)) for t, g in zip(turns, rotations, strict=True))
    purpose = "Changes q (g - 1) and p (g - 1) of vectors by rotations, u = (q, p, g - 1)."
    return system_kernel(system, "turn_lanes", map(Add, *changes), u=(*q, *p, *sum(rotations, ())), purpose=purpose)


def summing_action(
    fixed_point: FixedPointIteration, system: MechanicalSystem, shape: Shape | None
) -> FixedPointIteration | None:
    """Return an iteration with the kernel of L at the points, whose sums are the action of a run; ``None`` if unknown.

    Not with turns, whose steps are more than the curve through the points.
    """
    name, macros = fixed_point.name, dict(fixed_point.macros)
    if system.integrands or {"TURNS", "MOVING_FRAME"} & {*macros}:
        return None
    twin = StepProblem(system, shape).lagrangian
    if name == "Hamiltonian":
        arguments, velocities = forms_of(system).legendre_arguments, forms_of(system).legendre
        scalar = Add(*(p * v for p, v in zip(system.auxiliaries, velocities, strict=True)), -system.formula)
    elif name in ("separable", "coupled", "shooting") and twin:
        system, arguments, scalar = twin, (*twin.coordinates, *twin.velocities), twin.lagrangian
    else:
        return None
    own = fixed_point.own_tables
    if name == "separable":
        with_velocities = separable_iteration(StepProblem(system, shape), velocities=True)
        tables = with_velocities.own_tables if with_velocities else ()
        own = (*own, *(table for table in tables if table.name == "VELOCITY"))
    kernel = system_kernel(system, "integrand_lanes", (scalar,), u=arguments, purpose="L at all points.")
    return replace(fixed_point, own_tables=own, kernels=(*fixed_point.kernels, kernel))


def _nearly_equal(a: Matrix, b: Matrix) -> bool:
    """Return whether two tables of a method are equal up to rounding: those of an SVI are rounded to be adjoint."""
    return all(abs(x - y) < EPSILON for x, y in zip(chain(*a), chain(*b), strict=True))


EPSILON = 1e-14
"""Largest difference of tables that rounding explains."""
MOST_LINEARISED, MOST_COUPLED = 8, 2
"""Largest numbers of coordinates with linearised forces; beyond, their derivatives cost more than they save: if masses
depend on positions, and if momenta do with masses that do not."""


LARGEST_MASS_MATRICES = 2**17
"""Largest number of entries of the full mass matrices at all points, which are on the stack (1 MiB)."""


def coupled_iteration(problem: StepProblem) -> FixedPointIteration | None:
    """Return the fixed-point iteration of a Lagrangian; ``None`` with too many points or coupled velocities."""
    system, tables = problem.lagrangian, velocity_tables(problem.shape)
    return _coupled(system, tables) if system and tables else None


def _coupled(system: LagrangianSystem, tables: VelocityTables) -> FixedPointIteration | None:
    lanes, forms = lane_count(max(len(tables.abscissae), len(tables.blocks))), forms_of(system)
    inverse = forms.inverse_mass
    full = not inverse and any(i != j for i, j in forms.lower_mass)
    if lanes > MOST_LANES or (full and lanes * system.dimension**2 > LARGEST_MASS_MATRICES):
        return None
    arguments, projected = (*system.coordinates, *system.velocities), bool(tables.velocity)
    frozen, kernel = bool(inverse or inner_of(system.lagrangian)), partial(system_kernel, system, u=arguments)
    followed = () if tables.projection or frozen else _linearised_forces(system)
    evaluated = "L_q, L_v, their derivatives F_q, F_v and L_vq" if followed else "L_q, L_v"
    values = (*forms.force, *forms.momentum)
    if frozen:
        force = kernel("value_lanes", values, purpose="L_q, L_v at all points.")
        purpose = f"{'Terms of the inverse' if inverse else 'The lower triangle'} of L_vv at all points, u = (q, v)."
        matrices = kernel("mass_lanes", (), partials=forms.mass_terms, purpose=purpose)
    else:
        force = kernel("force_lanes", forms.force, purpose="L_q at all points.")
        purpose = f"{evaluated} and the lower triangle of L_vv at all points, u = (q, v)."
        matrices = kernel("point_lanes", (*values, *followed), partials=forms.mass_terms, purpose=purpose)
    macros = (("PROJECTED", projected), ("FOLLOWED", followed), ("FROZEN_MASS", frozen))
    sizes = (("MASS_TERMS", len(inverse.terms)),) if inverse else ()
    integrands, damping = integrand_kernel(system, "integrand_lanes", arguments), damping_kernel(system)
    return _point_iteration(
        "coupled",
        tables,
        lanes,
        (matrices, None if followed else force, integrands, _solution_kernel(system, inverse) if inverse else None),
        forces=() if followed else ("point_lanes", force.name),
        stored=2 * lanes,
        parts=(
            *(("damped_points",) if damping else ()),
            *("point_weights", "mass_matrix", "corrections", "coupled_iteration"),
        ),
        macros=(*((name, 1) for name, holds in macros if holds), *sizes),
        mass_entries=() if inverse else tuple(forms.lower_mass),
        damping=damping,
        derivatives_part="" if projected or damping or integrands else "coupled_derivatives",
        serves_many=not projected,
    )


def _solution_kernel(system: LagrangianSystem, inverse: InverseMass) -> Kernel:
    """Return the kernel of solutions with the mass matrix from the terms of its inverse."""
    arguments = (*inverse.symbols, *system.momentum_symbols)
    purpose = "L_vv^-1 p at all points, u = (terms of L_vv^-1, p)."
    return system_kernel(system, "solve_lanes", inverse.solution, u=arguments, purpose=purpose)


def _linearised_forces(system: LagrangianSystem) -> tuple[Expr, ...]:
    """Return F_q, F_v and L_vq by rows, for few coordinates with position-dependent masses or momenta; else nothing."""
    forms, m, zero, q = forms_of(system), system.dimension, sympy.Integer(0), system.coordinates
    of_position = any(entry.free_symbols & {*q} for entry in forms.lower_mass.values())
    if m > (MOST_LINEARISED if of_position else MOST_COUPLED):
        return ()
    momenta = jacobian(forms.momentum, q)
    if not of_position and (not momenta or all(F.is_polynomial(*q) for F in forms.force)):
        return ()  # polynomials cost less than the linearised equations
    matrices = jacobian(forms.force, q), jacobian(forms.force, system.velocities), momenta
    return tuple(matrix.get((i, j), zero) for matrix in matrices for i in range(m) for j in range(m))


def weighted_tables(tables: VelocityTables) -> tuple[Matrix, Vector, Matrix, Vector]:
    """Return position table and weights, momentum table and weights, whose products are the method's own tables.

    Of a variational method ``mu[n][b] = position[n][b] / beta_b``, rounded to multiples of 2^-51 (in two words 2^-102),
    and its adjoint ``1 - mu[n][b]``, transposed, which is exact then: ``beta_b momentum[b][n] = w_n (beta_b -
    position[n][b])`` holds of the rounded tables, too. With a projection the momentum table is not that of mu and is
    only divided by its weights. Other methods have weights 1.
    """
    beta, weights = tables.end_position, tables.end_momentum
    if not tables.variational:
        ones = (mp.one,) * len(beta)
        return tables.position, ones, tables.momentum, ones
    unit = mp.ldexp(1, (float_info.mant_dig - 2) * words_of_tables())
    mu = tuple(tuple(mp.nint(x * unit) / unit for x in over(line, beta)) for line in tables.position)
    if tables.projection:
        return mu, beta, tuple(over(line, weights) for line in tables.momentum), weights
    return mu, beta, transpose(tuple(tuple(1 - x for x in line) for line in mu)), weights


def over(numbers: Vector, divisors: Vector) -> Vector:
    """Return quotients, entry by entry."""
    return tuple(x / y for x, y in zip(numbers, divisors, strict=True))
