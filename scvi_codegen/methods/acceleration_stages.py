"""Stage equations in v0 and z_i = h (acceleration at c_i): Euler-Lagrange equations at stages of a tableau."""

from dataclasses import replace
from fractions import Fraction

from scvi_codegen.mechanics.derived_expressions import accelerations, forms_of
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.galerkin_stages import position_block
from scvi_codegen.methods.stage_structure import Accelerations
from scvi_codegen.methods.stage_system import (
    Block,
    Gather,
    Row,
    Scatter,
    StageGroup,
    StageSystem,
    Table,
)
from scvi_codegen.tables.basis import differentiation_matrix, matrix_product, next_step
from scvi_codegen.tables.nodes import Nodes
from scvi_codegen.tables.precision import Matrix, Number, Vector, mp
from scvi_codegen.tables.tableau import Tableau

VELOCITY_BLOCK = Block(name="v_0", power=1, straight=(mp.zero, mp.one))


def position_system(system: MechanicalSystem, tableau: Tableau) -> StageSystem:
    """Return (22) on (q, v): unknowns v0 and z_i = h a_i; v0 from p0 by the Legendre transform, p1 from v1."""
    b, size = tableau.b, len(tableau.b)
    momenta = forms_of(system).momentum
    ones, none = Table.constant(1, 1, 1), Table.constant(1, size)
    b_row = Table(entries=(b,), names=(tuple(f"b_{i}" for i in range(1, size + 1)),))
    end_row = Table.joined(ones, ones, Table.named("bA", matrix_product((b,), tableau.A)))
    start = single_point(system, "start", mp.zero, Table.joined(ones, Table.constant(1, 1), none))
    end = single_point(system, "end", mp.one, end_row)
    end_velocity = Gather(arguments=system.velocities, table=Table.joined(Table.constant(1, 1), ones, b_row), power=-1)
    end = replace(end, gathers=(end.gathers[0], end_velocity))
    minus = Table.constant(1, 1, -1)
    start_table = Table.joined(minus, none, minus)
    end_table = Table.joined(Table.constant(1, 1), none, ones)
    inner = Table.joined(Table.constant(size, 1), Table.identity(size), Table.constant(size, 1))
    collocation = residual_group(
        system, tableau.c, acceleration_gathers(system, tableau.A), Scatter(results=(), table=inner, power=1)
    )
    return StageSystem(
        blocks=acceleration_unknowns(size),
        rows=(
            Row(number="p0", kind="Legendre", momentum=mp.one),
            *(Row(number="18", kind="stage", momentum=mp.zero) for _ in range(size)),
        ),
        stage_groups=(
            replace(start, scatters=(Scatter(results=momenta, table=start_table, power=0),)),
            collocation,
            replace(end, scatters=(Scatter(results=momenta, table=end_table, power=0),)),
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
    residual: Scatter,
    *others: Scatter,
) -> StageGroup:
    """Return collocation nodes of weight 1 with the Euler-Lagrange residual as kernel, scattered by ``residual``."""
    return StageGroup(
        name="node",
        abscissae=abscissae,
        gathers=gathers,
        scatters=(replace(residual, results=forms_of(system).euler_lagrange), *others),
    )


def acceleration_unknowns(size: int) -> tuple[Block, ...]:
    """Return the blocks v0, z_1 .. z_s of a curve with initial velocity v0 and scaled accelerations z_i."""
    return (
        VELOCITY_BLOCK,
        *(Block(name=f"z_{i}", power=1, straight=(mp.zero, mp.zero)) for i in range(1, size + 1)),
    )


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
            arguments=accelerations(system),
            table=Table.joined(zeros, zeros, Table.identity(size), padding),
            power=-2,
        ),
    )


def acceleration_extrapolation(tableau: Tableau) -> Matrix:
    """Return the predictor for the next step: v0 <- v1 = v0 + sum b_i z_i, accelerations by extrapolation."""
    inner = next_step(tableau.c)
    size = len(tableau.b)
    return ((mp.one, *tableau.b), *((mp.zero, *inner[i]) for i in range(size)))


def single_point(
    system: MechanicalSystem, name: str, abscissa: Number, position: Table, *, velocity_block: int = 0
) -> StageGroup:
    """Return a single point whose velocity is the block ``velocity_block``; the caller adds the scatters."""
    columns = len(position.entries[0])
    velocity = Table.named("", [[int(b == velocity_block + 1) for b in range(columns)]])
    return StageGroup(
        name=name,
        abscissae=(abscissa,),
        gathers=(
            Gather(arguments=system.coordinates, table=position, power=0),
            Gather(arguments=system.velocities, table=velocity, power=-1),
        ),
        scatters=(),
    )


def nodal_collocation(system: MechanicalSystem, nodes: Nodes) -> StageSystem:
    """Return (18) as printed: unknowns Q^1 .. Q^s and v0; v0 from p0, p1 from v1 = V_s by the Legendre transform."""
    size = nodes.degree
    momenta = forms_of(system).momentum
    none, last = Table.constant(size, size + 1), Table.named("", [[int(n == size - 1)] for n in range(size)])
    group = residual_group(
        system,
        nodes.abscissae[1:],
        nodal_gathers(system, nodes),
        Scatter(results=(), table=Table.joined(Table.identity(size), Table.constant(size, 2)), power=0),
        Scatter(results=momenta, table=Table.joined(none, last), power=0),
    )
    start = single_point(
        system,
        "start",
        mp.zero,
        Table.joined(Table.constant(1, 1, 1), Table.constant(1, size + 1)),
        velocity_block=size,
    )
    start_table = Table.joined(Table.constant(1, size), Table.constant(1, 1, -1), Table.constant(1, 1))
    return StageSystem(
        blocks=nodal_blocks(nodes),
        rows=(
            *(Row(number="18", kind="stage", momentum=mp.zero) for _ in range(size)),
            Row(number="p0", kind="Legendre", momentum=mp.one),
        ),
        stage_groups=(group, replace(start, scatters=(Scatter(results=momenta, table=start_table, power=0),))),
        end_position=Table.joined(Table.constant(1, size), Table.constant(1, 1, 1), Table.constant(1, 1)),
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
            names=tuple((f"D_{n}_0/2",) for n in range(1, size + 1)),
        ),
    )
    return (
        Gather(
            arguments=system.coordinates,
            table=Table.joined(zeros, Table.identity(size), zeros, padding),
            power=0,
        ),
        Gather(
            arguments=system.velocities,
            table=Table.joined(derivative, zeros, padding),
            power=-1,
            scale=Fraction(2),
        ),
        Gather(
            arguments=accelerations(system),
            table=Table.joined(acceleration, padding),
            power=-2,
            scale=Fraction(4),
        ),
    )
