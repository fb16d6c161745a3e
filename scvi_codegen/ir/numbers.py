"""Numbers of a program, exact or with 50 digits; they are rounded once, when printed, to the target's scalar type."""

from __future__ import annotations

from fractions import Fraction
from typing import Any, TypeAlias

import sympy

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.tables.precision import DIGITS, Matrix, Vector, mp, settled

TABLE_DIGITS = 50
"""Digits of a table; the last of the 60 that it is computed with are rounding errors, and a 1 has to be exactly 1."""

Number: TypeAlias = Any
"""A ``Fraction``, a multiprecision number (``mpf``), or a ``float`` if no more digits are intended."""

NumberTable: TypeAlias = tuple[tuple[Number, ...], ...]


def lower_vector(numbers: Vector) -> tuple[Number, ...]:
    """Return the numbers of a table to :data:`TABLE_DIGITS` digits; zeros except for rounding become 0."""
    with mp.workdps(TABLE_DIGITS):
        return tuple(settled(x) for x in numbers)


def lower_matrix(entries: Matrix) -> NumberTable:
    """Return the rows of a table to :data:`TABLE_DIGITS` digits."""
    return tuple(lower_vector(line) for line in entries)


def exact_number(constant: sympy.Expr) -> Number:
    """Return the value of an expression without symbols: a fraction, or 60 digits of it.

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
        raise SystemDefinitionError(
            f"the constant {constant} is outside the range of double precision: choose other units"
        )
    return value
