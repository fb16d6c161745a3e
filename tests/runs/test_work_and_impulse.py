"""Work and impulses of forces compared with energy and momentum maps, by curves and by quadrature."""

import numpy as np
import pytest
from notation import lagrange

import scvi_codegen as sc

pytestmark = pytest.mark.rotated

DRAG = {"x": "-c*x_dot*sqrt(x_dot**2 + y_dot**2) + w*cos(3*t)", "y": "-c*y_dot*sqrt(x_dot**2 + y_dot**2)"}


@pytest.fixture(scope="module")
def thrown():
    """A body in the plane about a centre, with drag by the square of its speed and a push that is periodic."""
    return lagrange("thrown", "x y", "(x_dot**2 + y_dot**2)/2 + k/sqrt(x**2 + y**2)", k=1.0, c=0.05, w=0.1, forces=DRAG)


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


@pytest.mark.second
def test_missing_newton_iteration_is_an_error_message(thrown):
    stepper = sc.compile_stepper(thrown, sc.SVI(3), solver="fixed-point")
    run = stepper.integrate([1.0, 0.0], [0.0, 1.1], h=0.1, steps=2)
    with pytest.raises(sc.MethodError, match="requires Newton's method"):
        run.work()
