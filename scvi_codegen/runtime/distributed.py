"""Ensembles past one machine: blocks of trajectories over a ``dask.distributed`` cluster (extra ``distributed``).

A stepper travels as source text; each worker compiles it once and keeps it in its cache. Blocks know nothing of each
other, so a worker that dies costs no more than the blocks it had, which others do again.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.counts import checked_count
from scvi_codegen.runtime.ensemble import Ensemble, EnsembleParameters
from scvi_codegen.runtime.ensemble_trajectory import EnsembleTrajectory

if TYPE_CHECKING:
    from scvi_codegen.native.options import SolverOptions
    from scvi_codegen.runtime.stepper import Stepper

__all__ = ["integrate_ensemble"]

Part = tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.str_], NDArray[np.int64]]

LANES = 8
BLOCKS_A_THREAD = 4
"""More than one, so that fast workers help slow ones out and a lost one loses little."""
WORKER_SECONDS = 60
"""How long to wait for the first worker of a cluster."""


def integrate_ensemble(
    stepper: Stepper,
    q: ArrayLike,
    p: ArrayLike,
    *,
    h: float,
    steps: int,
    every: int = 1,
    t: float = 0.0,
    parameters: EnsembleParameters = None,
    options: SolverOptions | None = None,
    progress: Callable[[int], None] | None = None,
    address: str | None = None,
    blocks: int | None = None,
) -> EnsembleTrajectory:
    """``stepper.integrate_ensemble`` over a cluster; the same bits on the same kind of processors.

    Args:
        stepper: compiled here; its source is compiled again by each worker, which needs this package and a C compiler.
        q, p: (k, m) initial positions and momenta.
        h, steps, every, t, parameters, options: as of ``stepper.integrate_ensemble``.
        progress: called now and then with the number of trajectories done.
        address: of a scheduler, as in ``"tcp://10.0.0.1:8786"``; by default a cluster of threads in this process.
        blocks: number of parts that the trajectories are divided into, by default four for each thread of the cluster.

    Returns:
        An :class:`EnsembleTrajectory`, also if workers were lost on the way.

    Raises:
        ImportError: if dask.distributed is not installed.
        StateError: on wrong shapes, names or numbers, before anything is sent.
        BuildError: if a worker cannot compile the source.
    """
    work = Ensemble(stepper, q, p, h=h, steps=steps, every=every, t=t, parameters=parameters, options=options)
    wanted = None if blocks is None else checked_count(blocks, "blocks", least=1)
    with _client(address) as client:
        count = wanted or BLOCKS_A_THREAD * sum(client.ncores().values())
        _gather(client, work, list(_slices(work.count, count)), progress)
    return work.result()


@contextmanager
def _client(address: str | None) -> Iterator[Any]:
    """A client of the scheduler at an address, or of a cluster of its own."""
    try:
        import distributed
    except ImportError as error:
        raise ImportError(
            "this needs dask.distributed, which is not installed: pip install 'scvi-codegen[distributed]'"
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
    """About so many parts, of full vector registers."""
    size = -(-count // (blocks * LANES)) * LANES
    for first in range(0, count, size):
        yield slice(first, min(first + size, count))


def _gather(client: Any, work: Ensemble, parts: list[slice], progress: Callable[[int], None] | None) -> None:
    """Send the parts out and put what comes back into its place."""
    from distributed import as_completed

    pickled = pickle.dumps(work.stepper)
    settings = {"h": work.h, "steps": work.steps, "every": work.every, "t": work.t0, "options": work.options}
    futures = {
        client.submit(
            _integrate, pickled, work.q[0, part], work.p[0, part], work.parameters[part], settings, pure=False
        ): part
        for part in parts
    }
    done = 0
    try:
        for future, (q, p, status, steps) in as_completed(futures, with_results=True):
            part = futures[future]
            work.q[:, part], work.p[:, part], work.status[part], work.done[part] = q, p, status, steps
            future.release()
            done += part.stop - part.start
            if progress is not None:
                progress(done)
    finally:
        client.cancel(list(futures))


def _integrate(
    pickled: bytes,
    q: NDArray[np.float64],
    p: NDArray[np.float64],
    parameters: NDArray[np.float64],
    settings: dict[str, Any],
) -> Part:
    """One part, by one thread of a worker."""
    result = _stepper(pickled).integrate_ensemble(q, p, parameters=parameters, threads=1, **settings)
    return result.q, result.p, result.status, result.steps


@lru_cache(maxsize=16)
def _stepper(pickled: bytes) -> Stepper:
    """The stepper, compiled or from the cache of this worker."""
    stepper: Stepper = pickle.loads(pickled)
    return stepper
