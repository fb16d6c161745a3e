"""Lagrangian systems, built from text, from SymPy expressions, or from sympy.physics.mechanics."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import sympy
from sympy import Expr, Symbol

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.formulas.derivatives import hessian
from scvi_codegen.formulas.grammar import parse_expression
from scvi_codegen.formulas.inputs import input_formulas, with_inputs
from scvi_codegen.formulas.symbols import DOT, TIME, check_names, name_of_key, number, symbol
from scvi_codegen.formulas.translation import Translation, sympy_expression
from scvi_codegen.mechanics.arrays.elements import unrolled_fields
from scvi_codegen.mechanics.arrays.system import ArrayLagrangian, ArraySystem, are_arrays
from scvi_codegen.mechanics.constraints import check_constraints, constraints_of
from scvi_codegen.mechanics.damping import damping_rate
from scvi_codegen.mechanics.forces import dissipative_forces, forces_by_coordinate
from scvi_codegen.mechanics.plausibility import warn_of_mistakes
from scvi_codegen.mechanics.regularity import null_direction, singular_part
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
    ArgumentType,
    checks_arguments,
)

if TYPE_CHECKING:
    from sympy.physics.mechanics import KanesMethod, LagrangesMethod, System

__all__ = ["LagrangianSystem"]

LAGRANGES_METHOD = ArgumentType("a LagrangesMethod of sympy.physics.mechanics", lambda value: hasattr(value, "lam_vec"))
KANES_METHOD = ArgumentType("a KanesMethod of sympy.physics.mechanics", lambda value: hasattr(value, "kindiffdict"))
BODIES = ArgumentType("a System of sympy.physics.mechanics", lambda value: hasattr(value, "actuators"))

REQUIRED = "A regular Lagrangian is required: d2L/dv2 must be invertible."
REDUNDANT = (
    "Add the missing kinetic energy, or use fewer coordinates: as many as there are independent motions with inertia"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class LagrangianSystem(MechanicalSystem):
    """Lagrangian L(q, q_dot, t; parameters) in m coordinates, validated on construction.

    Build one with ``from_text``, ``from_sympy``, or from SymPy's mechanics with ``from_lagranges_method``,
    ``from_kanes_method`` and ``from_system``. Equality is structural.

    Attributes:
        name, coordinates, time, parameters, defaults: see :class:`~scvi_codegen.mechanics.system.MechanicalSystem`.
        lagrangian: L, exact: it contains no floating-point numbers.

    Raises:
        SystemDefinitionError: naming the symbol at fault, if a name is invalid or used twice, L contains an unknown
            symbol or an unsupported function, a default value is not a finite number, a velocity does not occur in L,
            or the mass matrix d2L/dv2 is singular at every sampled point.
    """

    lagrangian: Expr

    __repr__ = summary("name", "coordinates")

    def __post_init__(self) -> None:
        self._check("Lagrangian", self.velocities, "a velocity")
        _check_velocities(self)
        _check_mass_matrix(self)
        if self.constraints:
            check_constraints(self)

    @property
    def auxiliaries(self) -> tuple[Symbol, ...]:
        """Empty: a Lagrangian has no auxiliary variables."""
        return ()

    @property
    def formula(self) -> Expr:
        """L."""
        return self.lagrangian

    @classmethod
    @checks_arguments(
        SystemDefinitionError,
        name=TEXT,
        coordinates=NAMES,
        lagrangian=TEXT,
        parameters=MAPPING,
        forces=MAPPING,
        dissipation=TEXT,
        damping=FORMULA,
        constraints=TEXTS,
        inputs=NAMES,
        tables=TEXTS,
    )
    def from_text(
        cls,
        name: str,
        coordinates: Sequence[str],
        lagrangian: str,
        *,
        parameters: Mapping[str, float] | None = None,
        forces: Mapping[str, str] | None = None,
        dissipation: str | None = None,
        damping: str | float | None = None,
        constraints: Sequence[str] = (),
        inputs: Sequence[str] = (),
        tables: Sequence[str] = (),
    ) -> LagrangianSystem:
        """Read L from text of the grammar in :mod:`scvi_codegen.formulas.grammar`.

        With arrays the grammar is that of :mod:`scvi_codegen.formulas.arrays`. If all their sizes are numbers, their
        entries are coordinates q_0, q_1, .. like all others. Otherwise the sizes follow from the arrays of a run, or
        from ``sizes`` of :func:`~scvi_codegen.compile_stepper`.

        Args:
            name: name of the system.
            coordinates: names of the coordinates, and declarations of arrays, ``["x", "q[N]", "r[N, 3]"]``, whose sizes
                are names or whole numbers; the velocity of ``q`` is written ``q_dot``, time ``t``.
            lagrangian: the formula; it may span several lines.
            parameters: default value by name, or of all entries by declaration of an array, ``{"k": 1, "m[N]": 1}``.
            forces: formula by coordinate, in coordinates, velocities and time (:mod:`scvi_codegen.mechanics.forces`).
            dissipation: Rayleigh's function D(q, q_dot, t), whose forces -dD/dq_dot are added to them.
            damping: damping rate of all momenta, a number or a formula of parameters
                (:mod:`scvi_codegen.mechanics.damping`).
            constraints: formulas in coordinates and time that are 0, or equations ``"x**2 + y**2 = l**2"``;
                formulas linear in velocities are nonholonomic (:mod:`scvi_codegen.mechanics.constraints`).
            inputs: names of functions of time whose values are passed to each run
                (:mod:`scvi_codegen.formulas.inputs`).
            tables: declarations of index tables with their columns, ``["bonds[B, 2]", "pins[P]"]``.

        >>> oscillator = LagrangianSystem.from_text(
        ...     name="oscillator", coordinates=["x"], lagrangian="m*x_dot**2/2 - k*x**2/2",
        ...     parameters={"m": 1, "k": 2, "c": 0.1}, forces={"x": "cos(t)"}, dissipation="c*x_dot**2/2")
        >>> oscillator.lagrangian, oscillator.forces
        (-k*x**2/2 + m*x_dot**2/2, (-c*x_dot + cos(t),))
        >>> chain = LagrangianSystem.from_text(
        ...     name="chain", coordinates=["q[N]"], parameters={"k": 2},
        ...     lagrangian="sum(i in N, q_dot[i]**2/2) - k*sum(i in N periodic, (q[i+1] - q[i])**2/2)")
        >>> print(chain)
        chain: L(q[N]) = sum(i in N, q_dot[i]**2/2) + sum(i in N periodic, -k*(q[i+1] - q[i])**2/2)
        """
        if are_arrays(coordinates, parameters or (), tables):
            return cls._of_arrays(
                ArraySystem.from_text(
                    name=name,
                    coordinates=coordinates,
                    lagrangian=lagrangian,
                    parameters=parameters,
                    tables=tables,
                    forces=forces,
                    dissipation=dissipation,
                    damping=damping,
                    inputs=inputs,
                    constraints=constraints,
                )
            )
        values = with_inputs(parameters or {}, inputs)
        check_names(coordinates, (*values, *inputs))
        velocities = [coordinate + DOT for coordinate in coordinates]
        names = [*coordinates, *velocities, TIME, *values, *inputs]
        symbols = {symbol_name: symbol(symbol_name) for symbol_name in names}
        variables = tuple(symbols[coordinate] for coordinate in coordinates)
        driven = input_formulas(inputs, symbols[TIME])

        def read(text: str) -> Expr:
            return parse_expression(text, symbols).xreplace(driven)

        system = cls(
            name=name,
            coordinates=variables,
            time=symbols[TIME],
            parameters=tuple(symbols[parameter] for parameter in values),
            defaults=tuple(number(parameter, value) for parameter, value in values.items()),
            lagrangian=read(lagrangian),
            forces=_forces(variables, forces, dissipation, read),
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
        velocities=FORMULAS,
        parameters=MAPPED,
        forces=MAPPED,
        constraints=FORMULAS,
        inputs=FORMULAS,
        tables=TEXTS,
    )
    def from_sympy(
        cls,
        *,
        name: str,
        lagrangian: Expr,
        coordinates: Sequence[Expr | str],
        velocities: Sequence[Expr] | None = None,
        time: Symbol | None = None,
        parameters: Mapping[Any, float] | None = None,
        forces: Mapping[Expr | str, Expr] | None = None,
        dissipation: Expr | None = None,
        damping: Expr | float | None = None,
        constraints: Sequence[Expr] = (),
        inputs: Sequence[Any] = (),
        tables: Sequence[str] = (),
    ) -> LagrangianSystem:
        """Create the system from a SymPy expression in plain symbols or in functions of time.

        Floating-point numbers become the rationals of their shortest decimal form (``0.1`` is 1/10); symbols become
        canonical as described in :mod:`scvi_codegen.formulas.symbols`.

        Args:
            name: name of the system.
            lagrangian: L.
            coordinates: symbols, or functions of time such as ``dynamicsymbols`` returns.
            velocities: parallel to ``coordinates``; by default ``Derivative(q(t), t)`` for a function of time, the
                symbol called ``q_dot`` for a symbol ``q``.
            time: the symbol for time; by default the argument of the coordinates, or the symbol called ``t``.
            parameters: default value by symbol, by name, or by a function of time that is constant.
            forces: expression by coordinate, which is a symbol, a function of time or a name.
            dissipation: Rayleigh's function, whose forces -dD/dv are added to them.
            damping: damping rate of all momenta, an expression in parameters.
            constraints: expressions in coordinates, time and, linearly, velocities that are 0, or equations ``Eq``.
            inputs: functions of time, symbols or names whose values are passed to each run.
            tables: declarations of index tables, as of :meth:`from_text`.

        With arrays, ``coordinates`` and ``parameters`` are as of :meth:`from_text`, and the Lagrangian consists of
        ``Sum`` and ``Indexed``: a periodic index is ``Mod(i + 1, N)``, pairs are ``(j, i + 1, N - 1), (i, 0, N - 2)``,
        a table entry is ``q[bonds[b, 0]]``, the velocity of ``q[i]`` is that of ``IndexedBase("q_dot")``.

        >>> from sympy import IndexedBase, Sum, symbols
        >>> q, v, (i, N) = IndexedBase("q"), IndexedBase("q_dot"), symbols("i N", integer=True)
        >>> kinetic, springs = Sum(v[i] ** 2 / 2, (i, 0, N - 1)), Sum((q[i + 1] - q[i]) ** 2 / 2, (i, 0, N - 2))
        >>> LagrangianSystem.from_sympy(name="chain", coordinates=["q[N]"], lagrangian=kinetic - springs)
        LagrangianSystem(name='chain', coordinates=(q[N]))
        """
        if are_arrays(c for c in coordinates if isinstance(c, str)):
            if any(each for each in (velocities, forces, dissipation, damping, constraints, inputs)):
                raise SystemDefinitionError(
                    "from_sympy reads the Lagrangian, parameters and tables of a system with arrays: give the rest "
                    "as text to from_text"
                )
            names: list[Any] = list(coordinates)
            return cls._of_arrays(
                ArraySystem.from_sympy(
                    name=name, coordinates=names, lagrangian=lagrangian, parameters=parameters, tables=tables
                )
            )
        lagrangian = sympy_expression(lagrangian, "Lagrangian")
        applied = {q: sympy_expression(f, f"force on {q}") for q, f in (forces or {}).items()}
        friction = None if dissipation is None else sympy_expression(dissipation, "dissipation")
        rate = damping_rate(damping, lambda formula: sympy_expression(formula, "damping"))
        conditions = constraints_of(constraints, lambda g: sympy_expression(g, "constraint"))
        input_names = tuple(name_of_key(each) for each in inputs)
        constants = with_inputs(named_parameters(parameters), input_names)
        others = (*applied.values(), *(() if friction is None else (friction,)), rate, *conditions)
        translation = Translation(
            lagrangian,
            coordinates,
            others,
            velocities=velocities,
            time=time,
            parameters=tuple(constants),
            inputs=input_names,
        )
        driven = input_formulas(input_names, symbol(TIME))

        def read(formula: Expr, what: str = "Lagrangian") -> Expr:
            return translation.apply(formula, what).xreplace(driven)

        system = cls(
            name=name,
            coordinates=translation.coordinates,
            time=symbol(TIME),
            parameters=translation.parameters,
            defaults=tuple(number(parameter, value) for parameter, value in constants.items()),
            lagrangian=read(lagrangian),
            forces=_forces(
                translation.coordinates,
                {translation.rules.get(q, q): f for q, f in applied.items()},
                friction,
                lambda formula: read(formula, "forces"),
            ),
            damping=read(rate, "damping"),
            constraints=constraints_of(conditions, lambda formula: read(formula, "constraints")),
            inputs=input_names,
        )
        warn_of_mistakes(system)
        return system

    @classmethod
    def _of_arrays(cls, system: ArraySystem) -> LagrangianSystem:
        """Return the system of named coordinates of arrays of known sizes, others as they are."""
        return cast(LagrangianSystem, system) if system.sizes else cls(**unrolled_fields(system, {}))

    @classmethod
    @checks_arguments(SystemDefinitionError, method=LAGRANGES_METHOD)
    def from_lagranges_method(
        cls,
        method: LagrangesMethod,
        *,
        name: str = "mechanism",
        parameters: Mapping[Any, float] | None = None,
        inputs: Sequence[Any] = (),
    ) -> LagrangianSystem:
        """Create the system from a ``sympy.physics.mechanics.LagrangesMethod``, with its forces and constraints.

        Forces and torques of its ``forcelist`` are projected on the coordinates by the velocities of their points and
        the angular velocities of their frames: f_i = sum F . dv/dq_dot_i. As in SymPy its ``bodies`` are not used:
        their energies are part of its Lagrangian.
        """
        from scvi_codegen.mechanics.multibody.readers import forces_of_lagranges_method

        holonomic = [sympy.sympify(g) for g in method._hol_coneqs]  # private attribute: SymPy has no public one
        rolling = list(method.coneqs)[len(holonomic) :]  # coneqs begins with the rates of the holonomic constraints
        lagrangian = method._L[0]  # private attribute: SymPy has no public one
        return cls.from_sympy(
            name=name,
            lagrangian=lagrangian,
            coordinates=list(method.q),
            parameters=parameters,
            forces=forces_of_lagranges_method(method),
            constraints=[*holonomic, *rolling],
            inputs=inputs,
        )

    @classmethod
    @checks_arguments(SystemDefinitionError, method=KANES_METHOD)
    def from_kanes_method(
        cls,
        method: KanesMethod,
        *,
        name: str = "mechanism",
        parameters: Mapping[Any, float] | None = None,
        inputs: Sequence[Any] = (),
    ) -> LagrangianSystem:
        """Create the system from a ``sympy.physics.mechanics.KanesMethod``, by its bodies and loads.

        Generalised speeds are expressed by the rates of the coordinates. Loads that depend only on coordinates and have
        a potential become a potential energy; all others are generalised forces, as are the terms of Kane's equations
        beyond Lagrange's if constraints are built into velocities (a rolling disc). Potential energies of bodies are
        not used, as in Kane's equations; accelerations follow from velocities, and those set by hand are ignored.
        Holonomic constraints, and velocity constraints that they do not imply, become constraints. A speed without a
        coordinate, which nothing depends on, gets one, ``integral_u``.

        Args:
            method: with bodies and kinematic equations; its equations need not have been formed.
            name: name of the system.
            parameters: default value by symbol, by function of time that is constant, or by name.
            inputs: functions of time, such as ``dynamicsymbols("F")``, whose values are passed to each run.

        Raises:
            SystemDefinitionError: if generalised speeds are not an invertible combination of the rates of the
                coordinates, bodies are missing, or a symbol has no value.
        """
        from scvi_codegen.mechanics.multibody.readers import of_kanes_method

        return cls.from_sympy(name=name, parameters=parameters, inputs=inputs, **of_kanes_method(method).formulas())

    @classmethod
    @checks_arguments(SystemDefinitionError, system=BODIES)
    def from_system(
        cls,
        system: System,
        *,
        name: str = "mechanism",
        parameters: Mapping[Any, float] | None = None,
        inputs: Sequence[Any] = (),
    ) -> LagrangianSystem:
        """Create the system from a ``System`` of ``sympy.physics.mechanics``: bodies, joints, loads, constraints.

        Like :meth:`from_kanes_method`, but with the potential energies of its bodies, unless its equations were formed
        by Kane's method, which does not use them.

        Args:
            system: its equations need not have been formed.
            name, parameters, inputs: see :meth:`from_kanes_method`.
        """
        from scvi_codegen.mechanics.multibody.readers import of_system

        return cls.from_sympy(name=name, parameters=parameters, inputs=inputs, **of_system(system).formulas())

    def _repr_latex_(self) -> str:
        dotted = {
            velocity: rf"\dot{{{sympy.latex(coordinate)}}}"
            for coordinate, velocity in zip(self.coordinates, self.velocities, strict=True)
        }
        return rf"$\displaystyle L = {sympy.latex(self.lagrangian, symbol_names=dotted)}$"


LagrangianSystem.register(ArrayLagrangian)


def _forces(
    coordinates: tuple[Symbol, ...],
    applied: Mapping[Any, Any] | None,
    dissipation: Any,
    read: Callable[[Any], Expr],
) -> tuple[Expr, ...]:
    """Return the forces of a system plus those of its dissipation function."""
    forces = forces_by_coordinate(coordinates, applied or {}, read)
    if dissipation is None:
        return forces
    friction = dissipative_forces(read(dissipation), tuple(symbol(q.name + DOT) for q in coordinates))
    return tuple(map(sympy.Add, forces, friction)) if forces else friction


def _check_velocities(system: LagrangianSystem) -> None:
    free = system.lagrangian.free_symbols
    missing = tuple(velocity for velocity in system.velocities if velocity not in free)
    if missing:
        raise SystemDefinitionError(_degenerate_message(system, missing, "does not occur in the Lagrangian"))


def _check_mass_matrix(system: LagrangianSystem) -> None:
    others = (*system.coordinates, system.time)
    singular = singular_part(system.lagrangian, system.velocities, others, system.constants)
    if singular is None:
        return
    velocities, block = singular
    names = ", ".join(velocity.name for velocity in velocities)
    if velocities and not block:
        raise SystemDefinitionError(_degenerate_message(system, velocities, "occurs only linearly in L"))
    subject = f"the mass matrix d2L/dv2 of '{system.name}'"
    if not block:
        raise SystemDefinitionError(
            f"{subject} is singular: some velocities occur only in products with too few others. "
            f"{REQUIRED} Give each coordinate its own kinetic energy"
        )
    occurring = set[Symbol]().union(*(entry.free_symbols for entry in block.values()))
    used = {parameter: value for parameter, value in system.constants.items() if parameter in occurring}
    zero = " and ".join(parameter.name for parameter, value in used.items() if value == 0)
    values = " with the default parameters" if used else ""
    direction = null_direction(block, velocities)
    motion = f": a motion with ({direction}) has no kinetic energy" if direction else ""
    remedy = f"{zero} = 0 is the default: give it a positive value" if zero else REDUNDANT
    raise SystemDefinitionError(
        f"{subject} in {names} is singular at every sampled point{values}{motion}. {REQUIRED} {remedy}"
    )


def _degenerate_message(system: LagrangianSystem, velocities: Sequence[Symbol], how: str) -> str:
    """Return the error message for coordinates whose velocities occur at most linearly in L."""
    names = [velocity.name[: -len(DOT)] for velocity in velocities]
    if not hessian(system.lagrangian, system.velocities):
        every = " and ".join(velocity.name for velocity in system.velocities)
        pairs = (
            "If coordinates are conjugate to each other (a guiding centre, point vortices), write it as a "
            "HamiltonianSystem in canonical coordinates and momenta; otherwise add "
        )
        return (
            f"the Lagrangian of '{system.name}' is degenerate: it is at most linear in {every} (no kinetic energy), so "
            f"its equations of motion are of first order. {REQUIRED} {pairs if system.dimension > 1 else 'Add '}"
            f"the missing kinetic energy, such as m*{velocities[0]}**2/2"
        )
    derivative = sympy.expand(system.lagrangian.diff(symbol(names[0])))
    multiplies = derivative.has(*system.coordinates) and not derivative.has(symbol(names[0]), *system.velocities)
    hint = f"; if {names[0]} is a Lagrange multiplier, give constraints=['{system.text_of(derivative)}'] in its place"
    return (
        f"coordinate '{names[0]}' of '{system.name}' has no kinetic energy: velocity '{velocities[0]}' {how}. "
        f"{REQUIRED} Add the missing term, such as m*{velocities[0]}**2/2{hint if multiplies else ''}; if {names[0]} "
        "is a known function of time, make it an input or write the function out"
    )
