"""Saved runs over arrays: serialisation to bytes and validation when reading."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StateError
from scvi_codegen.rendering.source import Interface
from scvi_codegen.runtime.arrays.interface import RunArrays, read_arrays
from scvi_codegen.runtime.arrays.memory import COMPUTED, RUN_FIELDS, STATE
from scvi_codegen.validation import checked_count

RANGES = {
    **dict.fromkeys(("step", "rejected", "avoiding", "steps_from_rest", "steps_to_compare"), (0, 2**53)),
    "guess": (0, 2),
    "turn": (0, 2),
    "direction": (-1, 1),
    **dict.fromkeys(("grid_level", "change", "change_before", "failed"), (-(2**16), 2**16)),
}
"""Smallest and largest values of whole numbers that C uses as indices or states."""
FINITE = ("t", "t_low", "h")
"""Fields that are finite in every run; error estimates may be NaN."""
CHECKSUM = "checksum"


class SavedRun(NamedTuple):
    """Saved run: sizes and tables, the bytes of its memory, and the parameters that are set."""

    arrays: RunArrays
    state: bytes
    parameters: dict[str, Any]


def saved_bytes(stepper: Any, run: Any) -> bytes:
    """Return a run with its problem as NumPy's format (.npz), with a checksum."""
    interface, memory, layout = stepper.origin.interface, run._memory, stepper.origin.interface.layout
    known = stepper.parameters_by_name(run.parameters)
    saved: dict[str, Any] = {f"table {name}": array for name, array in stepper.problem.places.items()}
    saved |= {f"field {field.name}": known[field.name] for field in layout.fields}
    saved |= {"integrator": _integrator(interface), "parameters": [known[name] for name in interface.parameters]}
    saved |= {f"state {name}": array for name, array in stepper.arrays(run.q).items()}
    saved |= {f"memory {name}": array for name, array in memory.numbers.items()}
    saved |= {"moments": [float(getattr(memory.run, name)) for name in RUN_FIELDS], "iterations": run.iterations}
    saved |= {"unset_inputs": np.array(run._unset_inputs, dtype=str), "to a time": run.plan is not None}
    arrays_saved: dict[str, Any] = {name: np.asarray(array) for name, array in saved.items()}
    file = io.BytesIO()
    arrays_saved[CHECKSUM] = _checksum(arrays_saved)
    np.savez(file, **arrays_saved)
    return file.getvalue()


def read_saved(saved: bytes, interface: Interface, *, to_a_time: bool) -> SavedRun:
    """Return the run of :func:`saved_bytes`.

    Raises:
        StateError: if the bytes are invalid or damaged or belong to another integrator or another kind of steps.
    """
    if not isinstance(saved, bytes):
        raise StateError(f"a saved run must be bytes, not {type(saved).__name__}")
    with damage_as_state_error():
        arrays = dict(np.load(io.BytesIO(saved), allow_pickle=False))
        if str(arrays["integrator"]) != _integrator(interface):
            raise StateError(f"the saved run is one of '{arrays['integrator']}', not of '{_integrator(interface)}'")
        if str(arrays.pop(CHECKSUM)) != _checksum(arrays):
            raise StateError("invalid saved run: the checksum differs. Save the run again")
        if bool(arrays["to a time"]) != to_a_time:
            raise StateError(
                "the saved run has fixed steps: omit t_end"
                if to_a_time
                else "the saved run has adaptive steps: give t_end"
            )
        known = dict(zip(interface.parameters, arrays["parameters"].tolist(), strict=True))
        known |= {field.name: arrays[f"field {field.name}"] for field in interface.layout.fields}
        problem = read_arrays(
            interface,
            {array.name: arrays[f"state {array.name}"] for array in interface.layout.coordinates},
            known,
            {table.name: arrays[f"table {table.name}"] for table in interface.layout.tables},
        )
        unset = arrays["unset_inputs"].tolist()
        parameters = {name: value for name, value in known.items() if name.removesuffix("_0") not in unset}
        return SavedRun(problem, _state_bytes(arrays, sum(each.size for each in problem.state.values())), parameters)


@contextmanager
def damage_as_state_error() -> Iterator[None]:
    """Convert exceptions caused by damaged bytes to :class:`StateError`."""
    try:
        yield
    except StateError:
        raise
    except Exception as error:  # zipfile, zlib, NumPy's header parser and conversions raise many types
        raise _not_saved(repr(error)) from error


def _state_bytes(saved: Mapping[str, NDArray[Any]], n: int) -> bytes:
    """Return the validated memory of n coordinates as bytes; raise StateError if a value is impossible in a run."""
    moments = dict(zip(RUN_FIELDS, np.asarray(saved["moments"], dtype=float).tolist(), strict=True))
    for name, value in moments.items():
        if name in RANGES and not (value.is_integer() and RANGES[name][0] <= value <= RANGES[name][1]):
            raise _not_saved(f"{name} is {value:g}, not a whole number from {RANGES[name][0]} to {RANGES[name][1]}")
        if name in FINITE and not np.isfinite(value):
            raise _not_saved(f"{name} is {value:g}")
    iterations = checked_count(saved["iterations"].item(), "iterations", least=0)
    fields = [*moments.values(), iterations, saved["to a time"].item()]
    arrays = {name.removeprefix("memory "): array for name, array in saved.items() if name.startswith("memory ")}
    for name, array in arrays.items():
        if array.dtype != float and name not in COMPUTED:
            raise _not_saved(f"{name} has the type {array.dtype}")
        if name in STATE and array.shape != (n,):
            raise _not_saved(f"{name} has the shape {array.shape}, not {(n,)}")
        if name in STATE and not np.isfinite(array).all():
            raise _not_saved(f"{name} is not finite")
    stored = (array.tobytes() for name, array in arrays.items() if name not in COMPUTED)
    return b"".join([np.array(fields, dtype=float).tobytes(), *stored])


def _not_saved(reason: object) -> StateError:
    return StateError(f"invalid saved run: {reason}")


def _checksum(arrays: Mapping[str, NDArray[Any]]) -> str:
    digest = hashlib.sha256()
    for name in sorted(arrays):
        array = np.ascontiguousarray(arrays[name])
        digest.update(f"{name} {array.dtype.str} {array.shape} ".encode())
        digest.update(array.tobytes() if array.dtype.kind == "U" else array.data)
    return digest.hexdigest()


def _integrator(interface: Interface) -> str:
    """Return the identification of saved runs; runs of another solver have another memory layout."""
    return f"{interface.title}, {interface.solver}"
