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


def test_the_readme_is_short_and_shows_code_before_claims():
    assert README.count("\n") <= 90
    assert README.count("](") <= 15
    assert README.index("```python") < README.index("\n* ")


def test_the_checks_use_the_commands_of_the_readme():
    blocks = [text for _, language, text in BLOCK.findall(README) if language == "sh"]
    shown = [line for text in blocks for line in re.split(r" && |\n", text)]
    assert "pip install -e '.[test]'" in shown
    assert "pytest -n auto" in shown
    checks = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    for _, begin in re.findall(r"^    (['\"])(.*)\1\*\) \w+=\$line ;;$", checks, re.MULTILINE):
        assert len(re.findall(f"^{re.escape(begin)}", README, re.MULTILINE)) == 1, begin
    assert checks.count("=$line ;;") == 4


def test_measurements_are_those_of_the_pages():
    """Times beside heyoka, and distances from the ephemeris."""
    text = " ".join(README.split())
    stated = r"in (\S+) ms at an error of (\S+)\. .*? takes (\S+) times as long, and (\S+) to (\S+) times"
    time, error, *ratios = re.search(stated, text).groups()
    page = (ROOT / "docs" / "performance.md").read_text(encoding="utf-8")
    rows = [line.strip("| ").split(" | ") for line in page.split("| heyoka at best |")[1].split("\n\n")[0].splitlines()]
    rows = {row[0]: row[1:] for row in rows if len(row) == 5 and " ms" in row[2]}
    planets = rows.pop("outer solar system, 200,000 days")
    assert planets[:3] == [error, f"{time} ms", ratios[0]]
    others = [float(ratio) for row in rows.values() for ratio in row[2].split(" / ")]
    assert ratios[1:] == [f"{min(others):g}", f"{max(others):g}"]
    mercury, moon = map(float, re.search(r"within (\S+) km .*? at Mercury and (\S+) km at the Moon", text).groups())
    table = (ROOT / "docs" / "solar_system.md").read_text(encoding="utf-8")
    head, *lines = (re.findall(r"[^|]+", line) for line in table.splitlines() if line.startswith(("| |", "| + tides")))
    distances = dict(zip((name.strip() for name in head), map(str.strip, lines[0]), strict=True))
    assert [mercury, moon] == [round(float(distances[name]), 1) for name in ("Mercury", "Moon")]


def test_links_of_the_readme_have_targets():
    targets = re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", README) + re.findall(r'src="([^":]+)"', README)
    assert [target for target in targets if not (ROOT / target).exists()] == []
