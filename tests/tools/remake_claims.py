"""Write the page on claims, ``docs/claims.md``, from recorded measurements.

python -m benchmarks planar-pendulum kepler outer-solar-system --peers heyoka -o benchmarks/recorded.json
python tests/tools/remake_claims.py

The record is what ``-o`` writes, with the key ``date``, without the single settings of each method.
"""

# ruff: noqa: E501  (rows of tables)

import json
import re
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
RECORD = ROOT / "benchmarks" / "recorded.json"
PAGE = ROOT / "docs" / "claims.md"
TITLES = {
    "planar-pendulum": "pendulum, T = 1000",
    "duffing": "Duffing oscillator, T = 2000",
    "kepler:0.2": "Kepler e = 0.2, T = 2000",
    "kepler:0.5": "Kepler e = 0.5, T = 2000",
    "henon-heiles": "Henon-Heiles, T = 1000",
    "outer-solar-system": "outer solar system, 200,000 days",
}
"""Rows of the table of ``docs/performance.md`` by section of the benchmark."""


def record(measured: dict[str, Any], day: str) -> dict[str, Any]:
    """Return the part of a report that is recorded."""
    cases = [{"name": case["name"], "rows": case["rows"]} for case in measured["cases"]]
    return {"date": day, "machine": measured["machine"], "cases": cases}


def rows_of(recorded: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the row of this package by section."""
    return {
        case["name"]: next(row for row in case["rows"] if row["method"].startswith("scvi-codegen"))
        for case in recorded["cases"]
    }


def stated() -> dict[str, list[str]]:
    """Return error, time, and both ratios of ``docs/performance.md`` by title of the row."""
    page = (ROOT / "docs" / "performance.md").read_text(encoding="utf-8")
    rows = [line.strip("| ").split(" | ") for line in page.splitlines() if line.count(" | ") == 4]
    return {row[0]: row[1:] for row in rows}


def page(recorded: dict[str, Any]) -> str:
    """Return the page."""
    readme = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    _, _, energy, distance = re.search(
        r"(\d+) steps of (\d+) days: relative energy error (\S+), final positions within (\S+) AU", readme
    ).groups()
    mercury, moon = re.search(r"within (\S+) km .*? at Mercury and (\S+) km at the Moon", readme).groups()
    machine, documented = recorded["machine"], stated()
    command = f"python -m benchmarks {' '.join(case['name'] for case in recorded['cases'])} --peers heyoka"
    lines = [
        f"| {TITLES[name]} | {row['at_error']:.0e} | {documented[TITLES[name]][1]} | {1e3 * row['seconds']:.2g} ms "
        f"| {documented[TITLES[name]][2]} | {row['default']:.2g} | {documented[TITLES[name]][3]} | {row['best']:.2g} |"
        for name, row in rows_of(recorded).items()
    ]
    table = "\n".join(lines)
    versions, load = machine["versions"], float(machine["load"].split(",")[0])
    busy = " (other programs ran)" if load > int(machine["cores"]) / 2 else ""
    return f"""# What would change our mind: claims and how to check them

<!-- index: falsifiable, reproducibility, evidence, check the numbers -->

Check each claim of the README by one command. A claim is wrong if its command prints another result on your machine;
please report it with the output of `scvi-codegen doctor --json`. The page is written by
`python tests/tools/remake_claims.py` from recorded measurements, and a test compares it with the README and the
[benchmarks](performance.md).

## Accuracy

| claim | wrong if | command |
| --- | --- | --- |
| outer solar system, 1000 steps of 200 days: relative energy error {energy} | it exceeds 1.5 times the value | `pytest tests/promises/test_outer_solar_system.py` |
| final positions within {distance} AU of a reference of extended precision | they are farther away | the same |
| from one Lagrangian within {mercury} km of DE421 at Mercury, {moon} km at the Moon, 1899 to 2053 | the printed distances are larger | `python examples/solar_system/solar_system.py` (extra `ephemeris`) |
| order, symplecticity, conserved quantities of any system | a line of the report fails | `scvi-codegen verify kepler` |

## Speed

Times depend on the processor; ratios less so. The claim is that heyoka, an adaptive Taylor integrator compiled by LLVM,
takes longer at equal error with its default options. It is wrong if a ratio "default" is below 1 on an idle machine.
"Stated" are the numbers of the [benchmarks](performance.md), from an idle machine, "recorded" the last measurement by

`{command}`

on {recorded["date"]}: {machine["processor"]}, {machine["cores"]} cores, load {machine["load"]}{busy}, heyoka
{versions["heyoka"]}, version {versions["scvi-codegen"]}. Times are processor times of one trajectory.

| problem | error | time stated | recorded | default stated | recorded | best stated | recorded |
| --- | --- | --- | --- | --- | --- | --- | --- |
{table}

Problems of the benchmarks that are missing here have no record yet. The claim does not cover other classes of problems:
the [pages of benchmarks](performance.md) name those on which other programs are faster, and [limits](limits.md) those
for which they are better suited.
"""


def main() -> None:
    """Write the record, if reports are given, and the page."""
    if reports := sys.argv[1:]:
        measured = [json.loads(Path(name).read_text(encoding="utf-8")) for name in reports]
        day = datetime.now(UTC).date().isoformat()
        cases = {case["name"]: case for each in measured for case in record(each, day)["cases"]}
        whole = record(measured[0], day) | {"cases": [cases[name] for name in TITLES if name in cases]}
        RECORD.write_text(json.dumps(whole, indent=1) + "\n", encoding="utf-8")
    PAGE.write_text(page(json.loads(RECORD.read_text(encoding="utf-8"))), encoding="utf-8")


if __name__ == "__main__":
    main()
