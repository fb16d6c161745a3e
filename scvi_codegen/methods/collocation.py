"""Spectral collocation (SC), (10)-(21), in position form (q, v) and in phase space (q, p).

At the nodes x_1 .. x_s it is the collocation Runge-Kutta method (22)-(23) on the abscissae c_i = (x_i + 1)/2, and is
compiled as such (:mod:`scvi_codegen.methods.runge_kutta`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from fractions import Fraction

from scvi_codegen.display.number_tables import Part
from scvi_codegen.mechanics.derived_expressions import accelerations, forms_of
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.acceleration_stages import VELOCITY_BLOCK, position_system, residual_group, single_point
from scvi_codegen.methods.arguments import resolve_nodes
from scvi_codegen.methods.galerkin_stages import position_block
from scvi_codegen.methods.method import Method, Specification, degree_count
from scvi_codegen.methods.runge_kutta import check_form, phase_space_system
from scvi_codegen.methods.stage_system import (
    Block,
    Gather,
    Row,
    Scatter,
    StageSystem,
    Table,
)
from scvi_codegen.representation import summary
from scvi_codegen.tables import tableau as tableaux
from scvi_codegen.tables.basis import (
    differentiation_matrix,
    matrix_product,
)
from scvi_codegen.tables.nodes import Nodes
from scvi_codegen.tables.precision import mp
from scvi_codegen.tables.tableau import Tableau

__all__ = ["SpectralCollocation", "nodal_blocks", "nodal_gathers"]


@dataclass(frozen=True, slots=True)
class SpectralCollocation(Method):
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
    def node_set(self) -> Nodes:
        """Collocation nodes."""
        assert isinstance(self.nodes, Nodes)
        return self.nodes

    @property
    def tableau(self) -> Tableau:
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
    def order(self) -> int | None:
        """Order of the equivalent tableau."""
        return self.tableau.order

    @property
    def symmetric(self) -> bool:
        """True if the equivalent tableau is symmetric."""
        return self.tableau.is_symmetric

    @property
    def symplectic(self) -> bool:
        """True if the form is phase space and the equivalent tableau symplectic."""
        return self.form == "phase-space" and self.tableau.is_symplectic

    @property
    def needs_regular(self) -> bool:
        """True if the form is position, which requires a regular Lagrangian."""
        return self.form == "position"

    @property
    def parts(self) -> tuple[Part, ...]:
        """Nodes; in phase space also the tableau in which the equations are written."""
        return (self.node_set,) if self.form == "position" else (self.node_set, self.tableau)

    def specification(self) -> Specification:
        """See :meth:`Method.specification`."""
        return {"method": "sc", "degree": self.degree, "nodes": self.node_set.name, "form": self.form}

    def stage_system(self, system: MechanicalSystem) -> StageSystem:
        """Return the equivalent Runge-Kutta stage equations."""
        return (position_system if self.form == "position" else phase_space_system)(system, self.tableau)

    def paper_form(self, system: MechanicalSystem) -> StageSystem:
        """Return (18) with unknowns Q^1 .. Q^s and v0, or (21) with the stage velocities V_i as unknowns for H_p."""
        if self.form == "position":
            return nodal_collocation(system, self.node_set)
        return phase_space_system(system, self.tableau)


def nodal_collocation(system: MechanicalSystem, nodes: Nodes) -> StageSystem:
    """Return (18) as printed: unknowns Q^1 .. Q^s and v0; v0 from p0, p1 from v1 = V_s by the Legendre transform."""
    size = nodes.degree
    momenta = forms_of(system).momentum
    none, last = Table.constant(size, size + 1), Table.named("", [[int(n == size - 1)] for n in range(size)])
    group = residual_group(
        system,
        nodes.abscissae[1:],
        nodal_gathers(system, nodes),
        Scatter(results=(), table=Table.joined(Table.identity(size), Table.constant(size, 2)), power=0),
        Scatter(results=momenta, table=Table.joined(none, last), power=0),
    )
    start = single_point(
        system,
        "start",
        mp.zero,
        Table.joined(Table.constant(1, 1, 1), Table.constant(1, size + 1)),
        velocity_block=size,
    )
    start_table = Table.joined(Table.constant(1, size), Table.constant(1, 1, -1), Table.constant(1, 1))
    return StageSystem(
        blocks=nodal_blocks(nodes),
        rows=(
            *(Row(number="18", kind="stage", momentum=mp.zero) for _ in range(size)),
            Row(number="p0", kind="Legendre", momentum=mp.one),
        ),
        stage_groups=(group, replace(start, scatters=(Scatter(results=momenta, table=start_table, power=0),))),
        end_position=Table.joined(Table.constant(1, size), Table.constant(1, 1, 1), Table.constant(1, 1)),
        end_momentum=mp.zero,
        end_numbers=("15", "p1"),
    )


def nodal_blocks(nodes: Nodes) -> tuple[Block, ...]:
    """Return the blocks Q^1 .. Q^s and v0."""
    return (*(position_block(v, nodes) for v in range(1, nodes.degree + 1)), VELOCITY_BLOCK)


def nodal_gathers(system: MechanicalSystem, nodes: Nodes, *, other_blocks: int = 0) -> tuple[Gather, Gather, Gather]:
    """Return Q^i, V_i = (A Q + a0 q0)_i (15) and (A V + a0 v0)_i (16) at nodes 1 .. s, from (q0; Q^1 .. Q^s, v0)."""
    size = nodes.degree
    full = differentiation_matrix(nodes.points)[1:]
    first = tuple((line[0],) for line in full)
    inner = tuple(line[1:] for line in full)
    zeros = Table.constant(size, 1)
    padding = Table.constant(size, other_blocks)
    derivative = Table.named("D", full, column=0)
    acceleration = Table.joined(
        Table.named("DD", matrix_product(inner, first), column=0),
        Table.named("DD", matrix_product(inner, inner)),
        Table(
            entries=tuple((x / 2,) for (x,) in first),
            names=tuple((f"D_{n}_0/2",) for n in range(1, size + 1)),
        ),
    )
    return (
        Gather(
            arguments=system.coordinates,
            table=Table.joined(zeros, Table.identity(size), zeros, padding),
            power=0,
        ),
        Gather(
            arguments=system.velocities,
            table=Table.joined(derivative, zeros, padding),
            power=-1,
            scale=Fraction(2),
        ),
        Gather(
            arguments=accelerations(system),
            table=Table.joined(acceleration, padding),
            power=-2,
            scale=Fraction(4),
        ),
    )
