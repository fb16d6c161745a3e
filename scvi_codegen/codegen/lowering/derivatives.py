"""Derivatives of a step with respect to all inputs, as kernels: of the stage equations, and at the points.

The derivatives of the stage equations with respect to parameters and time, and their second derivatives, serve Newton's
factors; those of forces and momenta at the points serve tangent vectors by fixed-point iteration.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

from sympy import Add, Expr, Mul, S, Symbol

from scvi_codegen.codegen.ir.derivatives import Derivatives, InputDerivatives, PointDerivatives, TimeDerivatives
from scvi_codegen.codegen.ir.equations import FixedPointIteration
from scvi_codegen.codegen.ir.kernel import Kernel, lower_matrix
from scvi_codegen.codegen.ir.program import Program
from scvi_codegen.codegen.lowering.stage_groups import system_kernel
from scvi_codegen.common.precision import mp
from scvi_codegen.methods.stage_system import StageGroup, StageSystem, Velocities
from scvi_codegen.systems.derived_expressions import Entries, forms_of
from scvi_codegen.systems.formulas.expressions import gradient, gradient_tuple, jacobian, node_derivative
from scvi_codegen.systems.formulas.intermediates import Intermediate, intermediate
from scvi_codegen.systems.lagrangian import LagrangianSystem
from scvi_codegen.systems.legendre.transform import equivalent_lagrangian
from scvi_codegen.systems.system import MechanicalSystem


def derivatives_of(
    system: MechanicalSystem, stages: StageSystem, program: Program, *, second: bool = False
) -> Derivatives:
    """Return the derivatives of ``program``, of the equations ``stages``, by all inputs; ``second``: also second."""
    program = replace(program, summed=not forms_of(system).one_form)
    inputs = tuple(
        _input_derivatives(system, group.name, group.results, group.arguments) for group in stages.stage_groups
    )
    return Derivatives(
        program=program,
        by_inputs=inputs,
        curvatures=tuple(_curvature(system, group) for group in stages.stage_groups) if second else (),
        damping=_input_derivatives(system, "damping", (stages.damping,), ()) if program.damping else None,
        clock=_time_derivatives(system, stages.stage_groups[0].arguments) if system.clock else None,
        momenta=_momentum_derivatives(system) if program.quantities.first_order_rates else None,
        iterated=_iterated(system, stages, program.fixed_point) if program.fixed_point else None,
    )


def _input_derivatives(
    system: MechanicalSystem, name: str, results: Sequence[Expr], arguments: Sequence[Symbol]
) -> InputDerivatives:
    entries = jacobian(results, (*system.parameters, system.time))
    if not entries:
        return InputDerivatives(entries=(), kernel=None)
    kernel = system_kernel(
        system,
        f"{name}_by_inputs",
        entries.values(),
        u=arguments,
        purpose="Nonzero derivatives with respect to parameters and time.",
    )
    return InputDerivatives(entries=tuple(entries), kernel=kernel)


def _momentum_derivatives(system: MechanicalSystem) -> InputDerivatives:
    """Return the derivatives of the momenta theta of a first-order system."""
    forms = forms_of(system)
    entries = jacobian(forms.one_form, (*forms.legendre_arguments, *system.parameters, system.time))
    purpose = "Nonzero derivatives of the momenta with respect to q, y, parameters and time."
    kernel = system_kernel(
        system, "momentum_derivatives", entries.values(), u=forms.legendre_arguments, purpose=purpose
    )
    return InputDerivatives(entries=tuple(entries), kernel=kernel)


def _time_derivatives(system: MechanicalSystem, arguments: Sequence[Symbol]) -> TimeDerivatives:
    assert system.clock is not None
    rate = system.clock.rate
    partials = gradient(rate, (*arguments, *system.parameters))
    return TimeDerivatives(
        entries=tuple(partials),
        kernel=system_kernel(
            system,
            "rate_derivatives",
            (rate,),
            u=arguments,
            partials=partials.values(),
            purpose="The rate of time and its nonzero derivatives with respect to arguments and parameters.",
        ),
        level=_energy_derivatives(system),
    )


def _energy_derivatives(system: MechanicalSystem) -> Kernel:
    """Return the kernel of the gradient of the energy E of a state: since K = rate (H - E) = 0, dE = dK / rate."""
    assert system.clock is not None
    m, energy = system.dimension, system.clock.energy
    sign = 1 if system.auxiliaries else -1
    by_others = [sign * x for x in gradient_tuple(system.formula, (*system.coordinates, *system.parameters))]
    by_others[m + system.parameters.index(energy)] = S.Zero
    by_p = forms_of(system).legendre if system.auxiliaries else system.velocities
    return system_kernel(
        system,
        "energy_derivatives",
        [derivative / system.clock.rate for derivative in (*by_others[:m], *by_p, *by_others[m:])],
        u=forms_of(system).legendre_arguments,
        purpose="Gradient of the energy with respect to q, p and parameters at "
        f"u = (q, {'p' if system.auxiliaries else 'v'}).",
    )


def _curvature(system: MechanicalSystem, group: StageGroup) -> Kernel | None:
    """Return the kernel of the Hessian of ``mu . phi(y)`` times dy, phi the results; ``None`` if phi is linear.

    It is the gradient of a scalar, ``sum_k dy_k d2(mu . phi) / dy_j dy_k = d/dy_j (sum_ik mu_i dphi_i/dy_k dy_k)``,
    y being the arguments, the parameters and time, and mu and dy the symbols ``multiplier`` and ``change``.
    """
    depends = (*group.arguments, *system.parameters, system.time)
    multipliers = [Symbol(f"multiplier[{i}]", real=True) for i in range(len(group.results))]
    changes = [Symbol(f"change[{j}]", real=True) for j in range(len(depends))]
    entries = jacobian(group.results, depends)
    along = Add(*(Mul(multipliers[i], entry, changes[j]) for (i, j), entry in entries.items()))
    partials = gradient_tuple(along, depends)
    if not any(partials):
        return None
    return system_kernel(
        system,
        f"{group.name}_curvature",
        partials,
        u=(*group.arguments, *multipliers, *changes),
        purpose="Hessian-vector product of multipliers . results with a variation of all arguments.",
    )


MOST_DERIVATIVES = 4096
"""Largest number of derivatives at a point; those of all points are on the stack, a quarter of a megabyte."""
NOTHING: Entries = {(0, 0): S.Zero}
"""Replacement for an empty set of entries: C has no empty arrays."""


def point_derivatives_of(system: MechanicalSystem, fixed_point: FixedPointIteration) -> PointDerivatives | None:
    """Return the kernels for a system whose steps are solved by the iteration; ``None`` if unsupported or too large."""
    twin, make = equivalent_lagrangian(system), MAKERS.get(fixed_point.derivatives_part)
    iteration = make(twin) if twin and make else None
    return iteration if iteration and iteration.count + len(iteration.by_inputs.entries) <= MOST_DERIVATIVES else None


def correction_of(system: MechanicalSystem, fixed_point: FixedPointIteration) -> PointDerivatives | None:
    """Return the kernels that correct a step in double to two words; ``None`` if unsupported or too large.

    Supported are constant masses with forces of position and time, and any Lagrangian whose unknowns are the velocities
    at the points.
    """
    twin, kernels = equivalent_lagrangian(system), fixed_point.kernels
    if system.damping != 0 or twin is None:
        return None
    if fixed_point.name == "coupled" and not dict(fixed_point.macros).get("PROJECTED"):
        fixed_point = replace(fixed_point, derivatives_part="coupled_derivatives")
        forms, arguments = forms_of(twin), (*twin.coordinates, *twin.velocities)
        values, purpose = (*forms.force, *forms.momentum), "L_q, L_v at all points."
        integrands = (kernel for kernel in kernels if kernel.name == "integrand_lanes")
        kernels = system_kernel(twin, "value_lanes", values, u=arguments, purpose=purpose), *integrands
    elif fixed_point.name != "separable":
        return None
    derivatives = point_derivatives_of(system, fixed_point)
    return replace(derivatives, in_pairs=kernels) if derivatives else None


def _iterated(
    system: MechanicalSystem, stages: StageSystem, fixed_point: FixedPointIteration
) -> PointDerivatives | None:
    """Return the kernels of the iteration, with the table from its points to the unknowns of the stage equations.

    Values at the points are ``G z``, z being the unknowns: displacements divided by h with G = ``position``, or
    velocities with G = ``velocity``. The table is the left inverse ``(G^T G)^-1 G^T``.
    """
    iteration, shape = point_derivatives_of(system, fixed_point), stages.shape
    if iteration is None or not isinstance(shape, Velocities) or len(stages.blocks) != len(shape.end):
        return iteration
    separable = fixed_point.derivatives_part == "separable_derivatives"
    G = mp.matrix([list(line) for line in (shape.position if separable else shape.velocity)])
    try:
        inverse = mp.inverse(G.T * G) * G.T
    except ZeroDivisionError:
        return iteration
    if G.rows != fixed_point.points or max(map(abs, inverse)) > LARGEST_UNKNOWN:
        return iteration
    return replace(iteration, unknowns=lower_matrix(tuple(map(tuple, inverse.tolist()))))


LARGEST_UNKNOWN = 1e6
"""Largest entry of the table from points to unknowns, by which rounding errors grow."""


def _separable(system: LagrangianSystem) -> PointDerivatives:
    """Return the derivatives of forces at u = q, and those of constant masses with respect to parameters."""
    forms = forms_of(system)
    masses = jacobian(tuple(forms.mass.values()), system.parameters)
    purpose = "Derivatives of the constant masses with respect to parameters."
    kernel = system_kernel(system, "mass_by_inputs", masses.values(), u=(), purpose=purpose)
    partials, products = force_derivatives(system)
    return PointDerivatives(
        partials=partials,
        beside=0,
        products=products,
        by_inputs=_at_points_by_inputs(system, forms.force, system.coordinates),
        masses=InputDerivatives(entries=tuple(masses), kernel=kernel) if masses else None,
    )


def force_derivatives(system: LagrangianSystem) -> tuple[Kernel, tuple[Kernel, Kernel]]:
    """Return the kernel of the distinct derivatives of forces at u = q, and those of their products with vectors."""
    q = tuple(system.coordinates)
    partials = jacobian(forms_of(system).force, q) or NOTHING
    different = tuple(dict.fromkeys(partials.values()))
    purpose = "The distinct entries of L_qq at all points."
    kernel = system_kernel(system, "point_derivatives", different, u=q, purpose=purpose)
    return kernel, _products(system, partials, different, size=len(q))


def _coupled(system: LagrangianSystem) -> PointDerivatives:
    """Return the derivatives of (L_q, -L_v) at u = (q, v); those of L_v with respect to v, the mass, separately."""
    forms, arguments = forms_of(system), (*system.coordinates, *system.velocities)
    m = system.dimension
    partials = jacobian(forms.force, arguments)
    by_position = jacobian(forms.momentum, system.coordinates)
    partials |= {(m + i, j): Mul(S.NegativeOne, value) for (i, j), value in by_position.items()}
    partials = partials or NOTHING
    different = tuple(dict.fromkeys(partials.values()))
    at_points = system_kernel(
        system,
        "point_derivatives",
        (*forms.momentum, *different),
        u=arguments,
        partials=forms.mass_terms,
        purpose="L_v, the distinct entries of L_qq, L_qv and -L_vq, and terms of L_vv at all points.",
    )
    return PointDerivatives(
        partials=at_points,
        beside=m,
        products=_products(system, partials, different, size=2 * m),
        by_inputs=_at_points_by_inputs(system, (*forms.force, *forms.momentum), arguments),
    )


MAKERS: dict[str, Callable[[LagrangianSystem], PointDerivatives]] = {
    "separable_derivatives": _separable,
    "coupled_derivatives": _coupled,
}


def _at_points_by_inputs(
    system: LagrangianSystem, results: Sequence[Expr], arguments: Sequence[Symbol]
) -> InputDerivatives:
    entries = jacobian(results, (*system.parameters, system.time)) or NOTHING
    purpose = "Their derivatives with respect to parameters and time, at all points."
    kernel = system_kernel(system, "input_derivatives", entries.values(), u=arguments, purpose=purpose)
    return InputDerivatives(entries=tuple(entries), kernel=kernel)


def _products(
    system: LagrangianSystem, partials: Entries, different: tuple[Expr, ...], *, size: int
) -> tuple[Kernel, Kernel]:
    """Return kernels of the matrix of derivatives times x, and of its transpose; the same kernel if they are equal."""
    back = {(j, i): value for (i, j), value in partials.items()}
    purpose = "The matrix of derivatives times x, u = (x, its entries)."
    forward = vector_product(system, "derivative_product", partials, different, shape=(size, size), purpose=purpose)
    if back == partials:
        return forward, forward
    name, purpose = "transposed_product", "Its transpose times x."
    return forward, vector_product(system, name, back, different, shape=(size, size), purpose=purpose)


def vector_product(
    system: LagrangianSystem,
    name: str,
    matrix: Entries,
    different: tuple[Expr, ...],
    *,
    shape: tuple[int, int],
    purpose: str,
) -> Kernel:
    """Return the kernel of a matrix times x at u = (x, ``different``), the distinct entries of the matrix."""
    number = {value: k for k, value in enumerate(different)}
    x = [Symbol(f"x[{i}]", real=True) for i in range(shape[1])]
    values = [Symbol(f"derivative[{k}]", real=True) for k in range(len(different))]
    rows: list[list[Expr]] = [[] for _ in range(shape[0])]
    for (i, j), value in matrix.items():
        rows[i].append(Mul(values[number[value]], x[j]))
    return system_kernel(system, name, [Add(*row) for row in rows], u=(*x, *values), purpose=purpose)


def product_by_operations(
    system: LagrangianSystem,
    results: Sequence[Expr],
    of: Sequence[Symbol],
    *,
    u: Sequence[Symbol],
    partials: Sequence[Expr] = (),
    purpose: str,
) -> tuple[Kernel, Kernel]:
    """Return kernels like those of the matrix of derivatives ``purpose`` and of its product, but by operations.

    The change of each operation is computed from those of its operands (forward mode: Griewank & Walther, Evaluating
    Derivatives, ch. 3): two bodies share that of their force. Derivatives of operations without their constant factors,
    and ``partials``, are numbers of a point ``u``.
    """
    x = [Symbol(f"x[{i}]", real=True) for i in range(len(of))]
    changes: dict[Expr, Expr] = dict(zip(of, x, strict=True))
    values: dict[Expr, Expr] = {}

    def term(factor: Expr, change: Expr) -> Expr:
        constant, rest = factor.as_independent(*u, system.time, as_Add=False)
        number, rest = _number_and_rest(rest)
        value = 1 if rest == 1 else values.setdefault(rest, Symbol(f"derivative[{len(values)}]", real=True))
        return Mul(number, constant, value, change)

    def change_of(node: Expr) -> Expr:
        if node not in changes:
            inner = {k: change_of(argument) for k, argument in enumerate(node.args)}
            passed = isinstance(node, Intermediate)
            terms = [dx if passed else term(node_derivative(node, k), dx) for k, dx in inner.items() if dx != 0]
            number, rest = _number_and_rest(Add(*terms))
            changes[node] = number * intermediate(rest)
        return changes[node]

    along, stored = [change_of(result) for result in results], [*values] or [S.Zero]
    text = f"Derivatives of the operations of {purpose} at all points."
    at_points = system_kernel(system, "point_derivatives", stored, u=u, partials=partials, purpose=text)
    text = f"The matrix of derivatives of {purpose} times x, u = (x, derivatives of operations)."
    return at_points, system_kernel(system, "derivative_product", along, u=(*x, *values.values()), purpose=text)


def _number_and_rest(expression: Expr) -> tuple[Expr, Expr]:
    """Return a rational factor of either sign, and the rest, which is the same for multiples of an expression."""
    number, rest = expression.primitive()
    return (-number, -rest) if rest.could_extract_minus_sign() else (number, rest)
