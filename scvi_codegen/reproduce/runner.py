"""Execution of experiments in turn or in parallel processes; one that fails does not stop the others.

Experiments that judge the results of others run after all others, in this process.
"""

import importlib
import multiprocessing
import os
import signal
import sys
import traceback
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import TypeAlias

from scvi_codegen.errors import MethodWarning, StateError, closest
from scvi_codegen.reproduce.experiment import Experiment, Result
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
    chosen = [experiments[name] for name in with_needs(names, experiments)]
    count = min(workers or os.cpu_count() or 1, len(chosen))
    return _run(chosen, count, module, watch)


def _run(chosen: Sequence[Experiment], count: int, module: str, watch: Watch) -> Generator[Outcome, None, None]:
    results, alone = dict[str, Result](), [each for each in chosen if not each.needs]
    first = _in_processes(alone, count, module, watch) if count > 1 else _in_this_process(alone, {}, watch)
    for outcomes in (first, _in_this_process([each for each in chosen if each.needs], results, watch)):
        with closing(outcomes):
            for outcome in outcomes:
                if isinstance(outcome, Result):
                    results[outcome.name] = outcome
                yield outcome


@without_accuracy_warnings()
def _outcome(experiment: Experiment, needs: Mapping[str, Result]) -> Outcome:
    """Run one experiment; convert any error into a failure."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", MethodWarning)  # settings are the paper's
            return experiment.result(needs)
    except Exception as error:  # noqa: BLE001  (others go on)
        return _failure(experiment.name, error)


def _failure(name: str, error: BaseException) -> Failure:
    message = " ".join(f"{type(error).__name__}: {error}".split())
    return Failure(name=name, message=message, details=traceback.format_exc())


def _in_this_process(
    experiments: Sequence[Experiment], results: Mapping[str, Result], watch: Watch
) -> Generator[Outcome, None, None]:
    for experiment in experiments:
        watch([experiment.name])
        failed = [need for need in experiment.needs if need not in results]
        if failed:
            yield Failure(name=experiment.name, message=f"its dependency '{failed[0]}' failed")
        else:
            yield _outcome(experiment, {need: results[need] for need in experiment.needs})
    watch([])


class _Worker:
    """Process that runs experiments by name, and the name of the one that it runs."""

    def __init__(self, module: str) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, there = context.Pipe()
        self.process, self.running = context.Process(target=_work, args=(there, module), daemon=True), ""
        with _sigint_blocked():
            self.process.start()
        there.close()

    def give(self, name: str) -> None:
        self.running = name
        with suppress(OSError):  # the process died; take reports it
            self.connection.send(name)

    def take(self) -> Outcome:
        """Return the outcome that the process sent, or the failure that it died."""
        name, self.running = self.running, ""
        try:
            outcome: Outcome = self.connection.recv()
        except (EOFError, OSError):
            self.process.join(PATIENCE)
            return Failure(name=name, message=f"its process ended with exit status {self.process.exitcode}")
        return outcome


@contextmanager
def _sigint_blocked() -> Iterator[None]:
    """Block SIGINT, also for processes started meanwhile, which inherit the mask: Ctrl-C does not end their imports."""
    if sys.platform == "win32":
        yield
        return
    resource_tracker.ensure_running()  # its own start unblocks SIGINT
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _work(connection: Connection, module: str) -> None:
    """Serve a process: receive names, send outcomes. Ctrl-C is handled by the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    experiments = catalogue(module)
    with suppress(EOFError, OSError):  # the parent is gone
        while True:
            name = connection.recv()
            outcome = _outcome(experiments[name], {})
            try:
                connection.send(outcome)
            except OSError:
                raise
            except Exception as error:  # noqa: BLE001  (results that cannot be pickled)
                connection.send(_failure(name, error))


def _in_processes(
    experiments: Sequence[Experiment], count: int, module: str, watch: Watch
) -> Generator[Outcome, None, None]:
    pending = deque(each.name for each in experiments)
    with _crew(count, module) as crew:
        while True:
            for worker in crew:
                if pending and not worker.running:
                    worker.give(pending.popleft())
            busy = {worker.connection: worker for worker in crew if worker.running}
            watch([worker.running for worker in busy.values()])
            if not busy:
                return
            for connection in wait(list(busy)):
                worker = busy[connection]  # type: ignore[index]  # these are the connections waited for
                outcome = worker.take()
                if not worker.process.is_alive():
                    crew[crew.index(worker)] = _Worker(module)
                yield outcome


@contextmanager
def _crew(count: int, module: str) -> Iterator[list[_Worker]]:
    crew = [_Worker(module) for _ in range(count)]
    try:
        yield crew
    finally:
        for worker in crew:
            worker.process.terminate()
        for worker in crew:
            worker.process.join(PATIENCE)
            worker.connection.close()
