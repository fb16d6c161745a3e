"""Changes of modes that are too many, too fast or too close: an error that names them, or all of them."""

import numpy as np
import pytest
from notation import lagrange
from samples import QUICK_FLAGS

import scvi_codegen as sc


@pytest.mark.parametrize("plan", [{"t_end": 3.0}, {"h": 5.0, "steps": 1}], ids=["adaptive", "fixed"])
def test_changes_that_chatter_are_named(plan):
    """At irregular intervals, which decrease to 1e-12."""
    shifts = sc.Event("x - a", 1, then={"a": "x + (2 + sin(n**2))*(exp(-n)/10 + 1e-12)", "n": "n + 1"})
    stepper = sc.compile_stepper(lagrange("line", "x", "x_dot**2/2", a=0.5, n=0.0), "svi:2", flags=QUICK_FLAGS)
    with pytest.raises(sc.EventError, match=r"1000 changes of the state by 'x - a' before t = 0\.838233"):
        stepper.integrate([0.0], [1.0], events=shifts, **plan)


@pytest.mark.rotated
def test_bounces_that_accumulate_slowly_end_in_rest():
    ball = lagrange("ball", "y", "y_dot**2/2 - y")
    stepper = sc.compile_stepper(ball, "svi:2", contacts=[sc.contact("y", restitution=0.998)])
    end = np.sqrt(2) * 1.998 / 0.002
    closes = stepper.integrate([1.0], [0.0], h=end / 50, t_end=1.01 * end).contact_modes[-1]
    assert closes == (pytest.approx(end, rel=1e-7), ("slip",))


def test_kinks_that_runs_do_not_locate_are_shown_in_short():
    apart = " + ".join(f"(r[i, {k}] - r[j, {k}] - 10*rint((r[i, {k}] - r[j, {k}])/10))**2" for k in (0, 1))
    pairs = f"sum(i in N, (r_dot[i, 0]**2 + r_dot[i, 1]**2)/2) - sum(i < j in N, positive_part(1 - sqrt({apart}))**2)"
    with pytest.warns(sc.MethodWarning, match=r"such as .{60} = 0 for i < j in N: .*sizes= with at most 256 switching"):
        sc.compile_stepper(lagrange("gas", ["r[N, 2]"], pairs), "svi:2", flags=QUICK_FLAGS)
