"""What every method is: frozen data that knows its properties and gives its stage equations for a system.

A method is a frozen dataclass of :class:`Method` in a file of its own and a line in ``METHODS``
(:mod:`scvi_codegen.methods`). It must give a name, a title, its order, whether it is symmetric and symplectic, a
specification, and two readings of its equations, which may be one: as compiled, and as the paper prints them. What else
others ask of it (solvers, certificates, momentum maps) has an answer here that claims nothing, which it may better.
Nobody outside of this folder asks what kind of method it is.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from functools import partial

import sympy

from scvi_codegen.display.cards import card, plain
from scvi_codegen.display.number_tables import Part, number_table, numbers_html
from scvi_codegen.errors import MethodError
from scvi_codegen.formulas.parts import key_of
from scvi_codegen.given.counts import checked_count
from scvi_codegen.mechanics.constraints import velocities_held
from scvi_codegen.mechanics.forms import forms_of
from scvi_codegen.mechanics.hamiltonian import HamiltonianSystem
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.exactness import Exactness
from scvi_codegen.methods.stage_system import PointFamily, Scatter, StageSystem, dyadic
from scvi_codegen.tables.precision import Number, Vector, mp
from scvi_codegen.tables.tableau import MOST_STAGES

__all__ = [
    "Method",
    "Specification",
    "check_regular",
    "degree_count",
    "is_symplectic",
    "lagrangian_scatters",
    "unit_sum",
]

degree_count = partial(checked_count, least=1, most=MOST_STAGES, error=MethodError)
"""A degree, or a number of stages."""

Specification = Mapping[str, str | int | bool | Sequence[float]]


class Method(ABC):
    """One-step method for the Euler-Lagrange equations: (t, q0, p0), h -> (q1, p1)."""

    __slots__ = ()

    @property
    @abstractmethod
    def name(self) -> str:
        """Short identifier, unique among methods: ``"svi-8-gauss-legendre-8"``."""

    @property
    @abstractmethod
    def order(self) -> int | None:
        """Order of convergence in h for smooth regular systems; ``None`` where none is claimed."""

    @property
    @abstractmethod
    def symmetric(self) -> bool:
        """Whether the step with -h undoes the step with h."""

    @property
    @abstractmethod
    def symplectic(self) -> bool:
        """Whether the step preserves dq ^ dp for every regular Lagrangian."""

    @property
    def needs_regular(self) -> bool:
        """Whether momenta must be determined by velocities: for a Hamiltonian, d2H/dp2 regular."""
        return False

    @property
    def needs_lagrangian(self) -> bool:
        """Whether a Hamiltonian will not do."""
        return False

    @property
    def exactness(self) -> Exactness:
        """Which momentum maps are conserved to round-off; by default none is claimed."""
        return Exactness()

    @property
    def fractions(self) -> Vector:
        """Sizes of the leapfrog steps, as fractions of h, that the step consists of where L is separable; or none.

        With some the method is explicit there.
        """
        return ()

    @property
    def drifts_first(self) -> bool:
        """Whether each of these leapfrog steps is a drift, a kick and a drift, not a kick, a drift and a kick."""
        return False

    @property
    def implicit(self) -> bool:
        """Whether there are equations to solve; not for methods that are nothing but leapfrog steps."""
        return True

    @property
    def frequency(self) -> float | None:
        """In radians a step, where the curves are fitted to one: then nothing is promised for h to 0."""
        return None

    @property
    @abstractmethod
    def title(self) -> str:
        """One line for people."""

    @property
    def parts(self) -> tuple[Part, ...]:
        """The nodes, quadrature and tableau that its numbers are made from."""
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
        """The method as plain data, read back by ``method_from_specification`` (model files, command line)."""

    @abstractmethod
    def stage_system(self, system: MechanicalSystem) -> StageSystem:
        """The equations as compiled: velocities as unknowns."""

    @abstractmethod
    def paper_form(self, system: MechanicalSystem) -> StageSystem:
        """The equations as the paper prints them."""


def check_regular(method: Method, system: MechanicalSystem) -> None:
    """Raise :class:`MethodError` for a Hamiltonian that determines no velocities and a method that needs them."""
    if method.needs_regular and isinstance(system, HamiltonianSystem) and not system.is_regular:
        raise MethodError(
            f"{method.name} needs a Hamiltonian that determines momenta by velocities, but d2H/dp2 of '{system.name}' "
            "is singular: use an SVI with as many quadrature points as its degree, or a Runge-Kutta or collocation "
            "method in phase-space form"
        )


def is_symplectic(method: Method, system: MechanicalSystem) -> bool:
    """Whether the steps preserve dq ^ dp: of a symplectic method, where no forces act and nothing holds velocities."""
    return system.damping == 0 and is_conformally_symplectic(method, system)


def is_conformally_symplectic(method: Method, system: MechanicalSystem) -> bool:
    """Whether they multiply dq ^ dp by exp(-gamma h), gamma the damping, with nothing else that changes it."""
    return method.symplectic and not system.forces and not any(velocities_held(system))


def unit_sum(weights: Sequence[Number]) -> Vector:
    """Weights in [0, 1] rounded to multiples of 2^-52, the largest adjusted so that they sum to exactly 1.

    Weights whose sum is not 1 (of an unusual quadrature) are rounded only.
    """
    rounded = list(dyadic([weights])[0])
    excess = mp.fsum(rounded) - 1
    if abs(excess) < mp.mpf("1e-12"):
        largest = max(range(len(rounded)), key=lambda n: abs(rounded[n]))
        rounded[largest] -= excess
    return tuple(rounded)


def lagrangian_scatters(
    family: PointFamily, system: MechanicalSystem, force_scatter: Scatter, momentum_scatter: Scatter
) -> PointFamily:
    """``family`` with L_q and L_v as kernel results, scattered as given (their ``results`` are filled in)."""
    filled = (
        _with_results(force_scatter, forms_of(system).force),
        _with_results(momentum_scatter, forms_of(system).momentum),
    )
    return PointFamily(
        name=family.name,
        abscissae=family.abscissae,
        weights=family.weights,
        weight_names=family.weight_names,
        gathers=family.gathers,
        scatters=filled,
    )


def _with_results(scatter: Scatter, results: tuple[sympy.Expr, ...]) -> Scatter:
    return Scatter(results=results, table=scatter.table, power=scatter.power, scale=scatter.scale)
