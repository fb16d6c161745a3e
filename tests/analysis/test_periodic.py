"""Periodic orbits: published ones, closed forms, monodromies by DOP853, and what is no orbit."""

import warnings

import numpy as np
import pytest
from notation import lagrange
from numpy.testing import assert_allclose
from samples import earth_and_moon
from scipy.integrate import solve_ivp
from scipy.special import ellipk

import scvi_codegen as sc

EARTH_MOON = 1.215058560962404e-2
HALO = ([1.142732397667005, 0.0, 0.15915200933380999], [0.0, -0.22233902828510901, 0.0], 3.1327035113287223)
"""Position, velocity and period of a northern halo orbit about L2 in the catalogue of three-body periodic orbits of the
Jet Propulsion Laboratory (ssd.jpl.nasa.gov/tools/periodic_orbits.html)."""


@pytest.fixture(scope="module")
def restricted():
    """Three bodies in the rotating frame, by its Lagrangian."""
    return sc.compile_stepper(earth_and_moon(), sc.SVI(6))


@pytest.fixture(scope="module")
def planar():
    system = lagrange(
        "planar restricted three-body problem",
        "x y",
        "((x_dot - y)**2 + (y_dot + x)**2)/2 + (1 - mu)/sqrt((x + mu)**2 + y**2) + mu/sqrt((x - 1 + mu)**2 + y**2)",
        mu=0.01215,
    )
    return sc.compile_stepper(system, sc.SVI(8))


@pytest.fixture(scope="module")
def galaxy():
    return sc.compile_stepper(sc.problem("henon-heiles").system, sc.SVI(4))


@pytest.mark.rotated
def test_a_halo_orbit_is_the_published_one(restricted):
    """From a guess with an error in the third digit to ten digits; its monodromy is compared with DOP853."""
    x, v, period = HALO
    guess = [1.001 * x[0], 0.0, x[2]], [0.0, 0.998 * v[1], 0.0]
    orbit = sc.periodic_orbit(
        restricted, guess[0], velocity=guess[1], period=1.001 * period, steps=200, fixed=["y", "z"]
    )
    assert_allclose(orbit.q, x, rtol=0, atol=1e-10)
    assert_allclose(restricted.velocity(orbit.q, orbit.p), v, rtol=0, atol=1e-10)
    assert orbit.period == pytest.approx(period, abs=1e-10)
    assert orbit.residual < 1e-12
    assert orbit.reciprocal_error < 1e-7
    assert orbit.symplectic_error < 1e-13
    assert not orbit.stable
    assert_allclose(orbit.monodromy, _monodromy(orbit), rtol=0, atol=1e-8 * np.abs(orbit.monodromy).max())
    greatest = orbit.multipliers[0].real
    assert orbit.stability_indices[0] == pytest.approx((greatest + 1 / greatest) / 2, rel=1e-9)
    assert np.abs(orbit.stability_indices - 1.0).min() < 1e-9
    assert len(orbit.run(save_every=50)) == 5


@pytest.mark.rotated
def test_the_error_of_equal_steps_is_reported(restricted):
    """A near-rectilinear halo orbit about L2 in 60 steps, compared with adaptive ones, which DOP853 closes."""
    guess = {"velocity": [0.0, -0.1033, 0.0], "period": 1.5112, "fixed": ["y", "z"]}
    orbit = sc.periodic_orbit(restricted, [1.0220, 0.0, -0.1821], **guess)
    z = np.concatenate([orbit.q, orbit.p])
    end = solve_ivp(_motion, (0, orbit.period), z, method="DOP853", rtol=1e-13, atol=1e-15).y[:, -1]
    assert_allclose(end, z, rtol=0, atol=1e-9)
    assert orbit.error < 1e-9
    assert np.abs(orbit.multiplier_errors[0]) < 1e-8  # of the pair at 1, which is multiple, half of the digits
    with pytest.warns(sc.AccuracyWarning, match="its 60 steps rather"):
        coarse = sc.periodic_orbit(restricted, orbit.q, orbit.p, period=orbit.period, steps=60, fixed=["y", "z"])
    assert coarse.residual < 1e-12
    assert coarse.error == pytest.approx(abs(coarse.period / orbit.period - 1), rel=0.5)
    assert np.abs(coarse.stability_indices - 1.0).min() > 0.1


def _motion(t, z):
    """Return the rates of positions and momenta: p = v + (-y, x, 0), H = p^2/2 + y p_x - x p_y - .."""
    (x, y, w), p = z[:3], z[3:]
    v = np.array([p[0] + y, p[1] - x, p[2]])
    near, far = (x + EARTH_MOON, y, w), (x - 1 + EARTH_MOON, y, w)
    pull = sum(m * np.array(r) / np.linalg.norm(r) ** 3 for m, r in ((1 - EARTH_MOON, near), (EARTH_MOON, far)))
    return [*v, p[1] - pull[0], -p[0] - pull[1], -pull[2]]


def _monodromy(orbit):
    """Return the monodromy by differences of motions by DOP853."""

    def end(z):
        return solve_ivp(_motion, (0, orbit.period), z, method="DOP853", rtol=1e-13, atol=1e-15).y[:, -1]

    start = np.concatenate([orbit.q, orbit.p])
    columns = []
    for unit in 1e-5 * np.eye(6):
        a, b, c, d = (end(start + s * unit) for s in (1, -1, 2, -2))
        columns.append((8 * (a - b) - (c - d)) / 12e-5)
    return np.array(columns).T


@pytest.mark.second
def test_pendulum_period_is_the_elliptic_integral():
    """The amplitude held, then the period, then the energy; and one that turns over."""
    pendulum = sc.compile_stepper(sc.problem("planar-pendulum").system, sc.SVI(8))
    values = {"m": 1.0, "l": 1.0, "g": 1.0}
    exact = 4 * ellipk(np.sin(0.5) ** 2)
    amplitude = sc.periodic_orbit(pendulum, [1.0], [0.1], period=7.0, steps=60, fixed=["q"], parameters=values)
    at_rest = sc.periodic_orbit(pendulum, [1.0], [0.0], period=7.0, steps=60, fixed=["q", "p_q"], parameters=values)
    assert at_rest.period == pytest.approx(exact, rel=1e-12)
    assert amplitude.period > exact
    timed = sc.periodic_orbit(
        pendulum, [1.1], [0.0], period=exact, steps=60, fixed=["p_q"], fixed_period=True, parameters=values
    )
    assert timed.q[0] == pytest.approx(1.0, abs=1e-9)
    weighed = sc.periodic_orbit(pendulum, [0.9], [0.05], period=6.5, steps=60, energy=-np.cos(1.0), parameters=values)
    assert weighed.period == pytest.approx(exact, rel=1e-11)
    assert weighed.energy == pytest.approx(-np.cos(1.0), abs=1e-12)
    assert weighed.stable
    assert_allclose(weighed.stability_indices, [1.0], rtol=0, atol=1e-10)
    over = sc.periodic_orbit(
        pendulum, [0.0], [2.5], period=3.0, steps=60, fixed=["q", "p_q"], gain=[2 * np.pi], parameters=values
    )
    assert over.period == pytest.approx(2 * 2 / 2.5 * ellipk((2 / 2.5) ** 2), rel=1e-11)


@pytest.mark.rotated
def test_adaptive_steps_reach_the_bound(galaxy, restricted):
    """Periods by K(k), a published halo orbit, and an orbit of Henon-Heiles by equal steps."""
    pendulum = sc.compile_stepper(sc.problem("planar-pendulum").system, sc.SVI(8))
    values = {"m": 1.0, "l": 1.0, "g": 1.0}
    for amplitude in (0.1, 1.0, 3.0):
        at = {"fixed": ["q", "p_q"], "parameters": values, "error": 1e-12}
        exact = 4 * ellipk(np.sin(amplitude / 2) ** 2)
        orbit = sc.periodic_orbit(pendulum, [amplitude], [0.0], period=1.05 * exact, **at)
        assert orbit.period == pytest.approx(exact, rel=1e-12)
        assert orbit.error < 1e-12
    over = sc.periodic_orbit(
        pendulum, [0.0], [2.5], period=3.0, fixed=["q", "p_q"], gain=[2 * np.pi], parameters=values
    )
    assert over.period == pytest.approx(2 * 2 / 2.5 * ellipk((2 / 2.5) ** 2), rel=1e-11)
    x, v, period = HALO
    halo = sc.periodic_orbit(
        restricted,
        [1.001 * x[0], 0.0, x[2]],
        velocity=[0.0, 0.998 * v[1], 0.0],
        period=1.001 * period,
        fixed=["y", "z"],
    )
    assert_allclose([*halo.q, halo.period], [*x, period], rtol=0, atol=1e-10)
    adaptive = sc.periodic_orbit(galaxy, [0.0, 0.28], [0.4, 0.02], period=6.2, energy=1 / 8)
    equal = sc.periodic_orbit(galaxy, [0.0, 0.28], [0.4, 0.02], period=6.2, energy=1 / 8, h=0.05)
    limited = sc.periodic_orbit(galaxy, [0.0, 0.28], [0.4, 0.02], period=6.2, energy=1 / 8, max_step=0.02)
    assert np.diff(limited.sequence.ends).max() * limited.period < 0.021
    assert limited.period == pytest.approx(adaptive.period, abs=1e-8)
    assert adaptive.period == pytest.approx(equal.period, rel=1e-11)
    assert_allclose(adaptive.monodromy, adaptive.run().tangent()[-1], rtol=0, atol=1e-9)


@pytest.mark.second
def test_galactic_orbits_are_found_by_energy(galaxy):
    """The stable one at y = 0.3 or so, the unstable one below; and turned by a third, as the potential may be."""
    energy = 1 / 8
    stable = sc.periodic_orbit(galaxy, [0.0, 0.28], [0.4, 0.02], period=6.2, h=0.1, energy=energy)
    unstable = sc.periodic_orbit(galaxy, [0.0, -0.2], [0.45, 0.01], period=6.8, h=0.1, energy=energy)
    for orbit in (stable, unstable):
        assert orbit.energy == pytest.approx(energy, abs=1e-13)
        assert orbit.residual < 1e-12
        assert orbit.reciprocal_error < 1e-5
        assert np.prod(orbit.multipliers) == pytest.approx(1.0, abs=1e-8)
        assert_allclose(orbit.monodromy, orbit.run().tangent()[-1], rtol=0, atol=1e-9 * np.abs(orbit.monodromy).max())
        assert orbit.period / orbit.steps <= 0.12
    assert stable.stable
    assert not unstable.stable
    turn = np.array([[-1.0, -np.sqrt(3.0)], [np.sqrt(3.0), -1.0]]) / 2.0
    turned = sc.periodic_orbit(galaxy, turn @ stable.q, turn @ stable.p, period=stable.period, steps=stable.steps)
    assert turned.iterations <= 1
    assert_allclose(turned.stability_indices, stable.stability_indices, rtol=0, atol=1e-9)


@pytest.mark.rotated
def test_forced_oscillator_has_the_period_of_its_force():
    """x'' = -x - c x' + cos(w t): the closed form; multipliers exp(-c/2 +- i ..), no pairs."""
    driven = sc.LagrangianSystem.from_text(
        name="driven oscillator",
        coordinates=["x"],
        lagrangian="x_dot**2/2 - x**2/2",
        parameters={"c": 0.2, "w": 1.5},
        forces={"x": "cos(w*t)"},
        dissipation="c*x_dot**2/2",
    )
    stepper, period = sc.compile_stepper(driven, sc.SVI(6)), 2 * np.pi / 1.5
    orbit = sc.periodic_orbit(stepper, [0.5], [0.5], period=period, steps=40, fixed_period=True)
    answer = 1.0 / (1.0 - 1.5**2 + 0.3j)
    adaptive = sc.periodic_orbit(stepper, [0.5], [0.5], period=period, fixed_period=True)
    for each in (orbit, adaptive):
        assert_allclose([each.q[0], each.p[0]], [answer.real, (1.5j * answer).real], rtol=0, atol=1e-10)
        assert each.error < 1e-10
        assert not each.autonomous
    assert_allclose(np.abs(orbit.multipliers), np.exp(-0.1 * period), rtol=1e-9)
    assert orbit.stable
    with pytest.raises(sc.MethodError, match="not symplectic"):
        orbit.stability_indices  # noqa: B018  (the access is the point)
    with pytest.raises(sc.MethodError, match="not available with forces"):
        sc.periodic_orbit(stepper, [0.5], [0.5], period=period, steps=40, energy=1.0)


@pytest.mark.rotated
@pytest.mark.parametrize(
    ("speed", "duration", "fixed"), [(1, 0.85, []), (1, 1.15, []), (0.85, 0.85, []), (0.85, 1, ["x", "y"])]
)
def test_orbits_are_found_from_a_guess_that_is_15_percent_off(planar, speed, duration, fixed):
    q, velocity = [0.82, 0.0], [0.0, 0.1625133 * speed]
    orbit = sc.periodic_orbit(planar, q, velocity=velocity, period=2.780187 * duration, steps=200, fixed=fixed)
    assert orbit.residual < 1e-9
    assert np.ptp(orbit.run().q, axis=0).max() > 0.05  # no equilibrium
    if fixed:
        assert orbit.period == pytest.approx(2.780186915, abs=1e-8)


@pytest.mark.rotated
def test_nonautonomous_orbits_have_a_period_of_the_system():
    """A forced oscillator closes after any time from some state, and goes elsewhere the next time round."""
    system = lagrange(
        "forced", "x", "x_dot**2/2 - x**2/2", w=1.3, forces={"x": "cos(w*t)/10"}, dissipation="x_dot**2/20"
    )
    stepper, period = sc.compile_stepper(system, sc.SVI(3)), 2 * np.pi / 1.3
    with pytest.raises(sc.MethodError, match=r"give the period of .*, with fixed_period=True"):
        sc.periodic_orbit(stepper, [0.0], [0.1], period=period, steps=40)
    with pytest.raises(sc.OrbitError, match=r"is not periodic in time with the period 4\.7"):
        sc.periodic_orbit(stepper, [0.0], [0.1], period=4.7, steps=40, fixed_period=True)
    twice = sc.periodic_orbit(stepper, [0.0], [0.1], period=2 * period, steps=80, fixed_period=True)
    once = sc.periodic_orbit(stepper, [0.0], [0.1], period=period, steps=40, fixed_period=True)
    assert_allclose(np.append(twice.q, twice.p), np.append(once.q, once.p), rtol=0, atol=1e-12)


@pytest.mark.second
@pytest.mark.parametrize(
    ("amplitude", "origin"), [(1.0, 0.0), (1e-3, 0.0), (1e-9, 0.0), (1.0, 1e3), (1e-3, 1e3), (1e-6, 1e3)]
)
def test_orbits_depend_neither_on_the_origin_nor_on_the_amplitude(amplitude, origin):
    """The period of a pendulum is 4 K(sin^2(a/2)); errors are those of rounding, also of the origin."""
    system = lagrange("pendulum", "x", "x_dot**2/2 + cos(x - c)", c=0.0)
    guess, given = [origin + amplitude], {"period": 6.3 if amplitude < 1 else 6.7, "parameters": {"c": origin}}
    with warnings.catch_warnings(action="ignore"):  # seven digits are left of 1e-6 beside 1000
        orbit = sc.periodic_orbit(sc.compile_stepper(system, "svi:8"), guess, [0.0], fixed=["x"], **given)
    exact, rounding = 4.0 * ellipk(np.sin(0.5 * (orbit.q[0] - origin)) ** 2), 2.0**-53 * (origin + 1.0) / amplitude
    assert orbit.q[0] == pytest.approx(guess[0], rel=1e-15)
    assert abs(orbit.period / exact - 1.0) <= orbit.error + 64 * rounding
    assert orbit.error < 1e-9 + 1000 * rounding
