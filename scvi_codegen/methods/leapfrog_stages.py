"""Stage equations of leapfrog steps: kicks and drifts in turn, explicit for separable systems."""

from itertools import pairwise

from sympy import Expr, S

from scvi_codegen.common.errors import MethodError
from scvi_codegen.common.precision import Vector, mp
from scvi_codegen.methods.method import Method
from scvi_codegen.methods.stage_system import Block, EntryName, Gather, Row, Scatter, StageGroup, StageSystem, Table
from scvi_codegen.methods.tables.basis import identity_matrix
from scvi_codegen.systems.derived_expressions import forms_of
from scvi_codegen.systems.formulas.symbols import symbol
from scvi_codegen.systems.splittings.kinetic import KineticSplitting, kinetic_splitting
from scvi_codegen.systems.system import MechanicalSystem


def leapfrog_system(system: MechanicalSystem, method: Method) -> StageSystem:
    """Return the leapfrog steps of a method, one after the other; unknowns are the velocities V_k of the drifts.

    With rotations V_k is the change of q in drift k divided by its duration, and the momenta P_k before the drifts are
    unknown, too.

    Raises:
        MethodError: for a system that is not separable.
    """
    split = kinetic_splitting(system)
    if isinstance(split, str):
        raise MethodError(
            f"{method.name} requires a separable system, L = sum m_i v_i^2 / 2 - V(q, t) with constant masses, "
            "H = T(p) + V(q, t), or rigid bodies with constant moments and products of inertia, "
            f"without damping; '{system.name}' is not separable, because {split}: use an SVI"
        )
    kicks, drifts = kicks_and_drifts(method, split)
    moving = tuple(x for x in drifts if x)
    drift = _rotating_group(split, moving) if split.bodies else _drift_group(split, drifts)
    numbers, more = range(1, len(moving) + 1), len(moving) if split.bodies else 0
    return StageSystem(
        blocks=(
            *(Block(letter="V", index=k, straight=(mp.zero, mp.one)) for k in numbers),
            *(Block(letter="P", index=k, momentum=1, moves=False) for k in numbers[:more]),
        ),
        rows=(
            *(Row(number=f"V_{k}", kind="stage", momentum=mp.zero) for k in numbers[:more]),
            *(Row(number=f"{'P' if more else 'V'}_{k}", kind="IDEL", momentum=mp.one) for k in numbers),
        ),
        stage_groups=(*([_kick_group(split, kicks, drifts)] if any(split.force) else []), drift),
        end_position=Table.joined(Table.constant(1, 1, 1), Table.named("gamma", (moving,)), Table.constant(1, more)),
        end_momentum=mp.one,
        end_numbers=("q1", "p1"),
        extrapolation=identity_matrix(len(moving) + more),
    )


def _rotating_group(split: KineticSplitting, moving: Vector) -> StageGroup:
    """Return the changes of q and of the momentum by the flow of the kinetic energy in each drift."""
    n, m, q = len(moving), range(split.system.dimension), split.system.coordinates
    none, last = Table.constant(n, n), Table.constant(n, 1)
    u, v = (tuple(symbol(f"{name}_{i}") for i in m) for name in ("turn", "change"))
    moved, turned = split.flow(u)
    places = Table.named("a", [[x * int(k < j) for k, x in enumerate(moving)] for j in range(n)])
    durations = Table.named("gamma", [[x * int(k == j) for k in range(n)] for j, x in enumerate(moving)])
    rates = Table.named("r", [[-int(k == j) / x for k in range(n)] for j, x in enumerate(moving)])
    later = Table.named("s", [[int(k > j) / x for k in range(n + 1)] for j, x in enumerate(moving)])
    return StageGroup(
        name="drift",
        abscissae=tuple(mp.fsum(moving[:k]) for k in range(n)),
        gathers=(
            Gather(arguments=q, table=Table.joined(Table.constant(n, 1, 1), places, none), power=0),
            Gather(arguments=u, table=Table.joined(last, none, durations), power=0),
            Gather(arguments=v, table=Table.joined(last, durations, none), power=0),
        ),
        scatters=(
            Scatter(
                results=tuple(x - y for x, y in zip(moved, v, strict=True)),
                table=Table.joined(rates, none, last),
                power=-1,
            ),
            Scatter(results=tuple(turned), table=Table.joined(none, later), power=-1),
            Scatter(results=u, table=Table.joined(none, rates, last), power=-1),
        ),
        computes="Changes of q and u by the flow of the kinetic energy, less v, and u",
    )


def _kick_group(split: KineticSplitting, kicks: Vector, drifts: Vector) -> StageGroup:
    """Return L_q at the positions before, between and after the drifts, added to all later velocities (kicks)."""
    points, moving = ([k for k, x in enumerate(coefficients) if x] for coefficients in (kicks, drifts))
    drifted = tuple(tuple(drifts[k] if k < n else mp.zero for k in moving) for n in points)
    before = tuple(tuple(int(n <= k) for k in moving) for n in points)
    every = Table.constant(len(points), 1, 1)
    none = Table.constant(len(points), len(moving) if split.bodies else 0)
    places = Table.joined(every, Table.named("a", drifted), none)
    later = Table.joined(none, Table.named("", before), every)
    return StageGroup(
        name="kick",
        abscissae=tuple(mp.fsum(line) for line in drifted),
        weights=tuple(kicks[n] for n in points),
        weight_names=tuple(EntryName("w", n) for n in points),
        gathers=(Gather(arguments=split.system.coordinates, table=places, power=0),),
        scatters=(Scatter(results=split.force, table=later, power=1),),
        scalar=_potential_part(split.system) if _acts(split) else None,
        in_action=_acts(split),
    )


def _acts(split: KineticSplitting) -> bool:
    """Return whether the action of a step is a sum over kicks and drifts: with a potential and constant masses."""
    return not (split.velocity or split.bodies or split.system.auxiliaries or split.system.forces)


def _potential_part(system: MechanicalSystem) -> Expr:
    return system.lagrangian.xreplace(dict.fromkeys(system.velocities, S.Zero))


def _drift_group(split: KineticSplitting, drifts: Vector) -> StageGroup:
    """Return L_v at the velocity of each drift, which is its momentum."""
    system, acts = split.system, _acts(split)
    moving = [k for k, x in enumerate(drifts) if x]
    size = len(moving)
    into = Table.joined(Table.constant(size, 1), Table.identity(size))
    back = Table.joined(Table.identity(size, -1), Table.constant(size, 1))
    return StageGroup(
        name="drift",
        abscissae=tuple(mp.fsum(drifts[:k]) for k in moving),
        gathers=(Gather(arguments=system.velocities, table=into, power=-1),),
        scatters=(Scatter(results=forms_of(system).momentum, table=back, power=0),),
        scalar=system.lagrangian - _potential_part(system) if acts else None,
        scalar_weights=tuple(drifts[k] for k in moving) if acts else (),
        in_action=acts,
    )


def kicks_and_drifts(method: Method, split: KineticSplitting | None = None) -> tuple[Vector, Vector]:
    """Return the weights of the kicks and of the drifts: kick 0, drift 0, kick 1, .., the last drift being 0.

    If drifts come first, kick 0 has weight 0. The step of free rigid bodies is one drift, which is exact.
    """
    if split and split.bodies and not any(split.force):
        return (mp.zero, mp.zero), (mp.one, mp.zero)
    padded = (mp.zero, *method.fractions, mp.zero)
    halves = tuple((a + b) / 2 for a, b in pairwise(padded))
    return ((mp.zero, *method.fractions), halves) if method.drifts_first else (halves, (*method.fractions, mp.zero))
