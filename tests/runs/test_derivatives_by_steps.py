"""Derivatives of runs with contacts by steps: the active sets of both problems, beside differences of runs."""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest

import scvi_codegen as sc

BY_STEPS: dict[str, Any] = {"transitions": "by steps"}
PLANE = "m*(x_dot**2 + y_dot**2)/2"
STEP = 1e-5
"""Of differences of fourth order: steps are solved to 1e-12, forces of this scale to 1e-11."""

pytestmark = pytest.mark.filterwarnings("ignore:contacts change their modes")


def plank(part: float) -> sc.LagrangianSystem:
    """Return a plank on four points of which two suffice, pulled along by a part of its weight and a spring."""
    feet = [
        sc.contact(f"y + {u}*sin(a)", slip=f"x_dot - {u}*sin(a)*a_dot", friction="mu") for u in (-1.0, -0.5, 0.2, 1.0)
    ]
    lagrangian = f"{PLANE} + m*a_dot**2/10 - m*9.81*(y - {part}*x) - k*x**2/2"
    named = {"m": 1.0, "k": 1.0, "mu": 0.3}
    return sc.LagrangianSystem.from_text("plank", ["x", "y", "a"], lagrangian, parameters=named, contacts=feet)


@cache
def stepper(body: str) -> Any:
    """Return the stepper of a body: each has parameters of masses, forces, friction or restitution."""
    text = sc.LagrangianSystem.from_text
    match body:
        case "box":
            corners = [
                sc.contact(
                    f"y + {u}*sin(a) + {v}*cos(a)",
                    slip=f"x_dot - ({u}*sin(a) + {v}*cos(a))*a_dot",
                    friction="mu",
                    static_friction="2*mu",
                    restitution="e",
                )
                for u in ("w - o", "(-w - o)")
                for v in (-0.2, 0.2)
            ]
            speeds = "(x_dot - o*sin(a)*a_dot)**2 + (y_dot + o*cos(a)*a_dot)**2"
            lagrangian = f"m*({speeds})/2 + J*a_dot**2/2 - m*9.81*(y + o*sin(a))"
            named = {"m": 1.3, "J": 0.1, "w": 0.5, "o": 0.1, "mu": 0.3, "e": 0.3}
            system = text("box", ["x", "y", "a"], lagrangian, parameters=named, contacts=corners)
        case "puck on a table that swings":
            lagrangian = "m*(1 + a*sin(x)**2)*(x_dot**2 + y_dot**2)/2 - 9.81*m*y - k*x**2/2"
            law = {"friction": "mu*(1 + x_dot**2/9)", "restitution": "e"}
            table = sc.contact("y - 0.02*sin(w*t)", slip="x_dot", **law)
            named = {"m": 1.2, "a": 0.6, "k": 3.0, "c": 0.2, "d": 0.7, "w": 5.0, "mu": 0.4, "e": 0.6}
            forces = {"x": "-c*x_dot - d*y", "y": "-c*y_dot + d*x"}
            system = text("puck", ["x", "y"], lagrangian, parameters=named, forces=forces, contacts=[table])
        case "sphere":
            wx, wy = (f"rotate_{k}(R, omega_1, omega_2, omega_3)" for k in (1, 2))
            plane = sc.contact("z - 0.5", slip=[f"x_dot - {wy}/2", f"y_dot + {wx}/2"], friction="mu", restitution="e")
            lagrangian = "x_dot**2 + y_dot**2 + z_dot**2 + J*(omega_1**2 + omega_2**2 + omega_3**2) - 19.62*z"
            named = {"J": 0.1, "mu": 0.3, "e": 0.4}
            system = text(
                "sphere", ["x", "y", "z"], lagrangian, parameters=named, rotations={"R": "omega"}, contacts=[plane]
            )
        case "rod on a constraint":
            floor = [
                sc.contact(y, slip=f"{x}_dot", friction="mu", restitution=e)
                for x, y, e in (("x", "y", 0), ("u", "w", 0.5))
            ]
            lagrangian = "m*(x_dot**2 + y_dot**2 + u_dot**2 + w_dot**2)/2 - 9.81*m*(y + w)"
            rod = ["(x - u)**2 + (y - w)**2 = 1"]
            named = {"m": 1.0, "mu": 0.1}
            system = text("rod", ["x", "y", "u", "w"], lagrangian, parameters=named, constraints=rod, contacts=floor)
        case "belt":
            belt = sc.friction("x_dot - v", limit="l*(1 + x_dot**2)", static_limit="1.6*l")
            named = {"k": 1.0, "l": 0.25, "v": 0.3}
            system = text("belt", ["x"], "x_dot**2/2 - k*x**2/2", parameters=named, contacts=[belt])
        case "block in space":
            lagrangian = "m*(x_dot**2 + y_dot**2 + z_dot**2)/2 - m*(9.81*z + 3*x) - x*y/5"
            table = sc.contact("z", slip=["x_dot", "y_dot"], friction="mu")
            system = text("block", ["x", "y", "z"], lagrangian, parameters={"m": 1.0, "mu": 0.25}, contacts=[table])
        case "plank that slides":
            system = plank(0.5)
        case _:
            system = plank(0.1)
    return sc.compile_stepper(system, "svi:1", **BY_STEPS)


Case = tuple[list[float], list[float], float, float, list[int]]
CASES: dict[str, Callable[[Any], Case]] = {
    "box": lambda r: ([0, 1, r.uniform(-3, 3)], [*r.normal(size=2), 2 * r.normal()], 2e-3, 0.8, [0, 1, 2]),
    "puck on a table that swings": lambda r: ([r.normal(), 0.3], [*r.normal(size=2)], 5e-3, 0.8, [0, 1]),
    "sphere": lambda r: (
        [0, 0, 0.6, 1, 0, 0, 0],
        [*r.normal(size=2), 0, *[0, *r.normal(size=3)]],
        2e-3,
        0.35,
        [0, 1, 2],
    ),
    "rod on a constraint": lambda r: ([0, 0.5, 0.6, 1.3], [r.normal(), 0] * 2, 2e-3, 0.4, []),
    "belt": lambda r: ([r.uniform(0.4, 1)], [0], 1e-2, 2.5, [0]),
    "block in space": lambda r: ([0, 0, 0], [*r.uniform(0.5, 1.5, size=2), 0], 5e-3, 0.2, [0, 1]),
    "plank that slides": lambda r: ([0, 0, 0], [r.uniform(0.5, 1.5), 0, 0], 5e-3, 0.2, [0]),
    "plank that sticks": lambda r: ([0, 0, 0], [0, 0, 0], 5e-3, 0.2, [0]),
}
"""Positions, velocities, step, duration, and coordinates whose start is free, of a random start of each body."""


@pytest.mark.tiers(1, 4)
@pytest.mark.parametrize("number", range(12))
@pytest.mark.parametrize("body", CASES)
def test_derivatives_are_those_of_the_steps_where_no_mode_changes(body: str, number: int) -> None:
    """Along a random direction of the state, the parameters, t and h, all states; the adjoint is the transpose."""
    random, of = np.random.default_rng(number), stepper(body)
    q, v, h, duration, free = CASES[body](random)
    first = of.integrate(q, velocity=v, h=h, t_end=duration)
    start, m = np.concatenate([first.q[0], first.p[0]]), len(first.q[0])
    values, names = of.defaults[: len(of.parameters)], of.parameters
    direction = np.zeros(2 * m + len(names) + 2)
    for own in (free, [m + k for k in free], [*range(2 * m, len(direction))]):
        direction[own] = random.normal(size=len(own))
    direction[-1] *= h

    def run(part: float, **settings: Any) -> Any:
        x = part * direction
        named = dict(zip(names, values + x[2 * m : -2], strict=True))
        q, p = np.split(start + x[: 2 * m], 2)
        return of.integrate(q, p, t=x[-2], h=h + x[-1], steps=len(first) - 1, parameters=named, **settings)

    def states(of: Any) -> Any:
        return np.concatenate([of.q, of.p], axis=1)

    base, others = run(0.0), [run(part * STEP) for part in (1, -1, 2, -2)]
    for other in others:  # away from changes of modes: each is at the same step
        if (
            np.shape(other.modes.t) != np.shape(base.modes.t)
            or abs(other.modes.t - base.modes.t).max(initial=0.0) > h / 2
        ):
            pytest.skip("the modes change at other steps nearby")
    near, far = (states(others[k]) - states(others[k + 1]) for k in (0, 2))
    differences, size = (8 * near - far) / (12 * STEP), max(abs(near).max() / (2 * STEP), abs(start).max())
    if abs(2 * near - far).max() > 1e-5 * STEP * size:
        pytest.skip("a contact changes from a slip to a stick within a step nearby")
    sensitivity = base.sensitivity()
    by_inputs = [sensitivity.state, sensitivity.parameters, sensitivity.t[..., None], sensitivity.h[..., None]]
    change = np.concatenate(by_inputs, axis=2) @ direction
    assert abs(change - differences).max() < 1e-6 * size
    seeds = random.normal(size=(len(base), 2 * m))
    gradient = base.pullback(seeds)
    along = np.concatenate([gradient.q, gradient.p, gradient.parameters, [gradient.t, gradient.h]]) @ direction
    assert along == pytest.approx(float((seeds * change).sum()), abs=1e-9 * size * len(base))
    sparse = run(0.0, save_every=5)
    assert sparse.tangent()[-1] == pytest.approx(base.tangent()[-1], abs=1e-8 * size)


def test_rebounds_have_the_derivatives_of_their_steps() -> None:
    """A ball that falls onto the floor at step k leaves with -e p, p = -g h (k - 1) before, whatever its height was."""
    system = sc.LagrangianSystem.from_text(
        "ball", ["y"], "y_dot**2/2 - g*y", parameters={"g": 9.81, "e": 0.5}, contacts=[sc.contact("y", restitution="e")]
    )
    run = sc.compile_stepper(system, "svi:1", **BY_STEPS).integrate([1.0], velocity=[0.0], h=0.01, steps=46)
    lands = int(np.flatnonzero(run.q[:, 0] < 1e-12)[0])
    with pytest.warns(sc.AccuracyWarning, match=rf"a rebound at t = {run.t[lands]:.6g}"):
        state = run.sensitivity()
    fall = run.p[lands - 1, 0]
    assert state.state[lands] == pytest.approx(np.array([[0, 0], [0, -0.5]]), abs=1e-12)
    assert state.parameters[lands] == pytest.approx(np.array([[0, 0], [0.5 * 0.01 * (lands - 1), -fall]]), abs=1e-12)


def test_derivatives_through_pieces_of_inputs() -> None:
    system = sc.LagrangianSystem.from_text(
        "pushed",
        ["x", "y"],
        f"{PLANE} - m*9.81*y",
        parameters={"m": 1.0, "mu": 0.2},
        forces={"x": "F"},
        inputs=["F"],
        contacts=[sc.contact("y", slip="x_dot", friction="mu")],
    )
    of = sc.compile_stepper(system, "svi:1", **BY_STEPS)
    pushes = ([0.0, 0.1, 0.3], [4.0, 6.0, 8.0])
    runs = [of.integrate([0, 0], [1.0 + e, 0], h=0.01, t_end=0.3, inputs={"F": pushes}) for e in (1e-5, -1e-5, 0)]
    change = (runs[0].q[-1] - runs[1].q[-1]) / 2e-5
    assert runs[2].tangent()[-1, :2, 2] == pytest.approx(change, abs=1e-8)


def test_the_end_at_an_event_has_the_derivatives_of_its_time() -> None:
    """The state there is on the line between the ends of a step, as that of a run without the event at that time."""
    of = stepper("puck on a table that swings")
    settings: dict[str, Any] = {"velocity": [0.5, 0.0], "h": 5e-3, "t_end": 0.8}
    ended = of.integrate([0.3, 0.3], events=sc.Event("x - 0.35", terminal=True), **settings)
    near = [
        of.integrate([0.3 + e, 0.3], ended.p[0], h=5e-3, t_end=0.8, t_eval=[ended.t[-1]])
        for e in (STEP, -STEP, 2 * STEP, -2 * STEP)
    ]
    first, second, third, fourth = (np.concatenate([run.q[-1], run.p[-1]]) for run in near)
    change = (8 * (first - second) - (third - fourth)) / (12 * STEP)
    tangent = ended.tangent()[-1]
    assert tangent[:, 0] == pytest.approx(change, abs=1e-8)
    seeds = np.zeros((len(ended), 4))
    seeds[-1] = [1.0, 2.0, 3.0, 4.0]
    gradient = ended.pullback(seeds)
    assert np.concatenate([gradient.q, gradient.p]) == pytest.approx(seeds[-1] @ tangent, rel=1e-12)


@pytest.mark.parametrize("body", ["belt", "plank that sticks"])
def test_derivatives_of_runs_that_go_on_are_factors_of_those_of_the_whole(body: str) -> None:
    of, (q, v, h, duration, _) = stepper(body), CASES[body](np.random.default_rng(3))
    count = round(duration / h)
    whole = of.integrate(q, velocity=v, h=h, steps=count).tangent()
    for k in (count // 3, count - 3):
        run = of.start(q, velocity=v, h=h)
        run.advance(k)
        again = of.from_checkpoint(run.checkpoint())
        for tail in (run.record(count - k), again.record(count - k)):
            assert tail.tangent()[-1] @ whole[k] == pytest.approx(whole[-1], abs=1e-12)


def test_derivatives_that_steps_lack_are_refused_by_name() -> None:
    of = stepper("puck on a table that swings")
    with pytest.raises(sc.ContactError, match="single steps"):
        of.jacobian([0.3, 0.3], [0.0, 0.0], 0.01)
    for feature, is_there in (("tangent", True), ("pullback", True), ("sensitivity", True), ("fit", False)):
        assert bool(of.supports(feature)) == is_there
