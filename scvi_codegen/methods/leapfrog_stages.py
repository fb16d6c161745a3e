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
    numbers = range(1, len(moving) + 1)
    momenta = len(moving) if split.bodies else 0
    return StageSystem(
        blocks=(
            *(Block(letter="V", index=k, straight=(mp.zero, mp.one)) for k in numbers),
            *(Block(letter="P", index=k, momentum=1, moves=False) for k in numbers[:momenta]),
        ),
        rows=(
            *(Row(number=f"V_{k}", kind="stage", momentum=mp.zero) for k in numbers[:momenta]),
            *(Row(number=f"{'P' if momenta else 'V'}_{k}", kind="IDEL", momentum=mp.one) for k in numbers),
        ),
        stage_groups=(*([_kick_group(split, kicks, drifts)] if any(split.force) else []), drift),
        end_position=Table.joined(Table.constant(1, 1, 1), Table.named("gamma", (moving,)), Table.constant(1, momenta)),
        end_momentum=mp.one,
        end_numbers=("q1", "p1"),
        extrapolation=identity_matrix(len(moving) + momenta),
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
    own = Table.named("gamma", [[d if k == j else mp.zero for k in drifts] for j, d in enumerate(durations)])
    minus_inverse = Table.named("r", [[-1 / d if k == j else mp.zero for k in drifts] for j, d in enumerate(durations)])
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


def _kick_group(split: KineticSplitting, kicks: Vector, drifts: Vector) -> StageGroup:
    """Return the kicks: forces F = L_q at the positions before, between and after the drifts, times w_n h.

    With the durations d_k h of the drifts, kick n of weight w_n precedes drift n,

        q_n = q0 + h sum_{k < n} d_k V_k,    row k += w_n h F(q_n) for k >= n,    p1 += w_n h F(q_n);

    row k determines the momentum before drift k. Kicks and drifts of weight 0 are left out.
    """
    kicking = [n for n, weight in enumerate(kicks) if weight]
    moving = [k for k, duration in enumerate(drifts) if duration]
    earlier_drifts = tuple(tuple(drifts[k] if k < n else mp.zero for k in moving) for n in kicking)
    later_rows = tuple(tuple(int(k >= n) for k in moving) for n in kicking)
    ones = Table.constant(len(kicking), 1, 1)
    # With rigid bodies gathers have further columns for the blocks P, and scatters for the rows V.
    zeros = Table.constant(len(kicking), len(moving) if split.bodies else 0)
    positions = Table.joined(ones, Table.named("a", earlier_drifts), zeros)
    momenta = Table.joined(zeros, Table.named("", later_rows), ones)
    return StageGroup(
        name="kick",
        abscissae=tuple(mp.fsum(durations) for durations in earlier_drifts),
        weights=tuple(kicks[n] for n in kicking),
        weight_names=tuple(EntryName("w", n) for n in kicking),
        gathers=(Gather(arguments=split.system.coordinates, table=positions, power=0),),
        scatters=(Scatter(results=split.force, table=momenta, power=1),),
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
