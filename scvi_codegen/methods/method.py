"""Base class of integration methods: frozen data with properties and stage equations for a system.

A method is a frozen dataclass derived from :class:`Method` in a file of its own and a line in ``METHODS``
(:mod:`scvi_codegen.methods`). It must define a name, a title, its order, whether it is symmetric and symplectic, a
specification, and its equations as compiled; also as printed in the paper if these differ. Other properties (for
solvers, verification reports, momentum maps) have defaults here that claim nothing and may be overridden. Code outside
this package does not distinguish between kinds of methods.

Arguments of methods (nodes, quadrature, space of trial curves) are given as objects or names.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar

from scvi_codegen.common.cache import key_of
from scvi_codegen.common.display.cards import card, plain
from scvi_codegen.common.errors import MethodError
from scvi_codegen.common.precision import Vector
from scvi_codegen.common.validation import checked_count
from scvi_codegen.methods.tables.nodes import Nodes, nodes_by_name
from scvi_codegen.methods.tables.quadrature import Quadrature, gauss_legendre, quadrature_by_name
from scvi_codegen.methods.tables.spaces import CurveSpace, Polynomials, space_by_name
from scvi_codegen.methods.tables.tableau import MAX_STAGES
from scvi_codegen.systems.system import MechanicalSystem

if TYPE_CHECKING:
    from scvi_codegen.common.display.tables import TableBlock
    from scvi_codegen.methods.recurrence import ExplicitStep
    from scvi_codegen.methods.stage_system import StageSystem
    from scvi_codegen.methods.tables.number_tables import Part
    from scvi_codegen.systems.splittings.kinetic import KineticSplitting
    from scvi_codegen.systems.symmetry.symmetry import Symmetry

degree_count = partial(checked_count, least=1, most=MAX_STAGES, error=MethodError)
"""Validation of a degree or a number of stages."""

Specification = Mapping[str, str | int | bool | Sequence[float]]


@dataclass(frozen=True, slots=True, kw_only=True)
class Exactness:
    """Momentum maps that a method conserves to round-off at any step size; by default none is claimed.

    A variational method of degree s conserves a momentum map if the symmetry maps its curves to each other (A constant,
    b of degree s in t) and its quadrature is exact for df/dt along them (of degree d s + k - 1 for terms t^k q^d of f):
    L_d then changes by the difference of f between the ends. Runge-Kutta methods in phase space conserve momentum maps
    linear in (t, q, p), symplectic ones also quadratic ones. Other momentum maps may be conserved without being
    claimed.

    Attributes:
        polynomials: degree of the polynomials in (t, q, p) that the method conserves whenever the flow does.
        curve, quadrature: degree of the curves, and order of the quadrature along them, of a variational method.
        gauge: highest degree of f in q, if bounded otherwise than by the quadrature.
    """

    polynomials: int = 0
    curve: int = -1
    quadrature: int = -1
    gauge: float = math.inf

    def conserves(self, symmetry: Symmetry) -> bool:
        """Return whether the momentum map of a symmetry is conserved exactly."""
        terms = symmetry.degrees()
        if terms is None:
            return False
        return max(map(sum, terms)) <= self.polynomials or all(self._allows(*term) for term in terms)

    def _allows(self, k: int, d: int, e: int) -> bool:
        """Return whether a term t^k q^d p^e is admissible: in the direction (e = 1) or the gauge (e = 0)."""
        if e == 0:
            return d <= self.gauge and d * self.curve + k <= self.quadrature
        return e == 1 and ((d == 0 and k <= self.curve) or (d == 1 and k == 0 <= self.curve))


class Method(ABC):
    """Base class of one-step methods for the Euler-Lagrange equations: (t, q0, p0), h -> (q1, p1)."""

    __slots__ = ()

    @property
    @abstractmethod
    def name(self) -> str:
        """Identifier, unique among methods: ``"svi-8-gauss-legendre-8"``."""

    @property
    @abstractmethod
    def order(self) -> int | None:
        """Order of convergence in h for smooth regular systems; ``None`` if none is claimed."""

    @property
    @abstractmethod
    def symmetric(self) -> bool:
        """True if the step with -h is the inverse of the step with h."""

    @property
    @abstractmethod
    def symplectic(self) -> bool:
        """True if the step preserves dq ^ dp for every regular Lagrangian."""

    @property
    def needs_regular(self) -> bool:
        """True if velocities must determine momenta: for a Hamiltonian, d2H/dp2 must be regular."""
        return False

    @property
    def needs_lagrangian(self) -> bool:
        """True if the method applies to Lagrangians only."""
        return False

    @property
    def exactness(self) -> Exactness:
        """Momentum maps conserved to round-off; by default none is claimed."""
        return Exactness()

    def explicit_step(self, split: KineticSplitting) -> ExplicitStep | None:
        """Return the statements of an explicit step for a separable system; ``None`` for other methods."""
        return None

    @property
    def fractions(self) -> Vector:
        """Fractions of h of the leapfrog steps that form an explicit step for separable L; empty for other methods."""
        return ()

    @property
    def drifts_first(self) -> bool:
        """True if its leapfrog steps are drift-kick-drift instead of kick-drift-kick."""
        return False

    @property
    def implicit(self) -> bool:
        """True if a step requires the solution of equations; false for compositions of leapfrog steps."""
        return True

    @property
    def frequency(self) -> float | None:
        """Fitted frequency in radians per step, or ``None``; with one, no order for h to 0 is claimed."""
        return None

    @property
    @abstractmethod
    def title(self) -> str:
        """Display title."""

    @property
    def parts(self) -> tuple[Part, ...]:
        """Nodes, quadrature and tableau that the method is made from."""
        return ()

    @property
    def tables(self) -> tuple[TableBlock, ...]:
        """Nodes, quadratures and tableaux as tables, in radicals where these are short."""
        from scvi_codegen.methods.tables.number_tables import number_table  # imports SymPy

        return tuple(map(number_table, self.parts))

    @property
    def closed_forms(self) -> list[Sequence[Any] | None]:
        """Points, weights and coefficients of each part as rationals and radicals; ``None`` for other numbers."""
        from scvi_codegen.methods.tables.closed_forms import exact_part

        return [*map(exact_part, self.parts)]

    def _repr_html_(self) -> str:
        from scvi_codegen.methods.tables.number_tables import numbers_html

        facts = (
            ("name", plain(self.name)),
            ("order", plain("none claimed" if self.order is None else self.order)),
            ("symplectic", plain("yes" if self.symplectic else "no")),
            ("symmetric", plain("yes" if self.symmetric else "no")),
        )
        return card(self.title, facts, *map(numbers_html, self.tables))

    def key(self) -> tuple[str, ...]:
        """Return the key of this method in caches, made from its type and all of its fields."""
        return (key_of(self),)

    @abstractmethod
    def specification(self) -> Specification:
        """Return the method as plain data that ``method_from_specification`` accepts (model files, command line)."""

    @abstractmethod
    def stage_system(self, system: MechanicalSystem) -> StageSystem:
        """Return the compiled equations, with velocities as unknowns."""

    def paper_form(self, system: MechanicalSystem) -> StageSystem:
        """Return the equations in the paper's notation; by default, for methods that it does not print, the same."""
        return self.stage_system(system)


Kind = TypeVar("Kind")


class NodalMethod(Method):
    """Method with the nodes of a polynomial, resolved when it is constructed."""

    __slots__ = ()
    nodes: Nodes | str | None

    @property
    def node_set(self) -> Nodes:
        """Nodes of the curve of a step."""
        assert isinstance(self.nodes, Nodes)
        return self.nodes


def _resolved(value: object, kind: type[Kind], by_name: Callable[[str], Kind], requirement: str, example: str) -> Kind:
    item = by_name(value) if isinstance(value, str) else value
    if not isinstance(item, kind):
        raise MethodError(f"{requirement} {kind.__name__}, or a name such as '{example}', not {item!r}")
    return item


def resolve_quadrature(quadrature: Quadrature | str | None, degree: int) -> Quadrature:
    """Return a quadrature from an object or a name; by default ``degree`` Gauss points."""
    rule = gauss_legendre(degree) if quadrature is None else quadrature
    return _resolved(rule, Quadrature, quadrature_by_name, "quadrature must be a", f"gauss-legendre:{degree}")


def resolve_space(space: CurveSpace | str | None) -> CurveSpace:
    """Return a space of trial curves from an object or a name; by default polynomials."""
    curve_space = Polynomials() if space is None else space
    return _resolved(curve_space, CurveSpace, space_by_name, "space must be a", "splines:2")  # type: ignore[type-abstract]


def resolve_nodes(nodes: Nodes | str | None, degree: int) -> Nodes:
    """Return nodes from an object or a name, checked to contain both ends; by default Chebyshev-Lobatto nodes."""
    named, example = partial(nodes_by_name, degree=degree), "chebyshev-lobatto"
    nodes = _resolved(example if nodes is None else nodes, Nodes, named, "nodes must be", example)
    if nodes.degree != degree:
        raise MethodError(
            f"nodes of degree {nodes.degree} do not match a curve of degree {degree}: give nodes of degree {degree}"
        )
    if not nodes.contains_ends:
        raise MethodError(
            f"the nodes '{nodes.name}' lack an end point of the step, but Q^0 = q0 and Q^s = q1 must be node values; "
            "use chebyshev-lobatto, legendre-lobatto or equispaced"
        )
    return nodes
