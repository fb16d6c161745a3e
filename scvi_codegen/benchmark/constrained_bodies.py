"""Benchmark of constrained bodies: errors of energy and rod lengths of this package and of MuJoCo at equal time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from scvi_codegen.benchmark.contenders.constrained_contenders import (
    LINKAGES,
    PARTS,
    ContenderRun,
    Linkage,
    motion_in_angles,
    mujoco_motion,
    our_motion,
)
from scvi_codegen.benchmark.contenders.contenders import OURS
from scvi_codegen.benchmark.settings import Plan, ReportActivity
from scvi_codegen.benchmark.tables import ResultTable
from scvi_codegen.benchmark.work_precision import FLOOR, Point, error_at

__all__ = ["run_constrained_bodies"]

SPAN = 10.0
METHODS = ("svi:1", "svi:2", "svi:4")
OUR_STEPS = (2000, 1000, 500, 250, 100)
"""Numbers of steps in the span."""
STEPS = (10000, 5000, 2000, 1000)
"""Numbers of steps of MuJoCo, whose default is 5000."""
INTEGRATORS = ("Euler", "implicitfast", "RK4")
LOST = 1.0
"""Energy change, in units of the weight, above which results are not compared."""

Move = Callable[[float, int], ContenderRun]


def run_constrained_bodies(plan: Plan, report_activity: ReportActivity) -> ResultTable:
    """Measure all rows; those of MuJoCo state the reason if it is not installed."""
    rows: list[dict[str, Any]] = []
    for name, make in LINKAGES.items():
        linkage, constrained = make(), []
        for method in METHODS[: 1 if plan.quick else None]:
            report_activity(f"held: {name} by {method}")
            constrained += list(_rows(linkage, f"{OURS} {method}", our_motion(linkage, method), OUR_STEPS, plan))
        angles = [] if linkage.closed else list(_angles(linkage, plan))
        theirs = [row for label, move in _others(linkage) for row in _rows(linkage, label, move, STEPS, plan)]
        curves = {"energy": _points(constrained), "angles": _points(angles)}
        result = [row | _beside(row, curves) for row in theirs] or [{"by": "MuJoCo", "why_not": "pip install mujoco"}]
        rows += [{"bodies": name} | row for row in (*constrained, *angles, *result)]
    return ResultTable(
        name="constrained-bodies",
        title="constrained bodies: errors of energy and rod lengths over ten seconds",
        columns={
            "bodies": "",
            "by": "",
            "h": "g",
            "second_us": ".0f",
            "energy": ".1e",
            "stretch": ".0e",
            "ours_then": ".1e",
            "ratio": ".2g",
            "in_angles_then": ".1e",
            "why_not": "",
        },
        rows=tuple(rows),
        remarks=(
            "second: processor microseconds per second of simulated time; energy: its largest change, in units of",
            "all weights times 1; stretch: of a rod, as a part of its length; ours then: that energy by constraints of",
            "this project at equal time, between its settings; ratio: theirs over ours; in angles: ours in those.",
        ),
    )


def _angles(linkage: Linkage, plan: Plan) -> Iterator[dict[str, Any]]:
    for method in METHODS[-1:]:
        yield from _rows(linkage, f"{OURS} {method}, angles", motion_in_angles(linkage, method), OUR_STEPS, plan)


def _others(linkage: Linkage) -> Iterator[tuple[str, Move]]:
    """Yield MuJoCo's integrators; closed loops also with the stiffest constraint that the step allows."""
    try:
        import mujoco  # noqa: F401  (whether it is there)
    except ImportError:
        return
    for integrator in INTEGRATORS:
        for stiff in (False, True)[: 2 if linkage.closed else 1]:
            label = f"MuJoCo {integrator}{', stiff' * stiff}"
            yield label, mujoco_motion(linkage, integrator, stiff=stiff)


def _rows(linkage: Linkage, by: str, move: Move, counts: Sequence[int], plan: Plan) -> Iterator[dict[str, Any]]:
    """Yield one row for each step size, with the median of the times."""
    span = SPAN * plan.share
    for count in (each for each in counts if each * plan.share >= PARTS):
        h = SPAN / count
        try:
            runs = [move(h, round(span / h)) for _ in range(plan.rounds)]
        except ArithmeticError as error:  # too large a step
            yield {"by": by, "h": h, "why_not": str(error)}
            continue
        energy = runs[0].energy / linkage.weight
        seconds = float(np.median([run.seconds for run in runs]))
        lost = {} if energy < LOST else {"why_not": "step too large: the energy error exceeds the weight"}
        yield {
            "by": by,
            "h": h,
            "second_us": 1e6 * seconds / span,
            "energy": energy,
            "stretch": runs[0].length_error,
        } | lost


def _points(rows: Sequence[dict[str, Any]]) -> list[Point]:
    return [Point(seconds=row["second_us"], error=row["energy"]) for row in rows if "why_not" not in row]


def _beside(row: dict[str, Any], curves: dict[str, list[Point]]) -> dict[str, Any]:
    """Return the errors of this package in the time of a row."""
    if "why_not" in row:
        return {}
    ours, angles = (error_at(curves[name], row["second_us"]) for name in ("energy", "angles"))
    ratio = None if ours is None else row["energy"] / max(ours, FLOOR)
    return {"ours_then": ours, "ratio": ratio, "in_angles_then": angles}
