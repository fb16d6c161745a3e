"""The adaptive cases of the benchmark: their equations, their references, all modes of this project, the pictures."""

from dataclasses import replace

import numpy as np
import pytest

import benchmarks as bench
from benchmarks.cases import references
from benchmarks.cases.adaptive import ADAPTIVE_CASES, adaptive_case
from benchmarks.cases.references import reference
from benchmarks.contenders.ours import adaptive_contenders

needs_extended = pytest.mark.skipif(np.finfo(np.longdouble).eps > 1e-18, reason="long double is no wider than double")


@pytest.mark.rotated
@pytest.mark.sampled(1)
@needs_extended
@pytest.mark.parametrize("e", [0.0, 0.9, 0.999])
def test_keplers_reference_returns_after_a_period(e):
    chosen = replace(adaptive_case(f"kepler:{e}"), span=2.0 * np.pi)
    found = reference(chosen)
    assert np.abs(found.positions - chosen.q).max() < 1e-14 / (1.0 - e)  # the period of rounded states
    assert found.accuracy < 1e-15


def test_steps_of_a_reference_are_the_shortest_of_its_runs():
    runs = np.array([0.0, 1.0, 1.5, 2.0, 4.0]), np.array([0.0, 0.75, 2.75, 4.0])
    steps = references._shortest(runs)
    assert np.array_equal(steps, [0.75, 1.0, 0.5, 1.75])
    third = references._shortest([np.linspace(0.0, 4.0, 4), np.linspace(0.0, 4.0, 3)])
    assert third.sum() == 4.0


@pytest.mark.rotated
@needs_extended
def test_all_modes_run_and_agree():
    chosen = replace(adaptive_case("kepler:0.5"), span=20.0)
    made = adaptive_contenders(chosen, quick=False)
    assert {each.method.partition(" ")[2] for each in made} == {"adaptive", "adaptive, checked", "fixed"}
    exact = reference(chosen)
    tight = [each for each in made if each.setting == "tol=default"]
    for each in tight:
        assert np.abs(each.prepare(3)() - exact.positions[3]).max() < 1e-12
    assert all(f"adaptive:{name}" in bench.SECTIONS for name in ADAPTIVE_CASES)
