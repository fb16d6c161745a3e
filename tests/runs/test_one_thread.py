"""A run belongs to one thread: a second one is refused while the first is in C, and nothing is lost of the first."""

from __future__ import annotations

import copy
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from notation import lagrange
from samples import QUICK_FLAGS

import scvi_codegen as sc

PENDULUM = "q_dot**2/2 + cos(q)"


@pytest.fixture(scope="module")
def stepper() -> sc.Stepper:
    system = sc.LagrangianSystem.from_text(name="pendulum", coordinates=["q"], lagrangian=PENDULUM)
    return sc.compile_stepper(system, "svi:2", flags=QUICK_FLAGS)


@pytest.fixture(scope="module")
def arrays() -> sc.Stepper:
    system = lagrange("pendulums", "q[N]", "sum(i in N, q_dot[i]**2/2 + cos(q[i]))")
    return sc.compile_stepper(system, "svi:2", flags=QUICK_FLAGS)


class Holder:
    """A second thread that holds a run until the test has tried to enter it."""

    def __init__(self, run: Any, hold: Callable[[Callable[[], None]], Any]) -> None:
        self.inside, self.leave, self.run = threading.Event(), threading.Event(), run
        self.failed: list[sc.ScviCodegenError] = []
        self.thread = threading.Thread(target=self._work, args=(hold,))

    def _work(self, hold: Callable[[Callable[[], None]], Any]) -> None:
        try:
            hold(self._wait)
        except sc.ScviCodegenError as error:
            self.failed.append(error)
            self.inside.set()

    def _wait(self) -> None:
        self.inside.set()
        assert self.leave.wait(30.0)

    def __enter__(self) -> Holder:
        self.thread.start()
        assert self.inside.wait(30.0)
        return self

    def __exit__(self, *_: object) -> None:
        self.leave.set()
        self.thread.join()
        assert self.failed == []


def entries(run: Any) -> dict[str, Callable[[], Any]]:
    """Return the calls that a second thread may attempt, by name."""
    found = {
        "advance": lambda: run.advance(1),
        "update": lambda: run.update(h=0.2),
        "set_inputs": lambda: run.set_inputs(),
        "checkpoint": lambda: run.checkpoint(),
        "copy": lambda: copy.copy(run),
    }
    return found | ({"record": lambda: run.record(1)} if hasattr(run, "record") else {})


def check_refused(run: Any) -> None:
    for enter in entries(run).values():
        with pytest.raises(sc.StateError, match=r"in use by another thread.*Start a run for each thread"):
            enter()


@pytest.mark.second
def test_recorded_scalar_run_belongs_to_one_thread(stepper: sc.Stepper) -> None:
    run = stepper.start([1.0], [0.0], h=0.1)
    with Holder(run, lambda wait: run.record(10, progress=lambda _: wait())):
        check_refused(run)
    assert run.steps == 10
    for enter in entries(run).values():  # afterwards it is free
        enter()


@pytest.mark.second
def test_advancing_array_run_belongs_to_one_thread(arrays: sc.Stepper) -> None:
    run = arrays.start([1.0, 0.5], h=0.1)
    with Holder(run, lambda wait: run.advance(1, progress=lambda _: wait())):
        check_refused(run)
    assert run.steps == 1
    for enter in entries(run).values():
        enter()


@pytest.mark.rotated
def test_run_recorded_into_a_folder_belongs_to_one_thread(stepper: sc.Stepper, tmp_path: Any) -> None:
    run = stepper.start([1.0], [0.0], h=0.1)
    with Holder(run, lambda wait: sc.record_run(run, tmp_path / "run", steps=10, progress=lambda _: wait())):
        check_refused(run)
    assert len(sc.load_run(tmp_path / "run")) == 11


def test_owner_thread_may_reenter_a_run(stepper: sc.Stepper) -> None:
    run, saved = stepper.start([1.0], [0.0], h=0.1), []
    run.record(5, progress=lambda _: saved.append(run.checkpoint()))
    assert saved[-1] == run.checkpoint()


@pytest.mark.rotated
@pytest.mark.parametrize("kind", ["scalar", "arrays"])
def test_steps_of_racing_threads_are_all_counted(kind: str, stepper: sc.Stepper, arrays: sc.Stepper) -> None:
    """A thread either makes its steps or is refused."""
    run: Any = stepper.start([1.0], [0.0], h=0.1) if kind == "scalar" else arrays.start([1.0, 0.5], h=0.1)
    made, size = [], 2000
    barrier = threading.Barrier(4)

    def work() -> None:
        barrier.wait()
        for _ in range(20):
            try:
                run.advance(size)
                made.append(size)
            except sc.StateError:
                pass

    threads = [threading.Thread(target=work) for _ in range(4)]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    assert run.steps == sum(made)
    assert np.isfinite(run.t)
