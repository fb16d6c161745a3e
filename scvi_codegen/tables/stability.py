"""A-stability tests on polynomials with 60-digit coefficients: Routh's criterion and Sturm's theorem.

Coefficients below 1e-30 of their scale count as zero, so that exact zeros are recognised as such.
"""

from collections.abc import Iterable, Sequence
from itertools import pairwise, zip_longest
from typing import TypeAlias

from scvi_codegen.tables.basis import matrix_product
from scvi_codegen.tables.precision import DIGITS, Matrix, Number, mp

ZERO_TOLERANCE = mp.mpf("1e-30")

Polynomial: TypeAlias = list[Number]
"""Coefficients in ascending powers; the last is not zero, and the zero polynomial is empty."""


def determinant_polynomial(matrix: Matrix) -> Polynomial:
    """Return det(I - z M) in powers of z, by the Faddeev-LeVerrier recurrence with guard digits.

    Coefficient k is rounded to zero below 1e-30 of binomial(s, k) (2s - k)! / (2s)!, the natural scale: it is the
    coefficient of the Gauss method.
    """
    s = len(matrix)
    coefficients, power = [mp.one], matrix
    with mp.workdps(DIGITS + 20 + 2 * s):
        for k in range(1, s + 1):
            coefficients.append(-mp.fsum(power[i][i] for i in range(s)) / k)
            moved = [[power[i][j] + (coefficients[k] if i == j else 0) for j in range(s)] for i in range(s)]
            power = matrix_product(matrix, tuple(map(tuple, moved)))
        scales = [mp.binomial(s, k) * mp.factorial(2 * s - k) / mp.factorial(2 * s) for k in range(s + 1)]
    return trimmed(coefficients, scales)


def trimmed(coefficients: Iterable[Number], scales: Iterable[Number]) -> Polynomial:
    """Return the polynomial with coefficients below 1e-30 of their scales set to zero and trailing zeros dropped."""
    trimmed_values = [
        +value if abs(value) > ZERO_TOLERANCE * scale else mp.zero
        for value, scale in zip(coefficients, scales, strict=True)
    ]
    while trimmed_values and trimmed_values[-1] == 0:
        trimmed_values.pop()
    return trimmed_values


def divided(dividend: Polynomial, divisor: Polynomial) -> tuple[Polynomial, Polynomial]:
    """Return quotient and remainder; coefficients below 1e-30 of their scale are zero."""
    rest, quotient = list(dividend), [mp.zero] * max(0, len(dividend) - len(divisor) + 1)
    for k in reversed(range(len(quotient))):
        quotient[k] = rest.pop() / divisor[-1]
        for j, value in enumerate(divisor[:-1]):
            rest[k + j] -= quotient[k] * value
    scale = size(dividend) + size(quotient) * size(divisor)
    return trimmed(quotient, [size(quotient)] * len(quotient)), trimmed(rest, [scale] * len(rest))


def size(polynomial: Sequence[Number]) -> Number:
    """Return the largest coefficient in absolute value."""
    return max(map(abs, polynomial), default=mp.zero)


def scaled(polynomial: Polynomial) -> Polynomial:
    """Return the polynomial divided by its size, a positive number."""
    return [value / size(polynomial) for value in polynomial]


def common_factor(left: Polynomial, right: Polynomial) -> Polynomial:
    """Return a greatest common divisor, by Euclid's algorithm."""
    while right:
        left, right = right, divided(scaled(left), scaled(right))[1]
    return scaled(left)


def derivative(polynomial: Polynomial) -> Polynomial:
    """Return the derivative."""
    return [k * value for k, value in enumerate(polynomial)][1:]


def reduced(P: Sequence[Number], Q: Sequence[Number]) -> tuple[Polynomial, Polynomial]:
    """Return P and Q without common factors, in the variable z / rho that gives Q balanced coefficients."""
    rho = abs(Q[0] / Q[-1]) ** (mp.one / max(1, len(Q) - 1))
    numerator, denominator = ([value * rho**k for k, value in enumerate(polynomial)] for polynomial in (P, Q))
    factor = common_factor(denominator, numerator)
    return divided(numerator, factor)[0], divided(denominator, factor)[0]


def has_roots_right(polynomial: Polynomial) -> bool:
    """Return whether all roots have positive real parts: Routh's criterion on the polynomial of -z."""
    mirrored = [value if k % 2 == 0 else -value for k, value in enumerate(polynomial)]
    descending = [value / mirrored[-1] for value in reversed(mirrored)]
    upper, lower = descending[0::2], descending[1::2]
    while lower:
        if lower[0] <= ZERO_TOLERANCE * size(lower):
            return False
        ratio = upper[0] / lower[0]
        padded = [*lower[1:], mp.zero]
        upper, lower = lower, [a - ratio * b for a, b in zip(upper[1:], padded, strict=False)]
    return True


def squared_modulus(polynomial: Sequence[Number]) -> list[Number]:
    """Return |F(iy)|^2 in ascending powers of x = y^2: even(-x)^2 + x odd(-x)^2."""
    signed = [value if k % 4 < 2 else -value for k, value in enumerate(polynomial)]
    result = [mp.zero] * len(signed)
    for i, left in enumerate(signed):
        for j, right in enumerate(signed):
            if (i - j) % 2 == 0:
                result[(i + j) // 2] += left * right
    return result


def modulus_gap(Q: Polynomial, P: Polynomial) -> Polynomial:
    """Return |Q(iy)|^2 - |P(iy)|^2 in ascending powers of y^2, with round-off coefficients set to zero."""
    length = max(len(P), len(Q))
    padded = [[*polynomial, *[mp.zero] * (length - len(polynomial))] for polynomial in (Q, P)]
    gap = [left - right for left, right in zip(*map(squared_modulus, padded), strict=True)]
    scales = [mp.zero] * length
    for polynomial in padded:
        for i, left in enumerate(polynomial):
            for j, right in enumerate(polynomial):
                scales[(i + j) // 2] += abs(left * right)
    return trimmed(gap, scales)


def is_nonnegative(polynomial: Polynomial) -> bool:
    """Return whether the polynomial is nonnegative for x >= 0: positive at 0 and no root of odd multiplicity."""
    if all(value >= 0 for value in polynomial):
        return True
    lowest = next(k for k, value in enumerate(polynomial) if value != 0)
    rest = polynomial[lowest:]
    return bool(rest[0] > 0) and not any(map(positive_roots, odd_factors(rest)))


def odd_factors(polynomial: Polynomial) -> list[Polynomial]:
    """Return the square-free factors of odd multiplicity (Yun's algorithm)."""
    rate = derivative(polynomial)
    repeated = common_factor(polynomial, rate)
    rest, other = divided(polynomial, repeated)[0], divided(rate, repeated)[0]
    odd: list[Polynomial] = []
    for multiplicity in range(1, len(polynomial) + 1):
        if len(rest) <= 1:
            return odd
        pairs = list(zip_longest(other, derivative(rest), fillvalue=mp.zero))
        gap = trimmed([a - b for a, b in pairs], [abs(a) + abs(b) for a, b in pairs])
        factor = common_factor(rest, gap)
        if multiplicity % 2 == 1:
            odd.append(factor)
        rest, other = divided(rest, factor)[0], divided(gap, factor)[0]
    raise ArithmeticError("60 digits do not separate the roots of this polynomial")


def positive_roots(polynomial: Polynomial) -> int:
    """Return the number of distinct roots x > 0 (Sturm's theorem); 0 is no root."""
    chain = [scaled(polynomial), derivative(polynomial)]
    while chain[-1]:
        remainder = divided(scaled(chain[-2]), scaled(chain[-1]))[1]
        chain.append([-value for value in remainder])
    return sign_changes(p[0] for p in chain[:-1]) - sign_changes(p[-1] for p in chain[:-1])


def sign_changes(values: Iterable[Number]) -> int:
    """Return the number of sign changes, ignoring zeros."""
    return sum(1 for left, right in pairwise([value for value in values if value != 0]) if left * right < 0)
