"""Free rotation of bodies with three different moments: the exact flow, against Taylor series in 50 digits."""

from operator import mul

import numpy as np
import pytest
from mpmath import mp, mpf
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen.codegen.native.building import PORTABLE_FLAGS

DIGITS = 50
BITS = 180
"""Bits after the point of the fixed-point numbers of Taylor series."""
TERMS = 40
BODY = sc.LagrangianSystem.from_text(
    "free body",
    rotations={"R": "omega"},
    lagrangian="(I1*omega_1**2 + I2*omega_2**2 + I3*omega_3**2)/2",
    parameters={"I1": 1.0, "I2": 2.0, "I3": 2.5},
)
ATTITUDE = [0.5, -0.5, 0.5, 0.5]
CASES = {
    "series": ((1, 2, 2.5), (0.3, -0.5, 2.0), 0.01),
    "doubling": ((1, 2, 2.5), (0.3, -0.5, 2.0), 0.6),
    "doubling, nearly symmetric": ((1, 1 + 1e-9, 2.5), (2.0, -0.5, 0.05), 1.6),
    "means": ((1, 2, 2.5), (0.3, -0.5, 2.0), 8.0),
    "means about the smallest moment": ((1, 2, 2.5), (-2.0, 0.5, 0.3), -8.0),
    "about the smallest moment": ((1, 2, 2.5), (2.0, 0.5, -0.3), -0.6),
    "other order": ((2.5, 1, 2), (0.3, -2.0, 0.4), 0.6),
    "descending order": ((2.5, 2, 1), (1.1, -0.4, 0.9), 7.0),
    "close to the separatrix": ((1, 2, 3), (0.8, 1.5, 0.4619), 2.0),
    "on the separatrix": ((1, 2, 4), (1.0, 1.0, 0.5), 4.0),
    "tumbling": ((1, 2, 3), (1e-6, 1.5, 1e-6), 9.0),
    "nearly symmetric": ((1, 1 + 1e-9, 2.5), (0.3, -0.5, 2.0), 3.0),
    "nearly symmetric, slender": ((0.4, 2.5, 2.5 - 1e-12), (0.3, -0.5, 2.0), 1.0),
    "nearly a sphere": ((1, 1 + 1e-9, 1 - 1e-9), (0.3, -0.5, 2.0), 3.0),
}


def product(a, b):
    """Return the product of two quaternions."""
    (w, x, y, z), (s, t, u, v) = a, b
    return [w * s - x * t - y * u - z * v, w * t + x * s + y * v - z * u, w * u - x * v + y * s + z * t,
            w * v + x * u - y * t + z * s]  # fmt: skip


def fixed(x):
    """Return a number times 2^BITS as an integer."""
    return int(mp.ldexp(mpf(x), BITS))


def exact(moments, momentum, attitude, t):
    """Return the quaternion and the angular momentum in the body at t, by Taylor series of Euler's equations."""
    with mp.workdps(DIGITS + 10):
        a, start = [fixed(1 / mpf(x)) for x in moments], [*map(fixed, attitude), *map(fixed, momentum)]
        most = max(abs(x / mpf(y)) for x, y in zip(momentum, moments, strict=True))
        parts = 1 + int(3 * abs(t) * most + 0.1)  # of no case at a whole number, where a difference would change it
        h = fixed(mpf(t) / parts)
    for _ in range(parts):
        series = [[x] for x in start]
        (w, x, y, z), Pi, omega = series[:4], series[4:], [[], [], []]
        for k in range(TERMS):
            for rate, inverse, values in zip(omega, a, Pi, strict=True):
                rate.append(inverse * values[k] >> BITS)
            one, two, three = omega
            turned = [
                -cauchy(x, one) - cauchy(y, two) - cauchy(z, three),
                cauchy(w, one) + cauchy(y, three) - cauchy(z, two),
                cauchy(w, two) + cauchy(z, one) - cauchy(x, three),
                cauchy(w, three) + cauchy(x, two) - cauchy(y, one),
            ]
            moved = [cauchy(Pi[j], omega[n]) - cauchy(Pi[n], omega[j]) for j, n in ((1, 2), (2, 0), (0, 1))]
            for values, rate, factor in zip(series, [*turned, *moved], [2] * 4 + [1] * 3, strict=True):
                values.append(rate // (factor * (k + 1)) >> BITS)
        start = [0] * 7
        for n in reversed(range(TERMS + 1)):
            start = [(value * h >> BITS) + values[n] for value, values in zip(start, series, strict=True)]
    with mp.workdps(DIGITS + 10):
        result = [mp.ldexp(mpf(x), -BITS) for x in start]
        return result[:4], result[4:]


def cauchy(x, y):
    """Return the last coefficient of the product of two series of equal length."""
    return sum(map(mul, x, reversed(y)))


def momenta(attitude, Pi):
    """Return p = 2 E(q) Pi of a unit quaternion."""
    return [2 * x for x in product(attitude, [0, *Pi])]


@pytest.fixture(scope="module")
def stepper():
    """Return the stepper of a free body by composition of order 8, a single drift."""
    return sc.compile_stepper(BODY, "composition:8", flags=QUICK_FLAGS)


@pytest.mark.rotated
@pytest.mark.parametrize("name", CASES)
def test_steps_equal_taylor_series_in_50_digits(stepper, name):
    moments, omega, h = CASES[name]
    Pi = [mpf(i) * mpf(w) for i, w in zip(moments, omega, strict=True)]
    q0, p0 = ATTITUDE, [float(x) for x in momenta(ATTITUDE, Pi)]
    q, p = stepper.step(q0, p0, h, parameters=moments)
    expected, last = exact(moments, Pi, q0, h)
    allowed = 3e-15 * max(1, abs(h) * max(map(abs, omega))) * (1e4 if name == "tumbling" else 1)
    allowed *= 50 if "separatrix" in name else 1
    np.testing.assert_allclose(q, np.array(expected, float), rtol=0, atol=allowed)
    np.testing.assert_allclose(p, np.array(momenta(expected, last), float), rtol=0, atol=10 * allowed)
    energies = [sum(x * x / i for x, i in zip(product([q[0], *-q[1:]], p)[1:], moments, strict=True)) for q, p in
                ((np.array(q0), np.array(p0)), (q, p))]  # fmt: skip
    assert energies[1] == pytest.approx(energies[0], rel=3e-15)
    back = stepper.step(q, p, -h, parameters=moments)
    np.testing.assert_allclose(np.ravel(back), [*q0, *p0], rtol=0, atol=20 * allowed)


@pytest.mark.second
def test_a_free_body_takes_one_drift(stepper):
    assert "LEAPS = 2 }" in stepper.source.code


@pytest.mark.second
def test_short_steps_add_up_without_loss(stepper):
    moments, h = (1, 2, 2.5), 2.0**-40
    p0 = [float(x) for x in momenta(ATTITUDE, [0.3, -1.0, 5.0])]
    run = stepper.start(ATTITUDE, p0, h=h, parameters=moments)
    run.advance(1000)
    expected, _ = exact(moments, [0.3, -1.0, 5.0], ATTITUDE, 1000 * h)
    change = np.array([x - mpf(y) for x, y in zip(expected, ATTITUDE, strict=True)], float)
    np.testing.assert_allclose(run.q - np.array(ATTITUDE) + run._compensation[0], change, rtol=1e-12, atol=0)


def test_rest_and_rotation_about_the_middle_axis_are_exact(stepper):
    moments = (1, 2, 3)
    q, p = stepper.step(ATTITUDE, [0, 0, 0, 0], 1e3, parameters=moments)
    assert [*q, *p] == [*ATTITUDE, 0, 0, 0, 0]
    for h in (0.1, 40.0):
        q, p = stepper.step([1, 0, 0, 0], [0, 0, 6, 0], h, parameters=moments)
        np.testing.assert_allclose(q, [np.cos(0.75 * h), 0, np.sin(0.75 * h), 0], rtol=0, atol=1e-15 * (1 + h))
        np.testing.assert_allclose(product([q[0], *-q[1:]], p), [0, 0, 6, 0], rtol=0, atol=2e-15)


@pytest.mark.full
def test_tangents_are_differences_in_extended_precision_and_symplectic(stepper):
    for name in ("doubling", "on the separatrix", "nearly symmetric", "means"):
        moments, omega, h = CASES[name]
        Pi = [mpf(i) * mpf(w) for i, w in zip(moments, omega, strict=True)]
        p0 = momenta(ATTITUDE, Pi)
        tangent = stepper.jacobian(ATTITUDE, [float(x) for x in p0], h, parameters=moments)
        size = np.abs(tangent).max()
        form = np.block([[np.zeros((4, 4)), np.eye(4)], [-np.eye(4), np.zeros((4, 4))]])
        np.testing.assert_allclose(tangent.T @ form @ tangent, form, rtol=0, atol=1e-14 * size**2)
        with mp.workdps(DIGITS):
            for column in (1, 6):
                ends = []
                for change in (mpf(10) ** -20, -(mpf(10) ** -20)):
                    z = [*map(mpf, ATTITUDE), *p0]
                    z[column] += change
                    conjugate = [z[0], -z[1], -z[2], -z[3]]
                    body = [x / 2 for x in product(conjugate, z[4:])[1:]]
                    g, _ = exact(moments, body, [1, 0, 0, 0], h)
                    ends.append([*product(z[:4], g), *product(z[4:], g)])
                expected = [float((x - y) / (2 * mpf(10) ** -20)) for x, y in zip(*ends, strict=True)]
                np.testing.assert_allclose(tangent[:, column], expected, rtol=0, atol=3e-14 * size)


@pytest.mark.second
def test_lanes_by_different_formulas_have_the_bits_of_single_runs():
    stepper = sc.compile_stepper(BODY, "composition:8", flags=(*PORTABLE_FLAGS, "-march=native"))  # lanes of a register
    assert stepper.ensemble is not None
    resting = [((1, 2, 3), (0, 1.5, 0)), ((1, 2, 3), (0, 0, 0))]
    symmetric = [(moments, (0.3, -1.5, 0.4)) for moments in ((1, 2, 2), (2, 1, 2), (2, 2, 1), (2, 2, 2))]
    bodies = [*(case[:2] for case in CASES.values()), *resting, *symmetric]
    p = np.array([momenta(ATTITUDE, map(mul, *body)) for body in bodies], float)
    parameters = dict(zip(stepper.parameters, np.transpose([moments for moments, _ in bodies]), strict=True))
    for h in (0.01, 0.6, 1.6, 8.0):
        runs = stepper.integrate_ensemble(np.tile(ATTITUDE, (len(p), 1)), p, h=h, steps=3, parameters=parameters)
        for j, (moments, _) in enumerate(bodies):
            run = stepper.integrate(ATTITUDE, p[j], h=h, steps=3, parameters=moments)
            assert np.array_equal([runs.q[:, j], runs.p[:, j]], [run.q, run.p])
