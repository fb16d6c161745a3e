"""Ensembles on a cluster: blocks of trajectories distributed by ``dask.distributed`` (extra ``distributed``).

A stepper is sent as C source; each worker compiles it once and caches the library. Blocks are independent, so the
blocks of a lost worker are simply computed again by others.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from inspect import signature
from typing import TYPE_CHECKING, Any, cast

from scvi_codegen.api.checks import checked_count
from scvi_codegen.common.errors import StateError, closest
from scvi_codegen.runs.ensembles.result import EnsembleTrajectory

if TYPE_CHECKING:
    from scvi_codegen.api.states import Array, States
    from scvi_codegen.runs.stepper import Stepper

__all__ = ["integrate_ensemble"]

LANES = 8
BLOCKS_A_THREAD = 4
"""Blocks per worker thread; several balance the load and limit the loss when a worker dies."""
WORKER_SECONDS = 60
"""Time to wait for the first worker of a cluster, in seconds."""


def integrate_ensemble(
    stepper: Stepper,
    q: States,
    p: States | None = None,
    *,
    progress: Callable[[int], None] | None = None,
    address: str | None = None,
    blocks: int | None = None,
    **arguments: Any,
) -> EnsembleTrajectory:
    """Run ``stepper.integrate_ensemble`` on a cluster; results are bitwise equal on equal processors.

    Args:
        stepper: the stepper; each worker compiles its source again and needs this package and a C compiler.
        q, p: (k, m) initial positions and momenta.
        progress: called with the number of completed trajectories.
        address: address of a scheduler, ``"tcp://10.0.0.1:8786"``; by default a cluster of threads in this process.
        blocks: number of blocks of trajectories, by default four for each thread of the cluster.
        arguments: those of ``stepper.integrate_ensemble`` except ``threads``.

    Returns:
        An :class:`EnsembleTrajectory`, also if workers were lost during the computation.

    Raises:
        ImportError: if dask.distributed is not installed.
        StateError: if a shape, name or number is invalid; raised before anything is sent.
        BuildError: if a worker cannot compile the source.
    """
    _check_arguments(stepper, arguments)
    velocity, action = arguments.pop("velocity", None), arguments.pop("action", False)
    settings = {name: value for name, value in arguments.items() if name != "threads"}
    runs = stepper.products.ensemble_runs(q, p, settings, velocity=velocity, action=action)
    blocks = None if blocks is None else checked_count(blocks, "blocks", least=1)
    with _client(address) as client:
        count = blocks or BLOCKS_A_THREAD * sum(client.ncores().values())
        _gather(client, runs, list(_slices(len(runs.ensemble), count)), progress)
    return stepper.products.ensemble_result(runs)


def _check_arguments(stepper: Stepper, arguments: dict[str, Any]) -> None:
    """Raise ``StateError`` for arguments that ensembles, or those of a cluster, do not have."""
    accepted = signature(type(stepper).integrate_ensemble).parameters
    for name, value in arguments.items():
        if name not in accepted:
            raise StateError(f"integrate_ensemble has no argument '{name}'{closest(name, accepted)}")
        if name == "threads" and value is not None:
            raise StateError("threads= is not available on a cluster, whose workers use one thread each: omit it")
    if arguments.get("error") is not None and stepper._precise is not None:
        raise StateError(
            "error= of a stepper with precision='auto' is not available on a cluster: compile the system with "
            "precision='double' or 'double-double'"
        )


@contextmanager
def _client(address: str | None) -> Iterator[Any]:
    """Connect to the scheduler at an address, or to a local cluster of threads."""
    try:
        import distributed
    except ImportError as error:
        raise ImportError(
            "ensembles on a cluster require dask.distributed: pip install 'scvi-codegen[distributed]'"
        ) from error
    if address is None:
        with (
            distributed.LocalCluster(n_workers=1, processes=False, dashboard_address="127.0.0.1:0") as cluster,
            distributed.Client(cluster) as client,
        ):
            yield client
    else:
        with distributed.Client(address) as client:
            client.wait_for_workers(1, timeout=WORKER_SECONDS)
            yield client


def _slices(count: int, blocks: int) -> Iterator[slice]:
    """Divide ``count`` trajectories into about ``blocks`` slices, multiples of the SIMD width in size."""
    size = -(-count // (blocks * LANES)) * LANES
    for first in range(0, count, size):
        yield slice(first, min(first + size, count))


def _gather(client: Any, runs: Any, parts: list[slice], progress: Callable[[int], None] | None) -> None:
    """Submit the slices and store their results."""
    from distributed import as_completed

    ensemble, done = runs.ensemble, 0
    pickled, futures = pickle.dumps(ensemble.stepper), dict[Any, slice]()
    for part in parts:
        arguments = ensemble.q[part], ensemble.p[part], ensemble.settings_of(part)
        futures[client.submit(_integrate, pickled, arguments, pure=False)] = part
    try:
        for future, trajectories in as_completed(futures, with_results=True):
            part = futures[future]
            runs.keep(part, trajectories)
            future.release()
            done += part.stop - part.start
            if progress is not None:
                progress(done)
    finally:
        client.cancel(list(futures))


def _integrate(pickled: bytes, arguments: tuple[Array, Array, Any]) -> EnsembleTrajectory:
    """Integrate one slice on a single worker thread; return its results without stepper and functions."""
    runs = _stepper(pickled).products.ensemble_runs(*arguments)
    runs.run(threads=1)
    return replace(runs.result(), stepper=cast(Any, None), spans=())


@lru_cache(maxsize=16)
def _stepper(pickled: bytes) -> Stepper:
    """Unpickle the stepper, compiled or loaded from the cache of this worker."""
    stepper: Stepper = pickle.loads(pickled)
    return stepper
