"""Public names, signatures and options of the command line change only on purpose."""

from difflib import unified_diff

from public import RECORDED, public


def test_public_names_are_those_documented():
    saved, found = (text.splitlines() for text in (RECORDED.read_text(encoding="utf-8"), public()))
    changes = [line for line in unified_diff(saved, found, "kept", "found", lineterm="", n=0) if line[0] in "+-"]
    assert changes == [], "if it is meant: python tests/tools/public.py, and a line in CHANGELOG.md"
