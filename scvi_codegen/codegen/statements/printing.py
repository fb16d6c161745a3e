"""C of the statements of a step: loops, storage and number types.

Statements on values of the same index become one loop, and values that only this loop uses its local variables. Where
points of a step are SIMD lanes, loops are inside of a loop over groups of points, one group a vector. A statement that
sums over points, or reads the point before, of a value that the present loop computes needs all its points: there the
loop over groups ends.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum, auto
from itertools import chain

from scvi_codegen.codegen.statements.arithmetic import Value, combine, high_word, negated
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

Simple = Assign | Apply


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
    TABLE = auto()
    """A number for each point."""


SHAPES = {Place.ARRAY: "", Place.MEMORY: "[GROUP_LANES]", Place.GROUPS: "[GROUPS]"}
"""Dimensions of local arrays behind that of their index."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """A quantity of the statements in C.

    Attributes:
        text: the array or the number.
        place: where its values are.
        words: of a value.
        low: the array of the low words of a state.
        first: the array of the values at the first point, which is not among the points; of ``x->y`` x->first_y.
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

    def at(self, at: At | None) -> str:
        """Return the C of a value of an array."""
        return self.text if at is None or self.place is Place.LOCAL else f"{self.text}[{at.text}]"


@dataclass(frozen=True)
class Layout:
    """C of a step without points: numbers of one ``word`` or of two; with ``lanes`` trajectories are SIMD lanes."""

    words: int = 1
    lanes: bool = False
    word: str = "number"

    def type_of(self, quantity: Quantity) -> str:
        """Return the type of a value."""
        two = "dd" if quantity.uniform else "ddl"
        return self.word if quantity.words == 1 else two

    def read(self, quantity: Quantity, at: At | None) -> Value:
        """Return a value of a quantity."""
        text = quantity.at(at)
        if quantity.place is Place.STATE and self.words == 2:
            of_words = "ddl_of_words" if self.lanes else "dd_of"
            return Value(f"{of_words}({text}, {quantity.low}[{at and at.text}])", 2, uniform=not self.lanes)
        return Value(text, quantity.words, quantity.uniform)

    def write(self, quantity: Quantity, at: At | None, value: str) -> str:
        """Return the statement that stores a value."""
        return f"{self.read(quantity, at).text} = {value};"

    def at_other_points(self, expression: Former | OverPoints, quantity: Quantity) -> Value:
        """Return a value that depends on other points; MethodError if the layout has none."""
        raise MethodError(f"values of '{quantity.text}' at other points are needed, but this step has no points")


@dataclass(frozen=True)
class PointsAsLanes(Layout):
    """Layout of the points of constrained steps, which are SIMD lanes (point_lanes.h)."""

    lanes: bool = True
    word: str = "lanes"

    def read(self, quantity: Quantity, at: At | None) -> Value:
        """Return the values of a quantity at the points of a vector."""
        text, words = quantity.at(at), quantity.words
        match quantity.place:
            case Place.MEMORY:
                return Value(f"load({text}, g)")
            case Place.GROUPS:
                return Value(f"{text}[g]", words)
            case Place.TABLE if words == 1:
                return Value(f"weights({text}, g)")
            case Place.TABLE:
                return Value(f"ddl_of_words(weights({text}, g), weights({text}_LOW, g))", 2)
        return Value(text, words, quantity.uniform)

    def write(self, quantity: Quantity, at: At | None, value: str) -> str:
        """Return the statement that stores the values at the points of a vector."""
        if quantity.place is Place.MEMORY:
            return f"store({quantity.at(at)}, g, {value});"
        return super().write(quantity, at, value)

    def at_other_points(self, expression: Former | OverPoints, quantity: Quantity) -> Value:
        """Return the value at the point before, or the sum over points with the row of a table."""
        at, text, words = expression.value.at, quantity.at(expression.value.at), quantity.words
        if isinstance(expression, Former):
            function = "former" if words == 1 else "former_pairs"
            first = quantity.first or quantity.text.replace("->", "->first_")
            return Value(f"{function}({text}, {first}[{at and at.text}], g)", words)
        table = expression.table
        if words == 1:
            return Value(f"times({table}, DEGREE, {text}, g)")
        high, low = (f"{quantity.text}_{word}[{at and at.text}]" for word in ("high", "low"))
        return Value(f"pair_times({table}, {table}_LOW, {high}, {low}, g)", 2)


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
        self._place([statements], ())
        return [*self._declarations(self.locals.values()), *self.lines(statements)]

    def function_of_points(self, statements: Sequence[Statement]) -> list[str]:
        """Return the lines of a function with points."""
        loops = point_loops(statements)
        needed = [set[str]().union(*map(over_points, loop)) for loop in loops]
        self._place(loops, set[str]().union(*needed))
        lines = self._declarations(quantity for quantity in self.locals.values() if quantity.place is not Place.ARRAY)
        for number, loop in enumerate(loops):
            lines += self._point_loop(loop, set[str]().union(*needed[number + 1 :]))
        return lines

    def _place(self, blocks: Sequence[Sequence[Statement]], summed: Collection[str]) -> None:
        """Find places and words of the local quantities; a block is the body of a loop over points."""
        loops = [list(_loops(block)) for block in blocks]
        for statement in chain.from_iterable(chain.from_iterable(loops)):
            name, index = target_name(statement), statement.target.at if statement.target else None
            if name is None or index is None or name in self.quantities or name in self.locals:
                continue
            users = [users for block in loops if (users := [loop for loop in block if _uses(loop, name)])]
            match statement:
                case Assign(value=value):
                    words = self.value(value).words
                case Apply(argument=argument):
                    words = self.quantity(argument).words
            if len(users) > 1:
                place = Place.MEMORY if name in summed and words == 1 else Place.GROUPS
            else:
                place = Place.LOCAL if len(users[0]) == 1 and _is_local(users[0][0], name) else Place.ARRAY
            self.locals[name] = Quantity(name, place, words, uniform=not self.layout.lanes, index=index.letter)

    def _point_loop(self, loop: Sequence[Simple], summed_later: Collection[str]) -> Iterator[str]:
        """Yield a loop over groups of points, and what makes values that later ones sum readable in memory."""
        names = [name for name in dict.fromkeys(map(target_name, loop)) if name]
        own = [self.locals[name] for name in names if name in self.locals and self.locals[name].place is Place.ARRAY]
        yield from _braced("for (int g = 0; g < GROUPS; g++)", [*self._declarations(own), *self.lines(loop)])
        for name in names:
            yield from self._in_memory(self.quantity(name)) if name in summed_later else ()

    def _in_memory(self, quantity: Quantity) -> Iterator[str]:
        """Yield what makes values readable number by number; the words of pairs are in arrays of their own."""
        text, index, count = quantity.text, quantity.index, COUNTS[quantity.index]
        for word in () if quantity.words == 1 else ("high", "low"):
            yield f"real {text}_{word}[{count}][GROUP_LANES];"
            yield f"for (int {index} = 0; {index} < {count}; {index}++)"
            yield "  for (int g = 0; g < GROUPS; g++)"
            yield f"    store({text}_{word}[{index}], g, {text}[{index}][g].{word});"
        yield from (f"IN_MEMORY({text}{word});" for word in ([""] if quantity.words == 1 else ["_high", "_low"]))

    def _declarations(self, quantities: Iterable[Quantity]) -> list[str]:
        """Return the declarations of arrays, by their types."""
        arrays: dict[str, list[str]] = {}
        for quantity in quantities:
            if quantity.place in SHAPES:
                kind = "number" if quantity.place is Place.MEMORY else self.layout.type_of(quantity)
                declared = f"{quantity.text}[{COUNTS[quantity.index]}]{SHAPES[quantity.place]}"
                arrays.setdefault(kind, []).append(declared)
        return [f"{kind} {', '.join(names)};" for kind, names in arrays.items()]

    def lines(self, statements: Sequence[Statement]) -> Iterator[str]:
        """Yield the lines of a block."""
        for statement in _fused(statements):
            match statement:
                case tuple():
                    yield from self.loop(statement)
                case Repeat(row=row, count=count, body=body):
                    yield from _braced(f"for (int {row} = 0; {row} < {count}; {row}++)", self.lines(body))
                case When(condition=condition, body=body):
                    yield from _braced(f"if ({condition.text})", self.lines(body))
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
        yield from (head, f"  {lines[0]}") if len(lines) == 1 else _braced(head, lines)

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
        """Return the C of an expression; what is added to a state is added to its low word first."""
        match expression:
            case Constant(text=text):
                return Value(text, uniform=True)
            case Entry(table=table, row=row):
                if self.layout.words == 1:
                    return Value(f"{table}[{row}]", uniform=True)
                return Value(f"dd_of({table}[{row}], {table}_LOW[{row}])", 2, uniform=True)
            case Read(name=name, at=at):
                return self.layout.read(self.quantity(name), at)
            case Former(value=read) | OverPoints(value=read):
                return self.layout.at_other_points(expression, self.quantity(read.name))
            case Operation("-", (operand,)):
                return negated(self.value(operand))
            case Operation("word", (operand,)):
                return high_word(self.value(operand))
            case Operation("+", (Read(name=name, at=At() as at) as read, increment)) if (
                state := self.quantity(name)
            ).place is Place.STATE and self.layout.words == 1:
                low = Value(f"{state.low}[{at.text}]", uniform=state.uniform)
                return combine("+", self.value(read), combine("+", low, self.value(increment)))
            case Operation(operator, (left, right)):
                return combine(operator, self.value(left), self.value(right))
        raise AssertionError(expression)


def point_loops(statements: Sequence[Statement]) -> list[list[Simple]]:
    """Return the statements of each loop over points."""
    loops, computed = [list[Simple]()], set[str | None]()
    for statement in statements:
        assert isinstance(statement, Assign | Apply), "a repetition is not part of a loop over points"
        if over_points(statement) & computed:
            loops.append([])
            computed = set()
        loops[-1].append(statement)
        computed.add(target_name(statement))
    return loops


def target_name(statement: Statement) -> str | None:
    """Return the name of the quantity that a statement computes."""
    return statement.target.name if isinstance(statement, Assign | Apply) and statement.target else None


def parts(expression: Expression) -> Iterator[Expression]:
    """Yield an expression and all in it."""
    yield expression
    match expression:
        case OverPoints(value=value) | Former(value=value):
            yield value
        case Operation(operands=operands):
            for operand in operands:
                yield from parts(operand)


def quantities(statement: Assign) -> Iterator[Read]:
    """Yield the quantities that a statement computes and reads."""
    yield statement.target
    yield from (part for part in parts(statement.value) if isinstance(part, Read))


def over_points(statement: Simple) -> set[str]:
    """Return the names of the quantities of which a statement needs other points."""
    if isinstance(statement, Apply):
        return set()
    return {part.value.name for part in parts(statement.value) if isinstance(part, OverPoints | Former)}


def all_names(statement: Simple) -> set[str]:
    """Return the names of all quantities that a statement reads or computes."""
    match statement:
        case Assign():
            return {quantity.name for quantity in quantities(statement)}
        case Apply(argument=argument, time=time):
            times = {part.name for part in parts(time) if isinstance(part, Read)} if time is not None else set()
            return {argument, *times} | {name for name in (target_name(statement),) if name}


def _braced(head: str, lines: Iterable[str]) -> Iterator[str]:
    yield f"{head} {{"
    yield from map("  {}".format, lines)
    yield "}"


def _letter(statement: Assign) -> str | None:
    """Return the letter of the index of a statement; of a number that is no sum over an index ``None``."""
    return next((quantity.at.letter for quantity in quantities(statement) if quantity.at is not None), None)


def _fused(statements: Sequence[Statement]) -> Iterator[Statement | tuple[Assign, ...]]:
    """Yield statements, those on the same index one after the other as one loop, without indices from tables."""
    loop: tuple[Assign, ...] = ()
    for statement in statements:
        if loop and not (
            isinstance(statement, Assign)
            and _letter(loop[0]) == _letter(statement)
            and not any(each.at and each.at.gathers for part in (*loop, statement) for each in quantities(part))
        ):
            yield loop
            loop = ()
        if isinstance(statement, Assign):
            loop = (*loop, statement)
        else:
            yield statement
    if loop:
        yield loop


def _loops(statements: Sequence[Statement]) -> Iterator[Sequence[Simple]]:
    """Yield the statements of each loop over an index, and others one by one."""
    for statement in _fused(statements):
        if isinstance(statement, Repeat | When):
            yield from _loops(statement.body)
        else:
            yield statement if isinstance(statement, tuple) else (statement,)


def _uses(loop: Sequence[Simple], name: str) -> bool:
    return any(name in all_names(statement) for statement in loop)


def _is_local(loop: Sequence[Simple], name: str) -> bool:
    """Return whether a loop over an index computes a quantity, once, and uses it, at its own index alone."""
    return isinstance(loop[0], Assign) and sum(target_name(statement) == name for statement in loop) == 1
