"""Steps that choose their own length: accuracy on exact motions, ends, refusals; the error of a step in every run."""

import math
from contextlib import suppress

import numpy as np
import pytest
from mpmath import mp
from notation import lagrange
from scipy.special import ellipj

import scvi_codegen as sc

SPAN = 60.0


@pytest.fixture(scope="module")
def kepler():
    return sc.compile_stepper(sc.problem("kepler").system, sc.SVI(8))


def orbit(e, anomaly=0.3):
    """(q, p) on an ellipse of semi-axis 1."""
    p = 1.0 - e * e
    r = p / (1.0 + e * math.cos(anomaly))
    return (
        [r * math.cos(anomaly), r * math.sin(anomaly)],
        [-math.sin(anomaly) / math.sqrt(p), (e + math.cos(anomaly)) / math.sqrt(p)],
    )


def exact_position(q, p, t):
    """Return the position from Kepler's equation in 40 digits, with Lagrange coefficients."""
    with mp.workdps(40):
        (x, y), (u, v) = map(mp.mpf, q), map(mp.mpf, p)
        r = mp.hypot(x, y)
        a = 1 / (2 / r - (u * u + v * v))
        n, cosine, sine = a ** mp.mpf("-1.5"), 1 - r / a, (x * u + y * v) / mp.sqrt(a)

        def misfit(E):
            return E - cosine * mp.sin(E) + sine * (1 - mp.cos(E)) - n * t

        E = mp.findroot(misfit, (n * t - 1, n * t + 1), solver="anderson", tol=1e-70)
        f, g = 1 - a / r * (1 - mp.cos(E)), t - (E - mp.sin(E)) / n
        return np.array([float(f * x + g * u), float(f * y + g * v)])


@pytest.mark.parametrize(("e", "error"), [(0.0, 1e-12), (0.2, 1e-12), (0.5, 1e-12), (0.9, 5e-12), (0.99, 5e-11)])
def test_ellipse_is_followed_to_round_off_without_step_arguments(kepler, e, error):
    q, p = orbit(e)
    run = kepler.integrate(q, p, t_end=SPAN)
    assert run.t[-1] == SPAN
    assert (np.diff(run.t) > 0.0).all()
    assert np.abs(run.q[-1] - exact_position(q, p, SPAN)).max() < error
    energy = run.energy()
    assert np.abs(energy / energy[0] - 1.0).max() < (1e-12 if e > 0.9 else 3e-14)
    assert np.abs(run.momentum_errors()).max() < 1e-13
    assert run.steps == len(run) - 1
    assert run.rejected_steps <= 0.02 * run.steps
    assert run.step_error < 1e-15
    assert run.iterations.sum() < 6 * run.steps


def test_collision_is_rejected_where_it_occurs(kepler):
    with pytest.raises(sc.StepFailedError, match="collision") as failure:
        kepler.integrate([1.0, 0.0], [0.0, 0.0], t_end=2.0)
    assert failure.value.t == pytest.approx(math.pi / math.sqrt(8.0), rel=1e-6)  # the time of free fall
    assert len(failure.value.trajectory) > 10


@pytest.mark.second
def test_equilibria_and_free_particles_need_few_steps():
    free = sc.compile_stepper(lagrange("free", "x", "x_dot**2/2"), sc.SVI(8))
    run = free.integrate([0.0], [2.0], t_end=1000.0)
    assert run.q[-1] == [2000.0]
    assert run.steps < 40
    assert free.integrate([3.0], [0.0], t_end=1000.0).q[-1] == [3.0]
    assert len(free.integrate([3.0], [1.0], t=5.0, t_end=5.0)) == 1


@pytest.mark.rotated
def test_newton_solves_stiff_systems_with_steps_of_the_slow_time_scale():
    """A last step that is short would resolve the vibrations, of which there are 30,000 in this time."""
    system = lagrange("penalty pendulum", "x y", "(x_dot**2 + y_dot**2)/2 - y - k*(x**2 + y**2 - 1)**2/8", k=1e10)
    stiff = sc.compile_stepper(system, sc.SVI(6), solver="newton")
    rigid = sc.compile_stepper(sc.problem("planar-pendulum").system, sc.SVI(6))
    for start, tolerance in ((1.0, 1e-9), (1.0, 1e-7), (1.1, 1e-7), (1.2, 1e-6), (1.3, 1e-6)):
        q = [math.sin(start), -math.cos(start)]
        run = stiff.integrate(q, [0.0, 0.0], t_end=2.0, tolerance=tolerance)
        angle = rigid.integrate([start], [0.0], t_end=2.0, parameters={"g": 1.0, "l": 1.0, "m": 1.0}).q[-1, 0]
        assert run.steps < 150, (start, tolerance)
        assert np.abs(run.q[-1] - [math.sin(angle), -math.cos(angle)]).max() < 10 * tolerance
        assert np.ptp(run.energy()) < 1e3 * tolerance


@pytest.mark.rotated
@pytest.mark.parametrize(
    "method", ["svi:5", *(pytest.param(name, marks=pytest.mark.full) for name in ("svi:8", "gauss:4"))]
)
def test_initial_step_size_is_found_for_zero_velocity(method):
    """A cart at rest, pushed: rounding hides what short steps make of its velocity, and they fail."""
    text = "x_dot**2 + x + (x_dot + 0.6*a_dot*cos(a))**2/4 + (0.6*a_dot*sin(a))**2/4 + 3*cos(a)"
    crane = lagrange("crane", "x a", text, forces={"a": "-0.05*a_dot"})
    start = {"q": [0.1, 2.8], "velocity": [0.0, 0.3], "t_end": 1.0}
    found = sc.compile_stepper(crane, method).integrate(**start)
    known = sc.compile_stepper(crane, method, solver="newton").integrate(**start)
    assert found.steps < 300
    assert np.abs(found.q[-1] - known.q[-1]).max() < 1e-13


@pytest.mark.rotated
@pytest.mark.parametrize("tolerance", [1e-8, 1e-12])
def test_degree_two_error_estimate_uses_the_change_of_force(tolerance):
    """At rest the force is initially constant: q = 2 asin(k cd(t, k)) (Whittaker, Analytical Dynamics, 44)."""
    pendulum = sc.LagrangianSystem.from_text(name="pendulum", coordinates=["q"], lagrangian="q_dot**2/2 + cos(q)")
    run = sc.compile_stepper(pendulum, "svi:2").integrate([1.0], [0.0], t_end=2.0, tolerance=tolerance)
    k = math.sin(0.5)
    _, cn, dn, _ = ellipj(run.t, k * k)
    errors = np.abs(run.q[:, 0] - 2 * np.arcsin(k * cn / dn))
    assert errors[1] <= 2 * tolerance
    assert errors.max() < (len(run) - 1) * tolerance


@pytest.mark.rotated
def test_a_singular_time_inside_a_run_is_resolved_or_its_error_reported():
    """The force -log((t - 1)^2): q(2) = q(0) + 4 from rest. The step across t = 1 has the error of the whole run."""
    singular = lagrange("singular", "q", "q_dot**2/2 - q*log((t - 1)**2)")
    stepper = sc.compile_stepper(singular, sc.SVI(8))
    for tolerance in (1e-8, 1e-10, None):
        run = stepper.integrate([1.0], [0.0], t_end=2.0, tolerance=tolerance, check_growth=False)
        error, wanted = abs(run.q[-1, 0] - 5.0) / 5.0, tolerance or 1e-13
        assert error < 200.0 * wanted, tolerance
        assert error < 10.0 * run.step_error <= 1e3 * wanted, tolerance


@pytest.mark.rotated
@pytest.mark.parametrize("method", ["svi:4", "svi:8"])
@pytest.mark.parametrize("force", ["1/(t - a)", "x/(t - a)", "1/(t - a)**2"])
def test_a_pole_in_time_ends_a_run(method, force):
    """Steps of 1e-6 hide the error of any force in positions; of eight runs five to eight passed, without a report.

    A step in whose middle the pole is may still pass, with the principal value.
    """
    system = lagrange("pole", "x", "x_dot**2/2", forces={"x": force}, a=1.0)
    stepper, passed = sc.compile_stepper(system, method), 0
    for a in np.linspace(0.73, 2.9, 8).tolist():
        with suppress(sc.StepFailedError):
            stepper.integrate([1.0], [0.0], t_end=a + 1.1, tolerance=1e-6, parameters={"a": a}, check_growth=False)
            passed += 1
    assert passed <= 1


@pytest.mark.rotated
def test_first_step_is_found_without_larger_ones_at_which_the_iteration_diverges():
    """Released at 1.5 rad; steps beyond 1.5 send the angle to 1e16, where cosines take a hundred times as long."""
    atwood = lagrange("atwood", "r s", "2*r_dot**2 + r**2*s_dot**2/2 - r*(3 - cos(s))")
    run = sc.compile_stepper(atwood, sc.SVI(8)).integrate([1.0, 1.5], [0.0, 0.0], t_end=40.0, tolerance=1e-5)
    assert run.iterations[1] <= 24  # of all trials; 46 with those at sizes of 19 and 40
    assert run.rejected_steps < 14


@pytest.mark.rotated
def test_newtons_method_is_not_tried_where_errors_forbid_its_larger_steps():
    """At a loose tolerance the iteration fails at sizes near those that errors allow; 50 iterations more, in vain."""
    atwood = lagrange("atwood", "r s", "2*r_dot**2 + r**2*s_dot**2/2 - r*(3 - cos(s))")
    for angle in (1.48, 1.5, 1.52):
        runs = [
            sc.compile_stepper(atwood, sc.SVI(8), solver=solver).integrate(
                [1.0, angle], [0.0, 0.0], t_end=40.0, tolerance=1e-2, check_growth=False
            )
            for solver in ("auto", "fixed-point")
        ]
        assert runs[0].iterations.tolist() == runs[1].iterations.tolist()


@pytest.mark.second
def test_step_that_ends_within_a_millionth_of_t_end_ends_there():
    system = sc.LagrangianSystem.from_text(name="unit", coordinates=["x"], lagrangian="x_dot**2/2 - x**2/2")
    stepper = sc.compile_stepper(system, "svi:4", flags=("-O0",))

    def times(t_end):
        return stepper.integrate([1.0], [0.0], t_end=t_end, tolerance=1e-8).t

    found = times(1.2)[:-1]  # the last two steps are equal
    length, t_end = found[-1] - found[-2], found[-1]
    for change, more in ((-1e-3, 0), (-5e-7, 0), (-1e-9, 0), (0.0, 0), (1e-9, 0), (5e-7, 0), (1e-3, 1)):
        changed = times(t_end + change * length)
        assert changed[-1] == t_end + change * length
        assert len(changed) == len(found) + more


FAR = [1e14, 1e15]


@pytest.fixture(scope="module")
def far_away():
    """Ways in which an oscillator moves by 2 units of time from a time on."""
    text = {"name": "oscillator", "coordinates": ["q"], "lagrangian": "q_dot**2/2 - q**2/2"}
    system = sc.LagrangianSystem.from_text(**text)
    pushed = sc.LagrangianSystem.from_text(**text, forces={"q": "u"}, inputs=["u"])
    summed = lagrange("oscillators", "q[N]", "sum(i in N, q_dot[i]**2/2 - q[i]**2/2)")
    adaptive, reversible, clocked, driven, indexed = (
        sc.compile_stepper(system, "gauss:4"),
        sc.compile_stepper(system, "svi:3", time_transformation="1/(1 + q**2)"),
        sc.compile_stepper(sc.reparametrise(system, "1/(1 + q**2)"), "svi:3"),
        sc.compile_stepper(pushed, "svi:3"),
        sc.compile_stepper(summed, "svi:3"),
    )

    def inputs(t):
        return {"u": ([t - 5.0, t + 1.0, t + 5.0], [0.0, 0.0, 0.0])}

    return {
        "adaptive": lambda t, end: adaptive.integrate([1.0], [0.0], t=t, t_end=end),
        "reversible": lambda t, end: reversible.integrate([1.0], [0.0], t=t, t_end=end, h=0.02),
        "clocked": lambda t, end: clocked.integrate([1.0], [0.0], t=t, t_end=end, h=np.copysign(0.02, end - t)),
        "driven": lambda t, end: driven.integrate(
            [1.0], [0.0], inputs=inputs(t), t=t, t_end=end, h=np.copysign(0.07, end - t)
        ),
        "driven, adaptive": lambda t, end: driven.integrate([1.0], [0.0], inputs=inputs(t), t=t, t_end=end),
        "indexed": lambda t, end: indexed.integrate([1.0], [0.0], t=t, t_end=end),
    }


WAYS = ["adaptive", "reversible", "clocked", "driven", "driven, adaptive", "indexed"]


@pytest.mark.rotated
@pytest.mark.sampled(4)
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("span", [2.0, -2.0])
def test_runs_end_at_t_end_including_the_low_word_of_time(far_away, way, span):
    """At t = 1e15 an ulp is 1/8, longer than a step: time alone is t_end some steps too early."""
    near = far_away[way](0.0, span)
    for t in FAR:
        run = far_away[way](t, t + span)
        q, there = (x.q["q"] if way == "indexed" else x.q for x in (run, near))
        assert run.t[-1] == t + span
        assert run.steps == near.steps
        assert abs(q[-1, 0] - there[-1, 0]) < 1e-13
        assert abs(q[-1, 0] - math.cos(span)) < 1e-10


@pytest.fixture(scope="module")
def oscillators():
    """A stepper and an indexed one, with the names that their event functions use."""
    system = sc.LagrangianSystem.from_text(name="o", coordinates=["q"], lagrangian="q_dot**2/2 - q**2/2")
    summed = lagrange("o", "q[N]", "sum(i in N, q_dot[i]**2/2 - q[i]**2/2)")
    return {"q": sc.compile_stepper(system, "svi:4"), "q[0]": sc.compile_stepper(summed, "svi:4")}


@pytest.mark.rotated
def test_many_iterations_limit_the_step_size():
    """At 1e-3 the error of a charge in a field that depends on z allows sizes at which the iteration diverges."""
    system = lagrange("charge", "x y z", "(x_dot**2 + y_dot**2 + z_dot**2)/2 + (5 + 5*z**2/2)*(x*y_dot - y*x_dot)")
    stepper = sc.compile_stepper(system, sc.SCVI(5))
    start = {"q": [0.3, 0.0, 0.2], "velocity": [0.0, 1.0, 0.3], "t_end": 50.0}
    exact = stepper.integrate(**start)
    loose, middle, tight = (stepper.integrate(**start, tolerance=tolerance) for tolerance in (1e-3, 1e-5, 1e-6))
    assert max(run.rejected_steps for run in (loose, middle, tight)) < 25
    assert loose.steps < middle.steps < tight.steps
    counts = [run.iterations.sum() for run in (loose, middle, tight)]
    assert counts[0] < counts[1] < counts[2] < 11_000  # 9,500, 13,600 and 14,200 if the error alone decides
    errors = [np.abs(run.q[-1] - exact.q[-1]).max() for run in (loose, middle, tight)]
    assert errors[0] > errors[2]
    assert errors[0] < 0.1


RANDOM_SYSTEMS = {
    "pendulum": (lagrange("pendulum", "a", "a_dot**2/2 + cos(a)"), 1, 20.0),
    "Duffing": (lagrange("Duffing", "x", "x_dot**2/2 + x**2/2 - x**4/4"), 1, 20.0),
    "two pendula": (sc.problem("double-pendulum").system, 2, 3.0),
    "Kepler": (lagrange("Kepler", "x y", "(x_dot**2 + y_dot**2)/2 + 1/sqrt((1 + x)**2 + y**2)"), 2, 20.0),
    "stiff": (lagrange("stiff", "x y", "(x_dot**2 + y_dot**2)/2 - x**2/2 - 500*(y - x**2)**2"), 2, 5.0),
    "rod": (lagrange("rod", "x y", "(x_dot**2 + y_dot**2)/2 - y", constraints=["(x + 1)**2 + y**2 - 1"]), 2, 10.0),
}
"""Systems with the number of their coordinates and a span: random starts are about rest at the origin."""


@pytest.mark.rotated
@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(
            name,
            marks=[
                pytest.mark.xfail(
                    strict=True, reason="iterations, not errors, limit steps at both: 9 to 14, failures decide"
                )
            ]
            if name == "rod"
            else [],
        )
        for name in RANDOM_SYSTEMS
    ],
)
def test_looser_tolerances_take_fewer_iterations(name):
    """No system takes more iterations at 1e-3 than at 1e-8."""
    system, m, span = RANDOM_SYSTEMS[name]
    stepper, random = sc.compile_stepper(system, "svi:8"), np.random.default_rng(5)
    for _ in range(6):
        q, velocity = np.zeros(m), random.uniform(-0.9, 0.9, m)
        if name == "rod":
            velocity[0] = 0.0
        elif name == "Kepler":
            velocity[1] += np.copysign(0.5, velocity[1])
        else:
            q = random.uniform(-0.9, 0.9, m)
        counts = [
            stepper.integrate(
                q, velocity=velocity, t_end=span, tolerance=tolerance, check_growth=False
            ).iterations.sum()
            for tolerance in (1e-3, 1e-8)
        ]
        assert counts[0] <= counts[1], (q, velocity)


@pytest.mark.rotated
def test_a_coordinate_that_begins_to_move_beside_another_takes_few_steps():
    """Relative to its own motion the error of a motion from rest is the same at all step sizes."""
    text = "(x_dot**2 + y_dot**2)/2 - g*x**2/2 - y**2/2 - a*x*y"
    stepper, random = sc.compile_stepper(lagrange("two", "x y", text, g=1.0, a=0.3), "svi:2"), np.random.default_rng(11)
    counts = []
    for _ in range(40):
        q, speed, span = 0.3 * random.normal(size=2), 10 ** random.uniform(-1, 2), 10 ** random.uniform(-1, 0.5)
        control = {"tolerance": 10 ** random.uniform(-5, -3), "check_growth": False}
        control["parameters"] = {"g": 10 ** random.uniform(-1, 1), "a": random.uniform(-0.5, 0.5)}
        runs = [stepper.integrate(q, velocity=[speed, y], t_end=span, **control) for y in (0.0, speed / 2)]
        counts.append([run.steps for run in runs])
    from_rest, moving = np.array(counts).T
    assert from_rest.sum() < 3 * moving.sum()  # 6.2 times where errors of pilots contain motions that begin
    assert (from_rest < 40 * moving).all()  # up to 94 times


@pytest.mark.rotated
@pytest.mark.parametrize("solver", ["auto", "newton"])
def test_free_fall_of_linked_bodies_from_rest_at_the_origin_takes_few_steps(solver):
    """The angle rests but for rounding errors of z, which the masses couple to it."""
    kinetic = "(x_dot**2 + z_dot**2)/2 + ((x_dot + cos(a)*a_dot)**2 + (z_dot + sin(a)*a_dot)**2)/2 + a_dot**2/6"
    linked = lagrange("linked bodies", "x z a", f"{kinetic} - 10*(2*z - cos(a))")
    run = sc.compile_stepper(linked, "svi:3", solver=solver).integrate([0, 0, 0.3], velocity=[0, 0, 0], t_end=1.0)
    assert run.q[-1] == pytest.approx([0.0, -5.0, 0.3], abs=1e-14)
    assert run.steps < 20
