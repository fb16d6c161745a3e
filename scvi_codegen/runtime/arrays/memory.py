"""Memory of runs over arrays: SIMD-aligned vectors, index arrays and workspace of constraints."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StateError
from scvi_codegen.native.binding import Binding
from scvi_codegen.runtime.arrays.interface import Numbers

STEP_CONTROL_FIELDS = (
    "grid_level",
    "change",
    "change_before",
    "direction",
    "rejected",
    "failed",
    "avoiding",
    "error_before",
    "steps_to_compare",
)
"""Fields of the C struct that control adaptive steps."""
RUN_FIELDS = (
    *("t", "t_low", "h", "step", "guess", "turn", "error", "error_t"),
    *("largest_q", "largest_p", "steps_from_rest", *STEP_CONTROL_FIELDS),
)
"""Scalar fields of the C struct of a run."""
REAL_FIELDS = ("t", "t_low", "h", "error", "error_t", "largest_q", "largest_p", "error_before")
"""Those of them that are no whole numbers."""
COMPUTED = ("inverse_mass", "places", "columns")
"""Arrays computed from the problem and not restored: foreign indices could address memory out of bounds."""
STATE = ("q", "p", "carry_q", "carry_p")
"""Arrays of the state: positions, momenta and their compensation terms."""
ALIGNMENT = 64
"""Alignment in bytes, the size of the widest SIMD register."""


def aligned(count: int) -> Numbers:
    """Return ``count`` zeros, aligned to a SIMD register."""
    try:
        memory = np.zeros(count + ALIGNMENT // 8)
    except (MemoryError, ValueError) as error:
        raise StateError(f"there is not enough memory for {count} numbers") from error
    start = -memory.ctypes.data % ALIGNMENT // 8
    return memory[start : start + count]


def constraint_memory(binding: Binding, run: Any, problem: Any, n: int) -> dict[str, NDArray[Any]]:
    """Allocate the memory of constraints, by the name of its pointer in the C struct.

    Args:
        binding: binding of the integrator.
        run, problem: C structs; the counts of constraints, entries and pairs are stored in ``run``.
        n: number of coordinates.
    """
    binding.function("constraint_sizes")(problem, run)
    count, entries = run.constraints, run.entries
    if not 0 <= count <= entries < 2**31:
        raise StateError(f"invalid constraints ({count} with {entries} coordinates): check the bounds of their loops")
    indices = np.zeros(3 * (count + entries) + n + 3, dtype=np.int32)
    run.places = binding.pointer(indices)
    run.pairs = binding.function("constraint_pairs")(run, problem)
    columns = np.zeros(run.pairs + 1, dtype=np.int32)
    run.columns = binding.pointer(columns)
    binding.function("constraint_pairs")(run, problem)
    return {"places": indices, "columns": columns, "held": aligned(11 * count + 2 * (entries + run.pairs))}
