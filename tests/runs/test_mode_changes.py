"""Changes of modes that are too many, too fast or too close: an error that names them, or all of them."""

import numpy as np
import pytest
from notation import lagrange
from samples import QUICK_FLAGS

import scvi_codegen as sc


@pytest.mark.second
@pytest.mark.parametrize("plan", [{"t_end": 3.0}, {"h": 5.0, "steps": 1}], ids=["adaptive", "fixed"])
def test_changes_that_chatter_are_named(plan):
    """At irregular intervals, which decrease to 1e-12."""
    shifts = sc.Event("x - a", 1, then={"a": "x + (2 + sin(n**2))*(exp(-n)/10 + 1e-12)", "n": "n + 1"})
    stepper = sc.compile_stepper(lagrange("line", "x", "x_dot**2/2", a=0.5, n=0.0), "svi:2", flags=QUICK_FLAGS)
    with pytest.raises(sc.EventError, match=r"1000 changes of the state by 'x - a' before t = 0\.838233"):
        stepper.integrate([0.0], [1.0], events=shifts, **plan)


@pytest.mark.tiers(0, 1)
def test_bounces_that_accumulate_slowly_end_in_rest():
    ball = lagrange("ball", "y", "y_dot**2/2 - y")
    stepper = sc.compile_stepper(ball, "svi:2", contacts=[sc.contact("y", restitution=0.998)])
    end = np.sqrt(2) * 1.998 / 0.002
    closes = stepper.integrate([1.0], [0.0], h=end / 50, t_end=1.01 * end).contact_modes[-1]
    assert closes == (pytest.approx(end, rel=1e-7), ("slip",))


@pytest.mark.second
def test_kinks_that_runs_do_not_locate_are_shown_in_short():
    apart = " + ".join(f"(r[i, {k}] - r[j, {k}] - 10*rint((r[i, {k}] - r[j, {k}])/10))**2" for k in (0, 1))
    pairs = f"sum(i in N, (r_dot[i, 0]**2 + r_dot[i, 1]**2)/2) - sum(i < j in N, positive_part(1 - sqrt({apart}))**2)"
    with pytest.warns(sc.MethodWarning, match=r"such as .{60} = 0 for i < j in N: .*sizes= with at most 256 switching"):
        sc.compile_stepper(lagrange("gas", ["r[N, 2]"], pairs), "svi:2", flags=QUICK_FLAGS)


PULSES = {
    "sin(t) - 1 + w": lambda w: [(4 * k + 1) * np.pi / 2 + s * np.arccos(1 - w) for k in range(4) for s in (-1, 1)],
    "exp(-(t - 7.123)**2/w) - 1/2": lambda w: [7.123 + s * np.sqrt(w * np.log(2)) for s in (-1, 1)],
    "(t - 3)*(t - 3 - w)*(t - 15)": lambda w: [3.0, 3.0 + w, 15.0],
    "sin(t)**2 - sin(t/3)*cos(t)**3 - 1 + w": None,
    "min(cos(t), sin(3*t)) - 1/2 - w": None,
    "log(t + 1)*tanh(t - 5)*sqrt(1 + t**2)/(2 + atan(t)) - 8 + w": None,
    "sin(t) - 1": lambda w: [],
}


@pytest.mark.tiers(2, 4)
@pytest.mark.parametrize("plan", [{}, {"h": 0.7}], ids=["adaptive", "fixed"])
@pytest.mark.parametrize("u", PULSES)
def test_all_zeros_of_functions_of_time_are_found(u, plan):
    """However narrow the pulse: to closed forms, or the changes of sign of 10^6 values."""
    stepper = sc.compile_stepper(
        lagrange("p", "x", "x_dot**2/2", forces={"x": f"unit_step({u})"}, w=1.0), "svi:2", flags=QUICK_FLAGS
    )
    for w in (1e-6, 1e-9):
        run = stepper.integrate([0.0], [0.0], t_end=20.0, parameters={"w": w}, **plan)
        exact = PULSES[u] and sorted(t for t in PULSES[u](w) if t < 20.0)
        if exact is None:
            t = np.linspace(0.0, 20.0, 10**6)
            names = {name: getattr(np, name) for name in ("sin", "cos", "exp", "tanh", "sqrt")}
            g = eval(u, {**names, "log": np.log, "atan": np.arctan, "min": np.minimum, "t": t, "w": w})
            exact = t[:-1][np.sign(g[1:]) != np.sign(g[:-1])]
        assert run.switches[0].t == pytest.approx(exact, abs=1e-16 / w**0.5 if PULSES[u] else 1e-4)
