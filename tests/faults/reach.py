"""Tests of both tiers by the lines of the package and the templates that they reach, and how long they take.

    python tests/faults/reach.py reach.json

Every test file is run in a process of its own. The processes, and those that they start, record the lines of the
package (``coverage``) and the templates that they open. Rendered sources are removed from the cache before
each file, so that every file derives and renders what it uses; compiled libraries are shared. The result, which is
written after every file, is used by ``mutate.py``.
"""

import argparse
import ast
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
from difflib import SequenceMatcher
from pathlib import Path

from checkout import BOTH_TIERS, ROOT
from coverage import CoverageData

FOLDER_VARIABLE = "SCVI_CODEGEN_REACH"
COLLECTOR = f'''\
import atexit, os, sys

FOLDER, TEMPLATES = os.environ.get("{FOLDER_VARIABLE}"), os.environ.get("{FOLDER_VARIABLE}_TEMPLATES")
if FOLDER:
    opened = set()

    def audit(event, given):
        if event == "open" and isinstance(given[0], str) and given[0].startswith(TEMPLATES):
            opened.add(given[0][len(TEMPLATES) - len("templates/") :])

    def write():
        with open(os.path.join(FOLDER, str(os.getpid())), "w") as file:
            file.write("\\n".join(sorted(opened)))

    sys.addaudithook(audit)
    atexit.register(write)
'''
"""Contents of ``sitecustomize.py`` of all processes."""
GOLDEN = "tests/golden/test_golden.py"
NOT_GENERATING = ("common", "runs", "interfaces", "api")
"""Folders of the package that no generated source depends on."""
LONGEST = 900
"""Seconds after which a test file is ended; what it reached until then is lost."""


class Reach:
    """Test files by the lines and templates that they reach, with their processor time."""

    def __init__(self, path: Path) -> None:
        record = json.loads(path.read_text()) if path.exists() else {}
        self.path = path
        self.seconds: dict[str, float] = record.get("seconds", {})
        self.lines: dict[str, dict[str, list[int]]] = record.get("lines", {})
        self.templates: dict[str, list[str]] = record.get("templates", {})
        self.texts: dict[str, str] = record.get("texts", {})

    def write(self) -> None:
        self.path.write_text(json.dumps(vars(self) | {"path": ""}))

    def add(self, test: str, cache: Path) -> None:
        """Run a test file and record what it reaches."""
        shutil.rmtree(cache / "texts", ignore_errors=True)
        with tempfile.TemporaryDirectory(prefix="reach-") as folder:
            (Path(folder) / "sitecustomize.py").write_text(COLLECTOR)
            (Path(folder) / "found").mkdir()
            environment = os.environ | {
                "PYTHONPATH": os.pathsep.join([folder, str(ROOT)]),
                "SCVI_CODEGEN_CACHE": str(cache),
                "COVERAGE_FILE": str(Path(folder) / "lines"),
                FOLDER_VARIABLE: str(Path(folder) / "found"),
                f"{FOLDER_VARIABLE}_TEMPLATES": str(ROOT / "templates" / "_")[:-1],
            }
            before = _spent()
            options = (*BOTH_TIERS, "-q", "-p", "no:cacheprovider", "--cov=scvi_codegen", "--cov-report=")
            code = subprocess.run(
                (sys.executable, "-m", "pytest", *options, test),
                cwd=ROOT,
                env=environment,
                capture_output=True,
                check=False,
                timeout=LONGEST,
            ).returncode
            self.seconds[test] = round(_spent() - before, 2)
            data = CoverageData(str(Path(folder) / "lines"))
            data.read()
            self.lines[test] = {path: sorted(data.lines(path) or ()) for path in data.measured_files()}
            opened = [found.read_text().split() for found in (Path(folder) / "found").iterdir()]
            self.texts.update({path: (ROOT / path).read_text() for path in self.lines[test]})
            self.templates[test] = sorted({name for names in opened for name in names})
        print(f"{self.seconds[test]:8.1f} s  status {code}  {test}", flush=True)

    def tests(self, path: str, line: int) -> list[str]:
        """Return the test files to show a fault in a line to, the most promising first.

        Those named like the file come first, then those of its folder that reach it, then golden results, then others
        by their time for each line of the file that they reach. Files may have changed or been renamed since.
        """
        room, stem = Path(path).parts[1], Path(path).stem
        if path.startswith("templates"):
            reached = {test: 1 for test in self.seconds if path in self.templates[test]}
        else:
            old = path if path in self.texts else self._former(path)
            lines = self._former_lines(path, old, line) if old else set()
            reached = {test: len(own) for test in self.seconds if lines & {*(own := self.lines[test].get(old, ()))}}
        named = sorted(str(file.relative_to(ROOT)) for file in ROOT.glob(f"tests/*/test_{stem}.py"))
        order = sorted(reached, key=lambda test: self.seconds[test] / reached[test])
        near = [test for test in order if test.startswith(f"tests/{room}/")]
        unknown = sorted(str(file.relative_to(ROOT)) for file in ROOT.glob(f"tests/{room}/test_*.py"))
        golden = [] if room in NOT_GENERATING else [GOLDEN]
        found = [*named, *near, *golden, *order, *(test for test in unknown if test not in self.seconds)]
        return [test for test in dict.fromkeys(found) if (ROOT / test).exists()]

    def _former(self, path: str) -> str:
        """Return the recorded file with most lines in common."""
        now = {*(ROOT / path).read_text().splitlines()}
        return max(self.texts, key=lambda old: len(now & {*self.texts[old].splitlines()}), default="")

    def _former_lines(self, path: str, old: str, line: int) -> set[int]:
        """Return the recorded numbers of the lines of the innermost statement at a line, without its body."""
        text = (ROOT / path).read_text()
        span = line, line
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.stmt) and node.lineno <= line <= (node.end_lineno or line):
                body = getattr(node, "body", None)
                last = body[0].lineno - 1 if body else node.end_lineno or line
                if line <= last:
                    span = node.lineno, last
        blocks = SequenceMatcher(
            None, text.splitlines(), self.texts[old].splitlines(), autojunk=False
        ).get_matching_blocks()
        moved = {a + k + 1: b + k + 1 for a, b, size in blocks for k in range(size)}
        return {moved[number] for number in range(span[0], span[1] + 1) if number in moved}


def _spent() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("path", type=Path)
    options.add_argument("only", nargs="*", default=["tests/"], help="beginnings of the paths of test files, in order")
    options.add_argument("--again", action="store_true", help="run files again that the result contains")
    options.add_argument("--cache", type=Path, help="folder of compiled libraries, a new one by default")
    given = options.parse_args()
    reach = Reach(given.path)
    with tempfile.TemporaryDirectory(prefix="reach-cache-") as own:
        tests = sorted(str(file.relative_to(ROOT)) for file in ROOT.glob("tests/*/test_*.py"))
        for test in (test for beginning in given.only for test in tests if test.startswith(beginning)):
            if given.again or test not in reach.seconds:
                reach.add(test, given.cache or Path(own))
                reach.write()


if __name__ == "__main__":
    main()
