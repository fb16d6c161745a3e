"""Statements of a step: assignments between quantities with one index, as a textbook writes them.

An algorithm is a text in the syntax of Python, of which only the forms below are read; nothing is evaluated.

* ``f[i] = e``, ``f[i] += e``, ``f[i] -= e``: for all coordinates i; constraints are k, nonzero derivatives of
  constraints e, of which ``row(e)`` is the constraint and ``col(e)`` the coordinate. Points of the step are implicit.
* ``A @ x[i]`` is the sum over points j of A_nj x_j, ``former(x[i])`` the value at the point before.
* ``y[i] = mass(x[i])`` is M^-1 x, ``y[k] = solve(x[k])`` the solution of the factorised equations of the constraints,
  ``factorise(G)`` their factorisation.
* ``y[i] = modes(x[i])``, ``rotated`` and ``momenta`` are V x, U^T x and W x with the matrices of a heat bath.
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
    """An operation on all values of a quantity: a product or solution, ``factorise``, ``invert``, or a kernel.

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
class Comparison:
    """Comparison of numbers of tables and rows."""

    left: Expression
    operator: str
    right: Expression

    @property
    def text(self) -> str:
        """The comparison in C."""
        return f"{_number_text(self.left)} {self.operator} {_number_text(self.right)}"


@dataclass(frozen=True, slots=True)
class Not:
    """True if a flag of the step does not hold."""

    flag: str

    @property
    def text(self) -> str:
        """The condition in C."""
        return f"!{self.flag}"


@dataclass(frozen=True, slots=True)
class Junction:
    """Conditions of which one must hold, or all (``&&``)."""

    operator: str
    parts: tuple[Condition, ...]

    @property
    def text(self) -> str:
        """The condition in C."""
        return f" {self.operator} ".join(part.text for part in self.parts)


Condition: TypeAlias = Comparison | Not | Junction


@dataclass(frozen=True, slots=True)
class When:
    """Statements under a condition."""

    condition: Condition
    body: tuple[Statement, ...]


Statement: TypeAlias = Assign | Apply | Repeat | When

OPERATORS: dict[type[ast.operator], str] = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/"}
LINEAR = ("mass", "solve", "modes", "rotated", "momenta")
COMPARISONS: dict[type[ast.cmpop], str] = {ast.NotEq: "!=", ast.Gt: ">", ast.Eq: "=="}
FORMS = (
    "statements are x[i] = .., x[i] += .., x[i] -= .., x[i] = kernel(y, t), 'for n in ROWS:' and 'if condition:', "
    "of sums, differences, products and quotients"
)


def read(text: str, features: Sequence[str] = ()) -> tuple[Statement, ...]:
    """Return the statements of a text; conditions on names other than ``features`` do not hold. Raises MethodError."""
    return tuple(_Reader(frozenset(features)).block(_parsed(text).body))


def selected(text: str, features: Sequence[str]) -> str:
    """Return a text without conditions on features, of which some hold; MethodError for lines that are not Python."""
    return ast.unparse(_Selection(frozenset(features)).visit(_parsed(text)))


def _parsed(text: str) -> ast.Module:
    try:
        return ast.parse(text)
    except SyntaxError as failure:
        where = f"line {failure.lineno} of a step: '{(failure.text or '').strip()}'"
        raise MethodError(f"{where} is no statement ({failure.msg}): {FORMS}") from None


def _refused(node: ast.AST, of: str) -> MethodError:
    return MethodError(f"line {getattr(node, 'lineno', 0)} of a step: '{ast.unparse(node)}' is {of}")


@dataclass(frozen=True)
class _Selection(ast.NodeTransformer):
    features: frozenset[str]

    def visit_If(self, node: ast.If) -> ast.AST | list[ast.AST]:
        """Return the statements that hold in place of a condition on a feature."""
        if not isinstance(node.test, ast.Name):
            return self.generic_visit(node)
        held = node.body if node.test.id in self.features else node.orelse
        return [line for statement in held for line in self._listed(self.visit(statement))]

    @staticmethod
    def _listed(visited: ast.AST | list[ast.AST]) -> list[ast.AST]:
        return visited if isinstance(visited, list) else [visited]


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
                name in LINEAR or time
            ):
                whole = argument.value if isinstance(argument, ast.Subscript) else argument
                if not isinstance(whole, ast.Name):
                    raise _refused(argument, f"not a quantity: assign it first, as u[i] = .., and write {name}(u)")
                at = self.expression(time[0]) if time else None
                yield Apply(name, whole.id, self.quantity(target), at)
            case ast.Assign(targets=[target], value=value):
                yield Assign(self.quantity(target), self.expression(value))
            case ast.AugAssign(target=target, op=ast.Add() | ast.Sub() as operator, value=value):
                yield Assign(self.quantity(target), self.expression(value), OPERATORS[type(operator)])
            case _:
                raise _refused(node, f"no statement: {FORMS}")

    def condition(self, node: ast.expr) -> Condition:
        match node:
            case ast.BoolOp(op=operator, values=values):
                return Junction("||" if isinstance(operator, ast.Or) else "&&", tuple(map(self.condition, values)))
            case ast.UnaryOp(op=ast.Not(), operand=ast.Name(name)):
                return Not(name)
            case ast.Compare(left=left, ops=[operator], comparators=[right]) if type(operator) in COMPARISONS:
                return Comparison(self.expression(left), COMPARISONS[type(operator)], self.expression(right))
        raise _refused(node, f"no condition: compare two numbers by {', '.join(COMPARISONS.values())}")

    def expression(self, node: ast.expr) -> Expression:
        match node:
            case ast.Constant(value=int() | float() as value) if not isinstance(value, bool):
                if isinstance(value, float) and not _is_exact(value):
                    raise _refused(node, "not exact in binary: put the number into a table")
                return Constant(repr(value))
            case ast.BinOp(op=ast.MatMult(), left=ast.Name(table), right=right):
                return OverPoints(table, self.quantity(right))
            case ast.BinOp(left=ast.Constant(), op=ast.Div(), right=ast.Constant()):
                raise _refused(node, "a quotient of numbers: divide a quantity, as h / 2, or put it into a table")
            case ast.BinOp(left=left, op=operator, right=right) if type(operator) in OPERATORS:
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
        raise _refused(node, "not a quantity: write one with an index, as q[i], and sums and products of these")

    def index(self, node: ast.expr) -> At:
        match node:
            case ast.Name(letter) if letter in COUNTS:
                return At(letter)
            case ast.Call(func=ast.Name(name), args=[argument]) if name in GATHERS:
                inner = self.index(argument)
                return At(inner.letter, (name, *inner.gathers))
        raise _refused(node, f"not an index: write one of {', '.join(COUNTS)}, or row(e)")


def _is_exact(value: float) -> bool:
    """Return whether a decimal number is a multiple of 2^-20, as it is read."""
    return (value * 2**20).is_integer()


def _number_text(expression: Expression) -> str:
    """Return a number of a condition in C."""
    match expression:
        case Constant(text=text) | Read(name=text):
            return text
        case Entry(table=table, row=row):
            return f"{table}[{row}]"
    raise MethodError(f"{expression} is not a number of a table or a row, which conditions compare")
