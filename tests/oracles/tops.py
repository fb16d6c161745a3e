"""Exact attitudes of the free and of the Lagrange top in 30 digits, by Jacobi's elliptic functions.

One angle is an elliptic function of time; the others are integrals of functions of it, by quadrature of mpmath (E. T.
Whittaker, *Analytical Dynamics*, sections 69 to 72). Nothing of the package occurs.
"""

import numpy as np
from mpmath import mp

DIGITS = 30


def _turn(axis, angle):
    c, s = mp.cos(angle), mp.sin(angle)
    return mp.matrix([[1, 0, 0], [0, c, -s], [0, s, c]] if axis == 1 else [[c, -s, 0], [s, c, 0], [0, 0, 1]])


def _zxz(phi, theta, psi):
    return _turn(3, phi) * _turn(1, theta) * _turn(3, psi)


def _integral(function, t):
    return mp.quad(function, mp.linspace(0, t, max(2, int(4 * t))))


def _numbers(matrix):
    return np.array(matrix.tolist(), dtype=float)


def free_top(moments, omega, attitude, t):
    """Return R and omega at t of a free body with I1 < I2 < I3, L^2 > 2 E I2 and omega_3 > 0; attitude is R(0)."""
    with mp.workdps(DIGITS):
        inertia, start = [mp.mpf(each) for each in moments], [mp.mpf(float(each)) for each in omega]
        one, two, three = inertia
        energy = sum(i * w**2 for i, w in zip(inertia, start, strict=True))
        square = sum((i * w) ** 2 for i, w in zip(inertia, start, strict=True))
        assert square > energy * two
        assert start[2] > 0
        rate = mp.sqrt((three - two) * (square - energy * one) / (one * two * three))
        modulus = (two - one) * (energy * three - square) / ((three - two) * (square - energy * one))
        amplitudes = [
            mp.sqrt((energy * three - square) / (one * (three - one))),
            mp.sqrt((energy * three - square) / (two * (three - two))),
            mp.sqrt((square - energy * one) / (three * (three - one))),
        ]
        phase = mp.ellipf(mp.asin(start[1] / amplitudes[1]), modulus)
        phase = 2 * mp.ellipk(modulus) - phase if start[0] < 0 else phase

        def momentum(time):
            values = [mp.ellipfun(name, rate * time + phase, m=modulus) for name in ("cn", "sn", "dn")]
            return [i * a * each for i, a, each in zip(inertia, amplitudes, values, strict=True)]

        def precession(time):
            x, y, _ = momentum(time)
            return mp.sqrt(square) * (x**2 / one + y**2 / two) / (x**2 + y**2)

        def to_momentum(time, angle):
            """Return the matrix from the body frame to a frame whose third axis is the angular momentum."""
            x, y, z = momentum(time)
            return _zxz(angle, mp.acos(z / mp.sqrt(square)), mp.atan2(x, y))

        t = mp.mpf(t)
        end = to_momentum(mp.mpf(0), mp.mpf(0)).T * to_momentum(t, _integral(precession, t))
        return attitude @ _numbers(end), np.array([float(m / i) for m, i in zip(momentum(t), inertia, strict=True)])


def lagrange_top(moments, weight, angles, omega, t):
    """Return R and omega at t of a top with moments (A, A, C) and the potential weight R_33, from zxz angles at 0."""
    with mp.workdps(DIGITS):
        a, c, w = mp.mpf(moments[0]), mp.mpf(moments[1]), mp.mpf(weight)
        phi, theta, psi = (mp.mpf(float(each)) for each in angles)
        rates = [mp.mpf(float(each)) for each in omega]
        tilting = rates[0] * mp.cos(psi) - rates[1] * mp.sin(psi)
        turning = (rates[0] * mp.sin(psi) + rates[1] * mp.cos(psi)) / mp.sin(theta)
        spin, u0 = c * rates[2], mp.cos(theta)
        vertical = a * mp.sin(theta) ** 2 * turning + spin * u0
        energy = a * (rates[0] ** 2 + rates[1] ** 2) / 2 + w * u0
        # u = cos theta: u_dot^2 = 2 (energy - w u) (1 - u^2)/a - (vertical - spin u)^2/a^2
        cubic = [
            2 * w / a,
            -2 * energy / a - (spin / a) ** 2,
            -2 * w / a + 2 * vertical * spin / a**2,
            2 * energy / a - (vertical / a) ** 2,
        ]
        low, high, third = sorted(root.real for root in mp.polyroots(cubic, maxsteps=200, extraprec=100))
        modulus, rate = (high - low) / (third - low), mp.sqrt(w * (third - low) / (2 * a))
        phase = mp.ellipf(mp.asin(mp.sqrt(min(max((u0 - low) / (high - low), 0), 1))), modulus) * mp.sign(-tilting)

        def height(time):
            return low + (high - low) * mp.ellipfun("sn", rate * time + phase, m=modulus) ** 2

        def precession(time):
            u = height(time)
            return (vertical - spin * u) / (a * (1 - u**2))

        t = mp.mpf(t)
        phi += _integral(precession, t)
        psi += _integral(lambda time: rates[2] - precession(time) * height(time), t)
        sine = mp.sqrt(1 - height(t) ** 2)
        sn, cn, dn = (mp.ellipfun(name, rate * t + phase, m=modulus) for name in ("sn", "cn", "dn"))
        turning, tilting = precession(t), -2 * (high - low) * rate * sn * cn * dn / sine
        across = [
            turning * sine * mp.sin(psi) + tilting * mp.cos(psi),
            turning * sine * mp.cos(psi) - tilting * mp.sin(psi),
        ]
        return _numbers(_zxz(phi, mp.acos(height(t)), psi)), np.array([float(each) for each in (*across, rates[2])])
