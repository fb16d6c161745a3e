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

import sympy

from scvi_codegen.errors import MethodError
from scvi_codegen.formulas.expressions import gradient
from scvi_codegen.mechanics.derived_expressions import auxiliary_multipliers, forms_of
from scvi_codegen.mechanics.forces import nonholonomic_expressions
from scvi_codegen.mechanics.hamiltonian import HamiltonianSystem
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.mechanics.rotations.hamiltonian import hamiltonian_of_rotations
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.mechanics.time_transformation import reparametrise
from scvi_codegen.methods.constraints import with_constraints
from scvi_codegen.methods.method import Method
from scvi_codegen.methods.stage_structure import Velocities
from scvi_codegen.methods.stage_system import Block, Gather, Row, Scatter, StageGroup, StageSystem, Table
from scvi_codegen.tables.basis import identity_matrix, next_step
from scvi_codegen.tables.precision import Matrix, Vector, mp

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
    stages = method.stage_system(system)
    check_regular(method, system)
    _check_damping(system, method, stages)
    return _completed(system, stages, method.name)


def paper_equations(system: MechanicalSystem, method: Method) -> StageSystem:
    """Return the equations in the paper's notation. Raises as :func:`discretise`."""
    check_regular(method, system)
    return _completed(system, method.paper_form(system), method.name)


def _completed(system: MechanicalSystem, stages: StageSystem, name: str) -> StageSystem:
    """Add auxiliary variables, constraints and damping to the equations."""
    completed = with_auxiliaries(system, stages)
    completed = with_constraints(system, completed, name) if system.constraints else completed
    return replace(completed, damping=system.damping)


def _check_damping(system: MechanicalSystem, method: Method, stages: StageSystem) -> None:
    if system.damping != 0 and not isinstance(stages.shape, Velocities):
        raise MethodError(
            f"{method.name} does not support the damping of '{system.name}', which weights L_q and "
            "L_v at quadrature points: use an SVI, or a Runge-Kutta method in phase space. Every "
            'method supports damping as forces, "-gamma*p", but then areas do not shrink by exactly '
            "exp(-gamma h)"
        )


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
    guesses = [group.guess for group in groups]
    number_q, number_p = stages.end_numbers
    return replace(
        stages,
        blocks=(*stages.blocks, *(_block(groups[g], n) for g, n in added)),
        rows=tuple(replace(row, number=NUMBERS.get(row.number, row.number)) for row in rows),
        stage_groups=tuple(
            _extended(stage_group, [g for g, group in enumerate(groups) if group.stage_group == f], groups, added)
            for f, stage_group in enumerate(stages.stage_groups)
        ),
        end_position=Table.joined(stages.end_position, Table.constant(1, len(added))),
        end_numbers=(NUMBERS.get(number_q, number_q), NUMBERS.get(number_p, number_p)),
        extrapolation=stages.extrapolation and _diagonal([stages.extrapolation, *guesses]),
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
            results = _stationary(system, stage_group, symbols)
            yield _Group(stage_group=f, name=name, momenta=momenta, symbols=symbols, results=results, guess=guess)


def _stationary(
    system: MechanicalSystem, stage_group: StageGroup, symbols: Sequence[sympy.Symbol]
) -> tuple[sympy.Expr, ...]:
    """Return the equations of these symbols: the gradient of the group's scalar, or v - H_p if it has none."""
    if stage_group.scalar is None:
        return forms_of(system).constitutive
    derivatives = gradient(stage_group.scalar, symbols)
    return tuple(derivatives.get(i, sympy.S.Zero) for i in range(len(symbols)))


def _block(group: _Group, n: int) -> Block:
    straight = (mp.zero, mp.zero)
    return Block(name=f"{group.name}_{n + 1}", power=1, straight=straight, momentum=int(group.momenta), moves=False)


def _extended(
    stage_group: StageGroup, numbers: Sequence[int], groups: Sequence[_Group], added: Sequence[tuple[int, int]]
) -> StageGroup:
    """Return a stage group with the gathers and scatters of its ``numbers`` groups; columns of the others are 0."""
    points, rows = len(stage_group.abscissae), len(stage_group.scatters[0].table.entries[0]) - 1
    none = Table.constant(points, len(added))
    gathers = [replace(gather, table=Table.joined(gather.table, none)) for gather in stage_group.gathers]
    scatters = [replace(scatter, table=_inserted(scatter.table, none, rows)) for scatter in stage_group.scatters]
    known = Table.constant(points, len(stage_group.gathers[0].table.entries[0]))
    before, last = Table.constant(points, rows), Table.constant(points, 1)
    for g in numbers:
        selection = Table.named("", [[int(column == (g, n)) for column in added] for n in range(points)])
        gathers.append(Gather(arguments=groups[g].symbols, table=Table.joined(known, selection), power=-1))
        scatters.append(Scatter(results=groups[g].results, table=Table.joined(before, selection, last), power=0))
    return replace(stage_group, gathers=tuple(gathers), scatters=tuple(scatters))


def _inserted(table: Table, columns: Table, at: int) -> Table:
    """Insert ``columns`` before the last column of ``table``, that of p1."""
    return Table.joined(table.columns(range(at)), columns, table.columns([at]))


def _diagonal(blocks: Sequence[Matrix]) -> Matrix:
    """Return the block diagonal matrix."""
    size, offset = sum(map(len, blocks)), 0
    lines: list[Vector] = []
    for block in blocks:
        after = size - offset - len(block)
        lines += [(*(mp.zero,) * offset, *line, *(mp.zero,) * after) for line in block]
        offset += len(block)
    return tuple(lines)
