"""Events in index notation as C: functions, conditions and changes of the state for all elements of loops.

An event ``g for i in N`` has a function for each element of its loops. Its functions are evaluated in these loops, or
one of them with ranges of one element. Gradients and maps are lists of entries: the work of a change does not grow with
the number of coordinates that it does not involve.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, TypeAlias

from sympy import Expr

from scvi_codegen.errors import EventError, ScviCodegenError
from scvi_codegen.formulas.array_statements import parse_constraint
from scvi_codegen.formulas.arrays import ArrayTerm, parse_sums
from scvi_codegen.formulas.symbols import DOT, TIME, symbol
from scvi_codegen.indices import Access, Array, Loop
from scvi_codegen.ir.arithmetic import lower_kernel
from scvi_codegen.ir.kernel import Kernel, RolledKernel
from scvi_codegen.ir.program import Layout
from scvi_codegen.rendering.kernels.loop_nests import Nest, count_text, size_text

if TYPE_CHECKING:
    from scvi_codegen.rendering.source import Interface

SearchedEvent: TypeAlias = Any
Slots: TypeAlias = Sequence[tuple[Any, Access]]
ARGUMENTS = ("const problem *given", "const event_point *at", "const section *in", "event_entries *to")
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
            largest number of variables that one changes; ``accesses`` of arrays, with the loops around them.
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
        self.symbols = {name: symbol(name) for name in (TIME, *interface.parameters)}
        self.moving = {
            array.name: (k, layout.coordinates[j].name)
            for k, each in enumerate(vectors)
            for j, array in enumerate(each)
        }
        self.uses_velocity, self.functions, self.kernels = False, list[str](), list[Kernel]()
        self.events = [self._event(k, event) for k, event in enumerate(events)]

    def terms(self, formula: Any, event: SearchedEvent) -> tuple[ArrayTerm, ...]:
        """Return the terms of a formula of an event; in the loops of the event, one term for each of their elements.

        Raises:
            EventError: if the formula is invalid.
        """
        text, known = str(formula), ([*self.positions, *self.rates], self.symbols, self.layout.tables)
        try:
            if event.loops:
                each = parse_constraint(text if formula is event.function else text + event.loops, *known)
            terms = (each,) if event.loops else parse_sums(text, *known)
        except ScviCodegenError as error:
            raise EventError(f"the formula '{formula}' of the event '{event.function}': {error}") from error
        self._accesses += [(access, term.loops) for term in terms for _, access in term.slots]
        return terms

    def _function(
        self, name: str, of: Any, values: Sequence[Expr], lines: Iterable[str], to: Slots = (), *, within: bool
    ) -> str:
        """Add a function that evaluates formulas in the loops of a term; return its call.

        Args:
            name, values: of the kernel.
            of: a term or force, with its loops and slots.
            lines: statements after each evaluation; ``{0}``, ``{1}``, .. for the indices of the entries ``to``.
            to: slots of these entries.
            within: whether the loops have the ranges of the caller.
        """
        moving = [(slot, access) for slot, access in of.slots if access.array.name in self.moving and values]
        given = [(slot, access) for slot, access in of.slots if access.array.name not in self.moving]
        self.uses_velocity |= any(self.moving[access.array.name][0] == 2 for _, access in moving)
        kernel = lower_kernel(
            name,
            arguments=[slot for slot, _ in moving],
            time=symbol(TIME),
            parameters=(*map(symbol, self.layout.parameters), *(slot for slot, _ in given)),
            values=tuple(values),
        )
        rolled = RolledKernel(
            kernel=replace(kernel, purpose="Formulas of an event."),
            loops=of.loops,
            reads=tuple(access for _, access in moving),
            writes=(),
            given=tuple(access for _, access in given),
            text=f"Adds {name.replace('_', ' ')}.",
        )
        nest = _Entries(self, rolled, within=within)
        places = [nest.place_of(access) for _, access in to]
        inner = [f"{name}(u, at->t, parameters, value);"] * bool(values) + [line.format(*places) for line in lines]
        body = ["(void)given, (void)at, (void)in, (void)to;", *nest.text(innermost=inner)]
        declared = f"double value[{len(values)}]" if values else ""
        self.kernels += [rolled.kernel] * bool(values)
        self.functions.append(nest.function(f"static void add_{name}", ARGUMENTS, body, values=declared))
        return f"add_{name}(given, at, in, to);"

    def _value(self, name: str, formula: Any, event: SearchedEvent, to: str = NEXT) -> list[str]:
        """Return statements that compute a formula at one element; a ``NEXT`` value is counted."""
        lines, within = [f"{to} = 0.0;"], bool(event.loops)
        for j, each in enumerate(self.terms(formula, event)):
            lines.append(self._function(f"{name}_{j}", each, [each.formula], [f"{to} += value[0];"], within=within))
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
        conditions = [
            line for j, each in enumerate(event.conditions) for line in self._value(f"condition_{k}_{j}", each, event)
        ]
        changes, entries = self._wall(k, event, terms) if event.restitution is not None else self._map(k, event)
        ranges = [(size_text(loop.first), size_text(loop.end), int(bool(loop.behind))) for loop in loops]
        code = {"accesses": tuple(self._accesses), "functions": functions, "conditions": conditions, "changes": changes}
        return {"ranges": ranges, "count": count_text(loops), "entries": entries, **code}

    def _wall(self, k: int, event: SearchedEvent, terms: Sequence[ArrayTerm]) -> tuple[list[str], str]:
        """Return statements that compute the gradient of a wall and its restitution, and the number of entries."""
        if not self.rates:
            raise EventError(
                f"the impact '{event.function}' requires velocities, which are unknown for a system that is defined by "
                "a Hamiltonian: write the change of the momenta with then="
            )
        calls, counts, within = list[str](), list[str](), bool(event.loops)
        push = "to->place[to->count] = (int)({{{0}}});", "to->value[to->count++] = value[{0}];"
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
            line = f"to->place[to->count - 1] = (int)({kind[0]} * M + {{0}});"
            calls += self._value(f"change_{k}_{j}", formula, event)
            calls.append(self._function(f"place_{k}_{j}", target[0], (), [line], slots, within=True))
        if kinds >= {1, 2}:
            raise EventError(f"the event '{event.function}' sets momenta and velocities: set one or the other")
        return calls, str(len(event.changes))


array_events = lru_cache(maxsize=64)(ArrayEvents)
