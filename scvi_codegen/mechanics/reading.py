"""Systems read from text or from SymPy expressions: the fields of Lagrangian and Hamiltonian systems."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import sympy
from sympy import Expr, Symbol

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.formulas.grammar import parse_expression
from scvi_codegen.formulas.inputs import input_formulas, with_inputs
from scvi_codegen.formulas.symbols import DOT, TIME, check_names, name_of_key, number, symbol
from scvi_codegen.formulas.translation import Translation, sympy_expression
from scvi_codegen.mechanics.arrays.elements import unrolled_fields
from scvi_codegen.mechanics.arrays.system import ArraySystem
from scvi_codegen.mechanics.constraints import constraints_of
from scvi_codegen.mechanics.deferred import are_arrays
from scvi_codegen.mechanics.definition_checks import warn_of_mistakes
from scvi_codegen.mechanics.forces import damping_rate, dissipative_forces, forces_by_coordinate

__all__ = ["default_momenta", "system_from_sympy", "system_from_text"]

Read = Callable[[Any], Expr]


def system_from_text(cls: Any, arguments: Mapping[str, Any]) -> tuple[Any, bool]:
    """Return the system of the arguments of ``cls.from_text``, and whether warnings were issued.

    Systems of arrays of run-time sizes are returned as they are, others with their entries as coordinates.
    """
    coordinates, parameters, inputs = (arguments[each] for each in ("coordinates", "parameters", "inputs"))
    if are_arrays(coordinates, parameters or (), arguments["tables"]):
        return _of_arrays(cls, ArraySystem.from_text(**arguments)), True
    of_momenta = "momenta" in arguments
    momenta = arguments.get("momenta", ())
    momenta = default_momenta(coordinates) if momenta is None else tuple(momenta)
    values = with_inputs(parameters or {}, inputs)
    check_names(coordinates, (*values, *inputs), momenta)
    velocities = () if of_momenta else tuple(coordinate + DOT for coordinate in coordinates)
    symbols = {each: symbol(each) for each in (*coordinates, *velocities, *momenta, TIME, *values, *inputs)}
    driven = input_formulas(inputs, symbols[TIME])

    def read(text: str) -> Expr:
        return parse_expression(text, symbols).xreplace(driven)

    variables = tuple(symbols[each] for each in coordinates)
    conjugate = {"momenta": tuple(symbols[each] for each in momenta)} if of_momenta else {}
    function = "hamiltonian" if of_momenta else "lagrangian"
    system = cls(
        name=arguments["name"],
        coordinates=variables,
        **conjugate,
        time=symbols[TIME],
        parameters=tuple(symbols[each] for each in values),
        defaults=tuple(number(each, value) for each, value in values.items()),
        **{function: read(arguments[function])},
        forces=_forces(variables, arguments["forces"], arguments.get("dissipation"), read),
        damping=damping_rate(arguments["damping"], lambda formula: read(str(formula))),
        constraints=constraints_of(arguments["constraints"], read),
        inputs=tuple(inputs),
    )
    return system, warn_of_mistakes(system)


def system_from_sympy(
    cls: Any,
    function: str,
    formula: Any,
    *,
    name: str,
    coordinates: Sequence[Any],
    momenta: Sequence[Any] | None = None,
    velocities: Sequence[Any] | None = None,
    time: Symbol | None = None,
    parameters: Mapping[Any, float] | None = None,
    forces: Mapping[Any, Any] | None = None,
    dissipation: Any = None,
    damping: Any = None,
    constraints: Sequence[Any] = (),
    inputs: Sequence[Any] = (),
    tables: Sequence[str] = (),
) -> Any:
    """Return the system of a SymPy expression, its ``function`` ``"Lagrangian"`` or ``"Hamiltonian"``.

    Other arguments are those of ``cls.from_sympy``.
    """
    if function == "Lagrangian" and are_arrays(each for each in coordinates if isinstance(each, str)):
        if any(each for each in (velocities, forces, dissipation, damping, constraints, inputs)):
            raise SystemDefinitionError(
                "from_sympy reads the Lagrangian, parameters and tables of a system with arrays: give the rest "
                "as text to from_text"
            )
        named: dict[str, Any] = {
            "name": name,
            "coordinates": list(coordinates),
            "parameters": parameters,
            "tables": tables,
        }
        return _of_arrays(cls, ArraySystem.from_sympy(lagrangian=formula, **named))
    formula = sympy_expression(formula, function)
    applied = {q: sympy_expression(f, f"force on {q}") for q, f in (forces or {}).items()}
    friction = None if dissipation is None else sympy_expression(dissipation, "dissipation")
    rate = damping_rate(damping, lambda each: sympy_expression(each, "damping"))
    conditions = constraints_of(constraints, lambda g: sympy_expression(g, "constraint"))
    input_names = tuple(name_of_key(each) for each in inputs)
    constants = with_inputs(_named_parameters(parameters), input_names)
    translation = Translation(
        formula,
        coordinates,
        (*applied.values(), *(() if friction is None else (friction,)), rate, *conditions),
        velocities=velocities,
        momenta=momenta or (),
        time=time,
        parameters=tuple(constants),
        inputs=input_names,
    )
    driven = input_formulas(input_names, symbol(TIME))

    def reader(what: str) -> Read:
        return lambda each: translation.apply(each, what).xreplace(driven)

    by_symbol = {translation.rules.get(q, q): f for q, f in applied.items()}
    system = cls(
        name=name,
        coordinates=translation.coordinates,
        **({} if momenta is None else {"momenta": translation.momenta}),
        time=symbol(TIME),
        parameters=translation.parameters,
        defaults=tuple(number(parameter, value) for parameter, value in constants.items()),
        **{function.lower(): reader(function)(formula)},
        forces=_forces(translation.coordinates, by_symbol, friction, reader("forces")),
        damping=reader("damping")(rate),
        constraints=constraints_of(conditions, reader("constraints")),
        inputs=input_names,
    )
    warn_of_mistakes(system)
    return system


def default_momenta(coordinates: Sequence[str]) -> tuple[str, ...]:
    """Return the default names of momenta."""
    return tuple(f"p_{name}" for name in coordinates)


def _of_arrays(cls: Any, system: ArraySystem) -> Any:
    """Return the system of named coordinates of arrays of known sizes, others as they are."""
    return system if system.sizes else cls(**unrolled_fields(system, {}))


def _named_parameters(parameters: Mapping[Any, float] | None) -> dict[str, float]:
    """Return default values by name, for keys that are symbols or names."""
    by_name = {name_of_key(key): value for key, value in (parameters or {}).items()}
    if len(by_name) < len(parameters or {}):
        raise SystemDefinitionError("two parameters have the same name: rename one of them")
    return by_name


def _forces(
    coordinates: tuple[Symbol, ...], applied: Mapping[Any, Any] | None, dissipation: Any, read: Read
) -> tuple[Expr, ...]:
    """Return the forces of a system plus those of its dissipation function."""
    forces = forces_by_coordinate(coordinates, applied or {}, read)
    if dissipation is None:
        return forces
    friction = dissipative_forces(read(dissipation), tuple(symbol(q.name + DOT) for q in coordinates))
    return tuple(map(sympy.Add, forces, friction)) if forces else friction
