"""Cardinal (Lagrange) functions on distinct points: values, derivatives, integrals, differentiation, extrapolation.

l_j is the polynomial of least degree that is 1 at point j and 0 at the others. Points may lie in any interval. A
product of differences needs no division at a point and preserves the relative accuracy of every entry
(Higham, IMA J. Numer. Anal. 24 (2004) 547; Berrut & Trefethen, SIAM Review 46 (2004) 501); guard digits grow with the
number of points, so that 50 digits are correct even for equispaced points of high degree.

Points and results are numbers of 60 digits; arguments may be anything ``mpmath`` converts exactly.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from itertools import accumulate
from operator import mul

from scvi_codegen.common.errors import MethodError
from scvi_codegen.common.precision import DIGITS, Matrix, Number, Vector, mp, settled
from scvi_codegen.methods.tables.nodes import point_count, to_number
from scvi_codegen.methods.tables.quadrature import gauss_legendre

GUESS_DEGREE = 8
"""Maximum degree of the predictor for the next step: row sums of the extrapolation grow 20-fold per degree."""


def matrix_product(left: Matrix, right: Matrix) -> Matrix:
    """Return left @ right; rows of ``left`` are as long as ``right`` has rows."""
    columns = transpose(right)
    return tuple(tuple(mp.fdot(row, column) for column in columns) for row in left)


def identity_matrix(size: int) -> Matrix:
    """Return the (size, size) identity."""
    return tuple(tuple(mp.mpf(int(i == j)) for j in range(size)) for i in range(size))


def transpose(matrix: Matrix) -> Matrix:
    """Return the matrix with rows and columns exchanged."""
    return tuple(zip(*matrix, strict=True))


def rounded(matrix: Iterable[Iterable[Number]]) -> Matrix:
    """Return the matrix in tuples, each entry rounded to the current precision."""
    return tuple(tuple(map(settled, row)) for row in matrix)


def guard_digits(points: Sequence[Number]) -> int:
    """Return the working digits for a table on these points."""
    return DIGITS + 20 + len(points)


def checked_points(points: Iterable[Number]) -> Vector:
    """Return the points as numbers; ``MethodError`` when there is none or two coincide."""
    numbers = tuple(map(to_number, points))
    if not numbers:
        raise MethodError("cardinal functions need at least one point; none was given")
    for index, point in enumerate(numbers):
        if point in numbers[:index]:
            raise MethodError(
                f"point {index} ({mp.nstr(point, 8)}) occurs twice; cardinal functions require distinct points"
            )
    return numbers


@cache
def barycentric_weights(points: Vector) -> Vector:
    """Return 1 / prod_{k != j} (x_j - x_k) for each point, in guard digits."""
    with mp.workdps(guard_digits(points)):
        return tuple(
            1 / mp.fprod(point - other for k, other in enumerate(points) if k != j) for j, point in enumerate(points)
        )


def cardinal_row(points: Vector, weights: Vector, t: Number) -> Vector:
    """Return l_j(t) for each j: the weight times the differences before and after the point."""
    differences = [t - point for point in points]
    before = accumulate(differences[:-1], mul, initial=mp.one)
    after = list(accumulate(reversed(differences[1:]), mul, initial=mp.one))
    return tuple(w * left * right for w, left, right in zip(weights, before, reversed(after), strict=True))


def cardinal_values(points: Iterable[Number], at: Iterable[Number]) -> Matrix:
    """Return l_j(at_i): one row for each entry of ``at``, one column for each point.

    >>> [[float(x) for x in row] for row in cardinal_values((0, 1), (0, 1, 3))]
    [[1.0, 0.0], [0.0, 1.0], [-2.0, 3.0]]
    """
    numbers, targets = checked_points(points), tuple(map(to_number, at))
    weights = barycentric_weights(numbers)
    with mp.workdps(guard_digits(numbers)):
        rows = [cardinal_row(numbers, weights, t) for t in targets]
    return rounded(rows)


@cache
def guarded_differentiation(points: Vector) -> Matrix:
    """Return the differentiation matrix in guard digits."""
    weights = barycentric_weights(points)
    with mp.workdps(guard_digits(points)):
        return tuple(
            tuple(
                weights[j] / weights[i] / (x - y) if i != j else mp.fsum(1 / (x - z) for z in points if z != x)
                for j, y in enumerate(points)
            )
            for i, x in enumerate(points)
        )


def differentiation_matrix(points: Iterable[Number]) -> Matrix:
    """Return D with D_ij = l_j'(x_i), equation (11) of Li, Wu & Leok for Chebyshev points.

    With w the barycentric weights, D_ij = (w_j / w_i) / (x_i - x_j) and D_ii = sum_{k != i} 1 / (x_i - x_k)
    (Berrut & Trefethen 2004, section 9.3, and the derivative of the product).

    >>> [[float(x) for x in row] for row in differentiation_matrix((-1, 0, 1))]
    [[-1.5, 2.0, -0.5], [-0.5, 0.0, 0.5], [0.5, -2.0, 1.5]]
    """
    return rounded(guarded_differentiation(checked_points(points)))


def cardinal_derivatives(points: Iterable[Number], at: Iterable[Number]) -> Matrix:
    """Return l_j'(at_i), computed as values times D, since l_j' is the polynomial through its values at the points."""
    numbers, targets = checked_points(points), tuple(map(to_number, at))
    weights = barycentric_weights(numbers)
    with mp.workdps(guard_digits(numbers)):
        values = tuple(cardinal_row(numbers, weights, t) for t in targets)
        derivatives = matrix_product(values, guarded_differentiation(numbers))
    return rounded(derivatives)


def cardinal_integrals(points: Iterable[Number], at: Iterable[Number], start: Number) -> Matrix:
    """Return the integral of l_j from ``start`` to at_i: rows are ``at``, columns are points.

    It uses the Gauss-Legendre rule of half as many points on each interval, which is exact for these polynomials.
    """
    numbers, targets, origin = checked_points(points), tuple(map(to_number, at)), to_number(start)
    weights = barycentric_weights(numbers)
    rule = gauss_legendre((len(numbers) + 1) // 2)
    with mp.workdps(guard_digits(numbers)):
        rows = []
        for t in targets:
            half = (t - origin) / 2
            values = [cardinal_row(numbers, weights, origin + half * (1 + x)) for x in rule.points]
            rows.append([half * mp.fdot(rule.weights, column) for column in zip(*values, strict=True)])
    return rounded(rows)


def legendre_functional(points: Vector, degree: int) -> Vector:
    """Return the map from values at points in [0, 1] to the coefficient of P_degree(2x - 1) of their interpolant.

    All entries are zero for a degree below 0.
    """
    if degree < 0:
        return (mp.zero,) * len(points)
    rule = gauss_legendre((len(points) + degree) // 2 + 1)
    values = cardinal_values(points, rule.abscissae)
    weights = [
        (2 * degree + 1) * w * mp.legendre(degree, 2 * x - 1)
        for x, w in zip(rule.abscissae, rule.unit_weights, strict=True)
    ]
    return tuple(mp.fdot(weights, column) for column in zip(*values, strict=True))


def extrapolation(points: Iterable[Number], shift: Number, degree: int | None = None) -> Matrix:
    """Return the square matrix E with (E f)_i = p(x_i + shift).

    p is the least-squares polynomial of degree ``degree`` through the values f at the points; left out, the degree is
    that of interpolation. E_ij = sum_k pi_k(x_i + shift) pi_k(x_j) / |pi_k|^2 with the polynomials pi_k orthogonal on
    the points (Stieltjes' procedure; Gautschi, *Orthogonal Polynomials*, 2004, section 2.2). Raises ``MethodError``
    for a degree outside 0 .. number of points - 1.
    """
    numbers, offset = checked_points(points), to_number(shift)
    if degree is None:
        return cardinal_values(numbers, [point + offset for point in numbers])
    degree = point_count(degree, "the degree of an extrapolation", least=0)
    if degree >= len(numbers):
        raise MethodError(f"degree {degree} is too high for {len(numbers)} points; give 0 to {len(numbers) - 1}")
    with mp.workdps(guard_digits(numbers) + len(numbers)):
        rows = least_squares(numbers, [point + offset for point in numbers], degree)
    return rounded(rows)


def next_step(points: Iterable[Number]) -> Matrix:
    """Return the extrapolation by 1 of degree at most ``GUESS_DEGREE``: a first guess of the next step's values."""
    numbers = tuple(points)
    return extrapolation(numbers, 1, min(len(numbers) - 1, GUESS_DEGREE))


def continuation(points: Iterable[Number], degree: int) -> tuple[Matrix, Matrix]:
    """Return (E, E') with (E f + E' f')_i = p(x_i + 1).

    p is the least-squares polynomial of that degree through the values f at the points x in [0, 1] and f' at x - 1.
    Raises ``MethodError`` for a degree that they do not determine.
    """
    numbers = checked_points(points)
    sources = (*numbers, *(point - 1 for point in numbers))
    if not 0 <= degree < len(set(sources)):
        raise MethodError(
            f"degree {degree} must be between 0 and {len(set(sources)) - 1} for {len(set(sources))} points"
        )
    with mp.workdps(guard_digits(numbers) + 2 * len(sources)):
        rows = rounded(least_squares(sources, [point + 1 for point in numbers], degree))
    return tuple(row[: len(numbers)] for row in rows), tuple(row[len(numbers) :] for row in rows)


def least_squares(
    points: Sequence[Number], targets: Sequence[Number], degree: int, dot: Callable[..., Number] = mp.fdot
) -> list[list[Number]]:
    """Return the least-squares matrix as a sum over orthogonal polynomials; see ``extrapolation``.

    ``dot`` is the scalar product of the numbers, here of any precision.
    """
    # pi_(k+1)(x) = (x - <x pi_k, pi_k>/|pi_k|^2) pi_k(x) - |pi_k|^2/|pi_(k-1)|^2 pi_(k-1)(x).
    count, everywhere = len(points), [*points, *targets]
    rows: list[list[Number]] = [[0] * count for _ in targets]
    before, here, norm_before = [0] * len(everywhere), [1] * len(everywhere), math.inf
    for _ in range(degree + 1):
        norm = dot(here[:count], here[:count])
        for row, there in zip(rows, here[count:], strict=True):
            row[:] = [entry + there * value / norm for entry, value in zip(row, here[:count], strict=True)]
        centre = dot([x * value for x, value in zip(points, here, strict=False)], here[:count]) / norm
        ratio = norm / norm_before
        here, before = (
            [(x - centre) * value - ratio * last for x, value, last in zip(everywhere, here, before, strict=True)],
            here,
        )
        norm_before = norm
    return rows
