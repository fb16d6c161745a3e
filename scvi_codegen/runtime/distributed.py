"""Ensembles past one machine: blocks of trajectories over a ``dask.distributed`` cluster (extra ``distributed``).

A stepper travels as source text; each worker compiles it once and keeps it in its cache. Blocks know nothing of each
other, so a worker that dies costs no more than the blocks it had, which others do again.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from numpy.typing import ArrayLike

from scvi_codegen.errors import StateError
from scvi_codegen.given.counts import checked_count
from scvi_codegen.runtime.ensemble import Ensemble
from scvi_codegen.runtime.ensemble_states import EnsembleParameters
from scvi_codegen.runtime.ensemble_to_ends import EnsembleToEnds
from scvi_codegen.runtime.ensemble_trajectory import EnsembleTrajectory
from scvi_codegen.runtime.ensemble_work import driven_work, ensemble_work

if TYPE_CHECKING:
    from scvi_codegen.native.options import SolverOptions
    from scvi_codegen.runtime.stepper import Stepper

__all__ = ["integrate_ensemble"]

ARRAYS = ("t", "times", "q", "p", "status", "steps")
"""Of a result, that travel."""

LANES = 8
BLOCKS_A_THREAD = 4
"""More than one, so that fast workers help slow ones out and a lost one loses little."""
WORKER_SECONDS = 60
"""How long to wait for the first worker of a cluster."""


def integrate_ensemble(
    stepper: Stepper,
    q: ArrayLike,
    p: ArrayLike | None = None,
    *,
    velocity: ArrayLike | None = None,
    h: float | None = None,
    steps: int | None = None,
    t_end: ArrayLike | None = None,
    tolerance: float | None = None,
    save_every: int = 1,
    t: float = 0.0,
    t_eval: ArrayLike | None = None,
    parameters: EnsembleParameters = None,
    options: SolverOptions | None = None,
    inputs: Mapping[str, Any] | None = None,
    progress: Callable[[int], None] | None = None,
    address: str | None = None,
    blocks: int | None = None,
) -> EnsembleTrajectory:
    """``stepper.integrate_ensemble`` over a cluster; the same bits on the same kind of processors.

    Args:
        stepper: compiled here; its source is compiled again by each worker, which needs this package and a C compiler.
        q, p: (k, m) initial positions and momenta.
        velocity: (k, m) initial velocities, in place of p.
        h, steps, t_end, tolerance, save_every, t, t_eval, parameters, options: as of ``stepper.integrate_ensemble``.
        inputs: then as ``stepper.drive_ensemble``; without ``t_eval``.
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
    start: dict[str, Any] = {
        "velocity": velocity,
        "t": t,
        "parameters": parameters,
        "options": options,
        "save_every": save_every,
    }
    way: dict[str, Any] = {"h": h, "steps": steps, "t_end": t_end, "tolerance": tolerance}
    work: Ensemble | EnsembleToEnds
    if inputs is None:
        work = ensemble_work(stepper, q, p, t_eval=t_eval, **way, **start)
    elif t_eval is None:
        work = driven_work(stepper, q, p, inputs=inputs, **way, **start)
    else:
        raise StateError("states of runs with inputs are kept at their steps: leave out t_eval")
    wanted = None if blocks is None else checked_count(blocks, "blocks", least=1)
    with _client(address) as client:
        count = wanted or BLOCKS_A_THREAD * sum(client.ncores().values())
        _gather(client, work, list(_slices(len(work), count)), progress)
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


def _gather(
    client: Any, work: Ensemble | EnsembleToEnds, parts: list[slice], progress: Callable[[int], None] | None
) -> None:
    """Send the parts out and put what comes back into its place."""
    from distributed import as_completed

    pickled = pickle.dumps(work.stepper)
    futures = {client.submit(_integrate, pickled, work.call, work.part(part), pure=False): part for part in parts}
    done = 0
    try:
        for future, found in as_completed(futures, with_results=True):
            part = futures[future]
            arrays = dict(zip(ARRAYS, found, strict=True))
            parameters = work.parameters[part]
            work.keep(part, EnsembleTrajectory(**arrays, h=0.0, parameters=parameters, stepper=work.stepper))
            future.release()
            done += part.stop - part.start
            if progress is not None:
                progress(done)
    finally:
        client.cancel(list(futures))


def _integrate(pickled: bytes, call: str, arguments: dict[str, Any]) -> tuple[Any, ...]:
    """The arrays of one part, by one thread of a worker."""
    result = getattr(_stepper(pickled), call)(threads=1, **arguments)
    return tuple(getattr(result, name) for name in ARRAYS)


@lru_cache(maxsize=16)
def _stepper(pickled: bytes) -> Stepper:
    """The stepper, compiled or from the cache of this worker."""
    stepper: Stepper = pickle.loads(pickled)
    return stepper
