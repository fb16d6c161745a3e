"""Stage equations of a system with constraints: multipliers at points, and the momentum at the end.

With Gauss-Lobatto points c_0 = 0 < .. < c_s = 1 as quadrature points, the discrete action with a multiplier at each is
made stationary,

    h sum_n b_n [L(q_n, v_n) + lambda_n . g(q_n)],            g(q_n) = 0 for n = 1 .. s

(g(q_0) = 0 is the last condition of the previous step). lambda_s enters p1 only, and projects it onto the tangent
space: with v the velocity of p1,

    p1 = L_v(q1, v),                                          g_q v + g_t = 0.

This is the Lobatto IIIA-IIIB pair: order 2s in positions and momenta, symmetric, symplectic on the constrained phase
space, RATTLE for s = 1. With Gauss points constraints would hold only there, and the order would be reduced.

Nonholonomic constraints, A v + b = 0, act by multipliers at the same points, as A^T lambda in addition to L_q; they
are imposed at s Gauss points, where the velocity of a curve of degree s is most accurate, and on v at the end:

    A(q(c_j)) q'(c_j) + b = 0 for j = 1 .. s,                 A(q1) v + b = 0.

The order is 2s, measured, and the step symmetric; like the nonholonomic flow it is not symplectic. Momentum maps of
symmetries along which constraint forces do no work are conserved.

A constraint that is imposed in some modes only (:class:`~scvi_codegen.systems.constraints.kind.Reaction`) has the rows
c g(q_n) + (1 - c) lambda_{n-1} = 0 with its mask c, and the direction of its force in place of that of G^T: sliding
friction is the force (G - mu d T)^T lambda of the multipliers at the points. The order 2s is measured.

Sources: L. Jay, SIAM J. Numer. Anal. 33 (1996); J. E. Marsden, M. West, Acta Numerica 10 (2001), section 3.5; T.
Wenger, S. Ober-Bloebaum, S. Leyendecker, Adv. Comput. Math. 43 (2017). Other nonholonomic methods: R. McLachlan, M.
Perlmutter, J. Nonlinear Sci. 16 (2006); D. Martin de Diego, R. Sato Martin de Almagro, arXiv 1810.10926.
"""

from dataclasses import replace

import sympy

from scvi_codegen.common.errors import MethodError
from scvi_codegen.common.precision import Matrix, Vector, mp
from scvi_codegen.methods.stage_system import Block, Gather, Row, Scatter, StageGroup, StageSystem, Table, Velocities
from scvi_codegen.methods.tables.basis import cardinal_values
from scvi_codegen.methods.tables.quadrature import gauss_legendre
from scvi_codegen.systems.constraints import (
    constraint_multipliers,
    constraint_rates,
    idle_multipliers,
    position_conditions,
    velocity_conditions,
    with_constraint_forces,
)
from scvi_codegen.systems.derived_expressions import forms_of
from scvi_codegen.systems.system import MechanicalSystem

END_VELOCITY = "v", 1
"""Name of the unknown velocity that corresponds to the momentum at the end."""

SAME = mp.mpf(10) ** -40
"""Largest difference between equal coefficients of order 1, in 60 digits."""


def with_constraints(system: MechanicalSystem, stages: StageSystem, name: str) -> StageSystem:
    """Return the stage equations with the constraints of the system."""
    _check_points(system, stages, name)
    group, count = stages.stage_groups[0], len(system.constraints)
    points = len(group.abscissae)
    multipliers = tuple(Block(letter="lambda", index=n, moves=False, size=count) for n in range(points))
    velocity = Block(letter=END_VELOCITY[0], index=END_VELOCITY[1], straight=(mp.zero, mp.one), moves=False)
    conditions = [("g", "stage")] * (points - 1) + [("hidden", "stage")]
    return replace(
        stages,
        blocks=(*stages.blocks, velocity, *multipliers),
        rows=(
            *stages.rows,
            Row(number="end", kind="stage", momentum=-stages.end_momentum),
            *(Row(number=number, kind=kind, momentum=mp.zero, size=count) for number, kind in conditions),
        ),
        stage_groups=(
            _with_multipliers(system, group),
            *_velocity_conditions(system, stages, group),
            _end(system, stages, points),
        ),
        end_position=Table.joined(stages.end_position, Table.constant(1, 1 + points)),
        extrapolation=stages.extrapolation and _extrapolation(stages, group.abscissae),
    )


def _check_points(system: MechanicalSystem, stages: StageSystem, name: str) -> None:
    """Raise an error unless the first stage group has s + 1 points, both ends of the step among them."""
    group, s = stages.stage_groups[0], len(stages.blocks)
    ends = (group.abscissae[0], group.abscissae[-1]) == (0, 1)
    if any(velocity_conditions(system)) and ends and not _is_polynomial(group):
        raise MethodError(
            f"{name} does not support the nonholonomic constraints of '{system.name}', because its curves "
            "are not polynomials: use an SVI with polynomials"
        )
    if ends and len(stages.stage_groups) == 1 and len(group.abscissae) == s + 1 and group.in_action:
        return
    raise MethodError(
        f"{name} does not support the constraints of '{system.name}': they require an SVI whose "
        "quadrature has one point more than its degree, including both ends of the step. Use SVI(4, "
        "'gauss-lobatto:5'), of order 8, for example; SVI(1, 'gauss-lobatto:2') is RATTLE"
    )


def _is_polynomial(group: StageGroup) -> bool:
    """Return whether the velocity at the last point is interpolated by the others, as for a polynomial of degree s."""
    if len(group.gathers) < 2:  # compositions have positions alone
        return False
    velocities, points = group.gathers[1].table.entries, group.abscissae
    others = Table(entries=velocities[:-1], names=group.gathers[1].table.names[:-1])
    last = _interpolated(others, cardinal_values(points[:-1], points[-1:]), "").entries[0]
    return all(abs(x - y) < SAME for x, y in zip(last, velocities[-1], strict=True))


def _with_multipliers(system: MechanicalSystem, group: StageGroup) -> StageGroup:
    """Return the quadrature with multipliers: L + lambda . g in place of L, and g itself in rows of its own."""
    assert group.scalar is not None
    points, factors = len(group.abscissae), constraint_multipliers(system)
    columns = len(group.gathers[0].table.entries[0])
    rows = len(group.scatters[0].table.entries[0]) - 1
    none, zero = Table.constant(points, 1 + points), Table.constant(points, 1)
    gathers = [replace(gather, table=Table.joined(gather.table, none)) for gather in group.gathers]
    table = Table.joined(Table.constant(points, columns), zero, Table.identity(points))
    gathers.append(Gather(arguments=factors, table=table, power=-1))
    scatters = [replace(scatter, table=_with_end(scatter.table, rows, points)) for scatter in group.scatters]
    scatters[0] = replace(scatters[0], results=with_constraint_forces(system, scatters[0].results))
    conditions = [[int(row == n - 1) for row in range(points)] for n in range(points)]
    conditions_table = Table.joined(Table.constant(points, rows), zero, Table.named("", conditions), zero)
    positions = position_conditions(system)
    if any(positions):
        scatters.append(Scatter(results=positions, table=conditions_table, power=-1, scale=scatters[0].scale))
    if system.reactions:
        table = Table.joined(Table.constant(points, rows), zero, Table.identity(points), zero)
        scatters.append(Scatter(results=idle_multipliers(system), table=table, power=1))
    products = [factor * g for factor, g in zip(factors, positions, strict=True)]
    return replace(
        group,
        gathers=tuple(gathers),
        scatters=tuple(scatters),
        scalar=sympy.Add(group.scalar, *products),
        computes="L_q + G^T lambda, L_v and g",
        forced=group.forced or bool(system.reactions) or any(velocity_conditions(system)),
    )


def _velocity_conditions(system: MechanicalSystem, stages: StageSystem, group: StageGroup) -> tuple[StageGroup, ...]:
    """Return the nonholonomic constraints at s Gauss points; empty if there are none."""
    conditions, size, rows = velocity_conditions(system), len(stages.blocks), len(stages.rows)
    if not any(conditions):
        return ()
    points, gauss = len(group.abscissae), gauss_legendre(size)
    between = cardinal_values([2 * c - 1 for c in group.abscissae], gauss.points)
    gathers = [
        replace(
            gather, table=Table.joined(_interpolated(gather.table, between, name), Table.constant(size, 1 + points))
        )
        for gather, name in zip(group.gathers, ("A", "L"), strict=True)
    ]
    table = Table.joined(Table.constant(size, rows + 1), Table.identity(size), Table.constant(size, 2))
    return (
        StageGroup(
            name="rolling",
            abscissae=gauss.abscissae,
            gathers=tuple(gathers),
            scatters=(Scatter(results=conditions, table=table, power=0),),
            computes="Velocity constraints",
        ),
    )


def _interpolated(table: Table, weights: Matrix, name: str) -> Table:
    """Return the table at other points, where its entries are polynomials of the points."""
    columns = list(zip(*table.entries, strict=True))
    lines = [[mp.fdot(zip(line, column, strict=True)) for column in columns] for line in weights]
    return Table.named(name, lines, column=0)


def _with_end(table: Table, rows: int, points: int) -> Table:
    """Return a scatter table with the negative row of p1 added to that of L_v = p1, and zeros for constraints."""
    last = table.columns([rows])
    negative = Table(
        entries=tuple((-line[0],) for line in last.entries),
        names=tuple((name and replace(name, factor=-name.factor),) for (name,) in last.names),
    )
    return Table.joined(table.columns(range(rows)), negative, Table.constant(len(table.entries), points), last)


def _end(system: MechanicalSystem, stages: StageSystem, points: int) -> StageGroup:
    """Return L_v(q1, v) and the rates of the constraints at the end of the step."""
    size, rows = len(stages.blocks), len(stages.rows)
    others, column = Table.constant(1, 1 + points), [[0] * (1 + size) + [1] + [0] * points]
    momentum = [[0] * rows + [1] + [0] * (points + 1)]
    hidden = [[0] * (rows + points) + [1, 0]]
    return StageGroup(
        name="end",
        abscissae=(mp.one,),
        gathers=(
            Gather(arguments=system.coordinates, table=Table.joined(stages.end_position, others), power=0),
            Gather(arguments=system.velocities, table=Table.named("", column), power=-1),
        ),
        scatters=(
            Scatter(results=forms_of(system).momentum, table=Table.named("", momentum), power=0),
            Scatter(results=constraint_rates(system), table=Table.named("", hidden), power=0),
        ),
        computes="Momenta L_v and the rates of the constraints",
    )


def _extrapolation(stages: StageSystem, abscissae: Vector) -> Matrix:
    """Return the predictor by polynomials through multipliers, and velocities with the final one, of higher order."""
    blocks = stages.shape.blocks if isinstance(stages.shape, Velocities) else ()
    size, points, nodes = len(stages.blocks), len(abscissae), (*blocks, mp.one)
    if len(set(nodes)) <= size:
        lines = [(*line, *(mp.zero,) * (1 + points)) for line in stages.extrapolation or ()]
        lines.append((*(mp.zero,) * size, mp.one, *(mp.zero,) * points))
    else:
        lines = [(*line, *(mp.zero,) * points) for line in _ahead(nodes)]
    lines += [(*(mp.zero,) * (size + 1), *line) for line in _ahead(abscissae)]
    return tuple(lines)


def _ahead(points: Vector) -> Matrix:
    """Return the extrapolation from values at points of a step to the same points of the next step."""
    return cardinal_values([2 * c - 1 for c in points], [2 * c + 1 for c in points])
