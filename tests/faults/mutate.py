"""Small faults put into the package and its templates, drawn at random: which are caught, and by what.

    python tests/faults/reach.py reach.json
    python tests/faults/mutate.py --count 150 --seed 1 --reach reach.json --results results.jsonl

A fault is put into a copy of the checkout, in a folder of its own. Headers of C are tried in the golden programs first
(``golden.py``). Then ``verify`` is asked, of systems by methods whose code the faulty file is part of, then the test
files that reach the line (``reach.py``), one after the other; the first that notices ends it. Faults that do not
compile or import are not counted. A fault on which more than ``--seconds`` of processor time were spent without a
notice counts as one that survives, as its line reports. A run that was interrupted continues after the last line of
the results, which has one line per fault; ``--again`` repeats survivors. ``results.plan`` lists the drawn faults, each
with the text around it, by which they are found in files that changed.
"""

import argparse
import json
import random
import re
import resource
import shutil
import sys
import tempfile
from collections import Counter
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path

from checkout import BOTH_TIERS, ROOT, copied, run
from golden import changed_program
from operators import Place, places
from reach import Reach

PACKAGE = (
    *("common", "systems", "methods", "codegen", "runs", "extras/advice"),
    *("interfaces/cli", "extras/derivation", "interfaces/models"),
)
"""Folders of which Python is drawn; the others draw pictures, measure, or need programs that CI may not have."""
DERIVING = ("systems", "methods", "codegen/ir", "codegen/lowering", "codegen/rendering")
"""What all cases come from; of the others one shows as much."""
NOT_TRIED = ("errors.py", "text.py", "waiting.py")
"""Words for people; their tests are of words."""
OF_C = ("support/*/*.h", "*.c.jinja", "parts/*.c.jinja", "parts/newton/*.c.jinja")
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
OF_TEXT = ("--deselect", "tests/codegen/test_generated.py::test_no_file_is_outdated")
"""Notices that a text is another one, as it would of what is no fault."""
PYTEST = (sys.executable, "-m", "pytest", "-qx", "-p", "no:cacheprovider", *BOTH_TIERS, *OF_CLANG, *OF_TEXT)
UNSTYLED = "STYLE = CLANG_FORMAT = None\n\n\ndef check_style(text: str) -> None:\n    pass\n"
"""In the place of tests/tools/style.py: how a fault is set is no notice of it."""
NOTHING_RUN = 4
"""Status of pytest where a name was cut; one more where a file has no test of the two tiers."""
HANGS = 100
"""Seconds of work after which certificates of few cases count as hanging."""
AROUND = 60
"""Characters before and after a fault by which it is found again."""
MOST_UNFIT = 20
"""Tests of a file that may fail without a fault."""
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


def planned(plan: Path, count: int, seed: int, only: str) -> list[tuple[str, Place]]:
    """The faults of a plan with their names when drawn; where there is no plan, it is drawn first."""
    if not plan.exists():
        made = []
        for place in drawn(count, seed, only):
            text = (ROOT / place.path).read_text()
            around = text[max(0, place.start - AROUND) : place.start], text[place.end : place.end + AROUND]
            made.append({"fault": place.name(text), "around": around, "place": asdict(place)})
        plan.write_text("".join(json.dumps(entry) + "\n" for entry in made))
    found = []
    for entry in map(json.loads, plan.read_text().splitlines()):
        place, (before, after) = Place(**entry["place"]), entry["around"]
        path = ROOT / place.path
        text = path.read_text() if path.exists() else ""
        starts = [hit.start() + len(before) for hit in re.finditer(re.escape(before + place.old + after), text)]
        if starts:
            start = min(starts, key=lambda other: abs(other - place.start))
            found.append((entry["fault"], replace(place, start=start, end=start + len(place.old))))
        else:
            print(f"{'text is gone':30} {entry['fault']}")
    return found


def noticed(copy: Path, place: Place, reach: Reach, unfit: list[str], seconds: float) -> tuple[str, str]:
    """What noticed a fault, and in which words; ``""`` if nothing did. Tests that fail without it join the unfit."""
    end = _spent() + seconds
    path = copy / place.path
    text = path.read_text()
    if place.path.startswith("templates/support") and (cell := changed_program(place.path, place.applied(text))):
        return "golden", cell
    cases = [case for case in CERTIFIED if certifies(copy, case, place.path)][:MOST_CASES]
    path.write_text(place.applied(text))
    try:
        certify = partial(run, copy, sys.executable, "tests/faults/certify.py", *cases, seconds=HANGS)
        code, words = certify() if cases else (0, "")
        if code and not words:  # a process that ended without a word: it may have been the machine
            code, words = certify()
        if code:
            return "stillborn" if code == 3 else "certificate", words
        tests, failing = reach.tests(place.path, text.count("\n", 0, place.start) + 1), 0
        while tests and _spent() < end:
            code, words = run(copy, *PYTEST, *(f"--deselect={test}" for test in unfit), tests[0])
            test = _failed(words)
            if code and not test and code != NOTHING_RUN + 1:
                return "tests", words
            if not (code and test):
                tests, failing = tests[1:], 0
                continue
            path.write_text(text)
            if failing < MOST_UNFIT and run(copy, *PYTEST, test)[0] in (0, NOTHING_RUN):
                return test.partition("::")[0], words
            unfit.append(test)
            failing += 1
            path.write_text(place.applied(text))
        return "", f"not tried for want of time: {' '.join(tests)}" if tests else ""
    finally:
        path.write_text(text)


def _spent() -> float:
    """Seconds of processor time of all that was run."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


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
    options.add_argument("--seconds", type=float, default=600.0, help="of processor time for a fault")
    options.add_argument("--again", action="store_true", help="try once more what survived")
    options.add_argument("--reach", type=Path, required=True, help="result of reach.py")
    options.add_argument("--results", type=Path, required=True)
    given = options.parse_args()
    lines = given.results.read_text().splitlines() if given.results.exists() else []
    known = {entry["fault"]: entry["caught by"] for entry in map(json.loads, lines)}
    with tempfile.TemporaryDirectory(prefix="faults-") as folder:
        copy, unfit = copied(Path(folder)), list[str]()
        (copy / "tests/tools/style.py").write_text(UNSTYLED)
        plan = given.results.with_suffix(".plan")
        for fault, place in planned(plan, given.count, given.seed, given.only):
            if fault in known and (known[fault] or not given.again):
                continue
            by, words = noticed(copy, place, Reach(given.reach), unfit, given.seconds)
            known[fault] = by
            with given.results.open("a") as results:
                results.write(json.dumps({"fault": fault, "caught by": by, "words": words[:MOST_WORDS]}) + "\n")
            print(f"{by or 'SURVIVES':30} {fault}", flush=True)
    counts = Counter(
        "survive" if not by else by if by in ("stillborn", "certificate", "golden") else "tests"
        for by in known.values()
    )
    print(dict(counts), *(f"fails without a fault, too: {test}" for test in unfit), sep="\n")


if __name__ == "__main__":
    main()
