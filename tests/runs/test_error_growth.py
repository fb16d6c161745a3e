"""Growth of errors along adaptive runs, by a tangent vector: chaotic motions are reported, regular ones are not."""

import math
import re
import warnings

import numpy as np
import pytest
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen.runs.accuracy.growth import measured_growth
from scvi_codegen.runs.accuracy.warning_switch import without_accuracy_warnings

TOLERANCES = [None, 1e-12, 1e-9, 1e-6, 1e-3]
PLANE, BODIES = ("x", "y"), ("x1", "y1", "x2", "y2", "x3", "y3")
KEPLER = PLANE, "(x_dot**2 + y_dot**2)/2 + 1/sqrt(x**2 + y**2)"
HENON_HEILES = PLANE, "(x_dot**2 + y_dot**2)/2 - (x**2 + y**2)/2 - x**2*y + y**3/3"
MASSES = {1: 3, 2: 4, 3: 5}
BURRAU = (
    BODIES,
    " + ".join(
        [
            *(f"{m}*(x{i}_dot**2 + y{i}_dot**2)/2" for i, m in MASSES.items()),
            *(f"{MASSES[i] * MASSES[j]}/sqrt((x{i}-x{j})**2 + (y{i}-y{j})**2)" for i, j in ((1, 2), (1, 3), (2, 3))),
        ]
    ),
)
ELASTIC = PLANE, "(x_dot**2 + y_dot**2)/2 - y - 15*(sqrt(x**2 + y**2) - 1)**2"
OSCILLATORS = PLANE, "(x_dot**2 + y_dot**2)/2 - x**2/2 - 9*y**2"
HILL = PLANE, "(x_dot**2 + y_dot**2)/2 + x*y_dot - y*x_dot + 3*x**2/2 + 1/sqrt(x**2 + y**2)"
PENDULUM = ("a", "b"), "a_dot**2 + b_dot**2/2 + a_dot*b_dot*cos(a - b) + 2*cos(a) + cos(b)"
TOP = (
    ("a", "b", "c"),
    (
        "((a_dot*sin(b)*sin(c) + b_dot*cos(c))**2 + 2*(a_dot*sin(b)*cos(c) - b_dot*sin(c))**2"
        " + 3*(a_dot*cos(b) + c_dot)**2)/2"
    ),
)
SPHERICAL = ("u", "w"), "(u_dot**2 + sin(u)**2*w_dot**2)/2 + cos(u)"
POLAR = ("r", "f"), "(r_dot**2 + r**2*f_dot**2)/2 + 1/r"
DUFFING = ("x",), "x_dot**2/2 + x**2/2 - x**4/4"
PLANET = PLANE, KEPLER[1] + " + 0.001/sqrt((x - 5.2*cos(t/11.86))**2 + (y - 5.2*sin(t/11.86))**2)"
STEPPERS = {}


def stepper_of(system, method="svi:8", **forces):
    key = system, method, *forces.items()
    if key not in STEPPERS:
        names, text = system
        STEPPERS[key] = sc.compile_stepper(lagrange("motion", names, text, forces=forces), method)
    return STEPPERS[key]


def ellipse(e):
    return [1.0 - e, 0.0], [0.0, math.sqrt((1.0 + e) / (1.0 - e))]


def polar(e):
    return [1.0 - e, 0.0], [0.0, math.sqrt((1.0 - e) * (1.0 + e))]


def burrau_states(random):
    return np.array([1.0, 3.0, -2.0, -1.0, 1.0, -1.0]) * (1.0 + 1e-3 * random.standard_normal(6)), np.zeros(6)


def ejecting_states(random):
    """One body leaves the others early, and later motion is regular."""
    return np.array([1.0, 3.0, -2.0, -1.0, 1.0, -1.0]) + random.uniform(-0.05, 0.05, 6), np.zeros(6)


def pendulum_states(random):
    return random.uniform(1.5, 3.0, 2) * random.choice([-1.0, 1.0], 2), np.zeros(2)


def hill_states(random):
    """Orbits about the smaller mass."""
    x = random.uniform(0.1, 0.3)
    return [x, 0.0], [0.0, math.sqrt(1.0 / x)]


def henon_heiles_states(random, energy):
    """A state with x = 0 and this energy, above 0 in p_x."""
    while True:
        y, p_y = random.uniform([-0.4, -0.5], [0.8, 0.5])
        rest = 2.0 * energy - y**2 + 2.0 * y**3 / 3.0 - p_y**2
        if rest > 0.0:
            return [0.0, y], [math.sqrt(rest), p_y]


def reports(stepper, q, p, t_end, **arguments):
    """Whether a run reports that errors grow, or fails where they carry a bound motion over a saddle."""
    with warnings.catch_warnings(record=True, action="always") as heard:
        try:
            stepper.integrate(q, p, t_end=t_end, **arguments)
        except sc.StepFailedError:
            return True
    return any(str(each.message).startswith("the motion amplifies errors") for each in heard)


REGULAR = {
    **{f"Kepler {e}": (KEPLER, *ellipse(e), 300.0) for e in (0.0, 0.2, 0.5, 0.9, 0.99)},
    "elastic pendulum": (ELASTIC, [0.2, -1.0], [0.0, 0.0], 100.0),
    "Hill": (HILL, [0.1, 0.0], [0.0, math.sqrt(10.0)], 40.0),
    "oscillators": (OSCILLATORS, [1.0, 0.5], [0.0, 0.7], 300.0),
    "double pendulum, small": (PENDULUM, [0.3, -0.2], [0.0, 0.0], 60.0),
    "free top in Euler angles": (TOP, [0.3, 1.2, 0.5], [0.4, -0.7, 0.9], 60.0),
    "spherical pendulum": (SPHERICAL, [2.0, 0.0], [0.0, 0.5], 100.0),
    "Kepler 0.5, polar": (POLAR, [0.5, 0.0], [0.0, math.sqrt(0.75)], 100.0),
    "Henon-Heiles, E = 1/12": (HENON_HEILES, [0.0, 0.1], [math.sqrt(1 / 6 - 0.01 + 0.002 / 3 - 0.01), 0.1], 300.0),
}
CHAOTIC = {
    "double pendulum": (PENDULUM, [2.5, -2.0], [0.0, 0.0], 60.0),
    "Burrau": (BURRAU, [1.0, 3.0, -2.0, -1.0, 1.0, -1.0], [0.0] * 6, 65.0),
    "early ejection": (BURRAU, [1.0, 3.05, -2.02, -1.01, 0.95, -1.01], [0.0] * 6, 65.0),
    "Henon-Heiles, E = 1/6.2": (HENON_HEILES, *henon_heiles_states(np.random.default_rng(7), 1 / 6.2), 300.0),
}
IN_DOUBT = {("Kepler 0.99", 1e-3), ("early ejection", 1e-12)}
"""Motions whose answer is near the threshold: it differs between vectors of four and eight lanes."""
ANSWERS = [(name, tolerance) for name in (*REGULAR, *CHAOTIC) for tolerance in TOLERANCES]


@pytest.mark.rotated
@pytest.mark.covering(2)
@pytest.mark.parametrize(("name", "tolerance"), [each for each in ANSWERS if each not in IN_DOUBT])
def test_chaotic_motions_are_reported_and_regular_ones_are_not(name, tolerance):
    system, q, p, t_end = (REGULAR | CHAOTIC)[name]
    assert reports(stepper_of(system), q, p, t_end, tolerance=tolerance) == (name in CHAOTIC)


DRIVEN = {
    "oscillator from rest": (OSCILLATORS, {"x": "cos(1.2*t)"}, [0.0, 0.0], [0.0, 0.0], False),
    "Kepler with drag": (KEPLER, {"x": "-0.001*x_dot", "y": "-0.001*y_dot"}, *ellipse(0.2), False),
    "Kepler with a planet": (PLANET, {}, *ellipse(0.2), False),
    "damped pendulums": (PENDULUM, {"a": "-0.3*a_dot", "b": "-0.3*b_dot"}, [0.5, -0.2], [0.0, 0.0], False),
    "Duffing, periodic": (DUFFING, {"x": "-0.5*x_dot + 0.1*cos(1.2*t)"}, [0.5], [0.1], False),
    "Duffing, undamped": (DUFFING, {"x": "0.3*cos(1.2*t)"}, [0.5], [0.1], True),
    "Duffing from rest": (DUFFING, {"x": "-0.15*x_dot + 0.3*cos(t)"}, [0.0], [0.0], True),
    "driven pendulums": (PENDULUM, {"a": "2*cos(t) - 0.05*a_dot"}, [2.0, 1.7], [0.0, 0.0], True),
}


@pytest.mark.tiers(0, 1)
@pytest.mark.covering
@pytest.mark.parametrize("tolerance", TOLERANCES)
@pytest.mark.parametrize("name", DRIVEN)
def test_chaos_under_forces_is_reported_by_a_tangent_vector(name, tolerance):
    system, forces, q, p, chaotic = DRIVEN[name]
    stepper, t_end = stepper_of(system, **forces), 300.0
    assert stepper.start(q, p, t_end=t_end)._memory.measures_growth == 0  # only integrate measures it
    assert reports(stepper, q, p, t_end, tolerance=tolerance) == chaotic


def test_growth_is_measured_only_where_the_check_needs_it():
    system, q, p, t_end = CHAOTIC["Henon-Heiles, E = 1/6.2"]
    stepper = stepper_of(system)
    run = stepper.start(q, p, t_end=t_end)
    run._run_to_target()
    assert run._growth is None
    assert not reports(stepper, q, p, t_end, check_growth=False)
    with without_accuracy_warnings():
        assert not reports(stepper, q, p, t_end)
    assert reports(stepper, q, p, t_end)


@pytest.mark.parametrize("tolerance", [None, 1e-9, 1e-6, 1e-4])
@pytest.mark.parametrize(
    ("system", "q", "velocity", "t_end", "error"),
    [
        (KEPLER, [1.0, 0.1], [0.1, 1.1], 20.0, 0.02),
        (BURRAU, [1.0, 3.0, -2.0, -1.0, 1.0, -1.0], [0.2, 0.1, 0.0, -0.2, 0.1, 0.3], 3.0, 0.02),
        (PENDULUM, [1.0, 0.5], [0.3, -0.4], 3.0, 0.15),
    ],
    ids=["matrix", "by operations", "variable accelerations"],
)
def test_the_tangent_vector_is_the_difference_of_runs(system, q, velocity, t_end, error, tolerance):
    """Forces of time disable the projection on the energy surface. Derivatives are those of a matrix or of operations.

    Iterations end at errors that are small beside an exponential growth.
    """
    stepper = stepper_of(system, **{system[0][0]: "0.1*cos(t)"})
    first = stepper.integrate(q, velocity=velocity, t_end=t_end, tolerance=tolerance)
    run = stepper.start(q, first.p[0], t_end=t_end, tolerance=tolerance)
    run._memory.measures_growth = measured_growth(stepper, run._plan, None)
    run._run_to_target()
    i, change = np.arange(len(q)), first.q[1] - q
    dq, dv = 1e-6 * (q + change) * np.cos(i), 1e-6 * (velocity + change / first.t[1]) * np.cos(i + 1)
    after, before = (
        stepper.integrate(q + sign * dq, velocity=velocity + sign * dv, t_end=t_end).q[-1] for sign in (1, -1)
    )
    expected = (after - before) / 2e-6
    assert np.abs([row[0] for row in run._memory.tangent] - expected).max() < error * np.abs(expected).max()


@pytest.mark.rotated
@pytest.mark.parametrize("scale", [2.0**-600, 2.0**600])
def test_states_of_extreme_size_are_checked_by_repetition(scale):
    """Squares of such numbers are not representable."""
    saddle = (("x",), "x_dot**2/2 + x**2/2")
    assert not reports(stepper_of(saddle, "svi:4"), [scale], [scale], 43.0)
    run = stepper_of(saddle, "svi:4").start([scale], [scale], t_end=5.0)
    run._memory.measures_growth = 1
    run._run_to_target()
    assert run._growth is None


@pytest.mark.parametrize("tolerance", TOLERANCES)
@pytest.mark.parametrize(
    ("system", "states", "t_end", "least", "most"),
    [
        (BURRAU, burrau_states, 65.0, 26, 30),
        (BURRAU, ejecting_states, 65.0, 26, 30),
        (PENDULUM, pendulum_states, 60.0, 27, 30),
        (PENDULUM, lambda random: (random.uniform(-0.3, 0.3, 2), np.zeros(2)), 60.0, 0, 0),
        (POLAR, lambda random: polar(random.uniform(0.0, 0.9)), 100.0, 0, 0),
        (SPHERICAL, lambda random: ([random.uniform(0.5, 2.5), 0.0], [0.0, random.uniform(0.2, 0.9)]), 100.0, 0, 0),
        (TOP, lambda random: ([0.3, 1.2, 0.5], random.uniform(-1.0, 1.0, 3)), 60.0, 0, 0),
        (HILL, hill_states, 40.0, 0, 0),
        (HENON_HEILES, lambda random: henon_heiles_states(random, 1 / 6.2), 300.0, 23, 26),  # the others are regular
        (HENON_HEILES, lambda random: henon_heiles_states(random, 1 / 12), 300.0, 0, 0),
        (HENON_HEILES, lambda random: henon_heiles_states(random, 1 / 30), 300.0, 0, 0),
        (KEPLER, lambda random: ellipse(random.uniform(0.0, 0.99)), 300.0, 0, 0),
    ],
    ids=[
        "Burrau",
        "early ejection",
        "double pendulum",
        "small double pendulum",
        "polar Kepler",
        "spherical pendulum",
        "free top",
        "Hill",
        "Henon-Heiles 1/6.2",
        "Henon-Heiles 1/12",
        "Henon-Heiles 1/30",
        "Kepler",
    ],
)
@pytest.mark.full
def test_most_chaotic_runs_and_no_regular_ones_are_reported(system, states, t_end, least, most, tolerance):
    random, stepper = np.random.default_rng(1), stepper_of(system)
    found = [reports(stepper, *states(random), t_end, tolerance=tolerance) for _ in range(30)]
    assert least <= sum(found) <= most


ARENSTORF = (
    PLANE,
    "(x_dot**2 + y_dot**2)/2 + x*y_dot - y*x_dot + (x**2 + y**2)/2 + (1 - m)/sqrt((x + m)**2 + y**2)"
    " + m/sqrt((x - 1 + m)**2 + y**2)",
)
ORBITS = {  # initial velocities and periods: Hairer, Norsett, Wanner, Solving ODEs I, sec. II.0
    -2.00158510637908252240537862224: 17.0652165601579625588917206249,
    -2.0317326295573368357302057924: 11.124340337266085134999734047,
}


@pytest.mark.rotated
@pytest.mark.parametrize("velocity", ORBITS)
def test_growth_that_leaves_ten_digits_is_not_reported(velocity):
    """Arenstorf's orbits return to their start with 12 digits; perturbations grow by a factor of 5e4."""
    stepper = sc.compile_stepper(lagrange("moon", *ARENSTORF, m=0.012277471), "svi:8")
    with warnings.catch_warnings(action="error"):
        run = stepper.integrate([0.994, 0.0], velocity=[0.0, velocity], t_end=ORBITS[velocity])
    assert np.abs(run.q[-1] - [0.994, 0.0]).max() < 1e-12


@pytest.mark.rotated
@pytest.mark.parametrize("method", ["svi:4", "svi:8"])
def test_a_fall_from_the_rounded_equilibrium_is_reported(method):
    """The angle pi is rounded: the fall of a pendulum at rest is amplified rounding from its start."""
    stepper = stepper_of((("a",), "a_dot**2/2 + cos(a)"), method)
    with pytest.warns(sc.AccuracyWarning, match="leaves no digit"):
        stepper.integrate([math.pi], [0.0], t_end=45.0)


@pytest.mark.rotated
@pytest.mark.parametrize("origin", [0.0, 1000.0])
def test_a_regular_motion_in_a_magnetic_field_is_not_reported_far_from_the_origin(origin):
    """Its momenta are those of the vector potential there."""
    field = "(x_dot**2 + y_dot**2)/2 - (x - c)**2/2 - y**2/2 + x*y_dot + (x - c)**2*y_dot/7"
    stepper = sc.compile_stepper(lagrange("charge", PLANE, field, c=0.0), "svi:8")
    with warnings.catch_warnings(action="error"):
        stepper.integrate([origin + 1.0, 0.2], velocity=[0.0, 1.0], t_end=200.0, parameters={"c": origin})


@pytest.mark.parametrize("tolerance", [1e-9, 1e-12])
@pytest.mark.parametrize(("angle", "unit"), [(1e-8, 1.0), (1e-7, 1.0), (1e-7, 2.0**-10)])
def test_small_motions_on_a_rod_are_not_reported(angle, unit, tolerance):
    """Height and vertical momentum are of second order in the angle, and their differences are rounding.

    ``unit``: of x.
    """
    u, v = f"({unit!r}*x)", f"({unit!r}*x_dot)"
    rod = lagrange("rod", "x y", f"({v}**2 + y_dot**2)/2 - y", constraints=[f"{u}**2 + y**2 = 1"])
    start = [np.sin(angle) / unit, -np.cos(angle)], [0.0, 0.0]
    assert not reports(sc.compile_stepper(rod, "svi:2"), *start, 20.0, tolerance=tolerance)


@pytest.mark.rotated
@pytest.mark.parametrize(("q", "t_end"), [([2.5, -2.0], 30.0), ([2.5, -2.0], 40.0), ([2.4, -2.0], 40.0)])
def test_reported_growth_has_the_number_of_digits_left(q, t_end):
    """Compare the number with the largest difference from methods of other orders: double pendulums, 5 to 9 digits.

    A single difference may be small: that of two rounding errors, which have any size below the reported one.
    """
    with pytest.warns(sc.AccuracyWarning, match=r"leaves about (\d) digits at t = .* \(estimated\)") as warned:
        run = stepper_of(PENDULUM).integrate(q, [0.0, 0.0], t_end=t_end)
    digits = int(re.search(r"about (\d) digits", str(warned[0].message))[1])
    methods = (stepper_of(PENDULUM, method) for method in ("svi:6", "svi:10", "svi:12"))
    others = [stepper.integrate(q, [0.0, 0.0], t_end=t_end, check_growth=False).q[-1] for stepper in methods]
    assert digits - 1 < -np.log10(np.abs(run.q[-1] - others).max()) < digits + 2.5
