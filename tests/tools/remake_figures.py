"""Write the figures of single trajectories that README and ``docs/performance.md`` state, ``benchmarks/figures.json``.

python -m benchmarks planar-pendulum duffing kepler henon-heiles outer-solar-system double-pendulum \
    relativistic-particle fput-chain --peers heyoka -o report.json
python tests/tools/remake_figures.py [report.json]

Cases of a report replace those recorded before. The pages are written from the record; a test compares them with it.
"""

import json
import re
import sys
import textwrap
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from benchmarks.report import OURS

ROOT = Path(__file__).resolve().parents[2]
RECORD = ROOT / "benchmarks" / "figures.json"
METHOD = f"{OURS} svi:8"
SOLAR = "outer-solar-system"
TITLES = {
    "planar-pendulum": "pendulum, T = 1000",
    "duffing": "Duffing oscillator, T = 2000",
    "kepler:0.2": "Kepler e = 0.2, T = 2000",
    "kepler:0.5": "Kepler e = 0.5, T = 2000",
    "henon-heiles": "Henon-Heiles, T = 1000",
    SOLAR: "outer solar system, 200,000 days",
    "double-pendulum": "double pendulum, T = 1000",
    "relativistic-particle": "relativistic particle (heyoka: Hamilton's equations), T = 1000",
    "fput-chain:8": "FPUT chain of 8, T = 1000",
    "fput-chain:64": "FPUT chain of 64, T = 1000",
}
"""Problems of the first rows of the table of docs/performance.md, by the names of their cases."""


def recorded_case(case: dict[str, Any]) -> dict[str, float] | None:
    """Return what is recorded of a case of a report: the common error, milliseconds there and ratios of heyoka."""
    row = next(row for row in case["rows"] if row["method"] == METHOD)
    if row["default"] is None:
        return None
    figures = {"error": row["at_error"], "ms": 1e3 * row["seconds"], "default": row["default"], "best": row["best"]}
    return {key: float(f"{value:.3g}") for key, value in figures.items()}


def update(record: dict[str, Any], report: dict[str, Any]) -> None:
    """Replace the recorded cases by those of a report."""
    cases = {case["name"]: recorded_case(case) for case in report["cases"] if case["name"] in TITLES}
    record["trajectories"]["rows"] |= {name: case for name, case in cases.items() if case}
    record["trajectories"] |= {"date": f"{datetime.now(UTC):%Y-%m-%d}", "processor": report["machine"]["processor"]}


def rounded(value: float) -> str:
    """Return two digits without an exponent."""
    return f"{value:.1f}" if 1.0 <= value < 10.0 else f"{value:.0f}" if value >= 10.0 else f"{value:.2f}"


def table(record: dict[str, Any]) -> str:
    """Return the first rows of the table of docs/performance.md."""
    rows = record["trajectories"]["rows"]
    lines = []
    for position, (name, title) in enumerate(TITLES.items()):
        row = rows[name]
        heyoka, by_default, at_best = ("heyoka ", " by default", " at best") if position == 0 else ("", "", "")
        ratios = f"{heyoka}{rounded(row['default'])}{by_default}, {rounded(row['best'])}{at_best}"
        lines.append(f"| {title} | {row['error']:.0e} | {rounded(row['ms'])} ms | {ratios} |\n".replace("e-0", "e-"))
    return "".join(lines)


def claim(record: dict[str, Any]) -> str:
    """Return the figures of the README."""
    rows = record["trajectories"]["rows"]
    solar, others = rows[SOLAR], [row["default"] for name, row in rows.items() if name != SOLAR]
    least, most = rounded(min(others)), rounded(max(others))
    return (
        f"One core integrates these 200,000 days in {rounded(solar['ms'])} ms at an error of {solar['error']:.0e}. "
        "heyoka, an adaptive Taylor integrator compiled by LLVM, takes "
        f"{rounded(solar['default'])} times as long, and {least} to {most} times as long on the other problems"
    )


def with_table(page: str, record: dict[str, Any]) -> str:
    """Return docs/performance.md with the recorded rows."""
    titles = list(TITLES.values())
    first, last = titles[0], titles[-1]
    return re.sub(
        rf"\| {re.escape(first)} .*?\n\| {re.escape(last)} [^\n]*\n", lambda _: table(record), page, flags=re.S
    )


def with_claim(page: str, record: dict[str, Any]) -> str:
    """Return the README with the recorded figures, in lines of the width of the page."""
    start = "* **Fast.** "
    lines = textwrap.fill(start + claim(record), 120, subsequent_indent="  ", break_on_hyphens=False)
    return re.sub(rf"{re.escape(start)}One core integrates.*?on the other problems", lambda _: lines, page, flags=re.S)


def with_date(page: str, record: dict[str, Any]) -> str:
    """Return docs/claims.md with the date and the machine of the record."""
    measured = f"measured on {record['trajectories']['date']} on an {record['trajectories']['processor']}"
    return re.sub(r"measured on \d{4}-\d\d-\d\d on an [^;]*", lambda _: measured, page)


PAGES = {"README.md": with_claim, "docs/performance.md": with_table, "docs/claims.md": with_date}


def main() -> None:
    """Update the record by a report, if one is named, and write the pages."""
    record = json.loads(RECORD.read_text(encoding="utf-8"))
    if len(sys.argv) > 1:
        update(record, json.loads(Path(sys.argv[1]).read_text(encoding="utf-8")))
        RECORD.write_text(json.dumps(record, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    for name, written in PAGES.items():
        path = ROOT / name
        path.write_text(written(path.read_text(encoding="utf-8"), record), encoding="utf-8")


if __name__ == "__main__":
    main()
