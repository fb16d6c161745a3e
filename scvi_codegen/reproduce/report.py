"""Report of all results as one self-contained HTML page: inline pictures, MathML, no script, no network.

It adapts to light and dark mode, to narrow screens and to paper. The page is ``templates/report.html.jinja`` with
``templates/report.css`` on the base of all pages; this module converts results into text for it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from markupsafe import Markup

from scvi_codegen.display.page.environment import page_template, style_sheet
from scvi_codegen.reproduce.labels import label, linked
from scvi_codegen.reproduce.laboratory.experiment import Result, TableBlock, Verdict
from scvi_codegen.reproduce.svg import color_variables, inline_svg
from scvi_codegen.reproduce.writing import draw
from scvi_codegen.version import __version__

__all__ = ["report_html", "tally"]

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
        colors=_color_rules([*pictures.values()]),
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
    if result.picture is None:
        return Markup()
    text = f"{label(result.name)}. {_heading(result)}"
    return Markup(inline_svg(draw(result.picture, "svg"), prefix=result.name, label=text))


def _color_rules(pictures: Sequence[str]) -> Markup:
    """Return CSS for the colours of the pictures; print is always light."""

    def rule(dark: bool) -> str:
        variables = color_variables(pictures, dark=dark)
        return f":root{{{';'.join(f'{name}:{value}' for name, value in variables.items())}}}"

    return Markup(f"{rule(False)}\n@media screen and (prefers-color-scheme:dark){{{rule(True)}}}")


def _heading(result: Result) -> str:
    """Return the title, without the name if it begins with it."""
    name = label(result.name)
    shorter = result.title.removeprefix(name).lstrip(" .:,")
    return shorter[:1].upper() + shorter[1:] if shorter else result.title


def _caption(result: Result, table: TableBlock) -> str:
    return f"Data of {label(result.name)}{table.name and ': '}{table.name.replace('-', ' ')}"
