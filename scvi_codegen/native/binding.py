"""The compiled library as Python calls it: functions, structs, pointers into arrays, and failures as exceptions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.native.building import Library
from scvi_codegen.native.options import SolverOptions, checked_options

__all__ = ["Binding"]


class Binding:
    """Names and types of one C text.

    Args:
        library: the text, compiled.
        prefix: of its names.
        workspace: doubles that a call needs.
    """

    def __init__(self, library: Library, prefix: str, workspace: int = 0) -> None:
        self._ffi, self._lib, self._prefix, self._workspace = library.ffi, library.lib, prefix, workspace
        self.null = library.ffi.NULL

    def function(self, name: str) -> Callable[..., Any]:
        """``<prefix>_<name>``; releases the GIL while it runs."""
        function: Callable[..., Any] = getattr(self._lib, f"{self._prefix}_{name}")
        return function

    def constant(self, name: str) -> int:
        """``<PREFIX>_<NAME>``, of an enumeration."""
        return int(getattr(self._lib, f"{self._prefix.upper()}_{name}"))

    def new(self, what: str) -> Any:
        """A zeroed ``<prefix>_<what>``, as in ``"run *"``."""
        return self._ffi.new(f"{self._prefix}_{what}")

    def number(self, what: str) -> Any:
        """A zeroed number of C, as in ``"long long *"``."""
        return self._ffi.new(what)

    def buffer(self, struct: Any) -> Any:
        """The bytes of a struct, writable."""
        return self._ffi.buffer(struct)

    def pointer(self, array: NDArray[Any]) -> Any:
        """To the first element of a contiguous float64 or int32 array; NULL for an empty one."""
        kind = "int[]" if array.dtype == np.int32 else "double[]"
        return self._ffi.from_buffer(kind, array) if array.size else self.null

    def workspace(self) -> Any:
        """Memory for one call."""
        return self.pointer(np.empty(self._workspace))

    def options(self, options: SolverOptions | None) -> Any:
        """The C struct, NULL for the defaults."""
        if options is None or checked_options(options) is None:
            return self.null
        return self._ffi.new(
            f"{self._prefix}_options *",
            [options.tolerance, options.max_iterations, int(options.absolute)],
        )
