"""Trajectories that C integrates one after the other have the bits of single runs, at a small cost for each."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from counting import TooMuchWorkError, at_most
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen.runs.ensembles import batches

COUNT = 7
RNG = np.random.default_rng(3)
MU = RNG.uniform(0.8, 1.2, COUNT)


@cache
def stepper(name: str) -> sc.Stepper:
    """Return an integrator of each kind of run: iterated, constrained, of arrays."""
    if name == "rod":
        system = lagrange(
            "rod", "x y", "m*(x_dot**2 + y_dot**2)/2 - g*y", m=1.0, g=9.81, constraints=["x**2 + y**2 = 1"]
        )
        return sc.compile_stepper(system, "svi:4")
    if name == "chain":
        system = sc.LagrangianSystem.from_text(
            "chain", ["q[N]"], "sum(i in N, q_dot[i]**2/2 - q[i]**4/4) - sum(i in N periodic, (q[i + 1] - q[i])**2/2)"
        )
        return sc.compile_stepper(system, sc.SVI(4))
    return sc.compile_stepper(sc.problem("kepler").system, "svi:6")


def states(name: str) -> tuple[Any, Any]:
    """Return positions and momenta of COUNT trajectories."""
    if name == "rod":
        angle, rate = RNG.uniform(-1, 1, (2, COUNT))
        q = np.column_stack([np.sin(angle), -np.cos(angle)])
        return q, rate[:, np.newaxis] * np.column_stack([np.cos(angle), np.sin(angle)])
    if name == "chain":
        return RNG.uniform(-1, 1, (COUNT, 5)), RNG.uniform(-1, 1, (COUNT, 5))
    e = RNG.uniform(0.0, 0.8, COUNT)
    return np.column_stack([1 - e, 0 * e]), np.column_stack([0 * e, np.sqrt((1 + e) / (1 - e))])


PLANS: dict[str, dict[str, Any]] = {
    "adaptive": {"t_end": 3.0, "tolerance": 1e-9},
    "own ends": {"t_end": np.linspace(0.0, 4.0, COUNT), "tolerance": 1e-10, "save_every": 3},
    "backward": {"t_end": -2.0, "t": 1.0, "tolerance": 1e-8},
    "end only": {"t_end": 3.0, "tolerance": 1e-9, "t_eval": [3.0]},
    "both ends": {"t_end": 3.0, "tolerance": 1e-9, "t_eval": [0.0, 3.0]},
    "fixed": {"h": 0.05, "steps": 33, "save_every": 5},
    "shorter last step": {"h": 0.04, "t_end": 0.99, "save_every": 7},
}
FIXED = ("fixed", "shorter last step")
CASES = [
    *(("kepler", plan) for plan in PLANS if plan not in FIXED),
    *(("rod", plan) for plan in (*FIXED, "own ends")),
    *(("chain", plan) for plan in ("own ends", "shorter last step")),
]


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(("name", "plan"), CASES)
@pytest.mark.parametrize("capacity", [batches.MOST_NUMBERS, 1])
def test_trajectories_equal_single_runs(name: str, plan: str, capacity: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if the memory for states is full after a few of them."""
    monkeypatch.setattr(batches, "MOST_NUMBERS", capacity)
    one, (q, p), arguments = stepper(name), states(name), PLANS[plan]
    masses = {"parameters": {"mu": MU}} if name == "kepler" else {}
    start = {"q": q} if name == "chain" else q
    runs = one.integrate_ensemble(start, {"q": p} if name == "chain" else p, **arguments, **masses)
    assert runs.ok.all()
    for j, (t, found, momenta, _, steps) in enumerate(runs.each()):
        own = dict(arguments, check_growth=None)
        own["t_end"] = own["t_end"][j] if np.ndim(own.get("t_end")) else own.get("t_end")
        given = {"parameters": {"mu": MU[j]}} if masses else {}
        state = ({"q": q[j]}, {"q": p[j]}) if name == "chain" else (q[j], p[j])
        run = one.integrate(*state, **own, **given)
        assert steps == run.steps
        np.testing.assert_array_equal(t, run.t)
        last = -1 if plan == "shorter last step" else None  # which a single run takes by itself
        for those, expected in ((found, np.asarray(run.q)), (momenta, np.asarray(run.p))):
            if name != "rod":  # whose projection ends within rounding, in lanes at another iterate
                assert those[:last].tobytes() == expected[:last].tobytes()
            np.testing.assert_allclose(those, expected, rtol=0, atol=1e-14)


@pytest.mark.second
@pytest.mark.parametrize(("name", "plan"), [("kepler", "own ends"), ("rod", "fixed")])
def test_threads_and_calls_do_not_change_results(name: str, plan: str, monkeypatch: pytest.MonkeyPatch) -> None:
    one, (q, p), arguments = stepper(name), states(name), PLANS[plan]
    alone = one.integrate_ensemble(q, p, **arguments, threads=1)
    monkeypatch.setattr(batches, "CHUNK_SECONDS", 0.0)  # threads begin after the first call of one step
    monkeypatch.setattr(batches, "FIRST_CHUNK_STEPS", 1)
    reported: list[int] = []
    shared = one.integrate_ensemble(q, p, **arguments, threads=3, progress=reported.append)
    assert shared.q.tobytes() == alone.q.tobytes()
    assert shared.steps.tolist() == alone.steps.tolist()
    assert reported[-1] == (33 if name == "rod" else COUNT)


@pytest.mark.second
@pytest.mark.parametrize(
    "arguments", [{"t_end": 0.2, "tolerance": 1e-9, "save_every": 10**9}, {"h": 0.05, "steps": 2, "threads": 1}]
)
def test_python_costs_less_than_one_function_call_for_each_trajectory(
    arguments: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(batches, "CHUNK_SECONDS", 1e3)  # independent of the clock
    one, (q, p) = stepper("kepler"), (np.repeat(x, 200, axis=0) for x in states("kepler"))
    one.integrate_ensemble(q, p, **arguments)
    with at_most(len(q) // 2):
        one.integrate_ensemble(q, p, **arguments)
    with pytest.raises(TooMuchWorkError), at_most(50):
        one.integrate_ensemble(q, p, **arguments)


def test_initial_states_of_two_kinds_equal_those_of_single_runs() -> None:
    """Of velocities with different masses, and projected where they are typed with few digits."""
    one, (q, v), m = stepper("rod"), states("rod"), np.linspace(0.5, 2.0, COUNT)
    q[1::2], v[1::2] = np.round(q[1::2], 7), np.round(v[1::2], 7)
    runs = one.integrate_ensemble(q, velocity=v, h=0.05, steps=1, parameters={"m": m})
    for j in range(COUNT):
        run = one.integrate(q[j], velocity=v[j], h=0.05, steps=1, parameters={"m": m[j]})
        assert runs.q[:, j].tobytes() == run.q.tobytes()
        assert runs.p[:, j].tobytes() == run.p.tobytes()
    with pytest.warns(sc.AccuracyWarning, match="the initial state violates"):
        one.integrate_ensemble(1.01 * q, velocity=v, h=0.05, steps=1)
    with pytest.raises(sc.StateError, match=rf"^trajectory {COUNT}: .* violates the constraints"):
        one.integrate_ensemble(np.vstack([q, [[3.0, 4.0]]]), np.zeros((COUNT + 1, 2)), h=0.05, steps=1)


@pytest.mark.second
def test_energies_that_change_are_reported_for_the_worst_trajectory() -> None:
    one, (q, p) = stepper("kepler"), states("kepler")
    q[3], p[3] = (1e-3, 0.0), (0.0, 44.5)  # eccentricity .98: hundreds of encounters lose the energy
    with pytest.warns(sc.AccuracyWarning, match="trajectory 3"):
        one.integrate_ensemble(q, p, t_end=300.0, tolerance=1e-4)
