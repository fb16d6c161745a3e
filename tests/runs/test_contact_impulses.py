"""Impulses and directions of slips of ``run.contact_modes`` beside closed forms."""

import numpy as np
import pytest

import scvi_codegen as sc


@pytest.fixture(scope="module")
def balls():
    """A ball that bounces with friction on the floor y = 0 and meets a free one ahead; flights by svi:1 are exact."""
    system = sc.LagrangianSystem.from_text(
        "balls",
        ["x", "y", "z"],
        "m*(x_dot**2 + y_dot**2)/2 + M*z_dot**2/2 - m*g*y",
        parameters={"m": 2.0, "M": 3.0, "g": 9.81, "e": 0.6, "mu": 0.1},
        contacts=[sc.contact("y", slip="x_dot", friction="mu", restitution="e"), sc.contact("z - x", restitution="e")],
    )
    return sc.compile_stepper(system, "svi:1")


def closed_form(m, M, g, e, mu, height, ahead, vx, vz, t_end):
    """Return times, contacts and impulses: m (1 + e) v, friction to mu times that, and (1 + e) v m M/(m + M)."""
    t, x, y, z, vy, impacts = 0.0, 0.0, height, ahead, 0.0, []
    while True:
        lands = (vy + np.sqrt(vy * vy + 2 * g * y)) / g
        meets = (z - x) / (vx - vz) if vx > vz and z > x else np.inf
        span = min(lands, meets)
        if t + span > t_end:
            return impacts
        t, x, y, z, vy = t + span, x + vx * span, y + vy * span - g * span * span / 2, z + vz * span, vy - g * span
        if lands < meets:
            normal = -m * (1 + e) * vy
            friction = -np.sign(vx) * min(mu * normal, m * abs(vx))
            impacts.append((t, 0, normal, friction))
            y, vx, vy = 0.0, vx + friction / m, -e * vy
        else:
            impulse = (1 + e) * (vx - vz) * m * M / (m + M)
            impacts.append((t, 1, impulse, 0.0))
            vx, vz, z = vx - impulse / m, vz + impulse / M, np.inf


@pytest.mark.parametrize("number", range(20))
def test_impulses_of_bounces_and_collisions_are_closed_forms(balls, number):
    random = np.random.default_rng([97, number])
    values = dict(zip(["m", "M", "g", "e", "mu"], random.uniform([0.1, 0.1, 1, 0.5, 0], [9, 9, 20, 1, 1]), strict=True))
    height, ahead, vx, vz = random.uniform([0.2, 0.1, 0.5, -1], [2, 1, 4, 0.4])
    fall = np.sqrt(2 * height / values["g"])
    t_end = fall * (1 + 2 * values["e"] * random.uniform(1.2, 1.8))
    exact = np.array(closed_form(**values, height=height, ahead=ahead, vx=vx, vz=vz, t_end=t_end))
    start = {"velocity": [vx, 0.0, vz], "t_end": t_end, "h": t_end / 30, "parameters": values}
    impacts = balls.integrate([0.0, height, ahead], **start).contact_modes.impacts
    assert impacts.contact.tolist() == exact[:, 1].tolist()
    np.testing.assert_allclose(impacts.t, exact[:, 0], rtol=1e-12)
    np.testing.assert_allclose(impacts.impulse, exact[:, 2:], rtol=1e-10, atol=1e-11)


@pytest.mark.parametrize("velocity", [1.5, -1.5])
def test_directions_of_a_slip_until_it_stops(balls, velocity):
    start = {"velocity": [velocity, 0.0, 0.0], "t_end": 3.0, "h": 0.05, "parameters": {"e": 0.0}}
    modes = balls.integrate([0.0, 0.05, 9.0], **start).contact_modes
    impulse = 2.0 * np.sqrt(2 * 9.81 * 0.05)
    lands, stop = impulse / 2 / 9.81, abs(velocity) / 0.981
    assert modes.directions.vectors[:, :, 0].tolist() == [[0.0, 0.0], [np.sign(velocity), 0.0], [0.0, 0.0]]
    np.testing.assert_allclose(modes.directions.t, [0.0, lands, stop], rtol=1e-12)
    np.testing.assert_allclose(modes.impacts.impulse, [[impulse, -np.sign(velocity) * 0.1 * impulse]], rtol=1e-12)


@pytest.mark.parametrize(
    ("settings", "reason"), [({"transitions": "by steps"}, "located transitions"), ({"save_every": 10}, "save_every=1")]
)
def test_impulses_that_a_run_does_not_determine_are_refused(balls, settings, reason):
    run = balls.integrate([0.0, 1.0, 9.0], velocity=[1.0, 0.0, 0.0], h=0.01, t_end=1.0, **settings)
    with pytest.raises(sc.StateError, match=reason):
        _ = run.contact_modes.impacts
