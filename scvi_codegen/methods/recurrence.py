"""Explicit steps as statements, and their linear recurrence, with forces and velocities as letters.

Every value is a sum of the state q0, p0, of forces F_n = L_q(u_n, t_n) and of velocities V_k = M^-1 X_k, whose
coefficients are polynomials in h; u_n are such sums of q0 and velocities, X_k of p0 and forces.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias, cast

from scvi_codegen.common.errors import MethodError
from scvi_codegen.common.precision import Number, Vector, mp
from scvi_codegen.common.representation import summary
from scvi_codegen.common.validation import MAPPING, NUMBERS, TEXT, ArgumentType, check_kind
from scvi_codegen.methods.statements import (
    Apply,
    Assign,
    At,
    Comparison,
    Condition,
    Constant,
    Entry,
    Expression,
    Junction,
    Not,
    Operation,
    Read,
    Repeat,
    Statement,
    When,
    read,
)
from scvi_codegen.methods.tables.nodes import to_number
from scvi_codegen.systems.formulas.symbols import C_KEYWORDS, IDENTIFIER

Letter: TypeAlias = tuple[str, int]
"""A kind of value, with the number of a force or a velocity: ``("F", 2)``."""
Sum: TypeAlias = Mapping[Letter, Mapping[int, Number]]
"""Coefficients by letter and power of h."""

UNIT, TIME, Q, P, MASS = (("1", 0), ("t", 0), ("q0", 0), ("p0", 0), ("inverse_mass", 0))
COMPARE: dict[str, Callable[[Number, Number], bool]] = {
    "!=": lambda x, y: bool(x != y),
    ">": lambda x, y: bool(x > y),
    "==": lambda x, y: bool(x == y),
}
GIVEN = ("q0", "p0", "h", "t", "inverse_mass")
"""Quantities of which statements have values at first."""
OF_C = C_KEYWORDS.union(
    """
    M L S i k e step data known acted dq dp number real lanes dd ddl force velocity NAN INFINITY NULL ALL CARRIES
    COMPARISON DECAY EACH HOT MATH NAME PARAMETER REAL SELDOM SPLITTING START STATUS TOLERANCE VANISHING WORDS
    """.split()  # noqa: SIM905  (as a paragraph)
)
"""Names that quantities, rows and tables of statements cannot have, since they have another meaning in C."""
TABLE = re.compile(r"[A-Z][A-Z_]{2,}", re.ASCII)

RowTables: TypeAlias = tuple[tuple[str, tuple[tuple[str, Vector], ...]], ...]


@dataclass(frozen=True, slots=True)
class StepTables:
    """Statements of a step, and its tables of numbers by their name, those of the same rows by the name of the rows."""

    statements: str
    tables: RowTables

    @property
    def numbers(self) -> dict[str, Vector]:
        """The tables by their names."""
        return {name: numbers for _, named in self.tables for name, numbers in named}

    @property
    def sizes(self) -> dict[str, int]:
        """Number of rows by their name."""
        return {rows: len(named[0][1]) for rows, named in self.tables}


@dataclass(frozen=True, slots=True)
class ExplicitStep(StepTables):
    """An explicit step as statements (:mod:`scvi_codegen.methods.statements`).

    With the state q0, p0 at the start, in one or two words, statements compute the increments q and p, which are 0 at
    first, from forces ``F[i] = force(u, t + c * h)`` and velocities ``v[i] = velocity(P, t)``, or ``inverse_mass[i]``
    where the feature ``masses`` holds. F is kept from step to step: ``known`` if it is that of the last one.

    Attributes:
        statements: their text.
        tables: numbers by their name, those of the same rows by the name of the rows.
    """

    __repr__ = summary("statements")

    @classmethod
    def of(cls, statements: str, tables: Mapping[str, Mapping[str, Sequence[Any]]]) -> ExplicitStep:
        """Return the step with tables of numbers, or of text with all of their digits.

        Raises:
            MethodError: for a line that is not a statement, names that are not those of tables, tables that are no
                lists of numbers, and of different lengths with the same rows.
        """
        check_kind(TEXT, statements, "statements", MethodError)
        of_rows = ArgumentType("a mapping from rows, as {'STAGES': {'KICK': [0.5, 0.5]}}", MAPPING.accepts)
        check_kind(of_rows, tables, "tables", MethodError)
        read(statements)
        names = [name for rows, named in tables.items() for name in (rows, *_checked_tables(rows, named))]
        if double := [name for name in names if names.count(name) > 1]:
            raise MethodError(f"'{double[0]}' is the name of two tables, or of a table and of rows: rename one")
        for rows, named in tables.items():
            if len({len(numbers) for numbers in named.values()}) != 1 or not all(named.values()):
                lengths = ", ".join(f"{len(numbers)} of {name}" for name, numbers in named.items()) or "none"
                raise MethodError(f"tables of the rows {rows} need the same number of numbers, not {lengths}")
        return cls(
            statements,
            tuple(
                (rows, tuple((name, tuple(map(to_number, numbers))) for name, numbers in named.items()))
                for rows, named in tables.items()
            ),
        )


def _checked_tables(rows: str, named: Any) -> Mapping[str, Sequence[Any]]:
    """Return the tables of some rows by their names, or raise :class:`MethodError` for what is none."""
    of_numbers = ArgumentType("tables by name, as {'KICK': [0.5, 0.5]}", MAPPING.accepts)
    check_kind(of_numbers, named, f"tables['{rows}']", MethodError)
    for name in (rows, *named):
        if not TABLE.fullmatch(name) or name in OF_C:
            why = "has another meaning in C" if name in OF_C else "is not the name of a table"
            raise MethodError(f"'{name}' {why}: write three capital letters or more, as in STAGES")
    for name, numbers in named.items():
        check_kind(NUMBERS, numbers, f"the table {name}", MethodError)
    return cast(Mapping[str, Sequence[Any]], named)


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Forces at a position and a time, or the velocity of a momentum (``time`` is that of the positions then).

    Attributes:
        argument: the position or the momentum.
        time: offset in units of h.
        row: of the tables that it belongs to.
    """

    argument: Sum
    time: Number
    row: int


@dataclass
class Recurrence:
    """Values of the quantities of a step, whose statements are carried out one after the other.

    Attributes:
        step: the statements.
        values: by the names of quantities.
        forces, velocities: evaluated so far.
        turns: whether rigid bodies turn in its drifts.
    """

    step: ExplicitStep
    values: dict[str, Sum] = field(default_factory=dict)
    rows: dict[str, int] = field(default_factory=dict)
    forces: list[Evaluation] = field(default_factory=list)
    velocities: list[Evaluation] = field(default_factory=list)
    turns: bool = False

    @classmethod
    def of(cls, step: ExplicitStep, statements: Sequence[Statement], *, masses: bool) -> Recurrence:
        """Return the values at the end of a step by its statements; MethodError unless these are such a recurrence."""
        letters = {"q0": Q, "p0": P, "t": TIME} | ({"inverse_mass": MASS} if masses else {})
        values: dict[str, Sum] = {name: {letter: {0: mp.one}} for name, letter in letters.items()}
        values |= {"h": {UNIT: {1: mp.one}}, "q": {}, "p": {}, "S": {}}
        recurrence = cls(step, values)
        recurrence.block(statements)
        return recurrence

    def block(self, statements: Sequence[Statement]) -> None:
        """Carry out statements."""
        for statement in statements:
            match statement:
                case Assign(target=target, value=value, operator=operator):
                    increment = self.value(value)
                    if operator:
                        increment = _sum(self.read(target.name), increment, mp.mpf(f"{operator}1"))
                    self.assign(target, increment)
                case Apply():
                    self.apply(statement)
                case Repeat():
                    self.repeat(statement)
                case When(condition=condition, body=body):
                    if self.holds(condition):
                        self.block(body)

    def repeat(self, statement: Repeat) -> None:
        """Carry out statements for the rows of tables."""
        row, count = statement.row, statement.count
        if count not in self.step.sizes:
            rows = ", ".join(self.step.sizes) or "there are none"
            raise MethodError(f"'for {row} in {count}' needs rows of tables: {rows}")
        if not _is_name(row):
            raise MethodError(f"'{row}' cannot count rows: it has another meaning there; write n")
        for n in range(self.step.sizes[count]):
            self.rows[row] = n
            self.block(statement.body)

    def apply(self, statement: Apply) -> None:
        """Carry out an operation."""
        match statement:
            case Apply(name="turn"):
                self.turns = True
            case Apply(name="velocity", argument=argument, target=Read() as target):
                self.assign(target, self.velocity(self.read(argument)))
            case Apply(name="force", argument=argument, target=Read() as target, time=time) if time:
                self.assign(target, {("F", self.force(argument, self.value(time))): {0: mp.one}})
            case Apply(name="at_rest", argument=argument, target=Read(name="L"), time=time) if time:
                self.values["L"] = {("L", self.force(argument, self.value(time))): {0: mp.one}}
            case _:
                operations = "F[i] = force(u, t), v[i] = velocity(P, t) and L = at_rest(u, t)"
                raise MethodError(f"'{statement.name}' is no operation of an explicit step; these are {operations}")

    def assign(self, target: Read, value: Sum) -> None:
        """Set the value of a quantity."""
        name = target.name
        if name == "S":
            self.values[name] = value
            return
        if name in (*GIVEN, *self.rows) or not _is_name(name):
            raise MethodError(f"'{name}' cannot be assigned in a step: it has another meaning there; rename it")
        if target.at != At("i"):
            raise MethodError(f"'{name}' has values for all coordinates i in an explicit step: write {name}[i] = ..")
        self.values[name] = value

    def read(self, name: str) -> Sum:
        """Return the value of a quantity; MethodError if it has none."""
        if name not in self.values:
            remedy = f"assign it before; values at first are those of {', '.join(self.values)}"
            if name == MASS[0]:
                remedy = "H = T(p) + V(q, t) has no constant masses: write v[i] = velocity(P, t)"
            raise MethodError(f"'{name}' has no value in a step: {remedy}")
        return self.values[name]

    def value(self, expression: Expression) -> Sum:
        """Return the value of an expression."""
        match expression:
            case Constant(text=text):
                return {UNIT: {0: mp.mpf(text)}}
            case Entry():
                return {UNIT: {0: self.number(expression)}}
            case Read(name=name, at=at):
                if at is not None and at != At("i"):
                    raise MethodError(f"'{name}' has no constraints in an explicit step: write {name}[i]")
                return self.read(name)
            case Operation("-", (operand,)):
                return _sum({}, self.value(operand), -mp.one)
            case Operation("+" | "-" as operator, (left, right)):
                return _sum(self.value(left), self.value(right), mp.mpf(f"{operator}1"))
            case Operation("*", (left, right)):
                return self.product(self.value(left), self.value(right))
            case Operation("/", (left, right)):
                divisor = self.value(right)
                if divisor.keys() != {UNIT} or divisor[UNIT].keys() != {0} or divisor[UNIT][0] == 0:
                    raise MethodError("statements of an explicit step divide by numbers other than 0 only")
                return _scaled(self.value(left), {0: 1 / divisor[UNIT][0]})
        raise MethodError(f"{expression} is not a value of an explicit step, which has no points and constraints")

    def number(self, entry: Expression) -> Number:
        """Return a number of a condition or of a table."""
        match entry:
            case Constant(text=text):
                return mp.mpf(text)
            case Read(name=name) if name in self.rows:
                return mp.mpf(self.rows[name])
            case Entry(table=table, row=row) if table in self.step.numbers and row in self.rows:
                numbers = self.step.numbers[table]
                if self.rows[row] < len(numbers):
                    return numbers[self.rows[row]]
        text = f"{entry.table}[{entry.row}]" if isinstance(entry, Entry) else getattr(entry, "name", "an expression")
        tables = ", ".join(self.step.numbers) or "there are none"
        raise MethodError(
            f"'{text}' is not a number of a table for its rows: write the row of the loop around; tables are {tables}"
        )

    def holds(self, condition: Condition) -> bool:
        """Return whether a condition holds; nothing is known of an earlier step."""
        match condition:
            case Comparison(left=left, operator=operator, right=right):
                return COMPARE[operator](self.number(left), self.number(right))
            case Not(flag="known"):
                return True
            case Junction(operator=operator, parts=parts):
                return (any if operator == "||" else all)(map(self.holds, parts))
        raise MethodError(f"'{condition.text}' is not a condition of an explicit step: its only flag is 'known'")

    def product(self, left: Sum, right: Sum) -> Sum:
        """Return a product: with a number, of the inverse mass and a momentum, or of a velocity and its momentum."""
        for factor, other in ((left, right), (right, left)):
            if not factor:
                return {}
            if factor.keys() == {UNIT}:
                return _scaled(other, factor[UNIT])
            if factor.keys() == {MASS}:
                return _scaled(self.velocity(other), factor[MASS])
            (letter, coefficient), *more = factor.items()
            if letter[0] == "V" and not more and self.velocities[letter[1]].argument == other:
                return {("T", letter[1]): {power: 2 * x for power, x in coefficient.items()}}
        raise MethodError("statements of an explicit step multiply by numbers, and momenta by inverse_mass[i]")

    def velocity(self, momentum: Sum) -> Sum:
        """Return M^-1 X for a sum X of momenta, or H_p at X."""
        if not momentum or any(letter[0] not in ("p0", "F") for letter in momentum):
            raise MethodError("a velocity is that of a sum of p0[i] and forces")
        lowest = min(power for coefficients in momentum.values() for power in coefficients)
        argument = _scaled(momentum, {-lowest: mp.one})
        if argument.get(P, {0: 0}).keys() != {0}:
            raise MethodError("a velocity is that of forces, or of p0[i] with the same factor as in the others")
        position = _sum(self.values["q0"], self.values["q"], mp.one)
        time = mp.fsum(x.get(1, 0) for letter, x in position.items() if letter[0] == "V")
        same = (k for k, other in enumerate(self.velocities) if other.argument == argument)
        k = next(same, len(self.velocities))
        if k == len(self.velocities):
            self.velocities.append(Evaluation(argument, time, self.row))
        return {("V", k): {lowest: mp.one}}

    def force(self, name: str, time: Sum) -> int:
        """Return the number of the force at a position and a time."""
        argument = self.read(name)
        others = [letter for letter in argument if letter[0] != "V"]
        if others != [Q] or argument[Q] != {0: mp.one}:
            raise MethodError(f"'{name}' is not a position: write {name}[i] = q0[i] + .. with velocities")
        offset = {letter: x for letter, x in time.items() if letter != TIME}
        if time.get(TIME) != {0: mp.one} or offset.keys() - {UNIT} or offset.get(UNIT, {1: 0}).keys() != {1}:
            raise MethodError("forces are evaluated at a time t + c * h")
        c = offset.get(UNIT, {1: mp.zero})[1]
        same = (n for n, other in enumerate(self.forces) if (other.argument, other.time) == (argument, c))
        n = next(same, len(self.forces))
        if n == len(self.forces):
            self.forces.append(Evaluation(argument, c, self.row))
        return n

    @property
    def row(self) -> int:
        """Row of the tables, of the outermost loop."""
        return next(iter(self.rows.values()), len(self.forces))


def _is_name(name: str) -> bool:
    """Return whether a quantity or a row may have a name, which is one in C, too, and not that of a table."""
    return bool(IDENTIFIER.fullmatch(name)) and name not in OF_C and not TABLE.fullmatch(name)


def _sum(left: Sum, right: Sum, sign: Number) -> Sum:
    """Return left + sign right without coefficients that are 0."""
    total: dict[Letter, dict[int, Number]] = {letter: dict(x) for letter, x in left.items()}
    for letter, coefficients in right.items():
        own = total.setdefault(letter, {})
        for power, x in coefficients.items():
            own[power] = own.get(power, mp.zero) + sign * x
    nonzero = {letter: {power: x for power, x in own.items() if x != 0} for letter, own in total.items()}
    return {letter: own for letter, own in nonzero.items() if own}


def _scaled(value: Sum, by: Mapping[int, Number]) -> Sum:
    """Return the product with a polynomial in h."""
    total: Sum = {}
    for power, factor in by.items():
        shifted = {letter: {power + k: factor * x for k, x in own.items()} for letter, own in value.items()}
        total = _sum(total, shifted, mp.one)
    return total
