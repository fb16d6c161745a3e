"""Kind of constraint: its notation and its conditions on positions and velocities, from which all else is derived."""

from collections.abc import Callable, Sequence, Set
from dataclasses import dataclass
from typing import Protocol

from sympy import Expr, S, Symbol


class Constrained(Protocol):
    """System with constraints."""

    @property
    def coordinates(self) -> tuple[Symbol, ...]:
        """Symbols of the m coordinates."""

    @property
    def velocities(self) -> tuple[Symbol, ...]:
        """Symbols of the m velocities."""

    @property
    def time(self) -> Symbol:
        """Symbol of time."""

    @property
    def constraints(self) -> tuple[Expr, ...]:
        """Expressions that are 0."""

    @property
    def reactions(self) -> tuple["Reaction", ...]:
        """Masks and directions of force of the last constraints; all others are ideal and always imposed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Reaction:
    """Mask and direction of force of a constraint that is imposed in some modes only, as of contacts.

    The equation of the constraint g with the multiplier lambda is ``active * g + (1 - active) * lambda = 0``, and its
    force is ``direction * lambda``: oblique, (G - mu d T)^T lambda, of a contact that slides in the direction d.

    Attributes:
        active: mask, 0 or 1, a formula of parameters.
        direction: m components of the force per multiplier, in (q, v, t).
    """

    active: Expr
    direction: tuple[Expr, ...]


def difference(sides: Sequence[Expr], _rate: Callable[[Expr], Expr]) -> Expr:
    """Return left - right of an equation, or the expression that is 0."""
    left, *right = sides
    return left - right[0] if right else left


def no_condition(_expression: Expr) -> Expr:
    """Return 0: no condition on positions, or none on velocities."""
    return S.Zero


@dataclass(frozen=True, slots=True, kw_only=True)
class ConstraintKind:
    """Kind of constraint.

    Constraints of all kinds are ideal: forces G^T lambda, where G is the derivative of the rates with respect to
    velocities, do no virtual work. Stage equations, projection, multipliers and certificates follow from
    ``position`` and ``velocity``; constraints with conditions on velocities only are not symplectic and require
    polynomial curves.

    Attributes:
        form: equation in general form, for messages.
        applies: whether the expression of a constraint, with the symbols of velocities, is of this kind.
        position: g(q, t) of an expression, which is 0 at the quadrature points, or 0.
        velocity: A(q, t) v + b(q, t) of an expression, which is 0 at Gauss points and at the end of a step, or 0.
        function: name of the function in its notation, ``function(f) = b``; empty for plain equations.
        expression: expression of the constraint from its sides, f and b, and from a function that returns df/dt.
    """

    form: str
    applies: Callable[[Expr, Set[Symbol]], bool]
    position: Callable[[Expr], Expr] = no_condition
    velocity: Callable[[Expr], Expr] = no_condition
    function: str = ""
    expression: Callable[[Sequence[Expr], Callable[[Expr], Expr]], Expr] = difference


HOLONOMIC = ConstraintKind(
    form="g(q, t) = 0",
    applies=lambda expression, velocities: not expression.free_symbols & velocities,
    position=lambda expression: expression,
)
NONHOLONOMIC = ConstraintKind(
    form="A(q, t) v + b(q, t) = 0",
    applies=lambda expression, velocities: bool(expression.free_symbols & velocities),
    velocity=lambda expression: expression,
)
