"""Runge-Kutta methods, (22)-(23), in phase space (q, p) and in position-velocity form (q, v).

Spectral collocation (SC), (10)-(21), at the nodes x_1 .. x_s is the collocation Runge-Kutta method (22)-(23) on the
abscissae c_i = (x_i + 1)/2, so the compiled form of both is a tableau (A, b, c). On Hamilton's equations, with stage
velocities V_i as unknowns,

    q_i = q0 + h sum_j a_ij V_j,     L_v(q_i, V_i) = p0 + h sum_j a_ij L_q(q_j, V_j),                   (22), (21)

and on (q, v), with v0 and z_i = h (acceleration at c_i) as unknowns,

    V_i = v0 + sum_j a_ij z_j,       q_i = q0 + h sum_j a_ij V_j,       E(q_i, V_i, z_i / h, t_i) = 0,    (18)

where E is the Euler-Lagrange residual. If the mass is not constant these are two different maps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from scvi_codegen.common.errors import MethodError
from scvi_codegen.common.representation import counted, summary
from scvi_codegen.common.validation import NUMBERS, check_kind, checks_arguments, of
from scvi_codegen.methods.method import Exactness, Method, NodalMethod, Specification, degree_count, resolve_nodes
from scvi_codegen.methods.tables import tableau as tableaux
from scvi_codegen.methods.tables.nodes import Nodes
from scvi_codegen.methods.tables.tableau import Tableau
from scvi_codegen.systems.system import MechanicalSystem

if TYPE_CHECKING:
    from scvi_codegen.methods.stage_system import StageSystem
    from scvi_codegen.methods.tables.number_tables import Part

FORMS = ("phase-space", "position")


class TableauMethod(Method):
    """Method whose properties are those of a Runge-Kutta tableau, in one of two forms."""

    __slots__ = ()
    tableau: Tableau
    form: str

    @property
    def order(self) -> int | None:
        """Order by the simplifying conditions of the tableau."""
        return self.tableau.order

    @property
    def symmetric(self) -> bool:
        """True if the tableau is symmetric."""
        return self.tableau.is_symmetric

    @property
    def symplectic(self) -> bool:
        """True if the tableau is symplectic and the form phase space; in position form p is not an unknown."""
        return self.form == "phase-space" and self.tableau.is_symplectic

    @property
    def needs_regular(self) -> bool:
        """True if the form is position, which requires a regular Lagrangian."""
        return self.form == "position"


@dataclass(frozen=True, slots=True)
class RungeKutta(TableauMethod):
    """Runge-Kutta method on Hamilton's equations (``form="phase-space"``) or on (q, v) (``form="position"``).

    Args:
        tableau: (A, b, c); its order, symmetry and symplecticity are computed from the coefficients (paper, Table 4).
        form: ``"phase-space"`` or ``"position"``; symplectic tableaux are symplectic in phase space only (and for
            constant mass).
    """

    tableau: Tableau
    form: str = "phase-space"

    __repr__ = summary("tableau", "form")

    def __post_init__(self) -> None:
        check_kind(of("a tableau", Tableau), self.tableau, "tableau", MethodError)
        check_form(self.form)

    @property
    def name(self) -> str:
        """Name ``<tableau>`` or ``<tableau>-position``."""
        base = self.tableau.name.replace(":", "-")
        return base if self.form == "phase-space" else f"{base}-position"

    @property
    def title(self) -> str:
        """Display title."""
        return f"Runge-Kutta {self.tableau.name}, {counted(self.tableau.stages, 'stage')}, {self.form} form"

    @property
    def exactness(self) -> Exactness:
        """Exactness in phase space: linear maps, quadratic ones if symplectic; Gauss methods are variational."""
        if self.form == "position":
            return Exactness()
        stages = len(self.tableau.b)
        gauss = self.symplectic and self.tableau.order == 2 * stages
        curve, quadrature = (stages, 2 * stages) if gauss else (-1, -1)
        return Exactness(polynomials=2 if self.symplectic else 1, curve=curve, quadrature=quadrature)

    @property
    def parts(self) -> tuple[Part, ...]:
        """Tableau."""
        return (self.tableau,)

    def specification(self) -> Specification:
        """See :meth:`Method.specification`."""
        family, _, stages = self.tableau.name.partition(":")
        if family in TABLEAU_METHODS:
            return {"method": family, "stages": int(stages), "form": self.form}
        if family == "explicit-euler":
            return {"method": family, "form": self.form}
        return {"method": "collocation", "abscissae": [float(c) for c in self.tableau.c], "form": self.form}

    def stage_system(self, system: MechanicalSystem) -> StageSystem:
        """Return stage equations: from a generating function for symplectic tableaux, otherwise (22)."""
        from scvi_codegen.methods.galerkin_stages import symplectic_system

        return symplectic_system(system, self.tableau) if self.symplectic else self.paper_form(system)

    def paper_form(self, system: MechanicalSystem) -> StageSystem:
        """Return the stage equations (22)-(23)."""
        from scvi_codegen.methods.acceleration_stages import position_system
        from scvi_codegen.methods.galerkin_stages import phase_space_system

        return (position_system if self.form == "position" else phase_space_system)(system, self.tableau)


def check_form(form: str) -> None:
    """Raise :class:`MethodError` for an unknown form."""
    if form not in FORMS:
        raise MethodError(f"form must be 'phase-space' or 'position', not {form!r}")


@checks_arguments(MethodError, abscissae=NUMBERS)
def CollocationRK(abscissae: Sequence[float], *, form: str = "phase-space") -> RungeKutta:
    """Return the collocation Runge-Kutta method (22)-(23) on distinct abscissae c_1 < .. < c_s, usually in [0, 1]."""
    return RungeKutta(tableaux.collocation_tableau(tuple(abscissae)), form)


def Gauss(stages: int, *, form: str = "phase-space") -> RungeKutta:
    """Return the Gauss collocation method: order 2 stages, symplectic, symmetric, A-stable (paper, Tables 1-3)."""
    return RungeKutta(tableaux.gauss(stages), form)


def RadauIIA(stages: int, *, form: str = "phase-space") -> RungeKutta:
    """Return the Radau IIA collocation method: order 2 stages - 1, A-stable, stiffly accurate."""
    return RungeKutta(tableaux.radau_iia(stages), form)


def RadauIA(stages: int, *, form: str = "phase-space") -> RungeKutta:
    """Return the Radau IA method: order 2 stages - 1, A-stable; not a collocation method."""
    return RungeKutta(tableaux.radau_ia(stages), form)


def LobattoIIIA(stages: int, *, form: str = "phase-space") -> RungeKutta:
    """Return the Lobatto IIIA collocation method: order 2 stages - 2, symmetric, A-stable."""
    return RungeKutta(tableaux.lobatto_iiia(stages), form)


def ChebyshevGauss(stages: int, *, form: str = "phase-space") -> RungeKutta:
    """Return collocation at the Chebyshev points of the first kind: order s (even s) or s + 1 (odd s), symmetric."""
    return RungeKutta(tableaux.chebyshev_gauss(stages), form)


def ChebyshevLobatto(stages: int, *, form: str = "phase-space") -> RungeKutta:
    """Return collocation at the Chebyshev-Lobatto points: order s (even s) or s + 1 (odd s), symmetric."""
    return RungeKutta(tableaux.chebyshev_lobatto(stages), form)


def ExplicitEuler(*, form: str = "phase-space") -> RungeKutta:
    """Return explicit Euler: order 1, neither symplectic nor symmetric; a baseline."""
    return RungeKutta(tableaux.explicit_euler(), form)


TABLEAU_METHODS: dict[str, Callable[..., RungeKutta]] = {
    "gauss": Gauss,
    "radau-iia": RadauIIA,
    "radau-ia": RadauIA,
    "lobatto-iiia": LobattoIIIA,
    "chebyshev-gauss": ChebyshevGauss,
    "chebyshev-lobatto": ChebyshevLobatto,
}
"""Constructors of Runge-Kutta methods by the name of their tableau; each takes ``stages`` and ``form``."""


@dataclass(frozen=True, slots=True)
class SpectralCollocation(TableauMethod, NodalMethod):
    """Spectral collocation (SC): (18) in position form, (21) in phase space. Neither symplectic nor reversible.

    Args:
        degree: degree s of the collocation polynomial; equations are imposed at nodes 1 .. s, not at node 0.
        nodes: of that degree, containing both ends; default Chebyshev-Lobatto.
        form: ``"position"`` collocates the Euler-Lagrange equations, ``"phase-space"`` Hamilton's equations.
    """

    degree: int
    nodes: Nodes | str | None = None
    form: str = "position"

    __repr__ = summary("degree")

    def __post_init__(self) -> None:
        object.__setattr__(self, "degree", degree_count(self.degree, "the degree of spectral collocation"))
        check_form(self.form)
        object.__setattr__(self, "nodes", resolve_nodes(self.nodes, self.degree))

    @property
    def tableau(self) -> Tableau:  # type: ignore[override]  # a property in place of a field
        """Equivalent collocation Runge-Kutta tableau (23), on the nodes 1 .. s."""
        return tableaux.collocation_tableau(self.node_set.abscissae[1:])

    @property
    def name(self) -> str:
        """Name ``sc-<degree>-<nodes>[-phase-space]``."""
        return f"sc-{self.degree}-{self.node_set.name}" + ("-phase-space" if self.form == "phase-space" else "")

    @property
    def title(self) -> str:
        """Display title."""
        return f"Spectral collocation, degree {self.degree}, {self.node_set.name} nodes, {self.form} form"

    @property
    def parts(self) -> tuple[Part, ...]:
        """Nodes; in phase space also the tableau in which the equations are written."""
        return (self.node_set,) if self.form == "position" else (self.node_set, self.tableau)

    def specification(self) -> Specification:
        """See :meth:`Method.specification`."""
        return {"method": "sc", "degree": self.degree, "nodes": self.node_set.name, "form": self.form}

    def stage_system(self, system: MechanicalSystem) -> StageSystem:
        """Return the equivalent Runge-Kutta stage equations."""
        return RungeKutta(self.tableau, self.form).paper_form(system)

    def paper_form(self, system: MechanicalSystem) -> StageSystem:
        """Return (18) with unknowns Q^1 .. Q^s and v0, or (21) with the stage velocities V_i as unknowns for H_p."""
        if self.form == "phase-space":
            return self.stage_system(system)
        from scvi_codegen.methods.acceleration_stages import nodal_collocation

        return nodal_collocation(system, self.node_set)
