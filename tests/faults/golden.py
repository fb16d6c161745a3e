"""Golden programs whose output a fault in a header of C changes: headers are exchanged in programs generated once."""

import subprocess
import sys
import tempfile
from dataclasses import replace
from functools import cache
from pathlib import Path

from checkout import OF_TESTS, ROOT

sys.path[:0] = [str(ROOT), *(str(ROOT / name) for name in OF_TESTS)]

from golden_cells import CELLS, Program, output, plain, program  # noqa: E402


def changed_program(header: str, faulty: str) -> str:
    """Return the name of a golden program whose output changes; empty if there is none or it does not compile."""
    own, other = plain(header).strip(), plain(faulty).strip()
    for name in CELLS:
        made = _generated(name)
        if own in made.code:
            found = _output(replace(made, code=made.code.replace(own, other)))
            if found is None:
                return ""
            if found != _expected(name):
                return name
    return ""


_generated = cache(program)


@cache
def _expected(name: str) -> str | None:
    return _output(_generated(name))


def _output(made: Program) -> str | None:
    """Return what a program prints, with its status if that is not 0; ``None`` if it does not compile."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            return output(made, Path(folder))
        except subprocess.TimeoutExpired:
            return "it does not end"
        except subprocess.CalledProcessError as failed:
            return None if "-o" in failed.cmd else f"status {failed.returncode}"
