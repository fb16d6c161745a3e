"""The README and the pages of docs do what they say, from top to bottom, in a temporary folder with the examples in it.

Blocks marked ``python`` run in one namespace; of those marked ``sh`` or ``console``, every command that begins with
``scvi-codegen``.
"""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("as_users_compile")]

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


MINUTES = "scvi-codegen reproduce all"
"""Takes minutes of processor time."""


def runnable(page: str) -> Iterator[tuple[str, str]]:
    """("python", text) or ("command", text) in order; Python text stands on the line it has in the page."""
    for match in BLOCK.finditer(page):
        language, text = match.groups()
        if language == "python":
            yield "python", "\n" * (page.count("\n", 0, match.start()) + 1) + text
        for command in commands(text) if language in ("sh", "console") else ():
            if command.startswith("scvi-codegen "):
                yield "command", command


def commands(block: str) -> list[str]:
    """The commands of a shell block: a prompt is taken off, lines joined at a backslash and split at ``&&``."""
    lines = block.replace("\\\n", " ").splitlines()
    return [command.strip() for line in lines for command in line.removeprefix("$ ").split(" && ")]


def run_command(command: str) -> None:
    """Run one line of a shell in the present folder, with the programs of this interpreter's environment."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = {**os.environ, "PATH": path}
    result = subprocess.run(command, shell=True, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, f"{command}\n{result.stdout}{result.stderr}"


@pytest.mark.parametrize(
    ("name", "kinds"), [("README.md", {"python", "command"}), ("docs/steps.md", {"python"})], ids=["readme", "steps"]
)
def test_a_page_runs_from_top_to_bottom(name, kinds, tmp_path, monkeypatch):
    found = [pair for pair in runnable((ROOT / name).read_text(encoding="utf-8")) if not pair[1].startswith(MINUTES)]
    assert {kind for kind, _ in found} == kinds
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    namespace: dict[str, Any] = {"__name__": "readme"}
    for kind, text in found:
        if kind == "python":
            exec(compile(text, name, "exec"), namespace)
        else:
            run_command(text)


@pytest.mark.full
def test_the_paper_is_run_again_as_the_readme_says(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    [command] = [text for kind, text in runnable(README) if text.startswith(MINUTES)]
    run_command(command)
    assert (tmp_path / "paper.html").is_file()


def test_the_checks_use_the_commands_of_the_readme():
    shown = [command for language, text in BLOCK.findall(README) if language == "sh" for command in commands(text)]
    assert "pip install -e '.[test]'" in shown
    assert "pytest -n auto" in shown
    used = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert "pip install --quiet -e '.[test]'" in used
    [find] = re.findall(r"^tests=(\$\(.*\))", used, re.MULTILINE)
    found = subprocess.run(["bash", "-c", f"echo {find}"], cwd=ROOT, capture_output=True, text=True, check=True)
    assert found.stdout == "pytest -n auto\n"


def test_every_file_that_the_readme_links_to_is_there():
    targets = re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", README) + re.findall(r'src="([^":]+)"', README)
    assert [target for target in targets if not (ROOT / target).exists()] == []
