"""Draw the work-precision curves of ``docs/work_precision.svg`` from recorded measurements, ``benchmarks/curves.json``.

python -m benchmarks precision:kepler:0.5 .. -o report.json
python tests/tools/remake_curves.py [report.json]

Cases of a report replace those recorded before; each has its own date and machine. Times are minima.
"""

import json
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from benchmarks.plots import label_times
from benchmarks.report import OURS, Point, frontier
from scvi_codegen.interfaces.pictures.canvas import COLORS, save, style

ROOT = Path(__file__).resolve().parents[2]
RECORD, PICTURE = ROOT / "benchmarks" / "curves.json", ROOT / "docs" / "work_precision.svg"
COLUMNS, PANEL = 3, (3.4, 2.7)
MAIN = f"{OURS} svi:8"
SLOWEST = 100.0
"""Longest time in a panel, relative to the shortest one."""


def title_of(name: str) -> str:
    """Return the name of a problem; chaotic motions among the cases of adaptive steps are named as such."""
    plain = name.removeprefix("precision:")
    return plain.replace("adaptive:double-pendulum", "double-pendulum, tumbling").removeprefix("adaptive:")


def recorded_case(case: dict[str, Any], machine: dict[str, Any]) -> dict[str, Any]:
    """Return the part of a case of a report that is recorded: error and milliseconds by method."""
    curves: dict[str, list[list[float]]] = {}
    for each in case["measurements"]:
        if not each["failure"] and each["error"]:
            point = [float(f"{each['error']:.3g}"), float(f"{1e3 * each['fastest']:.4g}")]
            curves.setdefault(each["method"], []).append(point)
    where = {key: machine[key] for key in ("processor", "cores", "load")}
    return {"date": f"{datetime.now(UTC):%Y-%m-%d}", **where, "curves": curves}


def points_of(curve: list[list[float]]) -> list[Point]:
    """Return the measured points of a method."""
    return [Point(seconds=1e-3 * time, error=error) for error, time in curve]


def draw(record: dict[str, Any]) -> Any:
    """Return the figure: a panel for each problem, SVI(8) thick, other degrees grey, peers in colours."""
    from matplotlib.figure import Figure

    lines = -(-len(record) // COLUMNS)
    figure = Figure(figsize=(PANEL[0] * COLUMNS, PANEL[1] * lines + 0.5), layout="constrained")
    panels = figure.subplots(lines, COLUMNS, squeeze=False).ravel()
    peers = sorted({name for case in record.values() for name in case["curves"] if not name.startswith(OURS)})
    colors = dict(zip(peers, COLORS[1:], strict=False))
    handles = {}
    for panel, (name, case) in zip(panels, record.items(), strict=False):
        for method, curve in sorted(case["curves"].items(), key=lambda each: each[0] == MAIN):
            points = frontier(points_of(curve), floor=0.0)
            x, y = [1e3 * each.seconds for each in points], [each.error for each in points]
            is_main, ours = method == MAIN, method.startswith(OURS)
            look = {"color": COLORS[0] if is_main else "#bbbbbb" if ours else colors.get(method, "#555555")}
            label = MAIN if is_main else f"{OURS}, degrees 2 to 12" if ours else method
            (handles[label],) = panel.plot(x, y, **look, linewidth=2.0 if is_main else 0.8 if ours else 1.2)
        panel.set(xscale="log", yscale="log", title=title_of(name))
        panel.set_ylim(1e-15, 1e-1)
        panel.minorticks_off()
        shortest = min(time for curve in case["curves"].values() for _, time in curve)
        panel.set_xlim(0.8 * shortest, SLOWEST * shortest)
        panel.title.set_fontsize(9)
        label_times(panel)
    for panel in panels[len(record) :]:
        panel.set_visible(False)
    figure.supxlabel("time of a trajectory, ms", fontsize=10)
    figure.supylabel("relative error at the end", fontsize=10)
    figure.legend([*handles.values()], [*handles], loc="outside upper center", ncols=4)
    return figure


def main() -> None:
    """Record a report, if one is named, and draw the record."""
    record = json.loads(RECORD.read_text(encoding="utf-8")) if RECORD.exists() else {}
    for path in sys.argv[1:]:
        report = json.loads(Path(path).read_text(encoding="utf-8"))
        record |= {case["name"]: recorded_case(case, report["machine"]) for case in report["cases"]}
    RECORD.write_text(json.dumps(record, separators=(",", ":")).replace('"precision:', '\n"precision:') + "\n")
    with style():
        save(draw(record), PICTURE)


if __name__ == "__main__":
    main()
