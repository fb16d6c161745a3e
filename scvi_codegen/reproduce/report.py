"""Files of a result, and the report of all results: one self-contained HTML page with MathML, no script, no network.

It adapts to light and dark mode (pictures keep a light background), to narrow screens and to paper. The page is
``templates/report.html.jinja`` with ``templates/report.css`` on the base of all pages; this module converts results
into text for it.
"""

import base64
import csv
import io
import re
import textwrap
from collections import Counter
from collections.abc import Collection, Sequence
from pathlib import Path

from markupsafe import Markup

from scvi_codegen.display.page.blocks import TableBlock
from scvi_codegen.display.page.environment import SPACE, page_template, style_sheet
from scvi_codegen.files.atomic import write_atomically
from scvi_codegen.reproduce.drawing import draw
from scvi_codegen.reproduce.experiment import Result, Verdict
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
    page = page_template("report.html.jinja", label=label, caption=_caption, linked=linked)
    return page.render(
        title=results[0].title if alone else TITLE,
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
    return image.format(document, f"{label(result.name)}. {result.title}", result.picture.width)


def _caption(result: Result, table: TableBlock) -> str:
    return f"Data of {label(result.name)}{table.name and ': '}{table.name.replace('-', ' ')}"


# Files of a result: NAME.svg, NAME.png, NAME.csv, and NAME.txt with the statement; each written atomically.

WIDTH = 100


def write_result(result: Result, folder: Path) -> list[Path]:
    """Write the files of a result into an existing folder; return their paths."""
    written = []

    def write(name: str, content: bytes) -> None:
        path = folder / name
        write_atomically(path, lambda file: file.write(content))
        written.append(path)

    if result.picture is not None:
        write(f"{result.name}.svg", draw(result.picture, "svg"))
        write(f"{result.name}.png", draw(result.picture, "png"))
    for table in result.tables:
        write(f"{'-'.join(filter(None, (result.name, table.name)))}.csv", csv_text(table).encode())
    write(f"{result.name}.txt", statement(result).encode())
    return written


def csv_text(table: TableBlock) -> str:
    """Return CSV with a line of headings; floats in full precision."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator="\n")
    writer.writerow(table.columns)
    writer.writerows(["" if cell is None else cell for cell in row] for row in table.rows)
    return file.getvalue()


def statement(result: Result) -> str:
    """Return setting, claims and measurements as text."""
    lines = [f"{result.name}: {result.title}", f"verdict: {result.verdict.value}", ""]
    lines += [line for sentence in result.setting for line in _wrapped(sentence)]
    for check in result.checks:
        lines += ["", *_wrapped(f"paper:    {check.claim}"), *_wrapped(f"measured: {check.measured}")]
        lines += [f"verdict:  {check.verdict.value}"]
    return "\n".join(lines) + "\n"


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(text, WIDTH, subsequent_indent="  ", break_on_hyphens=False)
