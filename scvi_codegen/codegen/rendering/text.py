"""Text of C: tables, statements, comments and prototypes in lines of at most 120 characters."""

import re
import sys
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass, field

TOLERANCE = sys.float_info.epsilon
"""Default relative update below which an iteration has converged: the round-off unit of binary64."""

MAX_ITERATIONS = 50
"""Default number of iterations after which a step fails: Newton's method takes 3 to 6, fixed-point iterations 5 to 20.
"""

ROUNDING_UNITS, INPUT_PRECISION, LARGEST_VIOLATION = 64.0, 1e-6, 1e-2
"""Limits of the constraint violation of an initial state, relative to its size.

Rounding, in units of it; precision of typed numbers, corrected silently; largest violation that is accepted.
"""


WIDTH = 120
CONTINUATION = 4
OPERATOR = re.compile(r" ([-+*/=]) ")
SHORT_SUM = re.compile(r"(?<=[-+*/] )\([^(),]{1,50}\)")


def table(declaration: str, rows: Sequence[str] | Sequence[Sequence[str]], *, braces: bool = True) -> str:
    """Return ``declaration = {...};`` of numbers, or of rows of numbers, in braces or not, on one line if they fit."""
    left, right = "{}" if braces else ("", "")
    braced = [row if isinstance(row, str) else f"{left}{', '.join(row)}{right}" for row in rows]
    line = f"{declaration} = {{{', '.join(braced)}}};"
    if len(line) <= WIDTH:
        return line
    lines = _entries(braced) if isinstance(rows[0], str) else _rows(braced)
    return "\n".join([f"{declaration} = {{", *lines]) + "};"


def _entries(braced: Sequence[str]) -> list[str]:
    """Return full lines of entries that are not broken."""
    joined = ", ".join(entry.replace(" ", "\0") for entry in braced)
    return [line.replace("\0", " ") for line in _lines(joined, "    ", "    ")]


def _rows(braced: Sequence[str]) -> list[str]:
    """Return one line per row, or several if it is too long."""
    lines: list[str] = []
    for k, row in enumerate(braced):
        lines += _lines(row + "," * (k + 1 < len(braced)), "    ", "     ")
    return lines


def wrapped(statement: str, indent: int = 2) -> str:
    """Return a statement, continued on further lines if it is too long, after an operator or comma."""
    first = " " * indent
    joined = SHORT_SUM.sub(lambda match: match[0].replace(" ", "\0"), statement)
    joined = OPERATOR.sub("\0\\1 ", joined)  # no break before an operator
    return "\n".join(_lines(joined, first, first + " " * CONTINUATION)).replace("\0", " ")


def wrapped_comment(text: str) -> str:
    """Return a comment in the first column, whose end is on the line of its last word."""
    return "\n".join(_lines(f"/* {text}\0*/", "", " * ")).replace("\0", " ")


def wrapped_comment_lines(text: str) -> str:
    """Return a comment of several lines, with lines that are too long broken."""
    lines = (_lines(line, "", " * ") if len(line) > WIDTH else [line] for line in text.split("\n"))
    return "\n".join(part for parts in lines for part in parts)


def wrapped_prototype(prototype: str) -> str:
    """Return the head of a function, broken between arguments if it is too long."""
    arguments = prototype.replace(" ", "\0").replace(",\0", ", ")  # no break within an argument
    return "\n".join(_lines(arguments, "", " " * CONTINUATION)).replace("\0", " ")


def wrapped_functions(text: str) -> str:
    """Return functions with the heads and statements that are too long broken."""

    def broken(line: str) -> str:
        indent = len(line) - len(line.lstrip())
        return wrapped(line.lstrip(), indent) if indent else wrapped_prototype(line)

    return "\n".join(broken(line) if len(line) > WIDTH else line for line in text.split("\n"))


def _lines(text: str, first: str, following: str) -> list[str]:
    return textwrap.wrap(
        text,
        WIDTH,
        initial_indent=first,
        subsequent_indent=following,
        replace_whitespace=False,
        break_long_words=False,
        break_on_hyphens=False,
    )


@dataclass(frozen=True, slots=True)
class HeaderRecord:
    """What the template of one header declares.

    Attributes:
        prefix: of the exported names; real: C type of the numbers.
        functions: names of the exported functions, without the prefix.
        run_fields: fields of the struct of a run that not every integrator has.
    """

    prefix: str
    real: str
    functions: list[str] = field(default_factory=list)
    run_fields: list[str] = field(default_factory=list)

    def prototype(self, result: str, name: str, *arguments: str | Sequence[str]) -> str:
        """Return the declaration of ``<prefix>_<name>``; types may contain ``{prefix}`` and ``{real}``."""
        self.functions.append(name)
        words = [word for part in arguments for word in ([part] if isinstance(part, str) else part)]
        between = "" if result.endswith("*") else " "
        head = f"{result}{between}{{prefix}}_{name}({', '.join(words) or 'void'});"
        return wrapped_prototype(head.format(prefix=self.prefix, real=self.real))

    def optional(self, name: str) -> str:
        """Return the name of a field of a run."""
        self.run_fields.append(name)
        return name
