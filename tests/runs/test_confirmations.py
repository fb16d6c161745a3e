"""Random runs with ``error=``, some with narrow forces: none is falsely confirmed; those with kinks: test_kinks.py.

References are closed forms, or DOP853 at a relative tolerance of 3e-14.
"""

import math
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import mpmath
import numpy as np
import pytest
from commands import json_of
from notation import lagrange
from scipy.integrate import solve_ivp

import scvi_codegen as sc

PI = np.longdouble(4.0) * np.arctan(np.longdouble(1.0))
REFERENCE_TOLERANCE, REFERENCE_ERROR = 3e-14, 3e-12
"""Relative tolerance of references, and their largest relative error."""


@dataclass(frozen=True)
class Case:
    """A run and its reference.

    Attributes:
        kind: name of the system.
        stepper: stepper.
        arguments: of :meth:`Stepper.integrate`, without ``error``.
        positions: function of times (n,) that returns positions (n, m).
    """

    kind: str
    stepper: Any
    arguments: dict[str, Any]
    positions: Callable[[np.ndarray], np.ndarray]


SMOOTH = {
    "oscillator": (("x",), "x_dot**2/2 - w**2*x**2/2 - c*x**4/4", {}, {"w": 1.0, "c": 0.0}),
    "pendulum": (("a",), "a_dot**2/2 + w**2*cos(a - c)", {}, {"w": 1.0, "c": 0.0}),
    "Kepler": (("x", "y"), "(x_dot**2 + y_dot**2)/2 + 1/sqrt((x - c)**2 + y**2)", {}, {"c": 0.0}),
    "driven": (("x",), "x_dot**2/2 - x**2/2 - x**4/4", {"x": "w*cos(c*t) - x_dot/8"}, {"w": 1.0, "c": 1.0}),
    "double pendulum": (
        ("a", "b"), "a_dot**2 + b_dot**2/2 + a_dot*b_dot*cos(a - b) + w*(2*cos(a) + cos(b))", {}, {"w": 1.0},
    ),
    "charge": (
        ("x", "y", "z"), "(x_dot**2 + y_dot**2 + z_dot**2)/2 + w*(x*y_dot - y*x_dot)/2 - (x**2 + y**2 - z**2)*c/2",
        {}, {"w": 1.0, "c": 0.1},
    ),
}  # fmt: skip
NARROW = {
    "flash": (("x",), "x_dot**2/2", {"x": "k*exp(-((t - a)/w)**2)"}, {"a": 5.0, "w": 0.1, "k": 1.0}),
    "well": (("x",), "x_dot**2/2 + k*(1 - tanh((x - a)/w)**2)", {}, {"a": 5.0, "w": 0.1, "k": 1.0}),
}
METHODS = ("svi:4", "svi:6", "svi:8")


@cache
def stepper_of(kind: str, method: str) -> Any:
    names, lagrangian, forces, parameters = (SMOOTH | NARROW)[kind]
    system = lagrange("motion", names, lagrangian, forces=forces, **parameters)
    return sc.compile_stepper(system, method)


def integrated(rates, y0, times):
    """Return states (n, d) at times, the first one included."""
    run = solve_ivp(rates, (times[0], times[-1]), y0, "DOP853", times, rtol=REFERENCE_TOLERANCE, atol=1e-15)
    return run.y.T


def on_an_ellipse(r, v, times):
    """Return (n, 2) positions of Kepler's problem from the pericentre at distance r, with velocity v."""
    r, v, t = np.longdouble(r), np.longdouble(v), times.astype(np.longdouble)
    a = 1 / (2 / r - v * v)
    e, mean = 1 - r / a, t / a ** np.longdouble(1.5)
    whole = np.floor(mean / (2 * PI) + 0.5) * 2 * PI
    low, high = np.full_like(mean, -PI), np.full_like(mean, PI)
    for _ in range(80):
        middle = (low + high) / 2
        above = middle - e * np.sin(middle) > mean - whole
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    return np.stack([a * (np.cos(low) - e), a * np.sqrt(1 - e * e) * np.sin(low)], axis=1).astype(float)


def smooth_case(random, kind):
    """Return arguments, and a function of times that returns positions."""
    u, span = random.uniform, random.uniform(2.0, 25.0)
    values = {"w": 10.0 ** u(-0.5, 0.7), "c": u(0.0, 2.0)}
    if kind == "double pendulum":
        q, p, values, span = u(-1.2, 1.2, 2), u(-0.5, 0.5, 2), {"w": values["w"]}, span / 4

        def rates(t, y):
            a, b, pa, pb = y
            c = math.cos(a - b)
            va, vb = (pa - c * pb) / (2 - c * c), (2 * pb - c * pa) / (2 - c * c)
            g = va * vb * math.sin(a - b)
            return [va, vb, -g - 2 * values["w"] * math.sin(a), g - values["w"] * math.sin(b)]

    elif kind == "Kepler":
        e, c = 1.0 - 10.0 ** u(-1.5, -0.05), random.choice([0.0, 3.0, -10.0])
        q, p, values = np.array([1.0 - e + c, 0.0]), np.array([0.0, math.sqrt((1.0 + e) / (1.0 - e))]), {"c": c}
        arguments = {"q": q, "p": p, "t_end": span, "parameters": values}
        return arguments, lambda times: np.array([c, 0.0]) + on_an_ellipse(q[0] - c, p[1], times)

    elif kind == "charge":
        q, p = u(-1.0, 1.0, 3) * [1.0, 1.0, random.choice([1.0, 1e-9])], u(-1.0, 1.0, 3) * [1.0, 1.0, 0.0]
        w, c = values["w"], 0.1 * values["c"]
        values["c"] = c

        def rates(t, y):
            x, z, s, px, py, pz = y
            vx, vy = px + w * z / 2, py - w * x / 2
            return [vx, vy, pz, w * vy / 2 - c * x, -w * vx / 2 - c * z, c * s]

        span = min(span, 8.0)
    else:
        q, p = u(-1.5, 1.5, 1), u(-1.0, 1.0, 1)
        w, c = values["w"], values["c"]
        centre = 0.0  # tolerances of the judge are relative to the distance from it
        if kind == "pendulum":
            values["c"] = c = random.choice([0.0, 2.0 * math.pi * 10, -1.0])
            q, centre = q + c, c
        force = {
            "oscillator": lambda t, x, v: -(w**2) * x - c * x**3,
            "pendulum": lambda t, x, v: -(w**2) * math.sin(x),
            "driven": lambda t, x, v: -x - x**3 + w * math.cos(c * t) - v / 8,
        }[kind]

        def rates(t, y):
            return [y[1], force(t, y[0], y[1])]

        arguments = {"q": q, "p": p, "t_end": span, "parameters": values}
        return arguments, lambda times: integrated(rates, [*(q - centre), *p], times)[:, :1] + centre

    m = len(q)
    arguments = {"q": q, "p": p, "t_end": span, "parameters": values}
    return arguments, lambda times: integrated(rates, [*q, *p], times)[:, :m]


def narrow_case(random, kind):
    """Return arguments, and a function of times that returns positions; the width is 1e-4 to 1 of the duration."""
    u, span, x0, v = random.uniform, random.uniform(3.0, 12.0), random.uniform(-1.5, 1.5), random.uniform(0.3, 1.5)
    a, w, k = u(0.1, 0.9) * span, 10.0 ** u(-4.0, 0.0) * span, u(-0.8, 0.8)
    erf = np.vectorize(math.erf)
    if kind == "flash":
        k /= w
        impulse, before = k * w * math.sqrt(math.pi) / 2, -a / w

        def exact(t):
            integral = [z * erf(z) + np.exp(-z * z) / math.sqrt(math.pi) for z in ((t - a) / w, before)]
            return x0 + v * t + impulse * (w * (integral[0] - integral[1]) - erf(before) * t)

    else:  # sinh((x - a)/w) grows as the sine of an oscillator of negative stiffness (Poeschl & Teller)
        a, w, k = x0 + v * a, w * v, k * v * v / 2
        energy = v * v / 2 - k * (1.0 - math.tanh((x0 - a) / w) ** 2)
        rate, ratio = math.sqrt(2 * energy) / w, math.sqrt(1 + k / energy)
        start = float(_arcsinh_of(1 / ratio, np.float64((x0 - a) / w)))

        def exact(t):
            return a + w * _arcsinh_of(ratio, start + rate * t)

    arguments = {"q": [x0], "p": [v], "t_end": span, "parameters": {"a": a, "w": w, "k": k}}
    return arguments, lambda times: exact(times)[:, np.newaxis]


def _arcsinh_of(ratio, y):
    """Return arcsinh(ratio sinh y)."""
    far, near = np.sign(y) * (abs(y) + math.log(ratio)), np.clip(y, -30.0, 30.0)
    return np.where(abs(y) < 30.0, np.arcsinh(ratio * np.sinh(near)), far)


FAMILIES = {"smooth": (SMOOTH, smooth_case), "narrow": (NARROW, narrow_case)}


def case_of(number: int, family: str, methods: Sequence[str] = METHODS) -> Case:
    """Return a random case, by one of the methods."""
    random = np.random.default_rng([number, 1 + [*FAMILIES].index(family)])
    kinds, arguments_of = FAMILIES[family]
    kind, method = [*kinds][number % len(kinds)], str(random.choice(methods))
    arguments, positions = arguments_of(random, kind)
    arguments["error"] = 10.0 ** random.uniform(-11.0, -3.0)
    return Case(kind, stepper_of(kind, method), arguments, positions)


def outcome(case: Case) -> tuple[str, float]:
    """Return ``"confirmed"``, ``"false"`` or ``"unconfirmed"``, and the true error relative to the bound."""
    with warnings.catch_warnings(action="ignore"):
        run = case.stepper.integrate(**case.arguments)
    reached = run.t <= run.confirmed_until
    times = np.unique(np.append(run.t, np.linspace(run.t[0], run.t[-1], 201)))
    exact = case.positions(times)
    sizes = np.ptp(exact[times <= run.confirmed_until], axis=0)
    errors = abs(np.asarray(run.q) - exact[np.searchsorted(times, run.t)])[reached]
    with np.errstate(all="ignore"):
        error = np.nan_to_num(errors / sizes)[1:].max(initial=0.0)
    ratio = float(error / case.arguments["error"])
    if error > case.arguments["error"] + REFERENCE_ERROR:
        return "false", ratio
    return ("confirmed" if run.confirmation.confirmed else "unconfirmed"), ratio


def counts(numbers, family: str, methods: Sequence[str] = METHODS) -> Counter:
    """Return how many cases of each kind have each outcome."""
    found = Counter()
    for number in numbers:
        case = case_of(number, family, methods)
        found[case.kind, outcome(case)[0]] += 1
    return found


def check(found: Counter, least: float) -> None:
    total = Counter()
    for (_, result), count in found.items():
        total[result] += count
    assert total["false"] == 0, found
    assert total["confirmed"] >= least * sum(total.values()), found


@pytest.mark.rotated
@pytest.mark.parametrize(("family", "kind"), [(family, kind) for family in FAMILIES for kind in FAMILIES[family][0]])
def test_no_error_is_confirmed_but_wrong(family, kind):
    """Three cases of each kind, more with narrow forces, some of which all stages miss; most are confirmed."""
    kinds = [*FAMILIES[family][0]]
    first, stride, count = kinds.index(kind), len(kinds), 15 if family == "narrow" else 3
    least = {"smooth": 0.6, "narrow": 0.8}[family]
    check(counts(range(first, first + count * stride, stride), family, ["svi:4"]), least)


@pytest.mark.rotated
def test_free_flight_is_examined_for_narrow_forces():
    """Without ``error=``: of thirty runs, steps that are not examined in pieces miss the force in eleven."""
    missed = 0
    for number in range(30):
        case = case_of(number, "narrow", ["svi:4"])
        run = case.stepper.integrate(**{name: x for name, x in case.arguments.items() if name != "error"})
        missed += abs(run.q[-1] - case.positions(run.t[-1:])[0]).max() > 1e-7
    assert missed <= 3


@pytest.mark.second
def test_runs_for_comparison_do_not_pass_over_the_tail_of_a_force():
    """One of them flies to its flank in one step, and loses 1e-8 of the impulse."""
    flash = stepper_of("flash", "svi:4")
    run = flash.integrate([0.1], [0.2], t_end=10.0, error=1e-12, parameters={"w": 0.01})
    assert run.global_error <= 1e-12
    assert run.p[-1, 0] - 0.2 == pytest.approx(0.01 * math.sqrt(math.pi), rel=1e-12)


@pytest.mark.full
@pytest.mark.parametrize(("family", "count", "least"), [("smooth", 2000, 0.95), ("narrow", 1000, 0.9)])
def test_no_false_confirmation_in_three_thousand_cases(family, count, least):
    check(counts(range(count), family), least)


FLOOR_HEIGHT = 2.55


@pytest.mark.rotated
def test_an_unconfirmed_motion_with_kinks_has_the_remedies_for_these():
    height, span = FLOOR_HEIGHT, 3.0 * math.sqrt(2.0 * FLOOR_HEIGHT / 9.8)
    floor = lagrange("floor", "y[N]", "sum(i in N, y_dot[i]**2/2 - 9.8*y[i] - 1e5*positive_part(-y[i])**2)")
    with pytest.warns(sc.MethodWarning, match="does not locate"):
        stepper = sc.compile_stepper(floor, "svi:4")
    with pytest.warns(sc.AccuracyWarning, match=r"max_step=, .*sc\.impact, sc\.Event.* not smooth where") as caught:
        stepper.integrate([height], [0.0], t_end=span, error=1e-14)
    assert "time transformation" not in str(caught[0].message)


@pytest.mark.rotated
@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_errors_are_relative_to_the_range_of_each_coordinate(offset):
    """A small oscillation beside a large one has its own size; far from the origin positions are rounded."""
    system = lagrange("two", ("x", "z"), "(x_dot**2 + z_dot**2)/2 - (x**2 + 2*(z - c)**2)/2", c=0.0)
    stepper = sc.compile_stepper(system, "svi:6")
    with warnings.catch_warnings(action="ignore"):
        run = stepper.integrate([1.0, offset + 2.0**-20], [0.0, 0.0], t_end=5.0, parameters={"c": offset}, error=1e-6)
    exact = 2.0**-20 * np.cos(math.sqrt(2.0) * run.t)
    off = np.abs(run.q[:, 1] - offset - exact).max() / np.ptp(exact)
    assert off <= run.global_error
    assert run.confirmation.confirmed == (offset == 0.0)


@pytest.mark.second
def test_a_coordinate_that_does_not_move_is_confirmed():
    """An equilibrium away from the origin, and rounding errors of a coordinate beside one that moves."""
    system = lagrange("two", ("x", "z"), "(x_dot**2 + z_dot**2)/2 - ((x - z)**2 + (x + z)**2)/4 - (z - 3)**2/2 + z*z/2")
    run = sc.compile_stepper(system, "svi:6").integrate([1.0, 3.0], [0.0, 0.0], t_end=5.0, error=1e-9)
    assert run.confirmation.confirmed


@pytest.mark.rotated
@pytest.mark.filterwarnings("error")
def test_rest_is_confirmed_and_its_energy_is_that_of_rounding():
    body = lagrange("body", [], "(omega_1**2 + 2*omega_2**2 + 3*omega_3**2)/2", rotations={"R": "omega"})
    start = {"velocity": {"omega": [0.0, 0.0, 0.0]}, "t_end": 20.0}
    run = sc.compile_stepper(body, "svi:6").integrate({"R": [1.0, 0.0, 0.0, 0.0]}, **start, error=1e-9)
    assert run.confirmation.confirmed
    assert run.confirmed_until == 20.0
    spring = sc.compile_stepper(lagrange("spring", "x", "x_dot**2/2 - 50*(x - 1000)**2"), "svi:6")
    assert spring.integrate([1000.0], velocity=[0.0], t_end=20.0, error=1e-9).confirmation.confirmed
    spring.integrate([np.nextafter(1000.0, 2000.0)], velocity=[0.0], t_end=20.0)


@pytest.mark.second
def test_two_words_confirm_more_digits():
    system = lagrange("oscillator", "x", "x_dot**2/2 - x**2/2")
    stepper = sc.compile_stepper(system, "svi:12", precision="double-double")
    run = stepper.integrate([1.0], [0.0], t_end=3.0, error=1e-26)
    assert run.confirmation.confirmed
    with mpmath.workdps(40):
        t, x = run.mp("t")[-1], run.mp("x")[-1]
        assert abs(x - mpmath.cos(t)) < 1e-26


@pytest.mark.rotated
def test_steps_of_a_confirmed_run_with_a_short_force_reproduce_it(tmp_path):
    """In Python, of models and on the command line: the tolerance and the largest step."""
    force = "exp(-1000000*(t - a)**2)"
    stepper = sc.compile_stepper(lagrange("motion", "x", "x_dot**2/2", forces={"x": force}, a=5.0), "svi:4")
    start = {"q": [0.0], "p": [1.0], "t_end": 10.0, "parameters": {"a": 4.1}}
    a = start["parameters"]["a"]
    with warnings.catch_warnings(action="ignore"):
        run = stepper.integrate(**start, error=1e-8)
    assert run.confirmation.confirmed
    assert run.confirmation.max_step < 0.1
    assert np.array_equal(stepper.integrate(**start, **run.confirmation.steps).q, run.q)
    path = tmp_path / "motor.toml"
    system = f'[system]\nname = "motion"\ncoordinates = ["x"]\nlagrangian = "x_dot**2/2"\n[forces]\nx = "{force}"'
    more = f'[parameters]\na = {a}\n[method]\nmethod = "svi:4"\n[run]\nspan = 10.0\nerror = 1e-8'
    path.write_text(f"{system}\n{more}\n[initial]\nq = [0.0]\np = [1.0]\n")
    assert np.array_equal(sc.load_model(path).integrate().q, run.q)
    found = json_of("run", path, "-o", tmp_path / "motor.npz")["global_error"]
    assert (found["confirmed"], found["tolerance"]) == (True, run.confirmation.tolerance)
    with np.load(tmp_path / "motor.npz") as file:
        assert np.array_equal(file["q"], run.q)


@pytest.mark.rotated
def test_kinks_of_arrays_are_found():
    """Two balls on a stiff floor: the second one meets it at the end of a step at all tolerances."""
    system = lagrange("floor", "y[N]", "sum(i in N, y_dot[i]**2/2 - 9.8*y[i] - 1e5*positive_part(-y[i])**2)")
    start = {"q": [1.7, FLOOR_HEIGHT], "t_end": 3.0 * math.sqrt(2.0 * FLOOR_HEIGHT / 9.8)}
    with warnings.catch_warnings(action="ignore"):
        run = sc.compile_stepper(system, "svi:4").integrate(**start, error=1e-6)
    assert run.stepper.interface.kinks == ("y[i] for i in N",)
    assert run.confirmation.confirmed
    assert run.q[-1, 1] == pytest.approx(0.04951824, abs=1e-6)


def confirmed(system, q, p, method="svi:6", **arguments):
    """Return a run with a bound, without its warnings."""
    with warnings.catch_warnings(action="ignore"):
        return sc.compile_stepper(lagrange("motion", *system), method).integrate(q, p, **arguments)


class TestSizes:
    """Motions beside larger ones, far from the origin and in encounters."""

    @pytest.mark.rotated
    def test_a_tiny_motion_next_to_a_large_one_has_its_own_size(self):
        run = confirmed(
            ("x z", "(x_dot**2 + z_dot**2)/2 - x**2/2 - z**2"), [1.0, 1e-14], [0.0, 0.0], t_end=5.0, error=1e-8
        )
        off = abs(run.q[:, 1] - 1e-14 * np.cos(math.sqrt(2.0) * run.t)).max()
        assert run.confirmation.confirmed
        assert off <= 1e-22

    @pytest.mark.rotated
    @pytest.mark.xfail(strict=True, reason="the search for short forces takes rounding of such forces for one")
    def test_a_small_separation_is_confirmed_as_far_as_positions_resolve_it(self):
        """x1 - x2 = 1e-8 at x = 1: the positions are rounded at 1e-8 of their range."""
        system = "x y", "(x_dot**2 + y_dot**2)/2 - (x - y)**2/2"
        loose, tight = (confirmed(system, [1.0, 1.0 + 1e-8], [0.0, 0.0], t_end=5.0, error=e) for e in (1e-6, 1e-9))
        apart = (1.0 + 1e-8) - 1.0
        for run in (loose, tight):
            exact = 1.0 + apart / 2 * (1.0 - np.cos(math.sqrt(2.0) * run.t))
            assert np.abs(run.q[:, 0] - exact).max() <= run.global_error * apart
        assert loose.confirmation.confirmed > tight.confirmation.confirmed

    @pytest.mark.rotated
    @pytest.mark.parametrize("shift", [0.0, 100.0])
    def test_a_close_encounter_far_from_the_origin(self, shift):
        e, system = 0.9999, ("x y", f"(x_dot**2 + y_dot**2)/2 + 1/sqrt((x - {shift:g})**2 + y**2)")
        q, p = [1.0 - e + shift, 0.0], [0.0, math.sqrt((1.0 + e) / (1.0 - e))]
        run = confirmed(system, q, p, "svi:8", t_end=6.0, error=1e-4)
        exact = on_an_ellipse(q[0] - shift, p[1], run.t) + np.array([shift, 0.0])
        assert run.confirmation.confirmed
        error = (np.abs(run.q - exact).max(axis=0) / np.ptp(exact, axis=0)).max()
        assert error <= 1e-4
        assert error <= 1.05 * run.global_error  # of first order: without its part of 6e-5

    @pytest.mark.rotated
    def test_nothing_is_confirmed_beyond_a_growth_that_exceeds_the_tolerance(self):
        """exp(-t) on a saddle, whose rounding errors grow by exp(t)."""
        run = confirmed(("q", "q_dot**2/2 + q**2/2"), [1.0], [-1.0], "svi:4", t_end=40.0, error=1e-6)
        reached = run.t <= run.confirmed_until
        assert np.abs(run.q[reached, 0] - np.exp(-run.t[reached])).max() <= 1e-6
        assert 15.0 < run.confirmed_until < 30.0

    @pytest.mark.rotated
    def test_absolute_tolerances_are_sizes(self):
        """Positions of a range of 1e-9, far from the origin, to 1e-6 of a size of 1."""
        system, start = ("x", "x_dot**2/2 - (x - 10)**2/2"), ([10.0 + 1e-9], [0.0])
        run = confirmed(system, *start, t_end=5.0, error=1e-6)
        assert not run.confirmation.confirmed
        assert confirmed(system, *start, t_end=5.0, error=1e-6, absolute_tolerance=1.0).confirmation.confirmed


@pytest.mark.rotated
@pytest.mark.parametrize("mass", [1.0, 2.0**-30])
def test_momenta_of_light_bodies_count(mass):
    """A body that crosses ripples: errors of its velocity are 100 times those of its position relative to its range."""
    text = "x_dot**2/2 - x**2/2 + m*(y_dot**2/2 + cos(9*y)/2)"
    ripples = sc.compile_stepper(lagrange("ripples", ("x", "y"), text, m=mass), "svi:4")
    run = ripples.integrate([1.0, 0.25], velocity=[0.0, 1.5], t_end=15.0, error=1e-5)
    y, v = integrated(lambda t, z: [z[1], -4.5 * math.sin(9.0 * z[0])], [0.25, 1.5], run.t).T
    of_q, of_v = abs(run.q[:, 1] - y).max() / np.ptp(y), abs(run.p[:, 1] / mass - v).max() / abs(v).max()
    assert of_v > 10.0 * of_q
    assert run.confirmation.confirmed
    assert run.global_error == pytest.approx(of_v, rel=0.01)
