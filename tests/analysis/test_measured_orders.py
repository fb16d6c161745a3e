"""Orders of SVI for pairs of degree and quadrature: claimed, and measured by a step of its own.

The step makes the action of a pendulum along a polynomial stationary, with polynomials and quadrature in 80 digits and
Newton's method, and is compared with the Taylor solution of the equation of motion. It shares the points and the
weights of the quadrature with the package, and nothing else.
"""

from functools import cache

import mpmath
import pytest
from mpmath import mp

import scvi_codegen as sc
from scvi_codegen.methods.tables.quadrature import quadrature_by_name

DIGITS = 80
STEPS = mp.mpf(1) / 64, mp.mpf(1) / 128
START = mp.mpf("0.8"), mp.mpf("0.6")
FAMILIES = ("gauss-legendre", "gauss-lobatto", "gauss-radau-left", "clenshaw-curtis", "fejer")
PAIRS = [
    (family, degree, points)
    for family in FAMILIES
    for degree in range(1, 7)
    for points in range(max(degree, 2), degree + 5)
]


@cache
def exact(h: mpmath.mpf) -> tuple[mpmath.mpf, mpmath.mpf]:
    """Return the state of the pendulum at h by the Taylor series of q, sin q and cos q (q'' = -sin q)."""
    with mp.workdps(DIGITS):
        q, sine, cosine = list(START), [mp.sin(START[0])], [mp.cos(START[0])]
        for n in range(60):  # (sin q)' = q' cos q, (cos q)' = -q' sin q
            rates = [(k + 1) * q[k + 1] for k in range(n + 1)]
            sine.append(mp.fsum(rates[k] * cosine[n - k] for k in range(n + 1)) / (n + 1))
            cosine.append(-mp.fsum(rates[k] * sine[n - k] for k in range(n + 1)) / (n + 1))
            q.append(-sine[n] / ((n + 1) * (n + 2)))
        return mp.polyval(q[::-1], h), mp.polyval([k * q[k] for k in range(len(q) - 1, 0, -1)], h)


def step(degree: int, points: tuple, weights: tuple, h: mpmath.mpf) -> tuple[mpmath.mpf, mpmath.mpf]:
    """Return the end of a step: q(x h) = q0 + h sum_k a_k x^k, k = 1 .. degree, with a stationary action.

    The conditions are sum_n b_n (v dv + h f dq) = -p0 dq(0) for the variations dq = 1 - x and x^i - x; p1 follows from
    the variation 1.
    """
    q0, p0 = START
    a = mp.matrix([p0, *[0] * (degree - 1)])
    powers = range(1, degree + 1)
    for _ in range(12):
        residual, jacobian = mp.matrix(degree, 1), mp.matrix(degree, degree)
        total = mp.mpf(0)
        for x, b in zip(points, weights, strict=True):
            q = q0 + h * mp.fsum(a[k - 1] * x**k for k in powers)
            v = mp.fsum(k * a[k - 1] * x ** (k - 1) for k in powers)
            f, df = -mp.sin(q), -mp.cos(q)
            total += b * f
            for i in powers:  # variations x^i - x, which vanish at both ends, and 1 - x, whose momentum is p0
                dq, dv = (1 - x, mp.mpf(-1)) if i == 1 else (x**i - x, i * x ** (i - 1) - 1)
                residual[i - 1] += b * (v * dv + h * f * dq)
                for k in powers:
                    jacobian[i - 1, k - 1] += b * (k * x ** (k - 1) * dv + h * h * df * x**k * dq)
        residual[0] += p0
        change = mp.lu_solve(jacobian, residual)
        a -= change
        if mp.norm(change) < mp.mpf(10) ** (10 - DIGITS):
            break
    return q0 + h * mp.fsum(a), p0 + h * total


def measured(degree: int, quadrature: str) -> float:
    """Return the order from the errors of one step of two sizes."""
    rule = quadrature_by_name(quadrature)
    with mp.workdps(DIGITS):
        points = tuple((x + 1) / 2 for x in rule.points)
        weights = tuple(w / 2 for w in rule.weights)
        errors = []
        for h in STEPS:
            end = step(degree, points, weights, h)
            errors.append(max(abs(x - y) for x, y in zip(end, exact(h), strict=True)))
        return float(mp.log(errors[0] / errors[1], 2)) - 1


@pytest.mark.sampled(8)
@pytest.mark.parametrize(("family", "degree", "points"), PAIRS)
def test_claimed_order_is_measured(family: str, degree: int, points: int) -> None:
    method = sc.SVI(degree, f"{family}:{points}")
    assert measured(degree, f"{family}:{points}") == pytest.approx(method.order, abs=0.2)
