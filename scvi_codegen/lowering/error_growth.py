"""Growth of errors along adaptive runs: a tangent vector by an explicit Runge-Kutta-Nystroem scheme.

The variational equation dq'' = F_q dq / m of a separable system is integrated over each accepted step. Its nodes c_s
are a few of the points of the step, at which F_q is evaluated in SIMD lanes; the acceleration a_0 at the start of the
step is extrapolated from the step before. The stages

    x_s = dq + c_s h dv + h^2 sum_{j < s} position[s][j] a_j,      a_s = F_q(X_s) x_s / m

are explicit, with the integrals of the polynomial through a_0, .., a_{s-1}; the polynomial through a_1, .., a_n gives
the end. (Nystroem methods: Hairer, Norsett & Wanner, Solving ODEs I, sec. II.14.)
"""

from dataclasses import replace

from scvi_codegen.ir.arithmetic import INVERSE_ROOTS
from scvi_codegen.ir.equations import ErrorGrowth
from scvi_codegen.ir.kernel import Expression, Kernel, Load, Operation, lower_matrix, lower_vector
from scvi_codegen.ir.program import Program
from scvi_codegen.lowering.derivatives import force_derivatives
from scvi_codegen.lowering.solvers.tables import pad_vector
from scvi_codegen.mechanics.legendre import equivalent_lagrangian
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.tables.basis import cardinal_integrals, cardinal_values, matrix_product, transpose
from scvi_codegen.tables.precision import Matrix, Vector, mp
from scvi_codegen.tables.quadrature import gauss_legendre

MOST_NODES = 4
"""Largest number of nodes; those nearest to the Gauss points of as many are chosen."""
MOST_COORDINATES, MOST_DERIVATIVES = 12, 48
"""Largest numbers of coordinates and of distinct derivatives F_q, to limit the time of compilation."""


def error_growth_of(system: MechanicalSystem, program: Program) -> ErrorGrowth | None:
    """Return kernels and tables; ``None`` unless the system is separable, autonomous and conservative, and small."""
    fixed_point = program.fixed_point
    if fixed_point is None or fixed_point.derivatives_part != "separable_derivatives" or program.newton:
        return None
    twin = equivalent_lagrangian(system) if system.dimension <= MOST_COORDINATES else None
    if twin is None or system.changes_energy or system.inputs or program.damping:
        return None
    points, (partials, products) = fixed_point.guess.abscissae, force_derivatives(twin)
    which = _nodes(points)
    if partials.values > MOST_DERIVATIVES or len(set(points)) < len(points) or len(which) < 2:
        return None
    nodes, lanes = tuple(points[n] for n in which), fixed_point.lanes
    position = tuple(_twice_integrated((mp.zero, *nodes[:s]), (c,))[0] for s, c in enumerate(nodes))
    at_points = matrix_product(_twice_integrated(points, points), cardinal_values(nodes, points))
    return ErrorGrowth(
        partials=_with_common_roots(partials),
        product=products[0],
        which=which,
        nodes=lower_vector(nodes),
        position=lower_matrix(tuple((*row, *(mp.zero,) * (len(nodes) - len(row) + 1)) for row in position)),
        end_position=lower_vector(_twice_integrated(nodes, (mp.one,))[0]),
        end_velocity=lower_vector(cardinal_integrals(nodes, (mp.one,), mp.zero)[0]),
        end_acceleration=lower_vector(cardinal_values(nodes, (mp.one,))[0]),
        from_nodes=tuple(pad_vector(column, lanes) for column in transpose(at_points)),
        at_end=pad_vector(cardinal_values(points, (mp.one,))[0], lanes),
    )


def _nodes(points: Vector) -> tuple[int, ...]:
    """Return the indices of the nodes among the points; the start of the step is not one."""
    inner = [n for n, c in enumerate(points) if c > 0]
    if len(inner) <= MOST_NODES:
        return tuple(inner)
    gauss = [(1 + x) / 2 for x in gauss_legendre(MOST_NODES).points]
    distances = ([abs(points[n] - c) for n in inner] for c in gauss)
    return tuple(dict.fromkeys(inner[each.index(min(each))] for each in distances))


def _twice_integrated(points: Vector, at: Vector) -> Matrix:
    """Return the integrals of (c - u) l_j(u) from 0 to c for each c of ``at``."""
    rule = gauss_legendre(len(points) // 2 + 1)
    rows = []
    for c in at:
        u = [c * (1 + x) / 2 for x in rule.points]
        weights = [w * c / 2 * (c - x) for w, x in zip(rule.weights, u, strict=True)]
        rows.append(tuple(mp.fdot(weights, column) for column in transpose(cardinal_values(points, u))))
    return tuple(rows)


def _with_common_roots(kernel: Kernel) -> Kernel:
    """Return the kernel with inverse roots x^(-k/2) as powers of x^(-1/2), which is computed once for each x."""
    temporaries, results = (tuple(map(_powers_of_root, each)) for each in (kernel.temporaries, kernel.results))
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
