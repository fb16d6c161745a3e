"""Tests of the README: its code, commands and links."""

import re

import pytest
from pages import BLOCK, PROGRAM, ROOT, run_page, runnable

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("as_users_compile")]

README = (ROOT / "README.md").read_text(encoding="utf-8")


@pytest.mark.second
def test_the_readme_runs_from_top_to_bottom(tmp_path, monkeypatch):
    parts = [part for part in runnable(README) if part.kind != "command" or part.text.startswith(PROGRAM)]
    assert {part.kind for part in parts} == {"python", "output", "command"}
    run_page("README.md", parts, tmp_path, monkeypatch)


def test_the_checks_use_the_commands_of_the_readme():
    blocks = [text for _, language, text in BLOCK.findall(README) if language == "sh"]
    shown = [line for text in blocks for line in re.split(r" && |\n", text)]
    assert "pip install -e '.[test]'" in shown
    assert "pytest -n auto" in shown
    checks = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    for _, begin in re.findall(r"^    (['\"])(.*)\1\*\) \w+=\$line ;;$", checks, re.MULTILINE):
        assert len(re.findall(f"^{re.escape(begin)}", README, re.MULTILINE)) == 1, begin
    assert checks.count("=$line ;;") == 4


def test_links_of_the_readme_have_targets():
    targets = re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", README) + re.findall(r'src="([^":]+)"', README)
    assert [target for target in targets if not (ROOT / target).exists()] == []
