"""Self-contained pages of HTML: formulas as MathML, pictures inline, without scripts or network.

Blocks of a page: prose, formulas, tables, fixed-width text, drawings, and blocks side by side. Long formulas and
functions are replaced by their size. ASCII prose and table cells are typeset: 1e-9, h^2, q_(k+1), -3, <=, ``..``.
Templates are ``templates/page.html.jinja`` and those that extend it.
"""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any, TypeAlias

import sympy
from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from markupsafe import Markup, escape
from sympy.printing.pretty.pretty_symbology import greek_unicode

from scvi_codegen.api.text import TableBlock, Typeset, counted, template_folder


@dataclass(frozen=True, slots=True)
class Paragraph:
    """Prose."""

    text: str


@dataclass(frozen=True, slots=True)
class Formula:
    """A typeset equation, ``left = right``, or an expression alone.

    Attributes:
        right: SymPy; symbols called ``Q__2_x`` are set as Q with superscript 2 and subscript x.
        left: SymPy or ``None``.
        number: the paper's, or ``""``.
    """

    right: sympy.Basic
    left: sympy.Basic | None = None
    number: str = ""


@dataclass(frozen=True, slots=True)
class Listing:
    """Text in a fixed-width font: C, an outline, output."""

    text: str


@dataclass(frozen=True, slots=True)
class Code:
    """C source, with its comments in a lighter colour; long lines scroll."""

    text: str


@dataclass(frozen=True, slots=True)
class Drawing:
    """A picture.

    Attributes:
        svg: an ``<svg>`` element with colours of the page (``currentColor``, its variables).
        caption: description.
    """

    svg: str
    caption: str


@dataclass(frozen=True, slots=True, kw_only=True)
class SideBySide:
    """Contents side by side on a wide screen, one above the other on a narrow one.

    Attributes:
        title: of both, in a fixed-width font.
        left, right: contents.
        folded: whether only the title is visible until the reader unfolds it.
    """

    title: str
    left: tuple[Content, ...]
    right: tuple[Content, ...]
    folded: bool = False


Block: TypeAlias = Paragraph | Formula | Listing
Content: TypeAlias = Block | TableBlock | Code | Drawing | SideBySide


@dataclass(frozen=True, slots=True, kw_only=True)
class Section:
    """A part of a page: anchor of links, heading, and contents in order."""

    name: str
    title: str
    contents: tuple[Content, ...]


MOST_FORMULAS = 12
"""Largest number of equations of one kind that are shown."""
MOST_OPERATIONS = 400
"""Largest number of operations of an equation that is shown."""
MOST_TOGETHER = 600
"""Largest number of operations of all equations of one kind that are shown."""
MOST_LINES = 70
"""Largest number of lines of a C function that are shown."""


@lru_cache(maxsize=4096)
def operations(expression: sympy.Basic) -> int:
    """Return the number of operations as SymPy counts them: functions, powers, products, quotients and sums."""
    return int(sympy.count_ops(expression))


def formulas(all_formulas: Sequence[Formula], noun: str, *, together: int = MOST_TOGETHER) -> Iterator[Content]:
    """Yield the first formulas, of ``together`` operations in all, and the number of the others, called ``noun``."""
    shown, large, total = 0, [], 0
    for formula in all_formulas[:MOST_FORMULAS]:
        size = operations(formula.right)
        total += min(size, MOST_OPERATIONS)
        if shown and total > together:
            break
        shown += 1
        if size <= MOST_OPERATIONS:
            yield formula
        else:
            large.append(size)
    if large:
        count = counted(len(large), noun)
        yield Paragraph(f"{count} of more than {MOST_OPERATIONS} operations left out, the longest of {max(large)}.")
    if shown < len(all_formulas):
        yield Paragraph(f"The first {shown} of {counted(len(all_formulas), noun)}.")


def lines(text: str) -> Code:
    """Return C source, truncated if it is long."""
    source_lines = text.splitlines()
    if len(source_lines) <= MOST_LINES:
        return Code(text)
    shown = "\n".join(source_lines[:MOST_LINES])
    return Code(f"{shown}\n/* .. {len(source_lines) - MOST_LINES} more lines */")


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


def cell(value: Any, specification: str | None = None) -> Markup:
    """Return an entry of a table; numbers in the given format, a dash if there is none."""
    match value:
        case None:
            return Markup("\N{EN DASH}")
        case str():
            return prose(value)
        case sympy.Basic():
            return Markup(Typeset.whole(value))
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
    "paragraph": Paragraph,
    "formula": Formula,
    "listing": Listing,
    "code": Code,
    "drawing": Drawing,
    "beside": SideBySide,
    "table": TableBlock,
}
"""Tests of blocks in templates."""
COMMENT = re.compile(r"/\*.*?\*/", re.DOTALL)


def plain_template(name: str) -> Template:
    """Return the template of that file name, of text that is not HTML."""
    return _environment().overlay(autoescape=False, keep_trailing_newline=True).get_template(name)


def page_template(name: str, **filters: Callable[..., object]) -> Template:
    """Return the template of that file name, with ``filters`` in addition to those of all pages."""
    environment = _environment()
    if not filters:
        return environment.get_template(name)
    overlay = environment.overlay()
    overlay.filters = environment.filters | filters
    return overlay.get_template(name)


def style_sheet(*names: str) -> Markup:
    """Return the contents of style sheets, one after the other, after the font of formulas."""
    texts = ((template_folder() / name).read_text(encoding="utf-8") for name in names)
    return Markup("\n".join([mathematics_font(), *texts]))


@cache
def mathematics_font() -> Markup:
    """Return the rule that holds the font of formulas, a subset of STIX Two Math: browsers bring none of their own."""
    font = b64encode((template_folder() / "mathematics/stix_two_math.woff2").read_bytes()).decode()
    return Markup(f'@font-face {{ font-family: "STIX Two Math"; src: url(data:font/woff2;base64,{font}); }}')


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
        "equation": lambda formula: Markup(" ".join(Typeset.terms(formula.right, formula.left))),
        "c_text": lambda text: Markup(COMMENT.sub(r'<span class="comment">\g<0></span>', str(escape(text)))),
        "markup": Markup,
    }
    environment.tests |= {name: lambda block, kind=kind: isinstance(block, kind) for name, kind in KINDS.items()}
    return environment
