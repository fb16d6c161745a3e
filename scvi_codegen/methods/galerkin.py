"""Galerkin spectral variational integrators (SVI), section 3, (25)-(30).

The discrete Lagrangian is the quadrature of L along a polynomial curve of degree s,

    L_d(Q^0 .. Q^s) = (h/2) sum_n w_n L(q(tau_n), qdot(tau_n), t_n),     q(tau) = sum_v Q^v l_v(tau),       (25)

made stationary in the interior coefficients (26a); p0 = -D_1 L_d and p1 = D_{s+1} L_d (27). The step depends only on
the degree and the quadrature: the nodes parametrise the same polynomials. The compiled form therefore represents the
curve by its velocities V_b at s points, for any nodes: Q = q0 + h sum_b a_nb V_b. The same holds for curves that are
not polynomials (:mod:`scvi_codegen.methods.tables.spaces`). If the quadrature uses derivatives of the integrand,
dL/dt = L_q v + L_v a + L_t along the curve is summed as well (paper, 4.2.3).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from scvi_codegen.common.errors import MethodError, MethodWarning, warn
from scvi_codegen.common.precision import mp
from scvi_codegen.common.representation import summary
from scvi_codegen.methods.method import (
    Exactness,
    NodalMethod,
    Specification,
    degree_count,
    resolve_nodes,
    resolve_quadrature,
    resolve_space,
)
from scvi_codegen.methods.tables.basis import next_step
from scvi_codegen.methods.tables.nodes import Nodes
from scvi_codegen.methods.tables.quadrature import Quadrature
from scvi_codegen.methods.tables.spaces import CurveSpace
from scvi_codegen.systems.system import MechanicalSystem

if TYPE_CHECKING:
    from scvi_codegen.methods.stage_system import StageSystem
    from scvi_codegen.methods.tables.number_tables import Part


@dataclass(frozen=True, slots=True)
class SVI(NodalMethod):
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
        MethodError: for a degree below 1, for nodes without the end points or of another degree, and for nodes of
            curves that are not polynomials.

    Warns:
        MethodWarning: with fewer quadrature points than the degree, for which the stage equations are singular.
    """

    degree: int
    quadrature: Quadrature | str | None = None
    nodes: Nodes | str | None = None
    space: CurveSpace | str | None = None

    symplectic = True
    __repr__ = summary("degree", "quadrature", "space")

    def __post_init__(self) -> None:
        object.__setattr__(self, "degree", degree_count(self.degree, "the degree of a spectral variational integrator"))
        object.__setattr__(self, "space", resolve_space(self.space))
        rule = self.curves.default_rule(self.degree) if self.quadrature is None else self.quadrature
        object.__setattr__(self, "quadrature", resolve_quadrature(rule, self.degree))
        if self.nodes is not None and not self.curves.nodal:
            raise MethodError(f"nodes apply to polynomials only, not to {self.curves.name}: leave them out")
        object.__setattr__(self, "nodes", resolve_nodes(self.nodes, self.degree))
        size = self.curves.dimension(self.degree)
        if self.rule.conditions < size:
            warn(
                f"{len(self.rule)} quadrature points do not determine a curve of degree {self.degree}: the stage "
                f"equations are singular for most systems and no order is claimed; use at least {size} points",
                MethodWarning,
            )

    @property
    def curves(self) -> CurveSpace:
        """Space of trial curves."""
        assert isinstance(self.space, CurveSpace)
        return self.space

    @property
    def rule(self) -> Quadrature:
        """Quadrature along the step."""
        assert isinstance(self.quadrature, Quadrature)
        return self.curves.along(self.quadrature)

    @property
    def name(self) -> str:
        """Name ``svi-<degree>-<quadrature>[-<curves>]``."""
        suffix = [] if self.curves.nodal else [self.curves.name]
        return "-".join(["svi", str(self.degree), self.rule.name, *suffix]).replace(":", "-").replace(" ", "-")

    @property
    def title(self) -> str:
        """Display title."""
        suffix = "" if self.curves.nodal else f" {self.curves.name},"
        return f"Galerkin spectral variational integrator,{suffix} degree {self.degree}, {self.rule.name}"

    @property
    def order(self) -> int | None:
        """Order min(2s, q, 2 (q - s + 1)) with the order q of the quadrature.

        ``None`` with too few points, and for trigonometric curves. The last bound is attained by rules whose order
        hardly exceeds their number of points (Clenshaw-Curtis, Fejer): stationarity conditions integrate products with
        variations of degree s, which do not get smoother with h.
        """
        best, q = self.curves.order(self.degree), self.rule.order
        if best is None or self.rule.conditions < self.curves.dimension(self.degree):
            return None
        return min(best, q, 2 * (q - self.degree + 1))

    @property
    def symmetric(self) -> bool:
        """True if the quadrature is symmetric, as all spaces of curves are."""
        return self.rule.symmetric

    @property
    def needs_regular(self) -> bool:
        """True if the number of points differs from the degree, so that velocities at the points are dependent."""
        return len(self.rule) != self.curves.dimension(self.degree) or bool(self.rule.derivative_weights)

    @property
    def needs_lagrangian(self) -> bool:
        """True if the quadrature uses derivatives of L along the curve, which a Hamiltonian does not provide."""
        return bool(self.rule.derivative_weights)

    @property
    def exactness(self) -> Exactness:
        """Exactness of the curves; for the Gauss method also that of symplectic Runge-Kutta methods."""
        if not self.curves.nodal:
            return Exactness(curve=0)
        gauss = len(self.rule) == self.degree and self.rule.order == 2 * self.degree
        return Exactness(polynomials=2 * gauss, curve=self.degree, quadrature=self.rule.order)

    @property
    def frequency(self) -> float | None:
        """Fitted frequency of trigonometric curves, in radians per step."""
        return self.curves.fitted

    @property
    def parts(self) -> tuple[Part, ...]:
        """Nodes (of polynomials) and the quadrature along the step."""
        return (self.node_set, self.rule) if self.curves.nodal else (self.rule,)

    def specification(self) -> Specification:
        """See :meth:`Method.specification`."""
        assert isinstance(self.quadrature, Quadrature)
        common: dict[str, str | int] = {"method": "svi", "degree": self.degree, "quadrature": self.quadrature.name}
        if self.curves.nodal:
            return common | {"nodes": self.node_set.name}
        return common | {"space": self.curves.name}

    def stage_system(self, system: MechanicalSystem) -> StageSystem:
        """Return the stage equations; unknowns are velocities V_b at the points of :meth:`CurveSpace.points`."""
        return self._equations(system, rounded=True)

    def _equations(self, system: MechanicalSystem, *, rounded: bool) -> StageSystem:
        from scvi_codegen.methods.galerkin_stages import galerkin_system

        rule, curves = self.rule, self.curves
        points = curves.points(self.degree, rule)
        return galerkin_system(
            system,
            abscissae=rule.abscissae,
            weights=rule.unit_weights,
            position=curves.positions(points, rule.abscissae),
            velocity=curves.velocities(points, rule.abscissae),
            end_position=curves.positions(points, (mp.one,))[0],
            extrapolation=next_step(points),
            blocks=points,
            derivative_weights=rule.unit_derivative_weights,
            derivatives=[curves.velocities(points, rule.abscissae, k + 1) for k in range(len(rule.derivative_weights))],
            rounded=rounded,
        )

    def paper_form(self, system: MechanicalSystem) -> StageSystem:
        """Return the equations with unknowns Q^1 .. Q^s, rows (27a) and (27b), p1 by (27c).

        For curves other than polynomials, and quadratures with derivatives, the compiled equations with all digits.
        """
        if not self.curves.nodal or self.rule.derivative_weights:
            return self._equations(system, rounded=False)
        from scvi_codegen.methods.galerkin_stages import nodal_quadrature_group, position_block
        from scvi_codegen.methods.stage_system import Row, stationary_nodal

        s = self.degree
        blocks = tuple(position_block(v, self.node_set) for v in range(1, s + 1))
        return stationary_nodal(
            stage_groups=(nodal_quadrature_group(system, self.node_set, self.rule),),
            blocks=blocks,
            end_block=s - 1,
            rows=(
                Row(number="27a", kind="IDEL", momentum=mp.one),
                *(Row(number="27b", kind="stage", momentum=mp.zero) for _ in range(s - 1)),
            ),
            end_numbers=("27", "27c"),
        )
