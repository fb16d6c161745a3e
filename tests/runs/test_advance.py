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


@pytest.mark.tiers(0, 1)
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


SPRINGS = {
    "fixed steps": (["x"], "svi:3", {"h": 0.1}),
    "adaptive steps": (["x"], "svi:3", {"t_end": 9.0}),
    "explicit steps": (["x"], "stoermer-verlet", {"h": 0.1}),
    "heat bath": (["x"], "svi:2", {"h": 0.1}),
    "arrays": (["x[N]"], "svi:3", {"h": 0.1}),
    "arrays by adaptive steps": (["x[N]"], "svi:3", {"t_end": 9.0}),
}


@pytest.mark.second
@pytest.mark.parametrize("kind", SPRINGS)
def test_c_stores_states_where_there_are_arrays_for_them(kind):
    """Then every 1 or more steps, else the call is refused and changes nothing; with NULLs `every` is not read."""
    coordinates, method, plan = SPRINGS[kind]
    bath = {"temperature": "0.5", "damping": "0.1"} if kind == "heat bath" else {}
    energy = "x_dot[i]**2/2 - x[i]**4/4" if "arrays" in kind else "x_dot**2/2 - x**4/4"
    lagrangian = f"sum(i in N, {energy})" if "arrays" in kind else energy
    spring = sc.LagrangianSystem.from_text("spring", coordinates, lagrangian, **bath)
    stepper = sc.compile_stepper(spring, method)
    binding, ends = stepper.start([1.0], [0.2], **plan).stepper.binding, {}
    null = binding.null

    def advanced(every, arrays):
        run = stepper.start([1.0], [0.2], **plan)
        memory, report = run._memory, binding.new("report *")
        control = (plan["t_end"], run._call.control) if "t_end" in plan else ()
        function = binding.function("advance_to" if control else "advance")
        before = (run.t, run.q.tobytes(), run.p.tobytes(), run.steps)
        stored = [np.zeros(9), np.zeros(9), np.zeros(9), np.zeros(9, np.int32)]
        pointers = [*map(binding.pointer, stored)] if arrays else [null] * 4
        workspace = null if "arrays" in kind else run._workspace
        given = (run._arguments[0], null, *pointers, report, workspace)
        status = function(memory, *control, 6, every, *given)
        after = (run.t, run.q.tobytes(), run.p.tobytes(), run.steps)
        assert (after == before) == (status != 0)
        return status, after, int(np.count_nonzero(stored[0]))

    for every in (-1, 0, 1, 3):
        ends[every] = advanced(every, arrays=True), advanced(every, arrays=False)
    assert [ends[every][0][0] for every in ends] == [7, 7, 0, 0]
    assert [ends[every][0][2] for every in ends] == [0, 0, 6, 2]
    assert {(status, after) for _, (status, after, _) in ends.values()} == {ends[1][0][:2]}
