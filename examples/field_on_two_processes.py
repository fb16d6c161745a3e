"""Domain decomposition of a field on two processes: halo exchange and one reduction per fixed-point iteration.

It models a decomposition over MPI (docs/decomposition.md) with the shared memory of two processes: a Gauss method with
four stages and fixed-point iteration on the positions. Two processes compute the same bits as one, whose states are
those of the compiled integrator. The time of an iteration is compared with the model  c n / P + halo + reduction  for
processes with a core each. Each process has a session of its own, since Linux may schedule by session.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.shared_memory import SharedMemory

import numpy as np

import scvi_codegen as sc

STAGES, MOST, H, STEPS = 4, 50, 0.1, 5
EDGES, BLOCKS = 2, 16
"""Edges of a part; number of blocks in which changes are summed, so that the result does not depend on the number of
processes."""


def tables() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return A, b, c of the Gauss method: integrals of Lagrange's polynomials."""
    x, w = np.polynomial.legendre.leggauss(STAGES)
    c, powers = (x + 1) / 2, np.arange(STAGES)
    a = (c[:, None] ** (powers + 1) / (powers + 1)) @ np.linalg.inv(c[:, None] ** powers)
    return a, w / 2, c


def forces(x: np.ndarray, left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Return the forces of a Fermi-Pasta-Ulam-Tsingou ring at (stages, sites), with a neighbour column on each side."""
    stretch = np.diff(np.concatenate([left, x, right], axis=1), axis=1)
    pull = stretch + stretch**3 / 4
    return np.diff(pull, axis=1)


@dataclass
class Part:
    """Sites of a process, and the memory shared by all.

    Attributes:
        rank, count: index of the process, and number of processes.
        edges: (2, processes, 2, stages) values at the ends of all parts, double-buffered.
        sums: (2, blocks) sums of the squares of changes, double-buffered.
        arrived: (processes,) barrier counters.
    """

    rank: int
    count: int
    edges: np.ndarray
    sums: np.ndarray
    arrived: np.ndarray

    def meet(self) -> None:
        """Wait at a barrier for all processes."""
        self.arrived[self.rank] += 1
        while (self.arrived < self.arrived[self.rank]).any():
            os.sched_yield()

    def neighbours(self, x: np.ndarray, turn: int) -> tuple[np.ndarray, np.ndarray]:
        """Exchange the halo: send the stages at both ends, return those of both neighbours."""
        self.edges[turn, self.rank] = x[:, 0], x[:, -1]
        self.meet()
        left, right = (self.rank - 1) % self.count, (self.rank + 1) % self.count
        return self.edges[turn, left, 1][:, None], self.edges[turn, right, 0][:, None]

    def total(self, moved: np.ndarray, turn: int) -> float:
        """Return the sum of squares over all sites (reduction), the same in all processes."""
        own = BLOCKS // self.count
        for k, block in enumerate(np.split(moved, own, axis=1)):
            self.sums[turn, self.rank * own + k] = np.sum(block * block)
        self.meet()
        return float(self.sums[turn].sum())


def run(part: Part, q: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, int]:
    """Return the positions after all steps, and the number of iterations."""
    (a, b, c), iterations, turn = tables(), 0, 0
    for _ in range(STEPS):
        straight = q + H * c[:, None] * v
        x, change = straight, np.inf
        for _ in range(MOST):
            f = forces(x, *part.neighbours(x, turn))
            moved = straight + H * H * (a @ a @ f) - x
            x, before, change = x + moved, change, part.total(moved, turn)
            iterations, turn = iterations + 1, 1 - turn
            if change == 0.0 or (change >= before and change < 1e-24 * q.size):
                break
        f = forces(x, *part.neighbours(x, turn))
        turn = 1 - turn
        q, v = q + H * v + H * H * (b @ a @ f), v + H * (b @ f)
    return q, iterations


def work(steps: Callable, part: Part, q: np.ndarray, v: np.ndarray, end: np.ndarray, numbers: np.ndarray) -> None:
    """Run the steps of a process."""
    os.setsid()
    places = slice(part.rank * len(q) // part.count, (part.rank + 1) * len(q) // part.count)
    part.meet()
    began, busy = time.perf_counter(), time.process_time()
    end[places], iterations = steps(part, q[places], v[places])
    took = time.perf_counter() - began
    numbers[part.rank] = took, iterations, took - (time.process_time() - busy)


def on_processes(count: int, q: np.ndarray, v: np.ndarray, steps: Callable = run) -> tuple[np.ndarray, float, float]:
    """Return positions after all steps on ``count`` processes, seconds per iteration, and the share without a core."""
    sizes = {"edges": (2, count, EDGES, STAGES), "sums": (2, BLOCKS), "end": q.shape, "numbers": (count, 3)}
    shared = {name: SharedMemory(create=True, size=8 * int(np.prod(shape))) for name, shape in sizes.items()}
    meetings = SharedMemory(create=True, size=8 * count)
    arrays = {name: np.ndarray(sizes[name], buffer=memory.buf) for name, memory in shared.items()}
    arrived = np.ndarray(count, dtype=np.int64, buffer=meetings.buf)
    arrived[:] = 0

    parts = [Part(rank, count, arrays["edges"], arrays["sums"], arrived) for rank in range(count)]
    given = [(steps, part, q, v, arrays["end"], arrays["numbers"]) for part in parts]
    processes = [get_context("fork").Process(target=work, args=each) for each in given]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
        assert process.exitcode == 0
    end, (seconds, iterations, waited) = arrays["end"].copy(), arrays["numbers"].max(axis=0)
    del arrays, arrived, parts, given, processes
    for memory in (*shared.values(), meetings):
        memory.close()
        memory.unlink()
    return end, seconds / iterations, waited / seconds


def best(count: int, size: int) -> tuple[np.ndarray, float, float]:
    """Return the final state, the smallest of three times of an iteration, and the share of it without a core."""
    phase = 2 * np.pi * np.arange(size) / size
    found = [on_processes(count, np.sin(phase), np.cos(3 * phase)) for _ in range(3)]
    return found[0][0], *min(times for _, *times in found)


def main() -> None:
    """Compare bits, states, and times with those of the model."""
    ring = sc.LagrangianSystem.from_text(
        name="ring",
        coordinates=["q[N]"],
        lagrangian="sum(i in N, q_dot[i]**2/2) - sum(i in N periodic, (q[i+1] - q[i])**2/2 + (q[i+1] - q[i])**4/16)",
    )
    size = 16_000
    phase = 2 * np.pi * np.arange(size) / size
    exact = sc.compile_stepper(ring, "gauss:4").integrate(np.sin(phase), velocity=np.cos(3 * phase), h=H, steps=STEPS)
    one, two = (best(count, size)[0] for count in (1, 2))
    print("two processes have the bits of one:", bool((one == two).all()))
    print("and the states of the compiled integrator:", bool(np.abs(two - exact.q["q"][-1]).max() < 1e-14))

    sizes = (1600, 8000, 32_000)
    measured = {count: np.array([best(count, size)[1:] for size in sizes]) for count in (1, 2)}
    times, waited = ({count: found[:, k] for count, found in measured.items()} for k in (0, 1))
    per_element = (times[1][-1] - times[1][0]) / (sizes[-1] - sizes[0])
    alone = times[1][0] - per_element * sizes[0]
    exchange = max(0.0, times[2][0] - alone - per_element * sizes[0] / 2)
    print(f"c = {1e9 * per_element:.0f} ns per element; halo and reduction: {1e6 * exchange:.0f} us")
    for size, seconds in zip(sizes, times[2], strict=True):
        model = alone + per_element * size / 2 + exchange
        print(f"{size} elements on two: {1e3 * seconds:.3f} ms per iteration, by the model {1e3 * model:.3f}")
    if (most := max(map(np.max, waited.values()))) > 0.1:
        print(f"other processes used the cores for up to {100 * most:.0f} % of these times: the model cannot be judged")


if __name__ == "__main__":
    main()
