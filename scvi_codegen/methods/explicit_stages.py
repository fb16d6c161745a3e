"""Stage equations of explicit steps: forces and velocities in turn, from the statements of a method."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, compress

from sympy import Expr, S

from scvi_codegen.common.errors import MethodError
from scvi_codegen.common.precision import Number, Vector, mp
from scvi_codegen.methods.method import Method
from scvi_codegen.methods.recurrence import Evaluation, Letter, P, Q, Recurrence, Sum
from scvi_codegen.methods.stage_system import Block, EntryName, Gather, Row, Scatter, StageGroup, StageSystem, Table
from scvi_codegen.methods.statements import read
from scvi_codegen.methods.tables.basis import identity_matrix
from scvi_codegen.systems.derived_expressions import forms_of
from scvi_codegen.systems.formulas.symbols import symbol
from scvi_codegen.systems.splittings.kinetic import KineticSplitting, kinetic_splitting
from scvi_codegen.systems.system import MechanicalSystem


@dataclass(frozen=True, slots=True)
class _Drift:
    """An unknown V_k = h^(power - 1) M^-1 X_k, which enters positions with the factor h.

    Attributes:
        letter: of the velocity M^-1 X_k in the recurrence.
        power: of h with which it enters positions.
        momentum: evaluation of X_k, the sum of p0 and forces.
    """

    letter: Letter
    power: int
    momentum: Evaluation

    def factor(self, position: Sum) -> Number:
        """Return the factor of h V_k in a position."""
        return position.get(self.letter, {}).get(self.power, mp.zero)

    @property
    def forces(self) -> Sum:
        """The momentum h^(power - 1) X_k of the unknown."""
        by_power = {k: {n + self.power - 1: x for n, x in own.items()} for k, own in self.momentum.argument.items()}
        if not self.power > 0 or (P in by_power and self.power > 1):
            raise MethodError("positions are sums of h times velocities, and of higher powers times those of forces")
        return by_power


@dataclass(frozen=True, slots=True)
class _Step:
    """Forces and velocities that the end of a step depends on, and q1, p1 and the action as their sums."""

    kicks: tuple[tuple[Letter, Evaluation], ...]
    drifts: tuple[_Drift, ...]
    q: Sum
    p: Sum
    action: Sum
    turns: bool


def explicit_system(system: MechanicalSystem, method: Method) -> StageSystem:
    """Return the equations of the statements of a method; unknowns are the velocities V_k of the drifts.

    With rotations V_k is the change of q in drift k divided by its duration, and the momenta P_k before the drifts are
    unknown, too.
    """
    split = kinetic_splitting(system)
    if isinstance(split, str):
        raise MethodError(
            f"{method.name} requires a separable system, L = sum m_i v_i^2 / 2 - V(q, t) with constant masses, "
            "H = T(p) + V(q, t), or rigid bodies with constant moments and products of inertia, "
            f"without damping; '{system.name}' is not separable, because {split}: use an SVI"
        )
    step = _carried_out(method, split)
    durations = tuple(drift.factor(step.q) for drift in step.drifts)
    drift = _rotating_group(split, durations) if split.bodies else _drift_group(split, step)
    momenta = len(step.drifts) if split.bodies else 0
    names = [f"{'P' if momenta else 'V'}_{k}" for k in range(1, len(step.drifts) + 1)]
    starts = [drift.forces.get(P, {0: mp.zero})[0] for drift in step.drifts]
    return StageSystem(
        blocks=(
            *(Block(letter="V", index=k, straight=(mp.zero, start)) for k, start in enumerate(starts, 1)),
            *(Block(letter="P", index=k, momentum=1, moves=False) for k in range(1, momenta + 1)),
        ),
        rows=(
            *(Row(number=f"V_{k}", kind="stage", momentum=mp.zero) for k in range(1, momenta + 1)),
            *(Row(number=x, kind="IDEL" if a else "stage", momentum=a) for x, a in zip(names, starts, strict=True)),
        ),
        stage_groups=(*([_kick_group(split, step)] if any(split.force) else []), drift),
        end_position=Table.joined(
            Table.constant(1, 1, 1), Table.named("gamma", (durations,)), Table.constant(1, momenta)
        ),
        end_momentum=mp.one,
        end_numbers=("q1", "p1"),
        extrapolation=identity_matrix(len(step.drifts) + momenta),
    )


def _carried_out(method: Method, split: KineticSplitting) -> _Step:
    """Return the forces and velocities of a step, in order."""
    explicit = method.explicit_step(split)
    assert explicit is not None  # of a method with these equations
    holds = not split.velocity, split.bodies, _acts(split)
    run = Recurrence.of(
        explicit,
        read(explicit.statements, [*compress(("masses", "bodies", "action"), holds)]),
        masses=not split.velocity,
    )
    if split.bodies and not run.turns:
        raise MethodError(f"{method.name} does not turn rigid bodies: use 'stoermer-verlet' or a composition")
    if split.velocity and any(x.argument.get(P) != {0: mp.one} for x in run.velocities):
        raise MethodError(
            f"{method.name} computes velocities M^-1 X of sums X other than momenta, for which H = T(p) + V(q, t) of "
            f"'{split.system.name}' has no constant masses: use a method of kicks and drifts"
        )
    for name, letter, what in (("q", "V", "velocities"), ("p", "F", "forces")):
        if {kind for kind, _ in run.values[name]} - {letter}:
            raise MethodError(f"the increment {name}[i] of {method.name} is not a sum of {what}")
    for name, remedy in {"q": "q[i] += h * v[i] with v[i] = velocity(P, t)", "p": "p[i] += h * F[i]"}.items():
        if not run.values[name] and (name == "q" or any(split.force)):
            raise MethodError(f"the statements of {method.name} leave the increment {name}[i] 0: add {remedy}")
    return _needed(run, {Q: {0: mp.one}, **run.values["q"]}, {P: {0: mp.one}, **run.values["p"]})


def _needed(run: Recurrence, q: Sum, p: Sum) -> _Step:
    """Return the forces and velocities that the end of a step depends on."""
    uses = [q, p]
    for use in uses:
        for kind, n in use:
            if kind in ("V", "F"):
                evaluations = run.velocities if kind == "V" else run.forces
                if all(evaluations[n].argument is not other for other in uses):
                    uses.append(evaluations[n].argument)
    powers = {
        (letter, power) for use in uses for letter, factors in use.items() if letter[0] == "V" for power in factors
    }
    forces = sorted({letter for use in uses for letter in use if letter[0] == "F"})
    return _Step(
        kicks=tuple((letter, run.forces[letter[1]]) for letter in forces),
        drifts=tuple(_Drift(letter, power, run.velocities[letter[1]]) for letter, power in sorted(powers)),
        q=q,
        p=p,
        action=run.values["S"],
        turns=run.turns,
    )


def _rotating_group(split: KineticSplitting, durations: Vector) -> StageGroup:
    """Return the drifts of systems with rigid bodies: exact flows of the kinetic energy T, of these durations.

    Drift j of duration d_j h begins at (q_j, P_j); the flow of T changes q by dq_j and u_j = d_j h P_j by du_j:

        q_j = q0 + h sum_{k < j} d_k V_k,
        row V_j:  0 = -(dq_j(q_j, u_j) - d_j h V_j)/(d_j h),
        row P_j:  0 = p0 + sum_{k < j} du_k/(d_k h) + kicks before drift j - u_j/(d_j h),
        p1 = p0 + sum_k du_k/(d_k h) + all kicks

    (splitting methods: Hairer, Lubich, Wanner, Geometric Numerical Integration, II.5).
    """
    drifts, q = range(len(durations)), split.system.coordinates
    components = range(split.system.dimension)
    u = tuple(symbol(f"turn_{i}") for i in components)
    dV = tuple(symbol(f"change_{i}") for i in components)  # d_j h V_j
    dq, du = split.flow(u)
    # Rows are drifts j. Columns of gathers are those of q0, V and P; columns of scatters the rows V, P and p1.
    zero_square, zero_column = Table.constant(len(drifts), len(drifts)), Table.constant(len(drifts), 1)
    earlier = Table.named("a", [[d if k < j else mp.zero for k, d in enumerate(durations)] for j in drifts])
    own = Table.named("gamma", _diagonal(durations))
    minus_inverse = Table.named("r", _diagonal([-1 / d for d in durations]))
    to_later_and_p1 = Table.named(
        "s", [[1 / d if k > j else mp.zero for k in range(len(drifts) + 1)] for j, d in enumerate(durations)]
    )
    return StageGroup(
        name="drift",
        abscissae=tuple(mp.fsum(durations[:j]) for j in drifts),
        gathers=(
            Gather(arguments=q, table=Table.joined(Table.constant(len(drifts), 1, 1), earlier, zero_square), power=0),
            Gather(arguments=u, table=Table.joined(zero_column, zero_square, own), power=0),
            Gather(arguments=dV, table=Table.joined(zero_column, own, zero_square), power=0),
        ),
        scatters=(
            Scatter(
                results=tuple(change - estimate for change, estimate in zip(dq, dV, strict=True)),
                table=Table.joined(minus_inverse, zero_square, zero_column),
                power=-1,
            ),
            Scatter(results=tuple(du), table=Table.joined(zero_square, to_later_and_p1), power=-1),
            Scatter(results=u, table=Table.joined(zero_square, minus_inverse, zero_column), power=-1),
        ),
        computes="Changes of q and u by the flow of the kinetic energy, less v, and u",
    )


def _diagonal(entries: Sequence[Number]) -> list[list[Number]]:
    return [[entry if k == j else mp.zero for k in range(len(entries))] for j, entry in enumerate(entries)]


def _kick_group(split: KineticSplitting, step: _Step) -> StageGroup:
    """Return the kicks: forces F_n = L_q at the positions u_n, which add to the momenta X_k of velocities and to p1.

        u_n = q0 + h sum_k a_nk V_k,    row k += h^r s_nk F_n,    p1 += h w_n F_n;

    s_nk of a composition is w_n for the drifts after the kick, which has the weight w_n then.
    """
    sums, letters, kicks = [*(drift.forces for drift in step.drifts), step.p], *zip(*step.kicks, strict=True)
    factors = [[use.get(letter, {}) for use in sums] for letter in letters]
    weights = [*map(_weight_of, factors)]
    divisors = tuple(weight or mp.one for weight in weights)
    # With rigid bodies gathers have further columns for the blocks P, and scatters for the rows V.
    zeros = Table.constant(len(kicks), len(step.drifts) if split.bodies else 0)
    positions = [[drift.factor(kick.argument) for drift in step.drifts] for kick in kicks]
    ones = Table.constant(len(kicks), 1, 1)
    scatters = []
    for power in sorted(set[int]().union(*chain(*factors))):
        table = [[x.get(power, mp.zero) / w for x in line] for w, line in zip(divisors, factors, strict=True)]
        momenta = Table.joined(zeros, Table.named("s", table))
        scatters.append(Scatter(results=split.force, table=momenta, power=power))
    acts, summed = _acts(split) and bool(step.action), _of_action(step, "L", [index for _, index in letters])
    return StageGroup(
        name="kick",
        abscissae=tuple(kick.time for kick in kicks),
        weights=divisors,
        weight_names=tuple(
            EntryName("w", kick.row) if weight else None for weight, kick in zip(weights, kicks, strict=True)
        ),
        gathers=(
            Gather(
                arguments=split.system.coordinates,
                table=Table.joined(ones, Table.named("a", positions), zeros),
                power=0,
            ),
        ),
        scatters=tuple(scatters),
        scalar=_potential_part(split.system) if acts else None,
        scalar_weights=summed if acts and summed != divisors else (),
        in_action=acts,
    )


def _weight_of(factors: Sequence[Mapping[int, Number]]) -> Number:
    """Return the one factor w of h with which a force enters p1 and all momenta that it enters, else 0."""
    weight = factors[-1].get(1, mp.zero)
    return weight if all(x in ({}, {1: weight}) for x in factors) else mp.zero


def _of_action(step: _Step, term: str, numbers: Iterable[int]) -> Vector:
    """Return the factors of h L at kicks, or of h T at drifts, in the action."""
    return tuple(step.action.get((term, number), {}).get(0, mp.zero) for number in numbers)


def _acts(split: KineticSplitting) -> bool:
    """Return whether the action of a step is a sum over kicks and drifts: with a potential and constant masses."""
    return not (split.velocity or split.bodies or split.system.auxiliaries or split.system.forces)


def _potential_part(system: MechanicalSystem) -> Expr:
    return system.lagrangian.xreplace(dict.fromkeys(system.velocities, S.Zero))


def _drift_group(split: KineticSplitting, step: _Step) -> StageGroup:
    """Return L_v at the velocity of each drift, which is its momentum."""
    system, acts, size = split.system, _acts(split) and bool(step.action), len(step.drifts)
    into = Table.joined(Table.constant(size, 1), Table.identity(size))
    back = Table.joined(Table.identity(size, -1), Table.constant(size, 1))
    return StageGroup(
        name="drift",
        abscissae=tuple(drift.momentum.time for drift in step.drifts),
        gathers=(Gather(arguments=system.velocities, table=into, power=-1),),
        scatters=(Scatter(results=forms_of(system).momentum, table=back, power=0),),
        scalar=system.lagrangian - _potential_part(system) if acts else None,
        scalar_weights=_of_action(step, "T", [drift.letter[1] for drift in step.drifts]) if acts else (),
        in_action=acts,
    )
