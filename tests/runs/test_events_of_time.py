"""Zeros of events that are functions of time alone are found independently of the steps."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

import scvi_codegen as sc

KICK = {"p_x": "p_x + 1"}


@cache
def free() -> sc.Stepper:
    return sc.compile_stepper(sc.LagrangianSystem.from_text("free", ["x"], "x_dot**2/2"), "svi:4")


def times(function: str, then: dict[str, str] | None = None, **steps: Any) -> Any:
    return free().integrate([0.0], [0.0], events=[sc.Event(function, then=then)], check_growth=False, **steps)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("then", [KICK, None])
@pytest.mark.parametrize("steps", [{"t_end": 500.5}, {"h": 10.0, "steps": 50}, {"h": 0.7, "steps": 715}])
def test_every_kick_is_found(then: dict[str, str] | None, steps: dict[str, Any]) -> None:
    run = times("sin(pi*t)", then, **steps)
    assert_allclose(run.events[0].t, np.arange(1, 501), rtol=4e-16)
    assert run.p[-1, 0] == (500 if then else 0)


@pytest.mark.tiers(1)
@pytest.mark.parametrize(
    ("function", "zeros"),
    [
        ("t - 7", [7.0]),
        ("cos(pi*(t - 1/2)/10)", np.arange(5.5, 97.5, 10.0)),
        ("rint(t - 3)", [2.5]),
        ("sin(t**2/100)", np.sqrt(100 * np.pi * np.arange(1, 31))),
    ],
)
def test_zeros_of_other_functions(function: str, zeros: Any) -> None:
    assert_allclose(times(function, KICK, t_end=97.5).events[0].t, zeros, rtol=1e-14)


def test_zeros_within_rounding_of_nodes() -> None:
    for steps in (5, 8, 9, 12):
        assert_allclose(times("t - 1/10", KICK, h=0.1 / steps, t_end=0.25).events[0].t, [0.1], rtol=2e-16)


def test_zeros_of_polynomials_are_found_along_steps() -> None:
    run = times("(t - 1)*(t - 2)*(t - 3)", KICK, t_end=97.5)
    assert_allclose(run.events[0].t, [1.0, 2.0, 3.0], rtol=1e-12)


@pytest.mark.second
def test_backward_terminal_and_continued_runs() -> None:
    back = times("sin(pi*t)", KICK, t_end=-20.5)
    assert_allclose(back.events[0].t, -np.arange(1.0, 21.0), rtol=4e-16)
    ends = free().with_events([sc.Event("sin(pi*t)", terminal=7)])
    assert ends.integrate([0.0], [1.0], t_end=100.0).t[-1] == 7.0
    assert ends.integrate([0.0], [1.0], t_end=100.0, t=7.0).t[-1] == 14.0  # a start at a zero is no crossing
    run = free().with_events([sc.Event("sin(pi*t)", then=KICK)]).start([0.0], [0.0], t_end=30.0)
    for _ in range(3):
        run.record(7)
    assert run.record().p[-1, 0] == 30.0


@pytest.mark.second
def test_coincident_events_and_ensembles() -> None:
    both = [sc.Event("sin(pi*t)"), sc.Event("sin(2*pi*t)", then=KICK), sc.Event("x - 10")]
    run = free().integrate([0.0], [0.0], events=both, t_end=10.2, check_growth=False)
    assert [len(each) for each in run.events] == [10, 20, 1]
    kicked = free().with_events([sc.Event("sin(pi*t)", then=KICK)])
    runs = kicked.integrate_ensemble([[0.0], [1.0]], [[0.0], [0.5]], t_end=50.5)
    assert [runs[j].p[-1, 0] for j in range(2)] == [50.0, 50.5]


@pytest.mark.rotated
def test_arrays() -> None:
    chain = sc.LagrangianSystem.from_text("chain", ["u[N]"], "sum(i in N, u_dot[i]**2/2)")
    state = {"q": {"u": [1.0, 2.0]}, "velocity": {"u": [0.0, 0.0]}}
    for then in (None, {"u[0]": "u[0] + 1"}):
        events = [sc.Event("sin(pi*t)", then=then)]
        run = sc.compile_stepper(chain, "svi:4").integrate(**state, t_end=100.5, events=events, check_growth=False)
        assert_allclose(run.events[0].t, np.arange(1, 101), rtol=4e-16)
