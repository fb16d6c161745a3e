"""Runs without saved states: a number of steps, a target time, inputs with zero-order hold."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import scvi_codegen as sc
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.errors import StateError
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.methods.galerkin import SVI
from scvi_codegen.runtime.core.stepper import Stepper
from scvi_codegen.runtime.run import memory
from scvi_codegen.runtime.run.step_plan import StepPlan

pytestmark = pytest.mark.usefixtures("as_users_compile")

PUSHED = LagrangianSystem.from_text(
    name="pushed pendulum",
    coordinates=["q"],
    lagrangian="q_dot**2/2 + k*cos(q)",
    parameters={"k": 1.0},
    forces={"q": "u"},
    inputs=["u"],
)


@pytest.fixture(scope="module")
def pushed() -> Stepper:
    return compile_stepper(PUSHED, SVI(3))


def standing(run):
    return run.t, run.q.tolist(), run.p.tolist()


@pytest.mark.parametrize("chunk", [1, 7, 1000])
def test_runs_with_and_without_saved_states_are_equal(pushed, monkeypatch, chunk):
    """The result does not depend on the number of calls into C."""
    saved = pushed.integrate([0.3], [0.1], h=0.05, steps=100, parameters={"u_0": 0.2})
    monkeypatch.setattr(memory, "STEPS_PER_CALL", chunk)
    run = pushed.start([0.3], [0.1], h=0.05, parameters={"u_0": 0.2})
    run.advance(100)
    assert run.steps == 100
    assert standing(run) == (saved.t[-1], saved.q[-1].tolist(), saved.p[-1].tolist())


@pytest.mark.parametrize("chunk", [3, 10**5])
def test_run_stops_at_its_target_time(pushed, monkeypatch, chunk):
    plan = {"t_end": 3.0, "tolerance": 1e-9}
    saved = pushed.integrate([0.3], [0.1], parameters={"u_0": 0.2}, **plan)
    monkeypatch.setattr(memory, "STEPS_PER_CALL", chunk)
    for steps in ([10**6], [1] * (saved.steps - 1) + [10, 10]):
        run = pushed.start([0.3], [0.1], parameters={"u_0": 0.2}, **plan)
        for each in steps:
            run.advance(each)
        assert run.arrived
        assert run.steps == saved.steps
        assert standing(run) == (3.0, saved.q[-1].tolist(), saved.p[-1].tolist())


def test_run_with_time_transformation_stops_at_its_target_time():
    kepler = LagrangianSystem.from_text(
        name="Kepler", coordinates=["x", "y"], lagrangian="(x_dot**2 + y_dot**2)/2 + 1/sqrt(x**2 + y**2)"
    )
    stepper = compile_stepper(kepler, SVI(3), time_transformation="frequency")
    saved = stepper.integrate([1.0, 0.0], [0.0, 1.1], t_end=5.0, h=0.1)
    run = stepper.start([1.0, 0.0], [0.0, 1.1], t_end=5.0, h=0.1)
    run.advance(10**6)
    assert standing(run) == (5.0, saved.q[-1].tolist(), saved.p[-1].tolist())


def test_nan_input_leaves_all_inputs_unchanged(pushed):
    run = pushed.start([0.3], [0.1], h=0.05)
    run.set_inputs(u=0.4)
    before = run.parameters
    for wrong in (float("nan"), "1", [0.1]):
        with pytest.raises(StateError, match="the input u"):
            run.set_inputs(u=wrong)
    with pytest.raises(StateError, match="'w' is not an input; the system has u"):
        run.set_inputs(u=0.1, w=0.2)
    assert np.array_equal(run.parameters, before)


def test_target_times_and_parameters_may_be_changed_during_a_run(pushed):
    """The next call uses the arguments that it receives, not those of the previous call."""
    run = pushed.start([0.3], [0.1], t_end=1.0, tolerance=1e-9, parameters={"u_0": 0.2})
    run.advance(10**6)
    run.update(parameters={"k": 2.0, "u_0": -0.1}, plan=StepPlan(t_end=2.0, tolerance=1e-9))
    run.advance(10**6)
    first = pushed.integrate([0.3], [0.1], t_end=1.0, tolerance=1e-12, parameters={"u_0": 0.2})
    then = {"k": 2.0, "u_0": -0.1}
    second = pushed.integrate(first.q[-1], first.p[-1], t=1.0, t_end=2.0, tolerance=1e-12, parameters=then)
    assert run.t == 2.0
    assert run.q == pytest.approx(second.q[-1], abs=1e-8)


def test_runs_of_one_stepper_are_independent(pushed):
    given = np.array(pushed.start([0.3], [0.1], h=0.05, parameters={"u_0": 0.2}).parameters)

    def with_force(force):
        run = pushed.start([0.3], [0.1], h=0.05, parameters=given)
        for k in range(200):
            run.set_inputs(u=force * (-1) ** k)
            run.advance(5)
        return standing(run)

    forces = [0.1 * k for k in range(8)] * 4
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(with_force, forces))
    assert together == [with_force(force) for force in forces]
    assert len({each[1][0] for each in together}) == 8
    assert given[pushed.parameters.index("u_0")] == 0.2


@pytest.mark.parametrize("save_every", [3, 4001, 10**9])
def test_the_end_is_saved_if_whole_steps_reach_it(save_every):
    problem = sc.problem("kepler")
    stepper = sc.compile_stepper(problem.system, "svi:4")
    every = stepper.integrate(problem.q, velocity=problem.velocity, h=0.25, t_end=1000.0)
    few = stepper.integrate(problem.q, velocity=problem.velocity, h=0.25, t_end=1000.0, save_every=save_every)
    assert few.t[-1] == 1000.0
    assert np.array_equal(few.q[-1], every.q[-1])
    assert few.steps == every.steps
