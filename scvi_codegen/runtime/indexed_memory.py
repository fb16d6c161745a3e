"""Memory of runs over arrays: numbers on the boundary of a vector, places, and what constraints need of both."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StateError
from scvi_codegen.native.binding import Binding
from scvi_codegen.runtime.indexed_interface import Numbers

__all__ = ["MOMENTS", "STATE", "IndexedMark", "aligned", "held_memory"]

CHOICE = ("rung", "change", "change_before", "direction", "rejected", "error_before")
"""Of steps that choose their length."""
MOMENTS = ("t", "t_low", "h", "step", "guess", "turn", "error", "error_t", "largest_q", "largest_p", "leaving", *CHOICE)
"""Of a run, beside its arrays."""
STATE = ("q", "p", "carry_q", "carry_p")
"""Arrays of numbers that change from step to step, but for what guesses are made of."""
ALIGNMENT = 64
"""Bytes: those of the widest vector."""


@dataclass(frozen=True, slots=True)
class IndexedMark:
    """A state of a run: its arrays, its numbers, sweeps up to it."""

    arrays: Mapping[str, Numbers]
    moments: Mapping[str, Any]
    iterations: int


def aligned(count: int) -> Numbers:
    """So many zeros, the first on the boundary of a vector."""
    try:
        memory = np.zeros(count + ALIGNMENT // 8)
    except (MemoryError, ValueError) as error:
        raise StateError(f"{count} numbers do not fit into the memory") from error
    start = -memory.ctypes.data % ALIGNMENT // 8
    return memory[start : start + count]


def held_memory(binding: Binding, run: Any, problem: Any, n: int) -> dict[str, NDArray[Any]]:
    """What a run whose states are held by constraints needs beside, by the name of its place in the C struct.

    Args:
        binding: of the integrator.
        run, problem: C structs; the numbers of constraints, entries and pairs are entered in the first.
        n: the number of coordinates.
    """
    binding.function("constraint_sizes")(problem, run)
    count, entries = run.constraints, run.entries
    if not 0 <= count <= entries < 2**31:
        raise StateError(f"{count} constraints on {entries} coordinates: too many, or a loop ends early")
    places = np.zeros(3 * (count + entries) + n + 3, dtype=np.int32)
    run.places = binding.pointer(places)
    run.pairs = binding.function("constraint_pairs")(run, problem)
    columns = np.zeros(run.pairs + 1, dtype=np.int32)
    run.columns = binding.pointer(columns)
    binding.function("constraint_pairs")(run, problem)
    return {"places": places, "columns": columns, "held": aligned(11 * count + 2 * (entries + run.pairs))}
