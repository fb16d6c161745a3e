"""Extract and run the code of Markdown pages.

``python`` blocks of a page share one namespace. In ``sh`` and ``console`` blocks every command that begins with
``scvi-codegen`` runs, in ``console`` blocks also every other command after a prompt. A block preceded by a line that
contains only a file name is written to that file. A ``text`` block is the output of the Python blocks before it.
"""

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

ROOT = Path(__file__).parents[2]
BLOCK = re.compile(r"^(?:`([\w./-]+)`\n\n)?```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
PROGRAM = "scvi-codegen "
NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[-+]\d+)?(?!\w)")
MAGNITUDE = re.compile(r"\de[-+]\d+")
"""One digit and a power of ten: the magnitude of an error, compared to a factor of 10."""
UNCERTAIN = re.compile(r"(-?\d[\d.]*)\((\d+)\)(?:e([-+]\d+))?")
"""Value with its uncertain digits, ``0.512345(12)``: values agree within both errors, which are magnitudes."""


class Part(NamedTuple):
    """Part of a page: kind ``"python"``, ``"output"``, ``"command"``, or ``"file"`` with its name."""

    kind: str
    text: str
    name: str = ""


def runnable(page: str) -> Iterator[Part]:
    """Yield the parts of a page in order; Python code keeps its line numbers."""
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
    """Yield the commands of a shell block: lines joined at a backslash and split at ``&&``."""
    for line in block.replace("\\\n", " ").splitlines():
        for command in line.removeprefix("$ ").split(" && "):
            if line.startswith("$ ") or command.strip().startswith(PROGRAM):
                yield command.strip()


def run_command(command: str) -> None:
    """Run a shell command in the current folder, with the programs of this Python environment."""
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    environment = {**os.environ, "PATH": path}
    result = subprocess.run(command, shell=True, env=environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, f"{command}\n{result.stdout}{result.stderr}"


def uncertain_values(text: str) -> list[tuple[float, float]]:
    """Return the values with uncertain digits, and their uncertainties."""
    parts = [(value, digits, int(power or 0)) for value, digits, power in UNCERTAIN.findall(text)]
    units = [10.0 ** (power - len(value.partition(".")[2])) for value, _, power in parts]
    return [(float(f"{v}e{power}"), int(d) * unit) for (v, d, power), unit in zip(parts, units, strict=True)]


def agree(message: str, printed: str) -> None:
    """Check equal words and equal numbers: to two units of the last printed digit, magnitudes to a factor of 10."""
    for one, other in zip(*map(uncertain_values, (message, printed)), strict=True):
        close = abs(one[0] - other[0]) <= one[1] + other[1] <= 11.0 * one[1]
        assert close, f"{one[0]} +- {one[1]} is said, {other[0]} +- {other[1]} printed"
    message, printed = (UNCERTAIN.sub("", text) for text in (message, printed))
    assert NUMBER.sub("#", message).split() == NUMBER.sub("#", printed).split(), f"said\n{message}\nprinted\n{printed}"
    for one, other in zip(NUMBER.findall(message), NUMBER.findall(printed), strict=True):
        if MAGNITUDE.fullmatch(one):
            assert float(other) <= 10 * float(one), f"{one} is said, {other} printed"
        else:
            digits, _, power = one.partition("e")
            unit = 10.0 ** (int(power or 0) - len(digits.partition(".")[2]))
            close = isclose(float(one), float(other), rel_tol=0, abs_tol=2.01 * unit if "." in digits else 0)
            assert close, f"{one} is said, {other} printed"


def run_page(
    name: str, parts: list[Part], folder: Path, monkeypatch: Any, heard: Callable[[str, str], None] = agree
) -> dict[str, Any]:
    """Run all parts of a page in order, in a folder with a copy of the examples, and return the names of its code.

    ``heard`` is called with the expected and the printed output.
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
    return namespace
