"""The README does what it says, from top to bottom, in a temporary folder with the examples in it.

Blocks marked ``python`` run in one namespace. Blocks marked ``console`` or ``sh`` that begin with ``$ scvi-codegen``
run line by line, each line that begins with ``$ ``.
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

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def runnable() -> Iterator[tuple[int, bool, str]]:
    """(line number, whether Python, text) of the blocks to run, in order."""
    for match in BLOCK.finditer(README):
        language, text = match.groups()
        if language == "python" or (language in ("console", "sh") and text.startswith("$ scvi-codegen")):
            yield README.count("\n", 0, match.start()) + 2, language == "python", text


def commands(block: str) -> list[str]:
    """The lines after ``$``, with those they continue on."""
    return [line.removeprefix("$ ") for line in block.replace("\\\n", " ").splitlines() if line.startswith("$ ")]


def run_command(command: str) -> None:
    """Run one line of a shell in the present folder, with the programs of this interpreter's environment."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = {**os.environ, "PATH": path}
    result = subprocess.run(command, shell=True, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, f"{command}\n{result.stdout}{result.stderr}"


def test_the_readme_runs_from_top_to_bottom(tmp_path, monkeypatch):
    found = list(runnable())
    assert {python for _, python, _ in found} == {True, False}, "the README shows Python, and the command line"
    shutil.copytree(ROOT / "examples", tmp_path / "examples")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    namespace: dict[str, Any] = {"__name__": "readme"}
    for line, python, text in found:
        if python:
            exec(compile("\n" * (line - 1) + text, "README.md", "exec"), namespace)
        else:
            for command in commands(text):
                run_command(command)


@pytest.mark.parametrize("command", ["pip install -e '.[test]'", "pytest -n auto"])
def test_the_checks_use_the_commands_of_the_readme(command):
    assert re.search(rf"^(\$ )?{re.escape(command)}( +#.*)?$", README, re.MULTILINE), f"the README lacks: {command}"
    used = (ROOT / ".ci" / "run").read_text(encoding="utf-8").replace("--quiet ", "")
    assert command in used.splitlines()


def test_every_file_that_the_readme_links_to_is_there():
    targets = re.findall(r"\]\(([^)#:\s]+)(?:#[^)]*)?\)", README) + re.findall(r'src="([^":]+)"', README)
    assert [target for target in targets if not (ROOT / target).exists()] == []
