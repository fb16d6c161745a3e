"""Statements of a step: assignments between quantities with one index, as a textbook writes them.

An algorithm is a text in the syntax of Python, of which only the forms below are read; nothing is evaluated.

* ``f[i] = e``, ``f[i] += e``, ``f[i] -= e``: for all coordinates i; constraints are k, nonzero derivatives of
  constraints e, of which ``row(e)`` is the constraint and ``col(e)`` the coordinate. Points of the step are implicit.
* ``A @ x[i]`` is the sum over points j of A_nj x_j, ``former(x[i])`` the value at the point before.
* ``y[i] = mass(x[i])`` is M^-1 x, ``y[k] = solve(x[k])`` the solution of the factorised equations of the constraints,
  ``factorise(G)`` their factorisation.
* ``y[i] = kernel(x, t + c * h)`` evaluates the kernel of that name.
* ``for n in TABLE:`` repeats statements for the rows of tables; ``if condition:`` compares numbers of tables. A
  condition that is the name of a feature is decided when the text is read.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from scvi_codegen.common.errors import MethodError

COUNTS = {"i": "M", "k": "CONSTRAINTS", "e": "CONSTRAINT_ENTRIES"}
"""Number of values of each index, in C."""
GATHERS = {"row": "CONSTRAINT_ENTRY[{}][0]", "col": "CONSTRAINT_ENTRY[{}][1]", "pos": "CONSTRAINT_POSITION[{}]"}
"""Indices that tables of the constraints map an index to."""


@dataclass(frozen=True, slots=True)
class At:
    """Index of a quantity: its letter, and the names of the tables that it is mapped by, the last one first."""

    letter: str
    gathers: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """The index in C."""
        text = self.letter
        for name in reversed(self.gathers):
            text = GATHERS[name].format(text)
        return text


@dataclass(frozen=True, slots=True)
class Constant:
    """A number as it is written in the text."""

    text: str


@dataclass(frozen=True, slots=True)
class Read:
    """Value of a quantity; without an index of a number, which is the same for all coordinates."""

    name: str
    at: At | None = None


@dataclass(frozen=True, slots=True)
class Former:
    """Value of a quantity at the point before."""

    value: Read


@dataclass(frozen=True, slots=True)
class OverPoints:
    """Sum over the points with a row of a table."""

    table: str
    value: Read


@dataclass(frozen=True, slots=True)
class Entry:
    """Number of a table for the row n of a loop over rows."""

    table: str
    row: str


@dataclass(frozen=True, slots=True)
class Operation:
    """Sum, difference, product or quotient; ``-`` of one operand, or ``word``, the high word of one."""

    operator: str
    operands: tuple[Expression, ...]


Expression: TypeAlias = Constant | Read | Former | OverPoints | Entry | Operation


@dataclass(frozen=True, slots=True)
class Assign:
    """``target = value`` or, with the operators + and -, ``target += value`` and ``target -= value``."""

    target: Read
    value: Expression
    operator: str = ""


@dataclass(frozen=True, slots=True)
class Apply:
    """An operation on all values of a quantity: ``mass``, ``solve``, ``factorise``, ``invert``, or a kernel.

    Attributes:
        name: of the operation.
        argument: quantity that it is applied to.
        target: quantity that it computes; ``None`` for a factorisation.
        time: at which a kernel is evaluated; ``None`` for other operations.
    """

    name: str
    argument: str
    target: Read | None
    time: Expression | None = None


@dataclass(frozen=True, slots=True)
class Repeat:
    """Statements for the rows n = 0, .., count - 1 of tables."""

    row: str
    count: str
    body: tuple[Statement, ...]


@dataclass(frozen=True, slots=True)
class When:
    """Statements under a condition, in C."""

    condition: str
    body: tuple[Statement, ...]


Statement: TypeAlias = Assign | Apply | Repeat | When

OPERATORS: dict[type[ast.operator], str] = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}
OF_CONSTRAINTS = ("mass", "solve", "factorise", "invert")
COMPARISONS: dict[type[ast.cmpop], str] = {ast.NotEq: "!=", ast.Gt: ">", ast.Eq: "=="}


def read(text: str, features: Sequence[str] = ()) -> tuple[Statement, ...]:
    """Return the statements of a text.

    Args:
        text: in the syntax of the module.
        features: names that hold; a condition that is another name, without numbers, does not hold.

    Raises:
        MethodError: for a line of another form.
    """
    return tuple(_Reader(frozenset(features)).block(ast.parse(text).body))


@dataclass(frozen=True)
class _Reader:
    features: frozenset[str]

    def block(self, nodes: Sequence[ast.stmt]) -> Iterator[Statement]:
        for node in nodes:
            yield from self.statement(node)

    def statement(self, node: ast.stmt) -> Iterator[Statement]:
        match node:
            case ast.For(target=ast.Name(row), iter=ast.Name(count), body=body):
                yield Repeat(row, count, tuple(self.block(body)))
            case ast.If(test=ast.Name(feature), body=body, orelse=otherwise):
                yield from self.block(body if feature in self.features else otherwise)
            case ast.If(test=test, body=body, orelse=[]):
                yield When(self.condition(test), tuple(self.block(body)))
            case ast.Expr(value=ast.Call(func=ast.Name(name), args=[ast.Name(argument)])):
                yield Apply(name, argument, None)
            case ast.Assign(targets=[target], value=ast.Call(func=ast.Name(name), args=[argument, *time])) if (
                name in OF_CONSTRAINTS or time
            ):
                whole = argument.value if isinstance(argument, ast.Subscript) else argument
                assert isinstance(whole, ast.Name)
                at = self.expression(time[0]) if time else None
                yield Apply(name, whole.id, self.quantity(target), at)
            case ast.Assign(targets=[target], value=value):
                yield Assign(self.quantity(target), self.expression(value))
            case ast.AugAssign(target=target, op=operator, value=value):
                yield Assign(self.quantity(target), self.expression(value), OPERATORS[type(operator)])
            case _:
                raise MethodError(f"'{ast.unparse(node)}' is not a statement of a step")

    def condition(self, node: ast.expr) -> str:
        match node:
            case ast.BoolOp(op=operator, values=values):
                word = " || " if isinstance(operator, ast.Or) else " && "
                return word.join(map(self.condition, values))
            case ast.UnaryOp(op=ast.Not(), operand=ast.Name(name)):
                return f"!{name}"
            case ast.Compare(left=left, ops=[operator], comparators=[right]):
                return f"{ast.unparse(left)} {COMPARISONS[type(operator)]} {ast.unparse(right)}"
        raise MethodError(f"'{ast.unparse(node)}' is not a condition of a step")

    def expression(self, node: ast.expr) -> Expression:
        match node:
            case ast.Constant(value=value):
                return Constant(repr(value))
            case ast.BinOp(op=ast.MatMult(), left=ast.Name(table), right=right):
                return OverPoints(table, self.quantity(right))
            case ast.BinOp(left=left, op=operator, right=right):
                return Operation(OPERATORS[type(operator)], (self.expression(left), self.expression(right)))
            case ast.UnaryOp(op=ast.USub(), operand=operand):
                return Operation("-", (self.expression(operand),))
            case ast.Call(func=ast.Name("former"), args=[argument]):
                return Former(self.quantity(argument))
            case ast.Call(func=ast.Name("word"), args=[argument]):
                return Operation("word", (self.expression(argument),))
            case ast.Subscript(value=ast.Name(name), slice=ast.Name(row)) if row not in COUNTS:
                return Entry(name, row)
        return self.quantity(node)

    def quantity(self, node: ast.expr) -> Read:
        match node:
            case ast.Name(name):
                return Read(name)
            case ast.Subscript(value=ast.Name(name), slice=index):
                return Read(name, self.index(index))
        raise MethodError(f"'{ast.unparse(node)}' is not a quantity of a step: write one with an index, as q[i]")

    def index(self, node: ast.expr) -> At:
        match node:
            case ast.Name(letter) if letter in COUNTS:
                return At(letter)
            case ast.Call(func=ast.Name(name), args=[argument]) if name in GATHERS:
                inner = self.index(argument)
                return At(inner.letter, (name, *inner.gathers))
        raise MethodError(f"'{ast.unparse(node)}' is not an index: write one of {', '.join(COUNTS)}, or row(e)")
