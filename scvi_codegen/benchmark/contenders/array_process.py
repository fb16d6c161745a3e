"""Measurement of a ring or a field of one size in a fresh process: time to the first step, time per step, memory."""

from __future__ import annotations

import re
import sys
import time
from pathlib import Path

from scvi_codegen.benchmark.cases.large import field, ring
from scvi_codegen.compiler import compile_stepper
from scvi_codegen.ir.kernel import Kernel
from scvi_codegen.ir.program import Program
from scvi_codegen.lowering.program import lower
from scvi_codegen.methods import as_method

STEP_SIZES = {"ring": 0.1, "field": 0.03}
"""Step sizes."""


def _one_size(method: str, name: str, size: int) -> str:
    """Return the measurements of a fresh process."""
    began = time.perf_counter()
    each = {"ring": ring, "field": field}[name](size, 1.0)
    count = each.q.size
    run = compile_stepper(each.system, method).start(each.q, velocity=each.v, h=STEP_SIZES[name])
    run.advance(1)
    first = time.perf_counter() - began
    run.advance(3)
    steps, iterations_before, best = max(3, 3 * 10**5 // count), run.iterations, float("inf")
    for _ in range(7):
        start = time.process_time()
        run.advance(steps)
        best = min(best, (time.process_time() - start) / steps)
    iterations = (run.iterations - iterations_before) / (7 * steps)
    program = lower(each.system, as_method(method), prefix=name)
    rates = [1e-9 * each * count / best for each in (_operations(program, iterations), _bytes(program, iterations))]
    numbers = (first, 1e9 * best / count, iterations, *rates, _most_memory())
    return " ".join(map(repr, numbers))


def _operations(program: Program, iterations_before: float) -> float:
    """Return arithmetic operations per coordinate and step: of kernels, and of the products with tables."""
    force = sum(_counted(each.kernel) for each in program.loops.forces)
    if program.fixed_point is None:
        drifts = program.splitting.drifts if program.splitting is not None else ()
        return sum(map(bool, drifts)) * (force + 4)  # a kick and a drift are each a product and a sum
    points = len(program.fixed_point.guess.abscissae)
    return (iterations_before + program.fixed_point.final_iterations) * points * (force + 2 * points)


def _bytes(program: Program, iterations_before: float) -> float:
    """Return the bytes of arrays read and written per coordinate and step, every array once a loop.

    A fixed-point iteration clears and sums forces and reads positions, then reads forces, positions and state and
    writes positions; a leapfrog step sums increments from positions, then reads momenta, positions and both increments,
    and writes two arrays.
    """
    if program.fixed_point is None:
        return 8.0 * len(program.splitting.drifts if program.splitting else ()) * (3 + 7)
    return 8.0 * (iterations_before + program.fixed_point.final_iterations) * (7 * program.fixed_point.lanes + 3)


def _counted(kernel: Kernel) -> int:
    """Return the operations of a kernel; each result is added to those of other terms."""
    return sum(kernel.operation_counts().values()) + len(kernel.results)


def _most_memory() -> float:
    """Return the peak memory of the process in megabytes, if the system reports it (Linux)."""
    try:  # ru_maxrss would include the parent process
        status = Path("/proc/self/status").read_text(encoding="ascii")
    except OSError:
        return float("nan")
    result = re.search(r"VmHWM:\s+(\d+) kB", status)
    return int(result[1]) / 1024 if result else float("nan")


if __name__ == "__main__":
    print(_one_size(sys.argv[1], sys.argv[2], int(sys.argv[3])))
