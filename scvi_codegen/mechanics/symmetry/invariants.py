"""Conserved polynomials in q, p and t, found by linear algebra.

A polynomial J = sum_c x_c phi_c(q, p, t) is conserved if sum_c x_c dphi_c/dt is zero on all trajectories, that is, at
all points (:mod:`scvi_codegen.mechanics.symmetry.sampling`): x spans the null space of the matrix of rates at enough
random points, in binary64. Its reduced row echelon form is sparse. Its entries depend on the parameters; they are
recognised as rational numbers times powers of parameters, and of sums of parameters that occur in the system, from
their values at random parameters. A result is accepted if its rate is zero to 40 digits at random points and
parameters.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, TypeAlias

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Expr, Symbol

from scvi_codegen.formulas.expressions import gradient, parts
from scvi_codegen.formulas.numpy_values import array_value
from scvi_codegen.mechanics.derived_expressions import forms_of
from scvi_codegen.mechanics.symmetry.sampling import Rates, Sample, drawn_parameters
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.tables.precision import mp

Array = NDArray[np.float64]

NULL = 1e-9
"""Singular values below this bound are 0, for a matrix with entries of size 1."""
ROUNDING = 1e-11
"""Rates below this bound, relative to the largest, are 0."""
PIVOT = 1e-6
ZERO = 1e-8
RECOGNISED = 1e-7
LARGEST_INTEGER = 1000
HIGHEST_POWER = 16
"""Highest power of a parameter in a coefficient; larger exponents of the logarithmic fit are rejected."""
AT_ONCE = 4096
"""Number of points evaluated together, which bounds memory: so many numbers are stored per subexpression."""
MORE_POINTS = 12
"""Number of sampled points in excess of the number of columns."""
MORE_PARAMETERS = 4
"""Number of sampled parameter values in excess of the number of factors of a coefficient."""
NEGLIGIBLE = mp.mpf(10) ** -40


@dataclass(frozen=True, slots=True)
class Monomial:
    """Monomial t^power times the product of entries of the state (q, p), by index."""

    power: int
    factors: tuple[int, ...]

    def rate(self, sample: Sample) -> Any:
        """Return the time derivative of the monomial at sampled points."""
        t, total = sample.t, 0.0 * sample.t
        if self.power:
            total = total + self.power * t ** (self.power - 1) * math.prod(sample.state[i] for i in self.factors)
        for k, i in enumerate(self.factors):
            others = math.prod(sample.state[j] for j in (*self.factors[:k], *self.factors[k + 1 :]))
            total = total + t**self.power * sample.rates[i] * others
        return total


Polynomial: TypeAlias = Mapping[Monomial, Expr | int]
Column: TypeAlias = Polynomial | Expr
"""Ansatz function phi_c: a polynomial, or any expression in q, p, t and parameters."""


def conserved(
    system: MechanicalSystem, motion: Rates, columns: Sequence[Column], *, fractions: bool = False
) -> list[dict[int, Expr]]:
    """Return a basis of the conserved combinations of ``columns``, each as coefficients by column index.

    Columns that come first occur in as few of them as possible. Coefficients have denominators if ``fractions`` are
    allowed and make them shorter. A combination with an unrecognised coefficient is omitted.
    """
    search = _Search(motion, columns)
    (rows,) = search.null_spaces(range(len(columns)), 1)
    if rows is None or not len(rows):
        return []
    support = [int(c) for c in np.flatnonzero(rows.any(axis=0))]
    factors = _factors(system, motion)
    computed = search.null_spaces(support, len(factors) + MORE_PARAMETERS if factors else 1)
    spaces = [space for space in computed if space is not None and space.shape == (len(rows), len(support))]
    if len(spaces) < len(computed):
        return []
    known = search.with_values(factors)
    recognised = [_recognised_row(np.array(spaces)[:, k], support, known, fractions) for k in range(len(rows))]
    return [
        {c: coefficient.xreplace(motion.numbers) for c, coefficient in row.items()}
        for row in recognised
        if row is not None and search.verified(row)
    ]


def confirmed(motion: Rates, columns: Sequence[Column], row: Mapping[int, Expr]) -> bool:
    """Return whether a combination of columns is conserved to 40 digits at the sampled points where it is defined."""
    return _Search(motion, columns).verified(row)


class _Search:
    """Rates of columns at random points, for random values of the parameters."""

    def __init__(self, motion: Rates, columns: Sequence[Column]) -> None:
        self.motion, self.columns = motion, columns
        self.partials: dict[int, dict[int, Expr]] = {}
        self.drawn: dict[Symbol, Array] = {}

    def null_spaces(self, chosen: Sequence[int], count: int) -> list[Array | None]:
        """Return null spaces of the chosen columns for ``count`` values of the parameters, of shape (d, columns) each.

        ``None`` where the system is undefined at too many points. Parameters have the signs of their default values and
        are of size 1, or are near the default values where the system is undefined there.
        """
        for near in (False, True):
            self.drawn = drawn_parameters(self.motion.constants, count, near=near)
            together = max(1, AT_ONCE // (2 * (len(chosen) + MORE_POINTS)))
            spaces = [
                space
                for first in range(0, count, together)
                for space in self._null_spaces(chosen, slice(first, first + together))
            ]
            if all(space is not None for space in spaces):
                break
        return spaces

    def _null_spaces(self, chosen: Sequence[int], part: slice) -> Iterator[Array | None]:
        """Yield null spaces for a part of the drawn parameter values."""
        size = len(chosen) + MORE_POINTS
        points = 2 * size  # more than needed, since the system may be undefined at some of them
        parameters = {parameter: np.repeat(values[part], points) for parameter, values in self.drawn.items()}
        count = max([len(values) // points for values in parameters.values()], default=1)
        with np.errstate(all="ignore"):
            sample = self.motion.arrays(parameters, count * points)
            terms = [self.terms(c, sample) for c in chosen]
            rates = np.array([np.sum(summands, axis=0) for summands in terms]).T
            sizes = np.array([np.abs(summands).max(axis=0) for summands in terms]).T
        for own_rates, own_sizes in zip(np.split(rates, count), np.split(sizes, count), strict=True):
            good = np.flatnonzero(np.isfinite(own_rates).all(axis=1))[:size]
            yield _null_space(own_rates[good], own_sizes[good]) if len(good) == size else None

    def terms(self, c: int, sample: Sample) -> list[Any]:
        """Return the terms whose sum is the time derivative of a column."""
        column = self.columns[c]
        if not isinstance(column, Expr):
            return [
                (sample.value(factor) if isinstance(factor, Expr) else factor) * monomial.rate(sample)
                for monomial, factor in column.items()
            ]
        state = (*self.motion.arguments[: len(self.motion.momenta)], *self.motion.momenta, self.motion.time)
        if c not in self.partials:
            self.partials[c] = gradient(column, state)
        rates = (*sample.rates, 1.0)
        return [sample.value(derivative) * rates[i] for i, derivative in self.partials[c].items()] or [0.0 * sample.t]

    def with_values(self, factors: Sequence[Expr]) -> list[tuple[Expr, Array]]:
        """Return factors with their values at the drawn parameters, without those that are 0 or undefined there."""
        known: dict[Any, Any] = dict(self.drawn)
        with np.errstate(all="ignore"):
            evaluated = [(factor, np.asarray(array_value(factor, known), dtype=float)) for factor in factors]
        return [(factor, values) for factor, values in evaluated if np.isfinite(values).all() and values.all()]

    def verified(self, row: Mapping[int, Expr]) -> bool:
        """Return whether a combination is conserved to 40 digits at all verification points."""
        for sample in self.motion.verifying:
            try:
                terms = [sample.value(x) * term for c, x in row.items() for term in self.terms(c, sample)]
            except ArithmeticError:  # a root of a parameter that may be negative
                return False
            if abs(mp.fsum(terms)) > NEGLIGIBLE * (1 + mp.fsum(map(abs, terms))):
                return False
        return bool(self.motion.verifying)


def _null_space(matrix: Array, sizes: Array) -> Array:
    """Return the null space in reduced row echelon form; rows and columns are scaled by ``sizes`` of terms."""
    heights = sizes.max(axis=1, keepdims=True)
    heights = np.where(heights > 0.0, heights, 1.0)
    widths = np.sqrt(((sizes / heights) ** 2).mean(axis=0))
    widths = np.maximum(widths, ROUNDING * (widths.max() or 1.0))
    scaled, small = matrix / heights / widths, NULL * math.sqrt(len(matrix))
    if _all_larger(scaled, small):
        return np.empty((0, scaled.shape[1]))
    _, singular, directions = np.linalg.svd(scaled, full_matrices=False)
    rows, pivots = _reduced(directions[singular <= small])
    unscaled: Array = rows * widths[pivots, None] / widths
    return unscaled


def _all_larger(matrix: Array, small: float) -> bool:
    """Return whether singular values exceed ``small``, by 1 / |R^-1|_F with M = Q R, a twentieth of the cost of SVD."""
    try:
        return bool(np.linalg.norm(np.linalg.inv(np.linalg.qr(matrix, mode="r"))) < 1.0 / small)
    except np.linalg.LinAlgError:
        return False


def _reduced(rows: Array) -> tuple[Array, list[int]]:
    """Return the reduced row echelon form of orthonormal rows, and its pivot columns."""
    pivots: list[int] = []
    for c in range(rows.shape[1]):
        done = len(pivots)
        if done == len(rows):
            break
        best = done + int(np.abs(rows[done:, c]).argmax())
        if abs(rows[best, c]) < PIVOT:
            rows[done:, c] = 0.0
            continue
        rows[[done, best]] = rows[[best, done]]
        rows[done] /= rows[done, c]
        others = np.arange(len(rows)) != done
        rows[others] -= rows[others, c, None] * rows[done]
        pivots.append(c)
    return np.where(np.abs(rows) > ZERO, rows, 0.0), pivots


def _factors(system: MechanicalSystem, motion: Rates) -> list[Expr]:
    """Return candidate factors of coefficients: parameters, and sums of parameters that occur in the system."""
    constants = set(motion.constants)
    result: list[Expr] = list(motion.constants)
    masses = forms_of(system).mass
    sums = [*(part for part in parts(system.formula) if part.is_Add), *masses.values()]
    sums.append(sympy.Add(*(entry for (i, j), entry in masses.items() if i == j)))
    for total in sums:
        constant_part = sympy.Add(*(term for term in sympy.Add.make_args(total) if term.free_symbols <= constants))
        primitive = constant_part.primitive()[1]
        if len(sympy.Add.make_args(primitive)) > 1 and primitive not in result and -primitive not in result:
            result.append(primitive)
    return [*result[: len(constants)], *sorted(result[len(constants) :], key=str)]


def _recognised_row(
    entries: Array, support: Sequence[int], factors: Sequence[tuple[Expr, Array]], fractions: bool
) -> dict[int, Expr] | None:
    """Return coefficients by column; ``entries`` have the shape (values of the parameters, columns)."""
    powers: dict[int, dict[Expr, Fraction]] = {}
    numbers: dict[int, Expr] = {}
    for k, c in enumerate(support):
        if not entries[:, k].any():
            continue
        recognised = _recognised(entries[:, k], factors)
        if recognised is None:
            return None
        numbers[c], powers[c] = recognised
    shifts: dict[Expr, Fraction] = {}
    for factor, _ in factors:
        ascending = sorted(power[factor] for power in powers.values())
        shifts[factor] = ascending[(len(ascending) - 1) // 2] if fractions else min(Fraction(0), ascending[0])
    return {
        c: sympy.Mul(number, *(factor ** sympy.Rational(powers[c][factor] - shift) for factor, shift in shifts.items()))
        for c, number in numbers.items()
    }


def _recognised(entries: Array, factors: Sequence[tuple[Expr, Array]]) -> tuple[Expr, dict[Expr, Fraction]] | None:
    """Return the number and the powers of the factors whose product has these values."""
    if not entries.all():
        return None
    # Least squares: log|entry| = log|number| + sum of power * log|factor|; powers are rounded to halves.
    logs = [np.ones(len(entries)), *(np.zeros(len(entries)) + np.log(np.abs(values)) for _, values in factors)]
    solution = np.linalg.lstsq(np.array(logs).T, np.log(np.abs(entries)), rcond=None)[0]
    halves = np.rint(2.0 * solution[1:])
    if np.abs(halves).max(initial=0.0) > 2 * HIGHEST_POWER:
        return None
    quotients = entries.copy()
    for (_, values), twice in zip(factors, halves, strict=True):
        quotients /= values ** int(twice / 2) if twice % 2 == 0 else np.abs(values) ** (twice / 2.0)
    number = _number(float(np.median(quotients)))
    if number is None or np.abs(quotients / float(number) - 1.0).max() > RECOGNISED:
        return None
    return number, {factor: Fraction(int(twice), 2) for (factor, _), twice in zip(factors, halves, strict=True)}


def _number(value: float) -> Expr | None:
    """Return the rational number of small integers near ``value``, or the square root of one."""
    for exact in (Fraction(value), Fraction(value) ** 2):
        simple = exact.limit_denominator(LARGEST_INTEGER)
        if simple and abs(float(exact / simple) - 1.0) < RECOGNISED:
            rational = sympy.Rational(simple.numerator, simple.denominator)
            return rational if exact == Fraction(value) else sympy.sign(value) * sympy.sqrt(rational)
    return None
