"""Families of periodic orbits, beside elliptic integrals, published bifurcations and orbits found one by one."""

import re

import numpy as np
import pytest
from samples import earth_and_moon
from scipy.special import ellipk

import scvi_codegen as sc

PENDULUM = sc.LagrangianSystem.from_text("pendulum", ["q"], "q_dot**2/2 + g*cos(q)", parameters={"g": 1.0})


@pytest.fixture(scope="module")
def pendulum():
    return sc.compile_stepper(PENDULUM, "svi:8")


@pytest.fixture(scope="module")
def moon():
    return sc.compile_stepper(earth_and_moon(), "svi:8")


@pytest.mark.rotated
def test_equilibria_have_the_frequencies_of_the_linear_motion(moon, pendulum):
    rest = sc.equilibrium(moon, [0.83, 0.01, 0.01])
    (x, y, z), mu = rest.q, moon.defaults[0]
    assert abs(x - (1 - mu) / (x + mu) ** 2 + mu / (x - 1 + mu) ** 2) < 1e-14
    assert max(abs(y), abs(z)) < 1e-15
    c = (1 - mu) / (x + mu) ** 3 + mu / (1 - mu - x) ** 3
    assert rest.frequencies == pytest.approx([np.sqrt((2 - c + np.sqrt(9 * c**2 - 8 * c)) / 2), np.sqrt(c)], abs=1e-13)
    assert not rest.stable
    assert sc.equilibrium(pendulum, [0.0]).frequencies == pytest.approx([1.0], abs=1e-14)
    above = sc.equilibrium(pendulum, [3.0])
    assert above.q == pytest.approx([np.pi], abs=1e-14)
    assert above.eigenvalues.real == pytest.approx([-1, 1], abs=1e-13) or above.eigenvalues.real[0] > 0
    slow = sc.equilibrium(pendulum, [0.5], parameters={"g": 1e-18})
    assert abs(slow.q) < 1e-15
    assert slow.frequencies == pytest.approx([1e-9], rel=1e-12)


@pytest.mark.rotated
def test_periods_of_a_pendulum_are_elliptic_integrals(pendulum):
    family = sc.family(
        pendulum, sc.equilibrium(pendulum, [0.0]), amplitude=0.01, step=0.3, error=1e-11, until="energy > 0.9"
    )
    assert family.ended == "energy > 0.9 holds"
    assert not family.bifurcations
    expected = 4 * ellipk((family.energies + 1) / 2)
    assert family.periods == pytest.approx(expected, rel=1e-12)
    longer = family.more(2)
    assert longer.ended == "it has as many orbits as were asked for"
    assert len(longer) == len(family) + 2
    assert longer[-1].period == pytest.approx(4 * ellipk((longer[-1].energy + 1) / 2), rel=1e-11)


@pytest.mark.second
def test_family_ends_where_rounding_errors_hide_the_orbit(pendulum):
    """Near the separatrix runs of a period do not close: they pass the upper equilibrium."""
    family = sc.family(pendulum, sc.equilibrium(pendulum, [0.0]), amplitude=0.1, step=1.0)
    assert re.search(r"period 3\d\..*, whose least speed is \S+e-03 of the mean \(0 at a homoclinic", family.ended)
    assert "no periodic orbit was found" in family.ended
    assert max(orbit.residual for orbit in family) < 1e-2
    assert not family.bifurcations


@pytest.mark.second
def test_family_ends_at_an_equilibrium(pendulum):
    """Where the nonlinear terms, of the relative size of the square of the amplitude, are below the error 1e-9."""
    orbit = sc.periodic_orbit(pendulum, [0.5], [0.0], period=6.3)
    family = sc.family(pendulum, orbit, backward=True, step=0.5)
    assert family.ended.startswith("it shrinks to the equilibrium near q = [")
    assert 0 < abs(family[-1].q[0]) < 3.2e-5 * 0.51
    assert family[-1].period == pytest.approx(2 * np.pi, abs=1e-9)


@pytest.mark.rotated
def test_isola_is_followed_once():
    """Limit cycles of the radius r with (r^2 - 2)^2 + a^2 = 1, and the period 2 pi."""
    system = sc.LagrangianSystem.from_text(
        name="isola",
        coordinates=["x"],
        lagrangian="x_dot**2/2 - x**2/2",
        forces={"x": "x_dot*((x**2 + x_dot**2 - 2)**2 + a**2 - 1)/4"},
        parameters={"a": 0.0},
    )
    stepper = sc.compile_stepper(system, "svi:8")
    isola = sc.family(stepper, sc.periodic_orbit(stepper, [1.0], [0.0], period=6.3), parameter="a", step=0.2)
    assert isola.ended == "it is closed: the next orbit is the first one"
    assert [found.kind for found in isola.bifurcations] == ["fold", "fold"]
    assert [found.orbit.parameters[0] for found in isola.bifurcations] == pytest.approx([1, -1], abs=1e-9)
    x, p = np.array([(orbit.q[0], orbit.p[0]) for orbit in isola]).T
    assert (x**2 + p**2 - 2) ** 2 + isola.values**2 == pytest.approx(np.ones(len(isola)), abs=1e-9)
    angles = np.unwrap(np.arctan2(isola.values, x**2 + p**2 - 2))
    assert 0.9 < abs(angles[-1] - angles[0]) / (2 * np.pi) < 1.05


@pytest.mark.rotated
def test_units_of_a_parameter_without_effect_on_the_orbit():
    """A stiffness k across the plane, from 0, in units of 1 and 1e10, and one that changes nothing."""
    system = sc.LagrangianSystem.from_text(
        name="across",
        coordinates=["x", "y"],
        lagrangian="(x_dot**2 + y_dot**2)/2 - x**2/2 - x**4/l**2/4 - (1.5 + k/u)*y**2/2 + x**2*y**2/l**2/5",
        parameters={"k": 0.0, "u": 1.0, "l": 1.0, "c": 1.0},
    )
    stepper, found = sc.compile_stepper(system, "svi:6"), []
    for unit, length in ((1.0, 1.0), (1e10, 1e3)):
        at = {"parameters": {"k": 0.0, "u": unit, "l": length, "c": 1.0}, "period": 4.77, "fixed": ["x"]}
        orbit = sc.periodic_orbit(stepper, [length, 0.0], [0.0, 0.0], **at)
        family = sc.family(stepper, orbit, parameter="k", fixed=["x"], until=f"k > {0.5 * unit}")
        found.append((len(family), family.bifurcations[0].orbit.parameters[0] / unit))
    assert found[0] == pytest.approx(found[1], rel=1e-9)
    with pytest.raises(sc.OrbitError, match="c changes neither orbit nor multipliers"):
        sc.family(stepper, orbit, parameter="c", fixed=["x"])


@pytest.mark.rotated
def test_start_of_an_orbit_keeps_its_distance_from_impacts():
    """A free particle between walls at 0 and L(y) = 1: the period is 2/v, whatever phase the start has."""
    system = sc.LagrangianSystem.from_text("box", ["x", "y"], "(x_dot**2 + y_dot**2)/2 - y**2/2 - y**4/4 - x*y**2/10")
    walls = [sc.Event("x", direction=-1, restitution=1.0), sc.Event("1 - x", direction=-1, restitution=1.0)]
    stepper = sc.compile_stepper(system, "svi:4", events=walls)
    orbit = sc.periodic_orbit(stepper, [0.02, 0.0], [1.0, 0.0], period=2.0)
    family = sc.family(stepper, orbit, count=12)
    assert len(family) == 12
    assert family.periods == pytest.approx([2 / abs(orbit.p[0]) for orbit in family], rel=1e-10)
    for orbit in family[1:]:
        times = np.concatenate([crossings.t for crossings in orbit.run().events]) / orbit.period
        assert min(times.min(), 1 - times.max()) > 0.05


@pytest.mark.rotated
def test_family_of_a_motion_that_drifts():
    """Van der Pol's cycle has w = 1 - m^2/16 + 17 m^4/3072 + 35 m^6/884736; it drives s'' = x^2 - s', ds = int x^2."""
    system = sc.LagrangianSystem.from_text(
        name="driven drift",
        coordinates=["s", "x"],
        lagrangian="(s_dot**2 + x_dot**2 - x**2)/2",
        forces={"s": "x**2 - s_dot", "x": "m*(1 - x**2)*x_dot"},
        parameters={"m": 0.15},
    )
    stepper, gain = sc.compile_stepper(system, "svi:4"), [None, 0.0]
    orbit = sc.periodic_orbit(stepper, [0.0, 2.0], [2.0, 0.0], period=6.29, gain=gain)
    family = sc.family(stepper, orbit, parameter="m", gain=gain, step=0.02, count=3)
    m = family.values
    assert (np.diff(m) > 0).all()
    expected = 2 * np.pi / (1 - m**2 / 16 + 17 * m**4 / 3072 + 35 * m**6 / 884736)
    assert family.periods == pytest.approx(expected, rel=1e-9)
    run = family[-1].run()
    x = run.at(np.linspace(run.t[0], run.t[-1], 65)[:-1])[0][:, 1]
    assert run.q[-1, 0] - run.q[0, 0] == pytest.approx(family[-1].period * np.mean(x**2), rel=1e-8)


ROD = sc.LagrangianSystem.from_text(
    "rod",
    ["x", "y"],
    "m*(x_dot**2 + y_dot**2)/2 - m*g*y",
    constraints=["x**2 + y**2 = (l + d)**2"],
    parameters={"m": 1.3, "g": 1.0, "l": 1.0, "d": 0.0},
)


@pytest.mark.rotated
def test_families_of_a_rod_are_elliptic_integrals():
    """The period of a pendulum is 4 K((E/(m g l) + 1)/2) sqrt(l/g), also while the length of the rod varies."""
    rod = sc.compile_stepper(ROD, "svi:6")
    rest = sc.equilibrium(rod, [0.3, -0.9])
    assert [*rest.q, *rest.frequencies] == pytest.approx([0, -1, 1], abs=1e-13)
    start = sc.periodic_orbit(rod, [0.6, -0.9], [0.0, 0.0], period=6.4, fixed=["x"])
    assert start.monodromy.shape == (2, 2)
    at = {"step": 0.4, "count": 6}
    families = [
        sc.family(rod, rest, amplitude=0.1, **at),
        sc.family(rod, start, parameter="l", fixed=["x"], **at),
        sc.family(rod, start, parameter="l", energy=start.energy, **at),
        sc.family(rod, start, parameter="d", fixed=["x"], **at),
    ]
    for orbit in (orbit for family in families for orbit in family):
        m, g, length = orbit.parameters[:3] + np.array([0, 0, orbit.parameters[3]])
        expected = 4 * ellipk((orbit.energy / (m * g * length) + 1) / 2) * np.sqrt(length / g)
        assert orbit.period == pytest.approx(expected, rel=1e-11)
        assert np.hypot(*orbit.q) == pytest.approx(length, rel=1e-15)
        assert abs(orbit.stability_indices - 1) < 1e-10
    assert [orbit.q[0] for orbit in families[1]] == pytest.approx([0.6] * 6, abs=1e-15)
    assert families[2].energies == pytest.approx([start.energy] * 6, rel=1e-14)


@pytest.mark.rotated
@pytest.mark.parametrize("guess", [{"energy": 0.2}, {"fixed": ["z"]}, {"steps": 30}])
def test_a_conical_pendulum_is_found_and_has_the_index_of_its_nutation(guess):
    """Energy and angular momentum have parallel gradients there: w^2 = 1/cos a, nutation w sqrt(1 + 3 cos(a)^2)."""
    system = ["x", "y", "z"], "(x_dot**2 + y_dot**2 + z_dot**2)/2 - z"
    pendulum = sc.LagrangianSystem.from_text("pendulum", *system, constraints=["x**2 + y**2 + z**2 = 1"])
    at = {"velocity": [0.0, np.sin(0.8) / np.sqrt(np.cos(0.8)), 0.0], "period": 5.3}
    orbit = sc.periodic_orbit(sc.compile_stepper(pendulum, "svi:6"), [0.7225, 0.0, -0.6914], **at, **guess)
    c = -orbit.q[2]
    assert orbit.period == pytest.approx(2 * np.pi * np.sqrt(c), rel=1e-11)
    assert orbit.stability_indices == pytest.approx([1, np.cos(2 * np.pi * np.sqrt(1 + 3 * c**2))], abs=1e-10)


@pytest.mark.rotated
def test_a_body_on_a_pivot_swings_as_a_pendulum():
    body = sc.LagrangianSystem.from_text(
        "body",
        ["x", "y", "z"],
        "(x_dot**2 + y_dot**2 + z_dot**2)/2 + 0.4*(omega_1**2 + omega_2**2 + omega_3**2)/2 - z",
        rotations={"R": "omega"},
        constraints=["x + R_13 = 0", "y + R_23 = 0", "z + R_33 = 0"],
    )
    stepper, at = sc.compile_stepper(body, "svi:4"), {"velocity": np.zeros(7), "period": 7.9}
    start = sc.periodic_orbit(stepper, [0, np.sin(1), -np.cos(1), np.cos(0.5), np.sin(0.5), 0, 0], **at)
    for orbit in sc.family(stepper, start, fixed=["x"], step=0.3, count=3):
        assert orbit.period == pytest.approx(4 * ellipk((orbit.energy + 1) / 2) * np.sqrt(1.4), rel=1e-11)
        assert orbit.stability_indices == pytest.approx(np.ones(3), abs=1e-9)


def test_families_with_nonholonomic_constraints_are_refused():
    blade = sc.LagrangianSystem.from_text(
        "blade", ["x", "y"], "(x_dot**2 + y_dot**2)/2 - y", constraints=["x_dot = x*y_dot"]
    )
    with pytest.raises(sc.MethodError, match="with nonholonomic constraints"):
        sc.equilibrium(sc.compile_stepper(blade, "svi:2"), [0.0, -1.0])


@pytest.mark.rotated
def test_resonance_curve_has_two_folds():
    """Of a driven Duffing oscillator, at the frequencies where a multiplier is 1."""
    system = sc.LagrangianSystem.from_text(
        name="duffing",
        coordinates=["x"],
        lagrangian="x_dot**2/2 - x**2/2 - b*x**4/4 + F*x*cos(w*t)",
        parameters={"b": 0.2, "F": 0.1, "w": 0.9, "c": 0.05},
        dissipation="c*x_dot**2/2",
    )
    stepper = sc.compile_stepper(system, "svi:4")
    orbit = sc.periodic_orbit(stepper, [0.5], [0.0], period=2 * np.pi / 0.9, fixed_period=True)
    curve = sc.family(stepper, orbit, parameter="w", period="2*pi/w", step=0.3, until="w > 1.25")
    assert [found.kind for found in curve.bifurcations] == ["fold", "fold"]
    above, below = (found.orbit for found in curve.bifurcations)
    for orbit in (above, below):
        assert abs(orbit.multipliers - 1).min() < 1e-5
        assert np.prod(orbit.multipliers).real == pytest.approx(np.exp(-0.05 * orbit.period), rel=1e-9)
    assert above.parameters[2] == pytest.approx(1.194508, abs=1e-5)
    assert below.parameters[2] == pytest.approx(1.097960, abs=1e-5)


@pytest.mark.rotated
def test_gait_of_a_walker_doubles_its_period():
    """At the slopes of Garcia et al. (1998), .0151 and .0177."""
    walker = sc.LagrangianSystem.from_text(
        name="walker",
        coordinates=["theta", "phi"],
        lagrangian="(theta_dot**2 + phi_dot**2)/2 - cos(theta - gamma)",
        forces={"phi": "sin(theta - gamma) + (theta_dot**2 - cos(theta - gamma))*sin(phi)"},
        parameters={"gamma": 0.014},
    )
    then = {
        "theta": "-theta",
        "phi": "-2*theta",
        "p_theta": "cos(2*theta)*p_theta",
        "p_phi": "cos(2*theta)*(1 - cos(2*theta))*p_theta",
    }
    stepper = sc.compile_stepper(walker, "svi:8", events=sc.Event("phi - 2*theta", where="theta < -0.05", then=then))
    run = stepper.integrate([0.2, 0.4], velocity=[-0.1995, -0.0157], t_end=40.0)
    guess = [part[0] for part in run.at([run.events[0].t[-2] + 1.0])]
    gaits = sc.family(
        stepper, sc.periodic_orbit(stepper, *guess, period=3.9), parameter="gamma", until="gamma > 0.0155"
    )
    (limps,) = gaits.bifurcations
    assert limps.kind == "period doubling"
    assert limps.orbit.parameters[0] == pytest.approx(0.015088438, abs=1e-8)
    (again,) = limps.switch(until="gamma > 0.0178").bifurcations
    assert again.kind == "period doubling"
    assert again.orbit.parameters[0] == pytest.approx(0.0176694, abs=1e-6)


@pytest.mark.rotated
@pytest.mark.parametrize(("method", "error"), [("stoermer-verlet", 1e-8), ("svi:2", 1e-11), ("svi:8", 1e-13)])
def test_eigenvalues_have_their_error(method, error):
    rest = sc.equilibrium(sc.compile_stepper(PENDULUM, method), [0.1])
    assert abs(rest.frequencies[0] - 1) <= rest.error < error


@pytest.mark.second
def test_a_family_ends_where_its_condition_is_undefined(pendulum):
    orbit = sc.periodic_orbit(pendulum, [0.5], [0.0], period=6.3)
    undefined = sc.family(pendulum, orbit, count=3, until="log(energy - 100) > 0")
    assert len(undefined) == 2
    assert undefined.ended.startswith("until='log(energy - 100) > 0' is undefined")


@pytest.mark.rotated
def test_family_is_saved_and_drawn(pendulum, moon, tmp_path):
    family = sc.family(pendulum, sc.equilibrium(pendulum, [0.0]), amplitude=0.5, count=3)
    family.save(tmp_path / "family.npz")
    with np.load(tmp_path / "family.npz") as saved:
        assert saved["period"] == pytest.approx(family.periods, rel=1e-15)
        assert saved["multipliers"].shape == (3, 2)
    orbits, indices, _ = family.plot(tmp_path / "family.png").axes
    assert np.array_equal(indices.lines[0].get_ydata(), family.stability_indices[:, 0].real)  # signed
    corners = np.linalg.norm(np.diff(orbits.lines[2].get_xydata(), 2, axis=0), axis=1)
    assert corners.max() < 1e-4 * np.ptp(orbits.lines[2].get_xdata())  # a curve, no polygon of steps
    with pytest.raises(sc.StateError, match=r"is a family of 'pendulum.*', not of 'restricted three-body problem"):
        sc.Family.load(moon, tmp_path / "family.npz")
    heavier = sc.LagrangianSystem.from_text("pendulum", ["q"], "q_dot**2 + g*cos(q)", parameters={"g": 1.0})
    with pytest.raises(sc.StateError, match="but of another one"):
        sc.Family.load(sc.compile_stepper(heavier, "svi:8"), tmp_path / "family.npz")
    (tmp_path / "none.npz").write_text("nothing")
    with pytest.raises(sc.StateError, match=r"none\.npz' has no family of Family\.save"):
        sc.Family.load(pendulum, tmp_path / "none.npz")
    assert (tmp_path / "family.png").stat().st_size > 10_000


@pytest.mark.rotated
def test_family_of_a_file_continues(moon, tmp_path):
    """Orbits, the closure of the first one and the branches of a family, after Ctrl-C, are those without a file."""

    def interrupt(count):
        if count == 14:
            raise KeyboardInterrupt

    rest = sc.equilibrium(moon, [0.83, 0, 0])
    whole = sc.family(moon, rest, amplitude=0.01, step=0.2, count=16)
    family = sc.family(moon, rest, amplitude=0.01, step=0.2, progress=interrupt)
    assert family.ended == "it was interrupted"
    family.save(tmp_path / "family.npz")
    loaded = sc.Family.load(moon, tmp_path / "family.npz")
    assert repr(loaded) == repr(family)
    assert [orbit.period for orbit in loaded] == [orbit.period for orbit in family]
    longer = loaded.more(2)
    assert longer.periods == pytest.approx(whole.periods, rel=1e-3)
    last = longer[-1]
    nearest = sc.periodic_orbit(moon, whole[-1].q, whole[-1].p, period=whole[-1].period, energy=last.energy)
    assert last.period == pytest.approx(nearest.period, rel=1e-8)
    (before,), (after,) = whole.bifurcations, longer.bifurcations
    assert (before.kind, before.after) == (after.kind, after.after)
    north, again = (found.switch(count=2) for found in (before, after))
    change = np.append(north[1].q - north[0].q, north[1].p - north[0].p)
    assert change[abs(change).argmax()] > 0
    heights = [abs(halo[1].run().q[:, 2]).max() for halo in (north, again)]
    assert min(heights) > 1e-3
    gained = [halo[1].energy - before.orbit.energy for halo in (north, again)]  # by the square of the height
    assert gained[0] / heights[0] ** 2 == pytest.approx(gained[1] / heights[1] ** 2, rel=1e-2)
