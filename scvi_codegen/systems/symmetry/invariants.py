"""Conserved polynomials in q, p and t, found by linear algebra.

A polynomial J = sum_c x_c phi_c(q, p, t) is conserved if sum_c x_c dphi_c/dt is zero on all trajectories, that is, at
all points (:mod:`scvi_codegen.systems.symmetry.sampling`): x spans the null space of the matrix of rates at enough
random points, in binary64. Its reduced row echelon form is sparse. Its entries depend on the parameters; they are
recognised as rational numbers times powers of parameters, and of sums of parameters that occur in the system, from
their values at random parameters. A result is accepted if its rate is zero to 40 digits at random points and
parameters.

Ansatz for momentum maps: the polynomials in q, p and t that are tried, and arithmetic on them.

The state is q_0 .. q_(m-1), p_0 .. p_(m-1), with indices 0 .. 2 m - 1. Momentum maps are named after their
directions: ``angular momentum z``, ``momentum of phi``, ``boost x``.
"""

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import combinations, combinations_with_replacement
from typing import Any, TypeAlias

import numpy as np
import sympy
from numpy.typing import NDArray
from sympy import Expr, Symbol, prime

from scvi_codegen.systems.derived_expressions import forms_of
from scvi_codegen.systems.formulas.expressions import cancel, gradient
from scvi_codegen.systems.formulas.intermediates import parts
from scvi_codegen.systems.formulas.numpy_values import array_value
from scvi_codegen.systems.formulas.rotations import Spin
from scvi_codegen.systems.symmetry.sampling import AXES, Body, Rates, Sample, bodies, drawn_parameters
from scvi_codegen.systems.system import MechanicalSystem

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
PARTS = 8
"""Number of parts in which parameters are searched for those that act: formulas are evaluated once for all parts."""
MORE_POINTS = 12
"""Number of sampled points in excess of the number of columns."""
MORE_PARAMETERS = 4
"""Number of sampled parameter values in excess of the number of factors of a coefficient."""


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
    factors = _factors(system, search.acting(support))
    computed = search.null_spaces(support, len(factors) + MORE_PARAMETERS if factors else 1)
    spaces = [space for space in computed if space is not None and space.shape == (len(rows), len(support))]
    if len(spaces) < len(computed):
        return []
    factor_values = search.with_values(factors)
    recognised = [_recognised_row(np.array(spaces)[:, k], support, factor_values, fractions) for k in range(len(rows))]
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
        self.parameters_at: dict[Symbol, Array] = {}

    def acting(self, selected: Sequence[int]) -> list[Symbol]:
        """Return the parameters on which null spaces depend, by parts: those of one are changed together."""
        parts = [[*self.motion.constants]] if self.motion.constants else []
        while parts:
            first, *spaces = self.null_spaces(selected, 1 + len(parts), parts)
            parts = [part for part, space in zip(parts, spaces, strict=True) if not _equal(first, space)]
            if all(len(part) == 1 for part in parts):
                break
            sizes = [-(-len(part) // PARTS) for part in parts]
            parts = [
                part[k : k + size] for part, size in zip(parts, sizes, strict=True) for k in range(0, len(part), size)
            ]
        return [parameter for (parameter,) in parts]

    def null_spaces(
        self, selected: Sequence[int], count: int, parts: Sequence[Sequence[Symbol]] | None = None
    ) -> list[Array | None]:
        """Return null spaces of the chosen columns for ``count`` values of the parameters, of shape (d, columns) each.

        ``None`` where the system is undefined at too many points. Parameters have the signs of their default values and
        are of size 1, or are near the default values where the system is undefined there. Each set of values after the
        first differs from it in the parameters of one of the ``parts``.
        """
        for near in (False, True):
            self.parameters_at = drawn_parameters(self.motion.constants, count, near=near)
            for k, part in enumerate(parts or (), 1):
                for parameter in part:
                    values = self.parameters_at[parameter]
                    values[[*range(k), *range(k + 1, count)]] = values[0]
            together = max(1, AT_ONCE // (2 * (len(selected) + MORE_POINTS)))
            spaces = [
                space
                for first in range(0, count, together)
                for space in self._null_spaces(selected, slice(first, first + together))
            ]
            if all(space is not None for space in spaces):
                break
        return spaces

    def _null_spaces(self, selected: Sequence[int], part: slice) -> Iterator[Array | None]:
        """Yield null spaces for a part of the drawn parameter values."""
        size = len(selected) + MORE_POINTS
        points = 2 * size  # more than needed, since the system may be undefined at some of them
        parameters = {parameter: np.repeat(values[part], points) for parameter, values in self.parameters_at.items()}
        count = max([len(values) // points for values in parameters.values()], default=1)
        with np.errstate(all="ignore"):
            sample = self.motion.arrays(parameters, count * points)
            terms = [self.terms(c, sample) for c in selected]
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
        at_parameters: dict[Any, Any] = dict(self.parameters_at)
        with np.errstate(all="ignore"):
            evaluated = [(factor, np.asarray(array_value(factor, at_parameters), dtype=float)) for factor in factors]
        return [(factor, values) for factor, values in evaluated if np.isfinite(values).all() and values.all()]

    def verified(self, row: Mapping[int, Expr]) -> bool:
        """Return whether a combination is conserved to 40 digits at all verification points."""
        for sample in self.motion.verifying:
            try:
                terms = [sample.value(x) * term for c, x in row.items() for term in self.terms(c, sample)]
            except ArithmeticError:  # a root of a parameter that may be negative
                return False
            if not cancel(terms):
                return False
        return bool(self.motion.verifying)


def _equal(space: Array | None, other: Array | None) -> bool:
    """Return whether null spaces are equal up to rounding; those that are unknown are not."""
    if space is None or other is None or space.shape != other.shape:
        return False
    return np.allclose(space, other, 1e-6, ZERO)


def _null_space(matrix: Array, sizes: Array) -> Array:
    """Return the null space in reduced row echelon form; rows and columns are scaled by ``sizes`` of terms."""
    # Rows to size 1, then columns to root mean square 1: the null space of M D is D^-1 that of M.
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


def _factors(system: MechanicalSystem, acting: Sequence[Symbol]) -> list[Expr]:
    """Return candidate factors of coefficients: parameters that act on them, and sums of these in the system."""
    constants = set(acting)
    result: list[Expr] = list(acting)
    masses = {} if forms_of(system).inverse_mass else forms_of(system).mass  # of trees of bodies never formed
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


Terms: TypeAlias = Mapping[Monomial, Expr]
"""Polynomial whose coefficients depend on parameters."""

MAX_CYCLIC = 12


def monomial_columns(m: int, *, curved: bool) -> Iterator[dict[Monomial, int]]:
    """Yield all monomials of the ansatz, beginning with those that are to occur in few momentum maps."""
    q, p = range(m), range(m, 2 * m)
    planes = sorted(combinations(q, 2), reverse=True)
    turns = [*planes, *((i, i) for i in q), *((j, i) for i, j in planes)]
    factors: list[tuple[int, tuple[int, ...]]] = [(0, (i,)) for i in p]
    factors += [(0, (i,)) for i in q] * curved
    factors += [(0, (i, m + j)) for i, j in turns]
    factors += [(k, pair) for k in (0, 1) for pair in (*combinations(p, 2), *((i, i) for i in p))] * curved
    factors += [(k, (i,)) for k in (1, 2) for i in p]
    factors += [(1, (i, m + j)) for i, j in turns]
    columns = [{Monomial(*factor): 1} for factor in factors]
    yield from columns
    yield from (column for column in gauge_columns(m, quadratic=True) if column not in columns)


def gauge_columns(m: int, *, quadratic: bool) -> Iterator[dict[Monomial, int]]:
    """Yield the monomials of the gauge f: of degree 2 in q (1 in t), 1 in q (3 in t), 0 in q (4 in t)."""
    q = range(m)
    yield from ({Monomial(k, (i,)): 1} for k in range(4) for i in q)
    pairs = (*combinations(q, 2), *((i, i) for i in q)) if quadratic else ()
    yield from ({Monomial(k, pair): 1} for k in (0, 1) for pair in pairs)
    yield from ({Monomial(k, ()): 1} for k in range(1, 5))


def rigid_columns(system: MechanicalSystem) -> Iterator[dict[Monomial, int]]:
    """Yield momenta of cyclic coordinates, translations and rotations of all bodies together, and t."""
    m, free = system.dimension, system.formula.free_symbols
    cyclic = [i for i, q in enumerate(system.coordinates) if q not in free][:MAX_CYCLIC]
    yield from ({Monomial(0, (m + i,)): 1} for i in cyclic)
    rigid = bodies_of(system)
    groups = zip(*(body.columns for body in rigid), strict=True) if rigid else [range(m)]
    yield from ({Monomial(0, (m + i,)): 1 for i in group} for group in groups)
    yield from (turn(m, rigid, plane) for plane in planes_of(rigid))
    yield {Monomial(1, ()): 1}


def rotation_columns(system: MechanicalSystem) -> dict[str, dict[Monomial, Expr]]:
    """Return the angular momenta of each rotation and direction by name, in the space frame and in the body frame.

    E(q)^T p/2 of a quaternion is its angular momentum in the body frame, F(q)^T p/2 that in the space frame; both are
    generated by linear maps of the quaternion, and the scaling, which is gauge, is none of them.
    """
    m, position = system.dimension, {q.name: i for i, q in enumerate(system.coordinates)}
    columns: dict[str, dict[Monomial, Expr]] = {}
    for member in system.rotations:
        indices = [position[name] for name in member.coordinates]
        if len(indices) == len(AXES):
            body = Body(name=member.name, columns=tuple(indices))
            for axis, plane in zip(AXES, planes_of([body]), strict=True):
                columns[f"angular momentum {axis} of {member.name}"] = dict(turn(m, [body], plane))
            continue
        if isinstance(member, Spin):
            x, y, p, q = *indices, *(m + i for i in indices)
            half, quarter = sympy.Rational(1, 2), sympy.Rational(1, 4)
            parts = (
                {Monomial(0, (x, y)): half, Monomial(0, (p, q)): half},
                {Monomial(0, (x, q)): half, Monomial(0, (y, p)): -half},
                {Monomial(0, (i, i)): quarter * (1 if i in (x, p) else -1) for i in (x, p, y, q)},
            )
            columns |= {
                f"angular momentum {axis} of {member.name}": part for axis, part in zip(AXES, parts, strict=True)
            }
            continue
        for k, axis in enumerate(AXES, 1):
            columns[f"angular momentum {axis} of {member.name}"] = _quaternion_column(m, indices, k, -1)
            columns[f"body momentum {k} of {member.name}"] = _quaternion_column(m, indices, k, 1)
    return columns


def _quaternion_column(m: int, indices: Sequence[int], axis: int, sign: int) -> dict[Monomial, Expr]:
    """Return component ``axis`` of E(q)^T p/2 (sign 1) or F(q)^T p/2 (sign -1)."""
    after, before = axis % 3 + 1, (axis + 1) % 3 + 1
    pairs = ((axis, 0, -1), (0, axis, 1), (before, after, sign), (after, before, -sign))
    return {Monomial(0, (indices[i], m + indices[j])): sympy.Rational(factor, 2) for i, j, factor in pairs}


def total_angular_momentum(system: MechanicalSystem) -> dict[str, Terms]:
    """Return the angular momentum of all bodies, rotations and directions about each axis of space, by name."""
    columns = rotation_columns(system)
    turning = {name for rotation in system.rotations for name in rotation.coordinates}
    ordinary = [i for i, q in enumerate(system.coordinates) if q.name not in turning]
    alone = [Body(name="", columns=tuple(ordinary))]
    rest = ["" if q.name in turning else q.name for q in system.coordinates]
    rigid = [body for body in bodies(rest) or alone if len(body.columns) == len(AXES)]
    totals: dict[str, Terms] = {}
    for axis, plane in zip(AXES, ((1, 2), (2, 0), (0, 1)), strict=True):
        total: dict[Monomial, Expr] = {key: sympy.Integer(x) for key, x in turn(system.dimension, rigid, plane).items()}
        for member in system.rotations:
            total |= columns[f"angular momentum {axis} of {member.name}"]
        totals[f"angular momentum {axis}"] = total
    return totals


def is_shift(column: Polynomial) -> bool:
    """Return whether a polynomial is a sum of single momenta (a translation)."""
    return all(len(monomial.factors) == 1 for monomial in column)


def boost_columns(system: MechanicalSystem, rigid: Sequence[Polynomial]) -> list[Polynomial]:
    """Return Galilean boosts: translations times t minus the masses that they move times their positions, and t^2."""
    m, constants = system.dimension, set(system.parameters)
    masses = {column: x for column, x in forms_of(system).mass.items() if x.free_symbols <= constants}
    boosts: list[Polynomial] = []
    for shift in filter(is_shift, rigid):
        moved = {monomial.factors[0] - m for monomial in shift}
        boost: dict[Monomial, Expr | int] = {Monomial(1, monomial.factors): 1 for monomial in shift}
        for (i, j), mass in masses.items():
            if i in moved:
                boost[Monomial(0, (j,))] = boost.get(Monomial(0, (j,)), 0) - mass
        boosts.append(boost)
    return [*boosts, {Monomial(2, ()): 1}]


def bodies_of(system: MechanicalSystem) -> tuple[Body, ...]:
    """Return bodies by names such as jupiter_x, x_jupiter, x1; 2 or 3 coordinates with other names are one body."""
    names = [q.name for q in system.coordinates]
    alone = (Body(name="", columns=tuple(range(len(names)))),) if 2 <= len(names) <= 3 else ()
    return bodies(names) or alone


def planes_of(rigid: Sequence[Body]) -> list[tuple[int, int]]:
    """Return pairs of axes of right-handed rotations: about x, y, z, or the one of the plane."""
    planes = {2: [(0, 1)], 3: [(1, 2), (2, 0), (0, 1)]}
    return planes.get(len(rigid[0].columns), []) if rigid else []


def turn(m: int, rigid: Sequence[Body], plane: tuple[int, int]) -> dict[Monomial, int]:
    """Return the angular momentum of all bodies in a plane of rotation."""
    pairs = [(body.columns[plane[0]], body.columns[plane[1]]) for body in rigid]
    return {Monomial(0, (i, m + j)): 1 for i, j in pairs} | {Monomial(0, (j, m + i)): -1 for i, j in pairs}


def combined(row: Mapping[int, Expr], columns: Sequence[Column]) -> Terms:
    """Return the linear combination of polynomial columns with these coefficients."""
    terms: dict[Monomial, Expr] = {}
    for c, coefficient in row.items():
        column = columns[c]
        assert not isinstance(column, Expr)
        for monomial, factor in column.items():
            terms[monomial] = terms.get(monomial, sympy.S.Zero) + factor * coefficient
    return {monomial: coefficient for monomial, coefficient in terms.items() if coefficient != 0}


def polynomial_in(system: MechanicalSystem, terms: Terms) -> Expr:
    """Return the polynomial as an expression in the symbols of the system."""
    state = (*system.coordinates, *system.momentum_symbols)
    return sympy.Add(
        *(
            sympy.Mul(coefficient, system.time**monomial.power, *(state[i] for i in monomial.factors))
            for monomial, coefficient in terms.items()
        )
    )


def independent(candidates: Sequence[Terms], first: Sequence[Terms] = (), trivial: Sequence[Terms] = ()) -> list[Terms]:
    """Return ``first`` and those found that are no combinations of them, of products of linear ones and of ``trivial``.

    ``candidates`` and ``first`` span the products that they have; ``first``, unless empty, has all linear ones.
    """
    basis = list(first) or [terms for terms in candidates if _is_linear(terms)]
    linear = [terms for terms in basis if _is_linear(terms)]
    spanned = [*basis, *(_product(a, b) for a, b in combinations_with_replacement(linear, 2)), *trivial]
    rank = _rank(spanned)
    for terms in sorted((terms for terms in candidates if not _is_linear(terms)), key=len):
        if _rank([*spanned, terms]) > rank:
            basis, spanned, rank = [*basis, terms], [*spanned, terms], rank + 1
    return basis


def _is_linear(terms: Terms) -> bool:
    return all(len(monomial.factors) <= 1 for monomial in terms)


def _product(a: Terms, b: Terms) -> Terms:
    product: dict[Monomial, Expr] = {}
    for (left, x), (right, y) in itertools.product(a.items(), b.items()):
        both = Monomial(left.power + right.power, tuple(sorted(left.factors + right.factors)))
        product[both] = product.get(both, sympy.S.Zero) + x * y
    return product


def _rank(candidates: Sequence[Terms]) -> int:
    """Return the rank of polynomials, with numbers in place of the parameters; roots of these may be complex."""
    columns = {monomial: k for k, monomial in enumerate({monomial: None for terms in candidates for monomial in terms})}
    constants = sorted(set().union(*(x.free_symbols for terms in candidates for x in terms.values())), key=str)
    numbers = {constant: sympy.Rational(prime(k + 5), 7) for k, constant in enumerate(constants)}
    matrix = np.zeros((len(candidates), len(columns)), dtype=complex)
    for k, terms in enumerate(candidates):
        for monomial, coefficient in terms.items():
            matrix[k, columns[monomial]] = complex(coefficient.xreplace(numbers))
    return int(np.linalg.matrix_rank(matrix)) if matrix.size else 0  # NumPy 1.26 has no rank of empty ones


NAMED_TERMS = 4


def name_of(system: MechanicalSystem, terms: Terms) -> tuple[str, Expr | int]:
    """Return the name of a momentum map, and the factor (a sign without rotations) with which it has this name."""
    m = system.dimension
    if system.rotations and (named := _rotation_name(system, terms)):
        return named
    turning = {a: x for a, x in terms.items() if len(a.factors) == 2 and a.factors[0] < m <= a.factors[1]}
    shifting = {
        k: {a.factors[0] - m: x for a, x in terms.items() if a.power == k and len(a.factors) == 1 and a.factors[0] >= m}
        for k in (0, 1, 2)
    }
    if turning:
        return _turning_name(system, turning)
    for k, kind in enumerate(("momentum", "boost", "acceleration")):
        if shifting[k]:
            return _shifting_name(system, kind, shifting[k]), -1 if k else 1
    return ("linear" if all(len(a.factors) <= 1 for a in terms) else "quadratic") + " invariant", 1


def _rotation_name(system: MechanicalSystem, terms: Terms) -> tuple[str, Expr] | None:
    """Return the name of an angular momentum of all or one of the rotations and bodies, and the factor for it."""
    for name, named_terms in {**total_angular_momentum(system), **rotation_columns(system)}.items():
        first, value = next(iter(named_terms.items()))
        factor = terms.get(first, sympy.S.Zero) / value
        if factor != 0 and terms == {monomial: factor * x for monomial, x in named_terms.items()}:
            return name, 1 / factor
    return None


def _turning_name(system: MechanicalSystem, turning: Terms) -> tuple[str, int]:
    """Return ``angular momentum z`` of all bodies, or the kind of a linear map with its coordinates."""
    m, bodies = system.dimension, bodies_of(system)
    for plane in planes_of(bodies):
        rotation = turn(m, bodies, plane)
        axis = f" {AXES[3 - sum(plane)]}" if len(bodies[0].columns) == 3 else ""
        first = turning.get(next(iter(rotation)), sympy.S.Zero)
        if turning == {monomial: first * x for monomial, x in rotation.items()}:
            return f"angular momentum{axis}", -1 if first.could_extract_minus_sign() else 1
    q = [coordinate.name for coordinate in system.coordinates]
    touched = sorted({i % m for a in turning for i in a.factors})
    scaled = [a.factors[0] == a.factors[1] - m for a in turning]
    kind = "linear symmetry" if any(scaled) else "angular momentum"
    kind = "scaling" if all(scaled) else kind
    return f"{kind} of {', '.join(_shown([q[i] for i in touched]))}", 1


def _shifting_name(system: MechanicalSystem, kind: str, shifts: Mapping[int, Expr]) -> str:
    """Return ``momentum of x``, ``linear momentum x`` of all bodies, ``momentum of q1 + q3``; likewise for boosts."""
    bodies, equal = bodies_of(system), set(shifts.values()) == {sympy.S.One}
    if len(bodies) > 1 and equal:
        for k, axis in enumerate(AXES[: len(bodies[0].columns)]):
            if set(shifts) == {body.columns[k] for body in bodies}:
                return f"{'linear momentum' if kind == 'momentum' else kind} {axis}"
    if equal and len(shifts) == system.dimension > 1:
        return f"{kind} of all coordinates"
    terms = [x * system.coordinates[i] for i, x in sorted(shifts.items())]
    return f"{kind} of {' + '.join(_shown([str(term) for term in terms])).replace('+ -', '- ')}"


def _shown(names: Sequence[str]) -> Sequence[str]:
    return names if len(names) <= NAMED_TERMS else [*names[: NAMED_TERMS - 1], "...", names[-1]]
