"""Spectral collocation (SC), (10)-(21), in position form (q, v) and in phase space (q, p).

At the nodes x_1 .. x_s it is the collocation Runge-Kutta method (22)-(23) on the abscissae c_i = (x_i + 1)/2, and is
compiled as such (:mod:`scvi_codegen.methods.runge_kutta`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.method import NodalMethod, Specification, degree_count, resolve_nodes
from scvi_codegen.methods.runge_kutta import RungeKutta, TableauMethod, check_form
from scvi_codegen.representation import summary
from scvi_codegen.tables import tableau as tableaux
from scvi_codegen.tables.nodes import Nodes
from scvi_codegen.tables.tableau import Tableau

if TYPE_CHECKING:
    from scvi_codegen.display.number_tables import Part
    from scvi_codegen.methods.stage_system import StageSystem


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
