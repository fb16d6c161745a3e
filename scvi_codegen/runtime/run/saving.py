"""Checkpoints: checksum and bytes of a run, of arrays of run-time sizes preceded by sizes, tables and parameters."""

import hashlib
import json
import math
from typing import Any

import numpy as np

from scvi_codegen.errors import ScviCodegenError, StateError
from scvi_codegen.indices import MOST_THREADS
from scvi_codegen.rendering.source import Interface
from scvi_codegen.runtime.arrays.interface import RunSizes, check_accesses, read_tables
from scvi_codegen.runtime.core.integrator import Integrator
from scvi_codegen.validation import checked_count

MAGIC = b"scvi run 3\n"
"""First bytes of checkpoints, before the checksum."""
DIGEST = 32


def sealed(body: bytes) -> bytes:
    """Return bytes behind their checksum, for :func:`unsealed`."""
    return MAGIC + hashlib.sha256(body).digest() + body


def unsealed(saved: bytes) -> bytes:
    """Return the bytes behind a checksum; raise ``StateError`` if they are damaged."""
    if not isinstance(saved, bytes):
        raise StateError(f"a saved run must be bytes, not {type(saved).__name__}")
    body = saved[len(MAGIC) + DIGEST :]
    if saved != sealed(body):
        raise StateError(
            f"invalid saved run: the checksum of its {len(saved)} bytes differs, so they are damaged or not of "
            "Run.checkpoint(). Use another copy, or save the run again"
        )
    return body


def checkpoint(run: Any) -> bytes:
    """Return the bytes of a run; those of run-time sizes also contain what :meth:`Stepper.bind` requires."""
    stepper: Integrator = run.stepper
    state: bytes = run.snapshot
    if stepper.problem is None or stepper.origin is None:
        return sealed(state)
    arrays = [*stepper.problem.places.values(), run.parameters]
    header = {
        "integrator": _integrator(stepper.origin.interface),
        "sizes": stepper.problem.sizes,
        "unset inputs": run._unset_inputs,
        "adaptive": not run.plan.fixed,
    }
    return sealed(b"".join([json.dumps(header).encode(), b"\n", *(array.tobytes() for array in arrays), state]))


def read_checkpoint(
    body: bytes, origin: Integrator, *, threads: int | None, adaptive: bool
) -> tuple[Integrator, bytes, dict[str, Any]]:
    """Return the bound stepper, the state and the parameters by name of an unsealed run of run-time sizes.

    Raises:
        StateError: if the bytes are invalid or belong to another integrator or another kind of steps.
    """
    try:
        return _read(body, origin, threads, adaptive=adaptive)
    except StateError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, MemoryError, ScviCodegenError) as error:
        raise StateError(f"invalid saved run: {error!r}") from error


def _read(
    body: bytes, origin: Integrator, threads: int | None, *, adaptive: bool
) -> tuple[Integrator, bytes, dict[str, Any]]:
    text, _, rest = body.partition(b"\n")
    header, layout = json.loads(text), origin.interface.layout
    if header["integrator"] != _integrator(origin.interface):
        raise StateError(f"the saved run is one of '{header['integrator']}', not of '{_integrator(origin.interface)}'")
    if header["adaptive"] != adaptive:
        raise StateError(
            "the saved run has fixed steps: omit t_end" if adaptive else "the saved run has adaptive steps: give t_end"
        )
    sizes = {name: checked_count(header["sizes"][name], name, least=0) for name in layout.sizes}
    tables, first = {}, 0
    for table in layout.tables:
        tables[table.name] = np.frombuffer(rest, np.int32, math.prod(table.shape(sizes)), first).reshape(
            table.shape(sizes)
        )
        first += tables[table.name].nbytes
    places = read_tables(origin.interface, tables)
    check_accesses(layout, sizes, places)
    count = checked_count(1 if threads is None else threads, "threads", least=1, most=MOST_THREADS)
    bound = origin._bound_to(RunSizes(sizes=sizes, places=places, threads=count)).with_events(origin.events)
    values = np.frombuffer(rest, count=len(bound.defaults), offset=first)
    known = bound.parameters_by_name(values)
    for name in header["unset inputs"]:
        del known[f"{name}_0"]
    return bound, rest[first + values.nbytes :], known


def _integrator(interface: Interface) -> str:
    """Return the identification of saved runs; runs of another solver have another memory layout."""
    return f"{interface.title}, {interface.solver}"
