"""Ensembles on NVIDIA GPUs: CUDA C++ of an ensemble source, its compiled code in the cache, memory and launches.

The ensemble source with one lane (``SCVI_DEVICE``) is a kernel in which a thread is a trajectory. NVRTC compiles it;
the binary is cached by source, options, version of NVRTC and architecture. All functions of CUDA are called through
the package cuda-core, which requires neither nvcc nor headers (extra ``cuda``).
"""

import base64
import re
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.native.announcements import announced
from scvi_codegen.codegen.rendering.source import Source
from scvi_codegen.common.cache import cached_source
from scvi_codegen.common.errors import BuildError, imported

CUDA = "cuda"
DEVICES = (CUDA,)
"""Values of ``device=``."""
EXTRA_SIZE = "75 MB to download, 190 MB installed"
"""Price of the extra ``cuda``: cuda-core, cuda-bindings and the compiler NVRTC."""
NOT_YET_RUN = "experimental: compiled and checked on processors, not yet run on a device"

THREADS_PER_BLOCK = 64
SYSTEM_INCLUDE = re.compile(r"#include <\w+\.h>\n")
OPTIONS: dict[str, Any] = {
    "std": "c++20",
    "device_as_default_execution_space": True,
    "define_macro": "SCVI_DEVICE",
    "diag_suppress": [161, 177, 550, 20044],  # pragmas of GCC, functions and variables that a program does not use
}
"""Options of NVRTC, which contracts products and sums (fused multiply-add) by default, as on processors."""


def kernel_text(source: Source) -> str:
    """Return an ensemble source as one text without headers of the standard library: C99 and CUDA C++."""
    whole = source.amalgamated()
    text = whole.code.replace(f'#include "{source.prefix}.h"', whole.declarations)
    return SYSTEM_INCLUDE.sub("", text)


def compiled_kernel(text: str, architecture: str, **options: Any) -> bytes:
    """Return the binary (cubin) for an architecture such as ``"sm_90"``, from the cache or compiled now."""
    settings = {**OPTIONS, **options}

    def compiled() -> str:
        with announced(f"compiling {text.count(chr(10)):,} lines of CUDA C++ for {architecture}"):
            return base64.b64encode(build(text, architecture, **options)).decode("ascii")

    key = ("cubin", text, repr(sorted(settings.items())), compiler_version(), architecture)
    return base64.b64decode(cached_source(key, compiled))


def build(text: str, architecture: str, *, log: Any = None, **options: Any) -> bytes:
    """Return the binary of a text by NVRTC, whose messages are written to ``log``."""
    core = cuda_core()
    settings = core.ProgramOptions(arch=architecture, **{**OPTIONS, **options})
    try:
        code = core.Program(text, "c++", settings).compile("cubin", logs=log).code
    except Exception as error:  # of NVRTC, whose classes depend on the versions of cuda-core
        raise BuildError(f"NVRTC rejected the kernel for {architecture}: {error}") from error
    return bytes(code)


def cuda_core() -> Any:
    """Return the package ``cuda.core``; MissingLibraryError if it, its bindings or NVRTC are not installed."""
    imported("cuda.bindings", CUDA)
    return imported("cuda.core", CUDA)


@cache
def compiler_version() -> str:
    """Return the version of NVRTC."""
    status, major, minor = imported("cuda.bindings.nvrtc", CUDA).nvrtcVersion()
    return f"{major}.{minor}" if not int(status) else ""


class Device:
    """The current GPU: compiled kernels, memory, and launches in the order of one stream.

    Raises:
        MissingLibraryError: without the extra ``cuda``.
        BuildError: without a driver or a device.
    """

    def __init__(self) -> None:
        self.core = cuda_core()
        try:
            self.device = self.core.Device()
            self.device.set_current()
            self.stream = self.device.create_stream()
        except Exception as error:  # of the driver, whose classes depend on the versions of cuda-core
            raise BuildError(
                f"device='cuda' requires an NVIDIA GPU with its driver, and none was found ({error}): omit device to "
                "use the processor"
            ) from error
        self.architecture = f"sm_{self.device.arch}"

    def kernels(self, source: Source) -> Callable[..., None]:
        """Return a function that runs a kernel of a source: its name, the number of threads, and its arguments."""
        code = compiled_kernel(kernel_text(source), self.architecture)
        loaded = self.core.ObjectCode.from_cubin(code)
        by_name: dict[str, Any] = {}

        def run(name: str, threads: int, *arguments: Any) -> None:
            if name not in by_name:
                by_name[name] = loaded.get_kernel(f"{source.prefix}_{name}")
            blocks = -(-threads // THREADS_PER_BLOCK)
            config = self.core.LaunchConfig(grid=blocks, block=THREADS_PER_BLOCK)
            self.core.launch(self.stream, config, by_name[name], *map(self._argument, arguments))
            self.stream.sync()

        return run

    def _argument(self, value: Any) -> Any:
        return np.uint64(value.ptr) if isinstance(value, self.core.utils.StridedMemoryView) else value

    def empty(self, shape: tuple[int, ...], kind: Any = np.float64) -> Any:
        """Return an array of the device, all bits 1 (NaN)."""
        size = int(np.prod(shape, dtype=object)) * np.dtype(kind).itemsize
        try:
            buffer = self.device.allocate(size, stream=self.stream)
        except Exception as error:  # of the driver
            raise BuildError(
                f"the GPU cannot allocate {size / 2**30:.3g} GiB for states of shape {shape} ({error}): raise "
                "save_every, or split the ensemble"
            ) from error
        buffer.fill(255, stream=self.stream)
        return self.core.utils.StridedMemoryView.from_buffer(buffer, shape, dtype=np.dtype(kind))

    def copy_in(self, array: NDArray[Any], target: Any) -> None:
        """Copy an array of the processor to the beginning of one of the device."""
        array = np.ascontiguousarray(array)
        self._part(target.ptr, array).copy_from(self._part(array.ctypes.data, array), stream=self.stream)
        self.stream.sync()

    def copied(self, array: NDArray[Any]) -> Any:
        """Return a copy on the device."""
        target = self.empty(array.shape, array.dtype)
        self.copy_in(array, target)
        return target

    def copy_out(self, source: Any) -> NDArray[Any]:
        """Return a copy on the processor."""
        array = np.empty(source.shape, source.dtype)
        self._part(source.ptr, array).copy_to(self._part(array.ctypes.data, array), stream=self.stream)
        self.stream.sync()
        return array

    def copy_of(self, array: Any) -> NDArray[Any]:
        """Return a copy on the processor of an array with ``__dlpack__``, which may be a view with strides."""
        view = self.core.utils.StridedMemoryView.from_dlpack(array, stream_ptr=int(self.stream.handle))
        copy = np.empty(view.shape, view.dtype)
        view.copy_to(self.core.utils.StridedMemoryView.from_dlpack(copy, stream_ptr=-1), self.stream, blocking=True)
        return copy

    def _part(self, address: int, array: NDArray[Any]) -> Any:
        """Return the memory of as many bytes as an array from an address on."""
        return self.core.Buffer.from_handle(address, array.nbytes)


def has_device_memory(array: object) -> bool:
    """Return whether an array is in the memory of a CUDA device (DLPack's kDLCUDA)."""
    described = getattr(array, "__dlpack_device__", None)
    return described is not None and int(described()[0]) == 2
