"""Discretisation: the equations of one step for a system and a method.

Methods write their equations in terms of L. If the function of the system is p . v - H, their kernels depend on
momenta p_n at the points; each group of points gets them as further blocks, with rows that make the action stationary
in them,

    0 = v_n - H_p(q_n, p_n)                                                                            (35f),

and one such pair of rows per node where a multiplied residual is made stationary (shooting). If d2H/dp2 is regular,
the method equals that of the Lagrangian, step for step: (35f) is the Legendre transform at the points.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import sympy
from sympy import Add, Expr, Symbol

from scvi_codegen.errors import MethodError
from scvi_codegen.formulas.expressions import gradient_tuple
from scvi_codegen.mechanics.derived_expressions import auxiliary_multipliers, forms_of
from scvi_codegen.mechanics.forces import nonholonomic_expressions
from scvi_codegen.mechanics.hamiltonian import HamiltonianSystem
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.mechanics.rotations.axial import Turn, axial_turns, moving_frame
from scvi_codegen.mechanics.rotations.hamiltonian import hamiltonian_of_rotations
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.mechanics.time_transformation import reparametrise
from scvi_codegen.methods.constraints import with_constraints
from scvi_codegen.methods.method import Method
from scvi_codegen.methods.stage_structure import Velocities
from scvi_codegen.methods.stage_system import Block, Gather, Row, Scatter, StageGroup, StageSystem, Table
from scvi_codegen.tables.basis import identity_matrix, next_step
from scvi_codegen.tables.precision import Matrix, Number, Vector, mp

NUMBERS = {"34a": "35a", "34c": "35c", "34d": "35d", "34e": "35e"}
"""Equation numbers of the paper for the shooting method in phase space, by those for Lagrangians."""
BLOCK_NAMES = {"quadrature": "P", "derivative": "P", "stage": "P", "node": "N", "start": "S", "end": "E", "drift": "P"}
"""Names of the momenta at the points, by group of points."""


def discretised_form(system: MechanicalSystem, method: Method) -> MechanicalSystem:
    """Return the form of a system that a method discretises: of one with rotations the Hamiltonian, if it serves.

    The Hamiltonian needs about half of the operations; it is singular in p
    (:mod:`scvi_codegen.mechanics.rotations.hamiltonian`).
    """
    if not isinstance(system, LagrangianSystem) or not system.rotations or not method.symplectic:
        return system
    if (
        method.needs_regular
        or (form := hamiltonian_of_rotations(system.clock.plain if system.clock else system)) is None
    ):
        return system
    form = replace(form, arrays=system.arrays) if system.arrays else form
    return reparametrise(form, system.clock.rate) if system.clock else form


def discretise(system: MechanicalSystem, method: Method) -> StageSystem:
    """Return the compiled equations, with momenta at the points for a Hamiltonian and multipliers for constraints.

    Raises:
        MethodError: for a system that the method does not support.
    """
    stages = method.stage_system(axial_turns(system)[0])
    check_regular(method, system)
    if system.damping != 0 and not isinstance(stages.shape, Velocities):
        raise MethodError(
            f"{method.name} does not support the damping of '{system.name}', which weights L_q and "
            "L_v at quadrature points: use an SVI, or a Runge-Kutta method in phase space. Every "
            'method supports damping as forces, "-gamma*p", but then areas do not shrink by exactly '
            "exp(-gamma h)"
        )
    return _completed(system, stages, method, moving=in_moving_frame(system, method))


def in_moving_frame(system: MechanicalSystem, method: Method) -> bool:
    """Return whether the method is applied in the moving frame of bodies: if its points determine the momenta."""
    return bool(moving_frame(system)) and isinstance(method.stage_system(axial_turns(system)[0]).shape, Velocities)


def paper_equations(system: MechanicalSystem, method: Method) -> StageSystem:
    """Return the equations in the paper's notation. Raises as :func:`discretise`."""
    check_regular(method, system)
    moving = in_moving_frame(system, method)
    return _completed(system, method.paper_form(axial_turns(system)[0]), method, moving=moving)


def _completed(system: MechanicalSystem, stages: StageSystem, method: Method, *, moving: bool) -> StageSystem:
    """Add auxiliary variables, constraints, damping, and the rotations of axially symmetric bodies to the equations."""
    core, turns = axial_turns(system)
    completed = with_auxiliaries(core, stages)
    completed = with_constraints(core, completed, method.name) if core.constraints else completed
    completed = replace(completed, damping=core.damping)
    completed = _framed(core, completed, turns, moving_frame(system)) if moving else completed
    return _turned(core, completed, turns, moving=moving) if turns else completed


def _symbols(count: int) -> tuple[tuple[Symbol, ...], ...]:
    """Return the symbols of u = h p and of changes of q."""
    return tuple(tuple(Symbol(f"{name}_{i}", real=True) for i in range(count)) for name in ("turn", "change"))


def _framed(
    system: MechanicalSystem, stages: StageSystem, turns: Sequence[Turn], rates: Sequence[Expr]
) -> StageSystem:
    """Return the equations in the moving frame, with the first half of the free rotation as further unknowns.

    W depends on u_n = (c_n - 1/2) h P_n. At the start V is the change of q by h, P the momentum before it.
    """
    q, size, (u, v) = system.coordinates, len(stages.rows), _symbols(len(system.coordinates))
    by_u = dict(zip(system.auxiliaries, u, strict=True))
    velocity, force = (tuple(x.xreplace(by_u) for x in part) for part in (rates[: len(q)], rates[len(q) :]))
    groups = [
        replace(wide, gathers=tuple(replace(x, table=_following(x.table)) for x in wide.gathers))
        for wide in (each.widened(2) for each in stages.stage_groups)
    ]
    for k, group in enumerate(groups):
        if system.auxiliaries not in (each.arguments for each in group.gathers):
            continue
        (at,) = (each for each in group.gathers if each.arguments == system.auxiliaries)
        first, momentum, rate = group.scatters
        times = [c - mp.mpf(1) / 2 for c in group.abscissae]
        groups[k] = replace(
            group,
            gathers=(*group.gathers, replace(at, arguments=u, table=_timed(at.table, times), power=at.power + 1)),
            scatters=(
                replace(first, results=force),
                momentum,
                replace(rate, results=system.velocities),
                Scatter(results=tuple(-x for x in velocity), table=_timed(rate.table, times), power=rate.power + 1),
            ),
            scalar=None,
            in_action=False,
        )
    changes = zip(*(turn.changes(q, u, free=True, turned=False) for turn in turns), strict=True)
    moved, pushed = (tuple(map(Add, *each)) if len(turns) > 1 else each[0] for each in changes)
    one, minus, none = Table.constant(1, 1, 1), Table.constant(1, 1, -1), Table.constant(1, 1)
    others = Table.constant(1, size)
    into = Table.named("", [(*(row.momentum for row in stages.rows), mp.zero, mp.zero, stages.end_momentum)])
    start = StageGroup(
        name="frame",
        abscissae=(mp.zero,),
        gathers=(
            Gather(arguments=q, table=Table.joined(one, others, none, none), power=0),
            Gather(arguments=u, table=Table.joined(none, others, one, none), power=0),
            Gather(arguments=v, table=Table.joined(none, others, none, one), power=0),
        ),
        scatters=(
            Scatter(
                results=tuple(a - b for a, b in zip(moved, v, strict=True)),
                table=Table.joined(others, none, one, none),
                power=-1,
            ),
            Scatter(results=pushed, table=into, power=-1),
            Scatter(results=u, table=Table.joined(others, minus, none, none), power=-1),
        ),
        computes="Changes of q and u = h p by half of the free rotation, less v, and u",
    )
    still = (mp.zero, mp.zero)
    return replace(
        stages,
        blocks=(
            *(replace(each, straight=still) if each.moves else each for each in stages.blocks),
            Block(name="P_start", power=1, straight=still, momentum=1, moves=False),
            Block(name="V_start", power=1, straight=still),
        ),
        rows=(
            *stages.rows,
            Row(number="P_start", kind="stage", momentum=mp.one),
            Row(number="V_start", kind="stage", momentum=mp.zero),
        ),
        stage_groups=(start, *groups),
        end_position=_following(Table.joined(stages.end_position, none, none)),
        extrapolation=stages.extrapolation and _diagonal([stages.extrapolation, identity_matrix(2)]),
    )


def _following(table: Table) -> Table:
    """Return a table in which the last block, a change of q0, has the coefficients of q0."""
    return table.columns([*range(len(table.entries[0]) - 1), 0])


def _timed(table: Table, times: Sequence[Number]) -> Table:
    """Return the rows of a table times numbers."""
    return Table.named("tau", [[t * x for x in line] for t, line in zip(times, table.entries, strict=True)])


def _turned(system: MechanicalSystem, stages: StageSystem, turns: Sequence[Turn], *, moving: bool) -> StageSystem:
    """Return the equations followed by rotations of bodies: V is their change of q by h, P the momentum before them."""
    q, size, (u, v) = system.coordinates, len(stages.rows), _symbols(len(system.coordinates))
    changes = zip(*(turn.changes(q, u, free=moving, turned=True) for turn in turns), strict=True)
    moved, pushed = (tuple(map(Add, *each)) if len(turns) > 1 else each[0] for each in changes)
    one, minus, none = Table.constant(1, 1, 1), Table.constant(1, 1, -1), Table.constant(1, 1)
    before, others = Table.joined(stages.end_position, none, none), Table.constant(1, size)
    results = (tuple(a - b for a, b in zip(moved, v, strict=True)), (minus, none, none)), (pushed, (none, none, one))
    group = StageGroup(
        name="spin",
        abscissae=(mp.one,),
        gathers=(
            Gather(arguments=q, table=before, power=0),
            Gather(arguments=u, table=Table.joined(none, others, none, one), power=0),
            Gather(arguments=v, table=Table.joined(none, others, one, none), power=0),
        ),
        scatters=tuple(
            Scatter(results=each, table=Table.joined(others, *columns), power=-1)
            for each, columns in (*results, (u, (none, minus, none)))
        ),
        computes="Changes of q and u = h p by rotations, less v, and u",
    )
    still = (mp.zero, mp.zero)
    spin = Block(name="V_spin", power=1, straight=still)
    last = Row(number="P_spin", kind="IDEL", momentum=stages.end_momentum)
    return replace(
        stages,
        blocks=(*stages.blocks, spin, Block(name="P_spin", power=1, straight=still, momentum=1, moves=False)),
        rows=(*stages.rows, Row(number="V_spin", kind="stage", momentum=mp.zero), last),
        stage_groups=(*(_reaching(each, size) for each in stages.stage_groups), group),
        end_position=Table.joined(stages.end_position, one, none),
        extrapolation=stages.extrapolation and _diagonal([stages.extrapolation, identity_matrix(2)]),
    )


def _reaching(group: StageGroup, size: int) -> StageGroup:
    """Return a stage group that adds to the momentum before the turns what it adds to p1."""
    wide, order = group.widened(2), [*range(size + 1), -1, -1]
    return replace(wide, scatters=tuple(replace(each, table=each.table.columns(order)) for each in wide.scatters))


def check_regular(method: Method, system: MechanicalSystem) -> None:
    """Raise :class:`MethodError` for a Hamiltonian with singular d2H/dp2 and a method that requires regularity."""
    if method.needs_regular and isinstance(system, HamiltonianSystem) and not system.is_regular:
        raise MethodError(
            f"{method.name} requires a regular Hamiltonian, but d2H/dp2 of '{system.name}' is "
            "singular: use an SVI with as many quadrature points as its degree, or a Runge-Kutta or "
            "collocation method in phase-space form"
        )


def is_symplectic(method: Method, system: MechanicalSystem) -> bool:
    """Return whether the steps preserve dq ^ dp: not with forces, damping, rolling or prescribed motion."""
    return system.damping == 0 and is_conformally_symplectic(method, system)


def is_conformally_symplectic(method: Method, system: MechanicalSystem) -> bool:
    """Return whether the steps multiply dq ^ dp by exp(-gamma h), where gamma is the damping rate."""
    prescribed = 0 < len(system.constraints) == getattr(system, "dimension", 0)  # 0: sizes known at run time
    return method.symplectic and not (system.forces or prescribed or any(nonholonomic_expressions(system)))


@dataclass(frozen=True, slots=True, kw_only=True)
class _Group:
    """Group of m unknowns per point of one stage group: symbols, equations, and the matrix of their predictor."""

    stage_group: int
    name: str
    momenta: bool
    symbols: tuple[sympy.Symbol, ...]
    results: tuple[sympy.Expr, ...]
    guess: Matrix


def with_auxiliaries(system: MechanicalSystem, stages: StageSystem) -> StageSystem:
    """Return the stage equations with auxiliary variables at all points that need them; unchanged if there are none."""
    groups = [group for f, stage_group in enumerate(stages.stage_groups) for group in _groups(system, f, stage_group)]
    if not groups:
        return stages
    added = [(g, n) for g, group in enumerate(groups) for n in range(len(group.guess))]
    rows = (*stages.rows, *(Row(number="35f", kind="stage", momentum=mp.zero) for _ in added))
    auxiliary = partial(Block, power=1, straight=(mp.zero, mp.zero), moves=False)
    blocks = [auxiliary(name=f"{groups[g].name}_{n + 1}", momentum=int(groups[g].momenta)) for g, n in added]
    number_q, number_p = stages.end_numbers
    return replace(
        stages,
        blocks=(*stages.blocks, *blocks),
        rows=tuple(replace(row, number=NUMBERS.get(row.number, row.number)) for row in rows),
        stage_groups=tuple(
            _extended(stage_group, [g for g, group in enumerate(groups) if group.stage_group == f], groups, added)
            for f, stage_group in enumerate(stages.stage_groups)
        ),
        end_position=Table.joined(stages.end_position, Table.constant(1, len(added))),
        end_numbers=(NUMBERS.get(number_q, number_q), NUMBERS.get(number_p, number_p)),
        extrapolation=stages.extrapolation and _diagonal([stages.extrapolation, *(group.guess for group in groups)]),
    )


def _groups(system: MechanicalSystem, f: int, stage_group: StageGroup) -> Iterator[_Group]:
    """Yield the auxiliary variables that occur in a stage group, and the multipliers of their equations."""
    free = set().union(*(result.free_symbols for result in stage_group.results))
    free |= stage_group.scalar.free_symbols if stage_group.scalar is not None else set()
    points = stage_group.abscissae
    guesses = {
        system.auxiliaries: identity_matrix(len(points)) if stage_group.name == "drift" else next_step(points),
        auxiliary_multipliers(system): identity_matrix(len(points)),
    }
    for symbols, guess in guesses.items():
        if free & set(symbols):
            momenta = symbols == system.auxiliaries
            name = BLOCK_NAMES[stage_group.name] if momenta else "nu"
            scalar = stage_group.scalar
            results = forms_of(system).constitutive if scalar is None else gradient_tuple(scalar, symbols)
            yield _Group(stage_group=f, name=name, momenta=momenta, symbols=symbols, results=results, guess=guess)


def _extended(
    stage_group: StageGroup, numbers: Sequence[int], groups: Sequence[_Group], added: Sequence[tuple[int, int]]
) -> StageGroup:
    """Return a stage group with the gathers and scatters of its ``numbers`` groups; columns of the others are 0."""
    points, rows = len(stage_group.abscissae), len(stage_group.scatters[0].table.entries[0]) - 1
    wide = stage_group.widened(len(added))
    gathers, scatters = [*wide.gathers], [*wide.scatters]
    known = Table.constant(points, len(stage_group.gathers[0].table.entries[0]))
    before, last = Table.constant(points, rows), Table.constant(points, 1)
    for g in numbers:
        selection = Table.named("", [[int(column == (g, n)) for column in added] for n in range(points)])
        gathers.append(Gather(arguments=groups[g].symbols, table=Table.joined(known, selection), power=-1))
        scatters.append(Scatter(results=groups[g].results, table=Table.joined(before, selection, last), power=0))
    return replace(stage_group, gathers=tuple(gathers), scatters=tuple(scatters))


def _diagonal(blocks: Sequence[Matrix]) -> Matrix:
    """Return the block diagonal matrix."""
    size, offset = sum(map(len, blocks)), 0
    lines: list[Vector] = []
    for block in blocks:
        after = size - offset - len(block)
        lines += [(*(mp.zero,) * offset, *line, *(mp.zero,) * after) for line in block]
        offset += len(block)
    return tuple(lines)
