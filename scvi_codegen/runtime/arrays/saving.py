"""Saved runs over arrays: serialisation to bytes and validation when reading."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StateError
from scvi_codegen.rendering.source import Interface
from scvi_codegen.runtime.arrays.interface import RunArrays, read_arrays
from scvi_codegen.runtime.arrays.memory import RUN_FIELDS, STATE

__all__ = ["damage_as_state_error", "read_saved", "restore_memory", "saved_arrays", "saved_bytes"]

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
COMPUTED = ("inverse_mass", "places", "columns")
"""Arrays computed from the problem and not restored: foreign indices could address memory out of bounds."""
CHECKSUM = "checksum"


def saved_bytes(run: Mapping[str, Any], arrays: RunArrays, interface: Interface) -> bytes:
    """Return the data and the arrays of a run as NumPy's format (.npz), with a checksum."""
    saved: dict[str, Any] = {f"table {name}": array for name, array in arrays.places.items()}
    saved |= {f"field {name}": array for name, array in arrays.fields.items()}
    saved |= {"integrator": _integrator(interface), "parameters": arrays.numbers, **run}
    arrays_saved: dict[str, Any] = {name: np.asarray(array) for name, array in saved.items()}
    file = io.BytesIO()
    arrays_saved[CHECKSUM] = _checksum(arrays_saved)
    np.savez(file, **arrays_saved)
    return file.getvalue()


def read_saved(saved: bytes, interface: Interface, *, to_a_time: bool) -> dict[str, NDArray[Any]]:
    """Return the arrays of :func:`saved_bytes`.

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
        if bool(arrays["to a time"]) == to_a_time:
            return arrays
    raise StateError(
        "the saved run has fixed steps: omit t_end" if to_a_time else "the saved run has adaptive steps: give t_end"
    )


def saved_arrays(arrays: Mapping[str, NDArray[Any]], interface: Interface) -> RunArrays:
    """Return the validated problem data of a saved run."""
    numbers = dict(zip(interface.parameters, arrays["parameters"].tolist(), strict=True))
    return read_arrays(
        interface,
        {array.name: arrays[f"state {array.name}"] for array in interface.layout.coordinates},
        numbers | {field.name: arrays[f"field {field.name}"] for field in interface.layout.fields},
        {table.name: arrays[f"table {table.name}"] for table in interface.layout.tables},
    )


@contextmanager
def damage_as_state_error() -> Iterator[None]:
    """Convert exceptions caused by damaged bytes to :class:`StateError`."""
    try:
        yield
    except StateError:
        raise
    except Exception as error:  # zipfile, zlib, NumPy's header parser and conversions raise many types
        raise _not_saved(repr(error)) from error


def restore_memory(run: Any, arrays: Mapping[str, NDArray[Any]], saved: Mapping[str, NDArray[Any]]) -> None:
    """Copy validated saved values into the C struct and the arrays of a run.

    Raises:
        StateError: if a value is impossible in a run.
    """
    moments = dict(zip(RUN_FIELDS, np.asarray(saved["moments"], dtype=float).tolist(), strict=True))
    for name, value in moments.items():
        if name in RANGES and not (value.is_integer() and RANGES[name][0] <= value <= RANGES[name][1]):
            raise _not_saved(f"{name} is {value:g}, not a whole number from {RANGES[name][0]} to {RANGES[name][1]}")
        if name in FINITE and not np.isfinite(value):
            raise _not_saved(f"{name} is {value:g}")
        setattr(run, name, int(value) if name in RANGES else value)
    for name, array in arrays.items():
        if name in COMPUTED:
            continue
        values = saved[f"memory {name}"]
        if values.shape != array.shape or values.dtype != array.dtype:
            raise _not_saved(f"{name} has the shape {values.shape}, not {array.shape}")
        if name in STATE and not np.isfinite(values).all():
            raise _not_saved(f"{name} is not finite")
        array[:] = values


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
