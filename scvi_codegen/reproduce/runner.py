"""Execution of experiments in turn or in parallel processes; one that fails does not stop the others.

The scheduler assigns to a free process an experiment whose dependencies are complete, preferably of the module that
the process ran last: measurements that experiments of a module share are cached within a process.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import signal
import traceback
import warnings
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import TypeAlias

from scvi_codegen.errors import MethodWarning, StateError, closest
from scvi_codegen.reproduce.laboratory.experiment import Experiment, Result
from scvi_codegen.runtime.run.accuracy import without_accuracy_warnings

CATALOGUE = "scvi_codegen.reproduce.catalogue"
PATIENCE = 2.0
"""Seconds to wait for a process to end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Failure:
    """Experiment without a result.

    Attributes:
        name: name of the experiment.
        message: what went wrong, one line.
        details: traceback, or ``""``.
    """

    name: str
    message: str
    details: str = ""


Outcome: TypeAlias = Result | Failure
Watch: TypeAlias = Callable[[Sequence[str]], None]


def catalogue(module: str = CATALOGUE) -> Mapping[str, Experiment]:
    """Return the experiments by name: ``EXPERIMENTS`` of a module."""
    experiments: Mapping[str, Experiment] = importlib.import_module(module).EXPERIMENTS
    return experiments


def with_needs(names: Sequence[str], experiments: Mapping[str, Experiment]) -> list[str]:
    """Return the experiments called ``names`` and their dependencies, in topological order.

    Raises:
        StateError: for a name that is not among the experiments.
    """
    ordered: dict[str, None] = {}

    def add(name: str) -> None:
        if name not in experiments:
            raise StateError(f"there is no experiment called '{name}'{closest(name, experiments)}")
        if name not in ordered:
            for need in experiments[name].needs:
                add(need)
            ordered[name] = None

    for name in names:
        add(name)
    return list(ordered)


def run_experiments(
    names: Sequence[str], workers: int | None = None, *, module: str = CATALOGUE, watch: Watch = lambda names: None
) -> Generator[Outcome, None, None]:
    """Run experiments and their dependencies; yield each outcome as soon as it is complete.

    Experiments that depend on a failed one fail too. Closing or interrupting the generator ends all processes.

    Args:
        names: names of experiments.
        workers: number of processes, by default that of processors; with one, everything runs in this process.
        module: module with ``EXPERIMENTS``; processes import it by this name.
        watch: called with the names of the running experiments whenever they change.

    Raises:
        StateError: for an unknown name.
    """
    experiments = catalogue(module)
    plan = _Plan(pending={name: experiments[name] for name in with_needs(names, experiments)})
    count = min(workers or os.cpu_count() or 1, len(plan.pending))
    return _in_this_process(plan, watch) if count <= 1 else _in_processes(plan, count, module, watch)


@dataclass(kw_only=True)
class _Plan:
    """Experiments to start, and results so far."""

    pending: dict[str, Experiment]
    results: dict[str, Result] = field(default_factory=dict)

    def next(self, last_module: str = "") -> Experiment | None:
        """Remove and return an experiment whose dependencies are complete, of the module last run if possible."""
        ready = [e for e in self.pending.values() if all(need in self.results for need in e.needs)]
        ready.sort(key=lambda experiment: _module_of(experiment) != last_module)
        return self.pending.pop(ready[0].name) if ready else None

    def needs(self, experiment: Experiment) -> dict[str, Result]:
        return {need: self.results[need] for need in experiment.needs}

    def record_outcome(self, outcome: Outcome) -> Iterator[Outcome]:
        """Yield the outcome, and the failures of the experiments that depend on it."""
        yield outcome
        if isinstance(outcome, Result):
            self.results[outcome.name] = outcome
            return
        for experiment in [e for e in self.pending.values() if outcome.name in e.needs]:
            if self.pending.pop(experiment.name, None):
                yield from self.record_outcome(
                    Failure(name=experiment.name, message=f"its dependency '{outcome.name}' failed")
                )


def _module_of(experiment: Experiment) -> str:
    run = getattr(experiment.run, "func", experiment.run)
    return getattr(run, "__module__", "")


@without_accuracy_warnings()
def _outcome(experiment: Experiment, needs: Mapping[str, Result]) -> Outcome:
    """Run one experiment; convert any error into a failure."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MethodWarning)  # settings are the paper's
            return experiment.result(needs)
    except Exception as error:  # noqa: BLE001  (others go on)
        return Failure(name=experiment.name, message=_described(error), details=traceback.format_exc())


def _described(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())


def _in_this_process(plan: _Plan, watch: Watch) -> Generator[Outcome, None, None]:
    while (experiment := plan.next()) is not None:
        watch([experiment.name])
        yield from plan.record_outcome(_outcome(experiment, plan.needs(experiment)))


@dataclass(kw_only=True)
class _Worker:
    """Process that runs experiments by name, and the experiment that it runs."""

    process: SpawnProcess
    connection: Connection
    module: str = ""
    running: str = ""

    @classmethod
    def start(cls, module: str) -> _Worker:
        context = multiprocessing.get_context("spawn")
        here, there = context.Pipe()
        process = context.Process(target=_work, args=(there, module), daemon=True)
        process.start()
        there.close()
        return cls(process=process, connection=here)

    def give(self, experiment: Experiment, needs: Mapping[str, Result]) -> None:
        self.module, self.running = _module_of(experiment), experiment.name
        with suppress(OSError):  # the process died; take reports it
            self.connection.send((experiment.name, needs))

    def take(self) -> Outcome:
        """Return the outcome that the process sent, or the failure that it died."""
        name, self.running = self.running, ""
        try:
            outcome: Outcome = self.connection.recv()
        except (EOFError, OSError):
            self.process.join(PATIENCE)
            return Failure(name=name, message=f"its process ended with exit status {self.process.exitcode}")
        return outcome


def _work(connection: Connection, module: str) -> None:
    """Serve a process: receive names, send outcomes. Ctrl-C is handled by the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    experiments = catalogue(module)
    while True:
        try:
            name, needs = connection.recv()
        except (EOFError, OSError):
            return
        outcome = _outcome(experiments[name], needs)
        try:
            connection.send(outcome)
        except OSError:  # the parent is gone
            return
        except Exception as error:  # noqa: BLE001  (results that cannot be pickled)
            connection.send(Failure(name=name, message=_described(error), details=traceback.format_exc()))


def _in_processes(plan: _Plan, count: int, module: str, watch: Watch) -> Generator[Outcome, None, None]:
    with _crew(count, module) as crew:
        while True:
            _assign(plan, crew, watch)
            busy = {worker.connection: worker for worker in crew if worker.running}
            if not busy:
                return
            for connection in wait(list(busy)):
                worker = busy[connection]  # type: ignore[index]  # these are the connections waited for
                outcome = worker.take()
                if not worker.process.is_alive():
                    crew[crew.index(worker)] = _Worker.start(module)
                yield from plan.record_outcome(outcome)


def _assign(plan: _Plan, crew: Sequence[_Worker], watch: Watch) -> None:
    """Start experiments on all idle processes."""
    for worker in crew:
        if not worker.running and (experiment := plan.next(worker.module)) is not None:
            worker.give(experiment, plan.needs(experiment))
    watch([worker.running for worker in crew if worker.running])


@contextmanager
def _crew(count: int, module: str) -> Iterator[list[_Worker]]:
    crew = [_Worker.start(module) for _ in range(count)]
    try:
        yield crew
    finally:
        for worker in crew:
            worker.process.terminate()
        for worker in crew:
            worker.process.join(PATIENCE)
            worker.connection.close()
