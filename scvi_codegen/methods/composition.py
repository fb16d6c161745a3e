"""Stoermer-Verlet, and its symmetric compositions for separable systems: explicit, symplectic, of order 4 to 10.

A step of size h is s leapfrog steps of sizes gamma_1 h .. gamma_s h with sum gamma_k = 1, gamma_k = gamma_{s+1-k}:

    p += h (gamma_k + gamma_{k+1}) / 2 L_q(q),     q += h gamma_{k+1} M^-1 p,

that is kicks and drifts in turn. Source: Hairer, Lubich & Wanner, Geometric Numerical Integration, V.3.2; coefficients
of Suzuki, Phys. Lett. A 146 (1990), Kahan & Li, Math. Comp. 66 (1997), and Sofroniou & Spaletta, Optim. Methods Softw.
20 (2005).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, ClassVar

from scvi_codegen.common.errors import MethodError
from scvi_codegen.common.precision import Vector, mp
from scvi_codegen.common.representation import counted, summary
from scvi_codegen.common.toml_text import package_table
from scvi_codegen.common.validation import checked_count
from scvi_codegen.methods.method import Exactness, Method, Specification
from scvi_codegen.methods.recurrence import ExplicitStep
from scvi_codegen.methods.tables.tableau import lobatto_iiia
from scvi_codegen.systems.system import MechanicalSystem

if TYPE_CHECKING:
    from scvi_codegen.methods.stage_system import StageSystem
    from scvi_codegen.methods.tables.number_tables import Part
    from scvi_codegen.systems.splittings.kinetic import KineticSplitting

KICK_DRIFT_KICK, DRIFT_KICK_DRIFT = "kick-drift-kick", "drift-kick-drift"
"""Sequences of a leapfrog step: forces at both ends, shared between steps, or forces in the middle."""

FIRST_HALVES: dict[int, tuple[str, ...]] = {
    int(order): tuple(gammas) for order, gammas in package_table("methods/compositions.toml").items()
}
"""Coefficients gamma_1, gamma_2, .. before the middle one, which makes the sum 1; by order."""


SPLITTING = """
for n in LEAPS:
    if KICK[n] != 0:
        if n > 0 or not known:
            u[i] = q0[i] + q[i]
            F[i] = force(u, t + KICK_ABSCISSA[n] * h)
            if action:
                L = at_rest(u, t + KICK_ABSCISSA[n] * h)
        p[i] += h * KICK[n] * F[i]
        if action:
            S += KICK[n] * L
    if DRIFT[n] != 0:
        P[i] = p0[i] + p[i]
    if DRIFT[n] != 0:
        if masses:
            q[i] += h * DRIFT[n] * inverse_mass[i] * P[i]
        else:
            v[i] = velocity(P, t)
            q[i] += h * DRIFT[n] * v[i]
        if action:
            S += DRIFT[n] / 2 * inverse_mass[i] * P[i] * P[i]
        if bodies:
            turn(P)
"""
"""Kicks and drifts (Hairer, Lubich & Wanner, Geometric Numerical Integration, sec. II.5), with the increments q and p
of positions and momenta. S is the action divided by h, the sum of the Lagrangian L at rest and the kinetic energies.
Rigid bodies are turned by the flow of their kinetic energy in the time of a drift. Momenta P have a condition, and so a
loop, of their own: of two coordinates gcc makes faster code of two loops (.9 of the time of one)."""


class _Leapfrogs(Method):
    """Leapfrog steps, one or several in turn; ``sequence`` determines with what each begins."""

    __slots__ = ()
    sequence: str
    composition_order: int

    def __post_init__(self) -> None:
        if self.sequence not in (KICK_DRIFT_KICK, DRIFT_KICK_DRIFT):
            raise MethodError(f"sequence must be '{KICK_DRIFT_KICK}' or '{DRIFT_KICK_DRIFT}', not {self.sequence!r}")

    @property
    def _named_sequence(self) -> dict[str, str]:
        """Entry of the specification for the sequence; empty for the default."""
        return {} if self.sequence == KICK_DRIFT_KICK else {"sequence": self.sequence}

    @property
    def drifts_first(self) -> bool:
        """True if each leapfrog step begins with a drift."""
        return self.sequence == DRIFT_KICK_DRIFT

    @property
    def fractions(self) -> Vector:
        """Fractions gamma_1 .. gamma_s of the step size, of shape (s,)."""
        half = tuple(mp.mpf(x) for x in FIRST_HALVES[self.composition_order])
        return (*half, 1 - 2 * mp.fsum(half), *reversed(half))

    @property
    def order(self) -> int | None:
        """Order of the composition, 2 for a single leapfrog step."""
        return self.composition_order

    symmetric = symplectic = True

    @property
    def exactness(self) -> Exactness:
        """Exactness of straight lines, which composition preserves; f may be linear in q."""
        return Exactness(curve=1, quadrature=2, gauge=1)

    @property
    def kicks_and_drifts(self) -> tuple[Vector, Vector]:
        """Weights of the kicks and of the drifts: kick 0, drift 0, kick 1, .., the last drift being 0.

        If drifts come first, kick 0 has weight 0.
        """
        halves = tuple((a + b) / 2 for a, b in pairwise((mp.zero, *self.fractions, mp.zero)))
        return ((mp.zero, *self.fractions), halves) if self.drifts_first else (halves, (*self.fractions, mp.zero))

    def explicit_step(self, split: KineticSplitting) -> ExplicitStep:
        """Return kicks and drifts in turn; the step of free rigid bodies is one drift, which is exact."""
        kicks, drifts = self.kicks_and_drifts
        if split.bodies and not any(split.force):
            kicks, drifts = (mp.zero, mp.zero), (mp.one, mp.zero)
        abscissae = tuple(mp.fsum(drifts[:n]) for n in range(len(kicks)))
        return ExplicitStep.of(SPLITTING, {"LEAPS": {"KICK": kicks, "DRIFT": drifts, "KICK_ABSCISSA": abscissae}})

    def stage_system(self, system: MechanicalSystem) -> StageSystem:
        """Return the leapfrog equations; unknowns are the velocities V_k of the drifts, determined row after row."""
        from scvi_codegen.methods.explicit_stages import explicit_system

        return explicit_system(system, self)


@dataclass(frozen=True, slots=True)
class Composition(_Leapfrogs):
    """Symmetric composition of Stoermer-Verlet steps, for L = sum m_i v_i^2 / 2 - V(q, t) with constant masses.

    Args:
        order: 2 (Stoermer-Verlet itself), 4 (5 stages, Suzuki), 6 and 8 (9 and 17, Kahan & Li) or 10 (35, Sofroniou &
            Spaletta).
        sequence: of each step: ``"kick-drift-kick"`` or ``"drift-kick-drift"``.

    Raises:
        MethodError: for another order, or when used for a system that is not separable.
    """

    composition_order: int
    sequence: str = KICK_DRIFT_KICK

    implicit = False
    __repr__ = summary("composition_order", "sequence")

    def __post_init__(self) -> None:
        _Leapfrogs.__post_init__(self)
        order = checked_count(self.composition_order, "the order", least=2, error=MethodError)
        if order not in FIRST_HALVES:
            raise MethodError(f"order must be 2, 4, 6, 8 or 10, not {order}")
        object.__setattr__(self, "composition_order", order)

    @classmethod
    def of(cls, order: int, sequence: str = KICK_DRIFT_KICK) -> Composition:
        """Return the composition of an order."""
        return cls(order, sequence)

    @property
    def name(self) -> str:
        """Name ``composition-<order>[-<sequence>]``."""
        return "-".join(["composition", str(self.composition_order), *self._named_sequence.values()])

    @property
    def title(self) -> str:
        """Display title."""
        stages = len(self.fractions)
        return f"Composition of {counted(stages, 'Stoermer-Verlet step')}, order {self.composition_order}"

    def specification(self) -> Specification:
        """See :meth:`Method.specification`."""
        return {"method": "composition", "order": self.composition_order, **self._named_sequence}


@dataclass(frozen=True, slots=True)
class StoermerVerlet(_Leapfrogs):
    """Stoermer-Verlet: the two-stage Lobatto IIIA-IIIB pair, order 2, symplectic, symmetric.

    For L = v^T M v / 2 - V(q, t) with constant M it is the leapfrog scheme, and the SVI of degree 1 with the
    trapezoidal rule; for H = T(p) + V(q, t) it is explicit, too; for other systems it is implicit. Source: Hairer,
    Lubich & Wanner, Geometric Numerical Integration, II.2. For rigid bodies it is explicit, too, with their free
    rotation in place of the drift.

    Args:
        sequence: ``"kick-drift-kick"``, or ``"drift-kick-drift"``: for separable systems only, with forces at the
            middle of steps.
    """

    composition_order: ClassVar[int] = 2  # type: ignore[misc]
    sequence: str = KICK_DRIFT_KICK

    @property
    def name(self) -> str:
        """Name ``stoermer-verlet[-<sequence>]``."""
        return "-".join(["stoermer-verlet", *self._named_sequence.values()])

    @property
    def title(self) -> str:
        """Display title."""
        steps = "drift, kick, drift" if self.drifts_first else "Lobatto IIIA-IIIB pair of two stages"
        return f"Stoermer-Verlet ({steps})"

    @property
    def parts(self) -> tuple[Part, ...]:
        """Tableau of the positions."""
        return (lobatto_iiia(2),)

    def specification(self) -> Specification:
        """See :meth:`Method.specification`."""
        return {"method": "stoermer-verlet", **self._named_sequence}

    def stage_system(self, system: MechanicalSystem) -> StageSystem:
        """Return the pair by its generating function, unknowns V_1, V_2; explicit sequences as leapfrog equations."""
        from scvi_codegen.methods.galerkin_stages import symplectic_system
        from scvi_codegen.systems.splittings.kinetic import kinetic_splitting

        if self.drifts_first or (system.rotations and not isinstance(kinetic_splitting(system), str)):
            return _Leapfrogs.stage_system(self, system)
        return symplectic_system(system, lobatto_iiia(2))
