"""A derivation page taken apart: what it prints, in order, with formulas read back into trees."""

import html
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from printed_formulas import Tree, trees_of_mathml

PIECE = re.compile(
    r'<section id="(?P<section>[\w-]+)"|<p>(?P<prose>.*?)</p>|<summary>(?P<pair>.*?)</summary>'
    r'|<div class="formula">\s*<div[^>]*>(?P<formula>.*?)</div>\s*(?:<span class="number">\((?P<number>.*?)\)</span>)?'
    r'|<pre class="scroll code"[^>]*>(?P<code>.*?)</pre>'
    r"|<table>\s*<caption>(?P<caption>.*?)</caption>(?P<table>.*?)</table>",
    re.DOTALL,
)
MATH = re.compile(r"<math.*?</math>", re.DOTALL)


@dataclass(frozen=True)
class Entry:
    """A formula with its location: section, title of the pair, the paragraph before it, and number."""

    section: str
    pair: str
    heading: str
    number: str
    tree: Tree


@dataclass
class PrintedTable:
    """Cells are numbers' text, or trees."""

    section: str
    caption: str
    columns: list[str]
    rows: list[list[Any]]


@dataclass
class PrintedPage:
    """Everything of a page that states something in numbers or formulas."""

    entries: list[Entry] = field(default_factory=list)
    tables: list[PrintedTable] = field(default_factory=list)
    code: dict[str, str] = field(default_factory=dict)


def read_page(text: str) -> PrintedPage:
    page, section, pair, heading = PrintedPage(), "", "", ""
    for match in PIECE.finditer(text):
        if match["section"]:
            section, pair, heading = match["section"], "", ""
        elif match["prose"] is not None:
            heading = plain(match["prose"])
        elif match["pair"]:
            pair = match["pair"].partition("(")[0]
        elif match["formula"] is not None:
            tree = trees_of_mathml(MATH.findall(match["formula"]))
            page.entries.append(Entry(section, pair, heading, plain(match["number"] or ""), tree))
        elif match["code"] is not None and pair:
            page.code[pair] = plain(match["code"])
        elif match["table"]:
            page.tables.append(_table(section, plain(match["caption"]), match["table"]))
    return page


def plain(text: str) -> str:
    """Text without tags."""
    return html.unescape(re.sub(r"<[^>]*>", "", text)).replace("\N{MINUS SIGN}", "-").replace("\N{NO-BREAK SPACE}", " ")


def _table(section: str, caption: str, text: str) -> PrintedTable:
    columns = [plain(cell) for cell in re.findall(r"<th.*?>(.*?)</th>", text, re.DOTALL)]
    rows = [
        [trees_of_mathml(MATH.findall(cell)) if "<math" in cell else number(cell) for cell in _cells(row)]
        for row in re.findall(r"<tr>(.*?)</tr>", text.partition("<tbody>")[2], re.DOTALL)
    ]
    return PrintedTable(section, caption, columns, rows)


def _cells(row: str) -> Iterator[str]:
    return (match[1] for match in re.finditer(r"<td.*?>(.*?)</td>", row, re.DOTALL))


def number(text: str) -> str:
    """Return a cell as text: powers of ten as typed, ``-`` for undefined numbers."""
    powers = re.sub(r"10<sup>(.*?)</sup>", r"1e\1", re.sub(r"\s*×\s*10<sup>(.*?)</sup>", r"e\1", plain_spaces(text)))
    return plain(powers).replace("\N{EN DASH}", "")


def plain_spaces(text: str) -> str:
    return text.replace("\N{NO-BREAK SPACE}", " ").replace("\N{MULTIPLICATION SIGN}", "×")
