"""What tests of documentation read out of pages in Markdown, and how they run it.

Blocks marked ``python`` run in one namespace; of those marked ``sh`` or ``console``, every command that begins with
``scvi-codegen``, in ``console`` also what else follows a prompt; a block below a line with nothing but a file's name is
written to that file first. A block marked ``text`` is what the Python since the last such block prints.
"""

from __future__ import annotations

import io
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from math import isclose
from pathlib import Path
from typing import Any, NamedTuple

__all__ = ["BLOCK", "PROGRAM", "ROOT", "Part", "agree", "commands", "run_command", "run_page", "runnable"]

ROOT = Path(__file__).parents[2]
BLOCK = re.compile(r"^(?:`([\w./-]+)`\n\n)?```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
PROGRAM = "scvi-codegen "
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[-+]\d+)?(?!\w)")
MAGNITUDE = re.compile(r"\de[-+]\d+")
"""One digit and a power: of a rounding or an error, not of a quantity."""


class Part(NamedTuple):
    """A piece of a page: kind ``"python"``, ``"output"``, ``"command"``, or ``"file"`` with its name."""

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
        elif language == "text":
            yield Part("output", text)
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


def agree(said: str, printed: str) -> None:
    """The same words; the same numbers to two units of the last digit that is said, magnitudes to a factor of 10."""
    assert NUMBER.sub("#", said).split() == NUMBER.sub("#", printed).split(), f"said\n{said}\nprinted\n{printed}"
    for one, other in zip(NUMBER.findall(said), NUMBER.findall(printed), strict=True):
        if MAGNITUDE.fullmatch(one):
            assert float(other) <= 10 * float(one), f"{one} is said, {other} printed"
        else:
            digits, _, power = one.partition("e")
            unit = 10.0 ** (int(power or 0) - len(digits.partition(".")[2]))
            close = isclose(float(one), float(other), rel_tol=0, abs_tol=2.01 * unit if "." in digits else 0)
            assert close, f"{one} is said, {other} printed"


def run_page(
    name: str, parts: list[Part], folder: Path, monkeypatch: Any, heard: Callable[[str, str], None] = agree
) -> None:
    """Do what a page says, from top to bottom, in a folder that is given the examples.

    ``heard`` gets what the page says is printed, and what is.
    """
    shutil.copytree(ROOT / "examples", folder / "examples")
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("MPLBACKEND", "agg")
    namespace: dict[str, Any] = {"__name__": "page"}
    printed = io.StringIO()
    for part in parts:
        if part.kind == "python":
            with redirect_stdout(printed):
                exec(compile(part.text, name, "exec"), namespace)
        elif part.kind == "output":
            heard(part.text, printed.getvalue())
            printed = io.StringIO()
        elif part.kind == "file":
            (folder / part.name).write_text(part.text, encoding="utf-8")
        else:
            run_command(part.text)
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")
