"""Event functions in C: formulas to a kernel, and a search for its zeros besides the source of an integrator.

The search uses only the public functions of an integrator, so that it is available for every method and solver, and the
source without events does not change. On a step (``templates/support/run/events.h``):

* the functions are evaluated at its ends and at three states between them, each by a step of a fraction of h, and
  interpolated by polynomials of degree 4;
* the polynomial determines the number of zero crossings. At an extremum so near zero that its sign is uncertain (nearer
  than the last two Chebyshev coefficients), the step is subdivided, several times if necessary;
* each crossing is enclosed by partial steps until the ends are neighbouring numbers.

All crossings are detected if a function is a polynomial of degree 4 in time along a step. Of other functions those are
detected that the polynomials indicate; a function that oscillates faster within a step can have undetected crossings.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache

import sympy
from sympy import Expr, Symbol
from sympy.core.function import AppliedUndef

from scvi_codegen.errors import EventError, SystemDefinitionError, closest
from scvi_codegen.formulas.expressions import evaluated, unsupported_part
from scvi_codegen.formulas.grammar import parse_expression
from scvi_codegen.formulas.rotations.names import RotationNames
from scvi_codegen.formulas.symbols import DOT, TIME, identifier, input_formulas, symbol
from scvi_codegen.ir.arithmetic import lower_kernel
from scvi_codegen.ir.kernel import Kernel, lower_matrix, lower_vector
from scvi_codegen.rendering.program_source import EventSearch, render_events
from scvi_codegen.rendering.source import Interface, Source
from scvi_codegen.tables.nodes import chebyshev_lobatto, to_unit
from scvi_codegen.tables.precision import mp

DEGREE = 4


@lru_cache(maxsize=64)
def with_events(source: Source, interface: Interface, functions: tuple[str | Expr, ...]) -> Source:
    """Return the source of an integrator with the search for zeros of functions of its state.

    Args:
        source, interface: of the integrator, without events.
        functions: formulas as text or SymPy expressions in the names of the interface.

    Raises:
        ExpressionError: for text outside the grammar, with its column.
        EventError: naming the invalid symbol or function.
    """
    kernel, uses_velocity = _kernel(interface, functions)
    return replace(source, beside=render_events(_search(interface, kernel, uses_velocity)))


def _kernel(interface: Interface, functions: Sequence[str | Expr]) -> tuple[Kernel, bool]:
    """Return the kernel of the functions at u = (q, p, v), and whether any velocity occurs in them."""
    turning = RotationNames.of_declarations(interface.rotations)
    names = turning.symbols | _names(interface)
    input_values = input_formulas(interface.inputs, symbol(TIME))
    values = [turning.in_coordinates(_expression(function, names)).xreplace(input_values) for function in functions]
    q = [symbol(name) for name in interface.coordinates]
    v = [symbol(name + DOT) for name in interface.coordinates]
    taken = {*q, *v, symbol(TIME), *(symbol(name) for name in interface.parameters)}
    p = [sympy.Dummy() if symbol(name) in taken else symbol(name) for name in interface.momenta]
    kernel = lower_kernel(
        "event_functions",
        arguments=(*q, *p, *v),
        time=symbol(TIME),
        parameters=tuple(symbol(name) for name in interface.parameters),
        values=values,
    )
    return kernel, any(value.free_symbols.intersection(v) for value in values)


def _names(interface: Interface) -> dict[str, Symbol]:
    """Return the names that a function may use; coordinates and parameters precede default names of momenta."""
    velocities = [name + DOT for name in interface.coordinates]
    return {
        name: symbol(name)
        for name in (
            *interface.coordinates,
            *velocities,
            *interface.momenta,
            TIME,
            *interface.parameters,
            *interface.inputs,
        )
    }


def _expression(function: str | Expr, names: Mapping[str, Symbol]) -> Expr:
    """Return one function in canonical symbols."""
    if isinstance(function, str):
        found = parse_expression(function, names)
    elif isinstance(function, Expr):
        found = _translated(function)
    else:
        raise EventError(f"the function of an event must be text or a SymPy expression; got {function!r}")
    problem = unsupported_part(found)
    if problem:
        raise EventError(f"in the event function '{function}': {problem}")
    unknown = sorted(free.name for free in found.free_symbols.difference(names.values()))
    if unknown:
        raise EventError(
            f"'{unknown[0]}' in the event function '{function}' is neither a coordinate, a velocity, a momentum, time, "
            f"an input nor a parameter{closest(unknown[0], names)} Known here: {', '.join(names)}"
        )
    if not found.free_symbols:
        raise EventError(
            f"the event function '{function}' is constant and never crosses zero: use a function of the "
            "state or of time"
        )
    return found


def _translated(function: Expr) -> Expr:
    """Return the expression with functions of time, their derivatives and symbols as canonical symbols."""
    rules: dict[Expr, Expr] = {free: symbol(identifier(free.name)) for free in function.free_symbols}
    for moving in function.atoms(AppliedUndef):
        rules[moving] = symbol(identifier(moving.func.__name__))
    for rate in function.atoms(sympy.Derivative):
        if not isinstance(rate.expr, AppliedUndef) or rate.derivative_count != 1:
            raise EventError(
                f"'{rate}' in the event function '{function}' is not the velocity of a coordinate: use first "
                "derivatives of coordinates"
            )
        rules[rate] = symbol(identifier(rate.expr.func.__name__) + DOT)
    try:
        return evaluated(function, rules)
    except SystemDefinitionError as error:
        raise EventError(f"in the event function '{function}': {error}") from error


def _search(interface: Interface, kernel: Kernel, uses_velocity: bool) -> EventSearch:
    """Return the data of the search: Chebyshev points of the second kind, and the inverse Vandermonde matrix."""
    points = chebyshev_lobatto(DEGREE).points
    inverse = mp.matrix([[x**k for k in range(DEGREE + 1)] for x in points]) ** -1
    coefficients = tuple(tuple(inverse[k, j] for j in range(DEGREE + 1)) for k in range(DEGREE + 1))
    return EventSearch(
        prefix=interface.prefix,
        dimension=interface.dimension,
        kernel=kernel,
        uses_velocity=uses_velocity,
        transformed=bool(interface.energy_parameter),
        nodes=lower_vector(to_unit(points)),
        coefficients=lower_matrix(coefficients),
        doubts=(0.5 ** (DEGREE - 2), 0.5 ** (DEGREE - 1)),
    )
