"""Edits of the package that its own tests must notice, where no certificate looks: a line of edits.toml each."""

import re
import sys
import tomllib
from pathlib import Path

import pytest
from checkout import ROOT, copied, run
from samples import UNOPTIMISED
from tiers import first_of_each

from scvi_codegen.native.building import FLAGS_VARIABLE

Edit = dict[str, str]

EDITS: list[Edit] = [
    {"group": group, "name": name, **edit}
    for group, edits in tomllib.loads((ROOT / "tests/faults/edits.toml").read_text(encoding="utf-8")).items()
    for name, edit in edits.items()
]
BOTH_TIERS = ("-m", "full or not full")
QUICKLY = {FLAGS_VARIABLE: " ".join(UNOPTIMISED)}
FAILED = 1
STILLBORN = re.compile(r"BuildError|SyntaxError|NameError|ImportError|UndefinedError")
"""What is no notice: text that is none of C, Python or Jinja."""


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return copied(tmp_path_factory.mktemp("faults"))


def test_edits_find_their_source_lines() -> None:
    """Otherwise a line that was rewritten takes its faults with it, and only the full tier says so."""
    lost = [
        f"{edit['file']}: {edit['old']}"
        for edit in EDITS
        if (ROOT / edit["file"]).read_text("utf-8").count(edit["old"]) != 1
    ]
    assert lost == []
    assert [edit["name"] for edit in EDITS if not (ROOT / "tests" / edit["test"].split("::")[0]).exists()] == []


@pytest.mark.parametrize(
    "edit",
    first_of_each(EDITS, lambda edit: "one of them, of Python: those of C take thrice as long"),
    ids=lambda edit: f"{edit['group']}: {edit['name']}",
)
def test_every_edit_is_detected(edit: Edit, copy: Path) -> None:
    path = copy / edit["file"]
    text = path.read_text(encoding="utf-8")
    pytest_alone = ("-m", "pytest", "-qx", "--tb=line", "-p", "no:cacheprovider", "-p", "no:xdist", *BOTH_TIERS)
    path.write_text(text.replace(edit["old"], edit["new"]), encoding="utf-8")
    try:
        status, words = run(copy, sys.executable, *pytest_alone, f"tests/{edit['test']}", **QUICKLY)
    finally:
        path.write_text(text, encoding="utf-8")
    assert status == FAILED, f"{edit['test']} does not notice: {words}"
    assert not STILLBORN.search(words), words
