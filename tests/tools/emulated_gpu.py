"""Emulated GPU: what the package calls of ``cuda.core``, on the processor, for tests of the driver without a device.

Kernels are compiled as C99; threads run one after the other. Arguments of types that launches do not pass as 8 bytes,
and writes beyond the ends of an array, are errors.
"""

from __future__ import annotations

import ctypes
import hashlib
import subprocess
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from weakref import WeakSet

import numpy as np

HEADERS = "#include <float.h>\n#include <math.h>\n#include <stdint.h>\n#include <string.h>\n"
THREAD = "long long trajectory; /* number of the thread */\n"
ESTIMATE = """static inline double device_inverse_root(double x)
{
  uint64_t bits;
  memcpy(&bits, &x, 8), bits &= ~0xffffffffULL, memcpy(&x, &bits, 8);
  x = 1.0 / sqrt(x);
  memcpy(&bits, &x, 8), bits &= ~0xffffffffULL, memcpy(&x, &bits, 8);
  return x;
}
"""
"""x^(-1/2) from the high words, as rsqrt.approx.ftz.f64 computes it to 20 bits; a device may round differently."""
PRELUDE = """#define SCVI_DEVICE
#define KERNEL void
#define TRAJECTORY trajectory
"""
WARNINGS = ("-Wall", "-Werror", "-Wno-unused-function", "-Wno-psabi", "-Wno-unused-but-set-variable")
FLAGS = ("-std=gnu99", "-O0", "-ffp-contract=off")
GUARD = 64
"""Bytes before and after each array, which no kernel may change."""
PATTERN = 0xA5


def library_of(text: str, folder: Path, *flags: str) -> Path:
    """Return the shared library of a C text in a folder."""
    (folder / "kernel.c").write_text(text, encoding="utf-8")
    command = ["cc", *FLAGS, *flags, "-shared", "-fPIC", "kernel.c", "-lm", "-o", "kernel.so"]
    subprocess.run(command, cwd=folder, check=True)
    return folder / "kernel.so"


class EmulatedGpu:
    """Stands for the module ``cuda.core``.

    Attributes:
        compiled: architectures for which kernels were compiled.
        launches: names of the kernels launched, with their numbers of threads.
        memory: largest number of bytes of an allocation.
        estimates: whether inverse roots begin with an estimate, as on a device; else with division and square root.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.memory, self.estimates = folder, 2**30, False
        self.compiled: list[str] = []
        self.launches: list[tuple[str, int]] = []
        self.buffers: WeakSet[Buffer] = WeakSet()
        self.ProgramOptions, self.LaunchConfig = SimpleNamespace, SimpleNamespace
        self.Device = lambda: _Device(self)
        self.Buffer, self.utils = Buffer, SimpleNamespace(StridedMemoryView=View)
        self.ObjectCode = SimpleNamespace(from_cubin=self._load)

    @property
    def version(self) -> str:
        """Version of the compiler, which depends on this file."""
        return f"{hashlib.sha256(Path(__file__).read_bytes()).hexdigest()} {self.estimates}"

    def Program(self, text: str, language: str, options: Any) -> Any:
        """Stand for the compiler; the ``cubin`` is a shared library."""
        assert language == "c++"
        assert options.define_macro == "SCVI_DEVICE"

        def compile_text(form: str, logs: object = None) -> Any:
            assert form == "cubin"
            self.compiled.append(options.arch)
            with tempfile.TemporaryDirectory(dir=self.folder) as folder:
                return SimpleNamespace(code=self._compiled(text, Path(folder)).read_bytes())

        return SimpleNamespace(compile=compile_text)

    def _compiled(self, text: str, folder: Path) -> Path:
        estimate = f"{ESTIMATE}#define SCVI_INVERSE_ROOT device_inverse_root\n" if self.estimates else ""
        return library_of(HEADERS + THREAD + estimate + PRELUDE + text, folder, *WARNINGS)

    def _load(self, code: bytes) -> Any:
        path = Path(tempfile.mkdtemp(dir=self.folder), "kernel.so")
        path.write_bytes(code)
        library = ctypes.CDLL(str(path))  # a path of its own, because a process loads a path once
        return SimpleNamespace(get_kernel=lambda name: (name, library))

    def launch(self, stream: Any, config: Any, kernel: tuple[str, Any], *arguments: Any) -> None:
        """Run all threads of a kernel in turn."""
        name, library = kernel
        self.launches.append((name.rpartition("_")[2], config.grid * config.block))
        function = getattr(library, name)
        function.restype = None
        passed = [KINDS[type(each)](each) for each in arguments]
        number = ctypes.c_longlong.in_dll(library, "trajectory")
        for number.value in range(config.grid * config.block):
            function(*passed)
        for buffer in self.buffers:
            buffer.check()


KINDS: dict[type, Any] = {
    int: ctypes.c_longlong,
    float: ctypes.c_double,
    np.uint64: lambda value: ctypes.c_void_p(int(value)),
}
"""Types of arguments that launches accept, as C passes them."""


@dataclass
class _Device:
    gpu: EmulatedGpu
    arch: str = "90"

    def set_current(self) -> None:
        """Do nothing: there is one device."""

    def create_stream(self) -> Any:
        """Return a stream in which everything has happened."""
        return SimpleNamespace(sync=lambda: None, handle=0)

    def allocate(self, size: int, *, stream: Any) -> Buffer:
        """Return memory between two guards."""
        if size > self.gpu.memory:
            raise RuntimeError("CUDA_ERROR_OUT_OF_MEMORY")
        memory = np.full(size + 2 * GUARD, PATTERN, np.uint8)
        buffer = Buffer(memory.ctypes.data + GUARD, size, memory)
        self.gpu.buffers.add(buffer)
        return buffer


@dataclass(eq=False)
class Buffer:
    """Memory at an address."""

    handle: int
    size: int
    memory: Any = field(default=None, repr=False)

    @staticmethod
    def from_handle(address: int, size: int) -> Buffer:
        """Return the memory at an address of a process."""
        return Buffer(address, size)

    def fill(self, value: int, *, stream: Any) -> None:
        """Set all bytes."""
        ctypes.memset(self.handle, value, self.size)

    def copy_from(self, other: Buffer, *, stream: Any) -> None:
        """Copy as many bytes as the other has."""
        assert other.size == self.size
        ctypes.memmove(self.handle, other.handle, self.size)

    def copy_to(self, other: Buffer, *, stream: Any) -> None:
        """Copy all bytes."""
        other.copy_from(self, stream=stream)

    def check(self) -> None:
        """Fail if a guard has changed."""
        assert (self.memory[:GUARD] == PATTERN).all()
        assert (self.memory[GUARD + self.size :] == PATTERN).all()


class View:
    """Array with DLPack; like those of a GPU it has no buffer protocol."""

    def __init__(self, array: Any, owner: Any) -> None:
        self._array, self._owner = array, owner
        self.ptr, self.shape, self.dtype = array.ctypes.data, array.shape, array.dtype

    @staticmethod
    def from_buffer(buffer: Buffer, shape: tuple[int, ...], *, dtype: Any) -> View:
        """Return the array in memory that was allocated."""
        inner = buffer.memory[GUARD : GUARD + buffer.size]
        return View(inner.view(dtype).reshape(shape), buffer)

    @staticmethod
    def from_dlpack(array: Any, stream_ptr: int) -> View:
        """Return a view of another library's array."""
        return View(np.from_dlpack(getattr(array, "of_library", array)), array)

    def copy_to(self, other: View, stream: Any, blocking: bool) -> None:
        """Copy all elements."""
        other._array[...] = self._array

    def __dlpack__(self, **arguments: Any) -> Any:
        return self._array.__dlpack__(**arguments)

    def __dlpack_device__(self) -> tuple[int, int]:
        return (1, 0)


class ArrayOfLibrary:
    """Array of another library, such as CuPy, in the memory of the emulated device (DLPack's kDLCUDA)."""

    def __init__(self, array: Any) -> None:
        self.of_library = array

    def __dlpack_device__(self) -> tuple[int, int]:
        return (2, 0)

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise TypeError("implicit conversion to a NumPy array is not allowed")
