"""Ensembles equal single trajectories, trajectories leave each other alone, and a run can be stopped."""

from __future__ import annotations

import re
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import error_of, invoke, output_of
from notation import hamilton, lagrange
from numpy.testing import assert_allclose
from programs import needs
from samples import ensemble_runs, pushed_pendulum, sample_named, stepper_for

import scvi_codegen as sc
from benchmarks.cases.robots import chain
from scvi_codegen.codegen.native.options import FAILURES
from scvi_codegen.interfaces.models.model_files.ensemble_file import load_ensemble
from scvi_codegen.methods import Method
from scvi_codegen.runs.ensembles.lanes import LaneRuns

KNOTS = np.array([0.0, 0.37, 0.9, 1.41, 2.05, 2.6])
VALUES = np.array([0.0, 1.2, -0.7, 0.4, 1.9, -1.0])
COUNT = 11
"""Trajectories with inputs: more than a block of lanes, and no multiple of one."""
OWN_VALUES = VALUES * np.random.default_rng(1).uniform(0.5, 1.5, (COUNT, 1))
DAMPING = {"c": np.random.default_rng(4).uniform(0.1, 0.3, COUNT)}
W = ([0.0, 3.0], [0.0, 0.3])
ECCENTRICITIES = np.array([0.0, 0.3, 0.6, 0.9])
ENDS = [5.0, 10.0, 20.0, 15.0]


def coupled_with_inputs() -> sc.LagrangianSystem:
    """Return a system with position-dependent masses, whose iterations start with velocities."""
    return sc.LagrangianSystem.from_text(
        name="coupled",
        coordinates=["x", "y"],
        lagrangian="(1 + x**2/4)*x_dot**2/2 + x_dot*y_dot/3 + (1 + w/5)*y_dot**2 - x**4/4 - (x - y)**2/2",
        parameters={"c": 0.2},
        forces={"x": "u - c*x_dot"},
        inputs=["u", "w"],
    )


RELATIVISTIC = hamilton("relativistic", "q", "sqrt(1 + p_q**2) + k*q**2/2 + cos(t)*q", k=1.0)
FALLING = lagrange("falling", "x", "x_dot**2/2 + 1/x", forces={"x": "u"}, inputs="u")
ROOT = lagrange("root", "q", "q_dot**2/2 + cos(q)", forces={"q": "sqrt(u)"}, inputs="u")
OWN_SYSTEMS = {"relativistic": RELATIVISTIC, "falling": FALLING, "root": ROOT}
WITH_INPUTS = {"pushed pendulum": pushed_pendulum, "coupled with inputs": coupled_with_inputs}


@cache
def stepper_of(system: str, method: Method) -> sc.Stepper:
    if system in OWN_SYSTEMS:
        return sc.compile_stepper(OWN_SYSTEMS[system], method)
    if system in WITH_INPUTS:
        solver = "newton" if isinstance(method, sc.SCVI) else "auto"  # which has no lanes
        return sc.compile_stepper(WITH_INPUTS[system](), method, solver=solver)
    return stepper_for("kepler" if system in ("eccentric", "into the centre") else system, method)


def states(name: str, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(count, m) positions and momenta about the generic state of a system."""
    if name == "eccentric":
        zero, e = np.zeros(4), ECCENTRICITIES
        return np.column_stack([1 - e, zero])[:count], np.column_stack([zero, np.sqrt((1 + e) / (1 - e))])[:count]
    if name == "into the centre":
        q, p = states("eccentric", count)
        return q, np.where(np.arange(count)[:, None] == 1, 0.0, p)
    if name == "falling":
        return np.array([[1.0], [9.0]]), np.zeros((2, 1))
    if name == "runaway":
        q, p = np.random.default_rng(3).uniform([[-1.2], [-0.6]], [[-0.8], [-0.4]], (count, 2, 1)).transpose(1, 0, 2)
        q[3], p[3] = 1.0, 1.0
        return q, p
    if name in WITH_INPUTS or name in OWN_SYSTEMS:
        dimension = stepper_of(name, sc.SVI(3)).dimension
        return tuple(np.random.default_rng(2).uniform(-1, 1, (2, count, dimension)))
    q, p = sample_named(name).state
    generator = np.random.default_rng(7)
    return tuple(x * (1.0 + 0.1 * generator.uniform(-1, 1, (count, len(x)))) for x in (q, p))  # type: ignore[return-value]


def of_one(arguments: dict[str, Any], j: int) -> dict[str, Any]:
    """The arguments of trajectory j: rows of tables of inputs, entries of parameters, constants and end times."""

    def entry(value: Any) -> Any:
        if isinstance(value, tuple):
            t, values, *kind = value
            return (t, values[j] if np.ndim(values) == 2 else values, *kind)
        return value[j] if np.ndim(value) else value

    own = {name: value for name, value in arguments.items() if name != "threads"}
    for name in own.keys() & {"parameters", "inputs"}:
        own[name] = {key: entry(value) for key, value in own[name].items()}
    return own | ({"t_end": entry(own["t_end"])} if "t_end" in own else {})


@dataclass(frozen=True, eq=False)
class Case:
    """An ensemble of so many states, the relative difference from single runs, 0 for the same bits, and which fails."""

    system: str
    method: Method
    count: int
    arguments: dict[str, Any]
    tolerance: float = 0.0
    failing: int | None = None

    def run(self, **more: Any) -> sc.EnsembleTrajectory:
        q, p = states(self.system, self.count)
        return stepper_of(self.system, self.method).integrate_ensemble(q, p, **self.arguments, **more)

    def check(self) -> None:
        runs, stepper = self.run(), stepper_of(self.system, self.method)
        assert runs.ok.tolist() == [j != self.failing for j in range(self.count)]
        assert [*runs.failures] == [j for j in range(self.count) if j == self.failing]
        energies, errors = runs.energy(), runs.momentum_errors()
        conserved = stepper.interface.changes_energy is None
        drifts = runs.energy_error() if conserved else np.empty(0)
        for j, (t, q, p, _, steps) in enumerate(runs.each()):
            arguments = of_one(self.arguments, j)
            if "t_eval" in arguments:
                arguments["t_eval"] = [time for time in arguments["t_eval"] if time <= arguments["t_end"]]
            own, status = (x[j] for x in states(self.system, self.count)), "ok"
            try:
                run = stepper.integrate(*own, **arguments)
            except sc.StepFailedError as error:
                run, status = error.trajectory, error.status
            tolerance = self.tolerance * (1.0 if status == "ok" else 1e3)  # near a singularity errors grow
            assert (runs.status[j], steps) == (status, run.steps)
            assert status == "ok" or FAILURES[status][0] in runs.failures[j]
            assert status == "ok" or f"t = {run.t[-1]:.6g}"[:7] in runs.failures[j]
            assert np.array_equal(t, run.t)
            for found, expected in ((q, run.q), (p, run.p)):
                assert np.abs(found - expected).max() <= tolerance * np.abs(expected).max()
            if status == "ok":
                energy = run.energy()
                assert_allclose(energies[: len(t), j], energy, rtol=0, atol=20 * tolerance * np.abs(energy).max())
                assert_allclose(errors[: len(t), j], run.momentum_errors(), rtol=0, atol=20 * tolerance)
                if conserved:
                    assert_allclose(drifts[j], run.energy_error(), rtol=0, atol=20 * tolerance)
            assert all(np.isnan(x[len(t) :, j]).all() for x in (runs.q, runs.p, energies))


ADAPTIVE = {"t_end": ENDS, "tolerance": 1e-10}
INPUTS = {"u": (KNOTS, OWN_VALUES), "w": W}
CUBIC = {"u": (KNOTS, OWN_VALUES), "w": ([0.0, 1.0, 3.0], [0.0, 0.5, 0.0], "cubic")}
SECOND_FAILS = np.outer(np.arange(COUNT) == 2, np.arange(6) == 4)
CASES = {
    "drift of momenta": Case(
        "relativistic",
        sc.Composition.of(4),
        9,
        {"h": 0.1, "t_end": 1.94, "parameters": {"k": np.linspace(1, 2, 9)}},
        3e-14,
    ),
    "adaptive": Case("eccentric", sc.SVI(4), 4, ADAPTIVE),
    "at times": Case("eccentric", sc.SVI(4), 4, ADAPTIVE | {"t_eval": np.linspace(0.0, 20.0, 9)}),
    "at their ends": Case("eccentric", sc.SVI(4), 4, ADAPTIVE | {"t_eval": sorted(ENDS)}),
    "inputs": Case(
        "coupled with inputs",
        sc.SVI(3),
        COUNT,
        {"inputs": INPUTS, "parameters": DAMPING, "h": 0.05, "t_end": 2.3},
        2e-14,
    ),
    "inputs without lanes": Case(
        "pushed pendulum",
        sc.SCVI(2),
        COUNT,
        {"inputs": INPUTS, "parameters": DAMPING, "h": 0.02, "t_end": 2.3, "save_every": 4},
    ),
    "adaptive inputs backward": Case(
        "pushed pendulum",
        sc.SVI(4),
        COUNT,
        {"inputs": CUBIC, "parameters": DAMPING, "t": 2.5, "t_end": 0.0, "tolerance": 1e-6, "save_every": 5},
    ),
}

FAILING = {
    **{
        f"diverging {method.name}": Case("runaway", method, 16, {"h": 0.05, "steps": 60}, 1e-12, 3)
        for method in (sc.SVI(5), sc.SCVI(3), sc.StoermerVerlet())
    },
    **{
        f"at the start, {place}": Case(
            "relativistic-particle",
            sc.SVI(5),
            7,
            {"h": 0.05, "steps": 50, "parameters": dict.fromkeys(("m", "c", "k"), 1.0 * (np.arange(7) != place))},
            1e-14,
            place,
        )
        for place in (3, 6)
    },
    "adaptive": Case("into the centre", sc.SVI(4), 4, ADAPTIVE, 0.0, 1),
    "square root": Case(
        "root",
        sc.SVI(3),
        COUNT,
        {"inputs": {"u": (KNOTS, np.where(SECOND_FAILS, -3.0, np.abs(OWN_VALUES) + 0.1))}, "h": 0.1, "t_end": 2.3},
        1e-13,
        2,
    ),
    "adaptive inputs": Case(
        "falling", sc.SVI(4), 2, {"inputs": {"u": ([0.0, 0.5, 3.0], [0.0, 0.1, 0.1])}, "t_end": 2.5}, 0.0, 0
    ),
}
"""With one trajectory that fails: between others, as the last, whose lane is filled with a copy, and in a segment."""


@pytest.mark.rotated
@pytest.mark.parametrize("name", FAILING)
def test_a_failing_trajectory_equals_its_single_run_and_does_not_affect_others(name: str) -> None:
    FAILING[name].check()


@pytest.mark.tiers(5, 5)
@pytest.mark.filterwarnings("ignore::scvi_codegen.common.errors.AccuracyWarning")
@pytest.mark.parametrize("name", CASES)
def test_each_trajectory_equals_the_single_run(name: str) -> None:
    CASES[name].check()


@pytest.mark.rotated
def test_parameters_are_named_rows_or_one_row_per_trajectory() -> None:
    stepper = stepper_for("planar-pendulum", sc.SVI(5))
    q, p = states("planar-pendulum", 3)
    each = stepper.integrate_ensemble(q, p, h=0.1, steps=5, parameters={"g": [1.0, 2.0, 3.0], "l": 2.0})
    columns = [stepper.parameters.index(name) for name in ("g", "l")]
    assert each.parameters[:, columns].T.tolist() == [[1.0, 2.0, 3.0], [2.0] * 3]
    again = stepper.integrate_ensemble(q, p, h=0.1, steps=5, parameters=each.parameters)
    assert np.array_equal(again.q, each.q)
    same = stepper.integrate_ensemble(q, p, h=0.1, steps=5, parameters=each.parameters[0])
    assert np.array_equal(same.parameters, np.tile(each.parameters[0], (3, 1)))


@pytest.mark.rotated
def test_ensembles_with_few_or_no_steps() -> None:
    stepper = stepper_for("kepler", sc.SVI(5))
    q, p = states("kepler", 9)
    assert stepper.integrate_ensemble(q, p, h=0.1, steps=0).q.shape == (1, 9, 2)
    result = stepper.integrate_ensemble(q, p, h=0.1, steps=3, save_every=5)
    assert result.q.shape == (1, 9, 2)
    assert result.steps.tolist() == [3] * 9
    assert len(stepper.integrate_ensemble([1.0, 0.0], [0.0, 1.0], h=0.1, steps=5)) == 1
    shorter_last = Case("eccentric", sc.SVI(4), 4, {"h": 0.03, "t_end": 0.1, "save_every": 2}).run()
    assert shorter_last.t.tolist() == [0.0, 0.06, 0.1]
    assert shorter_last[0].at(0.08)[0] == pytest.approx(Case("eccentric", sc.SVI(4), 1, {"t_end": 0.08}).run().q[-1, 0])
    still = Case("pushed pendulum", sc.SVI(3), COUNT, {"inputs": INPUTS, "h": 0.1, "t": 0.4, "t_end": 0.4}).run()
    assert still.t.tolist() == [0.4]
    assert still.ok.all()
    assert still.energy().shape == (1, COUNT)


@pytest.mark.second
@pytest.mark.parametrize("t_eval", [[2.0, 5.0], [0.5, 2.0, 5.0]])
def test_ends_with_output_times_are_those_of_terminal_events(t_eval: list[float]) -> None:
    stepper = stepper_for("kepler", sc.SVI(5)).with_events(sc.Event("q1 - 1/2", -1, terminal=True))
    start = {"q": [[1.0, 0.0], [1.0, 0.0]], "velocity": [[0.0, 1.0], [0.0, 1.1]], "t_end": 5.0}
    runs, alone = (stepper.integrate_ensemble(**start, t_eval=each) for each in (t_eval, None))
    for its, expected in zip(runs.ends, alone.ends, strict=True):
        assert np.array_equal(its, expected)
    assert runs.ends[0][0] == pytest.approx(np.arccos(0.5), rel=1e-12)
    stopped = stepper.integrate_ensemble(**start | {"t_end": [0.3, 5.0]}, t_eval=[0.5, 5.0])
    assert np.isnan(stopped.ends[0]).tolist() == [True, False]


@pytest.fixture(scope="module")
def kepler() -> sc.Stepper:
    return stepper_for("kepler", sc.SVI(5))


class TestFailures:
    @pytest.mark.rotated
    def test_block_without_active_trajectories_stops(self):
        stepper = stepper_for("relativistic-particle", sc.SVI(5))
        q, p = states("relativistic-particle", 8)
        nothing = dict.fromkeys(stepper.parameters, 0.0)
        reports: list[int] = []

        def report(done: int) -> None:
            reports.append(done)
            assert len(reports) < 100  # an empty block that went on would report for minutes

        settings = {"parameters": nothing, "progress": report}
        result = stepper.integrate_ensemble(q, p, h=0.05, steps=10**9, save_every=10**8, **settings)
        assert set(result.steps) == {0}


@pytest.mark.rotated
@pytest.mark.filterwarnings("ignore::scvi_codegen.common.errors.AccuracyWarning")
@pytest.mark.parametrize(
    ("name", "method", "plan"),
    [
        ("kepler", sc.SVI(5), {"h": 0.3, "steps": 40}),
        ("kepler", sc.SVI(5), {"t_end": 3.0, "tolerance": 1e-8}),
        ("kepler", sc.Composition.of(4), {"h": 0.3, "t_end": 2.0}),
        ("double-pendulum", sc.SVI(3), {"h": 0.1, "steps": 20}),
        ("double-pendulum", sc.SCVI(3), {"h": 0.1, "steps": 6}),
        ("chain", sc.SVI(2), {"h": 0.1, "steps": 20}),
    ],
    ids=lambda value: getattr(value, "name", value) if not isinstance(value, dict) else next(iter(value)),
)
def test_bits_of_trajectories_do_not_depend_on_others(
    name: str, method: Method, plan: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In another order, in parts, in threads and calls: with different iterations, accelerated and failed steps."""
    monkeypatch.setattr("scvi_codegen.runs.ensembles.batches.FIRST_CHUNK_STEPS", 7)  # calls end within blocks
    generator = np.random.default_rng(4)
    if name == "chain":  # slow iterations
        stepper, count = sc.compile_stepper(chain(4).system, method), 136
        q, p = generator.uniform(-1.5, 1.5, (count, 4)), generator.uniform(-0.1, 0.1, (count, 4))
    else:
        stepper, count = stepper_for(name, method), 136
        q, p = (x * generator.choice([-1.0, 1.0], x.shape) for x in states(name, count))
        q[3], p[3] = (0.0, p[3]) if name == "kepler" else (q[3], 1e4)
    runs = stepper.integrate_ensemble(q, p, **plan, threads=1)
    order = generator.permutation(count)
    others = [stepper.integrate_ensemble(q[order], p[order], **plan, threads=3)]
    others += [stepper.integrate_ensemble(q[part], p[part], **plan) for part in (slice(2, 5), slice(5, 20))]
    for one, members in zip(others, (order, np.arange(2, 5), np.arange(5, 20)), strict=True):
        for found, expected in ((one.q, runs.q), (one.p, runs.p)):
            rows = min(len(found), len(expected))
            assert found[:rows].tobytes() == expected[:rows, members].tobytes()
        assert one.status.tolist() == runs.status[members].tolist()
        assert one.steps.tolist() == runs.steps[members].tolist()


@pytest.mark.second
def test_bits_of_trajectories_by_clang_do_not_depend_on_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lanes have the same products fused with sums."""
    monkeypatch.setenv("CC", needs("clang"))
    energy = "omega_1**2/2 + 0.4*omega_2**2 + 0.2*omega_3**2 - 2*R_33"
    stepper = sc.compile_stepper(sc.LagrangianSystem.from_text("body", [], energy, rotations={"R": "omega"}), "svi:2")
    generator = np.random.default_rng(0)
    starts = [
        stepper.integrate({"R": R}, velocity={"omega": [1, 2, 3]}, h=1, steps=0) for R in generator.normal(size=(16, 4))
    ]
    q, p = (np.concatenate(parts) for parts in zip(*((run.q, run.p) for run in starts), strict=True))
    order = generator.permutation(16)
    runs = [stepper.integrate_ensemble(q[of], p[of], h=0.05, steps=60) for of in (np.arange(16), order)]
    assert runs[1].q.tobytes() == runs[0].q[:, order].tobytes()


class TestThreadsAndInterruption:
    def test_interrupt_ends_all_threads_and_returns_completed_states(self, kepler: sc.Stepper):
        q, p = states("kepler", 64)
        work = ensemble_runs(kepler, q, p, h=0.05, steps=10**9, save_every=10**7)

        def interrupt(done: int) -> None:
            raise KeyboardInterrupt

        before = set(threading.enumerate())
        with pytest.raises(KeyboardInterrupt):
            work.run(progress=interrupt, threads=2)
        assert set(threading.enumerate()) <= before
        result = work.result()
        assert set(result.status) == {"interrupted"}
        assert 0 < result.steps.max() < 10**9


class TestFiles:
    @pytest.fixture
    def result(self, kepler: sc.Stepper) -> sc.EnsembleTrajectory:
        values = {"mu": [1.0, 1e9, 1.2]}  # the second falls into the centre
        return kepler.integrate_ensemble(*states("kepler", 3), h=0.05, steps=100, save_every=10, parameters=values)

    def test_csv_has_long_format_and_omits_failures(self, result: sc.EnsembleTrajectory, tmp_path):
        result.save(tmp_path / "runs.csv")
        assert (tmp_path / "runs.csv").read_text().startswith("trajectory,mu,t,q1,q2,p_q1,p_q2\n0,1,0,")
        table = np.loadtxt(tmp_path / "runs.csv", delimiter=",", skiprows=1)
        for j in range(3):
            rows = table[table[:, 0] == j]
            assert len(rows) == result.steps[j] // 10 + 1
            assert np.array_equal(rows[:, 3:5], result.q[: len(rows), j])
            assert set(rows[:, 1]) == {result.parameters[j, 0]}


GRID = """
[grid]
q1 = { from = 0.8, to = 1.2, count = 3 }
q2_dot = [0.9, 1.0]
mu = 1.5
"""


def model(**changes: object) -> sc.Model:
    entry = sc.Model.from_problem(sc.problem("kepler"), sc.SVI(4))
    return replace(entry, h=0.1, span=None, steps=50, save_every=10, **changes)  # type: ignore[arg-type]


class TestEnsembleFiles:
    def test_grid_is_a_product_and_the_model_supplies_the_rest(self, tmp_path):
        (tmp_path / "grid.toml").write_text(GRID)
        states = load_ensemble(tmp_path / "grid.toml", model())
        assert len(states) == 6
        assert states.q[:, 0].tolist() == [0.8, 0.8, 1.0, 1.0, 1.2, 1.2]
        assert set(states.q[:, 1]) == {model().q[1]}
        assert states.parameters.tolist() == [[1.5]] * 6
        p = states.momenta(stepper_for("kepler", sc.SVI(4)))
        assert p[:, 1].tolist() == [0.9, 1.0] * 3
        assert set(p[:, 0]) == {model().velocity[0]}  # type: ignore[index]

    def test_table_has_one_line_per_trajectory(self, tmp_path):
        (tmp_path / "table.csv").write_text("mu, p_q1,q2\n\n1.0,0.5,0.1\n 2e0 ,-0.5,0.2\n")
        states = load_ensemble(tmp_path / "table.csv", model())
        assert states.parameters[:, 0].tolist() == [1.0, 2.0]
        assert states.q.tolist() == [[model().q[0], 0.1], [model().q[0], 0.2]]
        stepper = stepper_for("kepler", sc.SVI(4))
        assert states.momenta(stepper).tolist() == [
            [0.5, model().momenta(stepper)[1]],
            [-0.5, model().momenta(stepper)[1]],
        ]

    def test_byte_order_mark_of_a_table_is_ignored(self, tmp_path):
        (tmp_path / "table.csv").write_text("q1\n0.5\n", encoding="utf-8-sig")
        assert load_ensemble(tmp_path / "table.csv", model()).q[:, 0].tolist() == [0.5]

    def test_velocities_are_transformed_with_individual_parameters(self, tmp_path):
        (tmp_path / "table.csv").write_text("q,q_dot,m\n0.1,0.5,1.0\n0.1,0.5,3.0\n")
        pendulum = sc.Model.from_problem(sc.problem("planar-pendulum"))
        states = load_ensemble(tmp_path / "table.csv", pendulum)
        p = states.momenta(stepper_for("planar-pendulum", sc.SVI(4)))
        assert p[1, 0] == 3.0 * p[0, 0]

    def test_velocities_override_momenta_of_a_model_and_vice_versa(self, tmp_path):
        stepper = stepper_for("kepler", sc.SVI(4))
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
            ("a.toml", "[grid]\nq1 = ['x']", r"\[grid\] q1 must be real numbers, not text: 'x'"),
            ("a.toml", "[grid]\nq1 = nan", r"\[grid\] q1 is nan: it must be finite"),
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
        with pytest.raises(sc.ModelFileError, match=message) as error:
            load_ensemble(tmp_path / name, model())
        assert str(error.value).startswith(str(tmp_path / name))


class TestCommandLine:
    @pytest.fixture(autouse=True)
    def elsewhere(self, here: Path) -> None:
        Path("grid.toml").write_text(GRID)

    @pytest.mark.parametrize("suffix", ["npz", "csv"])
    def test_ensemble_command_prints_a_summary_and_writes_files(self, suffix: str):
        words = f"run kepler --degree 4 --step 0.1 --steps 50 --save-every 10 --ensemble grid.toml -o runs.{suffix}"
        text = output_of(words)
        assert "6 trajectories of 50 steps of 0.1 from t = 0; 6 states saved of each" in text
        assert "\n6 ok\n" in text
        assert float(re.search(r"relative energy error: (\S+) at most, of trajectory \d", text)[1]) < 1e-3  # type: ignore[index]
        assert f"wrote runs.{suffix}" in text
        if suffix == "npz":
            with np.load("runs.npz") as file:
                assert file["q"].shape == (6, 6, 2)
        else:
            assert len(Path("runs.csv").read_text().splitlines()) == 37

    def test_failures_are_counted_and_others_saved(self):
        Path("table.csv").write_text("mu\n1\n1e9\n1.1\n")
        words = "run kepler --degree 4 --step 0.05 --steps 50 --ensemble table.csv -o runs.npz"
        text = output_of(words)
        assert re.search(r"^2 ok, 1 not \w+$", text, re.MULTILINE)
        assert re.search(
            r"^  trajectory 1: step \d+ at t = \S+ failed: .*(did not converge|NaN).*$", text, re.MULTILINE
        )
        assert Path("runs.npz").exists()

    def test_failure_of_all_trajectories_is_a_failure(self):
        Path("table.csv").write_text("mu\n1e9\n")
        words = "run kepler --degree 4 --step 0.05 --steps 50 --ensemble table.csv"
        assert "every trajectory failed" in error_of(words, status=1)

    @pytest.mark.parametrize(
        ("words", "message"),
        [
            ("kepler --ensemble none.toml", "none.toml cannot be read"),
            ("kepler --ensemble grid.toml --error 1e-6", "--error is not available with --ensemble"),
            ("kepler --ensemble grid.toml -o runs.txt", "written as .npz, .csv, .h5"),
            ("planar-pendulum --ensemble grid.toml", "'q1' is not a coordinate"),
            (
                "kepler --steps 1000000000000 --ensemble grid.toml",
                "1000000000001 states of each of 6 trajectories need 6.12e+05 GB of memory: save fewer (--save-every ",
            ),
        ],
    )
    def test_mistakes_are_usage_errors(self, words: str, message: str):
        assert message in error_of(f"run {words}")

    def test_interrupted_command_saves_completed_states(self, monkeypatch: pytest.MonkeyPatch):
        @contextmanager
        def once_some_have_begun(steps: int) -> Iterator[Callable[[int], None]]:
            yield lambda count: signal.raise_signal(signal.SIGINT) if count else None

        monkeypatch.setattr("scvi_codegen.interfaces.cli.ensembles.progress_bar", once_some_have_begun)
        words = "run kepler --degree 4 --step 0.05 --steps 10000000000 --save-every 1000000000 --ensemble grid.toml"
        result = invoke(words, "-o", "runs.npz", status=130)
        assert "0 ok, 6 interrupted" in result.stdout
        assert "the computed states were written: runs.npz" in result.stderr
        with np.load("runs.npz") as file:
            assert set(file["status"]) == {"interrupted"}
            assert file["steps"].max() > 0


@pytest.mark.rotated
@pytest.mark.filterwarnings("ignore::scvi_codegen.common.errors.AccuracyWarning")
def test_lane_with_failed_iteration_continues_as_scalar_across_breakpoints():
    """Stiff from the second piece on, where Newton's iteration alone leads on."""
    system = lagrange("stiffening", "q", "q_dot**2/2 - (1 + u)*q**2/2 - q**4/4", inputs="u")
    stepper, u = sc.compile_stepper(system, sc.SVI(2)), np.tile(VALUES**2, (COUNT, 1))
    u[4, 2:] = 4000.0
    q, p = states("pushed pendulum", COUNT)
    runs = stepper.integrate_ensemble(q, p, inputs={"u": (KNOTS, u)}, h=0.1, t_end=2.3)
    assert runs.ok.all()
    run = stepper.integrate(q[4], p[4], inputs={"u": (KNOTS, u[4])}, h=0.1, t_end=2.3)
    assert_allclose(runs.q[:, 4], run.q, rtol=0, atol=1e-11)
    assert_allclose(runs.energy()[:, 4], run.energy(), rtol=1e-10)


@pytest.mark.second
def test_files_contain_individual_times(tmp_path: Path) -> None:
    runs = CASES["adaptive"].run(save_every=5)
    runs.save(tmp_path / "e.csv")
    table = np.genfromtxt(tmp_path / "e.csv", delimiter=",", names=True)
    assert [table["t"][table["trajectory"] == j].max() for j in range(4)] == ENDS
    runs.save(tmp_path / "e.npz")
    with np.load(tmp_path / "e.npz") as file:
        assert np.array_equal(file["t"], runs.t, equal_nan=True)
    pytest.importorskip("xarray")
    dataset = runs.to_xarray()
    assert np.array_equal(dataset.time, runs.times, equal_nan=True)
    assert np.array_equal(np.isfinite(dataset.energy), np.isfinite(runs.times))


@pytest.mark.rotated
@pytest.mark.sampled(2)
@pytest.mark.usefixtures("as_users_compile")
@pytest.mark.parametrize("h", [6e-2, 1e-2, 1e-4, 2e-14])
def test_lanes_converge_as_single_runs(h: float) -> None:
    """Slowly, with steps repeated from another predictor, and at the level of rounding.

    Changes below rounding are random, and relative to a velocity near 0 they exceed any fixed level.
    """
    count, steps = 32, 64
    stepper = sc.compile_stepper(chain(4).system, "svi:2")
    generator = np.random.default_rng(1)
    q, v = generator.uniform(-1, 1, (count, 4)), generator.normal(size=(count, 4))
    p = np.array([stepper.momentum(*each) for each in zip(q, v, strict=True)])
    runs = ensemble_runs(stepper, q, p, h=h, steps=steps)
    batch = runs.batch()
    assert isinstance(batch, LaneRuns)
    batch.run(progress=None, threads=1)
    assert (batch.status == 0).all()
    for j in range(0, count, 5):
        single = stepper.integrate(q[j], p[j], h=h, steps=steps)
        np.testing.assert_allclose(runs.q[-1, j], single.q[-1], rtol=0, atol=1e-12)
        np.testing.assert_allclose(runs.p[-1, j], single.p[-1], rtol=0, atol=1e-11)


@pytest.mark.second
def test_what_an_ensemble_does_not_record_is_an_error(tmp_path: Path) -> None:
    """Neither 1.0 as the acceptance of a run that rejected steps, nor 0 as its iterations; slices and files remain."""
    system = sc.LagrangianSystem.from_text(
        "bath", ["x"], "x_dot**2/2 - x**4/4", parameters={"kT": 1.0}, temperature="kT", damping="0.5"
    )
    stepper = sc.compile_stepper(system, "svi:2")
    plan = {"h": 1.5, "steps": 40, "seed": 2**64 - 1}
    alone = stepper.integrate([1.0], velocity=[0.0], metropolis=True, **plan)
    runs = stepper.integrate_ensemble([[1.0], [2.0]], velocity=[[0.0], [0.0]], metropolis=True, **plan)
    assert alone.acceptance < 1.0
    for of in (runs, runs[0], runs[0][3:]):
        for name in ("acceptance", "bath", "iterations", "step_error", "worst_step_time"):
            with pytest.raises(sc.StateError, match=r"ensembles do not record .* stepper\.integrate"):
                getattr(of, name)
    for name in ("error", "corrected", "switches"):
        with pytest.raises(sc.StateError, match=rf"read that of one of its trajectories, runs\[0\]\.{name}"):
            getattr(runs, name)
    assert "seed" not in repr(runs[0])
    assert "not recorded" in runs[0]._repr_html_()
    runs[0].save(tmp_path / "member.npz")
    runs[0].save(tmp_path / "member.csv")
    with np.load(tmp_path / "member.npz") as file:
        assert {*file} >= {"t", "q", "p"}
        assert "iterations" not in file
    assert (tmp_path / "member.csv").read_text().startswith("t,x,p_x,x_dot,energy\n")
    np.testing.assert_array_equal(runs[0].q, alone.q)
    with pytest.raises(sc.StateError, match=r"kT, is 1e\+300 .* must be below"):
        stepper.integrate([1.0], velocity=[0.0], **plan, parameters={"kT": 1e300})
    with pytest.raises(sc.StateError, match="seed must be at most 18446744073709551615"):
        stepper.integrate([1.0], velocity=[0.0], h=0.1, steps=1, seed=2**64)
