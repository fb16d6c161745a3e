"""Functions of formulas that are not smooth, all made of ``unit_step`` and ``rint``, whose derivatives are 0.

    positive_part(u) = u s(u)       abs(u) = u (2 s(u) - 1)       sign(u) = 2 s(u) - 1
    max(a, b) = a s(a - b) + b (1 - s(a - b))                     min(a, b) = b s(a - b) + a (1 - s(a - b))
    where(a > b, f, g) = c f + (1 - c) g                          c = 1 - s(b - a); s(a - b) of a >= b

s is the unit step, 1 at 0, so ``sign(0)`` is 1. Each s(u) has the switching function u; s(u), s(2*u) and s(-u) have the
same. SymPy's functions of these names become these. Both values of ``where`` are computed, so both must be defined.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache, reduce
from typing import Any

import sympy
from sympy import Expr, Function, Mul, S
from sympy.core.relational import Relational
from sympy.logic.boolalg import Boolean

from scvi_codegen.common.errors import SystemDefinitionError


def _call(printer: Any, name: str, *arguments: Any) -> str:
    """Return a call of a function of NumPy or mpmath, for printers of :func:`sympy.lambdify`."""
    return f"{printer._module_format(name)}({', '.join(map(printer._print, arguments))})"


class rint(Function):  # type: ignore[misc]  # noqa: N801  (a function of formulas, like sympy.sin)
    """Nearest whole number, of two the even one; its derivative is 0."""

    is_real = True

    @classmethod
    def eval(cls, x: Expr) -> Expr | None:
        """Return the value at a number."""
        return sympy.Integer(round(x.evalf(50))) if x.is_number and x.is_finite and x.is_real else None

    def fdiff(self, argindex: int = 1) -> Expr:
        """Return 0."""
        return S.Zero

    def _numpycode(self, printer: Any) -> str:
        return _call(printer, "numpy.rint", *self.args)

    _scipycode = _numpycode

    def _mpmathcode(self, printer: Any) -> str:
        return _call(printer, "mpmath.nint", *self.args)


class unit_step(Function):  # type: ignore[misc]  # noqa: N801
    """1 where the argument is positive, 0 where it is negative; its derivative is 0."""

    is_real = True

    @classmethod
    def eval(cls, x: Expr) -> Expr | None:
        """Return the value at a number, 1 at 0."""
        return sympy.Integer(int(bool(x.evalf(50) >= 0))) if x.is_number and x.is_finite and x.is_real else None

    def _eval_power(self, exponent: Expr) -> Expr | None:
        if exponent.is_positive:
            return self
        return 1 / self if exponent.is_negative and exponent != -1 else None

    def fdiff(self, argindex: int = 1) -> Expr:
        """Return 0."""
        return S.Zero

    def _numpycode(self, printer: Any) -> str:
        return _call(printer, "numpy.heaviside", *self.args, S.One)

    _scipycode = _numpycode

    def _mpmathcode(self, printer: Any) -> str:
        return f"({_call(printer, 'mpmath.sign', *self.args)} >= 0)"


class Mode(sympy.Symbol):  # type: ignore[misc]
    """Mode in unit_step(u + mode): 0, or beyond all values of u (:mod:`scvi_codegen.systems.kinks`)."""


ODD_INCREASING = (sympy.sinh, sympy.asinh, sympy.tanh, sympy.atan)
"""Functions with the zero and the sign of their argument."""


@lru_cache(maxsize=4096)
def switching_function(u: Expr) -> tuple[Expr, int]:
    """Return a switching function without constant factor, and the sign 1 or -1 of the factor that was left out.

    Odd powers and odd increasing functions of u have the zeros and signs of u.

    >>> from sympy.abc import x
    >>> switching_function(2 - 2 * x), switching_function(sympy.pi * x**3), switching_function(sympy.tanh(x))
    ((x - 1, -1), (x, 1), (x, 1))
    """
    sign, factors = 1, []
    for factor in Mul.make_args(u.primitive()[1]):
        if factor.is_positive and factor.is_number:
            continue
        if isinstance(factor, ODD_INCREASING) or (factor.is_Pow and factor.exp.is_odd and factor.exp.is_positive):
            argument, orientation = switching_function(factor.args[0])
            sign *= orientation
            factors.append(argument)
            continue
        if factor.is_number and factor.is_negative:
            sign = -sign
        elif factor.is_Add and factor.could_extract_minus_sign():
            sign = -sign
            factors.append(-factor.primitive()[1])
        else:
            factors.append(factor.primitive()[1])
    return Mul(*factors), sign


def steps_on_sides(steps: Iterable[Expr], modes: Mapping[Expr, Expr]) -> dict[Expr, Expr]:
    """Return unit_step(u + mode) of the steps unit_step(u) whose switching functions have a mode, on one side of u."""
    functions = [(step, *switching_function(step.args[0])) for step in steps]
    return {step: unit_step(step.args[0] + sign * modes[u]) for step, u, sign in functions if u in modes}


def without_modes(formula: Expr) -> Expr:
    """Return a formula with unit_step(u) in place of unit_step(u + mode)."""
    return formula.xreplace(dict.fromkeys(formula.atoms(Mode), sympy.Integer(0)))


def by_parity(x: Expr) -> Expr:
    """Return rint(x) by one switching function, cos(pi x), with formulas that go on for half a unit beyond its zeros.

    >>> by_parity(sympy.Symbol("x")).subs("x", sympy.Rational(12, 5))
    2
    """
    return where(unit_step(sympy.cos(sympy.pi * x)), 2 * rint(x / 2), 2 * rint((x - 1) / 2) + 1)


def wrap(x: Expr, length: Expr) -> Expr:
    """Return x - L rint(x / L), the number of smallest size that differs from x by a multiple of L."""
    return x - length * rint(x / length)


def positive_part(x: Expr) -> Expr:
    """Return x where it is positive, else 0."""
    return x * unit_step(x)


def absolute(u: Expr) -> Expr:
    """Return u where it is positive, else -u."""
    if u.is_nonnegative:
        return u
    size = -u if u.could_extract_minus_sign() else u
    return size * sign(size)


def sign(u: Expr) -> Expr:
    """Return 1 where u is positive or 0, else -1."""
    return 2 * unit_step(u) - 1


def maximum(*values: Expr) -> Expr:
    """Return the largest value."""
    return _selected(values, lambda holds, a, b: where(holds, a, b))


def minimum(*values: Expr) -> Expr:
    """Return the smallest value."""
    return _selected(values, lambda holds, a, b: where(holds, b, a))


def _selected(values: Sequence[Expr], choice: Callable[[Expr, Expr, Expr], Expr]) -> Expr:
    """Return a choice of the values by comparisons a >= b in pairs, then of those of the pairs, until one is left.

    A comparison has the same switching function in either order of its values.
    """
    if len(values) == 1:
        return values[0]
    half = len(values) // 2
    a, b = _selected(values[:half], choice), _selected(values[half:], choice)
    if (a - b).could_extract_minus_sign():
        a, b = b, a
    return choice(unit_step(a - b), a, b)


def where(condition: Expr | Boolean, value: Expr, other: Expr) -> Expr:
    """Return a value where a condition holds, another one elsewhere; also of a number 1 or 0 as condition."""
    holds = _indicator(condition) if isinstance(condition, Boolean) else condition
    return holds * value + (1 - holds) * other


def comparison(left: Expr, relation: str, right: Expr) -> Expr:
    """Return 1 where a comparison by ``<``, ``<=``, ``>`` or ``>=`` holds, else 0."""
    lesser, greater = (left, right) if "<" in relation else (right, left)
    return unit_step(greater - lesser) if "=" in relation else 1 - unit_step(lesser - greater)


def _indicator(condition: Boolean) -> Expr:
    """Return 1 where a condition of SymPy holds, else 0."""
    if condition in (S.true, S.false):
        return sympy.Integer(condition == S.true)
    if isinstance(condition, sympy.Not):
        return 1 - _indicator(condition.args[0])
    if isinstance(condition, sympy.And):
        return Mul(*map(_indicator, condition.args))
    if isinstance(condition, sympy.Or):
        return 1 - Mul(*(1 - _indicator(part) for part in condition.args))
    if isinstance(condition, Relational) and condition.rel_op not in ("==", "!="):
        return comparison(condition.lhs, condition.rel_op, condition.rhs)
    raise SystemDefinitionError(
        f"the condition '{condition}' of a Piecewise is not supported: use <, <=, > or >=, joined by And, Or and Not"
    )


def _piecewise(*pieces: tuple[Expr, Boolean]) -> Expr:
    """Return a piecewise function of SymPy, of which the first piece whose condition holds applies."""
    defined = sympy.Or(*(condition for _, condition in pieces))
    if defined != S.true:
        raise SystemDefinitionError(
            f"a Piecewise is undefined unless '{defined}': add a last piece with the condition True"
        )
    return reduce(lambda rest, piece: where(piece[1], piece[0], rest), reversed(pieces[:-1]), pieces[-1][0])


OF_SYMPY: Mapping[type, Callable[..., Expr]] = {
    sympy.Abs: absolute,
    sympy.sign: sign,
    sympy.Max: maximum,
    sympy.Min: minimum,
    sympy.Heaviside: lambda u, _: unit_step(u),
    sympy.Piecewise: _piecewise,
}
"""Functions of SymPy that are not smooth; where they jump, they have the values of the functions above."""
