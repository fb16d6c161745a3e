"""Rigid bodies of the benchmark: Euler's equations by hand, this project and MuJoCo compute the same motion."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.cases.references import reference, rms_error
from benchmarks.cases.rotations import ROTATIONS, tumbling
from benchmarks.contenders.engines import mujoco_contenders
from benchmarks.contenders.ours import momenta_of
from scvi_codegen.runs.compiler import compile_stepper

pytestmark = pytest.mark.skipif(np.finfo(np.longdouble).eps > 1e-18, reason="long double is no wider than double")


@pytest.mark.rotated
@pytest.mark.parametrize("name", ROTATIONS)
def test_the_compiled_lagrangian_obeys_the_equations_derived_by_hand(name):
    chosen = replace(ROTATIONS[name](), span=5.0)
    stepper = compile_stepper(chosen.system, "svi:8")
    momenta, exact = momenta_of(stepper, chosen), reference(chosen)
    ends = [stepper.integrate(q, p, h=0.05, steps=100).q[-1] for q, p in zip(chosen.q, momenta, strict=True)]
    assert exact.accuracy < 1e-17
    assert rms_error(np.array(ends), exact) < 2e-14
    assert rms_error(chosen.q, exact) > 0.1


def test_bodies_tumble_in_mujoco_as_in_the_equations():
    pytest.importorskip("mujoco", reason="extra bench")
    chosen = replace(tumbling(3), span=1.0)
    contender = next(each for each in mujoco_contenders(chosen, quick=False) if float(each.setting[2:]) <= 0.01)
    assert contender.trajectories == 3
    assert rms_error(contender.prepare(0)()(), reference(chosen)) < 1e-4
