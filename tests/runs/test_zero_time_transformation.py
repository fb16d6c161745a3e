"""Time transformations that come to 0: refused in bounded work, and never gone round."""

from dataclasses import replace

import numpy as np
import pytest

import scvi_codegen as sc
from scvi_codegen.runs.driver.singular_time import check_energy_surface

OSCILLATOR = sc.LagrangianSystem.from_text(name="oscillator", coordinates=["x"], lagrangian="x_dot**2/2 - x**2/2")
KEPLER = sc.problem("kepler").system
NEAR = [1.99999, 0.0], [0.0, (1e-5 / 1.99999) ** 0.5]


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("time_transformation", ["x", "x**2"])
def test_run_stops_where_the_time_transformation_is_zero(time_transformation):
    stretched = sc.compile_stepper(sc.reparametrise(OSCILLATOR, time_transformation), sc.SVI(4))
    with pytest.raises(sc.StepFailedError, match="reaches 0") as failure:
        stretched.integrate([1.0], [0.0], h=0.1, t_end=4.0)
    assert failure.value.status == "time transformation singular"
    assert failure.value.t == pytest.approx(1.5708, abs=1e-3)
    assert 100 < len(failure.value.trajectory) < 10**6


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("events", [None, ["x - 2"]], ids=["alone", "with events"])
def test_reversible_controller_stops_where_the_time_transformation_is_zero(events):
    controlled = sc.compile_stepper(OSCILLATOR, sc.SVI(4), time_transformation="x**2", events=events)
    with pytest.raises(sc.StepFailedError, match="reaches 0") as failure:
        controlled.integrate([1.0], [0.0], h=0.1, t_end=4.0)
    assert failure.value.status == "time transformation singular"


@pytest.mark.tiers(1, 1)
@pytest.mark.parametrize("time_transformation", ["frequency", "q1**2 + q2**2"])
def test_close_encounters_do_not_stop_a_run(time_transformation):
    stretched = sc.compile_stepper(sc.reparametrise(KEPLER, time_transformation), sc.SVI(8))
    run = stretched.integrate(*NEAR, h=0.1, t_end=7.0)
    assert run.t[-1] == 7.0


@pytest.mark.rotated
def test_energy_is_checked_after_a_single_short_step():
    stretched = sc.compile_stepper(sc.reparametrise(KEPLER, "q1**2 + q2**2"), sc.SVI(2))
    run = stretched.integrate([1.0, 0.0], [0.0, 1.0], h=0.1, steps=5)
    t, p = run.t.copy(), run.p.copy()
    t[3] = np.nextafter(t[2], 9.0)
    check_energy_surface(replace(run, t=t), 0.1)
    p[2] *= 2.0
    with pytest.raises(sc.StepFailedError, match=r"step 2 at .* reaches 0"):
        check_energy_surface(replace(run, t=t, p=p), 0.1)
