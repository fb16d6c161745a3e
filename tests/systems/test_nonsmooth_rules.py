"""Rules for kinks and contacts whose violation no other test shows; which test would show it, of all others.

| rule | tests |
| --- | --- |
| L jumps at u(q, t) = 0: refraction, reflection; at times p is continuous | test_jumps; here |
| powers that are not whole: order min(2s, k) at fixed steps, 1 < k < 2 refused | here; test_kinks; refusals |
| fixed steps across located kinks are not symplectic, formulas are; derivatives across kinks | here; test_kinks |
| constraints have no corners; their kinks keep the order | refusals, test_continuity, test_tables; here |
| kinks in velocities: in forces only; masses with kinks | refusals, test_kinks (drag); here |
| two surfaces at once, starts on a surface | test_jumps (corners), test_contacts (joint at its limit); here |
| forces that point to a surface: dry friction, sliding named, relays accumulate | test_kinks (sliding); here |
| two crossings in a step, grazing, chattering | here; test_kinks (short visits), test_jumps, test_mode_changes |
| arrays: number of functions, lists; multiples of one function | test_mode_changes, test_many_contacts; here |
| zeros of functions of time | test_mode_changes |
| redundant contacts | test_many_contacts |
| slip in space: its beginning, small minima | test_contacts (begins); here |
| static above kinetic friction, starts at the limit | test_contacts (belt); here |
| first modes, bits of restarts and of ensembles | test_contact_runs (units), test_contacts; here |
| features | test_jumps, test_features |
| names of functions and tables | here; refusals, test_tables |
| where contacts are stated | test_contacts (model file), test_robot_contacts |
| impacts: cradles, restitution, plates and blocks | test_contacts, test_contact_runs; here |
| rest after accumulating impacts, starts within rounding, gaps that are distances | test_contacts, test_contact_runs |
| d x/d d = -8, d x/d mu, tippe top, shaken floors, balance | test_contact_derivatives, _of_bodies, _runs |
"""

import re
from typing import Any

import numpy as np
import pytest
from notation import lagrange
from samples import QUICK_FLAGS
from scipy.integrate import solve_ivp

import scvi_codegen as sc

pytestmark = pytest.mark.tiers(0, 1)
STEPS = pytest.mark.parametrize("steps", [{"h": 0.3}, {}], ids=["fixed", "adaptive"])


def made(text: str, coordinates: str = "x", method: str = "svi:3", contacts: Any = (), **given: Any) -> Any:
    return sc.compile_stepper(
        lagrange("rule", coordinates, text, **given), method, flags=QUICK_FLAGS, contacts=contacts
    )


@STEPS
@pytest.mark.parametrize(
    ("text", "x"),
    [
        ("x_dot**2/2 + 3/10*unit_step(t - 1)*x_dot", 1.7),
        ("(1 + 3*unit_step(t - 1))*x_dot**2/2", 1.25),
        ("x_dot**2/2 - x*unit_step(t - 1)", 1.5),
    ],
)
def test_momenta_are_continuous_where_l_jumps_at_a_time(text: str, x: float, steps: dict[str, float]) -> None:
    run = made(text).integrate([0.0], [1.0], t_end=2.0, **steps)
    assert run.q[-1] == pytest.approx([x], abs=1e-15)
    assert run.p[-1] == pytest.approx([0.0 if "x*unit" in text else 1.0], abs=1e-15)


@pytest.mark.second
def test_fixed_steps_at_a_power_that_is_not_whole_have_its_order() -> None:
    """Of steps between 1/32 and 1/512 in steps of 2^(1/4), whose errors depend on the place of the zero."""
    text = "x_dot**2/2 - 40*positive_part(-x)**(5/2)"
    run = made(text, method="svi:8").integrate([1.0], [-1.0], t_end=3.0, tolerance=1e-14)
    stepper, counts = made(text, method="svi:4"), 2 ** np.arange(5, 9.1, 0.25)
    errors = [abs(stepper.integrate([1.0], [-1.0], h=3.0 / n, t_end=3.0).q[-1, 0] - run.q[-1, 0]) for n in counts]
    assert -np.polyfit(np.log(counts), np.log(errors), 1)[0] == pytest.approx(2.5, abs=0.7)


@pytest.mark.parametrize(("power", "bound"), [("2", 2e-9), ("5/2", 5e-8), ("7/3", 5e-8)])
def test_constraints_with_kinks_keep_the_order_or_that_of_their_power(power: str, bound: float) -> None:
    """A bead that slides from a level wire onto y = x^k, against DOP853 for x from x = 0 on."""
    bead = made("(x_dot**2 + y_dot**2)/2 - y", "x y", "svi:4", constraints=[f"y - positive_part(x)**({power})"])
    k = eval(power)

    def rates(_: float, state: Any) -> list[float]:
        x, v = np.maximum(state[0], 0.0), state[1]
        slope, bend = k * x ** (k - 1), k * (k - 1) * x ** (k - 2)
        return [v, -slope * (1 + bend * v**2) / (1 + slope**2)]

    true = solve_ivp(rates, (0.973, 2), [0, 1], "DOP853", rtol=1e-13, atol=1e-15).y[0, -1]
    for plan, error in (({}, 1e-12), ({"h": 0.05}, bound)):
        run = bead.integrate([-0.973, 0], [1, 0], t_end=2.0, **plan)
        assert (abs(run.q[-1, 0] - true) < error, len(run.switches[0])) == (True, 1)
    with pytest.raises(sc.SystemDefinitionError, match=r"constraint .* has no bounded slope where x = 0"):
        lagrange("bead", "x y", "(x_dot**2 + y_dot**2)/2 - y", constraints=["y - positive_part(x)**(7/4)"])


@STEPS
def test_velocities_are_continuous_where_a_mass_has_a_kink(steps: dict[str, float]) -> None:
    run = made("(1 + abs(x))*x_dot**2/2", method="svi:8").integrate([-1.0], [1.0], t_end=4.0, **steps)
    assert len(run.switches[0]) == 1
    assert run.velocity[:, 0] * np.sqrt(1 + abs(run.q[:, 0])) == pytest.approx(np.sqrt(0.5), abs=1e-12)


@STEPS
@pytest.mark.parametrize(
    ("force", "x"),
    [("unit_step(x)", 0.5), ("-unit_step(x)", 0.0), ("unit_step(-x)", 0.0), ("-unit_step(-x)", -0.5), ("sign(x)", 0.5)],
)
def test_starts_at_rest_on_a_surface_take_a_consistent_side(force: str, x: float, steps: dict[str, float]) -> None:
    run = made("x_dot**2/2", forces={"x": force}).integrate([0.0], [0.0], t_end=1.0, **steps)
    assert (run.q[-1], len(run.switches[0])) == (pytest.approx([x], abs=1e-15), 0)


@pytest.mark.tiers(0, 1)
@STEPS
def test_a_relay_accumulates_and_its_equilibrium_is_named(steps: dict[str, float]) -> None:
    """x'' = -sign(x) - x'/2: amplitudes fall as 1/t; at x = 0, x' = 0 both sides point to the surface."""
    relay = made("x_dot**2/2", forces={"x": "-sign(x) - x_dot/2"})
    assert abs(relay.integrate([1.0], [0.0], t_end=15.0, **steps).q[-1, 0]) < 0.05
    with pytest.raises(sc.EventError, match="rests in the corner 'x' = 0 at t = 0"):
        relay.integrate([0.0], [0.0], t_end=1.0, **steps)


DRY: dict[str, tuple[str, dict[str, str], list[sc.Friction]]] = {
    "coulomb": ("x", {"x": "-d*sign(x_dot)"}, [sc.friction("x_dot", limit="d")]),
    "stribeck": (
        "x",
        {"x": "-(d + exp(-5*abs(x_dot - 1/5))/5)*sign(x_dot - 1/5)"},
        [sc.friction("x_dot - 1/5", limit="d + exp(-5*abs(x_dot - 1/5))/5")],
    ),
    "two-sided": ("x", {"x": "where(x_dot < 0, 2*d, -d)"}, [sc.friction("x_dot", limit="3*d/2")]),
    "drag": ("x", {"x": "-d*sign(2*x_dot) - x_dot*abs(x_dot)/9"}, [sc.friction("x_dot", limit="d + x_dot**2/9")]),
    "between": (
        "x y",
        {"x": "d*sign(y_dot - x_dot)", "y": "-d*sign(y_dot - x_dot) - d*sign(y_dot)/2"},
        [sc.friction("x_dot - y_dot", limit="d"), sc.friction("y_dot", limit="d/2")],
    ),
    "on a side": ("x", {"x": "-d*sign(x_dot)*unit_step(x)"}, [sc.friction("x_dot", limit="d*unit_step(x)")]),
    "by position": ("x", {"x": "-d*abs(x)*sign(x_dot)"}, [sc.friction("x_dot", limit="d*abs(x)")]),
    "odd power": ("x", {"x": "-d*sign(x_dot**3)"}, [sc.friction("x_dot", limit="d")]),
    "power of a sign": ("x", {"x": "-d*x_dot**3/abs(x_dot)**3"}, [sc.friction("x_dot", limit="d")]),
    "normal force": ("x", {"x": "-d*abs(cos(t) - x)*sign(x_dot)"}, [sc.friction("x_dot", limit="d*abs(cos(t) - x)")]),
    "quotient": ("x", {"x": "-d*x_dot/abs(x_dot)"}, [sc.friction("x_dot", limit="d")]),
    "root": ("x", {"x": "-d*x_dot/sqrt(x_dot**2)"}, [sc.friction("x_dot", limit="d")]),
    "pair": ("x", {"x": "d*unit_step(-x_dot) - d*unit_step(x_dot)"}, [sc.friction("x_dot", limit="d")]),
    "parts": ("x", {"x": "-d*(positive_part(x_dot) + positive_part(-x_dot))/x_dot"}, [sc.friction("x_dot", limit="d")]),
    "oblique": (
        "x y",
        {"x": "-d*cos(y)*sign(cos(y)*x_dot + x*y_dot)", "y": "-d*x*sign(cos(y)*x_dot + x*y_dot)"},
        [sc.friction("cos(y)*x_dot + x*y_dot", limit="d")],
    ),
    "in space": (
        "x y",
        {x: f"-d*({x}_dot - v)/sqrt((x_dot - v)**2 + (y_dot - v)**2) - {x}/9" for x in "xy"},
        [sc.friction(["x_dot - v", "y_dot - v"], limit="d")],
    ),
}
"""Coordinates, forces with steps of slips, and the friction that they are."""


@STEPS
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in ("coulomb", "in space") else pytest.mark.rotated) for name in DRY]
)
def test_forces_that_jump_along_a_slip_are_dry_friction(name: str, steps: dict[str, float]) -> None:
    names, forces, contacts = DRY[name]
    text, bias = " + ".join(f"({x}_dot**2 - {x}**2)/2" for x in names.split()), name == "two-sided"
    states = [1.0, 0.0][: len(names.split())], [0.0] * len(names.split())
    stated = made(text, names, forces=forces, d=0.15, v=0.1).integrate(*states, t=1.0, t_end=14.0, **steps)
    smooth = " + d*x/2" * bias + " - (x**2 + y**2)/18" * (name == "in space")
    friction = made(text + smooth, names, contacts=contacts, d=0.15, v=0.1)
    assert stated.contact_modes
    expected = friction.integrate(*states, t=1.0, t_end=14.0, **steps)
    assert stated.q[-1] == pytest.approx(expected.q[-1], abs=1e-13)
    assert [modes for _, modes in stated.contact_modes] == [modes for _, modes in expected.contact_modes]
    if name == "coulomb":
        assert stated.q[-1] == pytest.approx([-0.1], abs=1e-9)  # amplitudes 1, .7, .4, .1


@STEPS
@pytest.mark.second
def test_sums_over_arrays_in_forces_are_dry_friction(steps: dict[str, float]) -> None:
    """Of slips between elements, and of a size by the places of all."""
    array = "x[2]", "sum(i in 2, x_dot[i]**2/2 - x[i]**2/2)"
    for force, contacts in (
        ("-d*sum(j in 2, sign(x_dot[i] + x_dot[j]))", [("x_dot[i] for i in 2", "d"), ("x_dot[0] + x_dot[1]", "d")]),
        ("-d*sign(x_dot[i])*sum(j in 2, abs(x[j]))", [("x_dot[i] for i in 2", "d*abs(x[0]) + d*abs(x[1])")]),
    ):
        stated = lagrange("array", *array, forces={"x[i]": force}, d=0.15)
        dry = [sc.friction(slip, limit=limit) for slip, limit in contacts]
        friction = sc.compile_stepper(lagrange("array", *array, d=0.15), "svi:3", contacts=dry)
        runs = [
            stepper.integrate([1.0, 0.4], [0.0, 0.0], t_end=9.0, **steps)
            for stepper in (sc.compile_stepper(stated, "svi:3"), friction)
        ]
        assert runs[0].q[-1] == pytest.approx(runs[1].q[-1], abs=1e-13)
        assert len(runs[0].contact_modes) == len(runs[1].contact_modes) > 1


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("contacts", [[], [sc.friction("x_dot", limit=0.15)]], ids=["force", "contact"])
def test_friction_is_part_of_steppers_of_either_precision(contacts: list[sc.Friction]) -> None:
    system = lagrange("rule", "x", "x_dot**2/2 - x**2/2", forces={} if contacts else {"x": "-0.15*sign(x_dot)"})
    stepper = sc.compile_stepper(system, "svi:3", flags=QUICK_FLAGS, contacts=contacts, precision="auto")
    assert stepper.integrate([1.0], [0.0], t_end=13.0, error=1e-8).q[-1] == pytest.approx([-0.1], abs=1e-8)


@pytest.mark.parametrize("force", ["d*sign(x_dot)", "-d*x_dot*abs(x_dot)", "-d*sign(x) - x_dot", "-d*x*sign(x_dot)"])
def test_other_jumps_are_no_friction(force: str) -> None:
    """Forces that supply energy, or may do so, that are continuous at rest, and of positions alone."""
    assert not made("x_dot**2/2 - x**2/2", forces={"x": force}, d=0.15).interface.contacts


SPRINGS = "(x_dot**2 + y_dot**2 - x**2 - y**2)/2"
NO_FRICTION: dict[str, tuple[dict[str, str], str, str]] = {
    "reaction": (
        {"x": "-d*sign(x_dot - y_dot)"},
        "the force on y jumps otherwise than by -2*F*.*F = d",
        "x_dot - y_dot",
    ),
    "negative": ({"x": "-d*sign(x_dot)*(1 + x_dot)"}, "F = .* is negative at some states", "x_dot"),
    "not linear": ({"x": "-d*sign(sin(x_dot))"}, "it is not linear in the velocities", "x_dot"),
    "across": ({"x": "-d*sign(x_dot)", "y": "-d*sign(x_dot)*x/9"}, "the force on y jumps otherwise", "x_dot"),
    "quadrature": ({"x": "-d*sign(x_dot)"}, "an svi: has no quadrature= with contacts", "x_dot"),
}
"""Forces, the condition of dry friction that they violate, and the slip of what the remedy states."""


@STEPS
@pytest.mark.second
@pytest.mark.parametrize("name", NO_FRICTION)
def test_forces_that_are_no_friction_name_the_condition_and_have_remedies(name: str, steps: dict[str, float]) -> None:
    """The message has the time of the stop, 1 + 3 pi or the second one behind it; each of its remedies is followed."""
    forces, lacks, slip = NO_FRICTION[name]
    method = {"method": "svi", "degree": 4, "quadrature": "gauss-legendre:4"} if name == "quadrature" else "svi:3"
    start = {"q": [1.0, 0.0], "velocity": [0.0, 0.0], "t": 1.0, "t_end": 14.0, **steps}

    def stepper(method: Any = "svi:3", contacts: Any = (), events: Any = (), **given: Any) -> Any:
        system = lagrange("springs", "x y", SPRINGS, d=0.15, **given)
        return sc.compile_stepper(system, method, contacts=contacts, events=events)

    with pytest.raises(sc.EventError, match=lacks) as error:
        stepper(method, forces=forces).integrate(**start)
    t = float(re.search(r" = 0 at t = ([\d.]+):", str(error.value))[1])  # type: ignore[index]
    assert t == pytest.approx(1 + 3 * np.pi if name != "negative" else 13.6018634, abs=1e-6)
    assert "Write it as sc.friction(slip, limit=F)" in str(error.value)
    dry = stepper(contacts=[sc.friction(slip, limit="d")]).integrate(**start)
    assert dry.contact_modes[-1][1] == ("stick",) or name == "reaction"
    smooth = {x: re.sub(r"sign\((?:sin)?\(?(.*?_dot)\)?\)", r"tanh(50*(\1))", force) for x, force in forces.items()}
    assert stepper(forces=smooth).integrate(**start).t[-1] == 14.0
    rests = sc.Event(slip, terminal=True, where=f"t > {t - 1}")
    assert stepper(method, forces=forces, events=rests).integrate(**start).t[-1] == pytest.approx(t, abs=1e-6)


@pytest.mark.filterwarnings("ignore::scvi_codegen.common.errors.MethodWarning")
@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("size", [3, 200, "N"])
def test_friction_of_arrays_is_one_contact_an_element_of_at_most_192(size: int | str) -> None:
    """Smooth forces of arrays of run-time sizes are no expressions."""
    text, force = f"sum(i in {size}, x_dot[i]**2/2 - x[i]**2/2)", "-0.15*sign(x_dot[i])"
    array = lagrange("array", f"x[{size}]", text, forces={"x[i]": force})
    known = {"sizes": {"N": 3}} if size == "N" else {}
    stepper = sc.compile_stepper(array, "svi:2", flags=QUICK_FLAGS, **known)
    assert len(stepper.interface.contacts) == (0 if size == 200 else 3)
    if size != 200:
        run = stepper.integrate([1.0, 0.5, 0.1], [0.0] * 3, h=0.1, t_end=13.0)
        assert run.q[-1] == pytest.approx([-0.1, -0.1, 0.1], abs=1e-6)
    smooth = lagrange("array", "x[N]", "sum(i in N, x_dot[i]**2/2 - x[i]**2/2)", forces={"x[i]": "-x_dot[i]*abs(x[i])"})
    assert sc.compile_stepper(smooth, "svi:2", flags=QUICK_FLAGS).run_time_sizes


@pytest.mark.tiers(0, 1)
@STEPS
@pytest.mark.parametrize(
    ("text", "given", "bend"),
    [
        (" - 0.1*unit_step(x**2 + y**2 - 1)", {}, 0.0),
        (" + (y - 1)/2", {"forces": {"x": "3*unit_step(1 - y)"}}, 0.5),
        ("", {"contacts": [sc.contact("x**2 + y**2 - 1", restitution=0.5)]}, 0.0),
        (" - 50*positive_part(1 - x**2 - y**2)**2", {}, 0.0),
    ],
    ids=["refraction", "force", "contact", "continuous"],
)
def test_derivatives_at_a_graze_are_refused(text: str, given: dict[str, Any], bend: float, steps: dict) -> None:
    """A point of acceleration y'' = bend at first, which passes x = 0, y = 1 with y' = 0, 2.05 after its start."""
    stepper = made("(x_dot**2 + y_dot**2)/2" + text, "x y", **given)

    def run(dy: float) -> Any:
        start = [-2.05, 1 + dy + bend * 2.05**2 / 2], [1, -bend * 2.05]
        return stepper.integrate(*start, t=3.0, t_end=7.1, **steps)

    apart = [(run(dy).q[-1] - run(0).q[-1]) / dy for dy in (1e-8, -1e-8)]
    if "positive_part" in text:
        assert np.array([*apart, run(0).tangent()[-1][:2, 1]]) == pytest.approx(
            np.tile([0, 1], (3, 1)), abs=0.2
        )  # less as the root of dy
        return
    assert np.abs(apart[1] - apart[0]).max() > 100
    for derivatives in (run(0).sensitivity, run(0).tangent, lambda: run(0).pullback(np.ones((len(run(0)), 4)))):
        with pytest.raises(sc.StateError, match=r"tangent to the run at t = (5\.0|5\.1|4\.9)"):
            derivatives()


def test_multiples_of_a_switching_function_are_one() -> None:
    assert made("x_dot**2/2 - positive_part(x - 1)**2 - positive_part(2 - 2*x)**2 - abs(5*x - 5)").modes == ("mode_1",)


@pytest.mark.tiers(0, 1)
@STEPS
@pytest.mark.parametrize("v", [1e-2, 1e-4, 1e-6])
def test_a_slip_in_space_passes_near_zero_without_a_stop(v: float, steps: dict[str, float]) -> None:
    """A block that is pushed back along its velocity, but for a small angle."""
    block = made(
        "(x_dot**2 + y_dot**2 + z_dot**2)/2 - 9.81*z + 4*x",
        "x y z",
        contacts=[sc.contact("z", slip=["x_dot", "y_dot"], friction=0.1)],
    )

    def rates(_: float, state: Any) -> list[float]:
        d = state[2:] / np.hypot(*state[2:])
        return [*state[2:], 4.0 - 0.981 * d[0], -0.981 * d[1]]

    true = solve_ivp(rates, (0, 1), [0, 0, -1, v], "DOP853", rtol=1e-13, atol=1e-16).y[:, -1]
    run = block.integrate([0, 0, 0], velocity=[-1, v, 0], t_end=1, **{name: h / 6 for name, h in steps.items()})
    assert run.contact_modes == [(0.0, ("slip",))]
    assert np.abs([*run.q[-1, :2], *run.velocity[-1, :2]] - true).max() < 2e-7


@pytest.mark.parametrize("start", [1.0, 0.95, 0.55, 0.45, -1.0])
def test_a_stop_sticks_only_below_the_static_limit(start: float) -> None:
    """Each swing is shorter by 2 d; it ends at |x| <= d_s = 0.3."""
    dry = made("x_dot**2/2 - x**2/2", contacts=[sc.friction("x_dot", limit=0.1, static_limit=0.3)])
    swings = next(n for n in range(9) if abs(start) - 0.2 * n <= 0.3)
    run = dry.integrate([start], velocity=[0], h=0.1, t_end=25.0)
    assert run.q[-1, 0] == pytest.approx(np.copysign(abs(start) - 0.2 * swings, start * (-1) ** swings), abs=1e-12)
    assert run.contact_modes == [(0.0, ("slip",)), (pytest.approx(swings * np.pi), ("stick",))]


@pytest.mark.tiers(0, 1)
@STEPS
@pytest.mark.parametrize("beyond", [0.0, 1e-16, 1e-14, 1e-12, 1e-10, 1e-9])
def test_friction_at_its_limit_lets_a_body_go_that_is_pushed_harder(beyond: float, steps: dict[str, float]) -> None:
    """Within rounding of the limit a body may stick; forces that leave the cone then have no zero."""
    text, floor = "(x_dot**2 + y_dot**2)/2 - y + x*(f + t)", sc.contact("y", slip="x_dot", friction=1.0)
    for f, contacts in ((0.1, [sc.contact("y"), sc.friction("x_dot", limit=0.1)]), (1.0, [floor])):
        run = made(text, "x y", contacts=contacts, f=f).integrate(
            [0.0, 0.0], velocity=[0.0, 0.0], t_end=1.0, parameters={"f": f * (1 + beyond)}, **steps
        )
        assert run.q[-1] == pytest.approx([1 / 6 + f * beyond / 2, 0.0], abs=1e-14)


@pytest.mark.second
def test_restored_runs_and_members_have_the_modes_and_bits_of_runs() -> None:
    ball = made(
        "(x_dot**2 + y_dot**2)/2 - 9.81*y",
        "x y",
        contacts=[sc.contact("y", slip="x_dot", friction=0.1, restitution=0.5)],
    )
    starts = np.array([[0, 0], [0, 1], [0, 2e-3]]), np.array([[1, 0], [1, 0], [0, 0]])
    members = ball.integrate_ensemble(starts[0], velocity=starts[1], h=0.03, steps=40)
    for k, (q, v) in enumerate(zip(*starts, strict=True)):
        run = ball.integrate(q, velocity=v, h=0.03, steps=40)
        assert members[k].contact_modes == run.contact_modes
        assert np.array_equal(members[k].q[-1], run.q[-1])
        for steps in (1, 3, 17):
            parts = ball.start(q, velocity=v, h=0.03)
            parts.advance(steps)
            again = ball.from_checkpoint(parts.checkpoint())
            again.advance(40 - steps)
            assert np.array_equal([again.q, again.p], [run.q[-1], run.p[-1]])


@pytest.mark.parametrize("name", ["min", "max", "abs", "sign", "where"])
def test_names_of_a_system_win_over_functions(name: str) -> None:
    for _ in range(2):  # also of what the cache knows
        with pytest.warns(sc.SystemDefinitionWarning, match=rf"so the function {name}\(..\) is not available"):
            stepper = made(f"x_dot**2/2 - {name}*x**2/2", **{name: 4.0})
    assert stepper.integrate([1.0], [0.0], h=0.1, t_end=np.pi / 2).q[-1] == pytest.approx([-1.0], abs=1e-8)


@pytest.mark.second
def test_a_closed_contact_takes_part_in_impacts_with_restitution_0() -> None:
    """A plate of mass 2 at rest on a floor of restitution 0.8 stays; a ball bounces on it with 0.5."""
    contacts = [sc.contact("y", restitution=0.8), sc.contact("z - y - 1", restitution=0.5)]
    plate = made("(2*y_dot**2 + z_dot**2)/2 - 9.81*(2*y + z)", "y z", contacts=contacts)
    run = plate.integrate([0, 1.5], velocity=[0, 0], h=0.01, t_end=0.5)
    fall = np.sqrt(1 / 9.81)
    after = 0.5 - fall
    assert run.q[-1] == pytest.approx([0, 1 + 0.5 * 9.81 * fall * after - 9.81 / 2 * after**2], abs=1e-13)


def test_a_rocking_block_loses_housners_part_of_its_rate() -> None:
    """The rate of a block after an impact on its other corner is 1 - 3/2 sin^2 of that before (G. W. Housner 1963)."""
    height, width = 1.0, 0.2
    corners = [
        sc.contact(
            f"y - {height}*cos(a) {e:+}*{width}*sin(a)",
            slip=f"x_dot + a_dot*({height}*cos(a) {-e:+}*{width}*sin(a))",
            friction=5.0,
        )
        for e in (-1, 1)
    ]
    text = f"(x_dot**2 + y_dot**2)/2 + {(height**2 + width**2) / 3}*a_dot**2/2 - 9.81*y"
    run = made(text, "x y a", contacts=corners).integrate(
        [0, np.cos(0.1) + width * np.sin(0.1), 0.1], velocity=[0, 0, 0], h=0.02, t_end=3.0
    )
    hits = [t for t, _ in run.contact_modes[1:]]
    speeds = np.abs(run.velocity[np.searchsorted(run.t, hits), 2])
    ratio = 1 - 1.5 * np.sin(np.arctan(width / height)) ** 2
    assert speeds[1:] / speeds[:-1] == pytest.approx(np.full(len(hits) - 1, ratio), abs=1e-12)
    assert run.energy_error() < 1e-13


def test_an_energy_that_is_0_has_the_size_of_its_parts() -> None:
    """A mass that falls on a rope from rest: the error is a part of its kinetic energy, in any units."""
    rope = lagrange("rope", "y", "m*(y_dot**2/2 + 9.81*y - 500*positive_part(y - 1)**2)", m=1.0)
    stepper = sc.compile_stepper(rope, "svi:2")
    errors = [
        stepper.integrate([0.0], [0.0], h=0.005, t_end=2.0, parameters={"m": m}).energy_error() for m in (1.0, 2.0**-30)
    ]
    assert errors[0] == errors[1] < 1e-6
