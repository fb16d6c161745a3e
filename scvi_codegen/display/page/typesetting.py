"""Typesetting of ASCII prose and table cells as HTML: 1e-9, h^2, q_(k+1), -3, <=, ``..``."""

from __future__ import annotations

import re

import sympy
from markupsafe import Markup, escape
from sympy.printing.pretty.pretty_symbology import greek_unicode

from scvi_codegen.display.mathml import mathml
from scvi_codegen.display.page.blocks import Cell, TableBlock

__all__ = ["SPACE", "cell", "column_class", "column_heading", "prose"]

FORMAT = ".3g"
LONGEST_LINE = 32
"""Largest number of characters of a cell that is not broken into lines."""
MINUS, TIMES, SPACE = "\N{MINUS SIGN}", "\N{MULTIPLICATION SIGN}", "\N{NO-BREAK SPACE}"
SIGNS = {
    "...": "\N{HORIZONTAL ELLIPSIS}",
    "..": "\N{HORIZONTAL ELLIPSIS}",
    "-&gt;": "\N{RIGHTWARDS ARROW}",
    "&lt;-": "\N{LEFTWARDS ARROW}",
    "&gt;=": "\N{GREATER-THAN OR EQUAL TO}",
    "&lt;=": "\N{LESS-THAN OR EQUAL TO}",
    "+-": "\N{PLUS-MINUS SIGN}",
}
SIGN = re.compile("|".join(map(re.escape, SIGNS)))
SCIENTIFIC = re.compile(r"(?<![\w.])(\d+(?:\.\d+)?)e([+-]?)0*(\d+)(?!\w)")
RAISED = re.compile(r"\^(?:\{([^}]*)\}|\(([^)]*)\)|(-?\w+))")
LOWERED = re.compile(
    r"((?<![\w.])(?:d?[A-Za-z]|s\d|beta|gamma|lambda|tau|theta)|\))_(?:(\d+|[a-z]{1,2}\d?)(?!\w)|\((\w\+1)\)|\{([^}]*)\})"
)
EQUALITY = re.compile(r"(?<=\w) = (?=[-\d])")
INDEX = re.compile(f"^([ijkn])(?={SPACE}=)")
NEGATIVE = re.compile(r"(?<![\w)\]>;-])-(?=\d)|(?<== )-(?=\w)|(?<= )-(?= |[A-Za-z](?:<su|\())")


def prose(text: str) -> Markup:
    """Return text with its numbers, indices and signs typeset; ``h = 0.1`` stays on one line."""
    typeset = SIGN.sub(lambda match: SIGNS[match[0]], str(escape(text)))
    typeset = LOWERED.sub(_lowered, SCIENTIFIC.sub(_scientific, typeset))
    typeset = EQUALITY.sub(f"{SPACE}={SPACE}", RAISED.sub(_raised, typeset))
    return Markup(NEGATIVE.sub(MINUS, typeset))


def column_heading(text: str) -> Markup:
    """Return the heading of a column; an index with a value is set as a variable."""
    return Markup(INDEX.sub(r"<var>\1</var>", str(prose(text))))


def cell(value: Cell, specification: str | None = None) -> Markup:
    """Return an entry of a table; numbers in the given format, a dash if there is none."""
    match value:
        case None:
            return Markup("\N{EN DASH}")
        case str():
            return prose(value)
        case sympy.Basic():
            return Markup(mathml(value))
        case float():
            return prose(format(value, specification or FORMAT))
    return prose(format(value, specification or ""))


def column_class(table: TableBlock, index: int) -> str:
    """Return ``"number"`` for right-aligned columns, ``"text"`` for multi-line ones, ``"word"`` for others."""
    cells = [row[index] for row in table.rows]
    texts = [value for value in cells if isinstance(value, str)]
    if any(isinstance(value, sympy.Symbol) for value in cells):
        return "word"
    if not texts:
        return "number"
    return "text" if max(map(len, texts)) > LONGEST_LINE else "word"


def _scientific(match: re.Match[str]) -> str:
    digits, sign, exponent = match.groups()
    if int(exponent) == 0:
        return digits
    power = f"10<sup>{MINUS if sign == '-' else ''}{exponent}</sup>"
    return power if digits == "1" else f"{digits}{SPACE}{TIMES}{SPACE}{power}"


def _raised(match: re.Match[str]) -> str:
    return f"<sup>{(match[1] or match[2] or match[3]).replace('-', MINUS)}</sup>"


def _lowered(match: re.Match[str]) -> str:
    letter, *indices = match.groups()
    return f"{greek_unicode.get(letter, letter)}<sub>{next(filter(None, indices))}</sub>"
