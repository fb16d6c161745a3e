"""Spaces of trial curves (paper, 4.2.3): polynomials, trigonometric polynomials, splines with continuous velocity.

A space of degree s is defined by the velocities of its curves on [0, 1]: s functions with cardinal combinations l_b on
s points, l_b(point_a) = 1 if a = b else 0. A curve is q(c) = q0 + h sum_b V_b int_0^c l_b, its velocity
sum_b V_b l_b(c). A method needs tables of the l_b, of their integrals, and for quadratures with derivatives of their
derivatives.

Splines replace the wavelets that the paper mentions: with few basis functions per step there is nothing to compress.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

from scvi_codegen.common.errors import MethodError
from scvi_codegen.common.precision import DIGITS, Matrix, Number, Vector, mp
from scvi_codegen.common.validation import checked_count
from scvi_codegen.methods.tables.basis import (
    cardinal_integrals,
    cardinal_values,
    differentiation_matrix,
    matrix_product,
)
from scvi_codegen.methods.tables.nodes import to_number
from scvi_codegen.methods.tables.quadrature import Quadrature, gauss_legendre

MOST_POINTS = 64
BETTER = 4
"""Number of additional points of the reference rule by which the accuracy of a rule is judged."""
GUARD_DIGITS = 200
"""Guard digits: trigonometric functions of low frequency are nearly polynomials, and cardinal combinations cancel."""


class CurveSpace(ABC):
    """Family of spaces of curves, one for each degree."""

    __slots__ = ()

    @property
    @abstractmethod
    def name(self) -> str:
        """Name that :func:`space_by_name` accepts."""

    @property
    def nodal(self) -> bool:
        """True if values at nodes determine a curve, as for polynomials."""
        return False

    @property
    def fitted(self) -> float | None:
        """Fitted frequency of the curves, in radians per step, or ``None``."""
        return None

    def dimension(self, degree: int) -> int:
        """Return the number s of velocities that determine a curve: the degree, unless it has pieces."""
        return degree

    @abstractmethod
    def points(self, degree: int, rule: Quadrature) -> Vector:
        """Return the (s,) points at which the velocities of the curve are unknowns."""

    def default_rule(self, degree: int) -> Quadrature:
        """Return the default quadrature: as many Gauss points as the degree."""
        return gauss_legendre(degree)

    def along(self, rule: Quadrature) -> Quadrature:
        """Return the rule along the step: ``rule`` itself, unless the step has pieces."""
        return rule

    @abstractmethod
    def velocities(self, points: Vector, at: Vector, derivative: int = 0) -> Matrix:
        """Return the (len(at), s) values of the l_b, or of a derivative with respect to c."""

    @abstractmethod
    def positions(self, points: Vector, at: Vector) -> Matrix:
        """Return the (len(at), s) integrals of the l_b from 0."""

    def order(self, degree: int) -> int | None:
        """Return the order of an SVI with a sufficiently accurate quadrature, or ``None`` if none is claimed."""
        return 2 * degree


@dataclass(frozen=True, slots=True)
class Polynomials(CurveSpace):
    """Polynomials of the degree: the paper's spectral variational integrators."""

    name = "polynomials"
    nodal = True

    def points(self, degree: int, rule: Quadrature) -> Vector:
        """Return the quadrature points if there are as many as the degree, else Gauss points."""
        plain = len(rule) == degree and not rule.derivative_weights
        return rule.abscissae if plain else gauss_legendre(degree).abscissae

    def velocities(self, points: Vector, at: Vector, derivative: int = 0) -> Matrix:
        """See :meth:`CurveSpace.velocities`."""
        values = cardinal_values(points, at)
        for _ in range(derivative):
            values = matrix_product(values, differentiation_matrix(points))
        return values

    def positions(self, points: Vector, at: Vector) -> Matrix:
        """See :meth:`CurveSpace.positions`."""
        return cardinal_integrals(points, at, 0)


@dataclass(frozen=True, slots=True)
class Trigonometric(CurveSpace):
    """Span of 1, cos(k f c), sin(k f c) for k = 1 .. K, and powers of c for the rest of the degree: s = 2 K + powers.

    An even degree with all its harmonics contains no powers: straight lines are then not in the space, and for a fixed
    f the method does not converge as h goes to 0. Let f shrink with the step, or use an odd degree or fewer harmonics.

    If f is the frequency of an oscillator times the step size, the method is exact for the oscillator at any step size,
    provided that the quadrature is; the default has enough Gauss points. Survey: Vanden Berghe et al., J. Comput. Appl.
    Math. 125 (2000) 107.

    Args:
        frequency: f > 0, in radians per step.
        harmonics: K; by default the largest for the degree.
    """

    frequency: float
    harmonics: int | None = None

    def __post_init__(self) -> None:
        frequency = float(to_number(self.frequency))
        if not frequency > 0.0:
            raise MethodError(
                f"the frequency of trigonometric curves must be positive, in radians per step, not {frequency}"
            )
        if self.harmonics is not None:
            harmonics = checked_count(self.harmonics, "the number of harmonics", least=1, error=MethodError)
            object.__setattr__(self, "harmonics", harmonics)
        object.__setattr__(self, "frequency", frequency)

    @property
    def fitted(self) -> float | None:
        """Frequency f."""
        return self.frequency

    @property
    def name(self) -> str:
        """Name ``trigonometric:<frequency>[:<harmonics>]``."""
        tail = "" if self.harmonics is None else f":{self.harmonics}"
        return f"trigonometric:{self.frequency!r}{tail}"

    def points(self, degree: int, rule: Quadrature) -> Vector:
        """Return Gauss points."""
        self._count(degree)
        return gauss_legendre(degree).abscissae

    def default_rule(self, degree: int) -> Quadrature:
        """Return the Gauss rule that integrates products of two curves to round-off."""
        count = self._count(degree)
        powers = 2 * (degree - 2 * count)

        def product(x: Number) -> Number:
            """Return the product of highest frequency; 1 + x makes it asymmetric."""
            return (1 + x) ** powers * mp.cos(count * mp.mpf(self.frequency) * (1 + x))

        sums: list[Number] = []
        enough = count * self.frequency < MOST_POINTS
        for n in range(degree + 1, MOST_POINTS + 1) if enough else ():
            rule = gauss_legendre(n)
            sums.append(mp.fdot(rule.weights, map(product, rule.points)))
            if len(sums) > BETTER and abs(sums[-1 - BETTER] - sums[-1]) < mp.ldexp(1, powers - 56):
                return gauss_legendre(n - BETTER)
        raise MethodError(
            f"the frequency of {self.name} per step is too high for {MOST_POINTS} quadrature points: use "
            "a smaller step size"
        )

    def positions(self, points: Vector, at: Vector) -> Matrix:
        """See :meth:`CurveSpace.positions`."""
        start, *lines = self.velocities(points, (mp.zero, *at), -1)
        return tuple(tuple(x - y for x, y in zip(line, start, strict=True)) for line in lines)

    def order(self, degree: int) -> int | None:
        """Return ``None``; the order would be twice the degree if the frequency per step decreased with h."""
        return None

    def _count(self, degree: int) -> int:
        harmonics = degree // 2 if self.harmonics is None else self.harmonics
        if not 2 <= 2 * harmonics <= degree:
            raise MethodError(
                f"trigonometric curves of degree {degree} have 1 to {degree // 2} harmonics, not "
                f"{harmonics}; one harmonic requires degree 2"
            )
        return harmonics

    def velocities(self, points: Vector, at: Vector, derivative: int = 0) -> Matrix:
        """Return the functions at ``at`` times their inverse at the points; ``derivative`` -1 for integrals."""
        degree = len(points)
        with mp.workdps(DIGITS + GUARD_DIGITS):
            values_at_points = mp.matrix([self._functions(degree, c, 0) for c in points])
            try:
                solved = mp.matrix([self._functions(degree, c, derivative) for c in at]) * mp.inverse(values_at_points)
            except ZeroDivisionError:
                raise MethodError(
                    f"{self.name} of degree {degree} is not determined by {degree} velocities, "
                    "because its frequency per step is too high: use a smaller step size"
                ) from None
        return tuple(tuple(+solved[i, j] for j in range(degree)) for i in range(len(at)))

    def _functions(self, degree: int, c: Number, derivative: int) -> list[Number]:
        """Return the s velocity functions, centred at 1/2; ``derivative`` -1 for an integral of each."""
        count, x = self._count(degree), c - mp.mpf(1) / 2
        values = [_power_derivative(x, j, derivative) for j in range(degree - 2 * count)]
        for k in range(1, count + 1):
            f, turn = k * mp.mpf(self.frequency), derivative * mp.pi / 2
            values += [f**derivative * mp.cos(f * x + turn), f**derivative * mp.sin(f * x + turn)]
        return values


def _power_derivative(x: Number, j: int, derivative: int) -> Number:
    if derivative == -1:
        return x ** (j + 1) / (j + 1)
    return mp.ff(j, derivative) * x ** (j - derivative) if derivative <= j else mp.zero


@dataclass(frozen=True, slots=True)
class Splines(CurveSpace):
    """Piecewise polynomials of the degree with continuous velocity; the same quadrature on every piece.

    If breakpoints coincide with the kinks of a force, the order is that for smooth forces.

    Args:
        pieces: number of pieces of equal length, 2 by default.
    """

    pieces: int = 2

    def __post_init__(self) -> None:
        pieces = checked_count(self.pieces, "the number of pieces", least=1, most=MOST_POINTS, error=MethodError)
        object.__setattr__(self, "pieces", pieces)

    @property
    def name(self) -> str:
        """Name ``splines:<pieces>``."""
        return f"splines:{self.pieces}"

    @property
    def ends(self) -> list[tuple[Number, Number]]:
        """Start and end of each piece."""
        return list(pairwise(mp.mpf(k) / self.pieces for k in range(self.pieces + 1)))

    def dimension(self, degree: int) -> int:
        """Return the dimension of the velocities, which are continuous and of one degree less."""
        if degree < 2:
            raise MethodError("splines require degree 2 at least, for a continuous velocity")
        velocities = self.pieces * (degree - 1) + 1
        if velocities > MOST_POINTS:
            raise MethodError(
                f"{self.name} of degree {degree} has {velocities} velocities, more than "
                f"{MOST_POINTS}: use fewer pieces, and more steps"
            )
        return velocities

    def points(self, degree: int, rule: Quadrature) -> Vector:
        """Return equispaced points on each piece, including its ends."""
        self.dimension(degree)
        inner = [a + (b - a) * k / (degree - 1) for a, b in self.ends for k in range(degree - 1)]
        return (*inner, mp.one)

    def along(self, rule: Quadrature) -> Quadrature:
        """Return the composite rule."""
        if rule.derivative_weights:
            raise MethodError(
                f"{rule.name} uses derivatives along the curve, which are discontinuous at the "
                f"breakpoints of {self.name}: use a quadrature without derivatives"
            )
        return _composite(rule, tuple(self.ends))

    def velocities(self, points: Vector, at: Vector, derivative: int = 0) -> Matrix:
        """See :meth:`CurveSpace.velocities`; derivatives are not supported, since they jump."""
        assert derivative == 0  # ensured by :meth:`along`
        per_piece = (len(points) - 1) // self.pieces
        lines = []
        for c in at:
            first = self._piece(c) * per_piece
            values = cardinal_values(points[first : first + per_piece + 1], (c,))[0]
            lines.append(_placed(values, first, len(points)))
        return tuple(lines)

    def positions(self, points: Vector, at: Vector) -> Matrix:
        """See :meth:`CurveSpace.positions`."""
        per_piece = (len(points) - 1) // self.pieces

        def over(piece: int, end: Number) -> Vector:
            first, start = piece * per_piece, self.ends[piece][0]
            values = cardinal_integrals(points[first : first + per_piece + 1], (end,), start)[0]
            return _placed(values, first, len(points))

        whole = [over(k, end) for k, (_, end) in enumerate(self.ends)]
        pieces = map(self._piece, at)
        sums = ((*whole[:k], over(k, c)) for k, c in zip(pieces, at, strict=True))
        return tuple(tuple(map(mp.fsum, zip(*vectors, strict=True))) for vectors in sums)

    def _piece(self, c: Number) -> int:
        return sum(c >= a for a, _ in self.ends[1:])


def _placed(values: Vector, first: int, size: int) -> Vector:
    """Return the entries of one piece, padded with zeros."""
    return (*(mp.zero,) * first, *values, *(mp.zero,) * (size - first - len(values)))


@lru_cache(maxsize=64)
def _composite(rule: Quadrature, ends: tuple[tuple[Number, Number], ...]) -> Quadrature:
    points = [2 * (a + (b - a) * c) - 1 for a, b in ends for c in rule.abscissae]
    weights = [2 * (b - a) * w for a, b in ends for w in rule.unit_weights]
    merged: dict[Number, Number] = {}
    for x, w in zip(points, weights, strict=True):
        near = next((y for y in merged if abs(x - y) < mp.mpf("1e-30")), x)
        merged[near] = merged.get(near, mp.zero) + w
    name = f"{rule.name} on {len(ends)} pieces"
    return Quadrature(name=name, points=tuple(merged), weights=tuple(merged.values()), order=rule.order)


def space_by_name(name: str) -> CurveSpace:
    """Return ``"polynomials"``, ``"trigonometric:0.5"``, ``"trigonometric:0.5:1"``, ``"splines:2"``; or MethodError."""
    family, *words = name.split(":")
    try:
        match family, len(words):
            case "polynomials", 0:
                return Polynomials()
            case "trigonometric", 1 | 2:
                return Trigonometric(float(words[0]), *map(int, words[1:]))
            case "splines", 1 if words[0].isascii() and words[0].isdigit():
                return Splines(int(words[0]))
    except MethodError:
        raise
    except ValueError:
        pass
    raise MethodError(
        f"there is no space of curves {name!r}: write polynomials, "
        "trigonometric:FREQUENCY[:HARMONICS] with radians per step, or splines:PIECES"
    )
