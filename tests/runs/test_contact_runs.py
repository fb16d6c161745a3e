"""Runs with contacts beside their motion: work, conditions, surfaces, restitution and names."""

import warnings
from typing import Any

import numpy as np
import pytest
from notation import lagrange
from scipy.integrate import solve_ivp

import scvi_codegen as sc
from scvi_codegen.systems.contact import contacts_of

pytestmark = pytest.mark.rotated
G = 9.81
POINT = f"(x_dot**2 + y_dot**2)/2 - {G}*y"


def of(text: str, coordinates: str, contacts: list[Any], method: str = "svi:3", **parameters: float) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", sc.SystemDefinitionWarning)  # of parameters that contacts contain
        return sc.compile_stepper(lagrange("s", coordinates, text, **parameters), method, contacts=contacts)


def balance(run: Any) -> float:
    return float(np.abs(run.energy() - run.energy()[0] - run.work()).max())


BALANCES = {
    "oscillator": ("x_dot**2/2 - x**2/2", "x", sc.friction("x_dot", limit=0.13), [1.0], [0.0], 14.0),
    "belt": ("x_dot**2/2 - x**2/2", "x", sc.friction("x_dot - 0.3", limit=0.25, static_limit=0.4), [0], [0.3], 20.0),
    "ball": (
        f"(x_dot**2 + y_dot**2)/2 + a_dot**2/20 - {G}*y",
        "x y a",
        sc.contact("y - 1/2", slip="x_dot - a_dot/2 - 0.7*sin(t)", friction=0.1),
        [0.0, 0.5, 0.0],
        [2.0, 0.0, 0.0],
        6.0,
    ),
    "shaken": (f"y_dot**2/2 - {G}*y", "y", sc.contact("y - 0.1*sin(5*t)", restitution=0.3), [0.0], [0.5], 4.0),
}


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("name", [*BALANCES])
def test_the_balance_of_energy_has_the_order_of_the_method(name: str, degree: int) -> None:
    """By friction, belts and floors that move, and jumps at impacts; adaptive runs have it to rounding."""
    text, coordinates, contact, q, v, span = BALANCES[name]
    stepper, errors = of(text, coordinates, [contact], f"svi:{degree}"), []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", sc.AccuracyWarning)
        errors = [balance(stepper.integrate(q, velocity=v, h=span / n, t_end=span)) for n in (80, 160)]
    assert np.log2(errors[0] / errors[1]) > 2 * degree - 0.3
    if degree == 2:
        assert stepper.integrate(q, velocity=v, t_end=span).energy_error() < 2e-13


@pytest.mark.second
def test_work_is_exact_where_the_motion_is(tmp_path: Any) -> None:
    slides = of(POINT, "x y", [sc.contact("y", slip="x_dot", friction=0.3)])
    run = slides.integrate([0.0, 0.0], velocity=[2.0, 0.0], h=0.05, t_end=2.0)
    assert run.work()[-1] == pytest.approx(-2.0, abs=1e-14)
    bounces = of(f"y_dot**2/2 - {G}*y", "y", [sc.contact("y", restitution=0.5)])
    run = bounces.integrate([1.0], velocity=[0.0], h=0.05, t_end=0.8)
    assert run.work()[[0, -1]] == pytest.approx([0.0, -0.75 * G], abs=1e-13)
    assert run.energy_error() < 1e-14
    recorded = sc.record_run(bounces.start([1.0], velocity=[0.0], h=0.05), tmp_path / "run", steps=16)
    member = bounces.integrate_ensemble([[1.0]], velocity=[[0.0]], h=0.05, t_end=0.8)[0]
    for made in (recorded[:], member):
        with pytest.raises(sc.StateError, match="contacts do work"):
            made.energy_error()  # without the states at impacts the losses are no error
        with pytest.raises(sc.StateError, match="transitions of contacts"):
            made.work()


@pytest.mark.tiers(0, 1)
def test_single_steps_require_the_modes_that_runs_choose() -> None:
    stepper = of(POINT, "x y", [sc.contact("y", slip="x_dot", friction=0.3)])
    state, slides = ([0.0, 0.0], [2.0, 0.0]), {"contact_1_closed": 1.0, "contact_1_direction": 1.0}
    run = stepper.integrate(*state, h=0.1, steps=1)
    for call, arguments in (
        (stepper.step, (*state, 0.1)),
        (stepper.jacobian, (*state, 0.1)),
        (stepper.sensitivity, (*state, 0.1)),
        (stepper.work_and_impulses, (*state, 0.1)),
        (stepper.multipliers, state),
        (sc.equilibrium, (stepper, state[0])),
    ):
        with pytest.raises(sc.ContactError, match=r"integrate.*steps=1.*contact_1_closed"):
            call(*arguments, parameters={})
    assert np.array_equal(np.ravel(stepper.step(*state, 0.1, parameters=slides)), [*run.q[-1], *run.p[-1]])
    assert np.allclose(
        stepper.jacobian(*state, 0.1, parameters=slides)[:, [0, 2]], run.sensitivity().state[-1][:, [0, 2]]
    )
    assert stepper.multipliers(*state, parameters=slides)[0] == pytest.approx(G)
    assert not stepper.supports("action")
    assert not stepper.supports("path")


STEPS = pytest.mark.parametrize("steps", [{"h": 0.05}, {}])


@pytest.mark.tiers(0, 1)
@STEPS
def test_a_ball_rolls_off_the_edge_of_a_table(steps: dict[str, float]) -> None:
    """Rolling at 2 from x = 0 to the edge x = 1, then a fall by 1 onto the ground, on which it goes on."""
    r: Any = {"slip": "x_dot - 0.1*a_dot", "friction": 0.3}
    contacts = [sc.contact("y - 0.1", **r, where="x < 1"), sc.contact("y + 0.9", **r)]
    stepper = of(f"(x_dot**2 + y_dot**2)/2 + a_dot**2/500 - {G}*y", "x y a", contacts)
    run = stepper.integrate([0.0, 0.1, 0.0], velocity=[2.0, 0.0, 20.0], t_end=1.2, **steps)
    assert [modes for _, modes in run.contact_modes] == [("stick", "open"), ("open", "open"), ("open", "stick")]
    assert [t for t, _ in run.contact_modes] == pytest.approx([0.0, 0.5, 0.5 + np.sqrt(2 / G)], abs=1e-14)
    assert run.q[-1] == pytest.approx([2.4, -0.9, 24.0], abs=1e-13)
    run = stepper.integrate([1.0, 0.1, 0.0], velocity=[2.0, 0.0, 20.0], t_end=0.2, **steps)  # starts at the edge
    assert run.q[-1] == pytest.approx([1.4, 0.1 - G / 2 * 0.2**2, 4.0], abs=1e-11)


@pytest.mark.tiers(0, 1)
@STEPS
@pytest.mark.parametrize(("rise", "meets"), [(2.0, True), (8.0, False)])
def test_a_ball_misses_a_wall_of_finite_height(rise: float, meets: bool, steps: dict[str, float]) -> None:
    run = of(POINT, "x y", [sc.contact("1 - x", restitution=0.5, where="y < 1")]).integrate(
        [0.0, 0.0], velocity=[2.0, rise], t_end=1.0, **steps
    )
    assert run.q[-1] == pytest.approx([0.5 if meets else 2.0, rise - G / 2], abs=1e-13)


@pytest.mark.tiers(0, 1)
@STEPS
def test_contacts_end_at_times_and_beside_others(steps: dict[str, float]) -> None:
    """A floor that is withdrawn at t = 1/3, and two floors side by side with other friction."""
    run = of(f"y_dot**2/2 - {G}*y", "y", [sc.contact("y", where="t < 1/3")]).integrate(
        [0.0], velocity=[0.0], t_end=1.0, **steps
    )
    assert run.q[-1, 0] == pytest.approx(-G / 2 * (2 / 3) ** 2, abs=1e-14)
    floors = [sc.contact("y", slip="x_dot", friction=mu, where=f"x {way} 1") for mu, way in ((0.1, "<"), (0.3, ">"))]
    run = of(POINT, "x y", floors).integrate([0.0, 0.0], velocity=[2.0, 0.0], t_end=3.0, **steps)
    assert run.q[-1] == pytest.approx([1 + (4 - 0.2 * G) / (0.6 * G), 0.0], abs=1e-13)
    assert contacts_of([floors[0].table]) == (floors[0],)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("edge", ["t - T", "x - t - 1 - T"])
def test_a_floor_takes_over_from_another_at_a_node(edge: str) -> None:
    """The nodes h k miss T = h n by rounding, before and after."""
    floors = [sc.contact("y", where=f"{edge} {way} 0") for way in "<>"]
    stepper = of(POINT, "x y", floors, T=0.1)
    for n in (1, 2, 5, 8, 9, 10):
        run = stepper.integrate([1.0, 0.0], velocity=[2.0, 0.0], t_end=0.25, h=0.1 / n)
        assert run.q[-1] == pytest.approx([1.5, 0.0], abs=1e-15)
        assert [modes for _, modes in run.contact_modes] == [("slip", "open"), ("open", "slip")]
        assert run.contact_modes[1][0] == pytest.approx(0.1, abs=1e-15)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(("steps", "error"), [({"h": 0.05}, 1e-10), ({}, 5e-14)])
def test_friction_on_a_surface_is_that_of_the_true_normal_force(steps: dict[str, float], error: float) -> None:
    parabola = sc.contact(
        surface="z - x**2/4", of=["x", "z"], slip="(x_dot + x/2*z_dot)/sqrt(1 + x**2/4)", friction=0.2
    )
    assert contacts_of([parabola.table]) == (parabola,)
    stepper = of(f"(x_dot**2 + z_dot**2)/2 - {G}*z", "x z", [parabola])

    def rates(_: float, state: Any) -> list[float]:
        x, v = state
        root = np.sqrt(1 + x * x / 4)
        force = (v * v / 2 + G) / root  # along the normal (-x/2, 1) / root; slip is backward
        return [v, (-G * x / 2 + 0.2 * force * root - x / 2 * v * v / 2) / root**2]

    x, v = solve_ivp(rates, (0, 0.4), [2.0, -0.5], "DOP853", rtol=1e-13, atol=1e-14).y[:, -1]
    run = stepper.integrate([2.0, 1.0], velocity=[-0.5, -0.5], t_end=0.4, **steps)
    assert [run.q[-1, 0], run.velocity[-1, 0]] == pytest.approx([x, v], abs=error)
    normal = (v * v / 2 + G) / np.sqrt(1 + x * x / 4)
    assert run.contact_forces()[-1, 0] == pytest.approx([normal, 0.2 * normal], rel=1e-9)


@pytest.mark.second
def test_a_gap_is_a_distance_or_follows_from_a_surface() -> None:
    for arguments in list[Any]([{"gap": "x", "of": ["x"]}, {"surface": "x"}, {}]):
        with pytest.raises(sc.SystemDefinitionError, match="either its gap="):
            sc.contact(**arguments)
    with pytest.raises(sc.SystemDefinitionError, match="contains 't': give coordinates of the point, among x, y"):
        of(POINT, "x y", [sc.contact(surface="y", of=["t"])])


def impulses(inverse: Any, rate: Any, mu: float, e: float) -> Any:
    """Return the impulses of a contact with u_n = -e u_n(before), that sticks or slides in a direction d."""
    for d in (None, 1.0, -1.0):
        rows = [inverse[0], inverse[1] if d is None else [mu * d, 1.0]]
        impulse = np.linalg.solve(rows, [-(1 + e) * rate[0], -rate[1] if d is None else 0.0])
        if abs(impulse[1]) <= mu * impulse[0] if d is None else (rate + inverse @ impulse)[1] * d >= 0.0:
            return impulse
    raise AssertionError


@pytest.mark.tiers(0, 1)
def test_restitution_is_reduced_where_newtons_law_creates_energy() -> None:
    """Kane's paradox: random rods for which Newton's law with friction creates energy."""
    rod = of(
        "(x_dot**2 + y_dot**2)/2 + a_dot**2/6",
        "x y a",
        [sc.contact("y - cos(a)", slip="x_dot + cos(a)*a_dot", friction="mu", restitution="e")],
        "svi:2",
        mu=0.3,
        e=0.5,
    )
    random, count = np.random.default_rng(1), 0
    for _ in range(1500):
        a, v, mu, e = (
            random.uniform(-1.4, 1.4),
            2 * random.normal(size=3),
            random.uniform(0.2, 1),
            random.uniform(0.3, 1),
        )
        rows = np.array([[0.0, 1.0, np.sin(a)], [1.0, 0.0, np.cos(a)]])
        inverse, rate = rows @ np.diag([1.0, 1.0, 3.0]) @ rows.T, rows @ v
        stick = np.linalg.solve(inverse, [-e * rate[0], 0.0] - rate)
        creates = stick @ rate + stick @ inverse @ stick / 2 > 1e-3 * abs(stick @ rate)
        if rate[0] > -0.3 or abs(stick[1]) > mu * stick[0] or not creates:
            continue
        plastic = impulses(inverse, rate, mu, 0.0)
        moved = impulses(inverse, rate, mu, e) - plastic
        energy = [moved @ inverse @ moved / 2, moved @ (rate + inverse @ plastic), plastic @ (rate + rate) / 2]
        part = np.roots([energy[0], energy[1], energy[2] + plastic @ inverse @ plastic / 2]).real.max()
        impulse = plastic + part * moved
        with pytest.warns(sc.EventWarning, match="kinetic energy with friction: it was reduced"):
            run = rod.integrate([0.0, np.cos(a), a], velocity=v, h=1e-3, steps=1, parameters={"mu": mu, "e": e})
        assert run.velocity[0] == pytest.approx(v + np.array([1.0, 1.0, 3.0]) * (rows.T @ impulse), abs=1e-13)
        assert 0 < part < 1
        assert impulse @ rate + impulse @ inverse @ impulse / 2 == pytest.approx(0, abs=1e-13)
        count += 1
    assert count > 10


@pytest.mark.second
def test_modes_have_names_in_messages_only() -> None:
    stepper = of("x_dot**2/2 - k*x**2/2", "x", [sc.friction("x_dot", limit="d")], "svi:2", k=1.0, d=0.13)
    run = stepper.integrate([1.0], velocity=[0.0], h=0.1, steps=80)
    assert stepper.parameters == ("k", "d")
    assert run.sensitivity().parameters.shape[1:] == (2, 2)
    assert run.pullback(np.ones((len(run), 2))).parameters.shape == (2,)
    assert run.transitions[0].event.title == "contact 1 (slip 'x_dot') stops"
    assert (run.switches, run.contact_modes) == ((), [(0.0, ("slip",))])
    with pytest.raises(sc.StateError, match=r"no parameter 'f' among k, d$"):
        stepper.integrate([1.0], velocity=[0.0], h=0.1, steps=1, parameters={"f": 1.0})
    with pytest.raises(sc.EventError, match="An event can set: x, x_dot, p_x, k, d"):
        stepper.integrate([1.0], velocity=[0.0], h=0.1, steps=1, events=sc.Event("x", then={"f": 1}))
    with pytest.raises(sc.EventError, match="parameter 'k' after the event 'x' is not finite"):
        stepper.integrate([1.0], velocity=[0.0], h=0.1, steps=80, events=sc.Event("x", then={"k": "sqrt(x - 1)"}))


@pytest.mark.tiers(0, 1)
def test_first_modes_do_not_depend_on_units() -> None:
    text = "m*(x_dot**2 + y_dot**2)/2 + m*r**2*a_dot**2/5 - m*g*y"
    table = sc.contact("y - r", slip="x_dot - r*a_dot", friction=0.3, restitution=0.5)
    stepper = of(text, "x y a", [table], "svi:2", m=2.0, r=0.5, g=G)
    expected = {(0.0, 4.0, 0.0): "slip", (0.0, 0.0, 0.0): "stick", (1e-8, 4.0, 0.0): "open", (0.0, 4.0, -1.0): "open"}
    for (gap, v, w), name in expected.items():
        for length, time, mass in np.array(np.meshgrid(*[[1e-9, 1e9]] * 3)).reshape(3, -1).T:
            run = stepper.integrate(
                [0.0, length * (0.5 + gap), 0.0],
                velocity=[v * length / time, w * length / time, 0.0],
                **({"t_end": 1e3 * time} if mass > 1.0 else {"h": 0.05 * time, "steps": 1}),
                parameters={"m": 2 * mass, "r": length / 2, "g": G * length / time**2},
            )
            assert run.contact_modes[0][1] == (name,)
