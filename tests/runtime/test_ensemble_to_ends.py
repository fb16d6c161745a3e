"""Ensembles with adaptive steps: each trajectory has its own steps and its own end."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from scvi_codegen.cli import main
from scvi_codegen.errors import StateError
from scvi_codegen.methods import SVI
from scvi_codegen.runtime.ensemble.result import EnsembleTrajectory

ECCENTRICITIES = np.array([0.0, 0.3, 0.6, 0.9])
Q = np.column_stack([1.0 - ECCENTRICITIES, np.zeros(4)])
P = np.column_stack([np.zeros(4), np.sqrt((1.0 + ECCENTRICITIES) / (1.0 - ECCENTRICITIES))])
ENDS = [5.0, 10.0, 20.0, 15.0]
TOLERANCE = 1e-10


@pytest.fixture(scope="session")
def kepler(compiled):
    return compiled("kepler", SVI(4))


def alone(kepler, j, **settings):
    return kepler.integrate(Q[j], P[j], t_end=ENDS[j], tolerance=TOLERANCE, **settings)


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("save_every", [1, 7])
def test_each_trajectory_equals_the_single_run(kepler, threads, save_every):
    runs = kepler.integrate_ensemble(Q, P, t_end=ENDS, tolerance=TOLERANCE, save_every=save_every, threads=threads)
    assert runs.ok.all()
    for j, (t, q, p, status, steps) in enumerate(runs.each()):
        run = alone(kepler, j, save_every=save_every)
        assert (status, steps) == ("ok", run.steps)
        assert np.array_equal(t, run.t)
        assert np.array_equal(q, run.q)
        assert np.array_equal(p, run.p)
    t, q, _ = runs.ends
    assert t.tolist() == ENDS
    assert np.array_equal(q[2], alone(kepler, 2).q[-1])
    energy = runs.energy()
    assert np.nanmax(np.abs(energy - energy[0])) < 1e-6
    assert np.isnan(energy).sum() == np.isnan(runs.times).sum() > 0
    assert np.nanmax(np.abs(runs.momentum_errors())) < 1e-12


@pytest.mark.parametrize("threads", [1, 2])
def test_fixed_steps_end_at_t_end_with_a_shorter_step(kepler, threads):
    for h, t_end in ((0.03, 0.1), (-0.03, -0.1), (0.25, 0.1)):
        runs = kepler.integrate_ensemble(Q, P, h=h, t_end=t_end, save_every=2, threads=threads)
        for j in range(len(Q)):
            run = kepler.integrate(Q[j], P[j], h=h, t_end=t_end)
            assert runs.t[-1] == t_end == run.t[-1]
            assert (runs.status[j], runs.steps[j]) == ("ok", run.steps)
            assert np.abs(runs.q[-1, j] - run.q[-1]).max() < 1e-15
            assert np.abs(runs.p[-1, j] - run.p[-1]).max() < 1e-15


def test_states_at_common_times_end_with_each_trajectory(kepler):
    times = np.linspace(0.0, 20.0, 9)
    runs = kepler.integrate_ensemble(Q, P, t_end=ENDS, tolerance=TOLERANCE, t_eval=times)
    assert runs.times is None
    assert np.array_equal(runs.t, times)
    for j, end in enumerate(ENDS):
        assert np.array_equal(np.isfinite(runs.q[:, j, 0]), times <= end)
        assert np.array_equal(runs.q[times <= end, j], alone(kepler, j, t_eval=times[times <= end]).q)


def test_backward_in_time_with_individual_parameters(kepler):
    runs = kepler.integrate_ensemble(Q[:2], P[:2], t_end=-3.0, tolerance=TOLERANCE, parameters={"mu": [1.0, 1.2]})
    run = kepler.integrate(Q[1], P[1], t_end=-3.0, tolerance=TOLERANCE, parameters={"mu": 1.2})
    assert np.array_equal(runs.ends[1][1], run.q[-1])


def test_failed_trajectory_does_not_affect_the_others(kepler):
    p = P.copy()
    p[1] = 0.0  # falls into the centre
    runs = kepler.integrate_ensemble(Q, p, t_end=ENDS, tolerance=TOLERANCE)
    assert runs.ok.tolist() == [True, False, True, True]
    assert 0.0 < runs.ends[0][1] < 1.0
    assert runs.status[1] not in ("ok", "interrupted")
    assert np.array_equal(runs.ends[1][3], alone(kepler, 3).q[-1])


def test_interrupt_returns_completed_states(kepler):
    class Enough(Exception):  # noqa: N818
        pass

    from scvi_codegen.runtime.ensemble.ensemble import Ensemble

    work = Ensemble(kepler, Q, P, t_end=[5.0, 5.0, 5.0, 1e7], tolerance=TOLERANCE)

    def stop(done: int) -> None:
        if done:
            raise Enough

    with pytest.raises(Enough):
        work.run(progress=stop, threads=1)
    status = work.result().status.tolist()
    assert status[0] == "ok"
    assert status[3] == "interrupted"


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({}, "give either h with steps or t_end"),
        ({"h": 0.1, "steps": 3, "t_end": 1.0}, "give either steps=3 or t_end with h"),
        ({"h": 0.1, "t_end": -1.0}, "h = 0.1 has the wrong sign"),
        ({"h": 0.1, "t_end": [1.0, 2.0, 3.0, 4.0]}, "with h all trajectories have one t_end"),
        ({"h": 0.1, "t_end": 1.0, "t_eval": [0.5]}, "t_eval requires adaptive steps"),
        ({"h": 0.1, "steps": 3, "tolerance": 1e-9}, "tolerance requires adaptive steps"),
        ({"t_end": [1.0, 2.0]}, "one time or 4"),
        ({"t_end": [1.0, 2.0, -1.0, 3.0]}, "split the ensemble"),
        ({"t_end": 1.0, "tolerance": 2.0}, "must be positive and below 1"),
        ({"t_end": 1.0, "t_eval": [0.5, 1.5]}, "outside"),
        ({"t_end": 1.0, "t_eval": [0.5], "save_every": 2}, "not both"),
    ],
)
def test_invalid_argument_is_named(kepler, settings, words):
    with pytest.raises(StateError, match=words):
        kepler.integrate_ensemble(Q, P, **settings)


def test_ensemble_to_end_times_over_a_cluster(kepler):
    pytest.importorskip("distributed")
    from scvi_codegen.runtime.distributed import integrate_ensemble

    q, p, ends = np.tile(Q, (4, 1)), np.tile(P, (4, 1)), np.tile(ENDS, 4)
    here = kepler.integrate_ensemble(q, p, t_end=ends, tolerance=TOLERANCE)
    there = integrate_ensemble(kepler, q, p, t_end=ends, tolerance=TOLERANCE, blocks=2)
    for name in ("times", "q", "p", "steps"):
        assert np.array_equal(getattr(here, name), getattr(there, name), equal_nan=True)


def test_files_contain_individual_times(kepler, tmp_path):
    runs = kepler.integrate_ensemble(Q, P, t_end=ENDS, tolerance=TOLERANCE, save_every=5)
    runs.save(tmp_path / "e.csv")
    table = np.genfromtxt(tmp_path / "e.csv", delimiter=",", names=True)
    assert [table["t"][table["trajectory"] == j].max() for j in range(4)] == ENDS
    runs.save(tmp_path / "e.npz")
    with np.load(tmp_path / "e.npz") as file:
        assert np.array_equal(file["times"], runs.times, equal_nan=True)
    pytest.importorskip("xarray")
    dataset = runs.to_xarray()
    assert np.array_equal(dataset.time, runs.times, equal_nan=True)
    assert np.array_equal(np.isfinite(dataset.energy), np.isfinite(runs.times))


def test_command_line_runs_a_grid(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("k.toml").write_text(
        '[system]\ncatalogue = "kepler"\n[method]\nmethod = "svi"\ndegree = 4\n[run]\ntolerance = 1e-9\nspan = 9\n'
    )
    Path("grid.toml").write_text("[grid]\nq1 = [0.5, 0.7]\nmu = [1.0, 1.1]\n")
    done = CliRunner().invoke(main, ["run", "k.toml", "--ensemble", "grid.toml", "-o", "grid.npz"])
    assert done.exit_code == 0, done.output
    assert "adaptive steps from t = 0 to t = 9" in done.output
    assert "4 ok" in done.output
    with np.load("grid.npz") as file:
        assert (np.nanmax(file["times"], axis=0) == 9.0).all()


def test_result_names_its_target_times(kepler):
    runs = kepler.integrate_ensemble(Q, P, t_end=ENDS, tolerance=TOLERANCE)
    assert isinstance(runs, EnsembleTrajectory)
    assert [plan.t_end for plan in runs.plans] == ENDS
    assert runs.h == 0.0
