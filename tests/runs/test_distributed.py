"""Ensembles over a cluster equal those of one machine, also when a worker is killed on the way."""

import os
import signal
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen.extras.distributed.blocks import _slices, integrate_ensemble

COUNT = 70


@pytest.fixture(scope="module")
def kepler() -> sc.Stepper:
    return sc.compile_stepper(sc.problem("kepler").system, sc.SVI(5), flags=QUICK_FLAGS)


def states() -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(1)
    q = np.array([1.0, 0.0]) + 0.1 * generator.uniform(-1, 1, (COUNT, 2))
    return q, np.array([0.0, 1.1]) + 0.1 * generator.uniform(-1, 1, (COUNT, 2))


@pytest.fixture(scope="module")
def distributed() -> Any:
    with warnings.catch_warnings(action="ignore"):
        return pytest.importorskip("distributed", reason="needs the extra 'distributed'")


@pytest.fixture(scope="module")
def cluster(distributed: Any) -> Iterator[Any]:
    """Two worker processes of one thread."""
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0", silence_logs=50
    ) as cluster:
        yield cluster


def test_parts_are_multiples_of_the_register_width():
    for count, blocks in ((70, 4), (70, 100), (1, 3), (64, 8), (1000, 3)):
        parts = list(_slices(count, blocks))
        assert len(parts) <= blocks
        assert [j for part in parts for j in range(count)[part]] == list(range(count))
        assert all((part.stop - part.start) % 8 == 0 for part in parts[:-1])


@pytest.mark.second
class TestCluster:
    @pytest.mark.second
    def test_invalid_arguments_are_reported_before_distribution(self, kepler: sc.Stepper):
        q, p = states()
        for faults in ({"h": 0.0}, {"steps": -1}, {"blocks": 0}, {"parameters": {"nu": 1.0}}):
            with pytest.raises(sc.StateError):
                integrate_ensemble(kepler, q, p, **({"h": 0.1, "steps": 1} | faults))  # type: ignore[arg-type]

    @pytest.mark.rotated
    def test_failures_of_trajectories_are_returned(self, distributed: Any, cluster: Any, kepler: sc.Stepper):
        q, p = states()
        mu = np.where(np.arange(COUNT) == 5, 1e9, 1.0)  # the sixth falls into the centre
        done: list[int] = []
        way = {"address": cluster.scheduler_address, "blocks": 3, "progress": done.append}
        result = integrate_ensemble(kepler, q, p, h=0.05, steps=50, parameters={"mu": mu}, **way)
        assert done[-1] == COUNT
        assert np.flatnonzero(~result.ok).tolist() == [5]
        assert result.steps[5] < 50

    @pytest.mark.rotated
    def test_streams_of_noise_are_those_of_the_trajectories(self, distributed: Any, cluster: Any):
        """In SIMD lanes, with an odd start of a slice, and as inputs of a bath."""
        warm = sc.LagrangianSystem.from_text(
            *("warm", ["x"], "x_dot**2/2 - x**4/4"), forces={"x": "u"}, inputs=["u"], damping=1, temperature=1
        )
        stepper = sc.compile_stepper(warm, "stoermer-verlet", flags=QUICK_FLAGS)
        assert stepper.ensemble is not None
        q = states()[0][:, :1]
        settings: dict[str, Any] = {"h": 0.1, "steps": 20, "inputs": {"u": sc.ColouredNoise(1.0, 0.5)}, "seed": 3}
        runs = stepper.integrate_ensemble(q, 0 * q, **settings)
        away = integrate_ensemble(stepper, q, 0 * q, **settings, address=cluster.scheduler_address, blocks=3)
        assert (away.q == runs.q).all()
        assert (runs.q[:, 0] == stepper.integrate(q[0], [0.0], **settings).q).all()

    @pytest.mark.rotated
    def test_killed_worker_loses_nothing(self, distributed: Any, cluster: Any, kepler: sc.Stepper):
        q, p = states()
        arguments = {"h": 0.05, "steps": 15_000, "save_every": 5_000}
        here = kepler.integrate_ensemble(q, p, **arguments)
        pids = [worker.pid for worker in cluster.workers.values()]
        killed: list[int] = []

        def kill_one(done: int) -> None:
            if not killed:
                killed.append(done)
                os.kill(pids[0], signal.SIGKILL)

        result = integrate_ensemble(
            kepler, q, p, **arguments, address=cluster.scheduler_address, blocks=9, progress=kill_one
        )
        assert 0 < killed[0] < COUNT
        assert result.ok.all()
        assert np.array_equal(result.q, here.q)
        assert np.array_equal(result.p, here.p)

    @pytest.mark.rotated
    def test_worker_compiles_the_source_into_its_cache(self, distributed: Any, kepler: sc.Stepper, tmp_path: Path):
        q, p = states()
        with distributed.LocalCluster(
            n_workers=1,
            processes=True,
            dashboard_address=":0",
            silence_logs=50,
            env={"SCVI_CODEGEN_CACHE": str(tmp_path)},
        ) as cluster:
            result = integrate_ensemble(kepler, q, p, h=0.05, steps=20, address=cluster.scheduler_address)
        assert np.array_equal(result.q, kepler.integrate_ensemble(q, p, h=0.05, steps=20).q)
        assert any(tmp_path.iterdir())

    @pytest.mark.rotated
    def test_interrupt_cancels_remaining_parts(self, distributed: Any, cluster: Any, kepler: sc.Stepper):
        def interrupt(done: int) -> None:
            raise KeyboardInterrupt

        q, p = states()
        with pytest.raises(KeyboardInterrupt):
            integrate_ensemble(
                kepler, q, p, h=0.05, steps=10_000, address=cluster.scheduler_address, blocks=9, progress=interrupt
            )
        with distributed.Client(cluster.scheduler_address) as client:
            end = time.monotonic() + 600.0
            while any(client.processing().values()) and time.monotonic() < end:
                time.sleep(0.05)
            assert not any(client.processing().values())
