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

At known sizes one kernel evaluates the functions of all entries. At run-time sizes an event ``g for i in N`` has a
function for each element of its loops, evaluated in these loops, or one of them with ranges of one element; gradients
and maps are lists of entries: the work of a change does not grow with the number of coordinates that it does not
involve.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from itertools import accumulate, chain
from typing import Any, Protocol, TypeAlias, cast

import numpy as np
import sympy
from sympy import Expr, Symbol
from sympy.core.function import AppliedUndef

from scvi_codegen.codegen.ir.arithmetic import lower_kernel
from scvi_codegen.codegen.ir.kernel import Kernel, RolledKernel, lower_matrix, lower_vector
from scvi_codegen.codegen.ir.program import Layout
from scvi_codegen.codegen.ir.variants import BY_STEPS
from scvi_codegen.codegen.rendering.kernels.loop_nests import Nest, count_text, size_text
from scvi_codegen.codegen.rendering.program_source import ArrayEventSearch, EventSearch, render_events
from scvi_codegen.codegen.rendering.reaches import reaches
from scvi_codegen.codegen.rendering.source import Interface, Source
from scvi_codegen.common.errors import EventError, ScviCodegenError, SystemDefinitionError, closest
from scvi_codegen.common.precision import mp
from scvi_codegen.methods.tables.nodes import chebyshev_lobatto, to_unit
from scvi_codegen.methods.tables.quadrature import gauss_lobatto
from scvi_codegen.systems.contact import Impacts
from scvi_codegen.systems.contacts.rows import ContactRows
from scvi_codegen.systems.event import Kink, Refraction, Transition, modes_of
from scvi_codegen.systems.formulas.array_statements import (
    EntryRules,
    entry_names,
    formula_of_entries,
    is_indexed,
    momentum_arrays,
    parse_constraint,
)
from scvi_codegen.systems.formulas.arrays import ArrayTerm, parse_coordinate, parse_sums
from scvi_codegen.systems.formulas.expressions import evaluated, parts_of_type, unsupported_part
from scvi_codegen.systems.formulas.grammar import named_tables
from scvi_codegen.systems.formulas.indices import Access, Array, Loop, Size
from scvi_codegen.systems.formulas.intermediates import intermediate
from scvi_codegen.systems.formulas.kinks import rint, steps_on_sides, unit_step
from scvi_codegen.systems.formulas.rotations import RotationNames, entries_in_formulas
from scvi_codegen.systems.formulas.symbols import DOT, TIME, identifier, input_formulas, symbol
from scvi_codegen.systems.formulas.table import functions_of

DEGREE = 4
JUDGES = 10
"""Lobatto points that judge friction that varies along a slip, of order 18, above those 2s of degrees up to 8."""
FUNCTIONS = {"controlled": "advance_to", "by_steps": "motion_terms"}
"""Functions of an integrator of adaptive steps, and of contacts by steps."""
Formula: TypeAlias = "str | Expr | float"


class SearchedEvent(Protocol):
    """Event with the attributes of :class:`~scvi_codegen.systems.event.Event`, which is of a higher layer."""

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
    @property
    def is_wall(self) -> bool: ...
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
    has = {word: name in source.contents.functions for word, name in FUNCTIONS.items()}
    return replace(source, beside=render_events(_search(interface, events, **has)))


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
        self._known = self._turning.symbols | _names(interface)
        self._grammar = _Grammar(interface, self._turning)
        for name, formula in (pair for contact in interface.contacts for pair in contact.quantities):
            self._known[name] = intermediate(self._read(formula, f"quantity '{name}'"))
        elements = [self._elements(event) for event in events]
        self.elements = [*map(len, elements)]
        self.events = [element for of_event in elements for element in of_event]
        self.q = [symbol(name) for name in interface.coordinates]
        self.v = [symbol(name + DOT) for name in interface.coordinates]
        self.parameters = tuple(symbol(name) for name in interface.parameters)
        taken = {*self.q, *self.v, symbol(TIME), *self.parameters}
        self.p = [sympy.Dummy() if symbol(name) in taken else symbol(name) for name in interface.momenta]
        self.multipliers = [symbol(name) for name in multiplier_names(interface) if symbol(name) not in taken]
        self.functions = [*self._functions()]
        self.guards = [
            (number, self._read(condition, f"condition where='{condition}'"))
            for number, event in enumerate(self.events)
            for condition in event.conditions
        ]
        self.modes = modes_of(events, interface.parameters, interface.mode_names)
        self.changes = [self._changes(event, g) for event, g in zip(self.events, self.functions, strict=True)]
        if interface.in_tau and any(event.changes_state for event in events):
            raise EventError(
                "events that change the state are impossible in transformed time, where the energy is the constant "
                f"'{interface.energy_parameter}': compile the original system with time_transformation=.., or use "
                "adaptive steps (t_end)"
            )

    def _functions(self) -> Iterator[Expr]:
        """Yield g of each event, with coefficients of the mode of a step for transitions, and with masks for kinks."""
        functions = [self._read(event.function, f"event function '{event.function}'") for event in self.events]
        pairs = [*zip(self.events, functions, strict=True)]
        sides = {u: symbol(event.mode) for event, u in pairs if isinstance(event, Kink)}
        for event, function in pairs:
            if self.interface.variables and event.restitution is not None:
                name = self.interface.system
                raise EventError(f"'{name}' is a first-order system without impacts: write them in then=")
            moving = sorted(free.name for free in function.free_symbols & {*self.p, *self.v, *self.multipliers})
            event.check_function(moving, constant=not function.free_symbols)
            if isinstance(event, Transition):
                yield function.xreplace(steps_on_sides(parts_of_type(unit_step, function), sides))
            elif isinstance(event, Kink):
                yield function + self._read(event.held, f"masks of '{event.function}'")
            else:
                yield function

    @property
    def arguments(self) -> tuple[Symbol, ...]:
        """Arguments (q, p, v, lambda) of the kernels, the multipliers of constraints last."""
        return (*self.q, *self.p, *self.v, *self.multipliers)

    def kernel(self, name: str, values: Sequence[Expr]) -> Kernel:
        """Return the kernel of some of the formulas."""
        time, parameters = symbol(TIME), self.parameters
        return lower_kernel(name, arguments=self.arguments, time=time, parameters=parameters, values=values)

    def _read(self, formula: Formula, role: str) -> Expr:
        grammar = self._grammar
        if isinstance(formula, str) and grammar.arrays and is_indexed(formula):
            formula = formula_of_entries(formula, grammar.arrays, self._known, grammar.tables, grammar.rules)
        expression = self._turning.in_coordinates(_expression(formula, self._known, role, self._turning.read))
        return cast(Expr, expression.xreplace(input_formulas(self.interface.inputs, symbol(TIME))))

    def _elements(self, event: SearchedEvent) -> list[SearchedEvent]:
        """Return the events of the elements of the loops of an event, with formulas of the entries of arrays."""
        if not event.loops:
            return [event]

        def formulas(text: Any) -> list[Expr]:
            whole, grammar = str(text) if text is event.function else f"{text}{event.loops}", self._grammar
            try:
                term = parse_constraint(whole, grammar.arrays, self._known, grammar.tables)
                return grammar.rules.formulas(term)
            except ScviCodegenError as error:
                raise EventError(f"the formula '{text}' of the event '{event.function}': {error}") from error

        functions = formulas(event.function)
        changes = [(formulas(name), formulas(value)) for name, value in event.changes]
        conditions = [formulas(condition) for condition in event.conditions]
        restitutions = None if event.restitution is None else formulas(event.restitution)
        return [
            replace(
                cast(Any, event),
                function=function,
                then={str(names[k]): values[k] for names, values in changes} or None,
                where=tuple(cast(Any, of_elements[k]) >= 0 for of_elements in conditions) or None,
                restitution=restitutions and restitutions[k],
            )
            for k, function in enumerate(functions)
        ]

    def _changes(self, event: SearchedEvent, g: Expr) -> tuple[list[int], list[Expr]]:
        if event.is_wall:
            gradient = [sympy.diff(g, variable) for variable in (*self.q, symbol(TIME))]  # g_q, g_t
            e = 1.0 if event.restitution is None else event.restitution
            restitution = self._read(e, f"restitution '{e}'")
            return [*range(len(self.q)), 0, 0], [*gradient, restitution]
        settable = (*self.q, *self.p) if self.interface.variables else (*self.q, *self.p, *self.v)
        places = {variable: k for k, variable in enumerate(settable)}
        own = len(self.modes) - len(self.interface.mode_names)  # those of contacts and kinks follow
        places |= {symbol(name): 3 * len(self.q) + k for k, name in enumerate(self.modes[:own])}
        named = {name: places[variable] for name, variable in self._known.items() if variable in places}
        new = {
            str(self._read(name, "then=")) if "[" in name else name: self._read(value, f"value '{value}' of '{name}'")
            for name, value in event.changes
        }
        self._set_rates_of_rotations(new)
        if unknown := [name for name in new if name not in named]:
            name, rotations = unknown[0], self._turning.rotations
            rates = chain(*((*rotation.rates, *rotation.momenta) for rotation in rotations))
            names = [*dict.fromkeys((*map(str, rates), *named, *self.interface.own_parameters))]
            raise EventError(
                f"then={{'{name}': '{new[name]}'}} of the event '{event.function}': '{name}' is not a coordinate, a "
                f"momentum, a velocity or a parameter{closest(name, names)} An event can set: {', '.join(names)}"
            )
        indices = [*map(named.__getitem__, new)]
        if {min(index // len(self.q), 3) for index in indices} >= {1, 2}:
            raise EventError(f"the event '{event.function}' sets momenta and velocities: set one or the other")
        return indices, [*new.values()]

    def _set_rates_of_rotations(self, new: dict[str, Expr]) -> None:
        """Replace new angular velocities or momenta of rotations by the derivatives or momenta of quaternions."""
        for member in self._turning.rotations:
            for symbols in dict.fromkeys((member.rates, member.momenta)):
                if set(new).isdisjoint(rate.name for rate in symbols):
                    continue
                values = [new.pop(rate.name, self._turning.values[rate]) for rate in symbols]
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
        self.rules = EntryRules(sizes, tables, {array.name: entries for array, entries in names.items()})
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
    moving = *multiplier_names(interface), *interface.coordinates, *velocities, *interface.momenta
    named = {name: symbol(name) for name in (*moving, TIME, *interface.parameters, *interface.inputs)}
    return named | _functions(interface)


def _functions(interface: Interface) -> dict[str, Any]:
    return named_tables(functions_of({name: json.loads(table) for name, table in interface.functions}))


def multiplier_names(interface: Interface) -> list[str]:
    """Return the names of the multipliers of the constraints: lambda_1, .. in double; none of run-time sizes."""
    return [f"lambda_{k}" for k in range(1, len(interface.constraints) + 1)] if interface.words == 1 else []


def _expression(
    formula: Formula, names: Mapping[str, Symbol], role: str, read: Callable[[str, Mapping[str, Symbol]], Expr]
) -> Expr:
    if isinstance(formula, str | int | float):
        expression = read(str(formula), names)
    elif isinstance(formula, Expr):
        expression = _translated(formula, role)
    else:
        raise EventError(f"the {role} must be text or a SymPy expression; got {formula!r}")
    problem = unsupported_part(expression)
    if problem:
        raise EventError(f"in the {role}: {problem}")
    unknown = sorted(free.name for free in expression.free_symbols.difference(names.values()))
    if unknown:
        raise EventError(
            f"'{unknown[0]}' in the {role} is neither a coordinate, a velocity, a momentum, a multiplier, time, an "
            f"input nor a parameter{closest(unknown[0], names)} Known here: {', '.join(names)}"
        )
    return expression


def _translated(function: Expr, role: str) -> Expr:
    """Return the expression with functions of time, their derivatives and symbols as canonical symbols."""
    rules: dict[Expr, Expr] = {free: symbol(identifier(free.name)) for free in function.free_symbols}
    for moving in function.atoms(AppliedUndef):
        rules[moving] = symbol(identifier(moving.func.__name__))
    for rate in function.atoms(sympy.Derivative):
        if not isinstance(rate.expr, AppliedUndef) or rate.derivative_count != 1:
            raise EventError(
                f"'{rate}' in the {role} is not the velocity of a coordinate: use first derivatives of coordinates"
            )
        rules[rate] = symbol(identifier(rate.expr.func.__name__) + DOT)
    try:
        return evaluated(function, rules)
    except SystemDefinitionError as error:
        raise EventError(f"in the {role}: {error}") from error


def _search(
    interface: Interface, events: tuple[SearchedEvent, ...], *, controlled: bool, by_steps: bool
) -> EventSearch:
    """Return the search: Chebyshev points of the second kind, inverse Vandermonde matrix."""
    points = chebyshev_lobatto(DEGREE).points
    inverse = mp.matrix([[x**k for k in range(DEGREE + 1)] for x in points]) ** -1
    coefficients = tuple(tuple(inverse[k, j] for j in range(DEGREE + 1)) for k in range(DEGREE + 1))
    common: dict[str, Any] = {
        "prefix": interface.prefix,
        "dimension": interface.dimension,
        "transformed": interface.in_tau,
        "constrained": bool(interface.constraints or interface.layout.constraints),
        "nodes": lower_vector(to_unit(points)),
        "coefficients": lower_matrix(coefficients),
        "doubts": (0.5 ** (DEGREE - 2), 0.5 ** (DEGREE - 1)),
        "impacts": tuple(int(event.restitution is not None) for event in events),
        "conditional": tuple(int(bool(event.conditions)) for event in events),
        "controlled": controlled,
        "by_steps": by_steps and not interface.modes,
        "steps_alone": interface.solver == BY_STEPS,
        "changes_states": any(event.changes_state for event in events),
    }
    if interface.layout.coordinates:
        arrays = array_events(interface, events)
        return ArrayEventSearch(
            **common,
            arrays=arrays,
            kernels=tuple(arrays.kernels),
            timed=arrays.timed,
            guarded=tuple(number for number, event in enumerate(events) for _ in event.conditions),
            uses_velocity=arrays.uses_velocity,
        )
    return EventSearch(**common, **_formula_part(interface, events), **_change_part(interface, events))


def _formula_part(interface: Interface, events: Sequence[SearchedEvent]) -> dict[str, Any]:
    """Return the kernels of functions, conditions and changes of events, and what they depend on."""
    formulas = EventFormulas(interface, events)
    timed = [0 if interface.in_tau else _kind_in_time(g, formulas.arguments) for g in formulas.functions]
    bounds = [
        reaches(g, symbol(TIME), formulas.q[0]) if kind else (sympy.S.Zero,) * 3
        for g, kind in zip(formulas.functions if any(timed) else (), timed, strict=False)
    ]
    indices, values = [*zip(*formulas.changes, strict=True)] or ((), ())
    guarded, guards = [*zip(*formulas.guards, strict=True)] or ((), ())
    of_kernel: dict[str, list[Expr]] = {
        "event_functions": formulas.functions,
        "event_guards": [*guards],
        "event_changes": [*chain(*values)],
        "event_reaches": [*chain(*bounds)],
    }
    variables = set[Symbol]().union(*(value.free_symbols for value in chain(*of_kernel.values())))
    return {
        "elements": tuple(formulas.elements),
        "timed": tuple(timed[first] for first in (0, *accumulate(formulas.elements[:-1]))),
        "guarded": guarded,
        "kernels": tuple(formulas.kernel(name, values) for name, values in of_kernel.items() if values),
        "uses_velocity": not variables.isdisjoint(formulas.v),
        "multipliers": 0 if variables.isdisjoint(formulas.multipliers) else len(formulas.multipliers),
        "changed": tuple(chain(*indices)),
        "first_values": (0, *accumulate(map(len, values))),
        "parameters": len(interface.parameters),
        "modes": tuple(map(interface.parameters.index, formulas.modes)),
        "contacts": tuple(_places(formulas.modes, contact) for contact in interface.contacts),
        **(_judge_of_slips() if any(contact.varies for contact in interface.contacts) else {}),
    }


def _judge_of_slips() -> dict[str, Any]:
    """Return the quadrature with both ends by which friction that varies along a slip is judged."""
    rule = gauss_lobatto(JUDGES)
    return {"knots": lower_vector(rule.abscissae), "weights": lower_vector(rule.unit_weights)}


def _change_part(interface: Interface, events: Sequence[SearchedEvent]) -> dict[str, Any]:
    """Return what events of each kind do: kinks, refractions, contacts and their transitions."""
    sides = [event.power_sides for event in events if isinstance(event, Kink)]
    refracts = [isinstance(event, Refraction) for event in events]
    turning = tuple(len(member.coordinates) for member in RotationNames.members_of(interface.rotations))
    return {
        "kinks": sum(isinstance(event, Kink) for event in events),
        "powers": tuple((int(-1 in side), int(1 in side)) for side in sides) if any(sides) else (),
        "refracts": tuple(map(int, refracts)) if any(refracts) else (),
        "vectors": (1,) * (interface.dimension - sum(turning)) + turning,
        "contact_rows": interface.masked,
        "first_contact_row": len(interface.constraints) - interface.masked,
        "transitions": tuple((event.contact, event.kind) for event in events if isinstance(event, Transition)),
        "dissipates": interface.dissipates and all(isinstance(e, Transition) for e in events if e.changes_state),
    }


def _places(modes: Sequence[str], contact: ContactRows) -> tuple[int, ...]:
    """Return the rows of a contact, number of slips, places of its mode, law of impacts; -1: it does not have this."""
    rows = (-1 if row is None else row for row in (contact.normal, contact.tangential))
    masks = (
        contact.closed,
        *(names[0] if names else None for names in (contact.sticks, contact.directions)),
        contact.held,
    )
    places = (-1 if name is None else modes.index(name) for name in masks)
    return *rows, contact.slips, *places, [*Impacts].index(Impacts(contact.impacts)), int(contact.varies)


def _kind_in_time(g: Expr, moving: Iterable[Symbol]) -> int:
    """Return 1 for a function of time alone, 2 for one that is affine in time, else 0."""
    time = symbol(TIME)
    if time not in g.free_symbols or not g.free_symbols.isdisjoint(moving):
        return 0
    return 1 if g.has(rint, unit_step) or time in sympy.diff(g, time).free_symbols else 2


Slots: TypeAlias = Sequence[tuple[Any, Access]]
ARGUMENTS = ("const problem *arrays", "const event_point *at", "const section *in", "event_entries *to")
NEXT = "to->value[to->count]"


class _Entries(Nest):
    """Loops that read entries of q, p and v, in all their elements or in the ranges ``in`` of the caller."""

    def __init__(self, code: ArrayEvents, rolled: RolledKernel, *, within: bool) -> None:
        super().__init__(code.layout, rolled, "double", "at" if rolled.kernel.values else "")
        self.code, self.within = code, within

    def read(self, k: int, slot: Access) -> str:
        return f"u[{k}] = at->{'qpv'[self.code.moving[slot.array.name][0]]}[{self.place_of(slot)}];"

    def place_of(self, access: Access) -> str:
        """Return the index of an entry in q, p or v."""
        return f"start_{self.code.moving[access.array.name][1]} + {self.place(access)}"

    def _span(self, loop: Loop) -> tuple[str, str]:
        if not self.within:
            return super()._span(loop)
        here = f"in[{self.levels[loop.index] - 1}]"
        first = f"between({here}.first, index_{loop.behind} + 1, {here}.end)" if loop.behind else f"{here}.first"
        return first, f"{here}.end"


class ArrayEvents:
    """C of events in index notation.

    Args:
        interface: of the stepper of run-time sizes.
        events: the events.

    Attributes:
        events: C of each: ``functions``, ``conditions`` and ``changes``, statements; ``ranges``, the first index, end,
            and whether it is the greater index of a pair, of each loop; ``count`` of functions; ``entries``, the
            largest number of variables that one changes; ``accesses`` of arrays, with the loops around them; ``timed``,
            1 for a function of time alone, 2 if it is affine, else 0; ``reaches``, statements that compute its
            :func:`~scvi_codegen.codegen.rendering.reaches.reaches`.
        timed: the same ``timed`` of each event.
        layout: the arrays, tables, sizes and parameters of the stepper.
        moving: by the name of an array of coordinates, momenta or velocities: 0, 1 or 2 for q, p or v, and the name of
            its coordinates.
        functions: texts of the functions that their statements call.
        kernels: the kernels that these call.
        positions, rates: arrays whose entries may occur: coordinates, fields and momenta; velocities, of which a
            system that is defined by a Hamiltonian has none.
        symbols: time and parameters by name.
        uses_velocity: whether velocities occur.

    Raises:
        EventError: if a formula is invalid, or velocities are required and unknown.
    """

    def __init__(self, interface: Interface, events: Sequence[SearchedEvent]) -> None:
        layout = interface.layout
        arrays = {name: getattr(layout, name) for name in ("coordinates", "fields", "tables", "sizes")}
        self.layout = Layout(**arrays, parameters=interface.parameters)
        momenta = [*layout.momenta] or [Array(f"p_{array.name}", array.axes) for array in layout.coordinates]
        rates = [Array(array.name + DOT, array.axes) for array in layout.coordinates if not layout.momenta]
        vectors = layout.coordinates, momenta, rates
        self.positions, self.rates = [*layout.coordinates, *layout.fields, *momenta], rates
        self.symbols = {name: symbol(name) for name in (TIME, *interface.parameters)} | _functions(interface)
        self.moving = {
            array.name: (k, layout.coordinates[j].name)
            for k, arrays in enumerate(vectors)
            for j, array in enumerate(arrays)
        }
        self.uses_velocity, self.functions, self.kernels = False, list[str](), list[Kernel]()
        self.events = [self._event(k, event) for k, event in enumerate(events)]
        self.timed = tuple(event["timed"] for event in self.events)

    def terms(self, formula: Any, event: SearchedEvent) -> tuple[ArrayTerm, ...]:
        """Return the terms of a formula of an event; in the loops of the event, one term for each of their elements.

        Raises:
            EventError: if the formula is invalid.
        """
        text, names = str(formula), ([*self.positions, *self.rates], self.symbols, self.layout.tables)
        try:
            if event.loops:
                terms = [parse_constraint(text if formula is event.function else text + event.loops, *names)]
            else:
                terms = [*parse_sums(text, *names)]
        except ScviCodegenError as error:
            raise EventError(f"the formula '{formula}' of the event '{event.function}': {error}") from error
        self._accesses += [(access, term.loops) for term in terms for _, access in term.slots]
        return tuple(terms)

    def _function(
        self, name: str, term: Any, values: Sequence[Expr], lines: Iterable[str], to: Slots = (), *, within: bool
    ) -> str:
        """Add a function that evaluates formulas in the loops of a term; return its call.

        Args:
            name, values: of the kernel.
            term: a term or force, with its loops and slots.
            lines: statements after each evaluation; ``{0}``, ``{1}``, .. for the indices of the entries ``to``.
            to: slots of these entries.
            within: whether the loops have the ranges of the caller.
        """
        moving = [(slot, access) for slot, access in term.slots if access.array.name in self.moving and values]
        constants = [(slot, access) for slot, access in term.slots if access.array.name not in self.moving]
        self.uses_velocity |= any(self.moving[access.array.name][0] == 2 for _, access in moving)
        kernel = lower_kernel(
            name,
            arguments=[slot for slot, _ in moving],
            time=symbol(TIME),
            parameters=(*map(symbol, self.layout.parameters), *(slot for slot, _ in constants)),
            values=tuple(values),
        )
        rolled = RolledKernel(
            kernel=replace(kernel, purpose="Formulas of an event."),
            loops=term.loops,
            reads=tuple(access for _, access in moving),
            writes=(),
            constants=tuple(access for _, access in constants),
            text=f"Adds {name.replace('_', ' ')}.",
        )
        nest = _Entries(self, rolled, within=within)
        places = [nest.place_of(access) for _, access in to]
        inner = [f"{name}(u, at->t, parameters, value);"] * bool(values) + [line.format(*places) for line in lines]
        body = nest.text(innermost=inner)
        declared = f"double value[{len(values)}]" if values else ""
        self.kernels += [rolled.kernel] * bool(values)
        self.functions.append(nest.function(f"static void add_{name}", ARGUMENTS, body, values=declared))
        return f"add_{name}(arrays, at, in, to);"

    def _value(self, name: str, formula: Any, event: SearchedEvent, to: str = NEXT) -> list[str]:
        """Return statements that compute a formula at one element; a ``NEXT`` value is counted."""
        lines, within = [f"{to} = 0.0;"], bool(event.loops)
        for j, term in enumerate(self.terms(formula, event)):
            lines.append(self._function(f"{name}_{j}", term, [term.formula], [f"{to} += value[0];"], within=within))
        return [*lines, "to->count++;"] if to == NEXT else lines

    def _event(self, k: int, event: SearchedEvent) -> dict[str, Any]:
        self._accesses = list[tuple[Access, tuple[Loop, ...]]]()
        terms = self.terms(event.function, event)
        names = [access.array.name for term in terms for _, access in term.slots]
        moving = [name for name in names if self.moving.get(name, (0,))[0]]
        event.check_function(moving, constant=not any(term.formula.free_symbols for term in terms))
        loops = terms[0].loops if event.loops else ()
        if event.loops:
            line = "to->value[to->count++] = value[0];"
            functions = [self._function(f"event_{k}", terms[0], [terms[0].formula], [line], within=True)]
        else:
            functions = self._value(f"event_{k}", event.function, event)
        conditions = list[str]()
        for j, condition in enumerate(event.conditions):
            conditions += self._value(f"condition_{k}_{j}", condition, event)
        changes, entries = self._wall(k, event, terms) if event.restitution is not None else self._map(k, event)
        timed, bounds = self._in_time(k, event, terms)
        ranges = [(size_text(loop.first), size_text(loop.end), int(bool(loop.behind))) for loop in loops]
        code: dict[str, Any] = {
            "accesses": tuple(self._accesses),
            "functions": functions,
            "conditions": conditions,
            "changes": changes,
        }
        code |= {"timed": timed, "reaches": bounds}
        return {"ranges": ranges, "count": count_text(loops), "entries": entries, **code}

    def _in_time(self, k: int, event: SearchedEvent, terms: Sequence[ArrayTerm]) -> tuple[int, list[str]]:
        """Return 1 for a function of time alone, 2 if it is affine, else 0, and statements that compute its reaches."""
        whole = sympy.Add(*(term.formula for term in terms))
        if event.loops or any(term.loops or term.slots for term in terms) or not (kind := _kind_in_time(whole, ())):
            return 0, []
        array = self.layout.coordinates[0]
        place = f"[{', '.join('0' for _ in array.axes)}]" if array.axes else ""
        (radius,) = parse_sums(f"{array.name}{place}", self.positions, self.symbols, self.layout.tables)
        bounds = reaches(whole, symbol(TIME), radius.formula)
        lines = [f"to->value[to->count++] = value[{j}];" for j in range(3)]
        return kind, [self._function(f"reaches_{k}", radius, bounds, lines, within=False)]

    def _wall(self, k: int, event: SearchedEvent, terms: Sequence[ArrayTerm]) -> tuple[list[str], str]:
        """Return statements that compute the gradient of a wall and its restitution, and the number of entries."""
        if not self.rates:
            raise EventError(
                f"the impact '{event.function}' requires velocities, which are unknown for a system that is defined by "
                "a Hamiltonian: write the change of the momenta with then="
            )
        calls, counts, within = list[str](), list[str](), bool(event.loops)
        push = "event_host->places[to->count] = (int)({{{0}}});", "to->value[to->count++] = value[{0}];"
        for j, term in enumerate(terms):
            to = [(slot, access) for slot, access in term.slots if access.array.name in self.moving]
            values = [term.formula.diff(slot) for slot in (*(slot for slot, _ in to), symbol(TIME))]
            lines = [line.format(i) for i in range(len(to)) for line in push]
            lines.append(f"to->by_time += value[{len(to)}];")
            calls.append(self._function(f"normal_{k}_{j}", term, values, lines, to, within=within))
            counts.append(f"{len(to)} * {'1' if within else count_text(term.loops)}")
        calls += self._value(f"restitution_{k}", event.restitution, event, "to->restitution")
        return calls, " + ".join(counts)

    def _map(self, k: int, event: SearchedEvent) -> tuple[list[str], str]:
        """Return statements that compute the new values of variables, and their number."""
        calls, kinds = list[str](), set[int]()
        for j, (name, formula) in enumerate(event.changes):
            target = self.terms(name, event)
            slots = [pair for term in target for pair in term.slots]
            kind = self.moving.get(slots[0][1].array.name) if len(slots) == 1 else None
            if not kind or target[0].formula != slots[0][0] or (target[0].loops and not event.loops):
                raise EventError(
                    f"then={{'{name}': '{formula}'}} of the event '{event.function}': '{name}' is not an entry of a "
                    f"coordinate, a momentum or a velocity, such as {self.positions[-1]}"
                )
            kinds.add(kind[0])
            line = f"event_host->places[to->count - 1] = (int)({kind[0]} * M + {{0}});"
            calls += self._value(f"change_{k}_{j}", formula, event)
            calls.append(self._function(f"place_{k}_{j}", target[0], (), [line], slots, within=True))
        if kinds >= {1, 2}:
            raise EventError(f"the event '{event.function}' sets momenta and velocities: set one or the other")
        return calls, str(len(event.changes))


array_events = lru_cache(maxsize=64)(ArrayEvents)
