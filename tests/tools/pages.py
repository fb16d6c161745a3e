"""What tests of documentation read out of pages in Markdown, and how they run it.

Blocks marked ``python`` run in one namespace; of those marked ``sh`` or ``console``, every command that begins with
``scvi-codegen``, in ``console`` also what else follows a prompt; a block below a line with nothing but a file's name is
written to that file first.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

__all__ = ["BLOCK", "PROGRAM", "ROOT", "Part", "commands", "run_command", "run_page", "runnable"]

ROOT = Path(__file__).parents[2]
BLOCK = re.compile(r"^(?:`([\w./-]+)`\n\n)?```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
PROGRAM = "scvi-codegen "


class Part(NamedTuple):
    """A piece of a page: kind ``"python"``, ``"command"``, or ``"file"`` with its name."""

    kind: str
    text: str
    name: str = ""


def runnable(page: str) -> Iterator[Part]:
    """What a page does, in order; Python text stands on the line that it has in the page."""
    for match in BLOCK.finditer(page):
        name, language, text = match.groups()
        if name:
            yield Part("file", text, name)
        elif language == "python":
            yield Part("python", "\n" * page.count("\n", 0, match.start(3)) + text)
        elif language in ("sh", "console"):
            yield from (Part("command", command) for command in commands(text))


def commands(block: str) -> Iterator[str]:
    """The commands of a shell block: lines joined at a backslash and split at ``&&``."""
    for line in block.replace("\\\n", " ").splitlines():
        for command in line.removeprefix("$ ").split(" && "):
            if line.startswith("$ ") or command.strip().startswith(PROGRAM):
                yield command.strip()


def run_command(command: str) -> None:
    """Run one line of a shell in the present folder, with the programs of this interpreter's environment."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = {**os.environ, "PATH": path}
    result = subprocess.run(command, shell=True, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, f"{command}\n{result.stdout}{result.stderr}"


def run_page(name: str, parts: list[Part], folder: Path, monkeypatch: Any) -> None:
    """Do what a page says, from top to bottom, in a folder that is given the examples."""
    shutil.copytree(ROOT / "examples", folder / "examples")
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("MPLBACKEND", "agg")
    namespace: dict[str, Any] = {"__name__": "page"}
    for part in parts:
        if part.kind == "python":
            exec(compile(part.text, name, "exec"), namespace)
        elif part.kind == "file":
            (folder / part.name).write_text(part.text, encoding="utf-8")
        else:
            run_command(part.text)
