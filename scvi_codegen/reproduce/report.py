"""Report of all results as one self-contained HTML page: pictures in the page, MathML, no script, no network.

It adapts to light and dark mode (pictures keep a light background), to narrow screens and to paper. The page is
``templates/report.html.jinja`` with ``templates/report.css`` on the base of all pages; this module converts results
into text for it.
"""

from __future__ import annotations

import base64
import re
from collections import Counter
from collections.abc import Collection, Sequence

from markupsafe import Markup

from scvi_codegen.display.page.environment import SPACE, page_template, style_sheet
from scvi_codegen.reproduce.laboratory.experiment import Result, TableBlock, Verdict
from scvi_codegen.reproduce.writing import draw
from scvi_codegen.version import __version__


def label(name: str) -> str:
    """Return the name of an experiment as in the paper: ``figure-4`` as Figure 4, ``tables-6-7`` as Tables 6-7."""
    first, *rest = name.split("-", 1)
    return " ".join([first.capitalize(), *rest])


def linked(text: Markup, names: Collection[str]) -> Markup:
    """Return text with links to the sections of the experiments that it names; names without a digit are words."""
    numbered = sorted((re.escape(name) for name in names if re.search(r"\d", name)), key=len, reverse=True)
    if not numbered:
        return text
    pattern = re.compile(rf"(?<![\w-])({'|'.join(numbered)})(?![\w-]|\.\d)")
    return Markup(pattern.sub(lambda match: f'<a href="#{match[0]}">{label(match[0]).replace(" ", SPACE)}</a>', text))


TITLE = "The paper, run again"
PLURALS = {Verdict.HOLDS: "hold", Verdict.PARTLY: "hold in part", Verdict.FAILS: "do not hold", Verdict.SHOWN: "shown"}


def report_html(results: Sequence[Result]) -> str:
    """Return the page: a table of all verdicts, then one section per result; a single result is a page of its own.

    Requires Matplotlib if a result has a picture.
    """
    pictures = {result.name: _picture(result) for result in results}
    alone = len(results) == 1
    page = page_template("report.html.jinja", label=label, heading=_heading, caption=_caption, linked=linked)
    return page.render(
        title=_heading(results[0]) if alone else TITLE,
        alone=alone,
        body_class="alone" if alone else "",
        results=results,
        names=[] if alone else list(pictures),
        counts=tally([result.verdict for result in results]),
        check_counts=tally([check.verdict for result in results for check in result.checks]),
        pictures=pictures,
        css=style_sheet("page.css", "report.css"),
        version=__version__,
    )


def tally(verdicts: Sequence[Verdict]) -> list[tuple[Verdict, str]]:
    """Return the number of occurrences of each verdict: ``"3 hold"``, ``"1 does not hold"``."""
    counts = Counter(verdicts)
    return [
        (verdict, f"{counts[verdict]} {verdict.value if counts[verdict] == 1 else PLURALS[verdict]}")
        for verdict in Verdict
        if counts[verdict]
    ]


def _picture(result: Result) -> Markup:
    """Return the picture as an element with the SVG document inside; it stays light in dark mode."""
    if result.picture is None:
        return Markup()
    document = base64.b64encode(draw(result.picture, "svg")).decode()
    image = Markup('<img src="data:image/svg+xml;base64,{}" alt="{}" style="--width:{:g}in">')
    return image.format(document, f"{label(result.name)}. {_heading(result)}", result.picture.width)


def _heading(result: Result) -> str:
    """Return the title, without the name if it begins with it."""
    name = label(result.name)
    shorter = result.title.removeprefix(name).lstrip(" .:,")
    return shorter[:1].upper() + shorter[1:] if shorter else result.title


def _caption(result: Result, table: TableBlock) -> str:
    return f"Data of {label(result.name)}{table.name and ': '}{table.name.replace('-', ' ')}"
