"""One-line representations of runs and results: system, method, current state and steps."""

import numpy as np
import pytest
from notation import lagrange
from samples import QUICK_FLAGS

import scvi_codegen as sc

PUSHED = lagrange("pushed", "q", "q_dot**2/2 - q**2/2", forces={"q": "u"}, inputs="u")
FREE = sc.LagrangianSystem.from_text(name="free", coordinates=["q"], lagrangian="q_dot**2/2 - q**4/4")
OF_FREE = "of free, svi-2-gauss-legendre-2"


@pytest.fixture(scope="module")
def stepper():
    return sc.compile_stepper(FREE, "svi:2", flags=QUICK_FLAGS)


@pytest.mark.second
def test_display_of_a_run_and_its_saved_states(stepper):
    run = stepper.start([1.0], [0.0], h=0.5)
    saved = run.record(4)
    assert repr(run) == f"<Run {OF_FREE}; t = 2 after 4 steps of 0.5, solver fixed-point>"
    assert repr(saved) == f"<Trajectory {OF_FREE}; 5 states from t = 0 to 2, 4 steps of 0.5>"
    many = stepper.integrate_ensemble([[1.0], [2.0]], [[0.0], [0.0]], h=0.1, steps=3)
    assert repr(many).startswith("<EnsembleTrajectory of free, svi-2-gauss-legend..; 4 states of each of 2 ")


@pytest.mark.second
def test_display_of_adaptive_steps(stepper):
    run = stepper.start([1.0], [0.0], t_end=2.0)
    run.advance(1)
    assert repr(run).endswith("after 1 steps of adaptive size, t_end = 2, solver fixed-point>")
    saved = stepper.integrate([1.0], [0.0], t_end=2.0)
    assert repr(saved).endswith(f"{len(saved.t)} states from t = 0 to 2, {saved.steps} steps of adaptive size>")


def test_display_of_steps_in_tau():
    moon = lagrange("Kepler", "x y", "(x_dot**2 + y_dot**2)/2 + 1/sqrt(x**2 + y**2)")
    slow = sc.compile_stepper(sc.reparametrise(moon, "distance"), "svi:2", flags=QUICK_FLAGS)
    assert "3 steps of 0.1 in tau" in repr(slow.integrate([1.0, 0.0], [0.0, 1.1], h=0.1, steps=3))
    assert "0 steps of 0.1 in tau, solver" in repr(slow.start([1.0, 0.0], [0.0, 1.1], h=0.1))


@pytest.mark.tiers(1)
@pytest.mark.parametrize(
    ("method", "solver"), [("stoermer-verlet", "explicit"), ("gauss:2", "fixed-point"), ("svi:3", "newton")]
)
def test_display_names_the_solver(method, solver):
    chosen = {"solver": "newton"} if solver == "newton" else {}
    run = sc.compile_stepper(FREE, method, flags=QUICK_FLAGS, **chosen).start([1.0], [0.0], h=0.1)
    assert f"solver {solver}>" in repr(run)


def test_display_names_missing_inputs():
    stepper = sc.compile_stepper(PUSHED, "svi:2", flags=QUICK_FLAGS)
    run = stepper.start([1.0], [0.0], h=0.1)
    assert repr(run).endswith("inputs not set: u>")
    run.set_inputs(u=0.0)
    assert "waits" not in repr(run)
    driven = stepper.integrate([1.0], [0.0], h=0.1, steps=10, inputs={"u": ([0.0, 0.5, 2.0], [0.0, 1.0, 0.0])})
    assert repr(driven).endswith("11 states from t = 0 to 1, 10 steps, breakpoints between: 1>")


@pytest.mark.second
def test_display_of_array_runs():
    chain = lagrange("chain", "q[N]", "sum(i in N, q_dot[i]**2/2 - q[i]**2/2)", forces={"q[0]": "u"}, inputs="u")
    run = sc.compile_stepper(chain, "svi:2").start(np.zeros(5), h=0.1)
    assert repr(run).startswith("<Run of chain, svi-2")
    assert "; t = 0 after 0 steps of 0.1, solver" in repr(run)
    assert repr(run).endswith("inputs not set: u>")
