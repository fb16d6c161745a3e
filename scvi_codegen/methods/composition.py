"""Symmetric compositions of Stoermer-Verlet for separable systems: explicit, symplectic, of order 8 and 10.

A step of size h is s leapfrog steps of sizes gamma_1 h .. gamma_s h with sum gamma_k = 1, gamma_k = gamma_{s+1-k}:

    p += h (gamma_k + gamma_{k+1}) / 2 L_q(q),     q += h gamma_{k+1} M^-1 p,

that is kicks and drifts in turn. Source: Hairer, Lubich & Wanner, Geometric Numerical Integration, V.3.2; coefficients
of Kahan & Li, Math. Comp. 66 (1997), and Sofroniou & Spaletta, Optim. Methods Softw. 20 (2005).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

from scvi_codegen.errors import MethodError
from scvi_codegen.mechanics.derived_expressions import forms_of
from scvi_codegen.mechanics.hamiltonian import equivalent_lagrangian
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.exactness import Exactness
from scvi_codegen.methods.method import Method, Specification
from scvi_codegen.methods.stage_system import Block, Gather, Row, Scatter, StageGroup, StageSystem, Table
from scvi_codegen.representation import summary
from scvi_codegen.tables.basis import identity_matrix
from scvi_codegen.tables.precision import Vector, mp
from scvi_codegen.validation.counts import checked_count

__all__ = [
    "DRIFT_KICK_DRIFT",
    "KICK_DRIFT_KICK",
    "Composition",
    "check_sequence",
    "kicks_and_drifts",
    "leapfrog_system",
    "sequence_of",
]

KICK_DRIFT_KICK, DRIFT_KICK_DRIFT = "kick-drift-kick", "drift-kick-drift"
"""Sequences of a leapfrog step: forces at both ends, shared between steps, or forces in the middle."""

FIRST_HALVES = {
    2: (),
    8: (
        "0.13020248308889008087881763",
        "0.56116298177510838456196441",
        "-0.38947496264484728640807860",
        "0.15884190655515560089621075",
        "-0.39590389413323757733623154",
        "0.18453964097831570709183254",
        "0.25837438768632204729397911",
        "0.29501172360931029887096624",
    ),
    10: (
        "0.07879572252168641926390768",
        "0.31309610341510852776481247",
        "0.02791838323507806610952027",
        "-0.22959284159390709415121340",
        "0.13096206107716486317465686",
        "-0.26973340565451071434460973",
        "0.07497334315589143566613711",
        "0.11199342399981020488957508",
        "0.36613344954622675119314812",
        "-0.39910563013603589787862981",
        "0.10308739852747107731580277",
        "0.41143087395589023782070412",
        "-0.00486636058313526176219566",
        "-0.39203335370863990644808194",
        "0.05194250296244964703718290",
        "0.05066509075992449633587434",
        "0.04967437063972987905456880",
    ),
}
"""Coefficients gamma_1, gamma_2, .. before the middle one, which makes the sum 1; by order."""


def check_sequence(sequence: str) -> None:
    """Raise :class:`MethodError` for an unknown sequence."""
    if sequence not in (KICK_DRIFT_KICK, DRIFT_KICK_DRIFT):
        raise MethodError(f"sequence must be '{KICK_DRIFT_KICK}' or '{DRIFT_KICK_DRIFT}', not {sequence!r}")


def sequence_of(sequence: str) -> Specification:
    """Return the entry of a specification for a sequence; empty for the default."""
    return {} if sequence == KICK_DRIFT_KICK else {"sequence": sequence}


@dataclass(frozen=True, slots=True)
class Composition(Method):
    """Symmetric composition of Stoermer-Verlet steps, for L = sum m_i v_i^2 / 2 - V(q, t) with constant masses.

    Args:
        order: 2 (Stoermer-Verlet itself), 8 (17 stages, Kahan & Li) or 10 (35 stages, Sofroniou & Spaletta).
        sequence: of each step: ``"kick-drift-kick"`` or ``"drift-kick-drift"``.

    Raises:
        MethodError: for another order, or when used for a system that is not separable.
    """

    composition_order: int
    sequence: str = KICK_DRIFT_KICK

    __repr__ = summary("composition_order", "sequence")

    def __post_init__(self) -> None:
        check_sequence(self.sequence)
        order = checked_count(self.composition_order, "the order", least=2, error=MethodError)
        if order not in FIRST_HALVES:
            raise MethodError(f"order must be 2, 8 or 10, not {order}")
        object.__setattr__(self, "composition_order", order)

    @classmethod
    def of(cls, order: int, sequence: str = KICK_DRIFT_KICK) -> Composition:
        """Return the composition of an order."""
        return cls(order, sequence)

    @property
    def drifts_first(self) -> bool:
        """True if each leapfrog step begins with a drift."""
        return self.sequence == DRIFT_KICK_DRIFT

    @property
    def exactness(self) -> Exactness:
        """Exactness of Stoermer-Verlet, which composition preserves."""
        return Exactness(curve=1, quadrature=2, gauge=1)

    @property
    def implicit(self) -> bool:
        """Always false."""
        return False

    @property
    def fractions(self) -> Vector:
        """Fractions gamma_1 .. gamma_s of the step size, of shape (s,)."""
        half = tuple(mp.mpf(x) for x in FIRST_HALVES[self.composition_order])
        return (*half, 1 - 2 * mp.fsum(half), *reversed(half))

    @property
    def name(self) -> str:
        """Name ``composition-<order>[-<sequence>]``."""
        return f"composition-{self.composition_order}{f'-{self.sequence}' * self.drifts_first}"

    @property
    def title(self) -> str:
        """Display title."""
        stages = len(self.fractions)
        return f"Composition of {stages} Stoermer-Verlet step{'s' * (stages > 1)}, order {self.composition_order}"

    @property
    def order(self) -> int | None:
        """Order of the composition."""
        return self.composition_order

    @property
    def symmetric(self) -> bool:
        """Always true."""
        return True

    @property
    def symplectic(self) -> bool:
        """Always true."""
        return True

    def specification(self) -> Specification:
        """See :meth:`Method.specification`."""
        return {"method": "composition", "order": self.composition_order, **sequence_of(self.sequence)}

    def stage_system(self, system: MechanicalSystem) -> StageSystem:
        """Return the leapfrog equations; unknowns are the velocities V_k of the drifts, determined row after row."""
        return leapfrog_system(system, self)

    def paper_form(self, system: MechanicalSystem) -> StageSystem:
        """Return the same equations: the paper does not use the method."""
        return self.stage_system(system)


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
        weights=(mp.one,) * size,
        weight_names=("",) * size,
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
