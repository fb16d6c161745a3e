"""Step plans: largest and first step sizes and absolute tolerances, in every way in which runs are started."""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpmath import mp
from notation import lagrange
from numpy.testing import assert_allclose

import scvi_codegen as sc
from scvi_codegen.runs.stepping.step_plan import Adaptive, absolute_tolerances

Q, V = [1.0, 0.0], [0.0, 1.0]
LIMITED: dict[str, Any] = {"t_end": 5.0, "tolerance": 1e-3, "max_step": 0.1}
LARGEST = pytest.approx(2.0**-3.5)
"""Largest size of the grid below 0.1."""


@cache
def kepler(method: str = "svi:4", solver: str = "auto") -> sc.Stepper:
    system = sc.LagrangianSystem.from_text("circle", ["x", "y"], "(x_dot**2 + y_dot**2)/2 + 1/sqrt(x**2 + y**2)")
    return sc.compile_stepper(system, method, solver=solver)


@cache
def chain() -> sc.Stepper:
    text = "sum(i in N, u_dot[i]**2/2) - sum(i in N-1, (u[i+1] - u[i])**2/2) - u[0]**2/2"
    return sc.compile_stepper(sc.LagrangianSystem.from_text("chain", ["u[N]"], text), "svi:4")


def longest(t: Any) -> float:
    return float(np.abs(np.diff(t)).max())


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(("method", "solver"), [("svi:4", "auto"), ("gauss:2", "auto"), ("svi:4", "newton")])
def test_no_step_is_longer_than_the_largest(method: str, solver: str) -> None:
    run = kepler(method, solver).integrate(Q, velocity=V, **LIMITED)
    assert longest(run.t) == LARGEST
    assert longest(kepler(method, solver).integrate(Q, velocity=V, **{**LIMITED, "max_step": np.inf}).t) > 0.2
    back = kepler(method, solver).integrate(Q, velocity=V, **{**LIMITED, "t_end": -5.0})
    assert longest(back.t) == LARGEST


@pytest.mark.second
def test_largest_step_of_arrays_ensembles_events_and_continued_runs() -> None:
    q, v = np.linspace(0.5, 1.0, 6), np.zeros(6)
    assert longest(chain().integrate({"u": q}, velocity={"u": v}, **LIMITED).t) == LARGEST
    runs = kepler().integrate_ensemble([Q, [1.1, 0.0]], velocity=[V, V], **LIMITED)
    assert np.nanmax(np.diff(runs.times, axis=0)) == LARGEST
    turned = kepler().with_events([sc.Event("x", then={"x": "x"})]).integrate(Q, velocity=V, **LIMITED)
    assert longest(turned.t) == LARGEST
    run = kepler().start(Q, velocity=V, **LIMITED | {"max_step": np.inf})
    assert longest(run.record(2).t) > 0.2
    run.plan = Adaptive(5.0, 1e-3, max_step=0.05)  # smaller than the present step
    assert longest(run.record().t) < 0.05


def test_first_step_is_the_one_requested() -> None:
    run = kepler().integrate(Q, velocity=V, t_end=5.0, tolerance=1e-6, first_step=0.01)
    assert 0.01 / 2**0.25 < run.step_sizes[0] <= 0.01
    assert run.step_sizes[1] > run.step_sizes[0]
    far = kepler().integrate(Q, velocity=V, t_end=5.0, tolerance=1e-6, first_step=4.0)  # reduced: its error is large
    assert far.step_sizes[0] < 2.0
    assert_allclose(far.q[-1], [np.cos(5.0), np.sin(5.0)], atol=1e-5)


@pytest.mark.second
def test_absolute_tolerances_by_name_of_coordinate_array_and_rotation() -> None:
    interface = kepler().interface
    assert absolute_tolerances(interface, 2, 0.5).tolist() == [0.5, 0.5]
    assert absolute_tolerances(interface, 2, (("y", 0.5),)).tolist() == [0.0, 0.5]
    bound = chain().bind({"u": np.zeros(3)}, None)[0]
    assert absolute_tolerances(bound.interface, 3, (("u", 0.25),)).tolist() == [0.25] * 3
    body = lagrange("body", "z", "z_dot**2/2 + (omega_1**2 + 2*omega_2**2 + 3*omega_3**2)/2", rotations={"R": "omega"})
    stepper = sc.compile_stepper(body, "svi:2")
    values = absolute_tolerances(stepper.interface, stepper.dimension, (("R", 0.1), ("z", 0.2)))
    assert values.tolist() == [0.2, *[0.1] * (stepper.dimension - 1)]


@pytest.mark.rotated
@pytest.mark.parametrize(("method", "solver"), [("svi:4", "auto"), ("svi:4", "newton")])
def test_coordinate_that_hardly_moves_does_not_determine_the_steps(method: str, solver: str) -> None:
    text = "(x_dot**2 + y_dot**2 + z_dot**2)/2 + 1/sqrt(x**2 + y**2) - 50*z**2"
    system = sc.LagrangianSystem.from_text("orbit and vibration", ["x", "y", "z"], text)
    stepper = sc.compile_stepper(system, method, solver=solver)
    start: dict[str, Any] = {"q": [1.0, 0.0, 1e-12], "velocity": [0.0, 1.0, 0.0], "t_end": 10.0, "tolerance": 1e-6}
    strict, loose, other = (
        stepper.integrate(**start, absolute_tolerance=absolute).steps for absolute in (None, {"z": 1e-3}, {"x": 1e-3})
    )
    assert 2 * loose < strict
    assert abs(other - strict) < 0.1 * strict


def test_continued_runs_keep_their_options(tmp_path: Path) -> None:
    run = kepler().start(Q, velocity=V, **LIMITED, absolute_tolerance={"y": 1e-6})
    run.advance(5)
    again = kepler().from_checkpoint(run.checkpoint(), t_end=5.0)
    assert again.plan == run.plan
    assert kepler().from_checkpoint(run.checkpoint(), t_end=5.0, max_step=0.2).plan == Adaptive(
        5.0, 1e-3, 0.2, absolute_tolerance=(("y", 1e-6),)
    )
    for each in (run, again):
        each.advance(10**6)
    assert run.q.tolist() == again.q.tolist()
    whole = kepler().start(Q, velocity=V, **LIMITED)
    recorded = sc.record_run(whole, tmp_path / "a.run", stop=lambda: True)
    assert recorded.manifest.plan == whole.plan
    finished = sc.resume_run(tmp_path / "a.run")
    assert longest(finished.t) == LARGEST


def test_arguments_of_scipy() -> None:
    arguments: dict[str, Any] = {"t_span": (0.0, 5.0), "y0": [*Q, *V], "rtol": 1e-3}
    motion = sc.solve_ivp(kepler(), **arguments, atol=1e-6, max_step=0.1, first_step=0.01)
    assert motion.trajectory.plan == Adaptive(5.0, 1e-3, 0.1, 0.01, 1e-6 / 1e-3)
    assert longest(motion.t) == LARGEST
    assert sc.solve_ivp(kepler(), **arguments, max_step=np.inf).trajectory.plan == Adaptive(5.0, 1e-3)


@pytest.mark.rotated
def test_partial_steps_in_double_double_are_shorter_than_a_high_word() -> None:
    oscillator = sc.LagrangianSystem.from_text("oscillator", ["x"], "x_dot**2/2 - x**2/2")
    stepper = sc.compile_stepper(oscillator, "svi:12", precision="double-double")
    fixed: dict[str, Any] = {"velocity": [0.0], "h": 0.1, "steps": 20}
    run = stepper.integrate([1.0], **fixed)
    with mp.workdps(40):
        for t in (0.1 * 3, 0.7, 1.9):  # the ends of steps of a decimal h differ from these in the low word
            assert abs(run.at([t])[0].mp()[0][0] - mp.cos(mp.mpf(t))) < 1e-28
    saved = stepper.integrate([1.0], velocity=[0.0], h=0.1, t_end=2.0, t_eval=np.linspace(0.0, 2.0, 21))
    assert_allclose(np.asarray(saved.q)[:, 0], np.cos(np.linspace(0.0, 2.0, 21)), rtol=0, atol=2e-16)
