"""What a core of this machine can do at most: memory by STREAM's triad, arithmetic by multiply-adds in registers."""

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
PLACES, CHAINS, ROUNDS = 10**7, 96, 2 * 10**6
"""Numbers of an array, several times as many as a cache has (J. D. McCalpin's rule for STREAM); as in the C text."""
TIMES = 5


def machine_limits() -> tuple[float, float]:
    """GB/s of a = b + s c, each number counted once as STREAM does, and GFLOP/s; of one core, the best of some."""
    code = files("scvi_codegen.benchmark").joinpath("machine_limits.c").read_text(encoding="utf-8")
    source = Source(prefix="machine_limits", header=DECLARATIONS, code=code, declarations=DECLARATIONS)
    library = building.load(source, flags=building.TUNED_FLAGS)
    arrays = [library.ffi.from_buffer("double[]", np.ones(PLACES)) for _ in range(3)]
    memory = _best(lambda: library.lib.triad(*arrays, 3.0, PLACES))
    arithmetic = _best(lambda: library.lib.multiply_adds(ROUNDS))
    return 24e-9 * PLACES / memory, 2e-9 * ROUNDS * CHAINS / arithmetic


def _best(work: Callable[[], object]) -> float:
    seconds = []
    for _ in range(TIMES):
        began = time.process_time()
        work()
        seconds.append(time.process_time() - began)
    return min(seconds)
