"""Quadrature rules on [-1, 1]: Gauss-Legendre, Lobatto, Radau, Clenshaw-Curtis and Fejer, to 60 digits.

A rule of order p integrates polynomials of degree below p exactly. References: Davis & Rabinowitz, *Methods of
Numerical Integration*, 2nd ed. 1984; Golub & Welsch, Math. Comp. 23 (1969) 221; Waldvogel, BIT 46 (2006) 195;
Trefethen, SIAM Review 50 (2008) 67.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, TypeVar

from scvi_codegen.common.errors import MethodError
from scvi_codegen.common.precision import DIGITS, Matrix, Number, Vector, mp
from scvi_codegen.common.representation import summary
from scvi_codegen.methods.tables.nodes import (
    GUARD,
    ascending_points,
    cached_family,
    chebyshev_gauss_points,
    chebyshev_lobatto_points,
    family_named,
    is_antisymmetric,
    legendre_gauss_points,
    legendre_lobatto_points,
    point_count,
    radau_left_points,
    radau_right_points,
    to_number,
    to_unit,
)

COMPUTED_TOLERANCE = mp.mpf("1e-12")

CLAIMED_TOLERANCE = mp.mpf("1e-8")

MAX_ORDER = 10**6
MAX_CONDITIONS = 64
"""Maximum number of conditions of a rule with derivatives, whose weights solve as many equations."""

MOST_DIGITS = 9

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True, kw_only=True)
class Quadrature:
    """Quadrature rule sum_n w_n f(x_n) for the integral of f over [-1, 1], or sum_n sum_k w_kn f^(k)(x_n).

    ``points`` are ascending in [-1, 1], ``weights`` as many, of any sign, with sum 2; floats, integers, fractions,
    decimal strings and SymPy numbers are converted to 60 digits. ``derivative_weights`` has one row for f', one for f''
    and so on. ``order`` is the p such that polynomials of degree below p are integrated exactly; by default (0) it is
    computed from the Legendre moments, which must then be zero to 12 digits; otherwise it is verified to 8 digits.
    ``MethodError`` is raised when any of this fails.
    """

    name: str
    points: Vector
    weights: Vector
    derivative_weights: Matrix = ()
    order: int = 0

    __repr__ = summary("name", "order")

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", ascending_points(self.points, "quadrature point"))
        object.__setattr__(self, "weights", tuple(map(to_number, self.weights)))
        object.__setattr__(
            self, "derivative_weights", tuple(tuple(map(to_number, line)) for line in self.derivative_weights)
        )
        for weights in (self.weights, *self.derivative_weights):
            if len(self.points) != len(weights) or not self.points:
                raise MethodError(
                    f"quadrature {self.name!r} has {len(self.points)} points and {len(weights)} weights; "
                    "give one weight for each point, and at least one point"
                )
        claimed = point_count(self.order, "the order of a quadrature", least=0, most=MAX_ORDER)
        tolerance = CLAIMED_TOLERANCE if claimed else COMPUTED_TOLERANCE
        order = moment_order(self.points, (self.weights, *self.derivative_weights), tolerance)
        if order == 0:
            total = mp.nstr(mp.fsum(self.weights), 15)
            raise MethodError(f"the weights of quadrature {self.name!r} have sum {total}; scale them to sum 2")
        if order < claimed:
            raise MethodError(
                f"quadrature {self.name!r} has order {order}, not {claimed}: the Legendre moment of "
                f"degree {order} is not zero; correct the numbers or leave order out"
            )
        object.__setattr__(self, "order", claimed or order)

    def __len__(self) -> int:
        return len(self.points)

    @property
    def symmetric(self) -> bool:
        """True if points and weights are symmetric about 0, to 50 digits."""
        tolerance = mp.mpf(10) ** (10 - DIGITS)
        pairs = [
            (left, (-1) ** k * right)
            for k, weights in enumerate((self.weights, *self.derivative_weights))
            for left, right in zip(weights, reversed(weights), strict=True)
        ]
        return is_antisymmetric(self.points) and all(abs(left - right) <= tolerance for left, right in pairs)

    @property
    def conditions(self) -> int:
        """Number of values that the rule uses: points, times 1 plus the number of derivatives."""
        return len(self.points) * (1 + len(self.derivative_weights))

    @property
    def abscissae(self) -> Vector:
        """Points mapped to [0, 1]: c = (x + 1) / 2."""
        return to_unit(self.points)

    @property
    def unit_weights(self) -> Vector:
        """Weights for [0, 1], with sum 1: b = w / 2."""
        return tuple(weight / 2 for weight in self.weights)

    @property
    def unit_derivative_weights(self) -> Matrix:
        """Weights of the derivatives for [0, 1]: the k-th divided by 2^(k+1)."""
        return tuple(tuple(w / 2 ** (k + 1) for w in line) for k, line in enumerate(self.derivative_weights, 1))


def moment_order(points: Vector, weights: Matrix, tolerance: Number) -> int:
    """Return the degree of the first Legendre polynomial with an error above ``tolerance``, at most 2 n per derivative.

    Legendre polynomials make the test well conditioned: for a Gauss rule the moment of degree 2n is of size 1, while
    that of x^(2n) is below 4^-n.
    """
    most = 2 * len(points) * len(weights)
    none: Matrix = ((mp.zero,) * len(points),) * len(weights)
    before, values = none, ((mp.one,) * len(points), *none[1:])
    for degree in range(most):
        moment = mp.fsum(mp.fdot(w, f) for w, f in zip(weights, values, strict=True))
        if abs(moment - (2 if degree == 0 else 0)) > tolerance:
            return degree
        before, values = values, next_legendre(degree, points, values, before)
    return most


def next_legendre(degree: int, points: Vector, values: Matrix, before: Matrix) -> Matrix:
    """Return P_(degree + 1) and its derivatives at the points, one row per derivative, from the two degrees below."""
    lines = []
    for k, (line, last) in enumerate(zip(values, before, strict=True)):
        lower = values[k - 1] if k else line
        terms = zip(points, line, lower, last, strict=True)
        lines.append(
            tuple(
                ((2 * degree + 1) * (x * f + k * derivative) - degree * old) / (degree + 1)
                for x, f, derivative, old in terms
            )
        )
    return tuple(lines)


def gauss_type(name: str, points: Vector, order: int, weight: Callable[[Number, Number], Number]) -> Quadrature:
    """Return the rule on ``points`` whose weights are a formula of x and P_{n-1}(x)^2, evaluated with guard digits."""
    with mp.workdps(DIGITS + GUARD):
        weights = [weight(x, mp.legendre(len(points) - 1, x) ** 2) for x in points]
    return Quadrature(name=f"{name}:{len(points)}", points=points, weights=tuple(weights), order=order)


@cached_family
def gauss_legendre(n: int) -> Quadrature:
    """Return the n-point Gauss-Legendre rule, of order 2n.

    Points: the roots of P_n. Weights: 2 (1 - x^2) / (n P_{n-1}(x))^2, which is 2 / ((1 - x^2) P_n'(x)^2)
    (Davis & Rabinowitz, section 2.7; the classical alternative is the eigenproblem of Golub & Welsch 1969).

    >>> rule = gauss_legendre(2)
    >>> rule.name, rule.order, [float(w) for w in rule.weights]
    ('gauss-legendre:2', 4, [1.0, 1.0])
    """
    n = point_count(n, "the number of Gauss-Legendre points", least=1)
    return gauss_type("gauss-legendre", legendre_gauss_points(n), 2 * n, lambda x, P2: 2 * (1 - x * x) / (n * n * P2))


@cached_family
def gauss_lobatto(n: int) -> Quadrature:
    """Return the n-point Gauss-Lobatto rule (both ends are points, n >= 2), of order 2n - 2.

    Points: -1, 1 and the roots of P'_{n-1}. Weights: 2 / (n (n - 1) P_{n-1}(x)^2) (Davis & Rabinowitz, section 2.7).
    """
    n = point_count(n, "the number of Gauss-Lobatto points", least=2)
    return gauss_type("gauss-lobatto", legendre_lobatto_points(n), 2 * n - 2, lambda x, P2: 2 / (n * (n - 1) * P2))


@cached_family
def gauss_radau(n: int, side: Literal["left", "right"] = "left") -> Quadrature:
    """Return the n-point Gauss-Radau rule with a point at -1 (``"left"``) or at 1 (``"right"``), of order 2n - 1.

    Points on the left: the roots of P_{n-1} + P_n. Weights: (1 - x) / (n P_{n-1}(x))^2, for the right side (1 + x)
    (Davis & Rabinowitz, section 2.7).
    """
    n = point_count(n, "the number of Gauss-Radau points", least=1)
    if side not in ("left", "right"):
        raise MethodError(f"the side of a Gauss-Radau rule is 'left' or 'right', got {side!r}; choose one of them")
    points, sign = (radau_left_points(n), -1) if side == "left" else (radau_right_points(n), 1)
    return gauss_type(f"gauss-radau-{side}", points, 2 * n - 1, lambda x, P2: (1 + sign * x) / (n * n * P2))


def cosine_sum(angle: Number, count: int, last: int) -> Number:
    """Return 1 - sum_{k=1}^{count//2} b_k cos(2 k angle) / (4k^2 - 1), where b_k is 1 for 2 k = ``last``, else 2.

    Both Chebyshev rules are this sum.
    """
    terms = ((1 if 2 * k == last else 2) * mp.cos(2 * k * angle) / (4 * k * k - 1) for k in range(1, count // 2 + 1))
    return 1 - sum(terms)


@cached_family
def clenshaw_curtis(n: int) -> Quadrature:
    """Return the n-point Clenshaw-Curtis rule (n >= 2) on -cos(j pi / N), N = n - 1; of order n, or n + 1 for odd n.

    Weights: (c_j / N) (1 - sum_{k=1}^{N//2} b_k cos(2 j k pi / N) / (4k^2 - 1)) with c_j = 1 at the ends, else 2, and
    b_k = 1 for 2k = N, else 2 (Waldvogel 2006; Trefethen 2008).
    """
    n = point_count(n, "the number of Clenshaw-Curtis points", least=2)
    N = n - 1
    with mp.workdps(DIGITS + GUARD):
        sums = [cosine_sum(j * mp.pi / N, N, N) for j in range(n)]
        weights = symmetrised(tuple((1 if j in (0, N) else 2) * value / N for j, value in enumerate(sums)))
    points = chebyshev_lobatto_points(n)
    return Quadrature(name=f"clenshaw-curtis:{n}", points=points, weights=weights, order=n + n % 2)


@cached_family
def fejer(n: int) -> Quadrature:
    """Return Fejer's first rule with n points -cos((2j + 1) pi / 2n); of order n, or n + 1 for odd n.

    Weights: (2 / n) (1 - 2 sum_{k=1}^{n//2} cos((2j + 1) k pi / n) / (4k^2 - 1)) (Waldvogel 2006).
    """
    n = point_count(n, "the number of Fejer points", least=1)
    with mp.workdps(DIGITS + GUARD):
        weights = symmetrised(tuple(2 * cosine_sum((2 * j + 1) * mp.pi / (2 * n), n, 0) / n for j in range(n)))
    return Quadrature(name=f"fejer:{n}", points=chebyshev_gauss_points(n), weights=weights, order=n + n % 2)


@cached_family
def hermite(n: int, derivatives: int = 1) -> Quadrature:
    """Return the rule that integrates the Hermite interpolant of f and its derivatives at n Lobatto points.

    Order n (1 + derivatives), one more where that is odd. Two points with f' is the corrected trapezoidal rule of order
    4, f(-1) + f(1) + (f'(-1) - f'(1)) / 3 (Davis & Rabinowitz, section 2.8).

    >>> rule = hermite(2)
    >>> rule.name, rule.order, [float(w) for w in rule.derivative_weights[0]]
    ('hermite:2', 4, [0.3333333333333333, -0.3333333333333333])
    """
    n = point_count(n, "the number of Hermite points", least=2)
    kinds = 1 + point_count(derivatives, "the number of derivatives of a Hermite rule", least=1)
    count = point_count(
        n * kinds, "the number of values and derivatives of a Hermite rule", least=4, most=MAX_CONDITIONS
    )
    points = legendre_lobatto_points(n)
    with mp.workdps(DIGITS + GUARD + 2 * count):
        rows = mp.matrix(
            [[mp.ff(j, k) * x ** max(j - k, 0) for k in range(kinds) for x in points] for j in range(count)]
        )
        moments = mp.matrix([(1 - (-1) ** (j + 1)) / mp.mpf(j + 1) for j in range(count)])
        solved = list(mp.lu_solve(rows, moments))
    lines = [tuple(+w for w in solved[k * n : (k + 1) * n]) for k in range(kinds)]
    name = f"hermite:{n}" if kinds == 2 else f"hermite-{derivatives}:{n}"
    return Quadrature(name=name, points=points, weights=lines[0], derivative_weights=tuple(lines[1:]))


def symmetrised(weights: Vector) -> Vector:
    """Return the mean of the weights and their mirror image: symmetric to the last bit."""
    return tuple((left + right) / 2 for left, right in zip(weights, reversed(weights), strict=True))


QUADRATURE_FAMILIES: Mapping[str, Callable[[int], Quadrature]] = {
    "gauss-legendre": gauss_legendre,
    "gauss-lobatto": gauss_lobatto,
    "gauss-radau-left": lambda n: gauss_radau(n, "left"),
    "gauss-radau-right": lambda n: gauss_radau(n, "right"),
    "clenshaw-curtis": clenshaw_curtis,
    "fejer": fejer,
    "hermite": hermite,
    "hermite-2": lambda n: hermite(n, 2),
    "hermite-3": lambda n: hermite(n, 3),
}


def split_name(name: str, families: Mapping[str, Item], kind: str) -> tuple[Item, int]:
    """Read ``"family:count"`` and return the family and the count; ``MethodError`` says what is wrong with either."""
    family, _, count = str(name).partition(":")
    resolved = family_named(family, families, kind)
    if not (count.isascii() and count.isdigit() and len(count) <= MOST_DIGITS):
        raise MethodError(f"{kind} {name!r} lacks its number of points; write '{family}:3', for example")
    return resolved, int(count)


def quadrature_by_name(name: str) -> Quadrature:
    """Return the rule of a name such as ``"gauss-legendre:8"``, the inverse of ``name``.

    Raises ``MethodError`` for an unknown family (with the known ones and the closest) or a missing or too small count.
    """
    family, count = split_name(name, QUADRATURE_FAMILIES, "quadrature")
    return family(count)
