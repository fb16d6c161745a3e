"""Write the page on claims, ``docs/claims.md``, from recorded measurements.

python -m benchmarks planar-pendulum .. fput-chain:64 --peers heyoka -o report.json    (the sections of TITLES)
python tests/tools/remake_claims.py report.json

The record is what ``-o`` writes, with the key ``date``, without the single settings of each method. It is replaced as a
whole, so that one date, machine and version describe it.
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
    "double-pendulum": "double pendulum, T = 1000",
    "relativistic-particle": "relativistic particle, T = 1000",
    "fput-chain:8": "FPUT chain of 8, T = 1000",
    "fput-chain:64": "FPUT chain of 64, T = 1000",
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
    known = {re.sub(r" \(.*\)", "", row[0]): row[1:] for row in rows}
    for title, cells in list(known.items()):  # "FPUT chain of 8 / 64 / 256" is a row for each of them
        if numbers := re.search(r"\d+( / \d+)+", title):
            parts = [cell.removesuffix(" ms").split(" / ") for cell in cells]
            for k, number in enumerate(numbers[0].split(" / ")):
                known[title.replace(numbers[0], number)] = [each[min(k, len(each) - 1)] for each in parts]
    return known


def _with_unit(cells: list[str]) -> list[str]:
    error, time, *ratios = cells
    return [error, time if time.endswith("ms") else f"{time} ms", *ratios]


def page(recorded: dict[str, Any]) -> str:
    """Return the page."""
    readme = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    _, _, energy, distance = re.search(
        r"(\d+) steps of (\d+) days: relative energy error (\S+), final positions within (\S+) AU", readme
    ).groups()
    mercury, moon = re.search(r"within (\S+) km .*? at Mercury and (\S+) km at the Moon", readme).groups()
    machine, documented = recorded["machine"], stated()
    command = f"python -m benchmarks {' '.join(case['name'] for case in recorded['cases'])} --peers heyoka"
    missing = [name for name in TITLES if name not in rows_of(recorded)]
    listed = "".join(f"| {TITLES[name]} | {' | '.join(_with_unit(documented[TITLES[name]]))} |\n" for name in missing)
    unrecorded = f"""
These claims are stated but are not in the last record:

| problem | error | time stated | default stated | best stated |
| --- | --- | --- | --- | --- |
{listed}
Record all claims together, on an idle machine, by

`python -m benchmarks {" ".join(TITLES)} --peers heyoka -o report.json`

and `python tests/tools/remake_claims.py report.json`.
""" * bool(missing)
    lines = [
        f"| {TITLES[name]} | {row['at_error']:.0e} | {_with_unit(documented[TITLES[name]])[1]} | {1e3 * row['seconds']:.2g} ms "
        f"| {documented[TITLES[name]][2]} | {row['default']:.2g} | {documented[TITLES[name]][3]} | {row['best']:.2g} |"
        for name, row in rows_of(recorded).items()
    ]
    table = "\n".join(lines)
    versions, load = machine["versions"], float(machine["load"].split(",")[0])
    busy = " (other programs ran)" if load > 1 + int(machine["cores"]) / 4 else ""  # the benchmark itself loads one
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
{unrecorded}
The claim does not cover other classes of problems:
the [benchmarks](performance.md) name some on which other programs are faster, and [limits](limits.md) those
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
