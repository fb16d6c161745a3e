"""One step of the derived equations in 60 digits: errors of high order, free of round-off.

It shares with the compiled code what the method is and nothing of how it is solved: the closed form of
:func:`~scvi_codegen.equations.derive`, its symbolic Jacobian, Newton's iteration, elimination with pivots.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import sympy

from scvi_codegen.equations import derive
from scvi_codegen.errors import StateError
from scvi_codegen.methods.method import Method
from scvi_codegen.precision import DIGITS, Number, Vector, mp
from scvi_codegen.system import LagrangianSystem

__all__ = ["DerivedStep", "SolvedStep", "derived_step"]

MOST_ITERATIONS = 50
FUNCTIONS = ("mpf", "sqrt", "sin", "cos", "tan", "exp", "log", "sinh", "cosh", "tanh")


@dataclass(frozen=True, slots=True, kw_only=True)
class SolvedStep:
    """The unknowns of a step, in the order of the derivation, and the state at its end."""

    unknowns: Vector
    q: Vector
    p: Vector


class DerivedStep:
    """The equations of a step as functions of numbers; parameters have their default values."""

    def __init__(self, system: LagrangianSystem, method: Method) -> None:
        derived = derive(system, method)
        values = {entry.symbol: sympy.Float(str(entry.value), DIGITS) for entry in derived.entries}
        values |= {name: sympy.Rational(value) for name, value in zip(system.parameters, system.defaults, strict=True)}
        known = [*derived.state[0], *derived.state[1], derived.step, derived.time]
        names = {name: getattr(mp, name) for name in FUNCTIONS}

        def function(arguments: Sequence[Any], expressions: Iterable[sympy.Expr]) -> Any:
            filled = [expression.xreplace(values) for expression in expressions]
            return sympy.lambdify(arguments, filled, modules=[names, "mpmath"])

        solving = [derived.unknowns, *known]
        self.residuals = function(solving, (equation.residual for equation in derived.equations))
        self.jacobian = function(solving, derived.jacobian)
        self.end = function(solving, (end.residual for end in (*derived.end_position, *derived.end_momentum)))
        self.guess = function(known, (_at_rest(derived.initial_guess[unknown], known) for unknown in derived.unknowns))
        self.dimension = system.dimension

    def __call__(self, q: Sequence[Any], p: Sequence[Any], h: Any, t: Any = 0) -> SolvedStep:
        """The step from (q, p) at t to t + h; numbers are taken as they are given, so 0.1 is the double.

        Raises:
            StateError: if Newton's iteration does not converge.
        """
        known = [mp.mpf(number) for number in (*q, *p, h, t)]
        unknowns = [mp.mpf(value) for value in self.guess(*known)]
        for _ in range(MOST_ITERATIONS):
            change = self._newton(unknowns, known)
            unknowns = [value - delta for value, delta in zip(unknowns, change, strict=True)]
            if max(map(abs, change)) <= mp.eps**0.75 * max(1, *map(abs, unknowns)):
                end = [mp.mpf(value) for value in self.end(unknowns, *known)]
                return SolvedStep(
                    unknowns=tuple(unknowns), q=tuple(end[: self.dimension]), p=tuple(end[self.dimension :])
                )
        raise StateError(f"the derived equations were not solved in {MOST_ITERATIONS} iterations with h = {float(h):g}")

    def _newton(self, unknowns: list[Number], known: list[Number]) -> list[Number]:
        size = len(unknowns)
        entries = self.jacobian(unknowns, *known)
        matrix = mp.matrix([[entries[row * size + column] for column in range(size)] for row in range(size)])
        return list(mp.lu_solve(matrix, mp.matrix(self.residuals(unknowns, *known))))


def _at_rest(guess: sympy.Expr, known: Sequence[sympy.Symbol]) -> sympy.Expr:
    """A first guess with the velocity, its only other symbol, at zero."""
    return guess.xreplace(dict.fromkeys(guess.free_symbols - set(known), sympy.S.Zero))


@lru_cache(maxsize=64)
def derived_step(system: LagrangianSystem, method: Method) -> DerivedStep:
    """The equations of a method for a system, derived once a process."""
    return DerivedStep(system, method)
