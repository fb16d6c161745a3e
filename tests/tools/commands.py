"""Commands of the command line, in the process of a test."""

import json
from typing import Any

from click.testing import CliRunner, Result

from scvi_codegen.interfaces.cli import main


def invoke(text: str, *words: object, status: int | None = 0) -> Result:
    """Run a text of words separated by blanks and further words, which end with an exit status (``None``: any)."""
    result = CliRunner().invoke(main, [*text.split(), *map(str, words)], prog_name="scvi-codegen")
    assert status is None or result.exit_code == status, result.output
    return result


def output_of(*words: object) -> str:
    """Return what a command prints on stdout."""
    return invoke(*words).stdout


def error_of(*words: object, status: int | None = 2) -> str:
    """Return the message on stderr of a command that fails without a traceback."""
    result = invoke(*words, status=status)
    assert isinstance(result.exception, SystemExit)
    assert "Traceback" not in result.output
    return result.stderr


def json_of(*words: object, status: int = 0) -> dict[str, Any]:
    """Return the JSON of a command, which has no undefined numbers."""
    return dict(json.loads(invoke(*words, "--json", status=status).stdout, parse_constant=_refuse))


def _refuse(constant: str) -> float:
    raise AssertionError(f"{constant} is no JSON")
