"""Derivatives through contacts: stops, slip that begins, lift-off, impacts, rest."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

import scvi_codegen as sc

pytestmark = pytest.mark.rotated
PLANE = "(x_dot**2 + y_dot**2)/2"


def of(text: str, coordinates: str, contacts: list[Any], method: str, **parameters: float) -> Any:
    """Return the stepper of a system with contacts."""
    system = sc.LagrangianSystem.from_text(
        name="bodies", coordinates=coordinates.split(), lagrangian=text, parameters=parameters, contacts=contacts
    )
    return sc.compile_stepper(system, method)


def derivative(function: Callable[[float], NDArray[Any]], step: float) -> NDArray[Any]:
    """Return the derivative at 0 by differences of sixth order."""
    values = [function(k * step) - function(-k * step) for k in (1, 2, 3)]
    return np.asarray((45 * values[0] - 9 * values[1] + values[2]) / (60 * step))


def end(run: Any) -> NDArray[Any]:
    return np.concatenate([run.q[-1], run.p[-1]])


def by_parameter(run: Any, name: str) -> NDArray[Any]:
    return np.asarray(run.sensitivity().parameters[-1, :, run.stepper.parameters.index(name)])


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("gap", [False, True])
def test_an_oscillator_stops_at_x0_less_8_d(gap: bool) -> None:
    dry: Any = sc.contact("y", slip="x_dot", friction="d") if gap else sc.friction("x_dot", limit="d")
    stepper = of(f"{PLANE} - x**2/2{' - y' * gap}", "x y", [dry], "svi:3", d=0.13)
    run = stepper.integrate([1, 0], velocity=[0, 0], h=0.1, t_end=20)
    assert by_parameter(run, "d")[[0, 2]] == pytest.approx([-8, 0], abs=1e-10)
    assert run.tangent()[-1, :, [0, 2]] == pytest.approx(np.array([[1, 0, 0, 0], [0, 0, 0, 0]]), abs=1e-10)
    seeds = np.zeros((len(run), 4))
    seeds[-1, 0] = 1.0
    gradient = run.pullback(seeds)
    assert dict(zip(stepper.parameters, gradient.parameters.tolist(), strict=True))["d"] == pytest.approx(-8, abs=1e-10)


@pytest.mark.second
def test_an_input_releases_a_body_that_sticks_at_rest() -> None:
    system = sc.LagrangianSystem.from_text(
        name="pulled",
        coordinates=["x"],
        lagrangian="x_dot**2/2 - x**2/2",
        forces={"x": "F"},
        inputs=["F"],
        parameters={"d": 0.13},
        contacts=[sc.friction("x_dot", limit="d")],
    )
    stepper = sc.compile_stepper(system, "svi:3")

    def run(d: float) -> Any:
        force = ([0, 5, 11, 20], [0, 0.3, -0.2, 0.1])
        return stepper.integrate([1], [0], h=0.1, t_end=18, inputs={"F": force}, parameters={"d": d})

    assert [modes for _, modes in run(0.13).contact_modes] == [("slip",), ("stick",), ("slip",)]
    seeds = np.zeros((len(run(0.13)), 2, 2))
    seeds[-1] = np.eye(2)
    exact = derivative(lambda change: end(run(0.13 + change)), 1e-4)
    assert run(0.13).pullback(seeds).parameters[0] == pytest.approx(exact, abs=1e-9)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("steps", [{"h": 0.1}, {"tolerance": 1e-12}])
def test_a_falling_rod_sticks_slides_and_turns(steps: dict[str, float]) -> None:
    floor = sc.contact("y - cos(a)", slip="x_dot - cos(a)*a_dot", friction="mu")
    stepper = of(f"{PLANE} + a_dot**2/6 - g*y", "x y a", [floor], "svi:3", g=1, mu=0.3)

    def run(mu: float) -> Any:
        return stepper.integrate([0, np.cos(0.1), 0.1], velocity=[0, 0, 0], t_end=3.8, parameters={"mu": mu}, **steps)

    exact = derivative(lambda change: end(run(0.3 + change)), 1e-3)
    assert by_parameter(run(0.3), "mu") == pytest.approx(exact, abs=1e-10)


@pytest.mark.second
def test_a_ladder_leaves_the_wall() -> None:
    contacts = [sc.contact("y - cos(a)"), sc.contact("x - sin(a)")]
    stepper = of(f"{PLANE} + a_dot**2/6 - g*y", "x y a", contacts, "svi:3", g=1)

    def run(a: float) -> Any:
        return stepper.integrate([np.sin(a), np.cos(a), a], velocity=[0, 0, 0], h=0.05, t_end=2.6)

    along = np.array([np.cos(0.2), -np.sin(0.2), 1, 0, 0, 0])
    exact = derivative(lambda change: end(run(0.2 + change)), 1e-3)
    assert run(0.2).tangent(along)[-1] == pytest.approx(exact, abs=1e-10)


@pytest.mark.second
def test_a_bouncing_ball_by_its_restitution_which_a_fit_finds() -> None:
    stepper = of("y_dot**2/2 - g*y", "y", [sc.contact("y - a*sin(t)", restitution="e")], "svi:2", g=1, e=0.8, a=0)
    run = stepper.integrate([0.5], velocity=[0], h=0.05, t_end=4.5)
    after = 4.5 - 1 - 2 * 0.8 - 2 * 0.8**2  # three impacts, at the velocities 1, e, e**2
    by_time = -2 - 4 * 0.8
    y, v = 0.8**3 * after - after**2 / 2, 0.8**3 - after
    assert (run.q[-1, 0], run.p[-1, 0]) == pytest.approx((y, v), abs=1e-13)
    exact = [3 * 0.8**2 * after + v * by_time, 3 * 0.8**2 - by_time]
    assert by_parameter(run, "e") == pytest.approx(exact, abs=1e-11)
    measured = run.q[::12, 0]
    fitted = sc.fit(
        stepper,
        run.t[::12],
        measured,
        q=[0.5],
        p=[0],
        h=0.05,
        unknown=["e"],
        parameters={"e": 0.75},
        fit_initial_state=False,
    )
    assert fitted.parameters["e"] == pytest.approx(0.8, abs=1e-8)
    moving = stepper.integrate([1.0], velocity=[0.3], h=0.05, steps=200, parameters={"a": 0.5})
    volume = moving.chaos_indicators().lyapunov_exponents()[-1].sum() * moving.t[-1]
    assert volume == pytest.approx(5 * 2 * np.log(0.8), abs=1e-9)  # e**2 at each of five impacts


@pytest.mark.second
def test_a_ball_comes_to_rest_and_slides() -> None:
    """Impacts accumulate: x(T) does not depend on e, since friction is mu times impulses with the mean mu m g."""
    floor = sc.contact("y", slip="x_dot", friction="mu", restitution="e")
    stepper = of(f"{PLANE} - 9.81*y", "x y", [floor], "svi:2", mu=0.1, e=0.6)

    def run(mu: float) -> Any:
        return stepper.integrate([0, 1], p=[6, 0], h=0.05, t_end=2.2, parameters={"mu": mu})

    here = run(0.1)
    assert [modes for _, modes in here.contact_modes] == [("open",), ("slip",)]
    exact = derivative(lambda change: end(run(0.1 + change)), 1e-3)
    assert by_parameter(here, "mu") == pytest.approx(exact, abs=1e-9)
    assert by_parameter(here, "e") == pytest.approx(0, abs=1e-5)


@pytest.mark.second
def test_several_impacts_at_once_are_refused() -> None:
    contacts = [sc.contact("b - a - 1", restitution=1), sc.contact("c - b - 1", restitution=1)]
    stepper = of("(a_dot**2 + b_dot**2 + c_dot**2)/2", "a b c", contacts, "svi:2")
    run = stepper.integrate([-1, 1, 2], velocity=[1, 0, 0], h=0.1, t_end=2)
    with pytest.raises(sc.StateError, match=r"closes at t = .* with several impacts"):
        run.sensitivity()
    with pytest.raises(sc.MethodError, match="hessian_product is not available with contacts"):
        run.hessian_product(np.zeros((len(run), 6)), np.zeros(6))


SPACE = "(x_dot**2 + y_dot**2 + z_dot**2)/2"
SPINS = f"{SPACE} + (a_dot**2 + b_dot**2)/20 - g*z"
"""A ball of radius 1/2 that turns about horizontal axes."""
ROLLS = ["x_dot - a_dot/2", "y_dot - b_dot/2"]


def check_by_differences(stepper: Any, q: list[float], velocity: list[float], names: list[str], **steps: float) -> None:
    """Compare the derivatives of the end by velocities that are not 0 and by parameters with differences of runs."""
    m, places = len(q), [stepper.parameters.index(name) for name in names]
    x = np.array([*velocity, *np.array(stepper.defaults)[places]])

    def run(x: NDArray[Any]) -> Any:
        return stepper.integrate(q, velocity=x[:m], parameters=dict(zip(names, x[m:], strict=True)), **steps)

    found, masses = run(x).sensitivity(), stepper.momentum(q, np.ones(m), 0.0) - stepper.momentum(q, np.zeros(m), 0.0)
    by = np.hstack([masses * found.state[-1, :, m:], found.parameters[-1][:, places]])
    for k in np.flatnonzero(x).tolist():
        exact = derivative(lambda change, k=k: end(run(x + change * (np.arange(len(x)) == k))), 1e-3)
        assert by[:, k] == pytest.approx(exact, abs=2e-11), k
    seeds = np.eye(2 * m) * (np.arange(len(found.state)) == len(found.state) - 1)[:, np.newaxis, np.newaxis]
    assert np.abs(run(x).pullback(seeds).parameters.T - found.parameters[-1]).max() < 1e-10


@pytest.mark.second
def test_a_ball_in_space_slides_along_a_parabola_and_rolls() -> None:
    """The slip w0 keeps its direction d: v = v0 - mu g t d until t1 = 2 |w0|/(7 mu g), then v0 - 2 w0/7."""
    table = sc.contact("z - 1/2", slip=ROLLS, friction="mu")
    stepper = of(SPINS, "x y z a b", [table], "svi:3", g=9.81, mu=0.3)
    run = stepper.integrate([0, 0, 0.5, 0, 0], velocity=[2, 0.5, 0, 0, 4], h=0.05, t_end=1)
    w0, g, mu = np.array([2, -1.5]), 9.81, 0.3
    speed = np.linalg.norm(w0)
    assert run.q[-1, :2] == pytest.approx([2, 0.5] - 2 / 7 * w0 + 2 / 49 * speed * w0 / (mu * g), abs=1e-14)
    assert by_parameter(run, "mu")[:2] == pytest.approx(-2 / 49 * speed * w0 / (mu**2 * g), abs=1e-13)
    by_velocity = 5 / 7 * np.eye(2) + 2 / 49 * (speed * np.eye(2) + np.outer(w0, w0) / speed) / (mu * g)
    assert run.tangent()[-1, :2, 5:7] == pytest.approx(by_velocity, abs=1e-13)
    by_h = run.tangent(np.eye(stepper._input_size)[-1])[-1, :2]
    assert by_h == pytest.approx(20 * run.velocity[-1, :2], abs=1e-12)


@pytest.mark.second
def test_impacts_with_friction_in_space_turn_the_slip() -> None:
    floor = sc.contact("z - 1/2", slip=ROLLS, friction="mu", restitution="e")
    stepper = of(SPINS, "x y z a b", [floor], "svi:2", g=9.81, mu=0.03, e=0.7)
    check_by_differences(stepper, [0, 0, 1.5, 0, 0], [2, 3.2, 0, 0, 4], ["mu", "e"], h=0.05, t_end=1.5)


@pytest.mark.second
def test_slip_in_space_begins_at_rest_in_a_direction_that_depends_on_forces() -> None:
    table = sc.contact("z", slip=["x_dot", "y_dot"], friction="mu")
    stepper = of(f"{SPACE} - 9.81*z + F*x + G*x*y + H*y", "x y z", [table], "svi:3", F=3, G=0.5, H=1, mu=0.2)
    check_by_differences(stepper, [0, 0, 0], [0, 0, 0], ["mu", "F", "G", "H"], h=0.02, t_end=1.0)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(("steps", "error"), [({"h": 0.05}, 1e-7), ({"h": 0.025}, 5e-9), ({"tolerance": 1e-12}, 5e-10)])
def test_where_a_puck_on_a_slope_stops(steps: dict[str, float], error: float) -> None:
    """With u = log |w| as independent variable the angle of w has d angle/du = -f sin(angle)/(f cos(angle) - mu N)."""
    slope, start = sc.contact("z", slip=["x_dot", "y_dot"], friction="mu"), np.array([0.3, 1.5, 0.5, 3.0])
    stepper = of(f"{SPACE} - 9*z + f*x", "x y z", [slope], "svi:3", f=3, mu=0.5)

    def stop(values: NDArray[Any]) -> NDArray[Any]:
        (*w, mu, f) = values

        def rates(u: float, state: NDArray[Any]) -> list[float]:
            c, s, speed = np.cos(state[2]), np.sin(state[2]), np.exp(u)
            return [speed**2 * c / (f * c - mu * 9), speed**2 * s / (f * c - mu * 9), -f * s / (f * c - mu * 9)]

        u = np.log(np.hypot(*w))
        exact = solve_ivp(rates, (u, u - 40), [0, 0, np.arctan2(w[1], w[0])], "DOP853", rtol=1e-13, atol=1e-15)
        return np.asarray(exact.y[:2, -1])

    run = stepper.integrate([0, 0, 0], velocity=[*start[:2], 0], t_end=1.5, **steps)
    changes = np.diag([5e-3, 5e-3, 1e-3, 5e-3])
    exact = np.stack([derivative(lambda change, by=by: stop(start + change * by), 1.0) / by.sum() for by in changes])
    assert [modes for _, modes in run.contact_modes] == [("slip",), ("stick",)]
    found = run.sensitivity()
    by = [found.parameters[-1, :2, stepper.parameters.index(name)] for name in ("mu", "f")]
    columns = np.array([found.state[-1, :2, 3], found.state[-1, :2, 4], *by])
    assert columns == pytest.approx(exact, abs=error)


@pytest.mark.tiers(0, 1)
def test_a_block_on_a_shaken_table_stops_and_slips_again() -> None:
    """By DOP853 until the slip is 1e-8, and from 1e-6 after it begins; the floor carries the block between."""
    slip = ["x_dot - 0.4*sin(3*t)", "y_dot - 0.3*A*sin(2*t)"]
    table = sc.contact("z", slip=slip, friction="mu", static_friction="s*mu")
    stepper = of(f"{SPACE} - 9.81*z", "x y z", [table], "svi:3", A=1, mu=0.1, s=1.2)

    def reference(values: NDArray[Any]) -> NDArray[Any]:
        *w0, mu, size = values
        place = lambda t: -np.array([0.4 * np.cos(3 * t) / 3, 0.3 * size * np.cos(2 * t) / 2])  # noqa: E731
        moving = lambda t: np.array([0.4 * np.sin(3 * t), 0.3 * size * np.sin(2 * t)])  # noqa: E731
        force = lambda t: -np.array([1.2 * np.cos(3 * t), 0.6 * size * np.cos(2 * t)])  # noqa: E731

        def rates(t: float, state: NDArray[Any]) -> NDArray[Any]:
            w = state[2:]
            return np.concatenate([w + moving(t), force(t) - mu * 9.81 * w / np.linalg.norm(w)])

        stops: Any = lambda t, state: np.linalg.norm(state[2:]) - 1e-8  # noqa: E731
        stops.terminal, exact = True, {"method": "DOP853", "rtol": 3e-14, "atol": 1e-16}
        first = solve_ivp(rates, (0, 3), [0, 0, *w0], events=stops, **exact)
        begins = brentq(lambda t: np.hypot(*force(t)) - 1.2 * mu * 9.81, 0.8, 1.1, xtol=1e-15)
        at = first.y[:2, -1] + place(begins + 1e-6) - place(first.t[-1])
        slip = force(begins) * (1 - 1 / 1.2) * 1e-6
        return np.asarray(solve_ivp(rates, (begins + 1e-6, 1.2), [*at + slip * 5e-7, *slip], **exact).y[:2, -1])

    start = np.array([0.3, 0.6, 0.1, 1.0])
    run = stepper.integrate([0, 0, 0], velocity=[0.3, 0.6, 0], h=0.02, t_end=1.2)
    assert [modes for _, modes in run.contact_modes] == [("slip",), ("stick",), ("slip",)]
    found, names = run.sensitivity(), stepper.parameters
    by = [found.parameters[-1, :2, names.index(name)] for name in ("mu", "A")]
    columns = [found.state[-1, :2, 3], found.state[-1, :2, 4], *by]
    for k, (column, size) in enumerate(zip(columns, (2e-3, 2e-3, 2e-4, 2e-3), strict=True)):
        exact = derivative(lambda change, k=k: reference(start + change * np.eye(4)[k]), size)
        assert column == pytest.approx(exact, abs=2e-8), k
    run.parameters[names.index("s")] = 1.0
    with pytest.raises(sc.StateError, match=r"direction in which contact 1 begins to slip .* static_friction"):
        run.sensitivity()
