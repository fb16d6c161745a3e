"""Small faults put into the package and its templates, drawn at random: which are caught, and by what.

    python tests/faults/mutate.py --count 150 --seed 1 --results results.jsonl

A fault is put into a copy of the checkout, in a folder of its own. ``verify`` is asked first, of systems by methods
whose code the faulty file is part of, then the test files nearest to the file; the first that notices ends it. Faults
that do not compile or import are not counted. The results, a line a fault, say where to go on: those that stand there
are not tried again.
"""

from __future__ import annotations

import argparse
import json
import random
import re
import shutil
import sys
import tempfile
from collections import Counter
from pathlib import Path

from checkout import ROOT, copied, run
from near import near
from operators import Place, places

PACKAGE = ("ir", "lowering", "rendering", "methods", "runtime", "native", "mechanics", "files", "formulas", "tables")
DERIVING = ("ir", "lowering", "rendering", "methods", "mechanics", "formulas", "tables")
"""What all cases come from; of the others one shows as much."""
NOT_TRIED = ("errors.py", "text.py", "outline.py", "waiting.py")
"""Words for people; their tests are of words."""
OF_C = ("support/*.h", "*.c.jinja", "parts/*.c.jinja", "parts/newton/*.c.jinja")
CERTIFIED = (
    "kepler/svi-3",
    "cart/svi",
    "double/scvi",
    "double/sc",
    "vortices/svi",
    "kepler/composition",
    "double/verlet",
)
MOST_CASES = 4
OF_CLANG = () if shutil.which("clang") else ("-k", "not clang")
OF_TEXT = ("--deselect", "tests/rendering/test_generated.py::test_no_file_is_stale")
"""Notices that a text is another one, as it would of what is no fault."""
PYTEST = (sys.executable, "-m", "pytest", "-qx", "-p", "no:cacheprovider", *OF_CLANG, *OF_TEXT)
UNSTYLED = "def check_style(text: str) -> None:\n    pass\n"
"""In the place of tests/tools/style.py: how a fault is set is no notice of it."""
NOTHING_RUN = 4
"""Status of pytest where a name was cut."""
MOST_WORDS = 300
"""Of a result: characters of what noticed the fault."""


def drawn(count: int, seed: int, only: str) -> list[Place]:
    """As many faults of C as of Python, of each file about as many as it has lines."""
    python = [path for room in PACKAGE for path in (ROOT / "scvi_codegen" / room).rglob("*.py")]
    templates = [path for way in OF_C for path in (ROOT / "templates").glob(way)]
    kinds = (templates, [path for path in python if path.name not in NOT_TRIED])
    chooser, chosen = random.Random(seed), []
    for files in kinds:
        own = [place for path in sorted(files) for place in places(ROOT, str(path.relative_to(ROOT)))]
        own = [place for place in own if place.path.startswith(only)]
        chosen.append(chooser.sample(own, min(len(own), count // 2)))
    return [place for pair in zip(*chosen, strict=False) for place in pair] if all(chosen) else chosen[0] or chosen[1]


def noticed(copy: Path, place: Place, unfit: list[str]) -> tuple[str, str]:
    """What noticed a fault, and in which words; ``""`` if nothing did. Tests that fail without it join the unfit."""
    path = copy / place.path
    text = path.read_text()
    cases = [case for case in CERTIFIED if certifies(copy, case, place.path)][:MOST_CASES]
    path.write_text(place.applied(text))
    try:
        code, words = run(copy, sys.executable, "tests/faults/certify.py", *cases) if cases else (0, "")
        if code:
            return "stillborn" if code == 3 else "certificate", words
        while True:
            code, words = run(copy, *PYTEST, *(f"--deselect={test}" for test in unfit), *near(place.path))
            test = _failed(words)
            if not (code and test):
                return ("tests", words) if code else ("", "")
            path.write_text(text)
            if run(copy, *PYTEST, test)[0] in (0, NOTHING_RUN):
                return test.partition("::")[0], words
            unfit.append(test)
            path.write_text(place.applied(text))
    finally:
        path.write_text(text)


def _failed(words: str) -> str:
    """The test that pytest's last line names."""
    found = re.search(r"tests/\S+\.py(?:::.*?(?= - |$))?", words)
    return found[0] if found else ""


def certifies(copy: Path, case: str, path: str) -> bool:
    """Whether the certificate of a case has to do with a file."""
    if path.startswith("templates/support"):
        return path in used(copy)[case]
    return path.startswith(("templates", *(f"scvi_codegen/{room}" for room in DERIVING))) or case == CERTIFIED[0]


USED: dict[str, set[str]] = {}


def used(copy: Path) -> dict[str, set[str]]:
    """The templates that the code of each case is made from."""
    if not USED:
        code, text = run(copy, sys.executable, "tests/faults/certify.py", "--list", *CERTIFIED)
        assert code == 0, text
        USED.update({case: {f"templates/{name}" for name in names} for case, names in json.loads(text).items()})
    return USED


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("--count", type=int, default=150)
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--only", default="", help="beginning of the paths of files")
    options.add_argument("--results", type=Path, required=True)
    given = options.parse_args()
    lines = given.results.read_text().splitlines() if given.results.exists() else []
    known = {entry["fault"]: entry["caught by"] for entry in map(json.loads, lines)}
    with tempfile.TemporaryDirectory(prefix="faults-") as folder:
        copy, unfit = copied(Path(folder)), list[str]()
        (copy / "tests/tools/style.py").write_text(UNSTYLED)
        for place in drawn(given.count, given.seed, given.only):
            text = (ROOT / place.path).read_text()
            fault = place.name(text)
            if fault in known:
                continue
            by, words = noticed(copy, place, unfit)
            known[fault] = by
            with given.results.open("a") as results:
                results.write(json.dumps({"fault": fault, "caught by": by, "words": words[:MOST_WORDS]}) + "\n")
            print(f"{by or 'SURVIVES':30} {fault}", flush=True)
    counts = Counter(
        "survive" if not by else by if by in ("stillborn", "certificate") else "tests" for by in known.values()
    )
    print(dict(counts), *(f"fails without a fault, too: {test}" for test in unfit), sep="\n")


if __name__ == "__main__":
    main()
