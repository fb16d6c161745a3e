"""Coverage of the generated C by lines and branches, from builds that were compiled with ``--coverage``.

    SCVI_CODEGEN_CACHE=/tmp/covered SCVI_CODEGEN_CFLAGS="-O0 --coverage" pytest -n auto
    python tests/tools/c_coverage.py /tmp/covered

A line of a support header counts as reached if any build reached it; so does each direction of a branch. Code that is
rendered for one system is summed over the builds. What tests compile in caches of their own is not counted.
"""

import gzip
import json
import shutil
import subprocess
import sys
from collections import defaultdict
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

Reached = dict[tuple[str, int, int], int]
"""Counts by (file, line, branch); branch is -1 for the line itself."""


def _data_files(cache: Path) -> dict[str, list[Path]]:
    """Counters by name of the cache entry: libgcov writes them to the folder in which the entry was built."""
    found: defaultdict[str, list[Path]] = defaultdict(list)
    for path in cache.glob(".building-*/*/*.gcda"):
        found[path.parent.name].append(path)
    return found


def _report(entry: Path, data: list[Path]) -> list[dict[str, Any]]:
    """Files of one entry as ``gcov --json-format`` describes them."""
    files = []
    for path in data:
        shutil.copy(path, entry / path.name)
        command = ["gcov", "--branch-probabilities", "--json-format", path.name]
        if subprocess.run(command, cwd=entry, capture_output=True, check=False).returncode == 0:
            for made in entry.glob("*.gcov.json.gz"):
                files += json.loads(gzip.decompress(made.read_bytes()))["files"]
                made.unlink()
    return files


def collect(cache: Path) -> Reached:
    """Add the counters of all entries of a cache folder."""
    reached: Reached = defaultdict(int)
    entries = [(cache / name, data) for name, data in _data_files(cache).items() if (cache / name).is_dir()]
    with ThreadPoolExecutor() as pool:
        for (entry, _), files in zip(entries, pool.map(lambda one: _report(*one), entries), strict=True):
            for file in files:
                path = Path(file["file"])
                name = (
                    f"support/{path.parent.name}/{path.name}"
                    if "support" in path.parts
                    else f"{entry.name}/{path.name}"
                )
                if path.is_absolute() and "support" not in path.parts and not path.is_relative_to(cache):
                    continue  # headers of the system
                for line in file["lines"]:
                    reached[name, line["line_number"], -1] += line["count"]
                    for number, branch in enumerate(line["branches"]):
                        reached[name, line["line_number"], number] += branch["count"]
    return reached


def table(reached: Reached) -> list[tuple[str, int, int, int, int]]:
    """(file, lines, lines reached, branches, branches reached), the rendered files of all systems as one row."""
    rows: defaultdict[str, list[int]] = defaultdict(lambda: [0, 0, 0, 0])
    for (file, _, branch), count in reached.items():
        row = rows[file if file.startswith("support/") else "rendered for one system"]
        place = 0 if branch < 0 else 2
        row[place] += 1
        row[place + 1] += count > 0
    return [(name, *row) for name, row in sorted(rows.items())]  # type: ignore[misc]


def main() -> None:
    rows = table(collect(Path(sys.argv[1])))
    totals = [sum(row[column] for row in rows if row[0].startswith("support/")) for column in range(1, 5)]
    print(f"{'file':40} {'lines':>7} {'reached':>8} {'branches':>9} {'reached':>8}")
    for name, lines, hit, branches, taken in [*rows, ("all support headers", *totals)]:
        share, part = 100.0 * hit / max(lines, 1), 100.0 * taken / max(branches, 1)
        print(f"{name:40} {lines:7} {share:7.1f}% {branches:9} {part:7.1f}%")


if __name__ == "__main__":
    main()
