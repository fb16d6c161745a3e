"""Derivatives through contacts: stops, slip that begins, lift-off, impacts, rest."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import scvi_codegen as sc

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


@pytest.mark.parametrize("steps", [{"h": 0.1}, {"tolerance": 1e-12}])
def test_a_falling_rod_sticks_slides_and_turns(steps: dict[str, float]) -> None:
    floor = sc.contact("y - cos(a)", slip="x_dot - cos(a)*a_dot", friction="mu")
    stepper = of(f"{PLANE} + a_dot**2/6 - g*y", "x y a", [floor], "svi:3", g=1, mu=0.3)

    def run(mu: float) -> Any:
        return stepper.integrate([0, np.cos(0.1), 0.1], velocity=[0, 0, 0], t_end=3.8, parameters={"mu": mu}, **steps)

    exact = derivative(lambda change: end(run(0.3 + change)), 1e-3)
    assert by_parameter(run(0.3), "mu") == pytest.approx(exact, abs=1e-10)


def test_a_ladder_leaves_the_wall() -> None:
    contacts = [sc.contact("y - cos(a)"), sc.contact("x - sin(a)")]
    stepper = of(f"{PLANE} + a_dot**2/6 - g*y", "x y a", contacts, "svi:3", g=1)

    def run(a: float) -> Any:
        return stepper.integrate([np.sin(a), np.cos(a), a], velocity=[0, 0, 0], h=0.05, t_end=2.6)

    along = np.array([np.cos(0.2), -np.sin(0.2), 1, 0, 0, 0])
    exact = derivative(lambda change: end(run(0.2 + change)), 1e-3)
    assert run(0.2).tangent(along)[-1] == pytest.approx(exact, abs=1e-10)


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


def test_several_impacts_at_once_are_refused() -> None:
    contacts = [sc.contact("b - a - 1", restitution=1), sc.contact("c - b - 1", restitution=1)]
    stepper = of("(a_dot**2 + b_dot**2 + c_dot**2)/2", "a b c", contacts, "svi:2")
    run = stepper.integrate([-1, 1, 2], velocity=[1, 0, 0], h=0.1, t_end=2)
    with pytest.raises(sc.StateError, match=r"closes at t = .* with several impacts"):
        run.sensitivity()
    with pytest.raises(sc.MethodError, match="hessian_product is not available with contacts"):
        run.hessian_product(np.zeros((len(run), 6)), np.zeros(6))
