"""Galerkin spectral variational integrators, (25)-(30), and the Stoermer-Verlet method.

The discrete Lagrangian is the quadrature of L along a polynomial curve of degree s,

    L_d(Q^0 .. Q^s) = (h/2) sum_n w_n L(q(tau_n), qdot(tau_n), t_n),     q(tau) = sum_v Q^v l_v(tau),       (25)

made stationary in the interior coefficients (26a); p0 = -D_1 L_d and p1 = D_{s+1} L_d (27). The step depends on the
degree and the quadrature alone: the nodes parametrise the same polynomials. Compiled, the curve is therefore given by
the values V_b of its velocity at s points, whatever the nodes: Q = q0 + h sum_b a_nb V_b. Nothing else changes where
the curves are not polynomials (:mod:`scvi_codegen.tables.spaces`), or where the quadrature uses derivatives of the
integrand: then dL/dt = L_q v + L_v a + L_t along the curve is summed, too (paper, 4.2.3).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

from scvi_codegen.display.number_tables import Part
from scvi_codegen.errors import MethodError, MethodWarning
from scvi_codegen.mechanics.forms import curve_rates, forms_of
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.method import Method, Specification, check_count, unit_sum
from scvi_codegen.methods.stage_system import (
    Block,
    Gather,
    Row,
    ScalarFamily,
    StageSystem,
    Table,
    dyadic,
    stationary_increments,
    stationary_nodal,
)
from scvi_codegen.tables.basis import cardinal_slopes, cardinal_values, extrapolation, identity_matrix, next_step
from scvi_codegen.tables.nodes import Nodes, nodes_by_name
from scvi_codegen.tables.precision import Matrix, Vector, mp
from scvi_codegen.tables.quadrature import Quadrature, gauss_legendre, quadrature_by_name
from scvi_codegen.tables.spaces import CurveSpace, Polynomials, space_by_name
from scvi_codegen.tables.tableau import lobatto_iiia

__all__ = [
    "SVI",
    "StoermerVerlet",
    "galerkin_system",
    "nodal_quadrature_family",
    "position_block",
    "resolve_nodes",
    "resolve_quadrature",
]


@dataclass(frozen=True, slots=True)
class SVI(Method):
    """Galerkin spectral variational integrator of a polynomial degree, with any quadrature.

    Symplectic, conserves the momentum maps of affine symmetries to round-off, of order 2s by default and
    min(2s, q, 2 (q - s + 1)) with a quadrature of order q, reversible if the quadrature is symmetric. Paper: section 3,
    (25)-(30), Table 5.

    Args:
        degree: degree s of the trial curve, at least 1.
        quadrature: rule of at least s points, an object or a name such as ``"gauss-legendre:8"``; default: s-point
            Gauss-Legendre, with which the method is the s-stage Gauss collocation method. Rules with derivatives,
            ``"hermite:2"``, are used along the curve.
        nodes: of that degree, containing both ends; they appear in the derivation, the step does not depend on them.
        space: of the trial curves, an object or a name such as ``"trigonometric:0.5"`` or ``"splines:2"``; default:
            polynomials.

    Raises:
        MethodError: on a degree below 1, nodes without the end points or of another degree, or for curves other than
            polynomials.

    Warns:
        MethodWarning: with fewer quadrature points than the degree, where the stage equations are singular.
    """

    degree: int
    quadrature: Quadrature | str | None = None
    nodes: Nodes | str | None = None
    space: CurveSpace | str | None = None

    def __post_init__(self) -> None:
        check_count(self.degree, "the degree of a spectral variational integrator")
        object.__setattr__(self, "space", _resolve_space(self.space))
        own = self.curves.default_rule(self.degree) if self.quadrature is None else self.quadrature
        object.__setattr__(self, "quadrature", resolve_quadrature(own, self.degree))
        if self.nodes is not None and not isinstance(self.curves, Polynomials):
            raise MethodError(f"nodes parametrise polynomials, not {self.curves.name}: leave them out")
        object.__setattr__(self, "nodes", resolve_nodes(self.nodes, self.degree))
        size = self.curves.dimension(self.degree)
        if self.rule.conditions < size:
            warnings.warn(
                f"{len(self.rule)} quadrature points do not determine a curve of degree {self.degree}: the stage "
                f"equations are singular for most systems and no order is claimed; use at least {size} points",
                MethodWarning,
                stacklevel=3,
            )

    @property
    def curves(self) -> CurveSpace:
        """The space of trial curves, resolved."""
        assert isinstance(self.space, CurveSpace)
        return self.space

    @property
    def rule(self) -> Quadrature:
        """The quadrature along the step."""
        assert isinstance(self.quadrature, Quadrature)
        return self.curves.along(self.quadrature)

    @property
    def node_set(self) -> Nodes:
        """The nodes, resolved."""
        assert isinstance(self.nodes, Nodes)
        return self.nodes

    @property
    def name(self) -> str:
        """``svi-<degree>-<quadrature>[-<curves>]``."""
        own = [] if isinstance(self.curves, Polynomials) else [self.curves.name]
        return "-".join(["svi", str(self.degree), self.rule.name, *own]).replace(":", "-").replace(" ", "-")

    @property
    def title(self) -> str:
        """One line for people."""
        own = "" if isinstance(self.curves, Polynomials) else f" {self.curves.name},"
        return f"Galerkin spectral variational integrator,{own} degree {self.degree}, {self.rule.name}"

    @property
    def order(self) -> int | None:
        """min(2s, q, 2 (q - s + 1)), q the order of the quadrature; ``None`` with too few points, and for trigonometric
        curves.

        The last bound is felt by rules whose order is hardly their number of points (Clenshaw-Curtis, Fejer): the
        stationarity conditions integrate products with variations of degree s, which do not get smoother with h.
        """  # noqa: D205
        best, q = self.curves.order(self.degree), self.rule.order
        if best is None or self.rule.conditions < self.curves.dimension(self.degree):
            return None
        return min(best, q, 2 * (q - self.degree + 1))

    @property
    def symmetric(self) -> bool:
        """True for a symmetric quadrature along symmetric curves."""
        return self.rule.symmetric and self.curves.symmetric

    @property
    def symplectic(self) -> bool:
        """Always."""
        return True

    @property
    def needs_regular(self) -> bool:
        """With more (or fewer) points than the degree: velocities at the points are then not independent."""
        return len(self.rule) != self.curves.dimension(self.degree) or bool(self.rule.derivative_weights)

    @property
    def parts(self) -> tuple[Part, ...]:
        """Nodes of polynomials, and the quadrature along the step."""
        return (self.node_set, self.rule) if isinstance(self.curves, Polynomials) else (self.rule,)

    def specification(self) -> Specification:
        """See :meth:`Method.specification`."""
        assert isinstance(self.quadrature, Quadrature)
        common: dict[str, str | int] = {"method": "svi", "degree": self.degree, "quadrature": self.quadrature.name}
        if isinstance(self.curves, Polynomials):
            return common | {"nodes": self.node_set.name}
        return common | {"space": self.curves.name}

    def stage_system(self, system: MechanicalSystem) -> StageSystem:
        """Unknowns V_b at the quadrature points if there are s of them, else at points of the space of curves."""
        rule, curves = self.rule, self.curves
        points = curves.points(self.degree, rule)
        if rule.derivative_weights and system.auxiliaries:
            raise MethodError(
                f"{rule.name} differentiates L along the curve of positions, which a Hamiltonian does not have: give L "
                "(lagrangian_of), or use a quadrature without derivatives"
            )
        return galerkin_system(
            system,
            abscissae=rule.abscissae,
            weights=rule.unit_weights,
            position=curves.positions(points, rule.abscissae),
            velocity=curves.velocities(points, rule.abscissae),
            end_position=curves.positions(points, (mp.one,))[0],
            extrapolation=next_step(points),
            block_abscissae=points,
            derivative_weights=rule.unit_derivative_weights,
            derivatives=[curves.velocities(points, rule.abscissae, k + 1) for k in range(len(rule.derivative_weights))],
        )

    def paper_form(self, system: MechanicalSystem) -> StageSystem:
        """Unknowns Q^1 .. Q^s, rows (27a) and (27b), p1 by (27c).

        Of curves other than polynomials, and of quadratures with derivatives, the compiled equations.
        """
        if not isinstance(self.curves, Polynomials) or self.rule.derivative_weights:
            return self.stage_system(system)
        s = self.degree
        blocks = tuple(position_block(v, self.node_set) for v in range(1, s + 1))
        return stationary_nodal(
            families=(nodal_quadrature_family(system, self.node_set, self.rule),),
            blocks=blocks,
            end_block=s - 1,
            rows=(
                Row(number="27a", kind="IDEL", momentum=mp.one),
                *(Row(number="27b", kind="stage", momentum=mp.zero) for _ in range(s - 1)),
            ),
            end_numbers=("27", "27c"),
        )


@dataclass(frozen=True, slots=True)
class StoermerVerlet(Method):
    """Stoermer-Verlet: the two-stage Lobatto IIIA-IIIB pair, order 2, symplectic, symmetric.

    For L = v^T M v / 2 - V(q, t) with constant M it is the leapfrog scheme, and the SVI of degree 1 with the
    trapezoidal rule; for other Lagrangians it is implicit. Source: Hairer, Lubich & Wanner, Geometric Numerical
    Integration, II.2.
    """

    @property
    def name(self) -> str:
        """``stoermer-verlet``."""
        return "stoermer-verlet"

    @property
    def title(self) -> str:
        """One line for people."""
        return "Stoermer-Verlet (Lobatto IIIA-IIIB pair of two stages)"

    @property
    def order(self) -> int | None:
        """2."""
        return 2

    @property
    def symmetric(self) -> bool:
        """Yes."""
        return True

    @property
    def symplectic(self) -> bool:
        """Yes."""
        return True

    @property
    def parts(self) -> tuple[Part, ...]:
        """The tableau of positions."""
        return (lobatto_iiia(2),)

    def specification(self) -> Specification:
        """See :meth:`Method.specification`."""
        return {"method": "stoermer-verlet"}

    def stage_system(self, system: MechanicalSystem) -> StageSystem:
        """The pair written by its generating function, unknowns V_1, V_2."""
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
        """The same equations: the paper uses the method without printing it."""
        return self.stage_system(system)


def galerkin_system(
    system: MechanicalSystem,
    *,
    abscissae: Vector,
    weights: Vector,
    position: Matrix,
    velocity: Matrix,
    end_position: Vector,
    extrapolation: Matrix,
    block_abscissae: Vector = (),
    derivative_weights: Matrix = (),
    derivatives: Sequence[Matrix] = (),
) -> StageSystem:
    """Stationarity of h sum_n w_n L(q0 + h sum_b a_nb V_b, sum_b l_nb V_b, t_n) at fixed q1 = q0 + h sum_b beta_b V_b.

    Args:
        system: the Lagrangian.
        abscissae: (g,) points in [0, 1].
        weights: (g,) with sum 1.
        position: (g, s) matrix a.
        velocity: (g, s) matrix l.
        end_position: (s,) vector beta.
        extrapolation: (s, s), the guess for the next step.
        block_abscissae: (s,) where the velocities are; left out, the points.
        derivative_weights: rows of (g,) weights of h^k d^k L/dt^k, k = 1, 2, ..
        derivatives: as many (g, s) matrices of the k-th derivatives of the l_nb.
    """
    points, size = len(abscissae), len(end_position)
    beta = unit_sum(end_position)
    tables = (velocity, *derivatives)
    gathers = _curve_gathers(system, dyadic(position), tables)
    scalars = (system.lagrangian, *forms_of(system).rates(len(derivatives)))
    families = [
        ScalarFamily(
            name=f"derivative_{k}" if k else "quadrature",
            abscissae=abscissae,
            weights=own,
            weight_names=tuple(f"{'d' * k}w_{n}" for n in range(1, points + 1)),
            gathers=gathers[: k + 2],
            scalar=scalar,
            power=k,
        )
        for k, (own, scalar) in enumerate(zip((unit_sum(weights), *derivative_weights), scalars, strict=True))
    ]
    return stationary_increments(
        families=families,
        blocks=tuple(Block(name=f"V_{b}", power=1, straight=(mp.zero, mp.one)) for b in range(1, size + 1)),
        end_position=beta,
        rows=tuple(Row(number=f"V_{b}", kind="IDEL", momentum=beta[b - 1]) for b in range(1, size + 1)),
        extrapolation=extrapolation,
        block_abscissae=block_abscissae or abscissae,
    )


def _curve_gathers(system: MechanicalSystem, position: Matrix, velocities: Sequence[Matrix]) -> tuple[Gather, ...]:
    """Q, v and as many further time derivatives of the curve as there are tables."""
    points = len(position)
    rates = (system.velocities, *curve_rates(system, len(velocities) - 1))
    place = Table.joined(Table.constant(points, 1, 1), Table.named("a", position))
    return (
        Gather(arguments=system.coordinates, table=place, power=0),
        *(
            Gather(
                arguments=arguments,
                table=Table.joined(Table.constant(points, 1), Table.named(f"{'d' * k}l", table)),
                power=-1 - k,
            )
            for k, (arguments, table) in enumerate(zip(rates, velocities, strict=True))
        ),
    )


def nodal_quadrature_family(
    system: MechanicalSystem, nodes: Nodes, rule: Quadrature, *, other_blocks: int = 0
) -> ScalarFamily:
    """The quadrature of L along the interpolant through Q^0 .. Q^s, in the paper's notation.

    ``other_blocks`` unknown blocks behind Q^s (velocities, multipliers) do not move the curve.
    """
    padding = Table.constant(len(rule), other_blocks)
    values = Table.named("l", cardinal_values(nodes.points, rule.points), column=0)
    slopes = Table.named("dl", cardinal_slopes(nodes.points, rule.points), column=0)
    return ScalarFamily(
        name="quadrature",
        abscissae=rule.abscissae,
        weights=rule.weights,
        weight_names=tuple(f"w_{n}" for n in range(1, len(rule) + 1)),
        gathers=(
            Gather(arguments=system.coordinates, table=Table.joined(values, padding), power=0),
            Gather(arguments=system.velocities, table=Table.joined(slopes, padding), power=-1, scale=Fraction(2)),
        ),
        scalar=system.lagrangian,
        scale=Fraction(1, 2),
    )


def resolve_quadrature(quadrature: Quadrature | str | None, degree: int) -> Quadrature:
    """A quadrature given as an object, a name or not at all (then ``degree`` Gauss points)."""
    if quadrature is None:
        return gauss_legendre(degree)
    if isinstance(quadrature, str):
        return quadrature_by_name(quadrature)
    if not isinstance(quadrature, Quadrature):
        raise MethodError(f"a quadrature is wanted, or a name such as 'gauss-legendre:{degree}', not {quadrature!r}")
    return quadrature


def _resolve_space(space: CurveSpace | str | None) -> CurveSpace:
    """A space given as an object, a name or not at all (then polynomials)."""
    if space is None:
        return Polynomials()
    if isinstance(space, str):
        return space_by_name(space)
    if not isinstance(space, CurveSpace):
        raise MethodError(f"a space of curves is wanted, or a name such as 'splines:2', not {space!r}")
    return space


def resolve_nodes(nodes: Nodes | str | None, degree: int) -> Nodes:
    """Nodes given as an object, a name or not at all (then Chebyshev-Lobatto), checked to contain both ends."""
    if nodes is None:
        nodes = "chebyshev-lobatto"
    if isinstance(nodes, str):
        nodes = nodes_by_name(nodes, degree)
    if not isinstance(nodes, Nodes):
        raise MethodError(f"nodes are wanted, or a name such as 'chebyshev-lobatto', not {nodes!r}")
    if nodes.degree != degree:
        raise MethodError(f"nodes of degree {nodes.degree} do not fit a curve of degree {degree}")
    if not nodes.contains_ends:
        raise MethodError(
            f"the nodes '{nodes.name}' lack an end point of the step, but Q^0 = q0 and Q^s = q1 must be node values; "
            "use chebyshev-lobatto, legendre-lobatto or equispaced"
        )
    return nodes


def position_block(v: int, nodes: Nodes) -> Block:
    """The unknown Q^v, first guessed on the straight line."""
    return Block(name=f"Q_{v}", power=0, straight=(mp.one, nodes.abscissae[v]))
