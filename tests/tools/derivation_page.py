"""A derivation page taken apart: what it prints, in order, with formulas read back into trees."""

import html
import re
from dataclasses import dataclass, field

from printed_formulas import Tree, trees_of_mathml

PIECE = re.compile(
    r'<section id="(?P<section>[\w-]+)"|<p>(?P<prose>.*?)</p>|<summary>(?P<pair>.*?)</summary>'
    r'|<div class="formula">\s*<div[^>]*>(?P<formula>.*?)</div>\s*(?:<span class="number">\((?P<number>.*?)\)</span>)?'
    r'|<pre class="scroll code"[^>]*>(?P<code>.*?)</pre>',
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
class PrintedPage:
    """Formulas of a page, and the C of its kernels."""

    entries: list[Entry] = field(default_factory=list)
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
    return page


def plain(text: str) -> str:
    """Text without tags."""
    return html.unescape(re.sub(r"<[^>]*>", "", text)).replace("\N{MINUS SIGN}", "-").replace("\N{NO-BREAK SPACE}", " ")
