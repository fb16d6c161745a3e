"""Stage equations in v0 and z_i = h (acceleration at c_i): Euler-Lagrange equations at stages of a tableau."""

from fractions import Fraction

from scvi_codegen.mechanics.derived_expressions import accelerations, forms_of
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.galerkin_stages import position_block
from scvi_codegen.methods.stage_structure import Accelerations
from scvi_codegen.methods.stage_system import Block, Gather, Row, Scatter, StageGroup, StageSystem, Table
from scvi_codegen.tables.basis import differentiation_matrix, matrix_product, next_step
from scvi_codegen.tables.nodes import Nodes
from scvi_codegen.tables.precision import Matrix, Number, Vector, mp
from scvi_codegen.tables.tableau import Tableau

VELOCITY_BLOCK = Block(name="v_0", power=1, straight=(mp.zero, mp.one))


def position_system(system: MechanicalSystem, tableau: Tableau) -> StageSystem:
    """Return (22) on (q, v): unknowns v0 and z_i = h a_i; v0 from p0 by the Legendre transform, p1 from v1."""
    b, size = tableau.b, len(tableau.b)
    ones, none = Table.constant(1, 1, 1), Table.constant(1, size)
    b_row = Table(entries=(b,), names=(tuple(f"b_{i}" for i in range(1, size + 1)),))
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
    return (VELOCITY_BLOCK, *(Block(name=f"z_{i}", power=1, straight=(mp.zero, mp.zero)) for i in range(1, size + 1)))


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
    drift = Table(entries=sums.entries, names=tuple((name.rpartition("_")[0],) for (name,) in sums.names))
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
    none, last = Table.constant(size, size + 1), Table.named("", [[int(n == size - 1)] for n in range(size)])
    group = residual_group(
        system,
        nodes.abscissae[1:],
        nodal_gathers(system, nodes),
        Table.joined(Table.identity(size), Table.constant(size, 2)),
        Scatter(results=forms_of(system).momentum, table=Table.joined(none, last), power=0),
    )
    one, others, zero = Table.constant(1, 1, 1), Table.constant(1, size), Table.constant(1, 1)
    curve, minus = (Table.joined(one, others, zero), Table.joined(zero, others, one)), Table.constant(1, 1, -1)
    return StageSystem(
        blocks=nodal_blocks(nodes),
        rows=(
            *(Row(number="18", kind="stage", momentum=mp.zero) for _ in range(size)),
            Row(number="p0", kind="Legendre", momentum=mp.one),
        ),
        stage_groups=(group, single_point(system, "start", mp.zero, curve, Table.joined(others, minus, zero))),
        end_position=Table.joined(others, one, zero),
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
        Table(entries=tuple((x / 2,) for (x,) in first), names=tuple((f"D_{n}_0/2",) for n in range(1, size + 1))),
    )
    return (
        Gather(arguments=system.coordinates, table=Table.joined(zeros, Table.identity(size), zeros, padding), power=0),
        Gather(
            arguments=system.velocities, table=Table.joined(derivative, zeros, padding), power=-1, scale=Fraction(2)
        ),
        Gather(arguments=accelerations(system), table=Table.joined(acceleration, padding), power=-2, scale=Fraction(4)),
    )
