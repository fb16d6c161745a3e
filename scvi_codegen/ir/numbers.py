"""Numbers of a program: exact, or known to 50 digits. What is printed is rounded by the target's scalar type, once."""

from __future__ import annotations

from fractions import Fraction
from typing import Any, TypeAlias

import sympy

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.tables.precision import DIGITS, Matrix, Vector, mp, settled

__all__ = ["Number", "NumberTable", "exact_number", "lower_matrix", "lower_vector"]

PROMISED = 50
"""Digits of a table: of the 60 that it is computed with, the last ones are rounding, so that what is 1 is 1."""

Number: TypeAlias = Any
"""A ``Fraction``, a number of many digits (``mpf``), or a ``float`` where no more digits are meant."""

NumberTable: TypeAlias = tuple[tuple[Number, ...], ...]


def lower_vector(numbers: Vector) -> tuple[Number, ...]:
    """Numbers of a table to the digits that are promised; what is 0 but for rounding is 0."""
    with mp.workdps(PROMISED):
        return tuple(settled(x) for x in numbers)


def lower_matrix(entries: Matrix) -> NumberTable:
    """The same for the rows of a table."""
    return tuple(lower_vector(line) for line in entries)


def exact_number(constant: sympy.Expr) -> Number:
    """The number that an expression without symbols is: a fraction, or 60 digits of it.

    Raises:
        SystemDefinitionError: if it is not a real number, or beyond the largest double.
    """
    if isinstance(constant, sympy.Rational):
        value: Number = Fraction(int(constant.p), int(constant.q))
    else:
        real, imaginary = constant.evalf(DIGITS).as_real_imag()
        if imaginary != 0 or not real.is_finite:
            raise SystemDefinitionError(f"the constant {constant} is not a finite real number")
        value = mp.make_mpf(sympy.Float(real, DIGITS)._mpf_)
    try:
        beyond = abs(float(value)) == float("inf")
    except OverflowError:
        beyond = True
    if beyond:
        raise SystemDefinitionError(f"the constant {constant} does not fit a double")
    return value
