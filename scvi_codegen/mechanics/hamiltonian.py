"""Hamiltonian systems and Legendre transforms in both directions.

Hamilton's principle in phase space (paper, section 1.1) makes the action of p . v - H(q, p, t) stationary in q and p.
It needs no Lagrangian: systems with singular d2H/dp2, such as H = q p or point vortices, are integrated as well, by
methods that do not require a regular one (:attr:`~scvi_codegen.methods.method.Method.needs_regular`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, cast

import sympy
from sympy import Expr, Symbol

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.formulas.derivatives import gradient
from scvi_codegen.formulas.grammar import parse_expression
from scvi_codegen.formulas.inputs import input_formulas, with_inputs
from scvi_codegen.formulas.symbols import TIME, check_names, name_of_key, number, symbol
from scvi_codegen.formulas.translation import Translation, sympy_expression
from scvi_codegen.mechanics.arrays.elements import unrolled_fields
from scvi_codegen.mechanics.arrays.system import ArrayHamiltonian, ArraySystem, are_arrays
from scvi_codegen.mechanics.constraints import constraints_of
from scvi_codegen.mechanics.damping import damping_rate
from scvi_codegen.mechanics.forces import forces_by_coordinate
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.mechanics.legendre import legendre_dual
from scvi_codegen.mechanics.plausibility import warn_of_mistakes
from scvi_codegen.mechanics.regularity import singular_part
from scvi_codegen.mechanics.system import MechanicalSystem, named_parameters
from scvi_codegen.representation import summary
from scvi_codegen.validation.argument_types import (
    FORMULA,
    FORMULAS,
    MAPPED,
    MAPPING,
    NAMES,
    TEXT,
    TEXTS,
    checks_arguments,
    of,
)

__all__ = ["HamiltonianSystem", "equivalent_lagrangian", "hamiltonian_of", "lagrangian_of"]


@dataclass(frozen=True, slots=True, kw_only=True)
class HamiltonianSystem(MechanicalSystem):
    """Hamiltonian H(q, p, t; parameters) in m coordinates and momenta, validated on construction.

    Build one with ``from_text`` or ``from_sympy``, or from a Lagrangian with :func:`hamiltonian_of`. Every method
    accepts it in place of a Lagrangian; variational methods then discretise Hamilton's principle in phase space, (35).

    Attributes:
        name, coordinates, time, parameters, defaults: see :class:`~scvi_codegen.mechanics.system.MechanicalSystem`.
        momenta: the m momenta, parallel to ``coordinates``.
        hamiltonian: H, exact: it contains no floating-point numbers.

    Raises:
        SystemDefinitionError: naming the symbol at fault.
    """

    momenta: tuple[Symbol, ...]
    hamiltonian: Expr

    __repr__ = summary("name", "coordinates", "momenta")

    def __post_init__(self) -> None:
        if len(self.momenta) != len(self.coordinates):
            raise SystemDefinitionError(
                f"there are {len(self.coordinates)} coordinates, but {len(self.momenta)} momenta: "
                "list one momentum per coordinate"
            )
        if self.constraints:
            raise SystemDefinitionError(
                f"'{self.name}' is a Hamiltonian with constraints, which are supported for "
                "Lagrangians only: use lagrangian_of(system, constraints=[...]), which has the same "
                "momenta"
            )
        self._check("Hamiltonian", self.momenta, "a momentum")

    @classmethod
    @checks_arguments(
        SystemDefinitionError,
        name=TEXT,
        coordinates=NAMES,
        hamiltonian=TEXT,
        momenta=NAMES,
        parameters=MAPPING,
        damping=FORMULA,
        constraints=TEXTS,
        inputs=NAMES,
        tables=TEXTS,
    )
    def from_text(
        cls,
        name: str,
        coordinates: Sequence[str],
        hamiltonian: str,
        *,
        momenta: Sequence[str] | None = None,
        parameters: Mapping[str, float] | None = None,
        forces: Mapping[str, str] | None = None,
        damping: str | float | None = None,
        constraints: Sequence[str] = (),
        inputs: Sequence[str] = (),
        tables: Sequence[str] = (),
    ) -> HamiltonianSystem:
        """Read H from text of the grammar in :mod:`scvi_codegen.formulas.grammar`.

        Arrays are declared and treated as in :meth:`LagrangianSystem.from_text`.

        Args:
            name: name of the system.
            coordinates: names of the coordinates, and declarations of arrays, ``["x", "q[N]"]``.
            hamiltonian: the formula; it may span several lines.
            momenta: names of the momenta, declared as the coordinates are; by default ``p_`` before the name of the
                coordinate.
            parameters: default value by name, or of all entries by declaration of an array.
            forces: formula by coordinate, in coordinates, momenta and time, added to the rate of its momentum.
            damping: damping rate of all momenta, a number or a formula of parameters
                (:mod:`scvi_codegen.mechanics.damping`).
            constraints: must be empty; :func:`lagrangian_of` accepts constraints.
            inputs: names of functions of time whose values are passed to each run
                (:mod:`scvi_codegen.formulas.inputs`).
            tables: declarations of index tables.

        >>> HamiltonianSystem.from_text(
        ...     name="pendulum", coordinates=["q"], momenta=["p"], hamiltonian="p**2/2 - cos(q)"
        ... ).lagrangian
        -p**2/2 + p*q_dot + cos(q)
        """
        if are_arrays(coordinates, parameters or (), tables):
            arrays = ArraySystem.from_text(
                name=name,
                coordinates=coordinates,
                hamiltonian=hamiltonian,
                momenta=momenta,
                parameters=parameters,
                tables=tables,
                forces=forces,
                damping=damping,
                inputs=inputs,
                constraints=constraints,
            )
            return cast(HamiltonianSystem, arrays) if arrays.sizes else cls(**unrolled_fields(arrays, {}))
        names = _default_momenta(coordinates) if momenta is None else tuple(momenta)
        values = with_inputs(parameters or {}, inputs)
        check_names(coordinates, (*values, *inputs), names)
        symbols = {each: symbol(each) for each in [*coordinates, *names, TIME, *values, *inputs]}
        variables = tuple(symbols[each] for each in coordinates)
        driven = input_formulas(inputs, symbols[TIME])

        def read(text: str) -> Expr:
            return parse_expression(text, symbols).xreplace(driven)

        system = cls(
            name=name,
            coordinates=variables,
            momenta=tuple(symbols[each] for each in names),
            time=symbols[TIME],
            parameters=tuple(symbols[each] for each in values),
            defaults=tuple(number(each, value) for each, value in values.items()),
            hamiltonian=read(hamiltonian),
            forces=forces_by_coordinate(variables, forces or {}, read),
            damping=damping_rate(damping, lambda formula: read(str(formula))),
            constraints=constraints_of(constraints, read),
            inputs=tuple(inputs),
        )
        warn_of_mistakes(system)
        return system

    @classmethod
    @checks_arguments(
        SystemDefinitionError,
        name=TEXT,
        coordinates=FORMULAS,
        momenta=FORMULAS,
        parameters=MAPPED,
        forces=MAPPED,
        inputs=FORMULAS,
    )
    def from_sympy(
        cls,
        *,
        name: str,
        hamiltonian: Expr,
        coordinates: Sequence[Expr],
        momenta: Sequence[Expr],
        time: Symbol | None = None,
        parameters: Mapping[Symbol | str, float] | None = None,
        forces: Mapping[Expr | str, Expr] | None = None,
        damping: Expr | float | None = None,
        inputs: Sequence[Any] = (),
    ) -> HamiltonianSystem:
        """Create the system from a SymPy expression in plain symbols or in functions of time.

        Floating-point numbers become the rationals of their shortest decimal form; symbols become canonical as
        described in :mod:`scvi_codegen.formulas.symbols`.

        Args:
            name: name of the system.
            hamiltonian: H.
            coordinates, momenta: symbols or functions of time, parallel to each other.
            time: the symbol for time; by default the argument of the coordinates, or the symbol called ``t``.
            parameters: default value by symbol or by name.
            forces: expression by coordinate, in coordinates, momenta and time.
            damping: damping rate of all momenta, an expression in parameters.
            inputs: functions of time, symbols or names whose values are passed to each run.
        """
        hamiltonian = sympy_expression(hamiltonian, "Hamiltonian")
        applied = {q: sympy_expression(f, f"force on {q}") for q, f in (forces or {}).items()}
        rate = damping_rate(damping, lambda formula: sympy_expression(formula, "damping"))
        input_names = tuple(name_of_key(each) for each in inputs)
        constants = with_inputs(named_parameters(parameters), input_names)
        translation = Translation(
            hamiltonian,
            coordinates,
            (*applied.values(), rate),
            momenta=momenta,
            time=time,
            parameters=tuple(constants),
            inputs=input_names,
        )
        driven = input_formulas(input_names, symbol(TIME))
        system = cls(
            name=name,
            coordinates=translation.coordinates,
            momenta=translation.momenta,
            time=symbol(TIME),
            parameters=translation.parameters,
            defaults=tuple(number(parameter, value) for parameter, value in constants.items()),
            hamiltonian=translation.apply(hamiltonian, "Hamiltonian").xreplace(driven),
            forces=forces_by_coordinate(
                translation.coordinates,
                {translation.rules.get(q, q): f for q, f in applied.items()},
                lambda formula: translation.apply(formula, "forces").xreplace(driven),
            ),
            damping=translation.apply(rate, "damping").xreplace(driven),
            inputs=input_names,
        )
        warn_of_mistakes(system)
        return system

    @property
    def lagrangian(self) -> Expr:
        """Integrand p . v - H of Hamilton's principle in phase space."""
        products = [p * v for p, v in zip(self.momenta, self.velocities, strict=True)]
        return sympy.Add(*products, -self.hamiltonian)

    @property
    def auxiliaries(self) -> tuple[Symbol, ...]:
        """Momenta."""
        return self.momenta

    @property
    def formula(self) -> Expr:
        """H."""
        return self.hamiltonian

    @property
    def is_regular(self) -> bool:
        """True if d2H/dp2 is invertible at some sampled point, so that velocities determine momenta."""
        return _is_regular(self)

    def _repr_latex_(self) -> str:
        return rf"$\displaystyle H = {sympy.latex(self.hamiltonian)}$"


HamiltonianSystem.register(ArrayHamiltonian)


@checks_arguments(system=of("a LagrangianSystem", LagrangianSystem), momenta=NAMES)
def hamiltonian_of(system: LagrangianSystem, *, momenta: Sequence[str] | None = None) -> HamiltonianSystem:
    """Return the Hamiltonian p . v - L of a Lagrangian, with v eliminated by p = dL/dv (paper, section 1.1).

    Args:
        system: the Lagrangian.
        momenta: names of the momenta; by default ``p_`` before the name of the coordinate.

    Raises:
        SystemDefinitionError: if SymPy finds no closed-form solution of p = dL/dv.

    >>> oscillator = LagrangianSystem.from_text(
    ...     name="oscillator", coordinates=["x"], lagrangian="m*x_dot**2/2 - k*x**2/2", parameters={"m": 1, "k": 2})
    >>> hamiltonian_of(oscillator).hamiltonian
    k*x**2/2 + p_x**2/(2*m)
    """
    if system.constraints:
        raise SystemDefinitionError(
            f"'{system.name}' has constraints, which are supported for Lagrangians only: keep the "
            "Lagrangian, or convert it without constraints"
        )
    names = _default_momenta([q.name for q in system.coordinates]) if momenta is None else tuple(momenta)
    if len(names) != system.dimension:
        raise SystemDefinitionError(
            f"there are {system.dimension} coordinates, but {len(names)} momenta: list one momentum per coordinate"
        )
    symbols = tuple(symbol(name) for name in names)
    hamiltonian = legendre_dual(system, system.velocities, symbols)
    velocities = dict(zip(system.velocities, _gradient_tuple(hamiltonian, symbols), strict=True))
    return HamiltonianSystem(
        name=system.name,
        coordinates=system.coordinates,
        momenta=symbols,
        time=system.time,
        parameters=system.parameters,
        defaults=system.defaults,
        hamiltonian=hamiltonian,
        clock=system.clock,
        forces=tuple(f.xreplace(velocities) for f in system.forces),
        damping=system.damping,
        inputs=system.inputs,
    )


@checks_arguments(system=of("a HamiltonianSystem", HamiltonianSystem), constraints=TEXTS)
def lagrangian_of(system: HamiltonianSystem, *, constraints: Sequence[str] = ()) -> LagrangianSystem:
    """Return the Lagrangian p . v - H of a Hamiltonian, with p eliminated by v = dH/dp (paper, section 1.1).

    Args:
        system: the Hamiltonian.
        constraints: as of :meth:`LagrangianSystem.from_text`; they add G^T lambda to p' = -H_q. Momenta are those of
            the Hamiltonian.

    Raises:
        SystemDefinitionError: if d2H/dp2 is singular, or SymPy finds no closed-form solution of v = dH/dp.
    """
    lagrangian = _lagrangian_of(system)
    if not constraints:
        return lagrangian
    known = {x.name: x for x in (*system.coordinates, *lagrangian.velocities, system.time, *system.parameters)}
    known |= {name: symbol(name) for name in system.inputs}
    driven = input_formulas(system.inputs, system.time)
    return replace(
        lagrangian, constraints=constraints_of(constraints, lambda g: parse_expression(g, known).xreplace(driven))
    )


@lru_cache(maxsize=64)
def _lagrangian_of(system: HamiltonianSystem) -> LagrangianSystem:
    if not system.is_regular:
        raise SystemDefinitionError(
            f"'{system.name}' has no Lagrangian: d2H/dp2 is singular, so velocities do not determine "
            "momenta. Use the Hamiltonian"
        )
    if system.clock and system.clock.rate.free_symbols & set(system.momenta):
        raise SystemDefinitionError(
            f"the time transformation of '{system.name}' depends on momenta, which is not supported for a "
            "Lagrangian: use the Hamiltonian, or a formula in coordinates only"
        )
    lagrangian = legendre_dual(system, system.momenta, system.velocities)
    momenta = dict(zip(system.momenta, _gradient_tuple(lagrangian, system.velocities), strict=True))
    return LagrangianSystem(
        name=system.name,
        coordinates=system.coordinates,
        time=system.time,
        parameters=system.parameters,
        defaults=system.defaults,
        lagrangian=lagrangian,
        clock=system.clock,
        forces=tuple(f.xreplace(momenta) for f in system.forces),
        damping=system.damping,
        inputs=system.inputs,
    )


def equivalent_lagrangian(system: MechanicalSystem) -> LagrangianSystem | None:
    """Return an equivalent Lagrangian system, possibly ``system`` itself; ``None`` if none is found."""
    if isinstance(system, LagrangianSystem):
        return system
    return _equivalent_lagrangian(system) if isinstance(system, HamiltonianSystem) else None


@lru_cache(maxsize=64)
def _equivalent_lagrangian(system: HamiltonianSystem) -> LagrangianSystem | None:
    try:
        return _lagrangian_of(system)
    except SystemDefinitionError:
        return None


@lru_cache(maxsize=64)
def _is_regular(system: HamiltonianSystem) -> bool:
    others = (*system.coordinates, system.time)
    return singular_part(system.hamiltonian, system.momenta, others, system.constants) is None


def _default_momenta(coordinates: Sequence[str]) -> tuple[str, ...]:
    return tuple(f"p_{name}" for name in coordinates)


def _gradient_tuple(f: Expr, variables: Sequence[Symbol]) -> tuple[Expr, ...]:
    partials = gradient(f, variables)
    return tuple(partials.get(i, sympy.S.Zero) for i in range(len(variables)))
