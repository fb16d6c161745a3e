"""Binding of a compiled library: functions, structs, pointers into arrays.

A library with only the fixed-point iteration uses Newton's method of a second library, which is compiled when a call
first requests it (:mod:`scvi_codegen.codegen.rendering.kernels.simd`); that call is then repeated from its start.
"""

import re
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import cache, lru_cache, partial
from struct import Struct
from threading import local
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.native.building import Library
from scvi_codegen.codegen.native.options import (
    FAILURES,
    FALLBACK_REQUIRED,
    SolverOptions,
    checked_options,
    step_failure,
)
from scvi_codegen.codegen.rendering.c_text import renamed
from scvi_codegen.codegen.rendering.source import Source
from scvi_codegen.codegen.rendering.text import INPUT_PRECISION, ROUNDING_UNITS
from scvi_codegen.common.cache import template_folder
from scvi_codegen.common.errors import MethodError, StepFailedError
from scvi_codegen.common.tangent_space import DEPENDENT

RESULTS, FIRST_RESULT = Struct("=4d5q"), "error"
"""Format of the last fields of the struct (``calls_declarations.h``), and the first of them."""
LIMITS_ON_CONSTRAINTS = (
    f"#define HAS_CONSTRAINTS\n#define DEPENDENT {DEPENDENT!r}\n#define INPUT_PRECISION {INPUT_PRECISION!r}\n"
    f"#define ROUNDING_OF_INPUT {ROUNDING_UNITS * sys.float_info.epsilon!r}\n"
)
"""Constraints of named coordinates in ``calls.h``, with the limits of their initial states."""
CONSISTENT = (
    "int NAME(call_consistent)(double t, const double *q, const double *p, const double *parameters, double *q1, "
    "double *p1, double *workspace);\n"
)
"""Declaration of the function of ``calls.h`` that only constraints of named coordinates have."""
ERRORS = (
    "int NAME(call_errors)(NAME(call) *call, long long count, const double *t, const double *h, const double *q, "
    "const double *p, const double *size, const double *limits, const double *before, double *curves, "
    "long long stride, double *errors);\n"
    "int NAME(call_abscissae)(double *abscissae, int *count);\n"
    "int NAME(call_differences)(NAME(call) *call, long long count, const double *t, const double *h, const double *q, "
    "const double *p, const double *size, int vectors, double rounding, unsigned long long seed, "
    "const double *before, double *now, long long stride, double *deviations);\n"
)
"""Declaration of those which only named coordinates in double have."""
OPTIONAL_FUNCTIONS = frozenset(("advance_to", "set_fallback", "project"))
"""Functions that not all integrators have, HAS_.. in ``calls.h`` like the optional fields of a run."""


NAMES_OF_SOURCE = (
    *("real", "M", "CONSTRAINTS", "CONSTRAINT_ENTRIES", "CONSTRAINT_ENTRY", "MASS_ENTRIES", "MASS_ENTRY"),
    *("constraints", "legendre"),
)
"""Names of a source to which ``calls.h`` and ``error_vectors.h`` refer."""


def with_calls(source: Source) -> Source:
    """Return a source of runs with the functions of calls; others unchanged."""
    if "advance" not in source.contents.functions:
        return source
    sizes, further, switches = source.contents.sizes, "", ""
    if sizes and "h_low" not in source.contents.run_fields:
        further, switches = ERRORS, "#define HAS_ERRORS\n"
        if sizes.constraints:
            further, switches = further + CONSISTENT, switches + LIMITS_ON_CONSTRAINTS
    errors = _text("support/derivatives/error_vectors") if further else ""
    declarations, functions = (
        re.sub(r"NAME\((\w+)\)", rf"{source.prefix}_\1", text)
        for text in (_text("calls_declarations") + further, errors + _text("calls"))
    )
    functions = _in_one_file(functions, source)
    present = [name for name in source.contents.functions if name in OPTIONAL_FUNCTIONS]
    switches += "".join(f"#define HAS_{name.upper()}\n" for name in (*present, *source.contents.run_fields))
    return replace(
        source,
        code=f"{source.code}\n{switches}{declarations}\n{functions}",
        declarations=f"{source.declarations}\n{declarations}",
    )


def _in_one_file(functions: str, source: Source) -> str:
    """Return functions with the names to which they refer as a source of one file has them, with its prefix."""
    if f"{source.prefix}_real" not in source.code:
        return functions
    prefix, upper = source.prefix, source.prefix.upper()
    return renamed(functions, {name: f"{upper if name.isupper() else prefix}_{name}" for name in NAMES_OF_SOURCE})


@cache
def _text(name: str) -> str:
    return (template_folder() / f"{name}.h").read_text(encoding="utf-8")


DOUBLE_SIZE = np.dtype(np.float64).itemsize
WITHOUT_STEPS = frozenset(
    ("start", "step_error", "energies", "call_momenta", "call_project", "call_transform", "call_consistent")
)
"""Functions that never request the fallback, frequent or of many states."""
IN_DOUBT, BY_VELOCITY, ON_CONSTRAINTS = -1, 1, 2
"""Status of an integration whose initial state Python has to examine; how the initial state is given (``calls.h``)."""


class Binding:
    """Names and types of one C source.

    Args:
        library: the compiled source.
        prefix: of its names.
        workspace: doubles that a call requires.
        fallback: compiles the library with Newton's method, if the source uses a second library.
        origin: an object that can be pickled and the name of its attribute that is this binding.

    Attributes:
        count: number of coordinates of a run of run-time sizes, whose arrays are pointers; else ``None``.
        reusable: whether memory of runs may be kept for later runs.
        integers, whole_numbers: functions that return a pointer to the first element of a contiguous int32 or int64
            array that is not empty.
    """

    count: int | None = None
    reusable = True

    def __init__(
        self,
        library: Library,
        prefix: str,
        workspace: int = 0,
        *,
        fallback: Callable[[], Library] | None = None,
        origin: tuple[object, str] | None = None,
    ) -> None:
        self._origin = origin
        self._ffi, self._lib, self._prefix, self._workspace = library.ffi, library.lib, prefix, workspace
        self.null, self._doubles = library.ffi.NULL, partial(library.ffi.from_buffer, "double[]")
        self.integers: Callable[[NDArray[np.int32]], Any] = partial(library.ffi.from_buffer, "int[]")
        self.whole_numbers: Callable[[NDArray[np.int64]], Any] = partial(library.ffi.from_buffer, "long long[]")
        self._has: dict[str, bool] = {}  # whether the library has a function
        self._fallback = fallback if self.has("set_fallback") else None
        self._fallback_binding: Self | None = None
        self._spare = local()
        self._shared_fallback = self.null

    def __reduce__(self) -> tuple[Any, ...]:
        if self._origin is None:
            raise TypeError("a binding cannot be pickled by itself: pickle its stepper")
        return getattr, self._origin

    @property
    def failures(self) -> Mapping[str, tuple[str, str]]:
        """Cause and remedy of a failed step, by status."""
        return FAILURES

    def function(self, name: str, memory: Any = None) -> Callable[..., Any]:
        """Return ``<prefix>_<name>``, bound to this memory if one is given; it releases the GIL while it runs."""
        function: Callable[..., Any] = getattr(self._lib, f"{self._prefix}_{name}")
        if memory is not None:
            function = partial(function, memory)
        if self._fallback is None or name in WITHOUT_STEPS:
            return function
        restored = bytearray() if memory is None else self._ffi.buffer(memory)
        return self._with_fallback(function, restored)

    def call(self, name: str, call: Any) -> Callable[[int, int], int]:
        """Return the function ``<prefix>_call_<name>`` of numbers of steps and of those between stored states."""
        function: Callable[[int, int], int] = partial(getattr(self._lib, f"{self._prefix}_call_{name}"), call)
        if self._fallback is None:
            return function
        restored = bytearray() if name == "integrate" else self._ffi.buffer(call.run)
        return self._with_fallback(function, restored, call.workspace)

    def each(self, call: Any) -> Callable[[int], int]:
        """Return the function ``<prefix>_call_each`` of the largest number of steps; it returns the steps taken."""
        function: Callable[[int], int] = partial(getattr(self._lib, f"{self._prefix}_call_each"), call)
        if self._fallback is None:
            return function

        def advance(steps: int) -> int:
            taken = function(steps)
            if call.requested:
                self.set_fallback()
                self._refer_to_fallback(call.workspace)
                taken += function(steps - taken)
            return taken

        return advance

    def of_each(self, name: str, t: float, parameters: NDArray[np.float64], *states: NDArray[np.float64]) -> Any:
        """Call ``<prefix>_call_<name>`` with (k, m) states, each with its own parameters; arrays are contiguous."""
        inputs, results = states[:2], states[2:]
        sizes = *inputs[0].shape, parameters.shape[1]
        pointers = map(self.pointer, (*inputs, parameters, *results))
        return self.function(f"call_{name}")(sizes[0], t, *sizes[1:], *pointers, self.workspace())

    def with_function(self, name: str) -> Self:
        """Return this binding, or that of the fallback if only it has the function; MethodError if neither has it."""
        if self.has(name):
            return self
        if self._fallback is None:
            raise MethodError(
                f"the function {name} requires Newton's method, which this integrator does not include: compile it "
                "with solver='auto' or solver='newton'"
            )
        if self._fallback_binding is None:
            lender = type(self)(self._fallback(), self._prefix)
            lender._workspace = lender.constant("FALLBACK_WORKSPACE")
            self._fallback_binding = lender
        return self._fallback_binding

    def with_workspace(self, size: int) -> Self:
        """Return this binding with the given number of doubles of workspace."""
        self._workspace = size
        return self

    def set_fallback(self) -> None:
        """Compile the library with Newton's method if it is used; the workspaces allocated from now on refer to it."""
        if self._fallback is not None:
            self._shared_fallback = self.with_function("provided_fallback").function("provided_fallback")()

    def has(self, name: str) -> bool:
        """Return whether the library has the function ``<prefix>_<name>``."""
        if name not in self._has:
            self._has[name] = hasattr(self._lib, f"{self._prefix}_{name}")
        return self._has[name]

    def results(self, call: Any) -> Callable[[], tuple[Any, ...]]:
        """Return a function that returns the results of the last integration by a call."""
        first = self._ffi.offsetof(self._ffi.typeof(call).item, FIRST_RESULT)
        return partial(RESULTS.unpack_from, self._ffi.buffer(call), first)

    def _with_fallback(self, function: Callable[..., Any], restored: Any, workspace: Any = None) -> Callable[..., Any]:
        """Return the function, called again on the restored memory if it requests the fallback.

        Its last argument is the workspace, unless one is given.
        """

        def call(*arguments: Any) -> Any:
            before = restored[:]
            status = function(*arguments)
            if status != FALLBACK_REQUIRED:
                return status
            self.set_fallback()
            self._refer_to_fallback(arguments[-1] if workspace is None else workspace)
            restored[:] = before
            return function(*arguments)

        return call

    def constant(self, name: str) -> int:
        """Return the enumeration constant ``<PREFIX>_<NAME>``."""
        return int(getattr(self._lib, f"{self._prefix.upper()}_{name}"))

    def new(self, type_name: str) -> Any:
        """Return a zeroed ``<prefix>_<type_name>``, as in ``"run *"``."""
        return self._ffi.new(f"{self._prefix}_{type_name}")

    def numbers(self, type_name: str) -> Any:
        """Return zeroed numbers of C, as in ``"long long *"`` and ``"double[3]"``."""
        return self._ffi.new(type_name)

    def vector(self, part: Any) -> NDArray[np.float64]:
        """Return an array of doubles of a struct, in the same memory."""
        if self.count is None:
            return np.frombuffer(self._ffi.buffer(part))
        return np.frombuffer(self._ffi.buffer(part, DOUBLE_SIZE * self.count)) if self.count else np.empty(0)

    def buffer(self, struct: Any) -> Any:
        """Return the bytes of a struct, writable; of a run of run-time sizes those of its state."""
        if (size := getattr(struct, "saved", None)) is None:
            return self._ffi.buffer(struct)
        return self._ffi.buffer(self._ffi.addressof(struct, "t"), size)

    def records(self, structs: Any, count: int | None = None) -> NDArray[np.void]:
        """Return an array of structs, by the names of their fields, in the same memory; a copy of the first few."""
        layout = _layout(self._ffi, self._ffi.typeof(structs).item)
        records: NDArray[np.void] = np.frombuffer(self._ffi.buffer(structs), dtype=layout)
        return records if count is None else records[:count].copy()

    def pointer(self, array: NDArray[Any]) -> Any:
        """Return a pointer to the first element of a contiguous float64 or int32 array; NULL for an empty one."""
        if not array.size:
            return self.null
        return self._ffi.from_buffer("double[]" if array.itemsize == DOUBLE_SIZE else "int[]", array)

    def pointers(self, *arrays: NDArray[np.float64]) -> Iterable[Any]:
        """Return pointers to the first elements of contiguous float64 arrays that are not empty."""
        return map(self._doubles, arrays)

    def workspace(self, run: Any = None) -> Any:
        """Return memory for one call; of run-time sizes that of a run: of this one, or of one for each thread."""
        if self.count is not None:
            if run is None:
                run = self._spare.run = getattr(self._spare, "run", None) or self.new("run *")
            return self._ffi.cast("double *", run)
        workspace = self.pointer(np.empty(self._workspace))
        if self._fallback is not None:
            self._refer_to_fallback(workspace)
        return workspace

    def _refer_to_fallback(self, workspace: Any) -> None:
        getattr(self._lib, f"{self._prefix}_set_fallback")(self._shared_fallback, workspace)

    def failure(self, status: int, report: Any, *, step: int, h: float) -> StepFailedError:
        """Return the exception for a failed step: its number, its size, 0 if it is adaptive; see ``step_failure``."""
        return step_failure(status, report, step=step, h=h, failures=self.failures)

    def options(self, options: SolverOptions | None) -> Any:
        """Return the C struct, NULL for the defaults."""
        if options is None or checked_options(options) is None:
            return self.null
        struct = self.new("options *")
        struct.tolerance, struct.max_iterations = options.tolerance, options.max_iterations
        struct.absolute = options.absolute
        return struct


@lru_cache(maxsize=64)
def _layout(ffi: Any, item: Any) -> np.dtype[np.void]:
    """Return the NumPy type of a struct, without the structs in it; kept, as calls of single steps ask for it."""
    fields = [(name, field) for name, field in item.fields if field.type.kind != "struct"]
    return np.dtype(
        {
            "names": [name for name, _ in fields],
            "formats": [_format(field.type) for _, field in fields],
            "offsets": [field.offset for _, field in fields],
            "itemsize": ffi.sizeof(item),
        }
    )


def _format(kind: Any) -> tuple[Any, tuple[int, ...]]:
    """Return the NumPy type and the shape of a number or an array of numbers of C."""
    shape: tuple[int, ...] = ()
    while kind.kind == "array":
        shape, kind = (*shape, kind.length), kind.item
    return {"double": np.float64, "float": np.float32, "int": np.int32, "long long": np.int64}[kind.cname], shape
