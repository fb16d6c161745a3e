"""What is public changes on purpose alone: names, what they take, options of the command line."""

from difflib import unified_diff

from public import KEPT, public


def test_what_is_public_is_what_was_said_to_be():
    kept, found = (text.splitlines() for text in (KEPT.read_text(encoding="utf-8"), public()))
    changes = [line for line in unified_diff(kept, found, "kept", "found", lineterm="", n=0) if line[0] in "+-"]
    assert changes == [], "if it is meant: python tests/tools/public.py, and a line in CHANGELOG.md"
