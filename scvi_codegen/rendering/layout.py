"""C source on lines of at most 120 characters: tables of numbers, statements, comments."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence

WIDTH = 120
CONTINUATION = 4
OPERATOR = re.compile(r" ([-+*/=]) ")
SHORT_SUM = re.compile(r"(?<=[-+*/] )\([^(),]{1,50}\)")
PROTOTYPE = re.compile(r"^\w+ \w+\([^;{]*\);$", re.MULTILINE)


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
    joined = SHORT_SUM.sub(lambda found: found[0].replace(" ", "\0"), statement)
    joined = OPERATOR.sub("\0\\1 ", joined)  # no break before an operator
    return "\n".join(_lines(joined, first, first + " " * CONTINUATION)).replace("\0", " ")


def wrapped_comment(text: str) -> str:
    """Return a comment in the first column."""
    return "\n".join(_lines(f"/* {text} */", "", " * "))


def wrapped_comment_lines(text: str) -> str:
    """Return a comment of several lines, with lines that are too long broken."""
    lines = (_lines(line, "", " * ") if len(line) > WIDTH else [line] for line in text.split("\n"))
    return "\n".join(part for parts in lines for part in parts)


def wrapped_prototypes(text: str) -> str:
    """Return the source with every prototype that is too long broken between arguments."""
    return PROTOTYPE.sub(lambda found: wrapped_prototype(" ".join(found[0].split())), text)


def wrapped_prototype(prototype: str) -> str:
    """Return the head of a function, broken between arguments if it is too long."""
    arguments = prototype.replace(" ", "\0").replace(",\0", ", ")  # no break within an argument
    return "\n".join(_lines(arguments, "", " " * CONTINUATION)).replace("\0", " ")


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
