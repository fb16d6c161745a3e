"""Ensembles equal single trajectories, trajectories leave each other alone, and a run can be stopped."""

from __future__ import annotations

import gc
import pickle
import re
import signal
import threading
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from samples import sample_named, stepper_for

from scvi_codegen.benchmark.cases.robots import chain
from scvi_codegen.cli import main
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.errors import ModelFileError, StateError, StepFailedError
from scvi_codegen.methods import SCVI, SVI, Gauss, Method, RadauIIA, StoermerVerlet
from scvi_codegen.models.model import Model
from scvi_codegen.models.model_files.ensemble_file import load_ensemble
from scvi_codegen.models.problems import problem
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.runtime.core.stepper import Stepper
from scvi_codegen.runtime.ensemble.ensemble import Ensemble
from scvi_codegen.runtime.ensemble.lanes import LaneBlock
from scvi_codegen.runtime.ensemble.result import EnsembleTrajectory

pytestmark = pytest.mark.usefixtures("as_users_compile")

KINDS = {
    "separable": "kepler",
    "coupled": "double-pendulum",
    "time-dependent": "driven-duffing",
    "coupled and time-dependent": "pumped-cart-pole",
    "not quadratic": "relativistic-particle",
    "magnetic": "charged-particle",
}
METHODS = [SVI(5), Gauss(3), RadauIIA(2), StoermerVerlet(), SCVI(3)]


def states(name: str, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(count, m) positions and momenta about the generic state of a system."""
    q, p = sample_named(name).state
    generator = np.random.default_rng(7)
    return tuple(x * (1.0 + 0.1 * generator.uniform(-1, 1, (count, len(x)))) for x in (q, p))  # type: ignore[return-value]


def assert_equals_single_runs(
    stepper: Stepper, result: EnsembleTrajectory, tolerance: float, **settings: object
) -> None:
    assert result.ok.all()
    for j in range(len(result)):
        single = stepper.integrate(
            result.q[0, j], result.p[0, j], h=result.h, parameters=result.parameters[j], **settings
        )
        assert np.array_equal(single.t, result.t)
        for ours, theirs in ((result.q[:, j], single.q), (result.p[:, j], single.p)):
            assert np.abs(ours - theirs).max() <= tolerance * np.abs(theirs).max()


class TestEqualsSingleTrajectories:
    @pytest.mark.sampled(2)
    @pytest.mark.covering
    @pytest.mark.parametrize("kind", KINDS)
    @pytest.mark.parametrize("method", METHODS, ids=lambda method: method.name)
    def test_ensemble_equals_single_runs_for_systems_and_methods(self, kind: str, method: Method):
        stepper = stepper_for(KINDS[kind], method)
        q, p = states(KINDS[kind], 3)
        result = stepper.integrate_ensemble(q, p, h=0.02, steps=60, save_every=20, t=0.3)
        assert result.q.shape == (4, *q.shape)
        assert result.steps.tolist() == [60, 60, 60]
        # measured 2e-14: rounding of 60 steps, magnified by the motion
        assert_equals_single_runs(stepper, result, 3e-13, steps=60, save_every=20, t=0.3)

    @pytest.mark.parametrize("count", [1, 7, 8, 9, 64])
    def test_ensemble_equals_single_runs_for_any_number_and_parameters(self, count: int):
        stepper = stepper_for("kepler", SVI(5))
        q, p = states("kepler", count)
        result = stepper.integrate_ensemble(
            q, p, h=0.05, steps=40, save_every=3, parameters={"mu": np.linspace(0.8, 1.2, count)}
        )
        assert len(result) == count
        assert len(result.t) == 14
        assert_equals_single_runs(stepper, result, 3e-13, steps=40, save_every=3)

    def test_parameters_are_named_rows_or_one_row_per_trajectory(self):
        stepper = stepper_for("planar-pendulum", SVI(5))
        q, p = states("planar-pendulum", 3)
        each = stepper.integrate_ensemble(q, p, h=0.1, steps=5, parameters={"g": [1.0, 2.0, 3.0], "l": 2.0})
        place = {name: stepper.parameters.index(name) for name in ("g", "l")}
        assert each.parameters[:, place["g"]].tolist() == [1.0, 2.0, 3.0]
        assert each.parameters[:, place["l"]].tolist() == [2.0] * 3
        again = stepper.integrate_ensemble(q, p, h=0.1, steps=5, parameters=each.parameters)
        assert np.array_equal(again.q, each.q)
        same = stepper.integrate_ensemble(q, p, h=0.1, steps=5, parameters=each.parameters[0])
        assert np.array_equal(same.parameters, np.tile(each.parameters[0], (3, 1)))

    @pytest.mark.parametrize("method", [SVI(5), SCVI(3)], ids=lambda method: method.name)
    def test_ensemble_equals_single_runs_backward(self, method: Method):
        stepper = stepper_for("driven-duffing", method)
        q, p = states("driven-duffing", 9)
        there = stepper.integrate_ensemble(q, p, h=0.02, steps=50, t=1.0)
        back = stepper.integrate_ensemble(there.q[-1], there.p[-1], h=-0.02, steps=50, t=2.0)
        assert back.t[-1] == pytest.approx(1.0)
        assert_equals_single_runs(stepper, back, 3e-13, steps=50, t=2.0)
        if method.symmetric:
            np.testing.assert_allclose(back.q[-1], q, rtol=1e-12)

    def test_options_are_passed_to_the_lanes(self):
        stepper = stepper_for("double-pendulum", SVI(5))
        q, p = states("double-pendulum", 8)
        loose = stepper.integrate_ensemble(q, p, h=0.05, steps=20, options=SolverOptions(tolerance=1e-4))
        exact = stepper.integrate_ensemble(q, p, h=0.05, steps=20)
        assert loose.ok.all()
        assert 1e-14 < np.abs(loose.q - exact.q).max() < 1e-3

    def test_energies_equal_those_of_single_runs(self):
        stepper = stepper_for("double-pendulum", SVI(5))
        q, p = states("double-pendulum", 9)
        result = stepper.integrate_ensemble(q, p, h=0.02, steps=50)
        energies = result.energy()
        assert energies.shape == (51, 9)
        assert np.abs(energies / energies[0] - 1).max() < 1e-9
        assert energies[7, 8] == stepper.energy(result.q[7, 8], result.p[7, 8], result.t[7])

    def test_ensembles_with_few_or_no_steps(self):
        stepper = stepper_for("kepler", SVI(5))
        q, p = states("kepler", 9)
        assert stepper.integrate_ensemble(q, p, h=0.1, steps=0).q.shape == (1, 9, 2)
        result = stepper.integrate_ensemble(q, p, h=0.1, steps=3, save_every=5)
        assert result.q.shape == (1, 9, 2)
        assert result.steps.tolist() == [3] * 9


@pytest.fixture(scope="module")
def kepler() -> Stepper:
    return stepper_for("kepler", SVI(5))


class TestFailures:
    def test_diverging_trajectory_does_not_affect_others(self):
        stepper = stepper_for("runaway", SVI(5))
        generator = np.random.default_rng(3)
        q, p = generator.uniform(-1.2, -0.8, (16, 1)), generator.uniform(-0.6, -0.4, (16, 1))
        alone = stepper.integrate_ensemble(q, p, h=0.05, steps=50)
        q[3], p[3] = 1.0, 1.0
        result = stepper.integrate_ensemble(q, p, h=0.05, steps=50)
        others = np.arange(16) != 3
        assert result.ok.tolist() == others.tolist()
        assert np.array_equal(result.q[:, 8:], alone.q[:, 8:])
        assert np.abs(result.q[:, others] - alone.q[:, others]).max() < 1e-13  # measured 1e-15
        with pytest.raises(StepFailedError) as failure:
            stepper.integrate(q[3], p[3], h=0.05, steps=50)
        assert result.status[3] == failure.value.status
        assert result.steps[3] == failure.value.step
        reached = failure.value.step + 1
        single = failure.value.trajectory.q
        assert (np.abs(result.q[:reached, 3] - single) < 1e-9 * np.abs(single)).all()
        assert np.isnan(result.q[reached:, 3]).all()
        assert np.isnan(result.p[reached:, 3]).all()
        assert np.isnan(result.energy()[reached:, 3]).all()

    @pytest.mark.parametrize("place", [3, 6])
    def test_lane_that_fails_at_the_start_does_not_affect_others(self, place: int):
        """Between others, and as the last, whose place is filled up with copies: to roundings, as lanes that step
        together take as many sweeps as the slowest of them needs."""
        stepper = stepper_for("relativistic-particle", SVI(5))
        q, p = states("relativistic-particle", 7)
        values, others = np.tile(stepper.defaults, (7, 1)), np.arange(7) != place
        values[place] = 0.0
        result = stepper.integrate_ensemble(q, p, h=0.05, steps=50, parameters=values)
        without = stepper.integrate_ensemble(q[others], p[others], h=0.05, steps=50)
        assert result.ok.tolist() == others.tolist()
        assert result.steps[place] == 0
        np.testing.assert_allclose(result.q[:, others], without.q, rtol=0, atol=1e-14)
        np.testing.assert_allclose(result.p[:, others], without.p, rtol=0, atol=1e-14)

    def test_newton_continues_where_the_fixed_point_fails(self):
        stepper = stepper_for("harmonic-oscillator", SVI(5))
        q, p = states("harmonic-oscillator", 9)
        stiffness = {"k": np.where(np.arange(9) % 4 == 1, 1e6, 1.0)}
        result = stepper.integrate_ensemble(q, p, h=0.5, steps=50, save_every=7, parameters=stiffness)
        assert result.steps.tolist() == [50] * 9
        assert_equals_single_runs(stepper, result, 1e-10, steps=50, save_every=7)
        others = stiffness["k"] == 1.0
        calm = stepper.integrate_ensemble(q, p, h=0.5, steps=50, save_every=7)
        assert np.abs(result.q[:, others] - calm.q[:, others]).max() < 1e-13

    @pytest.mark.parametrize("h", [6e-2, 1e-2, 1e-4, 2e-14])
    def test_lanes_converge_as_single_runs(self, h: float):
        """Slowly, with steps repeated from another predictor, and at the level of rounding.

        Changes below rounding are random, and relative to a velocity near 0 they exceed any fixed level.
        """
        count, steps = 32, 64
        stepper = compile_stepper(chain(4).system, "svi:2")
        generator = np.random.default_rng(1)
        q, v = generator.uniform(-1, 1, (count, 4)), generator.normal(size=(count, 4))
        p = np.array([stepper.momentum(*each) for each in zip(q, v, strict=True)])
        runs = Ensemble(stepper, q, p, h=h, steps=steps).common
        assert runs is not None
        make, width = runs.blocks()
        for first in range(0, count, width):
            block = make(first)
            block.advance(steps)
            assert isinstance(block, LaneBlock)
            assert not block.left
        for j in range(0, count, 5):
            single = stepper.integrate(q[j], p[j], h=h, steps=steps)
            np.testing.assert_allclose(runs.q[-1, j], single.q[-1], rtol=0, atol=1e-12)
            np.testing.assert_allclose(runs.p[-1, j], single.p[-1], rtol=0, atol=1e-11)

    def test_block_without_active_trajectories_stops(self):
        stepper = stepper_for("relativistic-particle", SVI(5))
        q, p = states("relativistic-particle", 8)
        nothing = dict.fromkeys(stepper.parameters, 0.0)
        reports: list[int] = []

        def report(done: int) -> None:
            reports.append(done)
            assert len(reports) < 100  # an empty block that went on would report for minutes

        settings = {"parameters": nothing, "progress": report}
        result = stepper.integrate_ensemble(q, p, h=0.05, steps=10**9, save_every=10**8, **settings)
        assert set(result.steps) == {0}

    @pytest.mark.parametrize("method", [SVI(5), SCVI(3), StoermerVerlet()], ids=lambda method: method.name)
    def test_failures_are_per_trajectory_for_every_method(self, method: Method):
        stepper = stepper_for("runaway", method)
        result = stepper.integrate_ensemble([[-1.0], [1.0], [-0.9]], [[-0.5], [1.0], [-0.4]], h=0.05, steps=60)
        assert result.ok.tolist() == [True, False, True]
        last = int(result.steps[1])
        assert 0 < last < 60
        assert np.isfinite(result.q[: last + 1, 1]).all()
        assert np.isnan(result.q[last + 1 :, 1]).all()


class TestThreadsAndInterruption:
    def test_results_do_not_depend_on_the_number_of_threads(self, kepler: Stepper):
        q, p = states("kepler", 64)
        q[20] = 0.0
        one, two = (kepler.integrate_ensemble(q, p, h=0.05, steps=300, threads=threads) for threads in (1, 2))
        assert one.q.tobytes() == two.q.tobytes()  # NaN included
        assert one.p.tobytes() == two.p.tobytes()
        assert one.status.tolist() == two.status.tolist()

    @pytest.mark.parametrize("method", [SVI(5), SCVI(2)], ids=lambda method: method.name)
    def test_progress_counts_up_to_the_end(self, method: Method):
        stepper = stepper_for("kepler", method)
        q, p = states("kepler", 32)
        calls: list[int] = []
        stepper.integrate_ensemble(q, p, h=0.05, steps=4000, save_every=4000, progress=calls.append, threads=2)
        assert calls == sorted(calls)
        assert calls[-1] == 4000

    def test_interrupt_ends_all_threads_and_returns_completed_states(self, kepler: Stepper):
        q, p = states("kepler", 64)
        work = Ensemble(kepler, q, p, h=0.05, steps=10**9, save_every=10**7)

        def interrupt(done: int) -> None:
            raise KeyboardInterrupt

        before = set(threading.enumerate())
        with pytest.raises(KeyboardInterrupt):
            work.run(progress=interrupt, threads=2)
        assert set(threading.enumerate()) == before
        result = work.result()
        assert set(result.status) == {"interrupted"}
        assert 0 < result.steps.max() < 10**9

    def test_error_in_a_block_is_raised(self, kepler: Stepper, monkeypatch: pytest.MonkeyPatch):
        def fail(*arguments: object) -> None:
            raise RuntimeError("out of order")

        monkeypatch.setattr("scvi_codegen.runtime.ensemble.lanes.LaneBlock.advance", fail)
        with pytest.raises(RuntimeError, match="out of order"):
            kepler.integrate_ensemble(*states("kepler", 20), h=0.05, steps=10)

    def test_memory_is_bounded_by_save_every(self, kepler: Stepper):
        q, p = states("kepler", 64)
        kepler.integrate_ensemble(q, p, h=0.05, steps=1)
        gc.collect()
        tracemalloc.start()
        try:
            kepler.integrate_ensemble(q, p, h=0.05, steps=20_000, save_every=2000)
            peak = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        assert peak < 1e6  # all states would take 41 MB


class TestArguments:
    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"q": np.ones((3, 3))}, r"q must have shape \(k, 2\), not \(3, 3\)"),
            ({"q": np.ones((2, 2))}, r"equal shapes, not \(2, 2\) and \(3, 2\)"),
            ({"q": np.ones((0, 2))}, "q must have shape"),
            ({"q": 1.0}, "q must have shape"),
            ({"p": [[1.0, 0.0], [1.0, np.nan], [0.0, 0.0]]}, r"p\[1, 1\] \(q2\) is nan"),
            ({"p": "fast"}, "p must be real numbers"),
            ({"p": [[1.0], [1.0, 2.0], [3.0]]}, "p must be real numbers"),
            ({"h": 0.0}, "the step size h is 0"),
            ({"h": np.inf}, "the step size h is inf"),
            ({"steps": 1.5}, "steps must be a whole number"),
            ({"steps": -1}, "steps must be at least 0"),
            ({"save_every": 0}, "save_every must be at least 1"),
            ({"t": "noon"}, "the time t must be real numbers"),
            ({"threads": -1}, "threads must be at least 1"),
            ({"threads": 1.5}, "threads must be a whole number"),
            ({"parameters": {"nu": 1.0}}, "there is no parameter 'nu'"),
            (
                {"parameters": {"mu": [1.0, 2.0]}},
                r"the parameter mu must be one number or 3 numbers, not of shape \(2,\)",
            ),
            ({"parameters": {"mu": "heavy"}}, "the parameter mu must be real numbers"),
            ({"parameters": np.ones((3, 2))}, r"parameters must have shape \(3, 1\), not \(3, 2\)"),
            ({"parameters": ["heavy"]}, "parameters must be real numbers"),
            ({"parameters": {"mu": [1.0, np.nan, 1.0]}}, "the parameter mu of trajectory 1 is nan"),
        ],
    )
    def test_invalid_arguments_are_named(self, kepler: Stepper, changes: dict[str, object], message: str):
        arguments: dict[str, object] = {"q": np.ones((3, 2)), "p": np.zeros((3, 2)), "h": 0.1, "steps": 5} | changes
        with pytest.raises(StateError, match=message):
            kepler.integrate_ensemble(**arguments)  # type: ignore[arg-type]

    def test_one_state_is_an_ensemble_of_one(self, kepler: Stepper):
        assert len(kepler.integrate_ensemble([1.0, 0.0], [0.0, 1.0], h=0.1, steps=5)) == 1


class TestFiles:
    @pytest.fixture
    def result(self, kepler: Stepper) -> EnsembleTrajectory:
        values = {"mu": [1.0, 1e9, 1.2]}  # the second falls into the centre
        return kepler.integrate_ensemble(*states("kepler", 3), h=0.05, steps=100, save_every=10, parameters=values)

    def test_npz_round_trip(self, result: EnsembleTrajectory, tmp_path):
        result.save(tmp_path / "runs.npz")
        with np.load(tmp_path / "runs.npz") as file:
            for name in ("t", "q", "p", "status", "steps", "h", "parameters"):
                assert np.array_equal(file[name], getattr(result, name), equal_nan=name in "qp")
            assert file["coordinates"].tolist() == ["q1", "q2"]
            assert file["parameter_names"].tolist() == ["mu"]

    def test_csv_has_long_format_and_omits_failures(self, result: EnsembleTrajectory, tmp_path):
        result.save(tmp_path / "runs.csv")
        assert (tmp_path / "runs.csv").read_text().startswith("trajectory,mu,t,q1,q2,p_q1,p_q2\n0,1,0,")
        table = np.loadtxt(tmp_path / "runs.csv", delimiter=",", skiprows=1)
        for j in range(3):
            rows = table[table[:, 0] == j]
            assert len(rows) == result.steps[j] // 10 + 1
            assert np.array_equal(rows[:, 3:5], result.q[: len(rows), j])
            assert set(rows[:, 1]) == {result.parameters[j, 0]}

    def test_unknown_suffixes_are_rejected(self, result: EnsembleTrajectory, tmp_path):
        with pytest.raises(StateError, match=r"use \.npz, \.csv, \.h5"):
            result.save(tmp_path / "runs.txt")


GRID = """
[grid]
q1 = { from = 0.8, to = 1.2, count = 3 }
q2_dot = [0.9, 1.0]
mu = 1.5
"""


def model(**changes: object) -> Model:
    entry = Model.from_problem(problem("kepler"), SVI(4))
    return replace(entry, h=0.1, span=None, steps=50, save_every=10, **changes)  # type: ignore[arg-type]


class TestEnsembleFiles:
    def test_grid_is_a_product_and_the_model_supplies_the_rest(self, tmp_path):
        (tmp_path / "grid.toml").write_text(GRID)
        states = load_ensemble(tmp_path / "grid.toml", model())
        assert len(states) == 6
        assert states.q[:, 0].tolist() == [0.8, 0.8, 1.0, 1.0, 1.2, 1.2]
        assert set(states.q[:, 1]) == {model().q[1]}
        assert states.parameters.tolist() == [[1.5]] * 6
        p = states.momenta(stepper_for("kepler", SVI(4)))
        assert p[:, 1].tolist() == [0.9, 1.0] * 3
        assert set(p[:, 0]) == {model().velocity[0]}  # type: ignore[index]

    def test_table_has_one_line_per_trajectory(self, tmp_path):
        (tmp_path / "table.csv").write_text("mu, p_q1,q2\n\n1.0,0.5,0.1\n 2e0 ,-0.5,0.2\n")
        states = load_ensemble(tmp_path / "table.csv", model())
        assert states.parameters[:, 0].tolist() == [1.0, 2.0]
        assert states.q.tolist() == [[model().q[0], 0.1], [model().q[0], 0.2]]
        stepper = stepper_for("kepler", SVI(4))
        assert states.momenta(stepper).tolist() == [
            [0.5, model().momenta(stepper)[1]],
            [-0.5, model().momenta(stepper)[1]],
        ]

    def test_byte_order_mark_of_a_table_is_ignored(self, tmp_path):
        (tmp_path / "table.csv").write_text("q1\n0.5\n", encoding="utf-8-sig")
        assert load_ensemble(tmp_path / "table.csv", model()).q[:, 0].tolist() == [0.5]

    def test_velocities_are_transformed_with_individual_parameters(self, tmp_path):
        (tmp_path / "table.csv").write_text("q,q_dot,m\n0.1,0.5,1.0\n0.1,0.5,3.0\n")
        pendulum = Model.from_problem(problem("planar-pendulum"))
        states = load_ensemble(tmp_path / "table.csv", pendulum)
        p = states.momenta(stepper_for("planar-pendulum", SVI(4)))
        assert p[1, 0] == 3.0 * p[0, 0]

    def test_velocities_override_momenta_of_a_model_and_vice_versa(self, tmp_path):
        stepper = stepper_for("kepler", SVI(4))
        with_momenta = model(p=(0.3, 0.7), velocity=None)
        (tmp_path / "a.csv").write_text("q1_dot\n0.1\n")
        assert load_ensemble(tmp_path / "a.csv", with_momenta).momenta(stepper)[0].tolist() == [0.1, 0.7]
        (tmp_path / "b.csv").write_text("q1\n1.1\n")
        assert load_ensemble(tmp_path / "b.csv", with_momenta).momenta(stepper)[0].tolist() == [0.3, 0.7]

    @pytest.mark.parametrize(
        ("name", "text", "message"),
        [
            ("a.txt", "", "a grid in a .toml file or a table in a .csv file"),
            ("missing.toml", None, "cannot be read: No such file"),
            ("a.toml", "grid =", "this is not TOML"),
            ("a.toml", "[mesh]\nq1 = 1", r"must have one section, \[grid\]"),
            ("a.toml", "[grid]", r"must have one section, \[grid\]"),
            (
                "a.toml",
                "[grid]\nq3 = 1",
                "'q3' is not a coordinate, velocity, momentum or parameter of the system. Known: q1",
            ),
            ("a.toml", "[grid]\nq1 = []", r"\[grid\] q1 is an empty list"),
            ("a.toml", "[grid]\nq1 = ['x']", r"\[grid\] q1 must be a number, not 'x'"),
            ("a.toml", "[grid]\nq1 = nan", r"\[grid\] q1 is nan: it must be a finite number"),
            ("a.toml", "[grid]\nq1 = {from = 1, to = 2}", "must have from, to and count, not from, to"),
            ("a.toml", "[grid]\nq1 = {from = 1, to = 2, count = 0}", "count must be at least 1, not 0"),
            ("a.toml", "[grid]\nq1_dot = 1\np_q2 = 1", "both velocities and momenta"),
            ("a.csv", "q1,q2\n", "a header of names and at least one line of numbers"),
            ("a.csv", "q1,q1\n1,2", "the column 'q1' occurs twice"),
            ("a.toml", "[grid]\nq1 = {from = 1, to = 2, count = 1000000000}", "at most 100000000, not 1000000000"),
            (
                "a.toml",
                "[grid]\nq1 = {from = 1, to = 2, count = 30000}\nq2 = {from = 1, to = 2, count = 30000}",
                "the grid has 900000000 combinations, more than the 100000000",
            ),
            ("a.csv", "q1,q2\n1,2\n3", "line 3 must have a number for each of 2 names, and has 1"),
            ("a.csv", "q1,,q2\n1,2,3", "column 2 has no name in the first line"),
            ("a.csv", "q1;q2\n1;2", "'q1;q2' is not a coordinate"),
            ("a.csv", "q1,q2\n1,x", "line 2, q2: 'x' is not a number"),
            ("a.csv", "q1\ninf", "line 2, q1: inf is not a finite number"),
        ],
    )
    def test_invalid_entries_are_named(self, name: str, text: str | None, message: str, tmp_path):
        if text is not None:
            (tmp_path / name).write_text(text)
        with pytest.raises(ModelFileError, match=message) as error:
            load_ensemble(tmp_path / name, model())
        assert str(error.value).startswith(str(tmp_path / name))


class TestCommandLine:
    @pytest.fixture(autouse=True)
    def elsewhere(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.chdir(tmp_path)
        Path("grid.toml").write_text(GRID)

    def invoke(self, words: str) -> Result:
        return CliRunner().invoke(main, ["run", *words.split()])

    @pytest.mark.parametrize("suffix", ["npz", "csv"])
    def test_ensemble_command_prints_a_summary_and_writes_files(self, suffix: str):
        result = self.invoke(
            f"kepler --degree 4 --step 0.1 --steps 50 --save-every 10 --ensemble grid.toml -o runs.{suffix}"
        )
        assert result.exit_code == 0, result.output
        assert "6 trajectories of 50 steps of 0.1 from t = 0; 6 states saved of each" in result.stdout
        assert "\n6 ok\n" in result.stdout
        assert float(re.search(r"relative energy error: (\S+) at most, of trajectory \d", result.stdout)[1]) < 1e-3  # type: ignore[index]
        assert f"wrote runs.{suffix}" in result.stdout
        if suffix == "npz":
            with np.load("runs.npz") as file:
                assert file["q"].shape == (6, 6, 2)
        else:
            assert len(Path("runs.csv").read_text().splitlines()) == 37

    def test_failures_are_counted_and_others_saved(self):
        Path("table.csv").write_text("mu\n1\n1e9\n1.1\n")
        result = self.invoke("kepler --degree 4 --step 0.05 --steps 50 --ensemble table.csv -o runs.npz")
        assert result.exit_code == 0, result.output
        assert re.search(r"^2 ok, 1 not \w+$", result.stdout, re.MULTILINE)
        assert re.search(
            r"^  trajectory 1: step \d+ at t = \S+ failed: .*(did not converge|NaN).*$", result.stdout, re.MULTILINE
        )
        assert Path("runs.npz").exists()

    def test_failure_of_all_trajectories_is_a_failure(self):
        Path("table.csv").write_text("mu\n1e9\n")
        result = self.invoke("kepler --degree 4 --step 0.05 --steps 50 --ensemble table.csv")
        assert result.exit_code == 1
        assert "every trajectory failed" in result.stderr

    @pytest.mark.parametrize(
        ("words", "message"),
        [
            ("kepler --ensemble none.toml", "none.toml cannot be read"),
            ("kepler --ensemble grid.toml --plot a.png", "--plot is not available with --ensemble"),
            ("kepler --ensemble grid.toml --tolerance 1e-6", "--tolerance is not available with --ensemble"),
            ("kepler --ensemble grid.toml -o runs.txt", "written as .npz, .csv, .h5"),
            ("planar-pendulum --ensemble grid.toml", "'q1' is not a coordinate"),
            (
                "kepler --steps 1000000000000 --ensemble grid.toml",
                "1000000000001 states of each of 6 trajectories need 4.08e+05 GB of memory: save fewer (--save-every ",
            ),
        ],
    )
    def test_mistakes_are_usage_errors(self, words: str, message: str):
        result = self.invoke(words)
        assert result.exit_code == 2, result.output
        assert message in result.stderr

    def test_interrupted_command_saves_completed_states(self, monkeypatch: pytest.MonkeyPatch):
        @contextmanager
        def once_some_have_begun(steps: int) -> Iterator[Callable[[int], None]]:
            yield lambda count: signal.raise_signal(signal.SIGINT) if count else None

        monkeypatch.setattr("scvi_codegen.cli.ensembles.progress_bar", once_some_have_begun)
        result = self.invoke(
            "kepler --degree 4 --step 0.05 --steps 10000000000 --save-every 1000000000 --ensemble grid.toml -o runs.npz"
        )
        assert result.exit_code == 130
        assert "0 ok, 6 interrupted" in result.stdout
        assert "the computed states were written: runs.npz" in result.stderr
        with np.load("runs.npz") as file:
            assert set(file["status"]) == {"interrupted"}
            assert file["steps"].max() > 0


def test_pickled_stepper_has_its_lanes(kepler: Stepper):
    q, p = states("kepler", 9)
    again = pickle.loads(pickle.dumps(kepler))
    first, second = (stepper.integrate_ensemble(q, p, h=0.05, steps=20) for stepper in (kepler, again))
    assert np.array_equal(first.q, second.q)


@pytest.mark.parametrize("name", ["kepler", "double-pendulum"])
def test_absolute_tolerance_equals_that_of_single_trajectories(name):
    """With the absolute tolerance, lanes need as many iterations and reach the same states."""
    chosen = problem(name)
    stepper = compile_stepper(chosen.system, SVI(4))
    p = stepper.momentum(chosen.q, chosen.velocity)
    options = SolverOptions(tolerance=1e-6, absolute=True)
    single = stepper.integrate(chosen.q, p, h=0.05, steps=20, save_every=20, options=options)
    many = stepper.integrate_ensemble([chosen.q] * 8, [p] * 8, h=0.05, steps=20, save_every=20, options=options)
    exact = stepper.integrate(chosen.q, p, h=0.05, steps=20, save_every=20)
    np.testing.assert_allclose(many.q[-1, 0], single.q[-1], rtol=1e-13, atol=1e-13)
    assert not np.allclose(exact.q[-1], single.q[-1], rtol=1e-14, atol=1e-14)
