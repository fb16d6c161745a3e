"""Names of experiments as the paper writes them, and links to their sections.

Conversion of Matplotlib's SVG for an HTML page: small, with unique identifiers, in the colours of the page.

Black becomes the colour of the page's text, white that of its background. Every other colour becomes a CSS variable, to
which :func:`color_variables` assigns another value in dark mode, of the same contrast. A picture that contains an image
or the many colours of a colour scale keeps its colours, on a light background.

Report of all results as one self-contained HTML page: inline pictures, MathML, no script, no network.

It adapts to light and dark mode, to narrow screens and to paper. The page is ``templates/report.html.jinja`` with
``templates/report.css`` on the base of all pages; this module converts results into text for it.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from xml.etree import ElementTree

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


DARK_PAPER, LIGHT_PAPER = "#16181c", "#ffffff"
TEXT_CONTRAST, LINE_CONTRAST = 4.6, 5.0
"""Least contrast with the background, of letters (WCAG AA requires 4.5) and, in dark mode, of lines."""
GREY, PALE = 16, 2.0
"""Largest difference of the channels of a grey; largest contrast of a pale area with a light background."""
MOST_COLORS = 16
DROPPED = {"metadata", "style", "title"}
COLOR = re.compile(r"#([0-9a-f]{6})\b")
VARIABLE = re.compile(r"var\(--(line|text)-([0-9a-f]{6})\)")
REFERENCE = re.compile(r"#([\w.-]+)")
FONT_FAMILY = re.compile(r"font-family: [^;]*;? ?")
LONG_NUMBER = re.compile(r"-?\d+\.\d{3,}")
SIDEWAYS = re.compile(r"rotate\(-?0(\.0*)? [^)]*\)")


def inline_svg(svg: bytes, *, prefix: str, label: str) -> str:
    """Return an ``<svg>`` element for the body of an HTML page.

    Args:
        svg: document as Matplotlib writes it.
        prefix: prefix of all identifiers, so that those of several pictures differ.
        label: description for screen readers.
    """
    root = ElementTree.fromstring(svg)
    references = {name for element in root.iter() for name in _referenced(element)}
    _, _, width, height = root.attrib["viewBox"].split()
    root.attrib.clear()
    root.attrib |= {"viewBox": f"0 0 {width} {height}", "role": "img", "aria-label": label}
    root.attrib["style"] = f"--width: {width}pt"
    fixed = _keeps_colors(root)
    if fixed:
        root.attrib["class"] = "light"
    for element in root.iter():
        _simplify(element, references, prefix, fixed=fixed)
    _prune(root)
    return ElementTree.tostring(root, encoding="unicode")


def color_variables(pages: Iterable[str], *, dark: bool) -> dict[str, str]:
    """Return the values of all variables used in parts of a page, by name, for light or dark mode."""
    used = sorted({match for page in pages for match in VARIABLE.findall(page)})
    return {f"--{kind}-{digits}": _adapted(f"#{digits}", kind, dark=dark) for kind, digits in used}


def contrast(one: str, other: str) -> float:
    """Return the contrast of two colours ``#rrggbb`` as defined by WCAG, from 1 to 21."""
    low, high = sorted((_luminance(one), _luminance(other)))
    return (high + 0.05) / (low + 0.05)


def _keeps_colors(root: ElementTree.Element) -> bool:
    colors = {color for element in root.iter() for color in COLOR.findall(element.get("style", ""))}
    return len(colors) > MOST_COLORS or any(_local(element.tag) == "image" for element in root.iter())


def _adapted(color: str, kind: str, *, dark: bool) -> str:
    """Return a colour of equal contrast in dark and in light mode; letters get sufficient contrast in both."""
    if not dark and kind == "line":
        return color
    original_contrast = contrast(color, LIGHT_PAPER)
    grey = max(_channels(color)) - min(_channels(color)) < GREY
    if kind == "line" and (grey or original_contrast < PALE):
        mixtures = _mixtures("#ffffff" if grey else color, DARK_PAPER)
        return min(mixtures, key=lambda mixed: abs(contrast(mixed, DARK_PAPER) - original_contrast))
    paper, end = (DARK_PAPER, "#ffffff") if dark else (LIGHT_PAPER, "#000000")
    wanted = TEXT_CONTRAST if kind == "text" else LINE_CONTRAST
    return next(mixed for mixed in _mixtures(color, end) if contrast(mixed, paper) >= wanted)


def _mixtures(color: str, other: str) -> Iterator[str]:
    """Yield mixtures from one colour to another, in steps of a hundredth."""
    pairs = list(zip(_channels(color), _channels(other), strict=True))
    for part in range(101):
        yield "#" + "".join(f"{round(c + (end - c) * part / 100):02x}" for c, end in pairs)


def _luminance(color: str) -> float:
    shares = [c / 255 for c in _channels(color)]
    linear = [s / 12.92 if s <= 0.04045 else ((s + 0.055) / 1.055) ** 2.4 for s in shares]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def _channels(color: str) -> list[int]:
    return [int(color[k : k + 2], 16) for k in (1, 3, 5)]


def _local(name: str) -> str:
    """Return a tag or attribute without its namespace."""
    return name.rpartition("}")[2]


def _referenced(element: ElementTree.Element) -> Iterator[str]:
    """Yield identifiers that an element refers to."""
    for name, value in element.attrib.items():
        if (_local(name) == "href" and value.startswith("#")) or "url(#" in value:
            yield from REFERENCE.findall(value)


def _simplify(element: ElementTree.Element, references: set[str], prefix: str, *, fixed: bool) -> None:
    """Rewrite the attributes of an element: no namespaces, short numbers, unique identifiers, variables for colours."""
    element.tag = _local(element.tag)
    kind = None if fixed else "text" if element.tag in ("text", "tspan") else "line"
    attributes = {_local(name): value for name, value in element.attrib.items()}
    element.attrib.clear()
    for name, value in attributes.items():
        if name == "id" and value in references:
            element.set(name, f"{prefix}-{value}")
        elif name == "href" and value.startswith("#"):
            element.set(name, f"#{prefix}-{value[1:]}")
        elif name == "transform" and not SIDEWAYS.fullmatch(value):
            element.set(name, value)
        elif name not in ("id", "transform"):
            element.set(name, _value(name, value, kind, prefix))


def _value(name: str, value: str, kind: str | None, prefix: str) -> str:
    if name == "style":
        value = FONT_FAMILY.sub("", value)
        if kind is not None:
            value = value.replace("#000000", "currentColor").replace("#ffffff", "var(--paper)")
            value = COLOR.sub(rf"var(--{kind}-\1)", value)
    value = value.replace("url(#", f"url(#{prefix}-")
    if name == "style":
        return value.replace(": ", ":").replace("; ", ";")
    if name in ("d", "points", "x", "y"):
        value = LONG_NUMBER.sub(lambda match: f"{float(match[0]):.2f}".rstrip("0").rstrip("."), value)
        return re.sub(r"\s*([A-Za-z])\s*", r"\1", value).strip() if name == "d" else value
    return value


def _prune(element: ElementTree.Element) -> None:
    """Remove white space, elements that browsers do not need, and groups without attributes."""
    children: list[ElementTree.Element] = []
    for child in list(element):
        child.tail = None
        if child.tag in DROPPED:
            continue
        _prune(child)
        plain = child.tag == "g" and not child.attrib
        children += list(child) if plain else [] if child.tag == "defs" and not len(child) else [child]
    element[:] = children
    if element.tag not in ("text", "tspan") or not (element.text or "").strip():
        element.text = None


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
