"""Symmetric periodic orbits, computed over half a period, beside whole ones and elliptic integrals."""

import numpy as np
import pytest
from notation import lagrange
from samples import earth_and_moon
from scipy.special import ellipk

import scvi_codegen as sc

PENDULUM = lagrange("pendulum", "q", "q_dot**2/2 + g*cos(q) + a*q**3", g=1, a=0)
MIRROR = ["x", "-y", "z"]


@pytest.fixture(scope="module")
def pendulum():
    return sc.compile_stepper(PENDULUM, "svi:8")


@pytest.fixture(scope="module")
def moon():
    return sc.compile_stepper(earth_and_moon(), "svi:8")


def closing(orbit, gain=0.0):
    run = orbit.run()
    return max(abs(run.q[-1] - run.q[0] - gain).max(), abs(run.p[-1] - run.p[0]).max())


@pytest.mark.second
@pytest.mark.parametrize("steps", [None, 40])
def test_halo_orbit_of_half_a_period_is_the_whole_one(moon, steps):
    at = {"velocity": [0, -0.19261628, 0], "period": 3.337915, "fixed": ["z"], "error": 1e-11, "steps": steps}
    half = sc.periodic_orbit(moon, [1.17, 0.0, 0.09442299937998082], reversor=MIRROR, **at)
    whole = sc.periodic_orbit(moon, [1.17, 0.0, 0.09442299937998082], **at | {"fixed": ["y", "z"]})
    for name in ("q", "p", "period"):
        assert getattr(half, name) == pytest.approx(getattr(whole, name), abs=1e-12)
    assert half.monodromy == pytest.approx(whole.monodromy, abs=1e-12 * abs(whole.monodromy).max() * 100)
    assert half.steps == whole.steps or steps is None
    assert closing(half) < 1e-10
    assert max(half.residual, half.error) < 1e-11
    assert half.sequence.ends == pytest.approx(1 - half.sequence.ends[::-1], abs=1e-15)


@pytest.mark.second
def test_detected_reversors_and_rotations(pendulum):
    """A swing through the lowest point, a swing from rest, and full turns with -q and with 2 pi - q."""
    swing = sc.periodic_orbit(pendulum, [0.0], [1.0], period=6.7, fixed=["p_q"], reversor="detect")
    assert swing.period == pytest.approx(4 * ellipk(1 / 4), rel=1e-12)
    rest = sc.periodic_orbit(pendulum, [np.pi / 3], [0.0], period=6.7, fixed=["q"], reversor="detect")
    assert rest.period == pytest.approx(4 * ellipk(1 / 4), rel=1e-12)
    for start, formula in ((0.0, "-q"), (2 * np.pi, "4*pi - q")):
        at = {"period": 4.0, "fixed": ["p_q"], "gain": [2 * np.pi]}
        turn = sc.periodic_orbit(pendulum, [start + 1e-3], [2.2], reversor=[formula], **at)
        assert turn.q == pytest.approx([start], abs=1e-14)
        assert turn.period == pytest.approx(4 / 2.2 * ellipk(4 / 2.2**2), rel=1e-11)
        assert closing(turn, 2 * np.pi) < 1e-9


@pytest.mark.rotated
def test_exchange_of_bodies_as_reversor():
    """The figure eight of three bodies, from the collinear state: Chenciner & Montgomery (2000)."""
    names = [f"{axis}{k}" for k in (1, 2, 3) for axis in "xy"]
    attraction = "".join(f" + 1/sqrt((x{i} - x{j})**2 + (y{i} - y{j})**2)" for i, j in ((1, 2), (1, 3), (2, 3)))
    kinetic = " + ".join(f"{name}_dot**2/2" for name in names)
    stepper = sc.compile_stepper(sc.LagrangianSystem.from_text("eight", names, kinetic + attraction), "svi:8")
    speed = np.array([-0.93240737, -0.86473146])
    start = [0.97000436, -0.24308753, -0.97000436, 0.24308753, 0.0, 0.0]
    at = {"velocity": [*(-speed / 2), *(-speed / 2), *speed], "period": 6.32591398}
    eight = sc.periodic_orbit(stepper, start, reversor=["-x2", "-y2", "-x1", "-y1", "-x3", "-y3"], **at)
    assert closing(eight) < 1e-9
    assert eight.q[:2] == pytest.approx(-eight.q[2:4], abs=1e-14)


@pytest.mark.second
def test_a_family_ends_where_its_symmetry_does(pendulum):
    orbit = sc.periodic_orbit(pendulum, [0.0], [1.0], period=6.7, fixed=["p_q"], reversor=["-q"])
    family = sc.family(pendulum, orbit, parameter="a", fixed=["p_q"], reversor=["-q"], count=3)
    assert "is no symmetry at another value of parameter=" in family.ended


JPL = {
    "Lyapunov": (
        (0.8090546332188572, 0.0, 0.2818915604471463, 3.11687584914084, 3.016484309141973, 669.48058884107),
        (0.7639124660495868, 0.0, 0.494238048295948, 2.99360571851105, 4.469774524567025, 129.75287390231),
        (0.6474261879025457, 0.0, 0.7581649998051122, 2.91113555914615, 6.525492852637634, 53.6707952348081),
    ),
    "southern halo": (
        (
            0.8233908198365149,
            -0.0009894136623591,
            0.12634272983881797,
            3.17434351933012,
            2.743000798124153,
            1180.40653413,
        ),
        (
            0.8274662004681002,
            -0.09588969939784973,
            0.2111356427711061,
            3.10806899103114,
            2.784366428044787,
            327.44261565,
        ),
        (
            0.8778007990603793,
            -0.19247025470406084,
            0.22759832101134,
            2.99818349237843,
            2.1545977693007345,
            1.0000000000,
        ),
        (
            0.9216492528106669,
            -0.21446239588562,
            0.131453125080793,
            3.00250626287494,
            1.8041324586822214,
            2.4961029560772,
        ),
    ),
}
"""x, z, dy/dt, Jacobi constant, period, index of orbits about L1 of Earth and Moon: Three-Body Periodic Orbits Catalog
of JPL, ssd-api.jpl.nasa.gov/periodic_orbits.api?sys=earth-moon&libr=1, 2 October 2026."""


@pytest.mark.second
@pytest.mark.parametrize("row", [row for rows in JPL.values() for row in rows], ids=lambda row: f"T={row[4]:.2f}")
def test_orbits_about_l1_are_those_of_the_jet_propulsion_laboratory(moon, row):
    x, z, speed, constant, period, index = row
    at = {"velocity": [0.0, speed * (1 + 1e-6), 0.0], "period": period, "reversor": MIRROR, "error": 1e-12}
    orbit = sc.periodic_orbit(moon, [x, 0.0, z], fixed=["z"] if z else ["x"], **at)
    assert [orbit.q[0], orbit.q[2], orbit.p[1] - orbit.q[0]] == pytest.approx([x, z, speed], abs=1e-9)
    assert orbit.period == pytest.approx(period, abs=1e-9)
    assert -2 * orbit.energy == pytest.approx(constant, abs=1e-11)
    assert max(1.0, abs(orbit.stability_indices).max()) == pytest.approx(index, rel=1e-7)
