"""Golden programs whose output a fault in a header of C changes: headers are exchanged in sources generated once."""

import subprocess
import sys
import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

from checkout import OF_TESTS, ROOT

sys.path[:0] = [str(ROOT), *(str(ROOT / name) for name in OF_TESTS)]

from golden_cells import CELLS, Made, Program, of_source, output  # noqa: E402


def changed_program(header: str, faulty: str) -> str:
    """Return the name of a golden program whose output changes; empty if there is none or it does not compile.

    Args:
        header: path of the header in the checkout.
        faulty: its text with the fault.
    """
    support, correct = header.removeprefix("templates/"), (ROOT / header).read_text()
    for name in CELLS:
        source, main = _generated(name)
        assert source is not None
        if support not in (headers := dict(source.support)):
            continue
        changed = headers[support].replace(correct, faulty)  # the guard around it stays
        found = of_source(replace(source, support=tuple((headers | {support: changed}).items())), main)
        if found.code != _program(name).code:
            printed = _output(found)
            if printed is None:
                return ""
            if printed != _expected(name):
                return name
    return ""


@cache
def _generated(name: str) -> Made:
    return CELLS[name](name)


@cache
def _program(name: str) -> Program:
    return of_source(*_generated(name))


@cache
def _expected(name: str) -> str | None:
    return _output(_program(name))


def _output(made: Program) -> str | None:
    """Return what a program prints, with its status if that is not 0; ``None`` if it does not compile."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            return output(made, Path(folder))
        except subprocess.TimeoutExpired:
            return "it does not end"
        except subprocess.CalledProcessError as failed:
            return None if "-o" in failed.cmd else f"status {failed.returncode}"
