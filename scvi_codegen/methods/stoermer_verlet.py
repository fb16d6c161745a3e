"""Stoermer-Verlet method as an implicit pair, explicit for separable systems."""

from __future__ import annotations

from dataclasses import dataclass

from scvi_codegen.display.number_tables import Part
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.composition import (
    DRIFT_KICK_DRIFT,
    KICK_DRIFT_KICK,
    check_sequence,
    leapfrog_system,
    sequence_of,
)
from scvi_codegen.methods.exactness import Exactness
from scvi_codegen.methods.galerkin_stages import galerkin_system
from scvi_codegen.methods.method import Method, Specification
from scvi_codegen.methods.stage_system import (
    StageSystem,
)
from scvi_codegen.tables.basis import (
    extrapolation,
    identity_matrix,
)
from scvi_codegen.tables.precision import Vector, mp
from scvi_codegen.tables.tableau import lobatto_iiia

__all__ = ["StoermerVerlet"]


@dataclass(frozen=True, slots=True)
class StoermerVerlet(Method):
    """Stoermer-Verlet: the two-stage Lobatto IIIA-IIIB pair, order 2, symplectic, symmetric.

    For L = v^T M v / 2 - V(q, t) with constant M it is the leapfrog scheme, and the SVI of degree 1 with the
    trapezoidal rule; for H = T(p) + V(q, t) it is explicit, too; for other systems it is implicit. Source: Hairer,
    Lubich & Wanner, Geometric Numerical Integration, II.2.

    Args:
        sequence: ``"kick-drift-kick"``, or ``"drift-kick-drift"``: for separable systems only, with forces at the
            middle of steps.
    """

    sequence: str = KICK_DRIFT_KICK

    def __post_init__(self) -> None:
        check_sequence(self.sequence)

    @property
    def drifts_first(self) -> bool:
        """True if a step begins with a drift."""
        return self.sequence == DRIFT_KICK_DRIFT

    @property
    def name(self) -> str:
        """Name ``stoermer-verlet[-<sequence>]``."""
        return f"stoermer-verlet{f'-{self.sequence}' * self.drifts_first}"

    @property
    def title(self) -> str:
        """Display title."""
        if self.drifts_first:
            return "Stoermer-Verlet (drift, kick, drift)"
        return "Stoermer-Verlet (Lobatto IIIA-IIIB pair of two stages)"

    @property
    def order(self) -> int | None:
        """Order 2."""
        return 2

    @property
    def symmetric(self) -> bool:
        """Always true."""
        return True

    @property
    def symplectic(self) -> bool:
        """Always true."""
        return True

    @property
    def exactness(self) -> Exactness:
        """Exactness of straight lines; f may be linear in q."""
        return Exactness(curve=1, quadrature=2, gauge=1)

    @property
    def fractions(self) -> Vector:
        """Fractions of a single leapfrog step: 1."""
        return (mp.one,)

    @property
    def parts(self) -> tuple[Part, ...]:
        """Tableau of the positions."""
        return (lobatto_iiia(2),)

    def specification(self) -> Specification:
        """See :meth:`Method.specification`."""
        return {"method": "stoermer-verlet", **sequence_of(self.sequence)}

    def stage_system(self, system: MechanicalSystem) -> StageSystem:
        """Return the pair by its generating function, unknowns V_1, V_2; drift-kick-drift as leapfrog equations."""
        if self.drifts_first:
            return leapfrog_system(system, self)
        tableau = lobatto_iiia(2)
        return galerkin_system(
            system,
            abscissae=tableau.c,
            weights=tableau.b,
            position=tableau.A,
            velocity=identity_matrix(2),
            end_position=tableau.b,
            extrapolation=extrapolation(tableau.c, 1),
        )

    def paper_form(self, system: MechanicalSystem) -> StageSystem:
        """Return the same equations: the paper uses the method without printing it."""
        return self.stage_system(system)
