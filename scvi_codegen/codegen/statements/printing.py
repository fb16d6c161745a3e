"""C of the statements of a step: loops, storage and number types.

Statements on values of the same index become one loop, and values that only this loop uses its local variables. Where
points of a step are SIMD lanes, loops are inside of a loop over groups of points (:mod:`.schedule`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum, auto

from scvi_codegen.codegen.statements.arithmetic import Value, combine, high_word, negated
from scvi_codegen.codegen.statements.schedule import (
    PointLoop,
    in_registers,
    names_read,
    over_points,
    point_loops,
    reads,
    target_name,
)
from scvi_codegen.common.errors import MethodError
from scvi_codegen.methods.statements import (
    COUNTS,
    Apply,
    Assign,
    At,
    Constant,
    Entry,
    Expression,
    Former,
    Operation,
    OverPoints,
    Read,
    Repeat,
    Statement,
    When,
)


class Place(Enum):
    """Where the values of a quantity are."""

    LOCAL = auto()
    """In a variable of a loop over an index."""
    ARRAY = auto()
    """``x[i]``: of the trajectory, or of the present points."""
    STATE = auto()
    """``x[i]`` with low words, to which sums are added first."""
    NUMBER = auto()
    """One number for all coordinates."""
    MEMORY = auto()
    """In memory, at all points: sums over points read it number by number."""
    GROUPS = auto()
    """``x[i][g]``: vectors of all points."""
    FLAT = auto()
    """``x[i * GROUPS + g]``: the same in one array."""
    TABLE = auto()
    """A number for each point."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """A quantity of the statements in C.

    Attributes:
        text: the array or the number.
        place: where its values are.
        words: of a value.
        low: the array of the low words of a state.
        first: the array of the values at the first point, which is not among the points.
        uniform: whether it is one number for all lanes.
        index: letter of its index.
    """

    text: str
    place: Place = Place.ARRAY
    words: int = 1
    low: str = ""
    first: str = ""
    uniform: bool = False
    index: str = "i"


@dataclass(frozen=True)
class Layout:
    """C of a step without points: numbers of one ``word`` or of two; with ``lanes`` trajectories are SIMD lanes."""

    words: int = 1
    lanes: bool = False
    word: str = "number"

    @property
    def number(self) -> str:
        """Type of a value of the trajectory."""
        return self.type_of(Quantity("", words=self.words, uniform=not self.lanes))

    def type_of(self, quantity: Quantity) -> str:
        """Return the type of a value."""
        if quantity.words == 1:
            return self.word
        return "dd" if quantity.uniform else "ddl"

    def local(self, name: str, place: Place, words: int, index: str) -> Quantity:
        """Return a quantity that only the statements use."""
        return Quantity(name, place, words, uniform=not self.lanes, index=index)

    def pair(self, high: str, low: str) -> Value:
        """Return a number of two words that are in arrays."""
        if self.lanes:
            return Value(f"ddl_of_words({high}, {low})", 2)
        return Value(f"dd_of({high}, {low})", 2, uniform=True)

    def read(self, quantity: Quantity, at: At | None) -> Value:
        """Return a value of a quantity."""
        index = "" if at is None or quantity.place is Place.LOCAL else f"[{at.text}]"
        if quantity.place is Place.STATE and self.words == 2:
            return self.pair(f"{quantity.text}{index}", f"{quantity.low}{index}")
        return Value(f"{quantity.text}{index}", quantity.words, quantity.uniform)

    def write(self, quantity: Quantity, at: At | None, value: str) -> str:
        """Return the statement that stores a value."""
        return f"{self.read(quantity, at).text} = {value};"

    def former(self, quantity: Quantity, at: At) -> Value:
        """Return the value at the point before; MethodError if the layout has no points."""
        raise MethodError(f"former({quantity.text}[{at.text}]) is a value of points, which this step has not")

    def over_points(self, table: str, quantity: Quantity, at: At) -> Value:
        """Return the sum over points with the row of a table; MethodError if the layout has no points."""
        raise MethodError(f"{table} @ {quantity.text}[{at.text}] is a sum over points, which this step has not")


@dataclass(frozen=True)
class PointsAsLanes(Layout):
    """Layout of the points of constrained steps, which are SIMD lanes (point_lanes.h)."""

    def type_of(self, quantity: Quantity) -> str:
        """Return the type of a value."""
        return "lanes" if quantity.words == 1 else "ddl"

    def local(self, name: str, place: Place, words: int, index: str) -> Quantity:
        """Return a quantity that only the statements use, a vector."""
        return Quantity(name, place, words, index=index)

    def read(self, quantity: Quantity, at: At | None) -> Value:
        """Return the values of a quantity at the points of a vector."""
        place, words = quantity.place, quantity.words
        index = "" if at is None or place is Place.LOCAL else f"[{at.text}]"
        text = f"{quantity.text}{index}"
        match place:
            case Place.MEMORY if words == 1:
                return Value(f"load({text}, g)")
            case Place.MEMORY | Place.GROUPS:
                return Value(f"{text}[g]", words)
            case Place.FLAT:
                return Value(f"{quantity.text}[{at and at.text} * GROUPS + g]", words)
            case Place.TABLE if words == 1:
                return Value(f"weights({text}, g)")
            case Place.TABLE:
                return Value(f"ddl_of_words(weights({text}, g), weights({text}_LOW, g))", 2)
        return Value(text, words, quantity.uniform)

    def write(self, quantity: Quantity, at: At | None, value: str) -> str:
        """Return the statement that stores the values at the points of a vector."""
        if quantity.place is Place.MEMORY and quantity.words == 1:
            return f"store({quantity.text}[{at and at.text}], g, {value});"
        return super().write(quantity, at, value)

    def former(self, quantity: Quantity, at: At) -> Value:
        """Return the value at the point before."""
        function = "former" if quantity.words == 1 else "former_pairs"
        text = f"{function}({quantity.text}[{at.text}], {quantity.first}[{at.text}], g)"
        return Value(text, quantity.words)

    def over_points(self, table: str, quantity: Quantity, at: At) -> Value:
        """Return the sum over points with the row of a table."""
        if quantity.words == 1:
            return Value(f"times({table}, DEGREE, {quantity.text}[{at.text}], g)")
        words = f"{quantity.text}_high[{at.text}], {quantity.text}_low[{at.text}]"
        return Value(f"pair_times({table}, {table}_LOW, {words}, g)", 2)

    def declaration(self, quantity: Quantity) -> str:
        """Return the declaration of a quantity at all points."""
        count = COUNTS[quantity.index]
        if quantity.place is Place.GROUPS or quantity.words == 2:
            return f"{self.type_of(quantity)} {quantity.text}[{count}][GROUPS];"
        return f"number {quantity.text}[{count}][GROUP_LANES];"


@dataclass
class Printer:
    """C of statements.

    Attributes:
        quantities: by name; those that statements compute and that are not named here are local.
        layout: numbers and lanes.
        operations: C of each operation and of the call of each kernel, with ARGUMENT, TARGET and TIME in it.
    """

    quantities: Mapping[str, Quantity]
    layout: Layout
    operations: Mapping[str, str]
    locals: dict[str, Quantity] = field(default_factory=dict)

    def function_body(self, statements: Sequence[Statement]) -> list[str]:
        """Return the lines of a function without points."""
        for name, letter in _computed(statements).items():
            if name not in self.quantities:
                place = Place.LOCAL if _is_of_one_loop(name, statements) else Place.ARRAY
                self.locals[name] = self.layout.local(name, place, self.layout.words, letter)
        return [*self._declarations(self.locals.values()), *self.lines(statements)]

    def function_of_points(self, statements: Sequence[Statement]) -> list[str]:
        """Return the lines of a function with points."""
        assert isinstance(self.layout, PointsAsLanes)
        stored = {name for name, quantity in self.quantities.items() if quantity.place in (Place.MEMORY, Place.GROUPS)}
        loops = point_loops(statements, stored)
        self._place(loops)
        quantities = {**self.quantities, **self.locals}
        memory = {
            name for name, quantity in quantities.items() if quantity.place is Place.MEMORY and quantity.words == 1
        }
        loops = [in_registers(loop, memory) for loop in loops]
        shared = [quantity for quantity in self.locals.values() if quantity.place in (Place.MEMORY, Place.GROUPS)]
        lines = [self.layout.declaration(quantity) for quantity in shared]
        for loop in loops:
            lines += self._point_loop(loop)
        return lines

    def _place(self, loops: Sequence[PointLoop]) -> None:
        """Find the place of each local quantity."""
        statements = [statement for loop in loops for statement in loop.body]
        summed = set[str]().union(
            *(over_points(statement.value) for statement in statements if isinstance(statement, Assign))
        )
        for name, letter in _computed(statements).items():
            if name in self.quantities:
                continue
            users = [k for k, loop in enumerate(loops) if any(name in _all_names(statement) for statement in loop.body)]
            if name in summed:
                place = Place.MEMORY
            elif len(users) > 1:
                place = Place.GROUPS
            else:
                place = Place.LOCAL if _is_of_one_loop(name, loops[users[0]].body) else Place.ARRAY
            self.locals[name] = self.layout.local(name, place, self._words(name, statements), letter)

    def _words(self, name: str, statements: Sequence[Statement]) -> int:
        """Return the words of a local quantity: those of the first value that it is given."""
        for statement in statements:
            if target_name(statement) == name:
                if isinstance(statement, Apply):
                    return self.quantity(statement.argument).words
                assert isinstance(statement, Assign)
                return self.value(statement.value).words
        raise AssertionError(name)

    def _point_loop(self, loop: PointLoop) -> Iterator[str]:
        assert isinstance(self.layout, PointsAsLanes)
        own = {}
        for name, letter in _computed(loop.body).items():
            if name not in self.quantities and name not in self.locals:  # a register
                original = self.quantity(name.removesuffix("_now"))
                self.locals[name] = own[name] = self.layout.local(name, Place.ARRAY, original.words, letter)
            elif name in self.locals and self.locals[name].place is Place.ARRAY:
                own[name] = self.locals[name]
        yield "for (int g = 0; g < GROUPS; g++) {"
        yield from map("  {}".format, [*self._declarations(own.values()), *self.lines(loop.body)])
        yield "}"
        for name in loop.summed_later:
            yield from self._in_memory(self.quantity(name))

    def _in_memory(self, quantity: Quantity) -> Iterator[str]:
        """Yield what makes values readable number by number; the words of pairs are in arrays of their own."""
        if quantity.words == 1:
            yield f"IN_MEMORY({quantity.text});"
            return
        text, count = quantity.text, COUNTS[quantity.index]
        yield f"real {text}_high[{count}][GROUP_LANES], {text}_low[{count}][GROUP_LANES];"
        yield f"for (int {quantity.index} = 0; {quantity.index} < {count}; {quantity.index}++)"
        yield "  for (int g = 0; g < GROUPS; g++) {"
        for word in "high", "low":
            yield f"    store({text}_{word}[{quantity.index}], g, {text}[{quantity.index}][g].{word});"
        yield "  }"
        for word in "high", "low":
            yield f"IN_MEMORY({text}_{word});"

    def _declarations(self, quantities: Iterable[Quantity]) -> list[str]:
        """Return the declarations of arrays, by their types."""
        arrays: dict[str, list[str]] = {}
        for quantity in quantities:
            if quantity.place is Place.ARRAY:
                declared = f"{quantity.text}[{COUNTS[quantity.index]}]"
                arrays.setdefault(self.layout.type_of(quantity), []).append(declared)
        return [f"{kind} {', '.join(names)};" for kind, names in arrays.items()]

    def lines(self, statements: Sequence[Statement]) -> Iterator[str]:
        """Yield the lines of a block."""
        for statement in _fused(statements):
            match statement:
                case tuple():
                    yield from self.loop(statement)
                case Repeat(row=row, count=count, body=body):
                    yield f"for (int {row} = 0; {row} < {count}; {row}++) {{"
                    yield from map("  {}".format, self.lines(body))
                    yield "}"
                case When(condition=condition, body=body):
                    yield f"if ({condition.text}) {{"
                    yield from map("  {}".format, self.lines(body))
                    yield "}"
                case Apply(name=name, argument=argument, target=target, time=time):
                    text = self.operations[name].replace("ARGUMENT", self.quantity(argument).text)
                    if target is not None:
                        text = text.replace("TARGET", self.quantity(target.name).text)
                    if time is not None:
                        text = text.replace("TIME", self.value(time).text)
                    yield from text.splitlines()

    def loop(self, assignments: Sequence[Assign]) -> Iterator[str]:
        """Yield a loop over one index."""
        letter, lines = _letter(assignments[0]), [self.assignment(statement) for statement in assignments]
        if letter is None:
            yield from lines
            return
        if letter == "e":
            yield "#pragma GCC unroll 64"
        head = f"for (int {letter} = 0; {letter} < {COUNTS[letter]}; {letter}++)"
        if len(lines) == 1:
            yield head
            yield f"  {lines[0]}"
        else:
            yield f"{head} {{"
            yield from map("  {}".format, lines)
            yield "}"

    def assignment(self, statement: Assign) -> str:
        """Return the C of an assignment."""
        quantity, value, at = self.quantity(statement.target.name), self.value(statement.value), statement.target.at
        if statement.operator:
            target = self.layout.read(quantity, at)
            if quantity.place is Place.STATE and at:
                increment = value if statement.operator == "+" else negated(value)
                return f"add_to_state(&{target.text}, &{quantity.low}[{at.text}], {increment.text});"
            if quantity.words == 1 and quantity.place is not Place.MEMORY:
                return f"{target.text} {statement.operator}= {value.text};"
            value = combine(statement.operator, target, value)
        if quantity.words == 2 and (value.words == 1 or value.uniform != quantity.uniform):
            value = value.widened(quantity.uniform)
        assert quantity.words >= value.words, statement
        if quantity.place is Place.LOCAL:
            return f"const {self.layout.type_of(quantity)} {quantity.text} = {value.text};"
        return self.layout.write(quantity, at, value.text)

    def quantity(self, name: str) -> Quantity:
        """Return a quantity by its name."""
        return self.quantities.get(name) or self.locals[name]

    def value(self, expression: Expression) -> Value:
        """Return the C of an expression."""
        match expression:
            case Constant(text=text):
                return Value(text, uniform=True)
            case Entry(table=table, row=row):
                if self.layout.words == 1:
                    return Value(f"{table}[{row}]", uniform=True)
                return Value(f"dd_of({table}[{row}], {table}_LOW[{row}])", 2, uniform=True)
            case Read(name=name, at=at):
                return self.layout.read(self.quantity(name), at)
            case Former(value=Read(name=name, at=At() as at)):
                return self.layout.former(self.quantity(name), at)
            case OverPoints(table=table, value=Read(name=name, at=At() as at)):
                return self.layout.over_points(table, self.quantity(name), at)
            case Operation():
                return self.operation(expression)
        raise AssertionError(expression)

    def operation(self, operation: Operation) -> Value:
        """Return the C of an operation; what is added to a state is added to its low word first."""
        match operation:
            case Operation("+", (Read(name=name, at=At() as at), increment)) if (
                state := self.quantity(name)
            ).place is Place.STATE and self.layout.words == 1:
                low = Value(f"{state.low}[{at.text}]", uniform=state.uniform)
                return combine("+", self.layout.read(state, at), combine("+", low, self.value(increment)))
            case Operation("-", (operand,)):
                return negated(self.value(operand))
            case Operation("word", (operand,)):
                return high_word(self.value(operand))
            case Operation(operator, (left, right)):
                return combine(operator, self.value(left), self.value(right))
        raise AssertionError(operation)


def _letter(statement: Assign) -> str | None:
    """Return the letter of the index of a statement; of a number that is no sum over an index ``None``."""
    quantities = (statement.target, *reads(statement.value))
    return next((quantity.at.letter for quantity in quantities if quantity.at is not None), None)


def _gathers(statement: Assign) -> bool:
    """Return whether a statement reads or computes values at indices from tables."""
    return any(
        quantity.at is not None and quantity.at.gathers for quantity in (statement.target, *reads(statement.value))
    )


def _fused(statements: Sequence[Statement]) -> Iterator[Statement | tuple[Assign, ...]]:
    """Yield statements, those on the same index one after the other as one loop."""
    loop: tuple[Assign, ...] = ()
    for statement in statements:
        if loop and not (isinstance(statement, Assign) and _continues(loop, statement)):
            yield loop
            loop = ()
        if isinstance(statement, Assign):
            loop = (*loop, statement)
        else:
            yield statement
    if loop:
        yield loop


def _continues(loop: Sequence[Assign], statement: Assign) -> bool:
    """Return whether a statement can be in a loop: on the same index, without values at indices from tables."""
    return _letter(loop[0]) == _letter(statement) and not any(map(_gathers, (*loop, statement)))


def _loops(statements: Sequence[Statement]) -> Iterator[Sequence[Statement]]:
    """Yield the statements of each loop over an index, and others one by one."""
    for statement in _fused(statements):
        match statement:
            case tuple():
                yield statement
            case Repeat(body=body) | When(body=body):
                yield from _loops(body)
            case _:
                yield (statement,)


def _computed(statements: Sequence[Statement]) -> dict[str, str]:
    """Return the names of the quantities that statements compute, in order, with the letters of their indices."""
    letters: dict[str, str] = {}
    for statement in statements:
        match statement:
            case Assign(target=Read(name=name, at=At() as at)) | Apply(target=Read(name=name, at=At() as at)):
                letters.setdefault(name, at.letter)
            case Repeat(body=body) | When(body=body):
                letters = {**_computed(body), **letters}
    return letters


def _all_names(statement: Statement) -> set[str]:
    """Return the names of all quantities that a statement reads or computes."""
    name = target_name(statement)
    return names_read(statement) | ({name} if name else set())


def _is_of_one_loop(name: str, statements: Sequence[Statement]) -> bool:
    """Return whether one loop over an index computes a quantity, once, and uses it, at its own index alone."""
    users = [loop for loop in _loops(statements) if any(name in _all_names(statement) for statement in loop)]
    if len(users) > 1 or any(isinstance(statement, Apply) and name in _all_names(statement) for statement in users[0]):
        return False
    return sum(target_name(statement) == name for statement in users[0]) == 1
