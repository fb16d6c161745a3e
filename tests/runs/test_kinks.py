"""Runs across kinks against DOP853 restarted at each of them: eight families of random cases.

Default and given tolerances, output times and dense output, orders of fixed steps, and ``error=``
(``tools/kinks.py``, which prints a table of all); bits of restored runs and of ensembles; derivatives.
"""

from functools import cache
from itertools import count

import numpy as np
import pytest
from kinks import KINDS, METHODS, stepper_of, wrong
from nonsmooth import FAMILIES, Case, case_of

pytestmark = pytest.mark.filterwarnings("ignore::scvi_codegen.common.errors.AccuracyWarning")
SMALLEST_FIRST = sorted(FAMILIES, key=lambda family: len(FAMILIES[family].coordinates))
families = pytest.mark.parametrize("family", SMALLEST_FIRST)


@cache
def differentiable(family: str) -> Case:
    """Return the first case with kinks that does not start at one, where a derivative has two values."""
    for number in count(1):
        case = case_of(family, number)
        start = case.motion.switching(0.0, case.motion.q, case.motion.v)
        if case.kinks and np.abs(start).min() > 0.01:
            return case
    raise AssertionError


def without_end(case: Case) -> dict:
    return {name: value for name, value in case.arguments.items() if name != "t_end"}


@pytest.mark.tiers(5, 8)
@families
def test_motions_across_kinks_are_within_tolerances(family):
    assert not wrong(family, [1], ["svi:4"], [kind for kind in KINDS if kind != "order"])


@pytest.mark.second
@families
def test_orders_across_kinks(family):
    """SVI(1), SVI(2) and SVI(4) have orders 2, 4 and 8."""
    assert not wrong(family, [1], METHODS, ["order"])


@pytest.mark.second
@families
def test_methods_of_other_orders_are_within_tolerances(family):
    kinds = "round-off", "tolerance", "error="
    assert not [*wrong(family, [2], ["svi:2"], kinds), *wrong(family, [4], ["svi:8"], kinds)]


@pytest.mark.full
@pytest.mark.parametrize("method", METHODS)
@families
def test_two_thousand_cases_across_kinks(family, method):
    first = 84 * [*METHODS].index(method)
    assert not wrong(family, range(first, first + 84), [method])


@pytest.mark.tiers(3, 8)
@families
def test_restored_runs_have_the_same_bits_at_kinks(family):
    """After each of the first steps, some of which end at kinks."""
    stepper, case = stepper_of(family, "svi:4"), differentiable(family)
    span = case.arguments["t_end"] - case.arguments["t"]
    for plan, again in (({"t_end": case.arguments["t_end"]},) * 2, ({"h": span / 40}, {})):
        run, ends = stepper.start(**without_end(case), **plan), []
        checkpoints = []
        for _ in range(40):
            checkpoints.append(run.checkpoint())
            run.advance(1)
        for saved, steps in zip(checkpoints, range(40, 0, -1), strict=True):
            restored = stepper.from_checkpoint(saved, **again)
            restored.advance(steps)
            ends.append((restored.t, *restored.q, *restored.p))
        assert {*ends} == {(run.t, *run.q, *run.p)}


@pytest.mark.tiers(3, 8)
@families
@pytest.mark.parametrize("plan", [{}, {"tolerance": 1e-6}, {"h": 0.01}], ids=["round-off", "tolerance", "fixed"])
def test_trajectories_of_ensembles_have_the_bits_of_runs(family, plan):
    stepper, case = stepper_of(family, "svi:4"), differentiable(family)
    arguments = dict(case.arguments)
    plan = plan | ({"h": 0.01 * (arguments["t_end"] - arguments["t"])} if "h" in plan else {})
    q = arguments.pop("q") + np.array([0.0, 0.01, -0.02])[:, None] * case.ranges.max()
    p = arguments.pop("p") * np.array([1.0, 0.9, 1.1])[:, None]
    together = stepper.integrate_ensemble(q, p, **arguments, **plan)
    for j in range(3):
        run = stepper.integrate(q[j], p[j], **arguments, **plan)
        assert np.array_equal(together.ends[1][j], run.q[-1])
        assert np.array_equal(together.ends[2][j], run.p[-1])


@pytest.mark.tiers(1, 8)
@families
def test_derivatives_across_kinks_are_those_of_the_motion(family):
    """With respect to the initial state, to differences of the reference; to parameters, to differences of runs."""
    stepper, case = stepper_of(family, "svi:4"), differentiable(family)
    motion, m, run = case.motion, len(case.motion.q), stepper.integrate(**case.arguments)
    found, times = run.sensitivity(), np.array([0.0, motion.span])
    for k, unit in enumerate(np.eye(2 * m)):
        before, after = (motion.states(times, change * unit)[0][-1] for change in (-1e-6, 1e-6))
        exact = (after - before) / 2e-6
        assert np.abs(found.state[-1][:, k] / case.units * case.units[k] - exact).max() < 1e-6 * max(1.0, case.growth)
    parameters = case.arguments["parameters"]
    for name in {*parameters} - {"m", "o", "t0"}:
        step, change = 1e-6 * parameters[name], found.parameters[-1][:m, stepper.interface.parameters.index(name)]
        before, after = (
            stepper.integrate(**case.arguments | {"parameters": parameters | {name: value}}).q[-1]
            for value in (parameters[name] - step, parameters[name] + step)
        )
        assert np.abs(change * step - (after - before) / 2).max() < 1e-11 * max(1.0, case.growth) * case.ranges.max()
