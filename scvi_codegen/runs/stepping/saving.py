"""Checkpoints: a checksum, the sizes, tables and parameters of a run, and the bytes of its memory."""

import hashlib
import json
import math
from typing import Any

import numpy as np

from scvi_codegen.common.errors import ScviCodegenError, StateError
from scvi_codegen.common.representation import clipped
from scvi_codegen.common.validation import checked_count
from scvi_codegen.runs.states.words import block_of
from scvi_codegen.runs.stepping.array_interface import RunSizes, check_accesses, read_tables
from scvi_codegen.runs.stepping.integrator import Integrator
from scvi_codegen.runs.stepping.step_plan import Adaptive, FixedSteps, Steps
from scvi_codegen.systems.formulas.indices import MOST_THREADS

MAGIC = b"scvi run 4\n"
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
    """Return the bytes of a run for :func:`read_checkpoint`."""
    stepper: Integrator = run.stepper
    sizes, places = ({}, {}) if stepper.problem is None else (stepper.problem.sizes, stepper.problem.places)
    header = {
        "integrator": _integrator(stepper),
        "sizes": sizes,
        "unset inputs": run._unset_inputs,
        "adaptive": not isinstance(run.plan, FixedSteps),
        **({"control": Steps.of(run.plan).named} if isinstance(run.plan, Adaptive) else {}),
    }
    arrays: list[Any] = [*places.values(), block_of(run.parameters)]
    return sealed(b"".join([json.dumps(header).encode(), b"\n", *(array.tobytes() for array in arrays), run.snapshot]))


def read_checkpoint(
    saved: bytes, stepper: Integrator, *, threads: int | None, adaptive: bool
) -> tuple[Integrator, bytes, dict[str, Any], Steps]:
    """Return the stepper, bound to the sizes of the run, the state, the parameters by name and the error control.

    ``adaptive``: whether the run continues with adaptive steps.
    """
    body = unsealed(saved)
    try:
        return _read(body, stepper, threads, adaptive=adaptive)
    except StateError:
        raise
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, MemoryError, ScviCodegenError) as error:
        raise StateError(f"invalid saved run: {error!r}") from error


def _read(
    body: bytes, stepper: Integrator, threads: int | None, *, adaptive: bool
) -> tuple[Integrator, bytes, dict[str, Any], Steps]:
    # body: header in JSON, newline, tables of int32, words of the parameters, memory of the run
    text, _, arrays = body.partition(b"\n")
    header, layout = json.loads(text), stepper.interface.layout
    looser: Any = None
    if header["integrator"] != _integrator(stepper) and stepper._looser is not None:
        looser = stepper._looser()
    if looser is not None and header["integrator"] == _integrator(looser):
        stepper = looser.with_events(stepper.events)
    if header["integrator"] != _integrator(stepper):
        raise StateError(f"the saved run is one of '{header['integrator']}', not of '{_integrator(stepper)}'")
    if header["adaptive"] != adaptive:
        raise StateError(
            "the saved run has fixed steps: omit t_end" if adaptive else "the saved run has adaptive steps: give t_end"
        )
    offset = 0
    if layout.coordinates:
        sizes = {name: checked_count(header["sizes"][name], name, least=0) for name in layout.sizes}
        tables = {}
        for table in layout.tables:
            shape = table.shape(sizes)
            tables[table.name] = np.frombuffer(arrays, np.int32, math.prod(shape), offset).reshape(shape)
            offset += tables[table.name].nbytes
        places = read_tables(stepper.interface, tables)
        check_accesses(layout, sizes, places)
        count = checked_count(1 if threads is None else threads, "threads", least=1, most=MOST_THREADS)
        problem = RunSizes(sizes=sizes, places=places, threads=count)
        binding: Any = stepper  # of run-time sizes
        stepper = binding._bound_to(problem).with_events(stepper.events)
    words = stepper.interface.words
    values = np.frombuffer(arrays, count=words * len(stepper.defaults), offset=offset)
    parameters = stepper.parameters_by_name(stepper._states.numbers(values))
    for name in header["unset inputs"]:
        del parameters[f"{name}_0"]
    control = Steps(**header.get("control", {}))
    control.checked()
    return stepper, arrays[offset + values.nbytes :], parameters, control


def _integrator(stepper: Integrator) -> str:
    """Return the identification of saved runs: the memory of a run depends on the method and the solver."""
    interface = stepper.interface if stepper.origin is None else stepper.origin.interface
    return f"{interface.title}, {interface.solver}, of {clipped(', '.join(interface.coordinates), 60)}"
