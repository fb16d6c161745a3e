"""Step density of a time transformation: the reversible controller of Hairer and Soederlind."""

import numpy as np
import pytest
from notation import hamilton, lagrange
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen.runs.stepping.step_plan import InTau

KEPLER = sc.problem("kepler").system
E = 0.8
START = np.array([1.0 - E, 0.0]), np.array([0.0, np.sqrt((1.0 + E) / (1.0 - E))])
RADIUS = "(q1**2 + q2**2)**(3/4)"

DRIVEN = lagrange("driven and damped", "x", "x_dot**2/2 - x**4/4 + x*cos(2*t)/2", forces={"x": "-x_dot/10"})


def kepler(method, time_transformation="frequency", **more):
    return sc.compile_stepper(KEPLER, method, time_transformation=time_transformation, flags=QUICK_FLAGS, **more)


def by_hand(stepper, q, p, tau, steps, rate, control):
    """The controller, step by step, around an integrator that knows nothing of it."""
    density, t, states = 0.0, 0.0, []
    for _ in range(steps):
        derivative = control(t, q, p)
        density = density + tau * derivative if density else 1.0 / rate(t, q, p) + tau / 2.0 * derivative
        q, p = stepper.step(q, p, tau / density, t)
        t += tau / density
        states.append([t, *q, *p])
    return np.array(states)


@pytest.mark.rotated
@pytest.mark.sampled(2)
@pytest.mark.covering
@pytest.mark.parametrize(
    "method", [sc.SVI(3), sc.SCVI(2), sc.Gauss(2), sc.StoermerVerlet()], ids=lambda method: method.name
)
@pytest.mark.parametrize("solver", ["auto", "newton"])
def test_steps_are_those_of_the_density_controller(method, solver):
    run = kepler(method, RADIUS, solver=solver).integrate(*START, h=0.1, t_end=3.0)
    expected = by_hand(
        sc.compile_stepper(KEPLER, method, solver=solver, flags=QUICK_FLAGS),
        *START,
        0.1,
        len(run.t) - 2,
        lambda _, q, __: (q @ q) ** 0.75,
        lambda _, q, p: -1.5 * (q @ p) / (q @ q),
    )
    found = np.column_stack([run.t, run.q, run.p])[1:-1]
    assert np.abs(found - expected).max() < 1e-12
    assert run.t[-1] == 3.0
    assert 0.0 < run.t[-1] - run.t[-2] <= run.step_sizes[-3] * 1.5


DENSITIES = {
    "of time": (
        lambda: DRIVEN,
        "1/(1 + x**2 + cos(t)/2)",
        lambda t, q, _: 1.0 / (1.0 + q[0] ** 2 + np.cos(t) / 2.0),
        lambda t, q, p: (2.0 * q[0] * p[0] - np.sin(t) / 2.0) / (1.0 + q[0] ** 2 + np.cos(t) / 2.0),
    ),
    "of momenta": (
        lambda: sc.hamiltonian_of(DRIVEN, momenta=["p"]),
        "1/(1 + p**2)",
        lambda _, __, p: 1.0 / (1.0 + p[0] ** 2),
        lambda t, q, p: 2.0 * p[0] * (-(q[0] ** 3) + np.cos(2.0 * t) / 2.0 - p[0] / 10.0) / (1.0 + p[0] ** 2),
    ),
}


@pytest.mark.rotated
@pytest.mark.parametrize("name", DENSITIES)
def test_step_density_may_depend_on_time_or_momenta(name):
    """Time occurs in the system, too; forces enter the rates of momenta."""
    system, time_transformation, rate, control = DENSITIES[name]
    plain, own = (
        sc.compile_stepper(system(), sc.SVI(3), time_transformation=each, flags=QUICK_FLAGS)
        for each in (None, time_transformation)
    )
    run = own.integrate([1.0], [0.7], h=0.2, t_end=8.0)
    expected = by_hand(plain, np.array([1.0]), np.array([0.7]), 0.2, len(run.t) - 2, rate, control)
    assert np.abs(np.column_stack([run.t, run.q, run.p])[1:-1] - expected).max() < 1e-12


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("system", [KEPLER, sc.hamiltonian_of(KEPLER)], ids=["lagrangian", "hamiltonian"])
def test_reversed_run_returns_on_its_own_steps(system):
    stepper = sc.compile_stepper(system, sc.SVI(4), time_transformation="frequency", flags=QUICK_FLAGS)
    run = stepper.start(*START, h=0.1, t_end=100.0)
    there = run.record(300)
    run.plan = InTau(-100.0, 0.1)
    back = run.record(300)
    assert np.abs(back.t[::-1] - there.t).max() < 1e-11
    assert np.abs(back.q[::-1] - there.q).max() < 1e-11


def off_the_time_transformation(run):
    """Return the deviation of step sizes from h = tau g at the midpoint, for Kepler's orbit, tau = 0.1."""
    t, lengths = run.t[:-2], run.step_sizes[:-2]
    return np.abs(np.abs(lengths) / (0.1 * (run.at(t + lengths / 2)[0] ** 2).sum(axis=1)) - 1.0).max(initial=0.0)


@pytest.mark.rotated
def test_steps_that_end_at_a_time_advance_the_density_partially():
    """At breakpoints of inputs and where a run goes to and fro; by whole ones it would go on ahead of the motion."""
    pushed = lagrange("pushed", "x y", "(x_dot**2 + y_dot**2)/2 + 1/sqrt(x**2 + y**2)", forces={"x": "u"}, inputs="u")
    stepper = sc.compile_stepper(pushed, sc.SVI(6), time_transformation="x**2 + y**2", flags=QUICK_FLAGS)
    start = {"q": [0.4, 0.0], "velocity": [0.0, 2.0], "h": 0.1}
    for breakpoints in (2, 101, 401):
        times = np.linspace(0.0, 40.0, breakpoints)
        run = stepper.integrate(**start, inputs={"u": (times, 0.0 * times)}, t_end=40.0)
        assert max(map(off_the_time_transformation, run.pieces)) < 2e-3
    run = stepper.start(**start, t_end=3.0, parameters={"u_0": 0.0})
    for t_end in (3.0, -3.0) * 20:
        run.plan = InTau(t_end, 0.1)
        piece = run.record()
    assert off_the_time_transformation(piece) < 2e-3


def test_time_transformations_of_runs_with_inputs():
    """Steps of tau are positive, and their number is not prescribed."""
    system = sc.LagrangianSystem.from_text(name="u", coordinates=["x"], lagrangian="x_dot**2/2 + u*x", inputs=["u"])
    stepper = sc.compile_stepper(system, sc.SVI(2), time_transformation="1 + x**2", flags=QUICK_FLAGS)
    given = {"inputs": {"u": ([0.0, 1.0, 2.0], [1.0, 2.0, 2.0], "constant")}, "h": 0.1}
    there = stepper.integrate([0.0], [0.0], **given, t_end=2.0)
    assert there.q[-1, 0] == pytest.approx(2.5, abs=1e-14)
    back = stepper.integrate(there.q[-1], there.p[-1], **given, t=2.0, t_end=0.0)
    assert np.abs([back.q[-1], back.p[-1]]).max() < 1e-14
    with pytest.raises(sc.StateError, match=r"give h .constant step in tau. and t_end"):
        stepper.integrate([0.0], [0.0], **given, steps=10)


def test_checkpoints_require_the_step_size():
    stepper = kepler(sc.SVI(2))
    with pytest.raises(sc.StateError, match="and t_end"):
        stepper.from_checkpoint(stepper.start(*START, h=0.1, t_end=1.0).checkpoint(), t_end=1.0)


@pytest.mark.second
def test_momenta_not_determined_by_velocities_are_supported():
    vortices = hamilton("q p", "x", "x**2*y**2/2 + x**2/2 + y**2/2", momenta="y")
    run = sc.compile_stepper(
        vortices, sc.SVI(3), time_transformation="1/(1 + x**2 + y**2)", flags=QUICK_FLAGS
    ).integrate([1.0], [1.0], h=0.1, t_end=10.0)
    assert np.abs(run.energy() / run.energy()[0] - 1.0).max() < 1e-6
