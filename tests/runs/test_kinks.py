"""Runs across kinks against DOP853 restarted at each of them: ten families of random cases.

Default and given tolerances, output times and dense output, orders of fixed steps, and ``error=``
(``tools/kinks.py``, which prints a table of all); bits of restored runs and of ensembles; derivatives.
"""

import re
from functools import cache, partial
from itertools import count

import numpy as np
import pytest
from kinks import KINDS, METHODS, stepper_of, wrong
from nonsmooth import FAMILIES, Case, case_of
from notation import lagrange
from scipy.integrate import quad, solve_ivp
from scipy.optimize import brentq

import scvi_codegen as sc

pytestmark = pytest.mark.filterwarnings("ignore::scvi_codegen.common.errors.AccuracyWarning")
SMALLEST_FIRST = sorted(FAMILIES, key=lambda family: len(FAMILIES[family].coordinates))
families = pytest.mark.parametrize("family", SMALLEST_FIRST)


@cache
def differentiable(family: str) -> Case:
    """Return the first case with kinks that does not start at one, where a derivative has two values."""
    for number in count(1):
        case = case_of(family, number)
        start = case.motion.switching(0.0, case.motion.q, case.motion.v)
        if case.kinks and np.abs(start).min() > 0.01:
            return case
    raise AssertionError


def without_end(case: Case) -> dict:
    return {name: value for name, value in case.arguments.items() if name != "t_end"}


@pytest.mark.tiers(1, 1)
@families
def test_motions_across_kinks_are_within_tolerances(family):
    assert not wrong(family, [1], ["svi:4"], [kind for kind in KINDS if kind != "order"])


@pytest.mark.rotated
@families
def test_orders_across_kinks(family):
    """SVI(1), SVI(2) and SVI(4) have orders 2, 4 and 8."""
    assert not wrong(family, [1], METHODS, ["order"])


@pytest.mark.rotated
@families
def test_methods_of_other_orders_are_within_tolerances(family):
    kinds = "round-off", "tolerance", "error="
    assert not [*wrong(family, [2], ["svi:2"], kinds), *wrong(family, [4], ["svi:8"], kinds)]


@pytest.mark.rotated
def test_motions_at_rest_on_a_surface():
    """A rounding error beside it, which they leave after a first step within rounding; touching it again and again."""
    assert not [*wrong("rope", [85], ["svi:4"], ["error="]), *wrong("floor", [133], ["svi:4"], ["order"])]


@pytest.mark.rotated
def test_first_steps_where_forces_vanish():
    """So does the one coefficient of curves of SVI(2) there; at the start of a run, and at a kink."""
    assert not wrong("ramp", [35, 27], ["svi:2"], ["round-off", "tolerance"])


@pytest.mark.full
@pytest.mark.parametrize("method", METHODS)
@families
def test_two_thousand_cases_across_kinks(family, method):
    first = 84 * [*METHODS].index(method)
    assert not wrong(family, range(first, first + 84), [method])


@pytest.mark.tiers(0, 1)
@families
def test_restored_runs_have_the_same_bits_at_kinks(family):
    """After each of the first steps, some of which end at kinks."""
    stepper, case = stepper_of(family, "svi:4"), differentiable(family)
    span = case.arguments["t_end"] - case.arguments["t"]
    for plan, again in (({"t_end": case.arguments["t_end"]},) * 2, ({"h": span / 40}, {})):
        run, ends = stepper.start(**without_end(case), **plan), []
        checkpoints = []
        for _ in range(40):
            checkpoints.append(run.checkpoint())
            run.advance(1)
        for saved, steps in zip(checkpoints, range(40, 0, -1), strict=True):
            restored = stepper.from_checkpoint(saved, **again)
            restored.advance(steps)
            ends.append((restored.t, *restored.q, *restored.p))
        assert {*ends} == {(run.t, *run.q, *run.p)}


@pytest.mark.tiers(1, 3)
@families
@pytest.mark.parametrize("plan", [{}, {"tolerance": 1e-6}, {"h": 0.01}], ids=["round-off", "tolerance", "fixed"])
def test_trajectories_of_ensembles_have_the_bits_of_runs(family, plan):
    stepper, case = stepper_of(family, "svi:4"), differentiable(family)
    arguments = dict(case.arguments)
    plan = plan | ({"h": 0.01 * (arguments["t_end"] - arguments["t"])} if "h" in plan else {})
    q = arguments.pop("q") + np.array([0.0, 0.01, -0.02])[:, None] * case.ranges.max()
    p = arguments.pop("p") * np.array([1.0, 0.9, 1.1])[:, None]
    together = stepper.integrate_ensemble(q, p, **arguments, **plan)
    for j in range(3):
        run = stepper.integrate(q[j], p[j], **arguments, **plan)
        assert np.array_equal(together.ends[1][j], run.q[-1])
        assert np.array_equal(together.ends[2][j], run.p[-1])


@pytest.mark.tiers(1, 1)
@families
def test_derivatives_across_kinks_are_those_of_the_motion(family):
    """With respect to the initial state, to differences of the reference; to parameters, to differences of runs."""
    stepper, case = stepper_of(family, "svi:4"), differentiable(family)
    motion, m, run = case.motion, len(case.motion.q), stepper.integrate(**case.arguments)
    found, times = run.sensitivity(), np.array([0.0, motion.span])
    for k, unit in enumerate(np.eye(2 * m)):
        before, after = (motion.states(times, change * unit)[0][-1] for change in (-1e-6, 1e-6))
        exact = (after - before) / 2e-6
        assert np.abs(found.state[-1][:, k] / case.units * case.units[k] - exact).max() < 1e-6 * max(1.0, case.growth)
    parameters = case.arguments["parameters"]
    for name in {*parameters} - {"m", "o", "t0"}:
        step, change = 1e-6 * parameters[name], found.parameters[-1][:m, stepper.interface.parameters.index(name)]
        before, after = (
            stepper.integrate(**case.arguments | {"parameters": parameters | {name: value}}).q[-1]
            for value in (parameters[name] - step, parameters[name] + step)
        )
        assert np.abs(change * step - (after - before) / 2).max() < 1e-11 * max(1.0, case.growth) * case.ranges.max()


@pytest.mark.rotated
def test_functions_of_nested_kinks_follow_their_sides():
    """Outer functions are smooth in a step only with the sides of the inner ones."""
    nested = sc.compile_stepper(lagrange("nested", "x", "x_dot**2/2 - abs(max(x, -x/3) - 1)"), "svi:4")
    assert nested.integrate([0.2], [1.7], t_end=30.0).energy_error() < 1e-13
    square = sc.compile_stepper(lagrange("square", "x y", "(x_dot**2 + y_dot**2)/2 - max(abs(x), abs(y))"), "svi:4")
    for q, p in np.random.default_rng(0).normal(size=(8, 2, 2)):
        assert square.integrate(q, p, t_end=20.0).energy_error() < 1e-13


@pytest.mark.second
def test_the_first_of_many_crossings_in_a_step_is_found():
    saw = lagrange("saw", "x", "x_dot**2/2", forces={"x": "e*sign(sin(w*x))"}, e=1e-3, w=20.0)
    run = sc.compile_stepper(saw, "svi:4").integrate([0.01], [1.0], t_end=30.0)
    assert len(run.switches[0]) == np.floor(20.0 * run.q[-1, 0] / np.pi) == 191


@pytest.mark.parametrize("periods", [0, 1, 100])
@pytest.mark.parametrize("steps", [{}, {"h": 2 * np.pi / 35}], ids=["adaptive", "fixed"])
def test_kinks_of_time_at_starts_and_ends_of_steps(periods, steps):
    """x'' = +-1/2 in turn: x grows by P^2/8 in each period P."""
    square_wave = lagrange("wave", "x", "x_dot**2/2", forces={"x": "unit_step(sin(5*t)) - 1/2"})
    period = 2 * np.pi / 5
    begin = periods * period
    run = sc.compile_stepper(square_wave, "svi:4").integrate([0.0], [0.0], t=begin, t_end=begin + 3 * period, **steps)
    assert abs(run.q[-1, 0] - 3 * period**2 / 8) < 1e-13 * (1 + periods)


@pytest.mark.second
@pytest.mark.parametrize("width", [1e-3, 1e-6, 1e-9])
@pytest.mark.parametrize("steps", [{}, {"h": 0.7}], ids=["adaptive", "fixed"])
def test_short_visits_of_the_other_side_count(width, steps):
    window = lagrange("window", "x", "x_dot**2/2", forces={"x": "0.1/w*where(abs(x - 5) < w, 1, 0)"}, w=1.0)
    stepper = sc.compile_stepper(window, "svi:4")
    run = stepper.integrate([0.0], [1.0], t_end=10.0, parameters={"w": width}, **steps)
    assert run.p[-1, 0] ** 2 / 2 - 0.5 == pytest.approx(0.2, abs=1e-15 / width)
    assert [len(switches) for switches in run.switches] == [2, 1]


@pytest.mark.second
def test_steps_across_many_kinks_do_not_add_energy():
    """After whole periods x = 0 and |v| is that of the start: 112 jumps of a force."""
    relay = lagrange("relay", "x", "x_dot**2/2", forces={"x": "f*(1 - 2*unit_step(x)) + c"}, f=2.875, c=-0.125)
    end = 56 * (2 * 0.375 / 3 + 2 * 0.375 / 2.75)
    run = sc.compile_stepper(relay, "svi:4").integrate([0.0], [0.375], t_end=end)
    assert abs(run.q[-1, 0]) < 1e-13
    assert abs(run.p[-1, 0]) == pytest.approx(0.375, rel=1e-11)


@pytest.mark.second
def test_members_of_ensembles_have_dense_output_across_kinks():
    floor = lagrange("floor", "y", "y_dot**2/2 - y - k*positive_part(-y)**2/2", k=1e3)
    stepper = sc.compile_stepper(floor, "svi:4")
    settings, times = {"h": 0.05, "steps": 120}, np.linspace(0.0, 6.0, 97)
    member = stepper.integrate_ensemble([[0.5], [1.0]], [[0.0], [0.0]], **settings)[1]
    assert member.at(times)[1] == pytest.approx(stepper.integrate([1.0], [0.0], **settings).at(times)[1], abs=1e-12)


@pytest.mark.full
def test_steps_across_kinks_are_verified():
    """Sizes of tangent vectors are those of the parameters, without modes."""
    spring = lagrange("spring", "x", "x_dot**2/2 - k*positive_part(x)**2 - x**2", k=1.0)
    assert sc.verify(spring, "svi:1").passed


@pytest.mark.rotated
def test_modes_may_be_left_out_of_parameters_in_order():
    spring = lagrange("spring", "x", "x_dot**2/2 - k*positive_part(x)**2 - x**2", k=1.0)
    stepper = sc.compile_stepper(spring, "svi:4")
    assert (stepper.parameters, stepper.modes) == (("k",), ("mode_1",))
    runs = [stepper.integrate([1.0], [0.0], t_end=5.0, parameters=values) for values in ([2.0], [2.0, 0.0], {"k": 2.0})]
    assert len({run.q.tobytes() for run in runs}) == 1
    with pytest.raises(sc.ArgumentError, match="takes no 'kinks'"):
        sc.compile_stepper(spring, "svi:4", kinks="as formulas")


@pytest.mark.rotated
def test_a_stiffness_is_fitted_across_kinks():
    floor = lagrange("floor", "y", "y_dot**2/2 - 9.8*y - k*positive_part(-y)**2", k=1e3)
    stepper, times = sc.compile_stepper(floor, "svi:4"), np.arange(0.1, 2.01, 0.05)
    measured = stepper.integrate([1.0], [0.0], t_end=2.0, t_eval=times, parameters={"k": 1.2e3}).q
    start = {"q": [1.0], "p": [0.0], "start": 0.0, "fit_initial_state": False}
    fit = sc.fit(stepper, times, measured, **start, parameters={"k": 1.1e3}, unknown=["k"], h=0.01)
    assert fit.parameters["k"] == pytest.approx(1.2e3, rel=1e-9)


@pytest.mark.rotated
def test_periodic_orbits_between_springy_walls():
    """Of any velocity v: 4/v in flight and half a period of each spring."""
    walls = lagrange("walls", "x", "x_dot**2/2 - 50*(positive_part(x - 1)**2 + positive_part(-x - 1)**2)")
    orbit = sc.periodic_orbit(sc.compile_stepper(walls, "svi:4"), [0.0], [1.0], period=4.6)
    assert orbit.period == pytest.approx(4 / np.sqrt(2 * orbit.energy) + np.pi / 5, rel=1e-9)


def duration_of_contact(v: float) -> float:
    """Time from y = 0 to y = 0 with L = y_dot^2/2 - 10 y - 1e5 positive_part(-y)^(5/2), by y = -d (1 - z^2)."""
    d = brentq(lambda y: v * v + 20.0 * y - 2e5 * y**2.5, 1e-9, 1.0, xtol=1e-17, rtol=1e-15)
    rate = lambda z: 2e5 * d**1.5 * -np.expm1(2.5 * np.log1p(-z * z)) / z**2 - 20.0  # noqa: E731
    return 4.0 * np.sqrt(d) * quad(lambda z: 1.0 / np.sqrt(rate(z)), 0.0, 1.0, epsabs=0.0, epsrel=1e-13)[0]


@pytest.mark.rotated
@pytest.mark.parametrize(
    ("method", "tolerance", "bound"), [("svi:4", 1e-8, 1e-6), ("svi:8", 1e-8, 2e-7), ("svi:8", None, 1e-12)]
)
def test_adaptive_steps_keep_the_tolerance_at_powers_that_are_not_whole(method, tolerance, bound):
    """A Hertz ball that is dropped from 50 heights and bounces ten times, and one that starts on the surface."""
    hertz = lagrange("hertz", "y", "y_dot**2/2 - 10*y - 1e5*positive_part(-y)**(5/2)")
    stepper, heights = sc.compile_stepper(hertz, method), np.linspace(0.3, 2.0, 50)
    falls, plan = np.sqrt(heights / 5.0), {"tolerance": tolerance} if tolerance else {}
    ends = 10 * (2 * falls + [duration_of_contact(10.0 * fall) for fall in falls]) + falls / 2
    runs = stepper.integrate_ensemble(heights[:, None], np.zeros((50, 1)), t_end=ends, **plan)
    assert np.abs(runs.ends[1][:, 0] - 0.75 * heights).max() < bound
    assert runs.ends[1][7] == stepper.integrate([heights[7]], [0.0], t_end=ends[7], **plan).q[-1]
    start = stepper.integrate([0.0], [-3.0], t_end=duration_of_contact(3.0) + 0.1, **plan)
    assert abs(start.q[-1, 0] - 0.25) < bound


@pytest.mark.rotated
def test_a_ball_that_returns_to_a_kink_in_its_first_step_does_not_rest_there():
    """It falls with x'' = -3/2 from x = 0, v to -v at t = 4v/3, and then moves by x'' = 1/2 - x."""
    ball = lagrange("ball", "x", "x_dot**2/2 - abs(x) - x/2 - x**2*unit_step(-x)/2")
    run, t = sc.compile_stepper(ball, "svi:8").integrate([0.0], [1.0], t_end=2.0), 2.0 / 3.0
    expected = 4 * np.cos(t) / 3 - 5 * np.sin(t) / 3
    assert np.abs(run.q[:2]).max() < 1e-15
    assert run.tangent([0.0, 1.0])[-1, 0] == pytest.approx(expected, abs=1e-12)


def test_a_start_just_below_a_kink_leaves_it_at_the_time_of_the_start():
    stepper = sc.compile_stepper(lagrange("pad", "x", "x_dot**2/2 - 500*positive_part(-x)**2"), "svi:4")
    for x in -np.logspace(-60, -17, 50):
        run = stepper.integrate([x], [1.4], t_end=0.01)
        assert run.q[-1, 0] == pytest.approx(0.014, rel=1e-15)
        assert (np.diff(run.t) >= 0.0).all()


def test_the_last_output_time_may_be_that_of_a_crossing():
    stepper = sc.compile_stepper(lagrange("modulus", "x", "x_dot**2/2 - x**2*abs(x)/3"), "svi:8")
    (switch,) = stepper.integrate([1.0], [0.1], t_end=2.0).switches
    for end in switch.t + np.array([1e-15, 2e-15, 4e-15]):  # within rounding of the step's end
        assert stepper.integrate([1.0], [0.1], t_end=end, t_eval=[1.0, end]).t.tolist() == [1.0, end]


@pytest.mark.rotated
@pytest.mark.parametrize("constraint", ["y = x**2/4", "y = positive_part(x)**2 + x**2/4"])
def test_derivatives_of_rest_on_a_constraint(constraint):
    """At rest momenta are rounding of constraint forces; at a kink the derivatives are undefined, by name."""
    track = lagrange("track", "x y", "(x_dot**2 + y_dot**2)/2 - 9.81*y", constraints=[constraint])
    stepper, cosine = sc.compile_stepper(track, "svi:8"), np.cos(0.3 * np.sqrt(9.81 / 2))
    run = stepper.integrate([0.0, 0.0], [0.0, 0.0], h=0.1, steps=3)
    if "positive" not in constraint:
        assert run.tangent([1, 0, 0, 0])[-1, 0] == pytest.approx(cosine, abs=1e-12)
        return
    for derive in (run.sensitivity, *(partial(sc.equilibrium, stepper, q) for q in ([0.0, 0.0], [0.01, 0.0]))):
        with pytest.raises(sc.StateError, match=r"rests at a kink of its equations, 'x' = 0"):
            derive()
    with pytest.warns(sc.AccuracyWarning, match=re.escape("-x**2*unit_step(x) - x**2/4 + y")):
        stepper.integrate([1e-3, 0.0], [0.0, 0.0], h=0.1, steps=1)


def between_whole_numbers(a, b, c, of, x, v, t_end):
    """Return the state of x'' = -x + c n, n the whole number nearest to a of(x, v, t) + b, by DOP853 between jumps."""
    t, y, n = 0.0, np.array([x, v]), np.rint(a * of(x, v, 0.0) + b)
    while t < t_end:
        ends = [lambda t, y, n=n, side=side: a * of(*y, t) + b - n - side / 2 for side in (-1, 1)]
        for side, end in zip((-1, 1), ends, strict=True):
            end.terminal, end.direction = True, side
        rates = lambda t, y, n=n: [y[1], -y[0] + c * n]  # noqa: E731
        run = solve_ivp(rates, (t, t_end), y, "DOP853", events=ends, rtol=1e-13, atol=1e-14, max_step=0.02)
        t, y, n = run.t[-1], run.y[:, -1], n + len(run.t_events[1]) - len(run.t_events[0])
    return y


OF = {"x": lambda x, v, t: x, "x_dot": lambda x, v, t: v, "t": lambda x, v, t: t}


@pytest.mark.second
@pytest.mark.parametrize("of", OF)
def test_whole_numbers_in_forces_are_kinks(of):
    """8 random forces each that jump with the whole number nearest to a place, a velocity or a time."""
    force = {"x": f"-x + c*rint(a*{of} + b)"}
    stepper = sc.compile_stepper(lagrange("whole", "x", "x_dot**2/2", forces=force, a=1.0, b=0.0, c=1.0), "svi:3")
    for number in range(8):
        a, b, x, v = np.random.default_rng([97, number]).uniform([0.5, -0.5, -1, 0.5], [2, 0.5, 1, 2])
        c = {"x": 0.3, "x_dot": 0.2, "t": 0.1}[of] / a
        exact = between_whole_numbers(a, b, c, OF[of], x, v, 4.0)
        for steps in ({"h": 0.04}, {"tolerance": 1e-11}):
            run = stepper.integrate([x], velocity=[v], t_end=4.0, parameters={"a": a, "b": b, "c": c}, **steps)
            assert [run.q[-1, 0], run.velocity[-1, 0]] == pytest.approx(exact, abs=1e-7), (number, steps)


def test_whole_numbers_in_whole_numbers_are_refused():
    """The remedy is followed: rint(u + n) = rint(u) + n."""
    with pytest.raises(sc.MethodError, match=r"rint\(u \+ n\) with a whole n as rint\(u\) \+ n"):
        sc.compile_stepper(lagrange("whole", "x", "x_dot**2/2", forces={"x": "rint(x + rint(2*x))"}), "svi:3")
    stepper = sc.compile_stepper(lagrange("whole", "x", "x_dot**2/2", forces={"x": "rint(x) + rint(2*x)"}), "svi:3")
    assert len(stepper.modes) == 2
