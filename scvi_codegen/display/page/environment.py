"""Typesetting of ASCII prose and table cells as HTML: 1e-9, h^2, q_(k+1), -3, <=, ``..``.

Jinja environment of pages, ``templates/page.html.jinja`` and those that extend it, with their filters.
"""

import re
from collections.abc import Callable
from functools import cache

import sympy
from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from markupsafe import Markup, escape
from sympy.printing.pretty.pretty_symbology import greek_unicode

from scvi_codegen.display.mathml import mathml, mathml_terms
from scvi_codegen.display.page import blocks
from scvi_codegen.display.page.blocks import Cell, TableBlock
from scvi_codegen.files.cache import template_folder

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


KINDS = {
    "paragraph": blocks.Paragraph,
    "formula": blocks.Formula,
    "listing": blocks.Listing,
    "code": blocks.Code,
    "drawing": blocks.Drawing,
    "beside": blocks.SideBySide,
    "table": blocks.TableBlock,
}
"""Tests of blocks in templates."""
COMMENT = re.compile(r"/\*.*?\*/", re.DOTALL)


def page_template(name: str, **filters: Callable[..., object]) -> Template:
    """Return the template of that file name, with ``filters`` in addition to those of all pages."""
    environment = _environment()
    if not filters:
        return environment.get_template(name)
    overlay = environment.overlay()
    overlay.filters = environment.filters | filters
    return overlay.get_template(name)


def style_sheet(*names: str) -> Markup:
    """Return the contents of style sheets, one after the other."""
    return Markup("\n".join((template_folder() / name).read_text(encoding="utf-8") for name in names))


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(template_folder()),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        autoescape=True,
    )
    environment.filters |= {
        "prose": prose,
        "cell": cell,
        "column_heading": column_heading,
        "column": column_class,
        "equation": lambda formula: Markup(" ".join(mathml_terms(formula.right, formula.left))),
        "c_text": _c_text,
        "markup": Markup,
    }
    environment.tests |= {name: lambda block, kind=kind: isinstance(block, kind) for name, kind in KINDS.items()}
    return environment


def _c_text(text: str) -> Markup:
    return Markup(COMMENT.sub(lambda match: f'<span class="comment">{match[0]}</span>', str(escape(text))))
