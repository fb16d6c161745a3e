"""Execution of experiments in turn or in parallel processes; one that fails does not stop the others.

Experiments that judge the results of others run after all others, in this process.
"""

import importlib
import multiprocessing
import os
import signal
import sys
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any, TypeAlias

from scvi_codegen.api.runs import without_accuracy_warnings
from scvi_codegen.common.errors import MethodWarning, StateError, closest
from scvi_codegen.extras.paper.experiment import Experiment, Result

CATALOGUE = "scvi_codegen.extras.paper.catalogue"
PATIENCE = 10.0
"""Seconds to wait for a process to end by itself."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Failure:
    """Experiment without a result.

    Attributes:
        name: name of the experiment.
        message: what went wrong, one line.
    """

    name: str
    message: str


Outcome: TypeAlias = Result | Failure
Watch: TypeAlias = Callable[[Sequence[str]], None]


def catalogue(module: str = CATALOGUE) -> Mapping[str, Experiment]:
    """Return the experiments by name: ``EXPERIMENTS`` of a module."""
    experiments: Mapping[str, Experiment] = importlib.import_module(module).EXPERIMENTS
    return experiments


def with_needs(names: Sequence[str], experiments: Mapping[str, Experiment]) -> list[str]:
    """Return the experiments and their dependencies in topological order; StateError for an unknown name."""
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
    ordered = [experiments[name] for name in with_needs(names, experiments)]
    count = min(workers or os.cpu_count() or 1, len(ordered))
    return _run(ordered, count, module, watch)


def _run(experiments: Sequence[Experiment], count: int, module: str, watch: Watch) -> Generator[Outcome, None, None]:
    results = dict[str, Result]()
    independent = [experiment for experiment in experiments if not experiment.needs]
    dependent = [experiment for experiment in experiments if experiment.needs]
    first = _in_processes(independent, count, module, watch) if count > 1 else _in_this_process(independent, {}, watch)
    for outcomes in (first, _in_this_process(dependent, results, watch)):
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
    return Failure(name=name, message=message)


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


def _work(connection: Connection, module: str, name: str) -> None:
    """Run an experiment in a process of its own and send the outcome; the parent handles Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    outcome = _outcome(catalogue(module)[name], {})
    with suppress(OSError):  # the parent is gone
        try:
            connection.send(outcome)
        except OSError:
            raise
        except Exception as error:  # noqa: BLE001  (results that cannot be pickled)
            connection.send(_failure(name, error))


def _in_processes(
    experiments: Sequence[Experiment], count: int, module: str, watch: Watch
) -> Generator[Outcome, None, None]:
    """Run each experiment in a process of its own, at most ``count`` at a time."""
    context, pending = multiprocessing.get_context("spawn"), deque(experiment.name for experiment in experiments)
    running = dict[Any, tuple[str, SpawnProcess]]()
    try:
        while pending or running:
            while pending and len(running) < count:
                connection, there = context.Pipe(duplex=False)
                process = context.Process(target=_work, args=(there, module, name := pending.popleft()), daemon=True)
                with _sigint_blocked():
                    process.start()
                there.close()
                running[connection] = name, process
            watch([name for name, _ in running.values()])
            for ended in wait(list(running)):
                yield _received(ended, *running.pop(ended))
        watch([])
    finally:
        for connection, (_, process) in running.items():
            process.kill()
            process.join()
            connection.close()


def _received(connection: Any, name: str, process: SpawnProcess) -> Outcome:
    """Return the outcome that a process sent, or the failure that it died."""
    outcome: Outcome | None = None
    with connection, suppress(EOFError, OSError):
        outcome = connection.recv()
    process.join(PATIENCE)
    return outcome or Failure(name=name, message=f"its process ended with exit status {process.exitcode}")
