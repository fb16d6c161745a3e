"""Shooting-based spectral-collocation variational integrators (SCVI), section 4, (33)-(34), with total derivatives.

The curve is the spectral-collocation solution of the Euler-Lagrange boundary-value problem from q0 to q1: with
V = A Q + a0 q0 and Acc = A V + a0 v0, the residual E_i(Q^i, V_i, Acc_i) is zero at nodes 1 .. s (34a). L_d is the
quadrature of L along it (33), a function of (q0, q1) alone, because v0 and the interior Q solve E = 0. Hence

    p0 = -dG/dq0,   0 = dG/d(v0, Q^1 .. Q^{s-1}),   0 = dG/dlambda,   p1 = dG/dq1,    G = L_d(Q) + sum_i lambda_i . E_i,

where the multipliers lambda account for the dependence of the interior curve on the end points (the chain rule). The
map is symplectic, conserves the momenta of affine symmetries and has order min(2s, order of the quadrature).

The paper prints (34d), (34e) with the *partial* derivatives of L_d instead. With more than two nodes that is another
map: ``variational=False`` selects it, to reproduce the paper.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from scvi_codegen.common.errors import MethodError
from scvi_codegen.common.precision import Vector
from scvi_codegen.common.representation import summary
from scvi_codegen.common.validation import NUMBERS, check_kind
from scvi_codegen.methods.galerkin import SVI
from scvi_codegen.methods.method import (
    Exactness,
    NodalMethod,
    Specification,
    degree_count,
    resolve_nodes,
    resolve_quadrature,
)
from scvi_codegen.methods.tables.nodes import Nodes
from scvi_codegen.methods.tables.quadrature import Quadrature
from scvi_codegen.methods.tables.tableau import Tableau, collocation_tableau, tableau_by_name
from scvi_codegen.systems.system import MechanicalSystem

if TYPE_CHECKING:
    from scvi_codegen.methods.stage_system import StageSystem
    from scvi_codegen.methods.tables.number_tables import Part

COLLOCATION_TABLEAUX = ("gauss", "radau-iia", "lobatto-iiia", "chebyshev-gauss", "chebyshev-lobatto")
"""Families of tableaux that are collocation methods."""


@dataclass(frozen=True, slots=True)
class SCVI(NodalMethod):
    """Shooting-based spectral-collocation variational integrator.

    Args:
        degree: degree s of the collocation polynomial, at least 1.
        quadrature: rule for the action, an object or a name; default: s-point Gauss-Legendre. Rules with derivatives,
            ``"hermite:2"``, also sum dL/dt along the curve (paper, 4.2.3).
        nodes: collocation nodes of that degree, containing both ends; default Chebyshev-Lobatto (the paper's).
        abscissae: collocation abscissae in [0, 1] in place of nodes, s distinct numbers or the name of a family of s
            points: ``"gauss"``, ``"radau-iia"``, ``"lobatto-iiia"``, ``"chebyshev-gauss"`` or ``"chebyshev-lobatto"``.
            With symmetric ones the step is reversible; Gauss with s Gauss points is, for constant mass, the SVI.
        variational: ``True`` uses total derivatives of the discrete Lagrangian: symplectic and momentum-preserving,
            order min(2s, order of the quadrature). ``False`` is the paper's printed form (34a)-(34e), which omits the
            chain-rule term: for degree >= 2 it is neither symplectic nor momentum-preserving.

    Raises:
        MethodError: for a degree below 1, nodes without the end points or of another degree, abscissae together with
            nodes or of another number, and for the printed form with abscissae or with a quadrature with derivatives.
    """

    degree: int
    quadrature: Quadrature | str | None = None
    nodes: Nodes | str | None = None
    variational: bool = True
    abscissae: Sequence[Any] | str | None = None

    __repr__ = summary("degree", "quadrature")

    def __post_init__(self) -> None:
        object.__setattr__(
            self, "degree", degree_count(self.degree, "the degree of a spectral-collocation variational integrator")
        )
        if not isinstance(self.variational, bool):
            raise MethodError(f"variational must be True or False, not {self.variational!r}")
        object.__setattr__(self, "quadrature", resolve_quadrature(self.quadrature, self.degree))
        if self.rule.derivative_weights and not self.variational:
            raise MethodError(
                f"the form printed in the paper does not support derivatives of L, which {self.rule.name} "
                "uses: use a quadrature without derivatives"
            )
        if self.abscissae is not None:
            if self.nodes is not None:
                raise MethodError(
                    "give nodes or abscissae, not both: they are alternative definitions of the collocation points"
                )
            if not self.variational:
                raise MethodError("the form printed in the paper requires nodes at both ends: leave out the abscissae")
            object.__setattr__(self, "abscissae", _resolve_abscissae(self.abscissae, self.degree))
        object.__setattr__(self, "nodes", resolve_nodes(self.nodes, self.degree))

    @property
    def rule(self) -> Quadrature:
        """Quadrature of the action."""
        assert isinstance(self.quadrature, Quadrature)
        return self.quadrature

    @property
    def tableau(self) -> Tableau:
        """Collocation tableau (23) on the nodes 1 .. s, or on the abscissae."""
        if self.abscissae is None:
            return collocation_tableau(self.node_set.abscissae[1:])
        if isinstance(self.abscissae, str):
            return tableau_by_name(f"{self.abscissae}:{self.degree}")
        return collocation_tableau(self.abscissae)

    @property
    def places(self) -> str:
        """Description of the collocation points: ``chebyshev-lobatto nodes``, ``gauss abscissae``."""
        if self.abscissae is None:
            return f"{self.node_set.name} nodes"
        return f"{self.abscissae} abscissae" if isinstance(self.abscissae, str) else "own abscissae"

    @property
    def name(self) -> str:
        """Name ``scvi[-printed]-<degree>-<nodes or abscissae>-<quadrature>``."""
        form = "scvi" if self.variational else "scvi-printed"
        places = self.places.removesuffix(" nodes").replace(" ", "-")
        return f"{form}-{self.degree}-{places}-{self.rule.name.replace(':', '-')}"

    @property
    def title(self) -> str:
        """Display title."""
        form = "" if self.variational else ", as printed in the paper"
        return (
            f"Spectral-collocation variational integrator, degree {self.degree}, {self.places}, {self.rule.name}{form}"
        )

    @property
    def order(self) -> int | None:
        """Order min(2s, order of the quadrature); ``None`` for the printed form with s >= 2 (measured: about s - 1)."""
        if self.variational or self.degree == 1:
            return min(2 * self.degree, self.rule.order)
        return None

    @property
    def symmetric(self) -> bool:
        """True if abscissae and quadrature are symmetric; for degree 1 if the quadrature is."""
        if self.degree == 1:
            return self.rule.symmetric
        return self.variational and self.tableau.is_symmetric and self.rule.symmetric

    @property
    def symplectic(self) -> bool:
        """True if total derivatives are used, or the degree is 1, for which both forms coincide."""
        return self.variational or self.degree == 1

    @property
    def needs_regular(self) -> bool:
        """True unless the degree is 1 with one quadrature point: the Euler-Lagrange equations are collocated."""
        return self.degree > 1 or len(self.rule) > 1

    @property
    def needs_lagrangian(self) -> bool:
        """True if the quadrature uses derivatives of L along the curve, which a Hamiltonian does not provide."""
        return bool(self.rule.derivative_weights)

    @property
    def exactness(self) -> Exactness:
        """Exactness of the curves; none is claimed for the printed form."""
        return Exactness(curve=self.degree, quadrature=self.rule.order) if self.symplectic else Exactness()

    @property
    def parts(self) -> tuple[Part, ...]:
        """Nodes, or the tableau of the abscissae, and the quadrature."""
        return (self.node_set if self.abscissae is None else self.tableau, self.rule)

    def specification(self) -> Specification:
        """See :meth:`Method.specification`."""
        common: dict[str, Any] = {"method": "scvi", "degree": self.degree, "quadrature": self.rule.name}
        if self.abscissae is None:
            return common | {"nodes": self.node_set.name, "variational": self.variational}
        named = isinstance(self.abscissae, str)
        return common | {"abscissae": self.abscissae if named else [float(c) for c in self.abscissae]}

    @property
    def _line(self) -> SVI:
        return SVI(1, self.rule, self.node_set)

    def stage_system(self, system: MechanicalSystem) -> StageSystem:
        """Return equations with unknowns v0, h a_i and h^-2 lambda_i; degree 1 is the SVI with the same quadrature."""
        if self.degree == 1:
            return self._line.stage_system(system)
        from scvi_codegen.methods.acceleration_stages import printed_increments, shooting_increments

        if self.variational:
            return shooting_increments(system, self.tableau, self.rule)
        return printed_increments(system, self.tableau, self.rule, self.node_set)

    def paper_form(self, system: MechanicalSystem) -> StageSystem:
        """Return (34a)-(34e), with the multiplier terms unless they are zero (degree 1) or omitted (printed form).

        With abscissae, and for quadratures with derivatives, which the paper does not write out: the compiled equations
        with unknowns v0, h a_i and h^-2 lambda_i, with all digits.
        """
        from scvi_codegen.methods.acceleration_stages import printed_nodal, shooting_increments, shooting_nodal

        if self.abscissae is not None or self.rule.derivative_weights:
            if self.degree == 1:
                return self._line.paper_form(system)
            return shooting_increments(system, self.tableau, self.rule, rounded=False)
        if self.variational and self.degree > 1:
            return shooting_nodal(system, self.node_set, self.rule)
        return printed_nodal(system, self.node_set, self.rule)


def _resolve_abscissae(abscissae: Sequence[Any] | str, degree: int) -> Vector | str:
    """Return the validated name of a family of collocation methods, or s numbers."""
    if isinstance(abscissae, str):
        if abscissae not in COLLOCATION_TABLEAUX:
            raise MethodError(
                f"there are no abscissae called {abscissae!r}: give {', '.join(COLLOCATION_TABLEAUX)}, or numbers"
            )
        return abscissae
    check_kind(NUMBERS, abscissae, "abscissae", MethodError)
    numbers = tuple(collocation_tableau(tuple(abscissae)).c)
    if len(numbers) != degree:
        raise MethodError(f"a curve of degree {degree} requires {degree} abscissae, not {len(numbers)}")
    return numbers
