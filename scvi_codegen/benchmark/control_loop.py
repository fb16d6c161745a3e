"""Benchmark of a control step: set an input, step, read the state; compared with the bare C function and NumPy."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from scvi_codegen.benchmark.settings import Plan, ReportActivity
from scvi_codegen.benchmark.tables import ResultTable
from scvi_codegen.compiler import compile_stepper, generate_source
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.runtime.core.stepper import Stepper

__all__ = ["Sampling", "run_control_loop"]

CALLS = 20_000
"""Number of calls of each kind in a round."""
STEP = 0.01
METHODS = ("svi:2", "svi:4")
PUSH = 0.1
SYSTEMS = {
    "pendulum": LagrangianSystem.from_text(
        name="pushed pendulum",
        coordinates=["q"],
        lagrangian="q_dot**2/2 + cos(q)",
        forces={"q": "u"},
        inputs=["u"],
    ),
    "cart-pole": LagrangianSystem.from_text(
        name="cart and pole",
        coordinates=["x", "a"],
        lagrangian="(M + m)*x_dot**2/2 + m*l*x_dot*a_dot*cos(a) + m*l**2*a_dot**2/2 - m*g*l*cos(a)",
        parameters={"M": 1.0, "m": 0.2, "l": 0.5, "g": 9.81},
        forces={"x": "u"},
        inputs=["u"],
    ),
}


class Sampling:
    """Steps from one state, by each way of performing them.

    Attributes:
        held, advanced: runs whose input is set before every step, and once.
        calls: a function without arguments for each column.
    """

    def __init__(self, system: LagrangianSystem, method: str) -> None:
        stepper, alone = compile_stepper(system, method), Stepper(*generate_source(system, method))
        at = np.full(stepper.dimension, 0.3)
        self.advanced, self.held, bare = (each.start(at, 0.0 * at, h=STEP) for each in (stepper, stepper, alone))
        for run in (self.advanced, bare):
            run.set_inputs(u=PUSH)
        binding, self._values = alone.binding, bare.parameters
        self._memory, report, room = binding.new("run *"), binding.new("report *"), binding.workspace()
        binding.buffer(self._memory)[:] = bare.checkpoint()
        step, values, null = binding.function("advance", self._memory), binding.pointer(self._values), binding.null
        self.calls: dict[str, Callable[[], object]] = {
            "bare": lambda: step(1, 2**53, values, null, null, null, null, null, report, room),
            "assign": self._assign,
            "hold": lambda: self.advanced.set_inputs(u=PUSH),
            "advance": lambda: self.advanced.advance(1),
            "sample": self._sample,
            "look": lambda: (self.advanced.q, self.advanced.p),
        }

    def _assign(self) -> None:
        self._values[-5:] = PUSH, 0.0, 0.0, 0.0, 0.0

    def _sample(self) -> None:
        self.held.set_inputs(u=PUSH)
        self.held.advance(1)

    def states(self) -> list[list[float]]:
        """Return the positions of each run."""
        return [self.advanced.q.tolist(), self.held.q.tolist(), list(self._memory.q)]


def run_control_loop(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure microseconds per call: minima of processor time, all in turn, round after round."""
    rows = []
    for name, system in SYSTEMS.items():
        for method in METHODS:
            report_activity(f"samples: {name} by {method}")
            times = _fastest(Sampling(system, method).calls, plan)
            over = {"hold_over": times["hold"] - times["assign"], "advance_over": times["advance"] - times["bare"]}
            rows.append({"system": name, "by": method} | times | over)
    return ResultTable(
        name="control-loop",
        title="microseconds per control step",
        columns={"system": "", "by": ""}
        | dict.fromkeys([key for key in rows[0] if key not in ("system", "by")], ".2f"),
        rows=tuple(rows),
        remarks=(
            "bare: C's function, called with pointers at hand, a step; assign: NumPy's, of the five numbers of an",
            "input; hold: run.set_inputs(u=...); advance: run.advance(1); sample: both; look: run.q and run.p; over:",
            "what a call costs beyond NumPy's, and C's. Minima of processor time; a call from a Python function is in",
            "each.",
        ),
    )


def _fastest(calls: dict[str, Callable[[], object]], plan: Plan) -> dict[str, Any]:
    """Return the microseconds of each."""
    count, best = max(1, int(CALLS * plan.share)), dict.fromkeys(calls, float("inf"))
    for _ in range(plan.rounds):
        for name, call in calls.items():
            began = time.process_time()
            for _ in range(count):
                call()
            best[name] = min(best[name], 1e6 * (time.process_time() - began) / count)
    return best
