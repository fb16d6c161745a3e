"""Stage equations of leapfrog steps: kicks and drifts in turn, explicit for separable systems."""

from itertools import pairwise

from scvi_codegen.errors import MethodError
from scvi_codegen.mechanics.derived_expressions import forms_of
from scvi_codegen.mechanics.legendre import equivalent_lagrangian
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.method import Method
from scvi_codegen.methods.stage_system import Block, Gather, Row, Scatter, StageGroup, StageSystem, Table
from scvi_codegen.tables.basis import identity_matrix
from scvi_codegen.tables.precision import Vector, mp


def leapfrog_system(system: MechanicalSystem, method: Method) -> StageSystem:
    """Return the leapfrog steps of a method, one after the other; unknowns are the velocities V_k of the drifts.

    Raises:
        MethodError: for a system that is not separable.
    """
    twin = equivalent_lagrangian(system)
    if twin is not None and forms_of(twin).separable:
        system = twin
    elif not forms_of(system).split:
        raise MethodError(
            f"{method.name} requires a separable system, L = sum m_i v_i^2 / 2 - V(q, t) with "
            f"constant masses, or H = T(p) + V(q, t), without damping; '{system.name}' is not "
            "separable: use an SVI"
        )
    kicks, drifts = kicks_and_drifts(method)
    moving = [k for k, x in enumerate(drifts) if x]
    return StageSystem(
        blocks=tuple(Block(name=f"V_{k}", power=1, straight=(mp.zero, mp.one)) for k, _ in enumerate(moving, start=1)),
        rows=tuple(Row(number=f"V_{k}", kind="IDEL", momentum=mp.one) for k, _ in enumerate(moving, start=1)),
        stage_groups=(_kick_group(system, kicks, drifts), _drift_group(system, drifts)),
        end_position=Table.joined(Table.constant(1, 1, 1), Table.named("gamma", (tuple(drifts[k] for k in moving),))),
        end_momentum=mp.one,
        end_numbers=("q1", "p1"),
        extrapolation=identity_matrix(len(moving)),
    )


def _kick_group(system: MechanicalSystem, kicks: Vector, drifts: Vector) -> StageGroup:
    """Return L_q at the positions before, between and after the drifts, added to all later velocities (kicks)."""
    points, moving = ([k for k, x in enumerate(each) if x] for each in (kicks, drifts))
    drifted = tuple(tuple(drifts[k] if k < n else mp.zero for k in moving) for n in points)
    before = tuple(tuple(int(n <= k) for k in moving) for n in points)
    return StageGroup(
        name="kick",
        abscissae=tuple(mp.fsum(line) for line in drifted),
        weights=tuple(kicks[n] for n in points),
        weight_names=tuple(f"w_{n}" for n in points),
        gathers=(
            Gather(
                arguments=system.coordinates,
                table=Table.joined(Table.constant(len(points), 1, 1), Table.named("a", drifted)),
                power=0,
            ),
        ),
        scatters=(
            Scatter(
                results=forms_of(system).force,
                table=Table.joined(Table.named("", before), Table.constant(len(points), 1, 1)),
                power=1,
            ),
        ),
    )


def _drift_group(system: MechanicalSystem, drifts: Vector) -> StageGroup:
    """Return L_v at the velocity of each drift, which is its momentum."""
    moving = [k for k, x in enumerate(drifts) if x]
    size = len(moving)
    return StageGroup(
        name="drift",
        abscissae=tuple(mp.fsum(drifts[:k]) for k in moving),
        gathers=(
            Gather(
                arguments=system.velocities,
                table=Table.joined(Table.constant(size, 1), Table.identity(size)),
                power=-1,
            ),
        ),
        scatters=(
            Scatter(
                results=forms_of(system).momentum,
                table=Table.joined(Table.identity(size, -1), Table.constant(size, 1)),
                power=0,
            ),
        ),
    )


def kicks_and_drifts(method: Method) -> tuple[Vector, Vector]:
    """Return the weights of the kicks and of the drifts: kick 0, drift 0, kick 1, .., the last drift being 0.

    If drifts come first, kick 0 has weight 0.
    """
    padded = (mp.zero, *method.fractions, mp.zero)
    halves = tuple((a + b) / 2 for a, b in pairwise(padded))
    return ((mp.zero, *method.fractions), halves) if method.drifts_first else (halves, (*method.fractions, mp.zero))
