"""Derivatives of steps by all they start from, by differences in 60 digits; and their transpose."""

from functools import cache

import numpy as np
import pytest
from certified_cases import case as certified
from samples import QUICK_FLAGS

from scvi_codegen import SVI, LagrangianSystem, SolverOptions, StepFailedError, compile_stepper
from scvi_codegen.exact.motion import ExactMotion
from scvi_codegen.exact.step import DerivedStep
from scvi_codegen.methods.discretise import paper_equations
from scvi_codegen.tables.precision import mp

NAMES = """
    driven/svi double/svi kepler/svi-3 cart/svi pendulum/hermite pendulum/splines pendulum/trigonometric vortices/svi
    double/scvi kepler/printed double/sc kepler/sc-phase-space double/gauss linkage/lobatto-svi wire/lobatto-svi
    double/gauss-position kepler/radau-iia double/radau-ia driven/chebyshev kepler/composition driven/euler cart/verlet
""".split()
T = 0.3
EXACT = 1e-13


@cache
def given(name):
    """A stepper, a state, and a step."""
    case = certified(name)
    stepper = compile_stepper(case.system, case.method(), flags=QUICK_FLAGS)
    q, p = stepper.project(case.q, case.p, t=T) if case.system.constraints else (case.q, case.p)
    return case, stepper, np.array(q, dtype=float), np.array(p, dtype=float), case.h


def by_differences(case, q, p, h, t):
    """(2m, 2m + k + 2) of the paper's equations, solved in 60 digits."""
    system, width, m = case.system, mp.mpf(10) ** -15, len(q)
    step = DerivedStep(system, paper_equations(system, case.method()))

    def end(numbers):
        step.motion = ExactMotion(system, numbers[2 * m : -2])
        found = step(numbers[:m], numbers[m : 2 * m], numbers[-1], numbers[-2])
        return np.array([*found.q, *found.p])

    start, columns = [mp.mpf(x) for x in (*q, *p, *system.defaults, t, h)], []
    for k in range(len(start)):
        ends = []
        for sign in (1, -1):
            moved = list(start)
            moved[k] += sign * width
            ends.append(end(moved))
        columns.append(((ends[0] - ends[1]) / (2 * width)).astype(float))
    return np.array(columns).T


@pytest.mark.parametrize("name", NAMES)
def test_derivatives_by_all_that_a_step_starts_from(name):
    case, stepper, q, p, h = given(name)
    found, exact = stepper.sensitivity(q, p, h, T), by_differences(case, q, p, h, T)
    m = len(q)
    for block, own in {
        "state": exact[:, : 2 * m],
        "parameters": exact[:, 2 * m : -2],
        "t": exact[:, -2],
        "h": exact[:, -1],
    }.items():
        own_size = np.abs(own).max(initial=0.0)
        print(name, block, np.abs(getattr(found, block) - own).max(initial=0.0) / max(own_size, 1e-300), own_size)
        assert getattr(found, block).shape == own.shape
        assert np.abs(getattr(found, block) - own).max(initial=0.0) <= EXACT * max(own_size, 1.0)
