"""The C entry points of flows, called as frameworks call them, without these: failures, second derivatives, wrappers.

States and first derivatives of rows are properties of the table of motions (``tests/motions``).
The system depends on time, t and the parameters differ from their defaults, and the steps fill several pieces.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose
from pumped_leapfrog import EVERY, ROWS, STEP_INPUTS, STEPS, hessian, partials, states, stepper, weights

from scvi_codegen.codegen.native import building
from scvi_codegen.codegen.rendering.program_source import casadi_name, with_casadi_flow, with_xla_flow
from scvi_codegen.interfaces.frameworks.flow import FlowOfRows

EVERY_STEP, NOT_FINITE_STATUS = 1, 3
SAVED, SIZE = STEPS // EVERY + 1, len(STEP_INPUTS)
compiled = cache(stepper)
WAYS = {"rtol": 0, "atol": 2e-12}


@cache
def flow():
    return FlowOfRows.checked(compiled(), STEPS, EVERY)


OVERFLOWS = np.array([[1e300, 0.0, 1e300, 0.0, 1.0, -30.0, 0.0, 1.0, 0.5, 0.4]])
"""A state that grows by a factor in each step, until it is infinite."""


def first_failure():
    """The number of steps whose ends are finite, by a leapfrog of :data:`OVERFLOWS`."""
    (q, _, p, _, m, k, *_, h), n = OVERFLOWS[0], 0
    with np.errstate(over="ignore", invalid="ignore"):
        while True:
            p = p - h / 2 * (k * q)
            q = q + h * p / m
            p = p - h / 2 * (k * q)
            if not np.isfinite([q, p]).all():
                return n
            n += 1


@pytest.mark.parametrize("part", [0, 1, 2])
def test_failed_steps_are_reported_with_their_number_and_time(part):
    """The states fail after a saved one; derivatives as the states do."""
    failing, library = first_failure(), flow().library
    assert EVERY_STEP < failing < STEPS
    found = np.zeros((1, SIZE, STEPS + 1, SIZE))
    given = np.ones((1, SIZE, STEPS + 1, 4))
    report, pointers = library.new("report *"), [library.pointer(each) for each in (OVERFLOWS, given, found)]
    assert library.function("flow_rows")(part, STEPS, EVERY_STEP, 1, 1, *pointers, report) == NOT_FINITE_STATUS
    assert report.steps == failing
    assert report.t == pytest.approx(OVERFLOWS[0, 8] + failing * OVERFLOWS[0, 9])


@pytest.mark.rotated
def test_second_derivatives_of_batches():
    same, changes = np.tile(weights(), (2, SIZE, 1, 1)), np.tile(np.eye(SIZE), (2, 1, 1))
    found, library = np.zeros((2, SIZE, SIZE)), flow().second_library
    pointers = [library.pointer(array) for array in (ROWS, same, changes, found)]
    assert library.function("hessian_rows")(STEPS, EVERY, SIZE, 2, *pointers, library.new("report *")) == 0
    exact = np.array([hessian(row) for row in ROWS])
    assert_allclose(found, exact, rtol=0, atol=1e-7 * abs(exact).max())


@pytest.mark.second
def test_external_functions_of_casadi_are_exported():
    source, name = with_casadi_flow(compiled().derivatives, STEPS, EVERY), casadi_name(compiled().source.prefix)
    arguments = "(const double **arg, double **res, long long *iw, double *w, int mem);\n"
    shapes = "".join(
        f"const long long *{prefix}{name}_sparsity_{way}(long long i);\nlong long {prefix}{name}_n_{way}(void);\n"
        for prefix in ("", "jac_", "adj1_")
        for way in ("in", "out")
    )
    functions = "".join(f"int {prefix}{name}{arguments}" for prefix in ("", "jac_", "adj1_"))
    source = replace(source, declarations=source.declarations + functions + shapes)
    lib, ffi, _ = building.load(source, flags=compiled().flags)
    given, saved, none = [SIZE, 1, 1], [4, SAVED, 1], [4, SAVED, 0]
    wanted = {
        "": ([given], [saved]),
        "jac_": ([given, none], [[4 * SAVED, SIZE, 1]]),
        "adj1_": ([given, none, saved], [given]),
    }
    for prefix, expected in wanted.items():
        for way, each in zip(("in", "out"), expected, strict=True):
            shape = getattr(lib, f"{prefix}{name}_sparsity_{way}")
            assert getattr(lib, f"{prefix}{name}_n_{way}")() == len(each)
            assert [list(ffi.unpack(shape(k), 3)) for k in range(len(each))] == each
            assert shape(len(each)) == ffi.NULL

    def external(prefix, arrays, shape):
        found, saved = np.zeros(shape), [np.ascontiguousarray(array, dtype=float) for array in arrays]
        given = [ffi.cast("double *", array.ctypes.data) for array in saved]
        result = ffi.new("double *[]", [ffi.cast("double *", found.ctypes.data)])
        function = getattr(lib, prefix + name)
        assert function(ffi.new("const double *[]", given), result, ffi.NULL, ffi.NULL, 0) == 0
        return found

    for row in ROWS:
        assert_allclose(external("", [row], (SAVED, 4)), states(row), **WAYS)
        columns = external("jac_", [row, row], (SIZE, SAVED, 4))
        assert_allclose(np.moveaxis(columns, 0, -1), partials(row), rtol=1e-11, atol=1e-11)
        pulled = external("adj1_", [row, row, weights()], (SIZE,))
        assert_allclose(pulled, np.tensordot(weights(), partials(row), 2), rtol=1e-11, atol=1e-11)


@pytest.mark.rotated
def test_second_derivatives_and_absent_adjoint_variables_of_casadi():
    """CasADi passes NULL for adjoint variables that are zero and for results that it does not need."""
    source, name = (
        with_casadi_flow(flow().second_derivatives, STEPS, EVERY, second=True),
        flow().second_derivatives.prefix,
    )
    functions = [f"{prefix}{casadi_name(name)}" for prefix in ("adj1_", "jac_adj1_")]
    arguments = "(const double **arg, double **res, long long *iw, double *w, int mem);\n"
    source = replace(source, declarations=source.declarations + "".join(f"int {each}{arguments}" for each in functions))
    lib, ffi, _ = building.load(source, flags=compiled().flags)
    adjoint, second = (getattr(lib, each) for each in functions)

    def pointers(kind, *arrays):
        return ffi.new(
            f"{kind} *[]", [ffi.NULL if each is None else ffi.from_buffer("double *", each) for each in arrays]
        )

    row, along = np.array(ROWS[0], dtype=float), np.ascontiguousarray(weights())
    gradient, matrix, transposed = np.ones(SIZE), np.ones((SIZE, SIZE)), np.ones((SAVED, 4, SIZE))
    assert adjoint(pointers("const double", row, None, None), pointers("double", gradient), ffi.NULL, ffi.NULL, 0) == 0
    for given, exact in ((None, np.zeros((SIZE, SIZE))), (along, hessian(ROWS[0]))):
        results = pointers("double", matrix, None, transposed)
        assert second(pointers("const double", row, None, given, None), results, ffi.NULL, ffi.NULL, 0) == 0
        assert_allclose(matrix, exact, rtol=0, atol=1e-7 * abs(hessian(ROWS[0])).max())
    assert not gradient.any()
    assert_allclose(transposed, partials(ROWS[0]), rtol=1e-11, atol=1e-11)


XLA = """
#include <stddef.h>
#include <stdint.h>
#define XLA_FFI_API_MAJOR 0
#define XLA_FFI_API_MINOR 1
#define XLA_FFI_Error_Create_Args_STRUCT_SIZE sizeof(XLA_FFI_Error_Create_Args)
enum { XLA_FFI_Extension_Metadata = 1, XLA_FFI_Error_Code_ABORTED = 10 };
typedef struct XLA_FFI_Error { char text[200]; } XLA_FFI_Error;
typedef struct { size_t size; void *next; const char *message; int errc; } XLA_FFI_Error_Create_Args;
typedef struct { XLA_FFI_Error *(*XLA_FFI_Error_Create)(XLA_FFI_Error_Create_Args *); } XLA_FFI_Api;
typedef struct XLA_FFI_Extension_Base { int type; struct XLA_FFI_Extension_Base *next; } XLA_FFI_Extension_Base;
typedef struct { int major_version, minor_version; } XLA_FFI_Api_Version;
typedef struct { XLA_FFI_Api_Version api_version; int traits; } XLA_FFI_Metadata;
typedef struct { XLA_FFI_Extension_Base base; XLA_FFI_Metadata *metadata; } XLA_FFI_Metadata_Extension;
typedef struct { void *value; } XLA_FFI_Scalar;
typedef struct { void *data; int64_t rank; int64_t *dims; } XLA_FFI_Buffer;
typedef struct {
  XLA_FFI_Extension_Base *extension_start;
  const XLA_FFI_Api *api;
  struct { XLA_FFI_Buffer **args; } args;
  struct { XLA_FFI_Buffer **rets; } rets;
  struct { XLA_FFI_Scalar **attrs; } attrs;
} XLA_FFI_CallFrame;
"""
"""What ``xla_flow.h`` uses of XLA's C interface, by the same names; tests with JAX compile it with that itself."""
FRAME = """
typedef struct { void *value; } scalar;
typedef struct { void *data; int64_t rank; int64_t *dims; } buffer;
typedef struct { void *extension, *api; buffer **args, **rets; scalar **attrs; } call_frame;
"""


def test_handlers_of_xla_are_exported(tmp_path):
    header = tmp_path / "xla" / "ffi" / "api" / "c_api.h"
    header.parent.mkdir(parents=True)
    header.write_text(XLA)
    source = with_xla_flow(compiled().derivatives, "stub")
    source = replace(source, declarations=source.declarations + FRAME)
    lib, ffi, _ = building.load(source, flags=(*compiled().flags, f"-I{tmp_path}"))
    messages = []

    @ffi.callback("void *(void *)")
    def failed(error):
        messages.append(ffi.string(ffi.cast("char **", error)[2]).decode())  # after the size and a pointer
        return error

    api = ffi.new("void *[1]", [ffi.cast("void *", failed)])

    def handled(part, arrays, shape):
        alive = [np.ascontiguousarray(array, dtype=float) for array in (*arrays, np.zeros(shape))]
        buffers, saved = [], []
        for array in alive:
            dims = ffi.new("int64_t[]", list(array.shape))
            buffers.append(ffi.new("buffer *", (ffi.cast("void *", array.ctypes.data), array.ndim, dims)))
            saved.append(dims)
        counts = [ffi.new("long long *", value) for value in (EVERY, STEPS)]  # sorted by name
        scalars = [ffi.new("scalar *", (ffi.cast("void *", count),)) for count in counts]
        args, rets = ffi.new("buffer *[]", buffers[:-1]), ffi.new("buffer *[]", buffers[-1:])
        frame = ffi.new("call_frame *", (ffi.NULL, api, args, rets, ffi.new("scalar *[]", scalars)))
        error = getattr(lib, f"{source.prefix}_xla_{part}")(frame)
        assert (error == ffi.NULL) == (not messages)
        return alive[-1]

    assert_allclose(handled("states", [ROWS], (2, SAVED, 4)), [states(row) for row in ROWS], **WAYS)
    exact, changes = np.array([partials(row) for row in ROWS]), np.tile(np.eye(SIZE), (2, 1, 1))
    pushed = handled("jvp", [ROWS, changes], (2, SIZE, SAVED, 4))
    assert_allclose(np.moveaxis(pushed, 1, -1), exact, rtol=1e-11, atol=1e-11)
    pulled = handled("vjp", [ROWS, np.tile(weights(), (2, 1, 1, 1))], (2, 1, SIZE))
    assert_allclose(pulled[:, 0], np.tensordot(exact, weights(), ((1, 2), (0, 1))), rtol=1e-11, atol=1e-11)
    handled("states", [OVERFLOWS], (1, SAVED, 4))
    (message,) = messages
    assert message.startswith(f"step {first_failure()} at t = ")
    assert message.endswith(" failed: a value is infinite or NaN")
