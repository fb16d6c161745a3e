"""Recorded runs with adaptive steps are extended and shortened."""

import numpy as np
import pytest
from recorded_runs import STATE

import scvi_codegen as sc

pytestmark = pytest.mark.usefixtures("here")

END, TOLERANCE = 60.0, 1e-10


def controlled(stepper: sc.Stepper, folder: str, t_end: float = END, **settings: object):
    run = stepper.start(**STATE, t_end=t_end, tolerance=TOLERANCE)
    return sc.record_run(run, folder, **{"rows": 64} | settings)


@pytest.mark.parametrize("t_end", [END, -END])
def test_run_may_be_extended_or_shortened_but_not_reversed(kepler, t_end):
    controlled(kepler, "a.run", t_end, save_every=3)
    longer = sc.resume_run("a.run", t_end=1.5 * t_end)
    assert longer.finished
    assert t_end in longer.t
    assert longer.t[-1] == 1.5 * t_end
    assert np.abs(longer.q[-1] - kepler.integrate(**STATE, t_end=1.5 * t_end).q[-1]).max() < 1e-6
    with pytest.raises(sc.StateError, match="beyond"):
        sc.resume_run("a.run", t_end=t_end)
    with pytest.raises(sc.StateError, match="omit steps"):
        sc.resume_run("a.run", steps=1000)
    assert sc.load_run("a.run").manifest == longer.manifest
