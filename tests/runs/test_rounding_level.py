"""Fixed-point iterations with complex contraction factors end at the rounding level, neither before nor long after it.

The iteration of a rotation contracts with complex factors, so that changes may rise once above rounding. A criterion
that takes the first rise below 3e-13 of the state for rounding leaves errors of 1e-14 in these steps.
"""

import numpy as np
import pytest
from samples import QUICK_FLAGS

import scvi_codegen as sc

OMEGA, ATTITUDE = [2.0, 0.0, 1.5], {"euler": "xyz", "angles": [0.5, 0.2, 0.1]}
FAST = [0.1, 0.0, 50.0]


def top(moments, weight):
    energy = " + ".join(f"{moment}*omega_{k}**2/2" for k, moment in enumerate(moments, 1))
    return sc.LagrangianSystem.from_text("top", rotations={"R": "omega"}, lagrangian=f"{energy} - {weight}*R_33")


CASES = {
    "free asymmetric top, large steps": (top((1, 2, 3), 0), "svi:8", 1.0, OMEGA),
    "fast symmetric top": (top((1, 1, 0.5), 1), "svi:8", 0.03, FAST),
    "heavy top, very large steps": (top((1, 2, 3), 1), "svi:6", 0.8, OMEGA),
}
MOST_AFTER_ROUNDING = 5.0
"""Iterations from changes of 1e-14 to the end: three to the unit roundoff, and two in which changes stop decreasing."""


@pytest.mark.rotated
@pytest.mark.sampled(1)
@pytest.mark.filterwarnings("ignore::scvi_codegen.AccuracyWarning")
@pytest.mark.parametrize("name", CASES)
def test_steps_are_those_of_newtons_method_without_iterations_at_the_rounding_level(name):
    system, method, h, omega = CASES[name]
    stepper, newton = (
        sc.compile_stepper(system, method, solver=each, flags=QUICK_FLAGS) for each in ("auto", "newton")
    )
    start = {"q": {"R": ATTITUDE}, "velocity": {"omega": omega}, "h": h, "steps": 12_000}
    run = stepper.integrate(**start)
    differences = []
    for k in range(0, 12_000, 8):
        q, p = newton.step(run.q[k], run.p[k], h=h)[:2]
        differences.append(max(np.abs(q - run.q[k + 1]).max(), np.abs(p - run.p[k + 1]).max() / np.abs(p).max()))
    assert max(differences) < 2.5e-15
    loose = stepper.integrate(**start | {"steps": 1000}, options=sc.SolverOptions(tolerance=1e-14))
    assert run.iterations[1:1001].mean() - loose.iterations[1:].mean() < MOST_AFTER_ROUNDING
