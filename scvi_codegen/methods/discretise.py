"""Discretisation: the equations of one step for a system and a method.

Methods write their equations in terms of L. If the function of the system is p . v - H, their kernels depend on
momenta p_n at the points; each group of points gets them as further blocks, with rows that make the action stationary
in them,

    0 = v_n - H_p(q_n, p_n)                                                                            (35f),

and one such pair of rows per node where a multiplied residual is made stationary (shooting). If d2H/dp2 is regular,
the method equals that of the Lagrangian, step for step: (35f) is the Legendre transform at the points.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import sympy
from sympy import Add, Expr, Symbol

from scvi_codegen.common.errors import MethodError
from scvi_codegen.common.precision import Matrix, Vector, mp
from scvi_codegen.methods.constraints import with_constraints
from scvi_codegen.methods.method import Method
from scvi_codegen.methods.stage_system import Block, Gather, Row, Scatter, StageGroup, StageSystem, Table, Velocities
from scvi_codegen.methods.tables.basis import identity_matrix, next_step
from scvi_codegen.systems.derived_expressions import auxiliary_multipliers, forms_of
from scvi_codegen.systems.event import warn_of_formulas
from scvi_codegen.systems.first_order import FirstOrderSystem
from scvi_codegen.systems.formulas.expressions import gradient_tuple
from scvi_codegen.systems.formulas.intermediates import intermediate, symbols_of
from scvi_codegen.systems.hamiltonian import HamiltonianSystem
from scvi_codegen.systems.kinks import check_continuity
from scvi_codegen.systems.lagrangian import LagrangianSystem
from scvi_codegen.systems.legendre.of_rotations import hamiltonian_of_rotations
from scvi_codegen.systems.splittings.axial import Turn, axial_turns, frame_potential, rotated
from scvi_codegen.systems.splittings.kinetic import kinetic_splitting
from scvi_codegen.systems.system import MechanicalSystem
from scvi_codegen.systems.time_transformation import reparametrise, time_rescaling_function

NUMBERS = {"34a": "35a", "34c": "35c", "34d": "35d", "34e": "35e"}
"""Equation numbers of the paper for the shooting method in phase space, by those for Lagrangians."""
BLOCK_NAMES = {"quadrature": "P", "derivative": "P", "stage": "P", "node": "N", "start": "S", "end": "E", "drift": "P"}
"""Names of the momenta at the points, by group of points."""
MIDDLE = Symbol("t_middle", real=True)
"""Time in the middle of a step in :func:`reference_equations`."""


def discretised_form(system: MechanicalSystem, method: Method) -> MechanicalSystem:
    """Return the form of a system that a method discretises: of one with rotations the Hamiltonian, if it serves.

    The Hamiltonian needs about half of the operations; it is singular in p
    (:mod:`scvi_codegen.systems.rotations`).
    """
    if not isinstance(system, LagrangianSystem) or not system.rotations or not method.symplectic:
        return system
    if method.needs_regular or (form := hamiltonian_of_rotations(system.in_time)) is None:
        return system
    form = replace(form, arrays=system.arrays) if system.arrays else form
    return reparametrise(form, system.clock.rate) if system.clock else form


def discretise(system: MechanicalSystem, method: Method) -> StageSystem:
    """Return the compiled equations, with momenta at the points for a Hamiltonian and multipliers for constraints."""
    stages = method.stage_system(axial_turns(system)[0])
    check_regular(method, system)
    check_continuity(system)
    if system.has_contacts:
        raise MethodError(f"the contacts of '{system.name}' require compile_stepper: omit them, contacts=()")
    if system.damping != 0 and not isinstance(stages.shape, Velocities):
        raise MethodError(
            f"{method.name} does not support the damping of '{system.name}', which weights L_q and "
            "L_v at quadrature points: use an SVI, or a Runge-Kutta method in phase space. Every "
            'method supports damping as forces, "-gamma*p", but then areas do not shrink by exactly '
            "exp(-gamma h)"
        )
    return _completed(system, stages, method, moving=in_moving_frame(system, method))


def paper_equations(system: MechanicalSystem, method: Method) -> StageSystem:
    """Return the equations in the paper's notation. Raises as :func:`discretise`."""
    check_regular(method, system)
    return _completed(system, method.paper_form(axial_turns(system)[0]), method, moving=False)


def reference_equations(system: MechanicalSystem, method: Method) -> StageSystem:
    """Return the paper's equations of the compiled step: in the moving frame of bodies those for K(Z, t).

    ``MIDDLE`` is the time t0 + h/2 at which the moving frame is that at rest.
    """
    if not in_moving_frame(system, method):
        return paper_equations(system, method)
    (core, turns), potential = axial_turns(system), frame_potential(system)
    assert isinstance(core, HamiltonianSystem)
    assert potential is not None
    u = [(system.time - MIDDLE) * p for p in core.momenta]
    framed = replace(
        core,
        hamiltonian=potential.xreplace(_into_frame(turns, core.coordinates, u)),
        parameters=(*core.parameters, MIDDLE),
        defaults=(*core.defaults, 0.0),
    )
    return _between_rotations(core, with_auxiliaries(framed, method.paper_form(framed)), turns)


def in_moving_frame(system: MechanicalSystem, method: Method) -> bool:
    """Return whether the method is applied in the moving frame of bodies: its points determine the momenta."""
    core = axial_turns(system)[0]
    return frame_potential(system) is not None and isinstance(method.stage_system(core).shape, Velocities)


def _completed(system: MechanicalSystem, stages: StageSystem, method: Method, *, moving: bool) -> StageSystem:
    """Add auxiliary variables, constraints, damping, and the rotations of axially symmetric bodies to the equations."""
    system, turns, potential = *axial_turns(system), frame_potential(system)
    completed = with_auxiliaries(system, stages)
    completed = with_constraints(system, completed, method.name) if system.constraints else completed
    completed = replace(completed, damping=system.damping)
    if potential is None or not moving:
        return _rotated(system, completed, turns, Turn.rotation) if turns else completed
    return _between_rotations(system, _framed(system, completed, turns, potential), turns)


def _between_rotations(system: MechanicalSystem, stages: StageSystem, turns: Sequence[Turn]) -> StageSystem:
    """Return equations in the moving frame as those of a step that begins and ends at rest."""
    stages = _rotated(system, stages, turns, Turn.free_rotation, first=True)
    return _rotated(system, stages, turns, Turn.free_rotation, Turn.rotation)


def _into_frame(turns: Sequence[Turn], q: Sequence[Expr], u: Sequence[Expr]) -> dict[Expr, Expr]:
    """Return the coordinates after the free rotation by u = tau p, as functions of those in the moving frame."""
    moved = map(Add, q, rotated(turns, q, [2 * x for x in u], Turn.free_rotation)[0])
    return dict(zip(q, map(intermediate, moved), strict=True))


def _symbols(name: str, system: MechanicalSystem) -> tuple[Symbol, ...]:
    return tuple(Symbol(f"{name}_{i}", real=True) for i in range(system.dimension))


def _framed(system: MechanicalSystem, stages: StageSystem, turns: Sequence[Turn], potential: Expr) -> StageSystem:
    """Return the equations of W(Q, u) in place of H: in the moving frame.

    W is the potential at the coordinates after the free rotation by u_n = tau_n h P_n, tau_n = c_n - 1/2. With
    L = P . v - W(Q, u) the forces L_Q are -W_Q, and 0 = L_P = v_n - tau_n h W_u(Q_n, u_n) replaces 0 = v_n - H_p.
    """
    q, u, (group,) = system.coordinates, _symbols("turn", system), stages.stage_groups
    W = potential.xreplace(_into_frame(turns, q, u))
    velocity, push = (tuple(-x for x in gradient_tuple(W, variables)) for variables in (u, q))
    *others, momenta, (force, momentum, rate) = *group.gathers, group.scatters
    tau = [c - mp.mpf(1) / 2 for c in group.abscissae]
    timed, back = (
        Table.named("tau", [[t * x for x in line] for t, line in zip(tau, scaled.table.entries, strict=True)])
        for scaled in (momenta, rate)
    )
    rates = replace(rate, results=system.velocities), Scatter(results=velocity, table=back, power=1)
    framed = replace(
        group,
        gathers=(*others, momenta, Gather(arguments=u, table=timed, power=momenta.power + 1)),
        scatters=(replace(force, results=push), momentum, *rates),
        scalar=Add(*(p * v for p, v in zip(system.auxiliaries, system.velocities, strict=True)), -W),
        in_action=True,
        forced=True,
    )
    still = (replace(block, straight=(mp.zero,) * 2) if block.moves else block for block in stages.blocks)
    return replace(stages, blocks=tuple(still), stage_groups=(framed,))


def _rotated(
    system: MechanicalSystem,
    stages: StageSystem,
    turns: Sequence[Turn],
    *rotations: Callable[..., tuple[Expr, ...]],
    first: bool = False,
) -> StageSystem:
    """Return the equations with rotations of bodies at the end, or ``first``.

    V is their change of q divided by h, P the momentum before them. Rotations by u = h P change q by dq and u by du.

        At the end:  0 = -(dq - h V)/h,   0 = (momentum before them) - P,   q1 += h V,   p1 += du/h.
        First:       0 = -(dq - h V)/h,   0 = p0 - P,   q0 -> q0 + h V and p0 -> p0 + du/h in all other equations.
    """
    size, u, v = len(stages.rows), _symbols("turn", system), _symbols("change", system)
    moved, pushed = rotated(turns, system.coordinates, u, *rotations)
    # Columns of gathers are those of q0, of the unknowns, of V and of P; columns of scatters of the rows, V, P and p1.
    name, others = "start" if first else "spin", Table.constant(1, size)
    unit, minus, none = Table.constant(1, 1, 1), Table.constant(1, 1, -1), Table.constant(1, 1)
    end, momentum = Table.joined(stages.end_position, none, none), stages.end_momentum
    before, into = end, Table.joined(others, none, none, unit)
    groups = [stage_group.widened(2) if first else _reaching(stage_group, size) for stage_group in stages.stage_groups]
    if first:
        columns = [*range(size + 1), 0, -1]
        groups = [
            replace(x, gathers=tuple(replace(y, table=y.table.columns(columns)) for y in x.gathers)) for x in groups
        ]
        into = Table.named("", [(*(row.momentum for row in stages.rows), mp.zero, mp.zero, momentum)])
        before, end, momentum = Table.joined(unit, others, none, none), end.columns(columns), mp.one
    change = tuple(a - b for a, b in zip(moved, v, strict=True))
    acts = [turn.action(rotation, system.coordinates, u) for turn in turns for rotation in rotations]
    tables = Table.joined(others, minus, none, none), into, Table.joined(others, none, minus, none)
    group = StageGroup(
        name=name,
        abscissae=(mp.mpf(not first),),
        gathers=(
            Gather(arguments=system.coordinates, table=before, power=0),
            Gather(arguments=u, table=Table.joined(none, others, none, unit), power=0),
            Gather(arguments=v, table=Table.joined(none, others, unit, none), power=0),
        ),
        scatters=tuple(
            Scatter(results=result, table=table, power=-1)
            for result, table in zip((change, pushed, u), tables, strict=True)
        ),
        scalar=Add(*acts),
        scalar_power=-2,
        in_action=True,
        forced=True,
        computes="Changes of q and u = h p by rotations of bodies, less v, and u",
    )
    still = Block(letter="V", index=name)
    last = Row(number=f"P_{name}", kind="IDEL", momentum=momentum)
    return replace(
        stages,
        blocks=(*stages.blocks, still, replace(still, letter="P", momentum=1, moves=False)),
        rows=(*stages.rows, Row(number=f"V_{name}", kind="stage", momentum=mp.zero), last),
        stage_groups=(*groups, group),
        end_position=end if first else Table.joined(stages.end_position, unit, none),
        extrapolation=stages.extrapolation and _diagonal([stages.extrapolation, identity_matrix(2)]),
    )


def _reaching(group: StageGroup, size: int) -> StageGroup:
    """Return a stage group that adds to the momentum before the turns what it adds to p1."""
    wide, order = group.widened(2), [*range(size + 1), -1, -1]
    scatters = (replace(scatter, table=scatter.table.columns(order)) for scatter in wide.scatters)
    return replace(wide, scatters=tuple(scatters))


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
    return method.symplectic and not (system.forces or system.is_prescribed or system.is_rolling or system.has_friction)


@dataclass(frozen=True, slots=True, kw_only=True)
class _Group:
    """Group of m unknowns per point of one stage group: symbols, equations, and the matrix of their predictor.

    The equations are multiplied by h^power. Those of first-order systems then have units that contain that of time like
    those of the momenta theta, so that pivots do not depend on it.
    """

    stage_group: int
    name: str
    momenta: bool
    symbols: tuple[sympy.Symbol, ...]
    results: tuple[sympy.Expr, ...]
    power: int
    guess: Matrix


def with_auxiliaries(system: MechanicalSystem, stages: StageSystem) -> StageSystem:
    """Return the stage equations with auxiliary variables at all points that need them; unchanged if there are none."""
    groups = [group for f, stage_group in enumerate(stages.stage_groups) for group in _groups(system, f, stage_group)]
    if not groups:
        return stages
    added = [(g, n) for g, group in enumerate(groups) for n in range(len(group.guess))]
    rows = (*stages.rows, *(Row(number="35f", kind="stage", momentum=mp.zero) for _ in added))
    blocks = [Block(letter=groups[g].name, index=n + 1, momentum=int(groups[g].momenta), moves=False) for g, n in added]
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
    free = symbols_of(*stage_group.results, *([] if stage_group.scalar is None else [stage_group.scalar]))
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
            power = int(isinstance(system, FirstOrderSystem))
            yield _Group(
                stage_group=f, name=name, momenta=momenta, symbols=symbols, results=results, power=power, guess=guess
            )


def _extended(
    stage_group: StageGroup, numbers: Sequence[int], groups: Sequence[_Group], added: Sequence[tuple[int, int]]
) -> StageGroup:
    """Return a stage group with the gathers and scatters of its ``numbers`` groups; columns of the others are 0."""
    points, rows = len(stage_group.abscissae), len(stage_group.scatters[0].table.entries[0]) - 1
    wide = stage_group.widened(len(added))
    gathers, scatters = [*wide.gathers], [*wide.scatters]
    former = Table.constant(points, len(stage_group.gathers[0].table.entries[0]))
    before, last = Table.constant(points, rows), Table.constant(points, 1)
    for g in numbers:
        selection = Table.named("", [[int(column == (g, n)) for column in added] for n in range(points)])
        gathers.append(Gather(arguments=groups[g].symbols, table=Table.joined(former, selection), power=-1))
        table = Table.joined(before, selection, last)
        scatters.append(Scatter(results=groups[g].results, table=table, power=groups[g].power))
    return replace(stage_group, gathers=tuple(gathers), scatters=tuple(scatters))


def _diagonal(blocks: Sequence[Matrix]) -> Matrix:
    size, offset = sum(map(len, blocks)), 0
    lines: list[Vector] = []
    for block in blocks:
        after = size - offset - len(block)
        lines += [(*(mp.zero,) * offset, *line, *(mp.zero,) * after) for line in block]
        offset += len(block)
    return tuple(lines)


@dataclass(frozen=True)
class Discretisation:
    """A method for a system: its equations and what its steps preserve."""

    system: MechanicalSystem
    method: Method
    MIDDLE: ClassVar[Symbol] = MIDDLE
    """Time in the middle of a step in :attr:`reference`."""

    @property
    def form(self) -> MechanicalSystem:
        """See :func:`discretised_form`."""
        return discretised_form(self.system, self.method)

    @property
    def equations(self) -> StageSystem:
        """The compiled equations, see :func:`discretise`; MethodError where the method does not apply."""
        return discretise(self.system, self.method)

    @property
    def paper(self) -> StageSystem:
        """The equations in the paper's notation; MethodError as of :attr:`equations`."""
        return paper_equations(self.system, self.method)

    @property
    def reference(self) -> StageSystem:
        """See :func:`reference_equations`."""
        return reference_equations(self.system, self.method)

    @property
    def in_moving_frame(self) -> bool:
        """See :func:`in_moving_frame`."""
        return in_moving_frame(self.system, self.method)

    @property
    def symplectic(self) -> bool:
        """Whether the steps preserve dq ^ dp: not with forces, damping, rolling or prescribed motion."""
        return is_symplectic(self.method, self.system)

    @property
    def conformally_symplectic(self) -> bool:
        """Whether the steps multiply dq ^ dp by exp(-gamma h), where gamma is the damping rate."""
        return is_conformally_symplectic(self.method, self.system)

    @property
    def turns(self) -> tuple[Turn, ...]:
        """Rotations whose axial symmetry splits the step, see :func:`axial_turns`."""
        return tuple(axial_turns(self.system)[1])

    @property
    def explicit(self) -> bool:
        """Whether the step is an explicit one of kicks and drifts."""
        split = kinetic_splitting(self.system)
        return not isinstance(split, str) and self.method.explicit_step(split) is not None

    @staticmethod
    def time_rate(system: MechanicalSystem, g: str | Expr) -> Expr:
        """Return the formula of a time-rescaling function from its name or text, which may depend on time."""
        return time_rescaling_function(system, g, in_time=True)

    @staticmethod
    def check_continuity(system: MechanicalSystem) -> None:
        """Raise MethodError if L or H jumps where steps do not refract momenta."""
        check_continuity(system)

    @staticmethod
    def warn_of_kinks(system: MechanicalSystem, subject: str) -> None:
        """Warn that steps of a subject do not end at kinks of a system, other than rint and cutoffs of lists."""
        warn_of_formulas(system, subject)

    def check(self) -> None:
        """Raise MethodError for a Hamiltonian with singular d2H/dp2 and a method that requires regularity."""
        check_regular(self.method, self.system)
