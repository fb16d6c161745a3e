"""Runs without saved states: a number of steps, a target time, inputs with zero-order hold."""

import numpy as np
import pytest
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen.runs.stepping.step_plan import Adaptive

pytestmark = [pytest.mark.usefixtures("as_users_compile"), pytest.mark.rotated]

PUSHED = lagrange("pushed pendulum", "q", "q_dot**2/2 + k*cos(q)", k=1.0, forces={"q": "u"}, inputs="u")


@pytest.fixture(scope="module")
def pushed() -> sc.Stepper:
    return sc.compile_stepper(PUSHED, sc.SVI(3))


def test_nan_input_leaves_all_inputs_unchanged(pushed):
    run = pushed.start([0.3], [0.1], h=0.05)
    run.set_inputs(u=0.4)
    before = run.parameters
    for wrong in (float("nan"), "1", [0.1]):
        with pytest.raises(sc.StateError, match="the input u"):
            run.set_inputs(u=wrong)
    with pytest.raises(sc.StateError, match="'w' is not an input; the system has u"):
        run.set_inputs(u=0.1, w=0.2)
    assert np.array_equal(run.parameters, before)


def test_target_times_and_parameters_may_be_changed_during_a_run(pushed):
    """The next call uses the arguments that it receives, not those of the previous call."""
    run = pushed.start([0.3], [0.1], t_end=1.0, tolerance=1e-9, parameters={"u_0": 0.2})
    run.advance(10**6)
    run.update(parameters={"k": 2.0, "u_0": -0.1}, plan=Adaptive(2.0, 1e-9))
    run.advance(10**6)
    first = pushed.integrate([0.3], [0.1], t_end=1.0, tolerance=1e-12, parameters={"u_0": 0.2})
    then = {"k": 2.0, "u_0": -0.1}
    second = pushed.integrate(first.q[-1], first.p[-1], t=1.0, t_end=2.0, tolerance=1e-12, parameters=then)
    assert run.t == 2.0
    assert run.q == pytest.approx(second.q[-1], abs=1e-8)


@pytest.mark.second
@pytest.mark.parametrize("save_every", [3, 4001, 10**9])
def test_the_end_is_saved_if_whole_steps_reach_it(save_every):
    problem = sc.problem("kepler")
    stepper = sc.compile_stepper(problem.system, "svi:4")
    every = stepper.integrate(problem.q, velocity=problem.velocity, h=0.25, t_end=1000.0)
    few = stepper.integrate(problem.q, velocity=problem.velocity, h=0.25, t_end=1000.0, save_every=save_every)
    assert few.t[-1] == 1000.0
    assert np.array_equal(few.q[-1], every.q[-1])
    assert few.steps == every.steps
