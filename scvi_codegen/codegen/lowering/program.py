"""Lowering of a symbolic system and a method to a program: kernels, tables and loops (:mod:`scvi_codegen.codegen.ir`).

Fixed-point solvers (``FIXED_POINTS``) iterate on kernels at points that are the lanes of one vector, without a Newton
matrix: on positions, on velocities, or on momenta and velocities
(:mod:`~scvi_codegen.codegen.lowering.solvers.points`); on accelerations, or on accelerations and multipliers
(:mod:`~scvi_codegen.codegen.lowering.solvers.curves`).
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import sympy

from scvi_codegen.codegen.ir.equations import NO_RATTLE, FixedPointIteration, Splitting
from scvi_codegen.codegen.ir.kernel import Kernel, lower_matrix, lower_vector
from scvi_codegen.codegen.ir.program import (
    FEW_UNKNOWNS,
    ArrayProgram,
    Integrals,
    Layout,
    MassGrowth,
    MomentumMap,
    Program,
    Quantities,
    StageCurve,
    StageEquations,
)
from scvi_codegen.codegen.ir.variants import BY_STEPS, Sums
from scvi_codegen.codegen.lowering.arrays import UNSUPPORTED, check_solver_of_arrays, one_coordinate
from scvi_codegen.codegen.lowering.constraints import constrained_steps, lowered_constraints, rattle_of
from scvi_codegen.codegen.lowering.loops import rolled_terms
from scvi_codegen.codegen.lowering.solvers.curves import curve_iteration
from scvi_codegen.codegen.lowering.solvers.points import coupled_iteration, hamiltonian_iteration, separable_iteration
from scvi_codegen.codegen.lowering.solvers.tables import (
    Solver,
    StepProblem,
    resolved_degree,
    shift_tables,
    velocity_tables,
)
from scvi_codegen.codegen.lowering.stage_groups import (
    bandwidth,
    bandwidth_ordering,
    comment_text,
    damping_kernel,
    has_action,
    integrand_kernel,
    layout_of,
    lowered_stage_group,
    system_kernel,
)
from scvi_codegen.common.errors import MethodError, SizesRequiredError
from scvi_codegen.common.precision import Matrix, Vector, mp
from scvi_codegen.methods.constraints import END_VELOCITY
from scvi_codegen.methods.discretise import discretise, is_conformally_symplectic, is_symplectic
from scvi_codegen.methods.method import Method
from scvi_codegen.methods.stage_system import Accelerations, PrintedCurve, ShotCurve, StageSystem, Velocities
from scvi_codegen.methods.tables.basis import cardinal_values, legendre_functional
from scvi_codegen.systems.arrays.system import ArraySystem
from scvi_codegen.systems.derived_expressions import forms_of
from scvi_codegen.systems.first_order import FirstOrderSystem
from scvi_codegen.systems.formulas.expressions import gradient_tuple
from scvi_codegen.systems.formulas.indices import Array
from scvi_codegen.systems.formulas.symbols import symbol
from scvi_codegen.systems.lagrangian import LagrangianSystem
from scvi_codegen.systems.splittings.kinetic import kinetic_splitting
from scvi_codegen.systems.symmetry.symmetry import Symmetry, work_rates
from scvi_codegen.systems.system import MechanicalSystem

FIXED_POINTS: tuple[Solver, ...] = (
    separable_iteration,  # constant masses
    hamiltonian_iteration,
    coupled_iteration,  # velocities of any Lagrangian
    curve_iteration,  # accelerations
)
"""Fixed-point solvers, the fastest first; the first that is applicable is used."""


def iteration_of(
    system: MechanicalSystem, stages: StageSystem, *, velocities: bool = False
) -> FixedPointIteration | None:
    """Return the fixed-point iteration of the stage equations of a system, or ``None`` if there is none.

    With ``velocities`` it has a table of those at the points, on which forces depend.
    """
    if system.constraints or forms_of(system).one_form:
        return None
    problem = StepProblem(system, stages.shape)
    if velocities:
        return separable_iteration(problem, velocities=True)
    return next((fixed_point for solver in FIXED_POINTS if (fixed_point := solver(problem)) is not None), None)


def check_solver(
    solver: str, method: Method, names: Sequence[str], *, iteration: FixedPointIteration | Splitting | None
) -> None:
    """Raise :class:`MethodError` for an unknown solver, or one that this method and system do not have."""
    if solver not in names:
        raise MethodError(f"unknown solver {solver!r}: use one of {', '.join(names)}")
    if solver == "explicit" and iteration is None:
        raise MethodError(f"{method.name} is not explicit for this system: use solver='auto'")
    if solver == "fixed-point" and iteration is None:
        raise MethodError(
            f"{method.name} has no fixed-point iteration for this system: use solver='auto' or 'newton', "
            "or at most 32 points (an SVI: at least as many as its degree; a variational SCVI: at most 8 coordinates)"
        )


def splitting_of(system: MechanicalSystem, method: Method) -> Splitting | None:
    """Return the sequence of kicks and drifts, or ``None`` if the method is implicit."""
    if system.constraints or isinstance(split := kinetic_splitting(system), str):
        return None
    step = method.explicit_step(split)
    if step is None:
        return None
    moved = split.system
    turned = any(not axes.is_diagonal() for axes in split.axes)
    turning = system_kernel(moved, "turning", sum(split.rates, ()), u=(), purpose="a_i, a_j - a_i, a_k - a_i.")
    if split.velocity:
        drift = system_kernel(moved, "drift_velocity", split.velocity, u=moved.auxiliaries, purpose="H_p at u = p.")
    else:
        drift = system_kernel(moved, "mass", forms_of(moved).mass.values(), u=(), purpose="The constant masses.")
    return Splitting(
        statements=step.statements,
        tables=tuple(
            (rows, tuple((name, lower_vector(numbers)) for name, numbers in named)) for rows, named in step.tables
        ),
        force=system_kernel(moved, "force", split.force, u=moved.coordinates, purpose="L_q at u = q."),
        drift=drift,
        by_masses=not split.velocity,
        bodies=tuple((first, *axes) for first, _, *axes in split.bodies),
        turning=turning if split.bodies else None,
        principal=lower_matrix(tuple(tuple(map(mp.mpf, map(str, axes))) for axes in split.axes if turned)),
        leaps=bool(method.fractions),
        driven=bool(system.inputs),
    )


def step_texts(system: MechanicalSystem, method: Method) -> Mapping[str, str]:
    """Return the statements from which the C of a step is generated, by their titles; none of other steps."""
    from scvi_codegen.codegen.statements.steps import bath_texts, rattle_texts, splitting_texts

    bath = bath_texts(bool(system.bath.noise)) if system.bath else {}
    if not system.constraints:
        splitting = splitting_of(system, method)
        return (splitting_texts(splitting) if splitting else {}) | bath
    stages = discretise(system, method)
    extrapolation = _equations(system, method, stages, newton=False, curve=False).extrapolation
    rattle = rattle_of(system, stages, extrapolation)
    return (rattle_texts(rattle) if rattle else {}) | bath


def summing_splitting(splitting: Splitting, system: MechanicalSystem) -> Splitting | None:
    """Return a splitting with the kernel of L at rest, whose sum with the kinetic energies is the action of a run.

    ``None`` for rotations, whose splitting is of H.
    """
    split = kinetic_splitting(system)
    assert not isinstance(split, str)  # since there is a splitting
    moved = split.system
    if not isinstance(moved, LagrangianSystem):
        return None
    value = moved.lagrangian.xreplace(dict.fromkeys(moved.velocities, sympy.S.Zero))
    kernel = system_kernel(moved, "at_rest", (value,), u=moved.coordinates, purpose="L at v = 0, u = q.")
    return replace(splitting, at_rest=kernel)


SOLVERS = ("auto", "explicit", "fixed-point", "newton", BY_STEPS)


def lower(
    system: MechanicalSystem,
    method: Method,
    *,
    prefix: str,
    solver: str = "auto",
    symmetries: Sequence[Symmetry] = (),
    lanes: bool = True,
    fallback: bool = True,
) -> Program:
    """Return the program of one step of ``method`` for ``system``; exported C names begin with ``prefix``.

    Args:
        system, method: the system of named coordinates, and the method.
        prefix: a C identifier.
        solver: as in :func:`~scvi_codegen.compile_stepper`.
        symmetries: whose momentum maps are included.
        lanes: allow a solver that uses SIMD lanes.
        fallback: include Newton's iteration as a fallback. Systems with integrals along the curve always include it.
    """
    stages, explicit = discretise(system, method), solver in ("auto", "explicit")
    splitting = splitting_of(system, method) if explicit and not system.integrands else None
    iterated = lanes and solver in ("auto", "fixed-point") and splitting is None
    fixed_point = iteration_of(system, stages) if iterated else None
    check_solver(solver, method, SOLVERS, iteration=splitting if solver == "explicit" else fixed_point)
    alone = fixed_point is not None and not fallback and not system.integrands
    newton = solver in ("auto", "newton", BY_STEPS) and splitting is None and not alone
    by_steps = solver == BY_STEPS  # without the stage equations
    in_lanes = bool(fixed_point and "MASS_TERMS" in fixed_point.facts) and not newton and not system.bath
    polynomial = method.exactness.curve != 0
    equations = _equations(
        system, method, stages, newton=newton and not by_steps, curve=newton and polynomial, coupled=by_steps
    )
    return Program(
        **_heading(system, method, stages, prefix, geometry=_geometry(method, system)),
        layout=Layout(
            coordinates=tuple(Array(q.name, ()) for q in system.coordinates),
            inputs=tuple((name, system.parameters.index(symbol(f"{name}_0"))) for name in system.inputs),
            whole=(
                *_ranges_of((array.elements for array in system.arrays if array.axes), system),
                *_ranges_of((rotation.coordinates for rotation in system.rotations), system),
            ),
            coupled=tuple(_ranges_of((array.elements for array in system.arrays if array.is_field), system)),
            **_numbers_of(system),
        ),
        fixed_point=fixed_point,
        splitting=splitting,
        newton=newton,
        polynomial_curves=polynomial,
        equations=equations,
        quantities=_quantities(system, method, stages, symmetries, in_lanes=in_lanes),
        constraints=lowered_constraints(system, stages),
        rattle=rattle_of(system, stages, equations.extrapolation) if solver == "auto" else NO_RATTLE,
        damping=damping_kernel(system),
        mass_growth=_mass_growth(system, stages),
        has_unseen_growth=isinstance(stages.shape, Accelerations | ShotCurve | PrintedCurve)
        and bool(_rates_of_masses(system, forms_of(system))),
    )


def lower_arrays(
    system: ArraySystem, method: Method, *, prefix: str, solver: str = "fixed-point", sums: Sums = "compensated"
) -> ArrayProgram:
    """Return the program of one step of a system of arrays of run-time sizes, with its terms in loops.

    Their masses are constant, so that the tables of a method are the same for every coordinate: those of a system of
    one coordinate serve all. Arguments and errors are those of :func:`lower`.
    """
    if system.momenta and (method.drifts_first or not method.implicit):  # with known sizes H is T(p) + V(q, t)
        raise SizesRequiredError(method.name + UNSUPPORTED)
    of_tables = one_coordinate(system)
    stages, velocities = discretise(of_tables, method), bool(system.velocities)
    constrained = constrained_steps(system, stages, method)
    splitting = splitting_of(of_tables, method) if method.fractions and not constrained else None
    if sums == "plain" and splitting is None:
        raise MethodError(
            f"sums='plain' is not available for {method.name} with '{system.name}': its steps are not explicit. Leave "
            "out sums=, or use 'stoermer-verlet' or a composition without constraints"
        )
    iterated = constrained is None and splitting is None
    fixed_point = iteration_of(of_tables, stages, velocities=velocities) if iterated else None
    if fixed_point:
        fixed_point = replace(fixed_point, constant_mass=None)  # each coordinate has its own
    loops = rolled_terms(system, constrained, newton=solver == "newton", explicit=not iterated)
    if loops.products and fixed_point and fixed_point.matrix:
        loops = replace(loops, shifts=shift_tables(fixed_point.matrix, fixed_point.lanes))
    check_solver_of_arrays(system, method, solver, splitting or constrained or fixed_point, loops)
    arrays = ("coordinates", "momenta", "velocities", "sums", "fields", "tables", "sizes")
    geometry = "not symplectic" if system.applied_forces else _geometry(method, of_tables)
    return ArrayProgram(
        **_heading(system, method, stages, prefix, geometry=geometry),
        layout=Layout(**{kind: getattr(system, kind) for kind in arrays}, **_numbers_of(system)),
        fixed_point=fixed_point,
        splitting=splitting,
        increments=sums,
        loops=loops,
        polynomial_curves=bool(fixed_point and (fixed_point.points > 1 or not velocities) and not system.bath),
    )


def _heading(
    system: MechanicalSystem, method: Method, stages: StageSystem, prefix: str, *, geometry: str
) -> dict[str, Any]:
    """Return the names of a program, and what is known of its method, also for the header's comment."""
    order = "no order claimed" if method.order is None else f"order {method.order}"
    return {
        "prefix": prefix,
        "title": comment_text(f"{system.name}: {method.title}"),
        "notes": (order, geometry, "symmetric" if method.symmetric else "not symmetric"),
        "order": method.order or len(stages.blocks),
    }


def _geometry(method: Method, system: MechanicalSystem) -> str:
    """Return which structure steps preserve."""
    if is_symplectic(method, system):
        return "symplectic"
    return "conformally symplectic" if is_conformally_symplectic(method, system) else "not symplectic"


def _numbers_of(system: MechanicalSystem) -> dict[str, Any]:
    """Return names and default values of the parameters that are numbers."""
    return {"parameters": tuple(parameter.name for parameter in system.parameters), "defaults": system.defaults}


def _ranges_of(groups: Iterable[Sequence[str]], system: MechanicalSystem) -> Iterator[tuple[int, int]]:
    """Yield first and end of the coordinates of each group: an array of known size, a quaternion, a direction."""
    names = [q.name for q in system.coordinates]
    for elements in groups:
        first = names.index(elements[0]) if elements[0] in names else len(names)
        if names[first : first + len(elements)] == [*elements]:
            yield first, first + len(elements)


def _equations(
    system: MechanicalSystem, method: Method, stages: StageSystem, *, newton: bool, curve: bool, coupled: bool = False
) -> StageEquations:
    """Return the stage equations; ``newton``: with the stage groups, ``curve``: with the error estimate.

    ``coupled``: in an order of the unknowns in which all are coupled with each other.
    """
    m, sites = system.dimension, layout_of(stages, system.dimension)
    blocks, rows = [stages.blocks[b] for b in sites.columns[None]], [stages.rows[r] for r in sites.rows[None]]
    stage_groups = tuple(lowered_stage_group(system, group, sites) for group in stages.stage_groups) if newton else ()
    pairs = (pair for group in stage_groups for block in group.blocks for pair in block.entries)
    all_pairs = product(range(sites.count), repeat=2) if coupled else ()
    entries = [*forms_of(system).legendre_jacobian, *pairs, *all_pairs]  # with a nonzero derivative
    order = bandwidth_ordering(entries, sites.count)
    return StageEquations(
        sites=sites.count,
        blocks=len(blocks),
        stage_groups=stage_groups,
        places=order,
        mass_positions=tuple(sorted(range(m), key=order.__getitem__).index(i) for i in range(m)),
        bandwidth=bandwidth(entries, order),
        momentum_rows=lower_vector(tuple(row.momentum for row in rows)),
        end_position=lower_vector(stages.end_position.columns([b + 1 for b in sites.columns[None]]).entries[0]),
        straight=tuple(int(block.straight[1]) for block in blocks),
        momentum_blocks=tuple(block.momentum for block in blocks),
        moving_blocks=tuple(int(block.moves) for block in blocks),
        extrapolation=lower_matrix(
            tuple(line for columns in sites.columns.values() for line in _required_extrapolation(stages, columns))
        ),
        acts=sites.count == m
        and not forms_of(system).one_form
        and has_action(system)
        and any(group.in_action for group in stages.stage_groups),
        stage_curve=_stage_curve(stages) if curve else None,
        numbers=_numbers(system, method, len(rows)) if len(blocks) * sites.count <= FEW_UNKNOWNS else ("", "", ""),
    )


def _quantities(
    system: MechanicalSystem, method: Method, stages: StageSystem, symmetries: Sequence[Symmetry], *, in_lanes: bool
) -> Quantities:
    """Return the functions of the state that a run evaluates or integrates.

    ``in_lanes``: momenta and velocities are by kernels of the iteration.
    """
    forms, integrates = forms_of(system), any(group.in_action for group in stages.stage_groups)
    name, purpose, formula = "lagrangian", "L at u = (q, v).", system.formula
    legendre = f"Momenta L_v {'' if forms.inverse_mass else 'and mass matrix L_vv '}at u = (q, v)."
    if in_lanes:
        name, purpose = "lagrangian_at_rest", "L at v = 0."
        formula = formula.xreplace(dict.fromkeys(system.velocities, sympy.S.Zero))
    if system.auxiliaries:
        name, purpose, legendre = "hamiltonian", "H at u = (q, p).", "H_p and H_pp at u = (q, p)."
    if forms.one_form:
        legendre = "Momenta theta and their derivatives by y at u = (q, y)."
    return Quantities(
        legendre=None
        if in_lanes
        else system_kernel(
            system,
            "legendre",
            forms.regular_legendre,
            u=forms.legendre_arguments,
            partials=forms.legendre_jacobian.values(),
            purpose=legendre,
        ),
        inverse_legendre=None if in_lanes else _inverse_legendre_kernel(system),
        mass_entries=tuple(forms.legendre_jacobian),
        energy=system_kernel(system, name, (formula,), u=forms.legendre_arguments, purpose=purpose),
        hamiltonian=bool(system.auxiliaries),
        momentum_maps=tuple(_momentum_map(symmetry, method) for symmetry in symmetries),
        momentum_kernel=_momentum_kernel(system, symmetries),
        first_order_rates=_rates_of_first_order(system),
        integrals=_integrals(system, method, stages),
        work_and_impulses=tuple(rate.name for rate in work_rates(system)) if integrates else (),
        integrates=integrates,
    )


def _momentum_map(symmetry: Symmetry, method: Method) -> MomentumMap:
    name, formula = comment_text(symmetry.name), comment_text(symmetry.formula)
    return MomentumMap(name=name, formula=formula, exact=method.exactness.conserves(symmetry))


def _numbers(system: MechanicalSystem, method: Method, count: int) -> tuple[str, str, str]:
    """Return the paper's equation numbers of the last ``count`` rows, of q1 and of p1."""
    paper = method.paper_form(system)
    numbers = dict.fromkeys(row.number for row in paper.rows[-count:] if row.number[:1].isdigit())
    rows = ", ".join(f"({number})" for number in numbers)
    q1, p1 = (f"({number})" if number[:1].isdigit() else "" for number in paper.end_numbers)
    return rows, q1, p1


def _stage_curve(stages: StageSystem) -> StageCurve | None:
    """Return the error estimate for unknowns that are velocities along a curve, or a first velocity and accelerations.

    With constraints, the velocity at the end is determined separately, with the accuracy of the step. Its difference
    from that of the curve is the first Legendre coefficient that the curve does not have: a better estimate than the
    last one that it has, and also available for one velocity.
    """
    shape, count = stages.shape, len([block for block in stages.blocks if block.size is None])
    has_end_velocity = any((block.letter, block.index) == END_VELOCITY for block in stages.blocks)
    if isinstance(shape, Velocities) and _moves(stages, shape):
        tables, last = velocity_tables(shape), len(shape.blocks) - 1 + has_end_velocity
        degree = last if has_end_velocity or tables is None else resolved_degree(tables)
        if degree == 0:
            return None
        first, tops = 0, _highest_of(shape, None if has_end_velocity else degree)
        differences = [(0, last), (0, (last + 1) // 2)]
        rows = [tuple(mp.mpf((b == last) - (b == first)) for b in range(count)) for first, last in differences]
        power = 2 * degree - (degree > 1)
    elif isinstance(shape, Accelerations | ShotCurve | PrintedCurve):
        c, size = shape.tableau.c, len(shape.tableau.c)
        if len({*c}) < size:
            return None
        first, tops = 1, [legendre_functional(c, k) for k in (size - 1, size - 2)]
        rows = [tuple(mp.mpf(b == only) for b in range(count)) for only in (1, size)]
        power = 2 * size - (size > 2)
    else:
        return None
    before, behind = (mp.zero,) * first, (mp.zero,) * (count - first - len(tops[0]))
    highest, below = (lower_vector((*before, *top, *behind)) for top in tops)
    return StageCurve(
        highest=highest, next=below, curvatures=(lower_vector(rows[0]), lower_vector(rows[1])), power=power
    )


def _rates_of_masses(system: MechanicalSystem, forms: Any) -> list[Any]:
    """Return the rates at which masses grow, none if all are 0.

    Rates gamma + d log M_ii/dt of a Lagrangian, gamma - d log H_pp,ii/dt of a Hamiltonian; of an entry M_ii = 0 gamma.
    """
    masses = forms.legendre_jacobian or forms.mass
    diagonal = {i: entry for (i, j), entry in masses.items() if i == j} if system.depends_on_time else {}
    sign = -1 if system.auxiliaries else 1
    rates = [system.damping] * system.dimension
    for i, entry in diagonal.items():
        for derivative in gradient_tuple(entry, (system.time,)):
            rates[i] += sign * derivative / entry
    return rates if any(rates) else []


def _mass_growth(system: MechanicalSystem, stages: StageSystem) -> MassGrowth | None:
    """Return the rates at which masses grow in steps whose unknowns are velocities; ``None`` if all are 0.

    The error of a step is the larger one of its curves of velocities and of momenta. Steps of accelerations a have that
    of a alone, which is 0 at a terminal velocity v while momenta grow: the curve e^(r t) (a + r v) is not among what
    they store.
    """
    shape, forms = stages.shape, forms_of(system)
    if not (isinstance(shape, Velocities) and _moves(stages, shape)) or forms.one_form:
        return None
    if not (rates := _rates_of_masses(system, forms)):
        return None
    has_end_velocity = any((block.letter, block.index) == END_VELOCITY for block in stages.blocks)
    u, purpose = forms.legendre_arguments, "Rates of masses and damping, gamma + d log M_ii/dt."
    return MassGrowth(
        kernel=system_kernel(system, "mass_growth", rates, u=u, purpose=purpose),
        abscissae=lower_vector((*shape.blocks, *((mp.one,) if has_end_velocity else ()))),
    )


def _highest_of(shape: Velocities, degree: int | None) -> list[Vector]:
    """Return the weights of the leading coefficient of the accelerations, and of the next lower one."""
    if degree is None:
        line = (*(-x for x in cardinal_values(shape.blocks, (mp.one,))[0]), mp.one)
        return [tuple((4 * len(shape.blocks) - 2) * x for x in line), (mp.zero,) * len(line)]
    lines = {k: legendre_functional(shape.blocks, k) for k in (degree, degree - 1)}
    return [tuple(max(4 * k - 2, 0) * x for x in line) for k, line in lines.items()]


def _moves(stages: StageSystem, shape: Velocities) -> bool:
    """Return whether the velocities, the first blocks, are the only unknowns that displace positions."""
    degree = len(shape.blocks)
    return degree == len({*shape.blocks}) and all(block.moves == (b < degree) for b, block in enumerate(stages.blocks))


def _integrals(system: MechanicalSystem, method: Method, stages: StageSystem) -> Integrals | None:
    kernel = integrand_kernel(system, "integrands", stages.stage_groups[0].arguments)
    if kernel is None:
        return None
    if not isinstance(stages.shape, Velocities):
        raise MethodError(
            f"{method.name} does not support the time transformation of '{system.name}': use "
            "an SVI, or a Runge-Kutta method in phase space"
        )
    return Integrals(kernel=kernel, weights=lower_vector(stages.shape.weights))


def _inverse_legendre_kernel(system: MechanicalSystem) -> Kernel | None:
    """Return the kernel of the velocities at (q, p), ``None`` if they have no formula."""
    inverse, arguments = forms_of(system).inverse_mass, (*system.coordinates, *system.momentum_symbols)
    if inverse is None:
        return None
    return system_kernel(
        system, "inverse_legendre", inverse.velocities, u=arguments, purpose="L_vv^-1 p at u = (q, p)."
    )


def _rates_of_first_order(system: MechanicalSystem) -> Kernel | None:
    """Return the kernel of the right-hand side of the velocities of a first-order system, ``None`` for others."""
    if not isinstance(system, FirstOrderSystem) or system.is_canonical:
        return None
    right = gradient_tuple(system.hamiltonian, system.momenta)
    arguments = forms_of(system).legendre_arguments
    return system_kernel(system, "first_order_rates", right, u=arguments, purpose="H_y = theta_y^T q' at u = (q, y).")


def _momentum_kernel(system: MechanicalSystem, symmetries: Sequence[Symmetry]) -> Kernel | None:
    """Return the kernel of the momentum maps, then of the sums of the squares of their terms."""
    if not symmetries:
        return None
    maps = [symmetry.momentum_map for symmetry in symmetries]
    squares = [sympy.Add(*(term**2 for term in sympy.Add.make_args(J))) for J in maps]
    return system_kernel(
        system,
        "momentum_maps",
        (*maps, *squares),
        u=(*symmetries[0].coordinates, *symmetries[0].momenta),
        purpose="Momentum maps at u = (q, p), then the sums of the squares of their terms.",
    )


def _required_extrapolation(stages: StageSystem, columns: Sequence[int]) -> Matrix:
    """Return the extrapolation table of a group of blocks, transposed."""
    if stages.extrapolation is None or any(block.power != 1 for block in stages.blocks):
        raise TypeError("only stage systems with velocities as unknowns can be lowered")
    return tuple(tuple(stages.extrapolation[i][j] for i in columns) for j in columns)
