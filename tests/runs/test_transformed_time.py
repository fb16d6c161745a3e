"""Runs in transformed time: fixed steps of tau, and everything that users give and get in time."""

from functools import cache
from typing import Any

import numpy as np
import pytest
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen.runs.results.time_transformation import part_of_step

KEPLER = lagrange("Kepler", "x y", "(x_dot**2 + y_dot**2)/2 + mu/sqrt(x**2 + y**2)", mu=1.0)
ECCENTRICITY = 0.9
START: Any = [1.0 - ECCENTRICITY, 0.0], [0.0, float(np.sqrt((1 + ECCENTRICITY) / (1 - ECCENTRICITY)))]
METHODS = {
    "svi": sc.SVI(8),
    "svi, other points": sc.SVI(6, sc.gauss_lobatto(8)),
    "three points": sc.Gauss(3),
    "radau": sc.RadauIIA(4),
    "lobatto": sc.LobattoIIIA(4),
}
FORMS = {"L": "frequency", "K": "frequency", "K, momenta": "arclength"}


@cache
def system_of(form: str) -> sc.LagrangianSystem | sc.HamiltonianSystem:
    return sc.reparametrise(KEPLER if form == "L" else sc.hamiltonian_of(KEPLER), FORMS[form])


@cache
def stepper(form: str = "L", solver: str = "auto", method: str = "svi") -> sc.Stepper:
    return sc.compile_stepper(system_of(form), METHODS[method], solver=solver)


def kepler_time(q: Any) -> Any:
    """Return the time between positions less than half an orbit apart, from Kepler's equation."""
    axis = np.sqrt(1.0 - ECCENTRICITY**2)
    anomaly = np.unwrap(np.arctan2(q[:, 1] / axis, q[:, 0] + ECCENTRICITY))
    return anomaly - ECCENTRICITY * np.sin(anomaly)


WAYS = [(form, solver) for form in FORMS for solver in ("auto", "newton")]


@pytest.mark.tiers(0, 1)
@pytest.mark.sampled(3)
@pytest.mark.parametrize(("form", "solver"), WAYS)
def test_time_satisfies_keplers_equation(form: str, solver: str) -> None:
    run = stepper(form, solver).integrate(*START, h=0.1, steps=300)
    assert run.t[-1] > 10.0
    assert np.abs(kepler_time(run.q) - run.t).max() < 5e-13
    assert np.ptp(run.energy()) < 1e-13
    assert run.tau is not None
    assert np.array_equal(run.tau, 0.1 * np.arange(301)) or np.abs(run.tau - 0.1 * np.arange(301)).max() < 1e-14


@pytest.mark.second
def test_energy_is_that_of_the_initial_state() -> None:
    own = sc.compile_stepper(KEPLER, sc.SVI(4))
    made = stepper()
    assert made.energy(*START, parameters={"mu": 1.25}) == pytest.approx(own.energy(*START, parameters={"mu": 1.25}))
    run = made.start(*START, h=0.1, parameters={"mu": 1.25})
    assert run.parameters[1] == pytest.approx(own.energy(*START, parameters={"mu": 1.25}), rel=1e-14)
    assert made.start(*START, h=0.1, parameters={"E": -0.25}).parameters[1] == -0.25
    assert made.start(*START, h=0.1, parameters=[1.0, -0.25]).parameters[1] == -0.25
    assert made.step(*START, 0.1)[0] == pytest.approx(made.step(*START, 0.1, parameters={"E": -0.5})[0], rel=1e-14)


@pytest.mark.tiers(1, 1)
@pytest.mark.parametrize("form", FORMS)
def test_runs_end_at_a_physical_time(form: str) -> None:
    run = stepper(form).integrate(*START, h=0.1, t_end=9.0)
    assert run.t[-1] == 9.0
    assert run.tau is not None
    assert 0.0 < run.step_sizes[-2] < 0.1
    assert run.tau[-1] - run.tau[-2] == pytest.approx(run.step_sizes[-2])
    assert np.abs(kepler_time(run.q) - run.t).max() < 5e-13
    back = stepper(form).integrate(run.q[-1], run.p[-1], h=-0.1, t=9.0, t_end=0.0)
    assert back.t[-1] == 0.0
    assert np.abs(back.q[-1] - START[0]).max() < 1e-11
    assert len(stepper(form).integrate(*START, h=0.1, t_end=0.0)) == 2


@pytest.mark.rotated
@pytest.mark.sampled(1)
@pytest.mark.parametrize("form", FORMS)
def test_events_are_located_in_physical_time(form: str) -> None:
    run = stepper(form).integrate(*START, h=0.1, t_end=10.0, events=["y", "t - 4", "x_dot"])
    apsides, clock, turns = run.events
    assert np.abs(apsides.t / np.pi - [1.0, 2.0, 3.0]).max() < 5e-13
    assert clock.t == pytest.approx([4.0], abs=1e-14)
    assert np.abs(turns.t - apsides.t).max() < 1e-12
    assert np.abs(run.crossings("y")[0].t - apsides.t).max() < 1e-14
    ended = stepper(form).integrate(*START, h=0.1, t_end=10.0, events=sc.Event("y", terminal=2))
    assert ended.t[-1] == pytest.approx(2 * np.pi, abs=1e-12)
    assert ended.tau is not None
    assert 0.0 < ended.tau[-1] - ended.tau[-2] < 0.1


@pytest.mark.rotated
def test_levi_civita_follows_an_ellipse_that_is_almost_a_line() -> None:
    """Through e = 1 - 1e-8: the oscillator is solved to round-off, and the time with it."""
    plane = sc.change_coordinates(
        sc.reparametrise(KEPLER, "sqrt(x**2 + y**2)"), {"x": "u**2 - w**2", "y": "2*u*w"}, coordinates=["u", "w"]
    )
    made = sc.compile_stepper(plane, sc.SVI(8))
    e = 1.0 - 1e-8
    q, p = [np.sqrt(1.0 + e), 0.0], [0.0, 2.0 * np.sqrt(1.0 - e)]
    run = made.integrate(q, p, h=0.25, t_end=4 * np.pi)
    assert np.abs(run.q[-1] - q).max() < 1e-12
    assert run.parameters[-1] == pytest.approx(-0.5, rel=1e-13)


@pytest.mark.rotated
def test_nonpositive_time_transformation_is_rejected() -> None:
    oscillator = sc.LagrangianSystem.from_text(name="oscillator", coordinates=["q"], lagrangian="q_dot**2/2 - q**2/2")
    made = sc.compile_stepper(sc.reparametrise(oscillator, "q"), sc.SVI(4))
    with pytest.raises(sc.StateError, match="must be positive at every state"):
        made.integrate([-1.0], [0.0], h=0.1, steps=3)
    with pytest.raises(sc.StepFailedError, match="infinite or NaN"):
        made.step([-1.0], [0.0], 0.1, parameters={"E": 0.5})


@pytest.mark.parametrize("h", [0.05, 0.4, -0.4])
def test_partial_step_ends_at_the_requested_time(h: float) -> None:
    """Along an orbit on which the rate changes a hundredfold: the step of that part, taken alone, ends there."""
    made = stepper("L", "newton")
    run = made.integrate(*START, h=h, steps=40)
    values = made._parameters_at(*map(np.asarray, START))
    for k in range(0, 40, 3):
        for share in (1e-12, 0.02, 0.5, 0.98, 1.0):
            end = run.t[k] + share * (run.t[k + 1] - run.t[k])
            q, p, part = part_of_step(run, run.t[k], h, end, run.q[k], run.p[k])
            assert 0.0 < part <= 1.0
            short = made.integrate(run.q[k], run.p[k], h=part * h, steps=1, t=run.t[k], parameters=values)
            assert abs(short.t[1] - end) <= 6 * 2.0**-52 * max(abs(end), abs(run.t[k]), abs(end - run.t[k]))
            assert np.array_equal(short.q[1], q)
            assert np.array_equal(short.p[1], p)
