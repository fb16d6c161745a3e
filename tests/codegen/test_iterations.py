"""Iteration counts of runs compared with recorded counts: an increase indicates an error.

Steps are the same whatever leads to them: kept factors that never serve, guesses from the wrong steps, iterations that
stop a little later than they may. The numbers are the same with and without optimisation; a few more or less are
rounding. Where a change makes them smaller, the new ones belong here.
"""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from certified_cases import case
from notation import lagrange
from samples import QUICK_FLAGS, ensemble_runs

from scvi_codegen import Stepper, compile_stepper, problem
from scvi_codegen.runs.ensembles.lanes import LaneRuns

STEPS = 100
ROUNDING = 0.02
EXPECTED = {
    ("kepler/svi-3", "fixed-point"): {1: 206, 8: 201, 64: 103},
    ("cart/svi", "fixed-point"): {1: 457, 8: 299, 64: 202},
    ("field/gauss", "fixed-point"): {1: 980, 8: 451, 64: 303},
    ("tangle/scvi", "fixed-point"): {1: 1090, 8: 563, 64: 401},
    ("tangle/sc", "fixed-point"): {1: 969, 8: 430, 64: 203},
    ("cart/svi", "newton"): {1: 501, 8: 302, 64: 201},
    ("tangle/scvi", "newton"): {1: 427, 8: 269, 64: 201},
    ("double/svi", "newton"): {8: 369, 64: 201},
    ("chain/svi-4", "newton"): {16: 301, 64: 201},
}
"""Of so many steps of the case's h, of an eighth of it, and so on."""


@cache
def stepper(name: str, solver: str) -> Stepper:
    return compile_stepper(case(name).system, case(name).method(), solver=solver, flags=QUICK_FLAGS)


@pytest.mark.rotated
@pytest.mark.sampled(5)
@pytest.mark.parametrize(("name", "solver"), EXPECTED)
def test_iteration_counts_are_those_recorded(name, solver):
    given, expected = case(name), EXPECTED[name, solver]
    counts = [
        int(stepper(name, solver).integrate(given.q, given.p, h=given.h / part, steps=STEPS).iterations.sum())
        for part in expected
    ]
    assert counts == pytest.approx([*expected.values()], rel=ROUNDING, abs=2)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("name", ["kepler/svi-3", "cart/svi", "field/gauss"])
def test_lanes_use_as_many_iterations_as_single_runs(name):
    """Lanes start from equal states; predictors from one and two steps are equally good in a block."""
    given, own = case(name), stepper(name, "fixed-point")
    for part in (1, 8, 64):
        h = given.h / part
        batch = ensemble_runs(own, [given.q] * 8, [given.p] * 8, h=h, steps=STEPS).batch()
        assert isinstance(batch, LaneRuns)
        block = batch.part(0, batch.width)
        block.advance()
        run = own.integrate(given.q, given.p, h=h, steps=STEPS)
        assert block.memory.iterations == pytest.approx(int(run.iterations.sum()), rel=ROUNDING, abs=2)


@pytest.mark.parametrize("span", [10.0, 1e6])
@pytest.mark.parametrize("p", [[0.3, 1.0], [0.0, 0.0]])
def test_first_step_takes_few_trials(p, span):
    """The search from 1e-16 of the span in factors of 16 needs 20 iterations or more; half the largest step."""
    run = stepper("kepler/svi-8", "fixed-point").start([0.5, 0.1], p, t_end=span, tolerance=1e-9)
    run.advance(1)
    largest = 2.0**-1.5 if p[1] else 2.0**-2.25
    assert largest / 2 < run.t <= largest * (1 + 1e-9)
    assert run.iterations <= 17


def test_search_for_the_first_step_on_constraints_takes_few_iterations():
    """A pilot only has to say whether its iteration contracts: two rods at rest within rounding, or moving."""
    distances = ["x**2 + y**2 - 1", "(u - x)**2 + (v - y)**2 - 1"]
    kinetic = "(m*(x_dot**2 + y_dot**2) + u_dot**2 + v_dot**2)/2 - 9.81*(m*y + v)"
    rods = compile_stepper(lagrange("rods", "x y u v", kinetic, constraints=distances, m=1.0), "svi:8")
    generator = np.random.default_rng(7)
    for k in range(30):
        (a, b), rates = generator.uniform(-1.5, 1.5, 2), generator.normal(size=2) * (0.0, 1e-13, 1e-8, 1.0)[k % 4]
        first = np.array([np.sin(a), -np.cos(a)]), rates[0] * np.array([np.cos(a), np.sin(a)])
        second = np.array([np.sin(b), -np.cos(b)]), rates[1] * np.array([np.cos(b), np.sin(b)])
        q, velocity = (np.concatenate([x, x + y]) for x, y in zip(first, second, strict=True))
        plan = {"t_end": (1.0, 20.0)[k % 2], "tolerance": (1e-3, 1e-8, None)[k % 3]}
        run = rods.start(q, velocity=velocity, parameters={"m": (1.0, 1e-4)[k % 5 == 0]}, **plan)
        run.advance(1)
        assert run.steps == 1
        assert run.iterations <= 60


@pytest.mark.second
def test_newton_factors_are_reused_in_the_next_short_step():
    given = case("chain/svi-4")
    run = stepper("chain/svi-4", "newton").start(given.q, given.p, h=given.h / 64)
    run.advance(3)
    assert run._memory.guess == 2


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(("name", "expected"), [("double/svi", (78, 171)), ("tangle/scvi", (37, 95))])
def test_adaptive_steps_use_the_predictor_of_the_preceding_step(name, expected):
    """Compare Newton steps and iteration counts with steps of equal size."""
    given = case(name)
    run = stepper(name, "newton").integrate(given.q, given.p, t_end=10 * given.h, tolerance=1e-6)
    assert (len(run.t), int(run.iterations.sum())) == pytest.approx(expected, rel=ROUNDING, abs=2)


@pytest.mark.rotated
def test_reused_factors_need_two_updates_at_convergence():
    """Factors of another point must reduce an update once before a small update indicates convergence."""
    own = problem("fput-chain").system
    rest = [0.0] * own.dimension
    run = compile_stepper(own, "svi:4", solver="newton", flags=QUICK_FLAGS).integrate(rest, rest, h=0.01, steps=5)
    assert run.iterations[1:].tolist() == [1, 2, 2, 2, 2]
