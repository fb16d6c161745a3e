"""Draw the charts of ``docs/performance.md`` from recorded measurements, ``benchmarks/curves.json``.

python -m benchmarks precision:kepler:0.5 .. -o report.json
python tests/tools/remake_curves.py [report.json]

Cases and tables of a report replace those recorded before; each has its own date and machine. Times are minima.
"""

import json
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from benchmarks.plots import label_times
from benchmarks.report import OURS, Point, common_error, frontier, time_at
from scvi_codegen.extras.pictures.canvas import COLORS, save, style

ROOT = Path(__file__).resolve().parents[2]
RECORD, DOCS = ROOT / "benchmarks" / "curves.json", ROOT / "docs"
COLUMNS, PANEL = 3, (3.4, 2.7)
RECORDED = ("precision", "scaling", "ensemble", "contact")
"""Beginnings of the names of recorded cases and tables."""
ROUNDING = 1e-16
"""Smallest error of the chart of contacts."""
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
        if not each["failure"] and each["error"] is not None:
            point = [float(f"{each['error']:.3g}"), float(f"{1e3 * each['fastest']:.4g}")]
            curves.setdefault(each["method"], []).append(point)
    return {**measured_on(machine), "curves": curves}


def measured_on(machine: dict[str, Any]) -> dict[str, Any]:
    """Return the date, and what is recorded of the machine."""
    return {"date": f"{datetime.now(UTC):%Y-%m-%d}", **{key: machine[key] for key in ("processor", "cores", "load")}}


def points_of(curve: list[list[float]]) -> list[Point]:
    """Return the measured points of a method."""
    return [Point(seconds=1e-3 * time, error=error) for error, time in curve]


def cases_of(record: dict[str, Any], section: str) -> dict[str, Any]:
    """Return the recorded cases of a section by their names in it."""
    return {name.removeprefix(f"{section}:"): case for name, case in record.items() if name.startswith(f"{section}:")}


def draw_scaling(record: dict[str, Any]) -> Any:
    """Return the figure: nanoseconds per coordinate and step against the number of coordinates, a line a method."""
    figure, panel = chart(xlabel="coordinates", ylabel="ns per coordinate and step", xscale="log", yscale="log")
    rows = record["scaling"]["rows"]
    for color, method in zip(COLORS, [name for name in rows[0] if name != "coordinates"], strict=False):
        line = [row[method] for row in rows]
        panel.plot([row["coordinates"] for row in rows], line, "o-", color=color, label=method)
    panel.legend()
    return figure


def draw_ensembles(record: dict[str, Any]) -> Any:
    """Return the figure: milliseconds of a trajectory at the smallest error that all methods reach, a bar a method."""
    cases = cases_of(record, "ensemble")
    methods = list(dict.fromkeys(method for case in cases.values() for method in case["curves"]))
    figure, panel = chart(ylabel="ms per trajectory", xticks=range(len(cases)))
    panel.set_xticklabels(cases)
    for n, method in enumerate(methods):
        heights = []
        for case in cases.values():
            curves = {name: points_of(curve) for name, curve in case["curves"].items()}
            ours = next(points for name, points in curves.items() if name.startswith(OURS))
            error = max(common_error(ours, points) or 0.0 for points in curves.values())
            heights.append(1e3 * (time_at(curves.get(method, []), error) or 0.0))
        places = [k + (n - (len(methods) - 1) / 2) * 0.8 / len(methods) for k in range(len(cases))]
        panel.bar(places, heights, 0.8 / len(methods), color=COLORS[n], label=method)
    panel.legend()
    return figure


def draw_contacts(record: dict[str, Any]) -> Any:
    """Return the figure: smallest error against its time, a marker a motion, a colour a program."""
    cases = cases_of(record, "contact")
    figure, panel = chart(xlabel="time of a run, ms", ylabel="error", xscale="log", yscale="log")
    programs = list(dict.fromkeys(name.split()[0] for case in cases.values() for name in case["curves"]))
    for marker, (motion, case) in zip("osD^vP*", cases.items(), strict=False):
        for name, curve in case["curves"].items():
            best = min(points_of(curve), key=lambda point: (point.error, point.seconds))
            color = COLORS[programs.index(name.split()[0])]
            panel.plot(1e3 * best.seconds, max(best.error, ROUNDING), marker, color=color)
        panel.plot([], [], marker, color="#555555", label=motion)
    for color, program in zip(COLORS, programs, strict=False):
        panel.plot([], [], "-", color=color, label=program, linewidth=3)
    figure.legend(loc="outside right upper")
    return figure


def chart(**axes: Any) -> tuple[Any, Any]:
    """Return a figure with one panel."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 3.4), layout="constrained")
    panel = figure.subplots()
    panel.set(**axes)
    return figure, panel


def draw(record: dict[str, Any]) -> Any:
    """Return the figure: a panel for each problem, SVI(8) thick, other degrees grey, peers in colours."""
    from matplotlib.figure import Figure

    record = cases_of(record, "precision")
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
        measured = {case["name"]: recorded_case(case, report["machine"]) for case in report["cases"]}
        for table in report["tables"]:
            measured[table["name"]] = {**measured_on(report["machine"]), "rows": table["rows"]}
        record |= {name: case for name, case in measured.items() if name.split(":")[0] in RECORDED}
    lines = ",\n".join(f"{json.dumps(name)}:{json.dumps(each, separators=(',', ':'))}" for name, each in record.items())
    RECORD.write_text("{\n" + lines + "}\n", encoding="utf-8")
    charts = {"work_precision": draw, "scaling": draw_scaling, "ensembles": draw_ensembles, "contact": draw_contacts}
    with style():
        for name, make in charts.items():
            save(make(record), DOCS / f"{name}.svg")


if __name__ == "__main__":
    main()
