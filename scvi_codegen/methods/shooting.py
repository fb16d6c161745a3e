"""Shooting-based spectral-collocation variational integrators (SCVI), section 4, (33)-(34), differentiated in full.

The curve is the spectral-collocation solution of the Euler-Lagrange boundary-value problem from q0 to q1: with
V = A Q + a0 q0 and Acc = A V + a0 v0, the residual E_i(Q^i, V_i, Acc_i) vanishes at nodes 1 .. s (34a). L_d is the
quadrature of L along it (33), a function of (q0, q1) alone, because v0 and the interior Q solve E = 0. Hence

    p0 = -dG/dq0,   0 = dG/d(v0, Q^1 .. Q^{s-1}),   0 = dG/dlambda,   p1 = dG/dq1,    G = L_d(Q) + sum_i lambda_i . E_i,

the multipliers lambda carrying the dependence of the inner curve on the end points (the chain rule). The map is
symplectic, conserves the momenta of affine symmetries and has order min(2s, order of the quadrature).

The paper prints (34d), (34e) with the *partial* derivatives of L_d instead. With more than two nodes that is another
map: ``variational=False`` gives it, to reproduce the paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from scvi_codegen.display.number_tables import Part
from scvi_codegen.errors import MethodError
from scvi_codegen.mechanics.forms import forms_of, multipliers
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.collocation import (
    acceleration_extrapolation,
    acceleration_gathers,
    acceleration_unknowns,
    nodal_blocks,
    nodal_gathers,
    residual_family,
)
from scvi_codegen.methods.galerkin import SVI, nodal_quadrature_family, resolve_nodes, resolve_quadrature
from scvi_codegen.methods.method import Method, Specification, check_count, lagrangian_scatters, unit_sum
from scvi_codegen.methods.stage_system import (
    Block,
    Gather,
    PointFamily,
    Row,
    ScalarFamily,
    Scatter,
    StageSystem,
    Table,
    dyadic,
    stationary_increments,
    stationary_nodal,
)
from scvi_codegen.tables.basis import cardinal_integrals, cardinal_slopes, cardinal_values, matrix_product
from scvi_codegen.tables.nodes import Nodes
from scvi_codegen.tables.precision import Matrix, Vector, mp
from scvi_codegen.tables.quadrature import Quadrature
from scvi_codegen.tables.tableau import Tableau, collocation_tableau, tableau_by_name

__all__ = ["SCVI"]

COLLOCATION_FAMILIES = ("gauss", "radau-iia", "lobatto-iiia", "chebyshev-gauss", "chebyshev-lobatto")
"""Families of tableaux that are collocation on their abscissae."""


@dataclass(frozen=True, slots=True)
class SCVI(Method):
    """Shooting-based spectral-collocation variational integrator.

    Args:
        degree: degree s of the collocation polynomial, at least 1.
        quadrature: rule for the action, an object or a name; default: s-point Gauss-Legendre.
        nodes: collocation nodes of that degree, containing both ends; default Chebyshev-Lobatto (the paper's).
        abscissae: collocation abscissae in [0, 1] in place of nodes, s distinct numbers or the name of a family:
            ``"gauss"``, ``"radau-iia"``, ``"lobatto-iiia"``, ``"chebyshev-gauss"`` or ``"chebyshev-lobatto"``, s points
            of it. On symmetric ones the step is reversible; Gauss with s Gauss points is, for constant mass, the SVI.
        variational: ``True`` differentiates the discrete Lagrangian in full: symplectic and momentum-preserving, order
            min(2s, order of the quadrature). ``False`` is the paper's printed form (34a)-(34e), which drops the
            chain-rule term: for degree >= 2 it is neither symplectic nor momentum-preserving.

    Raises:
        MethodError: on a degree below 1, nodes without the end points or of another degree, abscissae beside nodes or
            of another number, and for the printed form on abscissae, which needs nodes at both ends.
    """

    degree: int
    quadrature: Quadrature | str | None = None
    nodes: Nodes | str | None = None
    variational: bool = True
    abscissae: Sequence[Any] | str | None = None

    def __post_init__(self) -> None:
        check_count(self.degree, "the degree of a spectral-collocation variational integrator")
        if not isinstance(self.variational, bool):
            raise MethodError(f"variational is True or False, not {self.variational!r}")
        object.__setattr__(self, "quadrature", resolve_quadrature(self.quadrature, self.degree))
        if self.abscissae is not None:
            if self.nodes is not None:
                raise MethodError("give nodes or abscissae, not both: they say where the curve is collocated")
            if not self.variational:
                raise MethodError("the form printed in the paper needs nodes at both ends: leave out the abscissae")
            object.__setattr__(self, "abscissae", _resolve_abscissae(self.abscissae, self.degree))
        object.__setattr__(self, "nodes", resolve_nodes(self.nodes, self.degree))

    @property
    def rule(self) -> Quadrature:
        """The quadrature, resolved."""
        assert isinstance(self.quadrature, Quadrature)
        return self.quadrature

    @property
    def node_set(self) -> Nodes:
        """The nodes, resolved; without meaning where abscissae are given."""
        assert isinstance(self.nodes, Nodes)
        return self.nodes

    @property
    def tableau(self) -> Tableau:
        """The collocation tableau (23) on the nodes 1 .. s, or on the abscissae."""
        if self.abscissae is None:
            return collocation_tableau(self.node_set.abscissae[1:])
        if isinstance(self.abscissae, str):
            return tableau_by_name(f"{self.abscissae}:{self.degree}")
        return collocation_tableau(self.abscissae)

    @property
    def places(self) -> str:
        """Where the curve is collocated, for people: ``chebyshev-lobatto nodes``, ``gauss abscissae``."""
        if self.abscissae is None:
            return f"{self.node_set.name} nodes"
        return f"{self.abscissae} abscissae" if isinstance(self.abscissae, str) else "own abscissae"

    @property
    def name(self) -> str:
        """``scvi[-printed]-<degree>-<nodes or abscissae>-<quadrature>``."""
        form = "scvi" if self.variational else "scvi-printed"
        places = self.places.removesuffix(" nodes").replace(" ", "-")
        return f"{form}-{self.degree}-{places}-{self.rule.name.replace(':', '-')}"

    @property
    def title(self) -> str:
        """One line for people."""
        form = "" if self.variational else ", as printed in the paper"
        return (
            f"Spectral-collocation variational integrator, degree {self.degree}, {self.places}, {self.rule.name}{form}"
        )

    @property
    def order(self) -> int | None:
        """min(2s, order of the quadrature); as printed about s - 1 for s >= 2, where none is claimed."""
        if self.variational or self.degree == 1:
            return min(2 * self.degree, self.rule.order)
        return None

    @property
    def symmetric(self) -> bool:
        """True where the step equals the symmetric SVI (degree 1) or the abscissae and the quadrature are symmetric."""
        if self.degree == 1:
            return self.rule.symmetric
        return self.variational and self.tableau.is_symmetric and self.rule.symmetric

    @property
    def symplectic(self) -> bool:
        """Yes, but for the printed form of degree >= 2."""
        return self.variational or self.degree == 1

    @property
    def needs_regular(self) -> bool:
        """The Euler-Lagrange equations are collocated, but for degree 1 with one point."""
        return self.degree > 1 or len(self.rule) > 1

    @property
    def parts(self) -> tuple[Part, ...]:
        """Nodes or the tableau of the abscissae, and the quadrature."""
        return (self.node_set if self.abscissae is None else self.tableau, self.rule)

    def specification(self) -> Specification:
        """See :meth:`Method.specification`."""
        common: dict[str, Any] = {"method": "scvi", "degree": self.degree, "quadrature": self.rule.name}
        if self.abscissae is None:
            return common | {"nodes": self.node_set.name, "variational": self.variational}
        named = isinstance(self.abscissae, str)
        return common | {"abscissae": self.abscissae if named else [float(c) for c in self.abscissae]}

    def stage_system(self, system: MechanicalSystem) -> StageSystem:
        """Unknowns v0, h a_i and h^-2 lambda_i; degree 1 is the SVI of degree 1 with the same quadrature."""
        if self.degree == 1:
            return SVI(1, self.rule, self.node_set).stage_system(system)
        build = _shooting_increments if self.variational else _printed_increments
        return build(system, self.tableau, self.rule, self.node_set)

    def paper_form(self, system: MechanicalSystem) -> StageSystem:
        """(34a)-(34e), with the multiplier terms unless the degree is 1 (where they vanish) or as printed.

        On abscissae, which the paper does not write out: the compiled equations, unknowns v0, h a_i and h^-2 lambda_i.
        """
        if self.abscissae is not None:
            return self.stage_system(system)
        if self.variational and self.degree > 1:
            return _shooting_nodal(system, self.node_set, self.rule)
        return _printed_nodal(system, self.node_set, self.rule)


def _resolve_abscissae(abscissae: Sequence[Any] | str, degree: int) -> Vector | str:
    """The name of a family of collocation methods, or s numbers."""
    if isinstance(abscissae, str):
        if abscissae not in COLLOCATION_FAMILIES:
            raise MethodError(
                f"there are no abscissae called {abscissae!r}: give {', '.join(COLLOCATION_FAMILIES)}, or numbers"
            )
        return abscissae
    numbers = tuple(collocation_tableau(tuple(abscissae)).c)
    if len(numbers) != degree:
        raise MethodError(f"a curve of degree {degree} has {degree} abscissae, not {len(numbers)}")
    return numbers


def _shooting_increments(system: MechanicalSystem, tableau: Tableau, rule: Quadrature, _nodes: Nodes) -> StageSystem:
    """G = h sum w_n L(q_n, v_n) + sum_i h^2 m_i . E_i, unknowns (v0, z_i = h a_i, m_i)."""
    size = len(tableau.b)
    position_rows, velocity_rows, end_row = _curve(tableau, rule.abscissae)
    blocks = (
        *acceleration_unknowns(size),
        *(Block(name=f"m_{i}", power=1, straight=(mp.zero, mp.zero)) for i in range(1, size + 1)),
    )
    action = ScalarFamily(
        name="quadrature",
        abscissae=rule.abscissae,
        weights=unit_sum(rule.unit_weights),
        weight_names=tuple(f"w_{n}" for n in range(1, len(rule) + 1)),
        gathers=_curve_gathers(system, dyadic(position_rows), velocity_rows, other_blocks=size),
        scalar=system.lagrangian,
    )
    beta = dyadic([end_row])[0]
    extrapolated = acceleration_extrapolation(tableau)
    return stationary_increments(
        families=(action, _multiplier_family(system, tableau)),
        blocks=blocks,
        end_position=(*beta, *(mp.zero,) * size),
        rows=(
            *(Row(number=f"z_{i}", kind="IDEL", momentum=beta[i]) for i in range(size + 1)),
            *(Row(number="34a", kind="stage", momentum=mp.zero) for _ in range(size)),
        ),
        extrapolation=(
            *((*line, *(mp.zero,) * size) for line in extrapolated),
            *((*(mp.zero,) * (size + 1), *(mp.mpf(int(i == j)) for j in range(size))) for i in range(size)),
        ),
    )


def _multiplier_family(system: MechanicalSystem, tableau: Tableau) -> ScalarFamily:
    """The collocation nodes with scalar m_i . E_i, weight h^2 (unknowns v0, z, m)."""
    size = len(tableau.b)
    position, velocity, acceleration = acceleration_gathers(system, tableau.A, other_blocks=size)
    rounded = Gather(
        arguments=position.arguments,
        table=Table(entries=dyadic(position.table.entries), names=position.table.names),
        power=0,
    )
    own = Gather(
        arguments=multipliers(system),
        table=Table.joined(Table.constant(size, 2 + size), Table.identity(size)),
        power=-1,
    )
    return ScalarFamily(
        name="node",
        abscissae=tableau.c,
        weights=(mp.one,) * size,
        weight_names=("",) * size,
        gathers=(rounded, velocity, acceleration, own),
        scalar=forms_of(system).multiplied_residual,
        power=1,
        in_action=False,
    )


def _curve(tableau: Tableau, at: Vector) -> tuple[Matrix, Matrix, Vector]:
    """The polynomial through V_i = v0 + sum a_ij z_j at abscissae ``at``: rows for q / h and v, the row of q1 / h."""
    moved = tuple((mp.one, *line) for line in tableau.A)
    position = matrix_product(cardinal_integrals(tableau.c, at, 0), moved)
    velocity = matrix_product(cardinal_values(tableau.c, at), moved)
    return position, velocity, matrix_product((tableau.b,), moved)[0]


def _curve_gathers(
    system: MechanicalSystem, position: Matrix, velocity: Matrix, *, other_blocks: int = 0
) -> tuple[Gather, Gather]:
    points = len(position)
    padding = Table.constant(points, other_blocks)
    return (
        Gather(
            arguments=system.coordinates,
            table=Table.joined(Table.constant(points, 1, 1), Table.named("r", position, column=0), padding),
            power=0,
        ),
        Gather(
            arguments=system.velocities,
            table=Table.joined(Table.constant(points, 1), Table.named("u", velocity, column=0), padding),
            power=-1,
        ),
    )


def _printed_increments(system: MechanicalSystem, tableau: Tableau, rule: Quadrature, nodes: Nodes) -> StageSystem:
    """(34a) and the partial derivatives (34d), (34e), unknowns (v0, z_i = h a_i)."""
    size, points = len(tableau.b), len(rule)
    position_rows, velocity_rows, end_row = _curve(tableau, rule.abscissae)
    abscissae = nodes.abscissae
    values = cardinal_values(abscissae, rule.abscissae)
    slopes = cardinal_slopes(abscissae, rule.abscissae)
    none = Table.constant(points, size)

    def first_and_sum(lines: Matrix) -> Table:
        first, both = [(line[0],) for line in lines], [(line[0] + line[-1],) for line in lines]
        return Table.joined(Table.named("l", first), none, Table.named("l", both))

    quadrature = lagrangian_scatters(
        PointFamily(
            name="quadrature",
            abscissae=rule.abscissae,
            weights=rule.unit_weights,
            weight_names=tuple(f"w_{n}" for n in range(1, points + 1)),
            gathers=_curve_gathers(system, position_rows, velocity_rows),
            scatters=(),
        ),
        system,
        Scatter(results=(), table=first_and_sum(values), power=1),
        Scatter(results=(), table=first_and_sum(slopes), power=0),
    )
    inner = Table.joined(Table.constant(size, 1), Table.identity(size), Table.constant(size, 1))
    node = residual_family(
        system, tableau.c, acceleration_gathers(system, tableau.A), Scatter(results=(), table=inner, power=1)
    )
    return StageSystem(
        blocks=acceleration_unknowns(size),
        rows=(
            Row(number="34d", kind="IDEL", momentum=mp.one),
            *(Row(number="34a", kind="stage", momentum=mp.zero) for _ in range(size)),
        ),
        families=(quadrature, node),
        end_position=Table.named("r", [(1, *end_row)], column=0),
        end_momentum=mp.one,
        end_numbers=("34c", "34e"),
        extrapolation=acceleration_extrapolation(tableau),
    )


def _shooting_nodal(system: MechanicalSystem, nodes: Nodes, rule: Quadrature) -> StageSystem:
    """G = L_d + sum lambda_i . E_i in the paper's unknowns Q^1 .. Q^s, v0 and lambda_1 .. lambda_s."""
    size = nodes.degree
    own = Gather(
        arguments=multipliers(system),
        table=Table.joined(Table.constant(size, 2 + size), Table.identity(size)),
        power=0,
    )
    node = ScalarFamily(
        name="node",
        abscissae=nodes.abscissae[1:],
        weights=(mp.one,) * size,
        weight_names=("",) * size,
        gathers=(*nodal_gathers(system, nodes, other_blocks=size), own),
        scalar=forms_of(system).multiplied_residual,
        power=-1,
        in_action=False,
    )
    return stationary_nodal(
        families=(nodal_quadrature_family(system, nodes, rule, other_blocks=1 + size), node),
        blocks=(
            *nodal_blocks(nodes),
            *(Block(name=f"lambda_{i}", power=0, straight=(mp.zero, mp.zero)) for i in range(1, size + 1)),
        ),
        end_block=size - 1,
        rows=(
            Row(number="34d", kind="IDEL", momentum=mp.one),
            *(Row(number="dG/dQ", kind="multiplier", momentum=mp.zero) for _ in range(size - 1)),
            Row(number="dG/dv0", kind="multiplier", momentum=mp.zero, power=1),
            *(Row(number="34a", kind="stage", momentum=mp.zero) for _ in range(size)),
        ),
        end_numbers=("34c", "34e"),
    )


def _printed_nodal(system: MechanicalSystem, nodes: Nodes, rule: Quadrature) -> StageSystem:
    """(34a), (34d) and (34e) as printed, unknowns Q^1 .. Q^s and v0; (36)-(37) for the two-point pendulum."""
    size = nodes.degree
    action = nodal_quadrature_family(system, nodes, rule, other_blocks=1)
    none = Table.constant(len(rule), size)

    def ends(table: Table) -> Table:
        return Table.joined(none, table.columns([0]), table.columns([size]))

    quadrature = action.point_family([ends(gather.table) for gather in action.gathers])
    node = residual_family(
        system,
        nodes.abscissae[1:],
        nodal_gathers(system, nodes),
        Scatter(results=(), table=Table.joined(Table.identity(size), Table.constant(size, 2)), power=0),
    )
    return StageSystem(
        blocks=nodal_blocks(nodes),
        rows=(
            *(Row(number="34a", kind="stage", momentum=mp.zero) for _ in range(size)),
            Row(number="34d", kind="IDEL", momentum=mp.one),
        ),
        families=(quadrature, node),
        end_position=Table.joined(Table.constant(1, size), Table.constant(1, 1, 1), Table.constant(1, 1)),
        end_momentum=mp.zero,
        end_numbers=("34c", "34e"),
    )
