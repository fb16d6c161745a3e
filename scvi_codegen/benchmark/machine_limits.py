"""Limits of one core of this machine: memory bandwidth by STREAM's triad, arithmetic by multiply-adds in registers."""

from __future__ import annotations

import time
from collections.abc import Callable
from importlib.resources import files

import numpy as np

from scvi_codegen.native import building
from scvi_codegen.rendering.source import Source

__all__ = ["machine_limits"]

DECLARATIONS = (
    "void triad(double *a, const double *b, const double *c, double s, long n);\ndouble multiply_adds(long count);\n"
)
ARRAY_LENGTH, CHAINS, ROUNDS = 10**7, 96, 2 * 10**6
"""Length of an array, several times that of a cache (J. D. McCalpin's rule for STREAM); chains and rounds as in the C
source."""
TIMES = 5


def machine_limits() -> tuple[float, float]:
    """Return GB/s of a = b + s c, each number counted once as in STREAM, and GFLOP/s; of one core, best of several."""
    code = files("scvi_codegen.benchmark").joinpath("machine_limits.c").read_text(encoding="utf-8")
    source = Source(prefix="machine_limits", header=DECLARATIONS, code=code, declarations=DECLARATIONS)
    library = building.load(source, flags=building.TUNED_FLAGS)
    arrays = [library.ffi.from_buffer("double[]", np.ones(ARRAY_LENGTH)) for _ in range(3)]
    memory = _best(lambda: library.lib.triad(*arrays, 3.0, ARRAY_LENGTH))
    arithmetic = _best(lambda: library.lib.multiply_adds(ROUNDS))
    return 24e-9 * ARRAY_LENGTH / memory, 2e-9 * ROUNDS * CHAINS / arithmetic


def _best(work: Callable[[], object]) -> float:
    seconds = []
    for _ in range(TIMES):
        began = time.process_time()
        work()
        seconds.append(time.process_time() - began)
    return min(seconds)
