"""Base class of integration methods: frozen data with properties and stage equations for a system.

A method is a frozen dataclass derived from :class:`Method` in a file of its own and a line in ``METHODS``
(:mod:`scvi_codegen.methods`). It must define a name, a title, its order, whether it is symmetric and symplectic, a
specification, and two forms of its equations, which may coincide: as compiled, and as printed in the paper. Other
properties (for solvers, verification reports, momentum maps) have defaults here that claim nothing and may be
overridden. Code outside this package does not distinguish between kinds of methods.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import partial

import sympy

from scvi_codegen.display.cards import card, plain
from scvi_codegen.display.number_tables import Part, number_table, numbers_html
from scvi_codegen.errors import MethodError
from scvi_codegen.formulas.subexpressions import key_of
from scvi_codegen.mechanics.constraints import nonholonomic_expressions
from scvi_codegen.mechanics.derived_expressions import forms_of
from scvi_codegen.mechanics.hamiltonian import HamiltonianSystem
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.exactness import Exactness
from scvi_codegen.methods.stage_system import Scatter, StageGroup, StageSystem, dyadic
from scvi_codegen.tables.precision import Number, Vector, mp
from scvi_codegen.tables.tableau import MAX_STAGES
from scvi_codegen.validation.counts import checked_count

__all__ = [
    "Method",
    "Specification",
    "check_regular",
    "degree_count",
    "is_symplectic",
    "lagrangian_scatters",
    "unit_sum",
]

degree_count = partial(checked_count, least=1, most=MAX_STAGES, error=MethodError)
"""Validation of a degree or a number of stages."""

Specification = Mapping[str, str | int | bool | Sequence[float]]


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

    @property
    def fractions(self) -> Vector:
        """Fractions of h of the leapfrog steps that form a step for separable L; empty for other methods.

        A method with fractions is explicit for separable L.
        """
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

    def _repr_html_(self) -> str:
        facts = (
            ("name", plain(self.name)),
            ("order", plain("none claimed" if self.order is None else self.order)),
            ("symplectic", plain("yes" if self.symplectic else "no")),
            ("symmetric", plain("yes" if self.symmetric else "no")),
        )
        return card(self.title, facts, *(numbers_html(number_table(part)) for part in self.parts))

    def key(self) -> tuple[str, ...]:
        """Return the key of this method in caches, made from its type and all of its fields."""
        return (key_of(self),)

    @abstractmethod
    def specification(self) -> Specification:
        """Return the method as plain data that ``method_from_specification`` accepts (model files, command line)."""

    @abstractmethod
    def stage_system(self, system: MechanicalSystem) -> StageSystem:
        """Return the compiled equations, with velocities as unknowns."""

    @abstractmethod
    def paper_form(self, system: MechanicalSystem) -> StageSystem:
        """Return the equations in the paper's notation."""


def check_regular(method: Method, system: MechanicalSystem) -> None:
    """Raise :class:`MethodError` for a Hamiltonian with singular d2H/dp2 and a method that requires regularity."""
    if method.needs_regular and isinstance(system, HamiltonianSystem) and not system.is_regular:
        raise MethodError(
            f"{method.name} requires a regular Hamiltonian, but d2H/dp2 of '{system.name}' is "
            "singular: use an SVI with as many quadrature points as its degree, or a Runge-Kutta or "
            "collocation method in phase-space form"
        )


def is_symplectic(method: Method, system: MechanicalSystem) -> bool:
    """Return whether the steps preserve dq ^ dp: not with forces, damping or nonholonomic constraints."""
    return system.damping == 0 and is_conformally_symplectic(method, system)


def is_conformally_symplectic(method: Method, system: MechanicalSystem) -> bool:
    """Return whether the steps multiply dq ^ dp by exp(-gamma h), where gamma is the damping rate."""
    return method.symplectic and not system.forces and not any(nonholonomic_expressions(system))


def unit_sum(weights: Sequence[Number]) -> Vector:
    """Round weights in [0, 1] to multiples of 2^-52 and adjust the largest so that they sum to exactly 1.

    Weights whose sum is not 1 (of an unusual quadrature) are only rounded.
    """
    rounded = list(dyadic([weights])[0])
    excess = mp.fsum(rounded) - 1
    if abs(excess) < mp.mpf("1e-12"):
        largest = max(range(len(rounded)), key=lambda n: abs(rounded[n]))
        rounded[largest] -= excess
    return tuple(rounded)


def lagrangian_scatters(
    group: StageGroup, system: MechanicalSystem, force_scatter: Scatter, momentum_scatter: Scatter
) -> StageGroup:
    """Return ``group`` with L_q and L_v as kernel results, which fill in the ``results`` of these scatters."""
    filled = (
        _with_results(force_scatter, forms_of(system).force),
        _with_results(momentum_scatter, forms_of(system).momentum),
    )
    return StageGroup(
        name=group.name,
        abscissae=group.abscissae,
        weights=group.weights,
        weight_names=group.weight_names,
        gathers=group.gathers,
        scatters=filled,
    )


def _with_results(scatter: Scatter, results: tuple[sympy.Expr, ...]) -> Scatter:
    return Scatter(results=results, table=scatter.table, power=scatter.power, scale=scatter.scale)
