"""Binding of arrays whose sizes are known at run time: its runs are bound to sizes and tables."""

import math
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StateError
from scvi_codegen.native.binding import Binding
from scvi_codegen.native.building import Library
from scvi_codegen.native.options import FAILURES, NOT_CONVERGED
from scvi_codegen.rendering.source import Interface
from scvi_codegen.runtime.arrays.envelope import envelope_of
from scvi_codegen.runtime.arrays.interface import Numbers, RunSizes

MASSES = ("a coordinate has no positive mass", "Add its kinetic energy to L, or check the parameters")
FAILURES_BY_SOLVER = {
    "explicit": FAILURES | {"singular": MASSES},
    "fixed-point": FAILURES
    | {
        NOT_CONVERGED: (
            "the fixed-point iteration did not converge",
            "It converges if h times the highest frequency is below about 1 to 3. Use a smaller h, or "
            "solver='newton' if the fast modes are not excited (stiff bonds, short waves on a lattice)",
        ),
        "singular": MASSES,
    },
    "newton": FAILURES | {NOT_CONVERGED: ("Newton-GMRES did not converge", "Use a smaller h"), "singular": MASSES},
    "rattle": FAILURES
    | {
        NOT_CONVERGED: ("the iteration on the constraints did not converge", "Use a smaller h"),
        "singular": (
            "the constraints are contradictory or redundant there",
            "Remove the constraints that follow from others",
        ),
    },
}
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


class ArrayBinding(Binding):
    """Binding of arrays of given sizes and tables; states and parameters are vectors, as for known sizes.

    Args:
        library: the compiled source.
        interface: interface of the source.
        sizes: sizes, tables and number of threads per step.
    """

    def __init__(self, library: Library, interface: Interface, sizes: RunSizes) -> None:
        super().__init__(library, interface.prefix)
        self.interface, self.sizes, layout = interface, sizes, interface.layout
        self.reusable = not layout.neighbours  # their lists, and rounding errors, depend on earlier states
        self.count = sum(math.prod(array.shape(sizes.sizes)) for array in layout.coordinates)

    @cached_property
    def failures(self) -> Mapping[str, tuple[str, str]]:
        """Messages of failed steps."""
        failures, hint = FAILURES_BY_SOLVER.get(self.interface.solver, FAILURES), ""
        if mesh := self.interface.layout.mesh:
            hint = (
                f". The highest frequency is at most {mesh.highest_frequency():.3g}: choose h below "
                "mesh.largest_step(method), with the method of compile_stepper"
            )
        if names := self.interface.layout.neighbours:
            hint = f". No particle may move by a cutoff of {', '.join(map(repr, names))} in one step"
        return {word: (cause, remedy + hint) for word, (cause, remedy) in failures.items()}

    @cached_property
    def _bound(self) -> tuple[Any, Any, tuple[NDArray[Any], ...]]:
        """Sizes and tables as pointers, and the arrays that these refer to."""
        layout = self.interface.layout
        tables = [self.sizes.places[table.name].reshape(-1) for table in layout.tables]
        if self.constant("TABLES") > len(tables):
            envelope = envelope_of(layout, self.sizes)
            tables.append(np.empty(0, np.int32) if envelope is None else envelope.pattern)
        sizes = self._ffi.new("long long[]", [*(self.sizes.sizes[name] for name in layout.sizes), 0])
        return sizes, self._ffi.new("int *[]", [*map(self.pointer, tables), self.null]), tuple(tables)

    def new(self, type_name: str) -> Any:
        """Return a run in memory of its own, bound to the sizes and tables; else what :meth:`Binding.new` returns."""
        if type_name != "run *":
            return super().new(type_name)
        sizes, tables, arrays = self._bound
        if (length := self._call("memory", sizes, tables)) < 0:
            raise StateError("the constraints are invalid, or too many for the memory: check the bounds of their loops")
        memory = aligned(length)
        run = self._call("bind", sizes, tables, self.pointer(memory))
        if run == self.null:
            raise StateError(f"there is not enough memory for a run of {length} numbers")
        run.threads = self.sizes.threads
        release = self._call if self.has("release") else None

        def freed(run: Any, _: object = (memory, arrays)) -> None:
            if release is not None:
                release("release", run)

        return self._ffi.gc(run, freed)

    def _call(self, name: str, *arguments: Any) -> Any:
        return getattr(self._lib, f"{self._prefix}_{name}")(*arguments)
