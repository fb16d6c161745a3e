"""Proofs about the tables of all methods, in rationals and in ball arithmetic (python-flint).

A method on nodes c_i, the roots of a polynomial M with rational coefficients, has rational moments
Q(n) = sum_i b_i c_i^n = int_0^1 (x^n mod M) dx. Collocation satisfies C(s), hence sum_ij b_i c_i^k a_ij c_j^l =
Q(k + l + 1) / (l + 1). The matrices (c_i^k) and (b_i) are regular, so that conditions on all i, j are conditions on
moments, which integers decide (Hairer, Lubich & Wanner, Geometric Numerical Integration, II.1, IV.2).
"""

from collections.abc import Callable
from itertools import pairwise
from math import comb, factorial, prod
from typing import Any

import pytest

import scvi_codegen as sc
from scvi_codegen.methods.composition import FIRST_HALVES
from scvi_codegen.methods.tables.quadrature import QUADRATURE_FAMILIES, quadrature_by_name
from scvi_codegen.methods.tables.tableau import TABLEAU_FAMILIES, tableau_by_name

flint = pytest.importorskip("flint")
arb, fmpq, fmpq_poly = flint.arb, flint.fmpq, flint.fmpq_poly

SIZES = range(1, 9)
X, ONE = fmpq_poly([0, 1]), fmpq_poly([1])


def legendre(s: int) -> Any:
    return fmpq_poly([fmpq((-1) ** (s + k) * comb(s, k) * comb(s + k, k)) for k in range(s + 1)])


def chebyshev(s: int, second: bool) -> Any:
    before, now, x = ONE, (2 if second else 1) * (2 * X - 1), 2 * X - 1
    for _ in range(s - 1):
        before, now = now, 2 * x * now - before
    return now if s else ONE


NODES: dict[str, Callable[[int], Any]] = {
    "gauss": legendre,
    "radau-iia": lambda s: legendre(s) - legendre(s - 1),
    "radau-ia": lambda s: legendre(s) + legendre(s - 1),
    "lobatto-iiia": lambda s: X * (1 - X) * legendre(s - 1).derivative(),
    "lobatto-iiib": lambda s: X * (1 - X) * legendre(s - 1).derivative(),
    "chebyshev-gauss": lambda s: chebyshev(s, second=False),
    "chebyshev-lobatto": lambda s: X * (1 - X) * chebyshev(s - 2, second=True),
}
"""Polynomial of the abscissae on [0, 1], by family of tableaux."""
PARTNERS = ("radau-ia", "lobatto-iiib")  # b_i a^_ij = b_i b_j - b_j a_ji of the collocation on the same nodes
CASES = [(name, s) for name in TABLEAU_FAMILIES for s in SIZES if s > 1 or "obatto" not in name]


def integral(p: Any) -> Any:
    primitive = p.integral()
    return primitive(fmpq(1)) - primitive(fmpq(0))


class Moments:
    """Moments of a tableau on the roots of a polynomial."""

    def __init__(self, name: str, s: int) -> None:
        self.polynomial, self.s, self.partner = NODES[name](s), s, name in PARTNERS
        assert self.polynomial.degree() == s
        assert self.polynomial.gcd(self.polynomial.derivative()).degree() == 0  # distinct nodes

    def Q(self, n: int) -> Any:
        return integral(X**n % self.polynomial)

    def A(self, k: int, n: int) -> Any:
        """Return sum_ij b_i c_i^k a_ij c_j^n."""
        if self.partner:
            return self.Q(k) * self.Q(n) - self.Q(k + n + 1) / (k + 1)
        return self.Q(k + n + 1) / (n + 1)

    @property
    def quadrature(self) -> int:
        """Largest p of the simplifying condition B(p)."""
        p = 0
        while self.Q(p) == fmpq(1, p + 1):
            p += 1
        return p

    def C(self, n: int) -> bool:
        return all(self.A(k, n - 1) == self.Q(k + n) / n for k in range(self.s))

    def D(self, n: int) -> bool:
        return all(self.A(n - 1, k) == (self.Q(k) - self.Q(n + k)) / n for k in range(self.s))

    @property
    def order(self) -> int:
        """Order by Butcher's theorem: B(p), C(eta), D(zeta), p <= eta + zeta + 1 and p <= 2 eta + 2."""
        eta, zeta = (
            next(n for n in range(self.s + 1) if n == self.s or not holds(n + 1)) for holds in (self.C, self.D)
        )
        return min(self.quadrature, eta + zeta + 1, 2 * eta + 2)

    @property
    def symplectic(self) -> bool:
        pairs = ((k, n) for k in range(self.s) for n in range(self.s))
        return all(self.A(k, n) + self.A(n, k) == self.Q(k) * self.Q(n) for k, n in pairs)

    @property
    def symmetric(self) -> bool:
        """Return whether c_i and 1 - c_i are nodes; b and the A of collocation and of its partner follow."""
        mirrored = self.polynomial(1 - X)
        return mirrored in (self.polynomial, -self.polynomial)


@pytest.mark.parametrize(("name", "s"), CASES)
def test_order_symplecticity_and_symmetry_of_tableaux_are_those_proved_in_rationals(name: str, s: int) -> None:
    tableau, proved = tableau_by_name(f"{name}:{s}"), Moments(name, s)
    assert (tableau.order, tableau.is_symplectic) == (proved.order, proved.symplectic)
    assert tableau.is_symmetric == proved.symmetric


@pytest.mark.parametrize("s", range(2, 9))
def test_work_of_scvi_has_order_s_plus_1_on_chebyshev_lobatto_nodes_and_more_on_gauss_abscissae(s: int) -> None:
    """The leading error of the work of a step is h^(s + 2) times the integral of (x - 1/2) M; see docs/conserved.md."""
    nodes = NODES["chebyshev-lobatto"](s + 1)
    M, rest = divmod(nodes, X)  # the first node carries no equation
    assert not rest
    assert [float(x) for x in sc.SCVI(s).tableau.c] == pytest.approx(
        sorted(float(r.real) for r, _ in M.complex_roots())
    )
    assert integral((X - fmpq(1, 2)) * M) != 0
    assert integral((X - fmpq(1, 2)) * NODES["gauss"](s)) == 0


@pytest.mark.rotated
def test_leading_error_of_the_work_of_scvi_is_that_of_the_integral() -> None:
    """For q'' = -q - q', force -q', it is -h^4 v'' v'/24: the integral of (x - 1/2)^2 (x - 1) is -1/24."""
    damped = sc.LagrangianSystem.from_text("damped", ["q"], "q_dot**2/2 - q**2/2", forces={"q": "-q_dot"})
    run = sc.compile_stepper(damped, sc.SCVI(2)).integrate([1.0], velocity=[0.5], h=0.01, steps=1)
    fine = sc.compile_stepper(damped, "svi:4").integrate([1.0], velocity=[0.5], h=0.01, steps=1)
    assert (run.work()[-1] - fine.work()[-1]) / 0.01**4 == pytest.approx(1.0 * -1.5 / -24, rel=0.02)


def rational(x: Any) -> Any:
    numerator, denominator = x.as_integer_ratio() if isinstance(x, float) else (None, None)
    if numerator is not None:
        return fmpq(numerator, denominator)
    sign, mantissa, exponent, _ = x._mpf_
    return (-1) ** sign * fmpq(int(mantissa)) * fmpq(2) ** int(exponent)


@pytest.mark.parametrize(("name", "s"), CASES)
def test_tables_of_sixty_digits_are_those_of_the_proofs(name: str, s: int) -> None:
    """The nodes are roots of the polynomial, in balls; b and A are the integrals of the cardinal functions there."""
    polynomial, tableau, bits = NODES[name](s), tableau_by_name(f"{name}:{s}"), flint.ctx.prec
    flint.ctx.prec = 300
    try:
        c = sorted((root.real for root, _ in polynomial.complex_roots()), key=lambda ball: float(ball.mid()))
        assert all(left < right for left, right in pairwise(c))
        powers = flint.arb_mat(s, s, [c[j] ** k for k in range(s) for j in range(s)])
        rows = flint.arb_mat(s, s + 1, [(*c, arb(1))[i] ** (k + 1) / (k + 1) for k in range(s) for i in range(s + 1)])
        cardinal = powers.solve(rows)  # column i: integrals to c_i; the last: weights
        b = [cardinal[j, s] for j in range(s)]
        A = [[cardinal[j, i] for j in range(s)] for i in range(s)]
        if name in PARTNERS:
            A = [[b[j] - b[j] * A[j][i] / b[i] for j in range(s)] for i in range(s)]
        numbers = [*zip(tableau.c, c, strict=True), *zip(tableau.b, b, strict=True)]
        numbers += [pair for i in range(s) for pair in zip(tableau.A[i], A[i], strict=True)]
        assert all(abs(arb(rational(value)) - ball) < arb("1e-57") for value, ball in numbers)
        assert all(ball.rad() < arb("1e-70") for _, ball in numbers)  # the comparison is not empty
    finally:
        flint.ctx.prec = bits


RULES: dict[str, tuple[str, int]] = {
    "gauss-legendre": ("gauss", 1),
    "gauss-lobatto": ("lobatto-iiia", 1),
    "gauss-radau-left": ("radau-ia", 1),
    "gauss-radau-right": ("radau-iia", 1),
    "clenshaw-curtis": ("chebyshev-lobatto", 1),
    "fejer": ("chebyshev-gauss", 1),
    **{name: ("lobatto-iiia", 1 + k) for k, name in enumerate(("hermite", "hermite-2", "hermite-3"), 1)},
}
"""Polynomial of the points of each quadrature, and its power: the number of values and derivatives at each point."""


@pytest.mark.parametrize("family", QUADRATURE_FAMILIES)
def test_orders_of_quadratures_are_those_proved_in_rationals(family: str) -> None:
    """A rule integrates p mod M^k, the (Hermite) interpolant at the roots of M; so its order follows from integers."""
    name, power = RULES[family]
    bits = flint.ctx.prec
    flint.ctx.prec = 300
    try:
        for n in SIZES if name in ("gauss", "radau-ia", "radau-iia", "chebyshev-gauss") else SIZES[1:]:
            rule, M = quadrature_by_name(f"{family}:{n}"), NODES[name](n)
            order = next(p for p in range(100) if integral(X**p % M**power) != fmpq(1, p + 1))
            assert rule.order == order
            points = [(arb(rational(x)) + 1) / 2 for x in rule.points]
            roots = sorted((root.real for root, _ in M.complex_roots()), key=lambda ball: float(ball.mid()))
            assert all(abs(x - root) < arb("1e-57") for x, root in zip(points, roots, strict=True))
            lines = (rule.weights, *rule.derivative_weights)
            for k in range(n * power):  # the weights, of functions on [-1, 1], are the solution of the interpolation
                total = arb(0)
                for j, line in enumerate(lines):
                    x = (2 * root - 1 for root in roots)
                    if k >= j:
                        terms = (
                            arb(rational(w)) * prod([y] * (k - j), start=arb(1)) for w, y in zip(line, x, strict=True)
                        )
                        total += sum(terms, arb(0)) * factorial(k) / factorial(k - j)
                assert abs(total - arb(1 + (-1) ** k) / (k + 1)) < arb("1e-50")
    finally:
        flint.ctx.prec = bits


VARIATIONAL = [
    *(sc.SVI(s) for s in SIZES),
    *(sc.SVI(s, quadrature=f"{family}:{s + 1}") for s in (1, 3, 6) for family in QUADRATURE_FAMILIES),
    *(sc.SCVI(s) for s in range(1, 7)),
    *(sc.SCVI(s, quadrature=f"{family}:{s + 1}") for s in (1, 3) for family in QUADRATURE_FAMILIES),
    sc.SCVI(4, quadrature="gauss-lobatto:4"),
]


@pytest.mark.parametrize("method", VARIATIONAL, ids=lambda each: each.name)
def test_compiled_tables_have_a_generating_function_exactly(method: Any) -> None:
    """The rows of the momenta are derivatives of sum w_n L at fixed q1: E_b g_0 - G_b, exactly in the rounded numbers.

    E is the row of q1 and (g_0, G) those of the arguments of L and of the multiplied conditions, as functions of q0 and
    of the unknowns: p0 = -D1 L_d and p1 = D2 L_d then hold for any numbers, and the map is symplectic.
    """
    stages = method.stage_system(sc.problem("kepler").system)
    E = [rational(x) for x in stages.end_position.entries[0][1:]]
    for group in stages.stage_groups:
        for gather, scatter in zip(group.gathers, group.scatters, strict=True):
            for row, known in zip(gather.table.entries, scatter.table.entries, strict=True):
                g, *G = map(rational, row)
                assert [rational(x) for x in known] == [*(e * g - x for e, x in zip(E, G, strict=True)), g]


@pytest.mark.parametrize("s", SIZES)
def test_compiled_weights_are_those_of_the_positions_but_tables_are_rounded(s: int) -> None:
    stages = sc.SVI(s).stage_system(sc.problem("kepler").system)
    (group,), shape = stages.stage_groups, stages.shape
    beta = [rational(x) for x in stages.end_position.entries[0][1:]]
    weights = [rational(x) for x in group.weights]
    assert sum(weights, fmpq(0)) == 1
    assert weights == beta
    A = [[rational(x) for x in line] for line in shape.position]
    defects = [abs(beta[i] * A[i][j] + beta[j] * A[j][i] - beta[i] * beta[j]) for i in range(s) for j in range(s)]
    assert (max(defects) == 0) == (s <= 2)
    assert max(defects) < fmpq(1, 10**16)


Series = dict[tuple[int, ...], Any]


def product(left: Series, right: Series, degree: int) -> Series:
    """Return the product of series in words of generators A_1, A_3, .., whose degrees are their indices."""
    result: Series = {}
    for one, a in left.items():
        for other, b in right.items():
            if sum(one) + sum(other) <= degree:
                result[one + other] = result.get(one + other, arb(0)) + a * b
    return result


def leapfrog(gamma: Any, degree: int) -> Series:
    """Return exp(gamma A_1 + gamma^3 A_3 + ..), the exponential of a symmetric step."""
    logarithm: Series = {(k,): gamma**k for k in range(1, degree + 1, 2)}
    term: Series = {(): arb(1)}
    total = dict(term)
    for n in range(1, degree + 1):
        term = {word: value / n for word, value in product(term, logarithm, degree).items()}
        for word, value in term.items():
            total[word] = total.get(word, arb(0)) + value
    return total


@pytest.mark.parametrize("order", sorted(FIRST_HALVES))
def test_compositions_have_their_order_in_a_free_algebra(order: int) -> None:
    """All words up to the order have the coefficients of exp(A_1), within the digits of the tables; others not."""
    half = [fmpq(int(x.replace(".", "")), 10 ** len(x.partition(".")[2])) for x in FIRST_HALVES[order]]
    gammas = [*half, 1 - 2 * sum(half, fmpq(0)), *half[::-1]]
    degree, bits = order + 1, flint.ctx.prec
    flint.ctx.prec = 200
    try:
        total: Series = {(): arb(1)}
        factors = {gamma: leapfrog(arb(gamma), degree) for gamma in set(gammas)}
        for gamma in gammas:
            total = product(total, factors[gamma], degree)
        defects = {
            word: abs(value - (arb(1) / factorial(sum(word)) if set(word) <= {1} else 0))
            for word, value in total.items()
        }
        assert all(defect < arb("1e-23") for word, defect in defects.items() if sum(word) <= order)
        assert any(defect > arb("1e-7") for word, defect in defects.items() if sum(word) == degree)
    finally:
        flint.ctx.prec = bits
