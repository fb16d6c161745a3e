"""Stage equations of Galerkin methods: stationary quadratures of L along curves, (25)-(27).

The compiled form represents a curve by its velocities V_b at s points: Q = q0 + h sum_b a_nb V_b. In the paper's
notation it is the polynomial through the positions Q^v at the nodes.
"""

from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction

from scvi_codegen.common.errors import MethodError
from scvi_codegen.common.precision import Matrix, Vector, mp
from scvi_codegen.methods.stage_system import (
    Block,
    EntryName,
    Gather,
    Row,
    ScalarStageGroup,
    Scatter,
    StageGroup,
    StageSystem,
    Table,
    Velocities,
    dyadic,
    stationary_increments,
    unit_sum,
)
from scvi_codegen.methods.tables.basis import cardinal_derivatives, cardinal_values, identity_matrix, next_step
from scvi_codegen.methods.tables.nodes import Nodes
from scvi_codegen.methods.tables.quadrature import Quadrature
from scvi_codegen.methods.tables.tableau import Tableau
from scvi_codegen.systems.derived_expressions import curve_rates, forms_of
from scvi_codegen.systems.system import MechanicalSystem


def galerkin_system(
    system: MechanicalSystem,
    *,
    abscissae: Vector,
    weights: Vector,
    position: Matrix,
    velocity: Matrix,
    end_position: Vector,
    extrapolation: Matrix,
    blocks: Vector = (),
    derivative_weights: Matrix = (),
    derivatives: Sequence[Matrix] = (),
    rounded: bool = True,
) -> StageSystem:
    """Return the stationarity of h sum_n w_n L(q0 + h sum_b a_nb V_b, sum_b l_nb V_b, t_n) at fixed q1.

    The end point is q1 = q0 + h sum_b beta_b V_b.

    Args:
        system: the mechanical system.
        abscissae: (g,) points in [0, 1].
        weights: (g,) with sum 1.
        position: (g, s) matrix a.
        velocity: (g, s) matrix l.
        end_position: (s,) vector beta.
        extrapolation: (s, s) predictor for the next step.
        blocks: (s,) abscissae of the velocities V_b; by default ``abscissae``.
        derivative_weights: rows of (g,) weights of h^k d^k L/dt^k, k = 1, 2, ..
        derivatives: as many (g, s) matrices of the k-th derivatives of the l_nb.
        rounded: whether to round tables to doubles that preserve symplecticity, instead of keeping all digits.
    """
    size = len(end_position)
    shape = exact = Velocities(
        abscissae=abscissae,
        blocks=blocks or abscissae,
        position=position,
        velocity=velocity,
        end=tuple(end_position),
        weights=tuple(weights),
        variational=True,
    )
    if rounded:
        end_position, position, weights = unit_sum(end_position), dyadic(position), unit_sum(weights)
        if abscissae[-1] == 1:
            position = (*position[:-1], end_position)
        shape = replace(exact, position=position, end=end_position, weights=weights, unrounded=exact)
    gathers = curve_gathers(system, position, (velocity, *derivatives))
    return stationary_increments(
        stage_groups=action_groups(system, abscissae, (weights, *derivative_weights), gathers),
        blocks=tuple(Block(letter="V", index=b, straight=(mp.zero, mp.one)) for b in range(1, size + 1)),
        end_position=end_position,
        rows=tuple(Row(number=f"V_{b}", kind="IDEL", momentum=end_position[b - 1]) for b in range(1, size + 1)),
        extrapolation=extrapolation,
        shape=None if derivatives else shape,
    )


def symplectic_system(system: MechanicalSystem, tableau: Tableau) -> StageSystem:
    """Return the stage equations of a symplectic tableau by its generating function; unknowns are stage velocities."""
    return galerkin_system(
        system,
        abscissae=tableau.c,
        weights=tableau.b,
        position=tableau.A,
        velocity=identity_matrix(len(tableau.b)),
        end_position=tableau.b,
        extrapolation=next_step(tableau.c),
    )


def action_groups(
    system: MechanicalSystem, abscissae: Vector, weights: Matrix, gathers: tuple[Gather, ...]
) -> tuple[ScalarStageGroup, ...]:
    """Return sum_k h^(k + 1) sum_n w_kn d^k L/dt^k at points, a group per row of weights (paper, 4.2.3).

    Args:
        system: the mechanical system.
        abscissae: (g,) points in [0, 1].
        weights: rows of (g,) weights, of L first, then of its derivatives.
        gathers: position, velocity and as many further derivatives of the curve as L has.
    """
    if len(weights) > 1 and system.auxiliaries:
        raise MethodError(
            "this quadrature uses derivatives of L along the curve of positions, which a Hamiltonian "
            "does not define: use the Lagrangian (lagrangian_of), or a quadrature without derivatives"
        )
    if len(weights) > 1 and system.forces:
        raise MethodError(
            "this quadrature uses derivatives of L along the curve, which is not supported with the "
            f"forces of '{system.name}': use a quadrature without derivatives"
        )
    scalars = (system.lagrangian, *forms_of(system).rates(len(weights) - 1))
    return tuple(
        ScalarStageGroup(
            name=f"derivative_{k}" if k else "quadrature",
            abscissae=abscissae,
            weights=group_weights,
            weight_names=tuple(EntryName(f"{'d' * k}w", n) for n in range(1, len(abscissae) + 1)),
            gathers=gathers[: k + 2],
            scalar=scalar,
            power=k,
            forces=(system.forces,) if system.forces else (),
        )
        for k, (group_weights, scalar) in enumerate(zip(weights, scalars, strict=True))
    )


def curve_gathers(
    system: MechanicalSystem,
    position: Matrix,
    velocities: Sequence[Matrix],
    *,
    names: tuple[str, str] = ("a", "l"),
    first: int = 1,
    other_blocks: int = 0,
) -> tuple[Gather, ...]:
    """Return Q, v and further time derivatives of the curve, one per table.

    Args:
        system: the mechanical system.
        position: matrix from the unknowns to q / h.
        velocities: matrices from them to v and h^k d^k v/dt^k.
        names: of the entries of both.
        first: number of their first column.
        other_blocks: number of unknowns that the curve does not depend on.
    """
    points, (of_position, of_velocity) = len(position), names
    padding = Table.constant(points, other_blocks)
    rates = (system.velocities, *curve_rates(system, len(velocities) - 1))
    gather_table = Table.joined(Table.constant(points, 1, 1), Table.named(of_position, position, column=first), padding)
    return (
        Gather(arguments=system.coordinates, table=gather_table, power=0),
        *(
            Gather(
                arguments=arguments,
                table=Table.joined(
                    Table.constant(points, 1), Table.named(f"{'d' * k}{of_velocity}", table, column=first), padding
                ),
                power=-1 - k,
            )
            for k, (arguments, table) in enumerate(zip(rates, velocities, strict=True))
        ),
    )


def nodal_quadrature_group(
    system: MechanicalSystem, nodes: Nodes, rule: Quadrature, *, other_blocks: int = 0
) -> ScalarStageGroup:
    """Return the quadrature of L along the interpolant through Q^0 .. Q^s, in the paper's notation.

    The curve does not depend on the ``other_blocks`` unknowns after Q^s (velocities, multipliers).
    """
    padding = Table.constant(len(rule), other_blocks)
    values = Table.named("l", cardinal_values(nodes.points, rule.points), column=0)
    derivative_values = Table.named("dl", cardinal_derivatives(nodes.points, rule.points), column=0)
    return ScalarStageGroup(
        name="quadrature",
        abscissae=rule.abscissae,
        weights=rule.weights,
        weight_names=tuple(EntryName("w", n) for n in range(1, len(rule) + 1)),
        gathers=(
            Gather(arguments=system.coordinates, table=Table.joined(values, padding), power=0),
            Gather(
                arguments=system.velocities, table=Table.joined(derivative_values, padding), power=-1, scale=Fraction(2)
            ),
        ),
        scalar=system.lagrangian,
        scale=Fraction(1, 2),
        forces=(system.forces,) if system.forces else (),
    )


def position_block(v: int, nodes: Nodes) -> Block:
    """Return the block of the unknown Q^v, whose initial guess is on the straight line."""
    return Block(letter="Q", index=v, power=0, straight=(mp.one, nodes.abscissae[v]))


def phase_space_system(system: MechanicalSystem, tableau: Tableau) -> StageSystem:
    """Return (22) on Hamilton's equations, with momenta eliminated by p_i = L_v(q_i, V_i)."""
    size = len(tableau.b)
    gathers = curve_gathers(system, tableau.A, (identity_matrix(size),))
    b_column = Table(entries=tuple((x,) for x in tableau.b), names=tuple((EntryName("b", n + 1),) for n in range(size)))
    return StageSystem(
        blocks=tuple(Block(letter="V", index=i, straight=(mp.zero, mp.one)) for i in range(1, size + 1)),
        rows=tuple(Row(number="22", kind="stage", momentum=mp.one) for _ in range(size)),
        stage_groups=(
            StageGroup(
                name="stage",
                abscissae=tableau.c,
                gathers=gathers,
                scatters=lagrangian_scatters(
                    system,
                    Table.joined(Table.named("a", tableau.A).transposed, b_column),
                    Table.joined(Table.identity(size, -1), Table.constant(size, 1)),
                ),
            ),
        ),
        end_position=Table.joined(Table.constant(1, 1, 1), b_column.transposed),
        end_momentum=mp.one,
        end_numbers=("22", "22"),
        extrapolation=next_step(tableau.c),
        shape=Velocities(
            abscissae=tableau.c,
            blocks=tableau.c,
            position=tableau.A,
            velocity=identity_matrix(size),
            end=tableau.b,
            weights=tableau.b,
            variational=False,
        ),
    )


def lagrangian_scatters(system: MechanicalSystem, force: Table, momentum: Table) -> tuple[Scatter, Scatter]:
    """Return L_q and L_v as kernel results, scattered by these tables."""
    forms = forms_of(system)
    return Scatter(results=forms.force, table=force, power=1), Scatter(results=forms.momentum, table=momentum, power=0)
