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

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import accumulate
from typing import Any, Protocol, TypeAlias, cast

import numpy as np
import sympy
from sympy import Expr, Symbol
from sympy.core.function import AppliedUndef

from scvi_codegen.errors import EventError, ScviCodegenError, SystemDefinitionError, closest
from scvi_codegen.formulas.array_statements import (
    EntryRules,
    entry_names,
    formula_of_entries,
    is_indexed,
    momentum_arrays,
    parse_constraint,
)
from scvi_codegen.formulas.arrays import parse_coordinate
from scvi_codegen.formulas.expressions import evaluated, unsupported_part
from scvi_codegen.formulas.rotations import RotationNames, entries_in_formulas
from scvi_codegen.formulas.symbols import DOT, TIME, identifier, input_formulas, symbol
from scvi_codegen.indices import Array, Size
from scvi_codegen.ir.arithmetic import lower_kernel
from scvi_codegen.ir.kernel import Kernel, lower_matrix, lower_vector
from scvi_codegen.rendering.array_events import array_events
from scvi_codegen.rendering.program_source import EventSearch, render_events
from scvi_codegen.rendering.source import Interface, Source
from scvi_codegen.tables.nodes import chebyshev_lobatto, to_unit
from scvi_codegen.tables.precision import mp

DEGREE = 4
Formula: TypeAlias = "str | Expr | float"


class SearchedEvent(Protocol):
    """Event with the attributes of :class:`~scvi_codegen.runtime.events.event.Event`, which is of a higher layer."""

    @property
    def function(self) -> str | Expr: ...
    @property
    def restitution(self) -> Formula | None: ...
    @property
    def changes(self) -> tuple[tuple[str, Formula], ...]: ...
    @property
    def conditions(self) -> tuple[Formula, ...]: ...
    @property
    def loops(self) -> str: ...
    @property
    def changes_state(self) -> bool: ...
    def check_function(self, moving: Sequence[str], *, constant: bool) -> None: ...


@lru_cache(maxsize=64)
def with_events(source: Source, interface: Interface, events: tuple[SearchedEvent, ...]) -> Source:
    """Return the source of an integrator with the search for its events and their changes of the state.

    Args:
        source, interface: of the integrator, without events.
        events: with formulas as text or SymPy expressions in the names of the interface.

    Raises:
        ExpressionError: for text outside the grammar, with its column.
        EventError: naming the invalid symbol or function, or what events that change the state do not support.
    """
    return replace(source, beside=render_events(_search(interface, events, source.header)))


class EventFormulas:
    """Formulas of events in canonical symbols: functions, conditions, and changes of the state.

    Attributes:
        q, v, p: symbols of the state, v of its velocities.
        functions: g of each event.
        guards: index of its event and formula of each condition, which is satisfied where it is >= 0.
        changes: for each event the indices of the variables among (q, p, v) that it changes, and their new values; for
            an impact its gradient g_q, g_t, and the coefficient of restitution.
    """

    def __init__(self, interface: Interface, events: Sequence[SearchedEvent]) -> None:
        self.interface = interface
        self._turning = RotationNames.of_states(interface.rotations, _names(interface))
        self._known, self._grammar = self._turning.symbols | _names(interface), _Grammar(interface, self._turning)
        elements = [self._elements(event) for event in events]
        self.elements, self.events = [*map(len, elements)], [each for element in elements for each in element]
        self.q = [symbol(name) for name in interface.coordinates]
        self.v = [symbol(name + DOT) for name in interface.coordinates]
        self.parameters = tuple(symbol(name) for name in interface.parameters)
        taken = {*self.q, *self.v, symbol(TIME), *self.parameters}
        self.p = [sympy.Dummy() if symbol(name) in taken else symbol(name) for name in interface.momenta]
        self.functions = [self._read(event.function, f"event function '{event.function}'") for event in self.events]
        for event, function in zip(self.events, self.functions, strict=True):
            if interface.variables and event.restitution is not None:
                raise EventError(f"'{interface.system}' is a first-order system without impacts: write them in then=")
            moving = sorted(free.name for free in function.free_symbols & {*self.p, *self.v})
            event.check_function(moving, constant=not function.free_symbols)
        self.guards = [
            (number, self._read(condition, f"condition where='{condition}'"))
            for number, event in enumerate(self.events)
            for condition in event.conditions
        ]
        self.changes = [self._changes(*each) for each in zip(self.events, self.functions, strict=True)]
        if interface.energy_parameter and any(event.changes_state for event in events):
            raise EventError(
                "events that change the state are impossible in transformed time, where the energy is the constant "
                f"'{interface.energy_parameter}': compile the original system with time_transformation=.., or use "
                "adaptive steps (t_end)"
            )

    @property
    def arguments(self) -> tuple[Symbol, ...]:
        """Arguments (q, p, v) of the kernels."""
        return (*self.q, *self.p, *self.v)

    def kernel(self, name: str, values: Sequence[Expr]) -> Kernel:
        """Return the kernel of some of the formulas."""
        time, parameters = symbol(TIME), self.parameters
        return lower_kernel(name, arguments=self.arguments, time=time, parameters=parameters, values=values)

    def _read(self, formula: Formula, what: str) -> Expr:
        grammar = self._grammar
        if isinstance(formula, str) and grammar.arrays and is_indexed(formula):
            formula = formula_of_entries(formula, grammar.arrays, self._known, grammar.tables, grammar.rules)
        expression = self._turning.in_coordinates(_expression(formula, self._known, what, self._turning.read))
        return cast(Expr, expression.xreplace(input_formulas(self.interface.inputs, symbol(TIME))))

    def _elements(self, event: SearchedEvent) -> list[SearchedEvent]:
        """Return the events of the elements of the loops of an event, with formulas of the entries of arrays."""
        if not event.loops:
            return [event]

        def formulas(text: Any) -> list[Expr]:
            whole, grammar = str(text) if text is event.function else f"{text}{event.loops}", self._grammar
            try:
                term = parse_constraint(whole, grammar.arrays, self._known, grammar.tables)
                return [cast("Expr", term.formula.xreplace(rule)) for _, rule in grammar.rules.rules(term)]
            except ScviCodegenError as error:
                raise EventError(f"the formula '{text}' of the event '{event.function}': {error}") from error

        functions = formulas(event.function)
        changes = [(formulas(name), formulas(value)) for name, value in event.changes]
        conditions = [formulas(each) for each in event.conditions]
        restitutions = None if event.restitution is None else formulas(event.restitution)
        return [
            replace(
                cast(Any, event),
                function=function,
                then={str(names[k]): values[k] for names, values in changes} or None,
                where=tuple(cast(Any, each[k]) >= 0 for each in conditions) or None,
                restitution=restitutions and restitutions[k],
            )
            for k, function in enumerate(functions)
        ]

    def _changes(self, event: SearchedEvent, g: Expr) -> tuple[list[int], list[Expr]]:
        if event.restitution is not None:
            gradient = [sympy.diff(g, each) for each in (*self.q, symbol(TIME))]
            restitution = self._read(event.restitution, f"restitution '{event.restitution}'")
            return [*range(len(self.q)), 0, 0], [*gradient, restitution]
        settable = (*self.q, *self.p) if self.interface.variables else self.arguments
        variables = {each: k for k, each in enumerate(settable)}
        named = {name: variables[each] for name, each in self._known.items() if each in variables}
        new = {
            str(self._read(name, "then=")) if "[" in name else name: self._read(value, f"value '{value}' of '{name}'")
            for name, value in event.changes
        }
        self._set_rates_of_rotations(new)
        indices = [named.get(name, -1) for name in new]
        for index, (name, value) in zip(indices, new.items(), strict=True):
            if index < 0:
                known = [str(x) for each in self._turning.rotations for x in (*each.rates, *each.momenta)] + [*named]
                raise EventError(
                    f"then={{'{name}': '{value}'}} of the event '{event.function}': '{name}' is not a coordinate, a "
                    f"momentum or a velocity{closest(name, known)} An event can set: {', '.join(known)}"
                )
        if {index // len(self.q) for index in indices} >= {1, 2}:
            raise EventError(f"the event '{event.function}' sets momenta and velocities: set one or the other")
        return indices, [*new.values()]

    def _set_rates_of_rotations(self, new: dict[str, Expr]) -> None:
        """Replace new angular velocities or momenta of rotations by the derivatives or momenta of quaternions."""
        for member in self._turning.rotations:
            for symbols in dict.fromkeys((member.rates, member.momenta)):
                if set(new).isdisjoint(each.name for each in symbols):
                    continue
                values = [new.pop(each.name, self._turning.values[each]) for each in symbols]
                p = member.forces(values)  # p = 2 E(q) m / |q|^2 of the angular momentum m, q_dot = |q|^2 p / 4
                size = sympy.Add(*(symbol(name) ** 2 for name in member.coordinates))
                for name, value in zip(member.coordinates, p, strict=True):
                    of_momentum = symbols == member.momenta
                    new[f"p_{name}" if of_momentum else name + DOT] = value if of_momentum else value * size / 4


class _Grammar:
    """Index notation at known sizes: arrays, index tables, and the names of entries."""

    def __init__(self, interface: Interface, turning: RotationNames) -> None:
        indices = interface.index_values
        sizes = {name: value for name, value in indices.items() if isinstance(value, int)}
        tables = {name: np.array(value) for name, value in indices.items() if name not in sizes}
        arrays = _arrays(interface)
        of_rotations = entries_in_formulas(arrays, turning.members, {})
        names = {array: entry_names(array, {}) for array in arrays if not array.name.endswith(DOT)} | of_rotations
        self.rules = EntryRules(sizes, tables, {array.name: each for array, each in names.items()})
        self.arrays = [*arrays, *of_rotations, *([Array("", tuple(map(Size, sizes)))] if sizes else ())]
        self.tables = [Array(name, tuple(Size("", n) for n in table.shape)) for name, table in tables.items()]


def _arrays(interface: Interface) -> list[Array]:
    """Return the arrays whose entries a function may contain: coordinates, parameters, velocities and momenta."""
    arrays = [parse_coordinate(declaration) for declaration in interface.arrays]
    moving = [Array(array.name + DOT, array.axes) for array in arrays if array.elements[0] in interface.coordinates]
    return [*arrays, *moving, *momentum_arrays(arrays, interface.momenta)]


def _names(interface: Interface) -> dict[str, Symbol]:
    """Return the names that a function may use; coordinates and parameters precede default names of momenta."""
    velocities = [name + DOT for name in interface.coordinates]
    moving = *interface.coordinates, *velocities, *interface.momenta
    return {name: symbol(name) for name in (*moving, TIME, *interface.parameters, *interface.inputs)}


def _expression(
    formula: Formula, names: Mapping[str, Symbol], what: str, read: Callable[[str, Mapping[str, Symbol]], Expr]
) -> Expr:
    if isinstance(formula, str | int | float):
        found = read(str(formula), names)
    elif isinstance(formula, Expr):
        found = _translated(formula, what)
    else:
        raise EventError(f"the {what} must be text or a SymPy expression; got {formula!r}")
    problem = unsupported_part(found)
    if problem:
        raise EventError(f"in the {what}: {problem}")
    unknown = sorted(free.name for free in found.free_symbols.difference(names.values()))
    if unknown:
        raise EventError(
            f"'{unknown[0]}' in the {what} is neither a coordinate, a velocity, a momentum, time, an input nor a "
            f"parameter{closest(unknown[0], names)} Known here: {', '.join(names)}"
        )
    return found


def _translated(function: Expr, what: str) -> Expr:
    """Return the expression with functions of time, their derivatives and symbols as canonical symbols."""
    rules: dict[Expr, Expr] = {free: symbol(identifier(free.name)) for free in function.free_symbols}
    for moving in function.atoms(AppliedUndef):
        rules[moving] = symbol(identifier(moving.func.__name__))
    for rate in function.atoms(sympy.Derivative):
        if not isinstance(rate.expr, AppliedUndef) or rate.derivative_count != 1:
            raise EventError(
                f"'{rate}' in the {what} is not the velocity of a coordinate: use first derivatives of coordinates"
            )
        rules[rate] = symbol(identifier(rate.expr.func.__name__) + DOT)
    try:
        return evaluated(function, rules)
    except SystemDefinitionError as error:
        raise EventError(f"in the {what}: {error}") from error


def _search(interface: Interface, events: tuple[SearchedEvent, ...], header: str) -> EventSearch:
    """Return the search: Chebyshev points of the second kind, inverse Vandermonde matrix; ``header`` of the steps."""
    points = chebyshev_lobatto(DEGREE).points
    inverse = mp.matrix([[x**k for k in range(DEGREE + 1)] for x in points]) ** -1
    coefficients = tuple(tuple(inverse[k, j] for j in range(DEGREE + 1)) for k in range(DEGREE + 1))
    search = EventSearch(
        prefix=interface.prefix,
        dimension=interface.dimension,
        transformed=bool(interface.energy_parameter),
        constrained=bool(interface.constraints or interface.layout.constraints),
        nodes=lower_vector(to_unit(points)),
        coefficients=lower_matrix(coefficients),
        doubts=(0.5 ** (DEGREE - 2), 0.5 ** (DEGREE - 1)),
        guarded=tuple(number for number, event in enumerate(events) for _ in event.conditions),
        impacts=tuple(int(event.restitution is not None) for event in events),
        controlled="_advance_to(" in header,
    )
    if interface.layout.coordinates:
        arrays, changed = array_events(interface, events), (0,) * any(event.changes_state for event in events)
        known: dict[str, Any] = {"kernels": tuple(arrays.kernels), "changed": changed}
        return replace(search, dimension=0, arrays=arrays, uses_velocity=arrays.uses_velocity, **known)
    formulas = EventFormulas(interface, events)
    guards = [guard for _, guard in formulas.guards]
    values = [value for _, each in formulas.changes for value in each]
    every = {"event_functions": formulas.functions, "event_guards": guards, "event_changes": values}
    return replace(
        search,
        elements=tuple(formulas.elements) if any(event.loops for event in events) else (),
        guarded=tuple(number for number, _ in formulas.guards),
        kernels=tuple(formulas.kernel(name, each) for name, each in every.items() if each),
        uses_velocity=any(value.free_symbols.intersection(formulas.v) for each in every.values() for value in each),
        changed=tuple(index for indices, _ in formulas.changes for index in indices),
        first_values=(0, *accumulate(len(each) for _, each in formulas.changes)),
    )
