"""The C entry points of flows, called as frameworks call them, without these: failures, second derivatives, wrappers.

States and first derivatives of rows are properties of the table of motions (``tests/motions``).
The system depends on time, t and the parameters differ from their defaults, and the steps fill several pieces.
"""

from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pumped_leapfrog import EVERY, ROWS, STEP_INPUTS, STEPS, hessian, stepper, weights

from scvi_codegen.extras.frameworks.flow import FlowOfRows

EVERY_STEP, NOT_FINITE_STATUS = 1, 3
SAVED, SIZE = STEPS // EVERY + 1, len(STEP_INPUTS)
compiled = cache(stepper)


@cache
def flow():
    return FlowOfRows.checked(compiled(), STEPS, EVERY)


OVERFLOWS = np.array([[1e300, 0.0, 1e300, 0.0, 1.0, -30.0, 0.0, 1.0, 0.5, 0.4]])
"""A state that grows by a factor in each step, until it is infinite."""


def first_failure():
    """The number of steps whose ends are finite, by a leapfrog of :data:`OVERFLOWS`."""
    (q, _, p, _, m, k, *_, h), n = OVERFLOWS[0], 0
    with np.errstate(over="ignore", invalid="ignore"):
        while True:
            p = p - h / 2 * (k * q)
            q = q + h * p / m
            p = p - h / 2 * (k * q)
            if not np.isfinite([q, p]).all():
                return n
            n += 1


@pytest.mark.parametrize("part", [0, 1, 2])
def test_failed_steps_are_reported_with_their_number_and_time(part):
    """The states fail after a saved one; derivatives as the states do."""
    failing, library = first_failure(), flow().library
    assert EVERY_STEP < failing < STEPS
    found = np.zeros((1, SIZE, STEPS + 1, SIZE))
    given = np.ones((1, SIZE, STEPS + 1, 4))
    report, pointers = library.new("report *"), [library.pointer(each) for each in (OVERFLOWS, given, found)]
    assert library.function("flow_rows")(part, STEPS, EVERY_STEP, 1, 1, *pointers, report) == NOT_FINITE_STATUS
    assert report.steps == failing
    assert report.t == pytest.approx(OVERFLOWS[0, 8] + failing * OVERFLOWS[0, 9])


@pytest.mark.rotated
def test_second_derivatives_of_batches():
    same, changes = np.tile(weights(), (2, SIZE, 1, 1)), np.tile(np.eye(SIZE), (2, 1, 1))
    found, library = np.zeros((2, SIZE, SIZE)), flow().second_library
    pointers = [library.pointer(array) for array in (ROWS, same, changes, found)]
    assert library.function("hessian_rows")(STEPS, EVERY, SIZE, 2, *pointers, library.new("report *")) == 0
    exact = np.array([hessian(row) for row in ROWS])
    assert_allclose(found, exact, rtol=0, atol=1e-7 * abs(exact).max())
