"""Adaptive step sizes on the grid h = 2^(k/4), and the step density of a time transformation.

The stored values of the last step, or of the last two, are extrapolated into the next by least-squares polynomials
(:mod:`scvi_codegen.codegen.lowering.solvers.tables`); the grid has few ratios of step sizes, each with its own table.
As predictors they need only double precision, by Stieltjes' procedure (Gautschi, *Orthogonal Polynomials*, 2004,
section 2.2), in sums that round the same on all platforms.

Growth of errors along runs: a tangent vector by Picard iterations (``templates/support/step_size/error_growth.h``).

The variational equation dq'' = F_q dq / m of a separable system, or L_vv dq'' = -E_q dq - E_v dq' with the residual
E(q, v, a) of the Euler-Lagrange equations, is integrated over each accepted step by collocation at Gauss points
(Hairer, Norsett & Wanner, Solving ODEs I, sec. II.7 and II.14).
"""

import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from sympy import Expr

from scvi_codegen.codegen.ir.arithmetic import INVERSE_ROOTS
from scvi_codegen.codegen.ir.equations import (
    AdaptivePredictor,
    Control,
    ErrorGrowth,
    FixedPointIteration,
    IterationTable,
    StoredValues,
)
from scvi_codegen.codegen.ir.kernel import Expression, Kernel, Load, Number, NumberTable, Operation
from scvi_codegen.codegen.ir.program import Program
from scvi_codegen.codegen.lowering.derivatives import NOTHING, force_derivatives, product_by_operations, vector_product
from scvi_codegen.codegen.lowering.solvers.tables import DEGREE_OF_ONE, DEGREE_OF_TWO, INTERPOLATED, pad_vector
from scvi_codegen.codegen.lowering.stage_groups import system_kernel
from scvi_codegen.common.precision import Matrix, Vector, mp
from scvi_codegen.methods.controllers import Controller
from scvi_codegen.methods.controllers.controller import PREDICTIVE
from scvi_codegen.methods.tables.basis import (
    cardinal_derivatives,
    cardinal_integrals,
    cardinal_values,
    differentiation_matrix,
    least_squares,
    transpose,
)
from scvi_codegen.methods.tables.quadrature import gauss_legendre
from scvi_codegen.systems.derived_expressions import accelerations, forms_of
from scvi_codegen.systems.formulas.expressions import jacobian
from scvi_codegen.systems.lagrangian import LagrangianSystem
from scvi_codegen.systems.legendre.transform import equivalent_lagrangian
from scvi_codegen.systems.system import MechanicalSystem

LEVELS_PER_BINADE, REACH, REACH_INSIDE = 4, 2, 8
"""Levels per factor of two; largest changes of level for which there are predictors from accepted steps and, downwards,
from a rejected one."""
MANTISSAS = tuple(round(2.0 ** (k / LEVELS_PER_BINADE + 32)) / 2.0**32 for k in range(LEVELS_PER_BINADE))
"""Step sizes in one octave, rounded to 32 bits.

In 53 bits the square of the root of 2 is 2 plus an ulp; the resulting rounding error of a product depends only on the
leading digits, is the same in every orbit, and accumulates: 2e-17 to 7e-17 of the energy per Kepler orbit at e = 0.9.
"""


def control_of(
    program: Program,
    controller: Controller = PREDICTIVE,
    system: MechanicalSystem | None = None,
    g: str | Expr | None = None,
) -> Control | None:
    """Return the step-size control of a program, with ``g`` of steps in tau; ``None`` without error estimates."""
    if controller.values is not None:
        assert system is not None  # by the caller
        assert g is not None
        kernel = system_kernel(
            system,
            "step_density",
            controller.values(system, g),
            u=forms_of(system).legendre_arguments,
            purpose="1/g and -d(log g)/dt of the time rescaling g at u = "
            f"{'(q, p)' if system.auxiliaries else '(q, v)'}.",
        )
        return Control(code=controller.code, memory=controller.memory, density=kernel)
    if not program.error_power or program.quantities.integrals:
        return None
    stage_curve = program.equations.stage_curve
    return Control(
        code=controller.code,
        memory=controller.memory,
        mantissas=MANTISSAS,
        predictor=predictor_of(program.fixed_point) if program.fixed_point else None,
        stage_growth=2.0 ** (stage_curve.power / LEVELS_PER_BINADE) if stage_curve else 0.0,
        arrays=program.layout.whole,
        localised=system is not None and system.has_localised_forces,
        friction=program.newton and system is not None and system.resists_motion,
    )


def predictor_of(fixed_point: FixedPointIteration) -> AdaptivePredictor:
    """Return the predictor tables of a fixed-point iteration."""
    points = _doubles(fixed_point.guess.abscissae)
    ratios = [2.0 ** (change / LEVELS_PER_BINADE) for change in range(-REACH, REACH + 1)]
    degree = min(len(points) - 1, DEGREE_OF_ONE)
    alone = _tables_by_ratio(fixed_point, ratios, points, degree, (1.0,))
    shorter = [2.0 ** (-down / LEVELS_PER_BINADE) for down in range(1, REACH_INSIDE + 1)]
    inside = _tables_by_ratio(fixed_point, shorter, points, len(points) - 1, (1.0,), begin=0.0)
    pairs = []
    for ratio in ratios:
        sources = (*points, *((x - 1.0) / ratio for x in points))
        most = min(len(set(sources)) - 1, max(2 * len(points) - 2, INTERPOLATED), DEGREE_OF_TWO)
        pairs.append(_tables_by_ratio(fixed_point, ratios, sources, most, (1.0, ratio)))
    return AdaptivePredictor(
        reach=REACH,
        alone=tuple(table for (table,) in alone),
        last=tuple(tuple(last for last, _ in line) for line in pairs),
        before=tuple(tuple(before for _, before in line) for line in pairs),
        inside=tuple(table for (table,) in inside),
        growth=2.0 ** (fixed_point.error_power / LEVELS_PER_BINADE),
    )


def _tables_by_ratio(
    fixed_point: FixedPointIteration,
    ratios: Sequence[float],
    sources: Sequence[float],
    degree: int,
    ages: Sequence[float],
    begin: float = 1.0,
) -> list[list[NumberTable]]:
    """Return tables by ratio of the next step size to the last, and by step.

    Args:
        ratios: ratios of the next step size to the last.
        sources: times of the stored values, in units of the last step size.
        degree: of the polynomial.
        ages: last step size by those of the steps.
        begin: of the next step, in units of the last step size.
    """
    points = _doubles(fixed_point.guess.abscissae)
    through = tuple(map(_doubles, fixed_point.predictor_matrix))
    count = len(points)
    targets = [begin + ratio * x for ratio in ratios for x in points]
    rows = least_squares(sources, targets, degree, lambda a, b: math.fsum(map(operator.mul, a, b)))
    tables = []
    for k, ratio in enumerate(ratios):
        scales = [ratio * age if fixed_point.kept is StoredValues.ACCELERATIONS else 1.0 for age in ages]
        part = rows[k * count : (k + 1) * count]
        tables.append(
            [
                _padded(
                    [[scale * x for x in row[n * count : (n + 1) * count]] for row in part], through, fixed_point.lanes
                )
                for n, scale in enumerate(scales)
            ]
        )
    return tables


def _doubles(numbers: Sequence[Number]) -> tuple[float, ...]:
    return tuple(map(float, numbers))


def _padded(rows: list[list[float]], through: NumberTable, lanes: int) -> NumberTable:
    """Return a table, times another one if given, padded to whole vectors; further rows repeat the last."""
    count = len(rows)
    if through:
        columns = list(zip(*rows, strict=True))
        rows = [
            [math.fsum(a * x for a, x in zip(line, column, strict=False)) for column in columns]
            for line in through[:count]
        ]
    wide = [(*row, *(0.0,) * (lanes - count)) for row in rows]
    return (*wide, *(wide[-1],) * (lanes - count))


MOST_OPERATIONS = 1000
"""Largest number of operations at a point of the iteration of a step, up to which its derivatives are derived.

They are compiled with the stepper: 10 to 50 % of its processor time below this number (eight bodies in space have 823,
five hinges 876), but 1.5 times and more of it above (six hinges 1441), and 20 s of derivation for ten hinges (4250).
"""


def part_of_tolerance(points: int) -> float:
    """Return the error of the positions in an adaptive step, in units of its tolerance, of a curve of so many points.

    The estimate that steps are controlled by is that of the curve inside the step, whose end is more accurate the more
    points it has. Nine of ten errors of the steps of eight regular systems are below 3 (2 points), .5, .1 (4), .03, .01
    (8) and .007 (12); the errors of a run that amplifies them are mostly from the largest ones.
    """
    return 3.0 * math.pow(10.0, -points / 4)


def error_growth_of(system: MechanicalSystem, program: Program) -> ErrorGrowth | None:
    """Return kernels and tables; ``None`` for damping, inputs or constraints, and for systems that are too large."""
    fixed_point = program.fixed_point
    if fixed_point is None or program.newton or program.damping:
        return None
    operations = sum(sum(kernel.operation_counts().values()) for kernel in fixed_point.kernels)
    make, points = GROWTH_KERNELS.get(fixed_point.derivatives_part), fixed_point.guess.abscissae
    if make is None or operations > MOST_OPERATIONS:
        return None
    twin = equivalent_lagrangian(system)
    if twin is None or len(set(points)) < len(points) or sum(c > 0 for c in points) < 2:
        return None
    partials, product = make(twin)
    of_velocities = make is _coupled_growth
    return ErrorGrowth(
        partials=_with_common_roots(partials),
        product=product,
        of_velocities=of_velocities,
        part_of_tolerance=part_of_tolerance(len(points)),
        knots=len(points),
        tables=_growth_tables(points, gauss_legendre(len(points)).abscissae, of_velocities=of_velocities),
    )


DIFFERENT = mp.mpf("1e-40")
"""Smallest distance of a knot from a point that is not one of both in working precision."""
COLUMNS = 8
"""Columns of the tables of tangent vectors, one for each knot, are a multiple of this number: whole vectors.

The knots are as many Gauss points as the step has points. Then the map of tangent vectors is the derivative of a step
of the method, and symplectic: along regular orbits products of such maps grow as powers. With half as many knots, with
every second point of the step, or with kicks at its points by Stoermer's method, they grow exponentially.
"""


def _growth_tables(points: Vector, knots: Vector, *, of_velocities: bool) -> tuple[IterationTable, ...]:
    """Return the tables from points to knots of a step, between knots, and to Taylor's coefficients."""
    end, rates = (mp.one,), differentiation_matrix(knots)
    at_end = cardinal_values(knots, end)[0]
    slope = tuple(mp.fdot(at_end, column) for column in transpose(rates))
    bend = tuple(mp.fdot(slope, column) for column in transpose(rates))
    taylor = (
        _twice_integrated(knots, end)[0],
        cardinal_integrals(knots, end, mp.zero)[0],
        *(tuple(x / k for x in row) for k, row in ((2, at_end), (6, slope), (24, bend))),
    )
    stored = COLUMNS * -(-len(knots) // COLUMNS)

    def columns(table: Matrix, *, repeat: bool = True) -> NumberTable:
        return tuple(pad_vector(column, stored, repeat=repeat) for column in transpose(table))

    tables = {
        "KNOT_ABSCISSA": columns(transpose((knots,))),
        "TANGENT_INTEGRALS_TWICE": columns(_twice_integrated(knots, knots)),
        "TANGENT_END": columns(taylor, repeat=False),
    }
    fills_vectors = len(points) in (2, 4) or len(points) == stored
    if not fills_vectors or max(map(abs, map(operator.sub, knots, points))) > DIFFERENT:
        tables["KNOT_VALUES"] = columns(cardinal_values(points, knots))
    if of_velocities:
        tables["TANGENT_INTEGRALS"] = columns(cardinal_integrals(knots, knots, mp.zero))
        tables["KNOT_INTEGRALS"] = columns(cardinal_integrals(points, knots, mp.zero))
        tables["KNOT_RATES"] = columns(cardinal_derivatives(points, knots))
    return tuple(IterationTable(name, table) for name, table in tables.items())


def _separable_growth(system: LagrangianSystem) -> tuple[Kernel, Kernel]:
    (partials, (product, _)), q = force_derivatives(system), system.coordinates
    by_operations = product_by_operations(system, forms_of(system).force, q, u=q, purpose="L_q")
    return min((partials, product), by_operations, key=_operations)


def _operations(kernels: tuple[Kernel, Kernel]) -> int:
    """Return the number of operations of a step with three iterations, as with a tolerance of 1e-9."""
    partials, product = (sum(kernel.operation_counts().values()) for kernel in kernels)
    return partials + 3 * product


def _coupled_growth(system: LagrangianSystem) -> tuple[Kernel, Kernel]:
    """Return kernels of L_vv dq'' = -E_q dq - E_v dq', E(q, v, a) the Euler-Lagrange residual."""
    forms, of = forms_of(system), (*system.coordinates, *system.velocities)
    residual = [-equation for equation in forms.euler_lagrange]
    entries = jacobian(residual, of) or NOTHING
    different = tuple(dict.fromkeys(entries.values()))
    u = *of, *accelerations(system)
    partials = system_kernel(
        system,
        "point_derivatives",
        different,
        u=u,
        partials=forms.mass_terms,
        purpose="The distinct entries of -E_q and -E_v, and terms of L_vv at all points.",
    )
    product = vector_product(
        system,
        "derivative_product",
        entries,
        different,
        shape=(system.dimension, len(of)),
        purpose="The matrix of derivatives times x, u = (x, its entries).",
    )
    by_operations = product_by_operations(system, residual, of, u=u, partials=forms.mass_terms, purpose="-E")
    return min((partials, product), by_operations, key=_operations)


GROWTH_KERNELS: Mapping[str, Callable[[LagrangianSystem], tuple[Kernel, Kernel]]] = {
    "separable_derivatives": _separable_growth,
    "coupled_derivatives": _coupled_growth,
}


def _twice_integrated(points: Vector, ends: Vector) -> Matrix:
    """Return the integrals of (c - u) l_j(u) from 0 to c for each c of ``ends``."""
    rule = gauss_legendre(len(points) // 2 + 1)
    rows = []
    for c in ends:
        u = [c * (1 + x) / 2 for x in rule.points]
        weights = [w * c / 2 * (c - x) for w, x in zip(rule.weights, u, strict=True)]
        rows.append(tuple(mp.fdot(weights, column) for column in transpose(cardinal_values(points, u))))
    return tuple(rows)


def _with_common_roots(kernel: Kernel) -> Kernel:
    """Return the kernel with inverse roots x^(-k/2) as powers of x^(-1/2), which is computed once for each x."""
    temporaries, results = (tuple(map(_powers_of_root, parts)) for parts in (kernel.temporaries, kernel.results))
    return replace(kernel, temporaries=temporaries, results=results)


def _powers_of_root(expression: Expression) -> Expression:
    if not isinstance(expression, Operation):
        return expression
    operands = tuple(map(_powers_of_root, expression.operands))
    k = {name: k for k, name in INVERSE_ROOTS.items()}.get(expression.operator, 0)
    if k < 3 or not isinstance(operands[0], Load):
        return Operation(expression.operator, operands)
    root = Operation(INVERSE_ROOTS[1], operands)
    power: Expression = root
    for _ in range(k // 2):
        power = Operation("*", (power, Operation("*", (root, root))))
    return power
