"""Work and impulses of forces compared with energy and momentum maps, by curves and by quadrature."""

import numpy as np
import pytest
from notation import lagrange

import scvi_codegen as sc

pytestmark = pytest.mark.second

DRAG = {"x": "-c*x_dot*sqrt(x_dot**2 + y_dot**2) + w*cos(3*t)", "y": "-c*y_dot*sqrt(x_dot**2 + y_dot**2)"}


@pytest.fixture(scope="module")
def thrown():
    """A body in the plane about a centre, with drag by the square of its speed and a push that is periodic."""
    return lagrange("thrown", "x y", "(x_dot**2 + y_dot**2)/2 + k/sqrt(x**2 + y**2)", k=1.0, c=0.05, w=0.1, forces=DRAG)


def test_work_balance_with_dense_output_and_adaptive_steps(thrown):
    stepper = sc.compile_stepper(thrown, sc.SVI(4))
    start = ([1.0, 0.0], [0.0, 1.1])
    save_every, some = (stepper.integrate(*start, h=0.05, steps=40, save_every=n) for n in (1, 8))
    assert np.abs(some.work() - save_every.work()[::8]).max() < 1e-13
    later = [
        stepper.integrate(*start, h=0.1, steps=140, save_every=n, t=1e6) for n in (1, 7)
    ]  # where times are rounded
    assert np.abs(later[1].work() - later[0].work()[::7]).max() < 1e-8  # of forces of time
    free = stepper.integrate(*start, t_end=2.0)
    assert np.abs(free.energy() - free.energy()[0] - free.work()).max() < 1e-12
    with pytest.raises(sc.StateError, match="save_every=1"):
        stepper.integrate(*start, t_end=2.0, t_eval=[0.3, 1.1]).work()


@pytest.mark.rotated
@pytest.mark.parametrize("plan", [{"h": 0.05}, {}])
def test_work_balance_with_impacts(thrown, plan):
    """Steps end in the states before impacts, which conserve the energy."""
    run = sc.compile_stepper(thrown, sc.SVI(6)).integrate(
        [1.0, 0.0], [0.0, 1.1], t_end=6.0, events=sc.impact("x + 1/5"), **plan
    )
    assert len(run.events[0]) > 1
    assert np.abs(run.energy() - run.energy()[0] - run.work()).max() < 1e-9
    with pytest.raises(sc.StateError, match="states after changes by events"):
        run.stepper.integrate([1.0, 0.0], [0.0, 1.1], h=0.05, t_end=6.0, save_every=7).work()


def test_unsupported_systems_have_no_work_balance(thrown):
    stepper = sc.compile_stepper(thrown, sc.RadauIIA(2))
    with pytest.raises(sc.MethodError, match="SVI, SCVI"):
        stepper.integrate([1.0, 0.0], [0.0, 1.1], h=0.1, steps=2).impulses()


def test_missing_newton_iteration_is_an_error_message(thrown):
    stepper = sc.compile_stepper(thrown, sc.SVI(3), solver="fixed-point")
    run = stepper.integrate([1.0, 0.0], [0.0, 1.1], h=0.1, steps=2)
    with pytest.raises(sc.MethodError, match="requires Newton's method"):
        run.work()


def test_work_is_computed_to_the_tolerance_of_the_solver():
    damped = sc.LagrangianSystem.from_text("damped", ["q"], "q_dot**2/2 + cos(q)", forces={"q": "-q_dot**3"})
    stepper = sc.compile_stepper(damped, "svi:3")
    exact, rough = (
        np.concatenate(list(map(np.atleast_1d, stepper.work_and_impulses([1.0], [1.5], 0.3, options=options))))
        for options in (None, sc.SolverOptions(tolerance=0.1))
    )
    assert 1e-13 < np.abs(exact - rough).max() < 0.1
