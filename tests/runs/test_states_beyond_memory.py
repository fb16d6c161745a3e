"""Runs and ensembles whose states exceed the memory: they end with a status, and the others are returned."""

import numpy as np
import pytest
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen.codegen.native import capacity

OSCILLATOR = sc.LagrangianSystem.from_text("oscillator", ["x"], "x_dot**2/2-w**2*x**2/2", parameters={"w": 1.0})
ARRAY = lagrange("array", "x[N]", "sum(i in N, x_dot[i]**2-w**2*x[i]**2)/2", w=1.0)
SLOW, FAST, TIME = 1.0, 2e4, 1.0


@pytest.fixture
def little_memory(monkeypatch):
    monkeypatch.setattr(capacity, "usable_memory", lambda: 6e6)


@pytest.mark.tiers(1, 2)
@pytest.mark.parametrize("settings", [{}, {"events": sc.Event("x")}, {"precision": "double-double"}])
def test_member_with_too_many_states_ends_and_the_others_are_returned(settings, little_memory):
    stepper = sc.compile_stepper(OSCILLATOR, "svi:4", **settings)
    q, p = np.array([[1.0], [1.0], [1.0]]), np.zeros((3, 1))
    tolerance = {"tolerance": 1e-9}
    with pytest.warns(sc.AccuracyWarning, match=r"trajectory 1 ended at t = .* steps: its states .*t_eval or save_ev"):
        runs = stepper.integrate_ensemble(q, p, t_end=TIME, parameters={"w": [SLOW, FAST, SLOW]}, **tolerance)
    assert runs.status.tolist() == ["ok", "too many states", "ok"]
    alone = stepper.integrate(q[0], p[0], t_end=TIME, **tolerance)
    assert np.array_equal(runs[0].q, alone.q)
    assert np.array_equal(runs[2].p, alone.p)
    assert len(runs.t) == len(alone)
    assert len(runs[1]) == 2
    t, x = float(runs.ends[0][1]), float(runs.ends[1][1, 0])
    assert 0.0 < t < TIME
    assert abs(x - np.cos(FAST * t)) < 1e-2


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("system", [OSCILLATOR, ARRAY], ids=["named", "array"])
def test_run_with_too_many_states_ends_with_them_and_a_remedy(system, little_memory):
    stepper = sc.compile_stepper(system, "svi:4")
    q = {"x": [1.0]} if system is ARRAY else [1.0]
    with pytest.raises(sc.StepFailedError, match=r"fill the memory.*t_eval, save_every.*observe.*record_run") as caught:
        stepper.integrate(q, p=None if system is ARRAY else [0.0], t_end=TIME, parameters={"w": FAST})
    assert caught.value.status == "too many states"
    states = caught.value.trajectory
    assert len(states) > 1000
    assert states.t[-1] == caught.value.t < TIME
    with pytest.raises(sc.StateError, match="do not fit into the memory"):
        stepper.integrate(q, p=None if system is ARRAY else [0.0], h=1e-9, steps=10**9)
