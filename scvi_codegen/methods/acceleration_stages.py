"""Stage equations in v0 and z_i = h (acceleration at c_i): Euler-Lagrange equations at stages of a tableau.

Stage equations of shooting-based methods, (33)-(34): compiled and nodal, with total and partial derivatives.
"""

from dataclasses import replace
from fractions import Fraction

from scvi_codegen.common.errors import MethodError
from scvi_codegen.common.precision import Matrix, Number, Vector, mp
from scvi_codegen.methods.galerkin_stages import (
    action_groups,
    curve_gathers,
    lagrangian_scatters,
    nodal_quadrature_group,
    position_block,
)
from scvi_codegen.methods.stage_system import (
    Accelerations,
    Block,
    EntryName,
    Gather,
    PrintedCurve,
    Row,
    ScalarStageGroup,
    Scatter,
    ShotCurve,
    StageGroup,
    StageSystem,
    Table,
    dyadic,
    stationary_increments,
    stationary_nodal,
    unit_sum,
)
from scvi_codegen.methods.tables.basis import (
    cardinal_derivatives,
    cardinal_values,
    differentiation_matrix,
    matrix_product,
    next_step,
)
from scvi_codegen.methods.tables.nodes import Nodes
from scvi_codegen.methods.tables.quadrature import Quadrature
from scvi_codegen.methods.tables.spaces import Polynomials
from scvi_codegen.methods.tables.tableau import Tableau
from scvi_codegen.systems.derived_expressions import accelerations, forms_of, multipliers
from scvi_codegen.systems.system import MechanicalSystem

VELOCITY_BLOCK = Block(letter="v", index=0, straight=(mp.zero, mp.one))


def position_system(system: MechanicalSystem, tableau: Tableau) -> StageSystem:
    """Return (22) on (q, v): unknowns v0 and z_i = h a_i; v0 from p0 by the Legendre transform, p1 from v1."""
    b, size = tableau.b, len(tableau.b)
    ones, none = Table.constant(1, 1, 1), Table.constant(1, size)
    b_row = Table(entries=(b,), names=(tuple(EntryName("b", column=i) for i in range(1, size + 1)),))
    end_row = Table.joined(ones, ones, Table.named("bA", matrix_product((b,), tableau.A)))
    zero, minus = Table.constant(1, 1), Table.constant(1, 1, -1)
    before, at_start = Table.joined(ones, zero, none), Table.joined(zero, ones, none)
    inner = Table.joined(Table.constant(size, 1), Table.identity(size), Table.constant(size, 1))
    return StageSystem(
        blocks=acceleration_unknowns(size),
        rows=(
            Row(number="p0", kind="Legendre", momentum=mp.one),
            *(Row(number="18", kind="stage", momentum=mp.zero) for _ in range(size)),
        ),
        stage_groups=(
            single_point(system, "start", mp.zero, (before, at_start), Table.joined(minus, none, minus)),
            residual_group(system, tableau.c, acceleration_gathers(system, tableau.A), inner, power=1),
            single_point(
                system, "end", mp.one, (end_row, Table.joined(zero, ones, b_row)), Table.joined(zero, none, ones)
            ),
        ),
        end_position=end_row,
        end_momentum=mp.one,
        end_numbers=("22", "p1"),
        extrapolation=acceleration_extrapolation(tableau),
        shape=Accelerations(tableau),
    )


def residual_group(
    system: MechanicalSystem,
    abscissae: Vector,
    gathers: tuple[Gather, ...],
    table: Table,
    *others: Scatter,
    power: int = 0,
) -> StageGroup:
    """Return collocation nodes of weight 1 with the Euler-Lagrange residual as kernel, scattered by ``table``."""
    return StageGroup(
        name="node",
        abscissae=abscissae,
        gathers=gathers,
        scatters=(Scatter(results=forms_of(system).euler_lagrange, table=table, power=power), *others),
    )


def acceleration_unknowns(size: int) -> tuple[Block, ...]:
    """Return the blocks v0, z_1 .. z_s of a curve with initial velocity v0 and scaled accelerations z_i."""
    return (VELOCITY_BLOCK, *(Block(letter="z", index=i) for i in range(1, size + 1)))


def acceleration_gathers(
    system: MechanicalSystem, A: Matrix, *, other_blocks: int = 0
) -> tuple[Gather, Gather, Gather]:
    """Return position, velocity and acceleration at the stages from (q0, v0, z_1 .. z_s).

    V_i = v0 + sum_j a_ij z_j and q_i = q0 + h sum_j a_ij V_j; the coefficient of v0 is the row sum of A, which is c_i
    for collocation but not for every tableau.
    """
    size = len(A)
    ones, zeros, padding = Table.constant(size, 1, 1), Table.constant(size, 1), Table.constant(size, other_blocks)
    sums = Table.named("c", [(mp.fsum(line),) for line in A])
    drift = replace(sums, names=tuple((name and replace(name, column=None),) for (name,) in sums.names))
    double = Table.named("aa", matrix_product(A, A))
    return (
        Gather(arguments=system.coordinates, table=Table.joined(ones, drift, double, padding), power=0),
        Gather(arguments=system.velocities, table=Table.joined(zeros, ones, Table.named("a", A), padding), power=-1),
        Gather(
            arguments=accelerations(system), table=Table.joined(zeros, zeros, Table.identity(size), padding), power=-2
        ),
    )


def acceleration_extrapolation(tableau: Tableau) -> Matrix:
    """Return the predictor for the next step: v0 <- v1 = v0 + sum b_i z_i, accelerations by extrapolation."""
    inner = next_step(tableau.c)
    size = len(tableau.b)
    return ((mp.one, *tableau.b), *((mp.zero, *inner[i]) for i in range(size)))


def single_point(
    system: MechanicalSystem, name: str, abscissa: Number, curve: tuple[Table, Table], momentum: Table
) -> StageGroup:
    """Return a single point with L_v as kernel, scattered by ``momentum``; ``curve``: tables of q and v."""
    return StageGroup(
        name=name,
        abscissae=(abscissa,),
        gathers=(
            Gather(arguments=system.coordinates, table=curve[0], power=0),
            Gather(arguments=system.velocities, table=curve[1], power=-1),
        ),
        scatters=(Scatter(results=forms_of(system).momentum, table=momentum, power=0),),
    )


def nodal_collocation(system: MechanicalSystem, nodes: Nodes) -> StageSystem:
    """Return (18) as printed: unknowns Q^1 .. Q^s and v0; v0 from p0, p1 from v1 = V_s by the Legendre transform."""
    size = nodes.degree
    none = Table.constant(size, size + 1)
    last = Table.named("", [[int(n == size - 1)] for n in range(size)])
    group = residual_group(
        system,
        nodes.abscissae[1:],
        nodal_gathers(system, nodes),
        Table.joined(Table.identity(size), Table.constant(size, 2)),
        Scatter(results=forms_of(system).momentum, table=Table.joined(none, last), power=0),
    )
    unit, others, zero = Table.constant(1, 1, 1), Table.constant(1, size), Table.constant(1, 1)
    curve = (Table.joined(unit, others, zero), Table.joined(zero, others, unit))
    minus = Table.constant(1, 1, -1)
    return StageSystem(
        blocks=nodal_blocks(nodes),
        rows=(
            *(Row(number="18", kind="stage", momentum=mp.zero) for _ in range(size)),
            Row(number="p0", kind="Legendre", momentum=mp.one),
        ),
        stage_groups=(group, single_point(system, "start", mp.zero, curve, Table.joined(others, minus, zero))),
        end_position=Table.joined(others, unit, zero),
        end_momentum=mp.zero,
        end_numbers=("15", "p1"),
    )


def nodal_blocks(nodes: Nodes) -> tuple[Block, ...]:
    """Return the blocks Q^1 .. Q^s and v0."""
    return (*(position_block(v, nodes) for v in range(1, nodes.degree + 1)), VELOCITY_BLOCK)


def nodal_gathers(system: MechanicalSystem, nodes: Nodes, *, other_blocks: int = 0) -> tuple[Gather, Gather, Gather]:
    """Return Q^i, V_i = (A Q + a0 q0)_i (15) and (A V + a0 v0)_i (16) at nodes 1 .. s, from (q0; Q^1 .. Q^s, v0)."""
    size = nodes.degree
    full = differentiation_matrix(nodes.points)[1:]
    first = tuple((line[0],) for line in full)
    inner = tuple(line[1:] for line in full)
    zeros = Table.constant(size, 1)
    padding = Table.constant(size, other_blocks)
    derivative = Table.named("D", full, column=0)
    acceleration = Table.joined(
        Table.named("DD", matrix_product(inner, first), column=0),
        Table.named("DD", matrix_product(inner, inner)),
        Table(
            entries=tuple((x / 2,) for (x,) in first),
            names=tuple((EntryName("D", n, 0, factor=Fraction(1, 2)),) for n in range(1, size + 1)),
        ),
    )
    return (
        Gather(arguments=system.coordinates, table=Table.joined(zeros, Table.identity(size), zeros, padding), power=0),
        Gather(
            arguments=system.velocities, table=Table.joined(derivative, zeros, padding), power=-1, scale=Fraction(2)
        ),
        Gather(arguments=accelerations(system), table=Table.joined(acceleration, padding), power=-2, scale=Fraction(4)),
    )


def shooting_increments(
    system: MechanicalSystem, tableau: Tableau, rule: Quadrature, *, rounded: bool = True
) -> StageSystem:
    """Return the stationarity of G = h sum w_n L(q_n, v_n) + sum_i h^2 m_i . E_i, unknowns (v0, z_i = h a_i, m_i).

    A quadrature with derivatives adds h^(k + 1) sum w_kn d^k L/dt^k, with the derivatives of the same curve. Unless
    ``rounded``, tables have all digits.
    """
    if system.forces and system.auxiliaries:
        raise MethodError(
            "shooting-based methods support forces for Lagrangians only: use the Lagrangian of "
            f"'{system.name}' (lagrangian_of)"
        )
    size = len(tableau.b)
    position, velocities, beta = _curve(tableau, rule)
    weights = rule.unit_weights
    if rounded:
        position, weights, beta = dyadic(position), unit_sum(weights), dyadic([beta])[0]
    blocks = (*acceleration_unknowns(size), *(Block(letter="m", index=i) for i in range(1, size + 1)))
    action = action_groups(
        system,
        rule.abscissae,
        (weights, *rule.unit_derivative_weights),
        curve_gathers(system, position, velocities, names=("r", "u"), first=0, other_blocks=size),
    )
    extrapolated = acceleration_extrapolation(tableau)
    return stationary_increments(
        stage_groups=(*action, _multiplier_group(system, tableau, rounded=rounded)),
        blocks=blocks,
        end_position=(*beta, *(mp.zero,) * size),
        rows=(
            *(Row(number=f"z_{i}", kind="IDEL", momentum=beta[i]) for i in range(size + 1)),
            *(Row(number="34a", kind="stage", momentum=mp.zero) for _ in range(size)),
        ),
        extrapolation=(
            *((*line, *(mp.zero,) * size) for line in extrapolated),
            *((*(mp.zero,) * (size + 1), *(mp.mpf(int(i == j)) for j in range(size))) for i in range(size)),
        ),
        shape=None if rule.derivative_weights else ShotCurve(tableau, rule),
    )


def _multiplier_group(system: MechanicalSystem, tableau: Tableau, *, rounded: bool) -> ScalarStageGroup:
    """Return the collocation nodes with scalar m_i . E_i, weight h^2 (unknowns v0, z, m)."""
    size = len(tableau.b)
    position, velocity, acceleration = acceleration_gathers(system, tableau.A, other_blocks=size)
    if rounded:
        table = Table(entries=dyadic(position.table.entries), names=position.table.names)
        position = replace(position, table=table)
    multiplier_gather = Gather(
        arguments=multipliers(system),
        table=Table.joined(Table.constant(size, 2 + size), Table.identity(size)),
        power=-1,
    )
    return ScalarStageGroup(
        name="node",
        abscissae=tableau.c,
        gathers=(position, velocity, acceleration, multiplier_gather),
        scalar=forms_of(system).multiplied_residual,
        power=1,
        in_action=False,
        forces=forms_of(system).multiplied_forces,
    )


def _curve(tableau: Tableau, rule: Quadrature) -> tuple[Matrix, tuple[Matrix, ...], Vector]:
    """Return rows of q/h, of v and h^k d^k v/dt^k of the rule, and of q1/h, for V_i = v0 + sum a_ij z_j."""
    curves, abscissae = Polynomials(), rule.abscissae
    moved = tuple((mp.one, *line) for line in tableau.A)
    velocities = tuple(
        matrix_product(curves.velocities(tableau.c, abscissae, k), moved)
        for k in range(len(rule.derivative_weights) + 1)
    )
    position = matrix_product(curves.positions(tableau.c, abscissae), moved)
    return position, velocities, matrix_product((tableau.b,), moved)[0]


def printed_increments(system: MechanicalSystem, tableau: Tableau, rule: Quadrature, nodes: Nodes) -> StageSystem:
    """Return (34a) and the partial derivatives (34d), (34e), unknowns (v0, z_i = h a_i)."""
    size, points = len(tableau.b), len(rule)
    position_rows, velocities, end_row = _curve(tableau, rule)
    abscissae = nodes.abscissae
    values = cardinal_values(abscissae, rule.abscissae)
    derivative_values = cardinal_derivatives(abscissae, rule.abscissae)
    none = Table.constant(points, size)

    def first_and_sum(name: str, lines: Matrix) -> Table:
        first, both = [(line[0],) for line in lines], [(line[0] + line[-1],) for line in lines]
        return Table.joined(Table.named(name, first), none, Table.named(name, both, column=2))

    quadrature = StageGroup(
        name="quadrature",
        abscissae=rule.abscissae,
        weights=rule.unit_weights,
        weight_names=tuple(EntryName("w", n) for n in range(1, points + 1)),
        gathers=curve_gathers(system, position_rows, velocities, names=("r", "u"), first=0),
        scatters=lagrangian_scatters(system, first_and_sum("s1", values), first_and_sum("s2", derivative_values)),
    )
    inner = Table.joined(Table.constant(size, 1), Table.identity(size), Table.constant(size, 1))
    node = residual_group(system, tableau.c, acceleration_gathers(system, tableau.A), inner, power=1)
    return StageSystem(
        blocks=acceleration_unknowns(size),
        rows=(
            Row(number="34d", kind="IDEL", momentum=mp.one),
            *(Row(number="34a", kind="stage", momentum=mp.zero) for _ in range(size)),
        ),
        stage_groups=(quadrature, node),
        end_position=Table.named("beta", [(1, *end_row)], column=0),
        end_momentum=mp.one,
        end_numbers=("34c", "34e"),
        extrapolation=acceleration_extrapolation(tableau),
        shape=PrintedCurve(tableau, rule),
    )


def shooting_nodal(system: MechanicalSystem, nodes: Nodes, rule: Quadrature) -> StageSystem:
    """Return the stationarity of G = L_d + sum lambda_i . E_i in the paper's Q^1 .. Q^s, v0, lambda_1 .. lambda_s."""
    size = nodes.degree
    multiplier_gather = Gather(
        arguments=multipliers(system), table=Table.joined(Table.constant(size, 2 + size), Table.identity(size)), power=0
    )
    node = ScalarStageGroup(
        name="node",
        abscissae=nodes.abscissae[1:],
        gathers=(*nodal_gathers(system, nodes, other_blocks=size), multiplier_gather),
        scalar=forms_of(system).multiplied_residual,
        power=-1,
        in_action=False,
        forces=forms_of(system).multiplied_forces,
    )
    return stationary_nodal(
        stage_groups=(nodal_quadrature_group(system, nodes, rule, other_blocks=1 + size), node),
        blocks=(*nodal_blocks(nodes), *(Block(letter="lambda", index=i, power=0) for i in range(1, size + 1))),
        end_block=size - 1,
        rows=(
            Row(number="34d", kind="IDEL", momentum=mp.one),
            *(Row(number="dG/dQ", kind="multiplier", momentum=mp.zero) for _ in range(size - 1)),
            Row(number="dG/dv0", kind="multiplier", momentum=mp.zero, power=1),
            *(Row(number="34a", kind="stage", momentum=mp.zero) for _ in range(size)),
        ),
        end_numbers=("34c", "34e"),
    )


def printed_nodal(system: MechanicalSystem, nodes: Nodes, rule: Quadrature) -> StageSystem:
    """Return (34a), (34d) and (34e) as printed, unknowns Q^1 .. Q^s and v0; (36)-(37) for the two-point pendulum."""
    size = nodes.degree
    action = nodal_quadrature_group(system, nodes, rule, other_blocks=1)
    none = Table.constant(len(rule), size)

    def ends(table: Table) -> Table:
        return Table.joined(none, table.columns([0]), table.columns([size]))

    quadrature = action.to_stage_group([ends(gather.table) for gather in action.gathers])
    inner = Table.joined(Table.identity(size), Table.constant(size, 2))
    node = residual_group(system, nodes.abscissae[1:], nodal_gathers(system, nodes), inner)
    return StageSystem(
        blocks=nodal_blocks(nodes),
        rows=(
            *(Row(number="34a", kind="stage", momentum=mp.zero) for _ in range(size)),
            Row(number="34d", kind="IDEL", momentum=mp.one),
        ),
        stage_groups=(quadrature, node),
        end_position=Table.joined(Table.constant(1, size), Table.constant(1, 1, 1), Table.constant(1, 1)),
        end_momentum=mp.zero,
        end_numbers=("34c", "34e"),
    )
