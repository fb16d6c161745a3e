"""Matplotlib's SVG made part of a page: small, with identifiers of its own, in the colours of the page.

Black becomes the colour of the page's text, white that of its paper. Every other colour becomes a CSS variable, so that
:func:`color_variables` can give it another value on dark paper, where it stays as readable as it was.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from functools import partial
from xml.etree import ElementTree

__all__ = ["color_variables", "contrast", "inline_svg"]

DARK_PAPER, LIGHT_PAPER = "#16181c", "#ffffff"
TEXT_CONTRAST, LINE_CONTRAST = 4.6, 5.0
"""Least contrast with the paper, of letters (WCAG AA asks for 4.5) and, on dark paper, of lines."""
GREY = 16
"""Largest difference of the channels of a grey."""
DROPPED = {"metadata", "style", "title"}
COLOR = re.compile(r"#([0-9a-f]{6})\b")
VARIABLE = re.compile(r"var\(--(line|text)-([0-9a-f]{6})\)")
REFERENCE = re.compile(r"#([\w.-]+)")
FONT_FAMILY = re.compile(r"font-family: [^;]*;? ?")
LONG_NUMBER = re.compile(r"-?\d+\.\d{3,}")
SIDEWAYS = re.compile(r"rotate\(-?0(\.0*)? [^)]*\)")


def inline_svg(svg: bytes, *, prefix: str, label: str) -> str:
    """An ``<svg>`` element for the body of an HTML page.

    Args:
        svg: a document as Matplotlib writes it.
        prefix: of all identifiers, so that those of several pictures differ.
        label: what it shows, for those who do not see it.
    """
    root = ElementTree.fromstring(svg)
    references = {name for element in root.iter() for name in _referenced(element)}
    _, _, width, height = root.attrib["viewBox"].split()
    root.attrib.clear()
    root.attrib |= {"viewBox": f"0 0 {width} {height}", "role": "img", "aria-label": label}
    root.attrib["style"] = f"--width: {width}pt"
    for element in root.iter():
        _simplify(element, references, prefix)
    _prune(root)
    return ElementTree.tostring(root, encoding="unicode")


def color_variables(pages: Iterable[str], *, dark: bool) -> dict[str, str]:
    """The values of all variables used in pieces of a page, by name, on light or on dark paper."""
    used = sorted({match for page in pages for match in VARIABLE.findall(page)})
    return {f"--{kind}-{digits}": _adapted(f"#{digits}", kind, dark=dark) for kind, digits in used}


def contrast(one: str, other: str) -> float:
    """The contrast of two colours ``#rrggbb`` as WCAG defines it, from 1 to 21."""
    low, high = sorted((_luminance(one), _luminance(other)))
    return (high + 0.05) / (low + 0.05)


def _adapted(color: str, kind: str, *, dark: bool) -> str:
    """A colour mixed with white, or with black, as little as gives enough contrast; grey lines keep theirs."""
    if not dark and kind == "line":
        return color
    if kind == "line" and max(_channels(color)) - min(_channels(color)) < GREY:
        return min(
            (f"#{c:02x}{c:02x}{c:02x}" for c in range(256)), key=partial(_difference, contrast(color, LIGHT_PAPER))
        )
    paper, end = (DARK_PAPER, 255) if dark else (LIGHT_PAPER, 0)
    wanted = TEXT_CONTRAST if kind == "text" else LINE_CONTRAST
    mixtures = (
        "#" + "".join(f"{round(c + (end - c) * part / 100):02x}" for c in _channels(color)) for part in range(101)
    )
    return next(mixed for mixed in mixtures if contrast(mixed, paper) >= wanted)


def _difference(wanted: float, color: str) -> float:
    """From a wanted contrast on dark paper."""
    return (contrast(color, DARK_PAPER) - wanted) ** 2 if _luminance(color) > _luminance(DARK_PAPER) else math.inf


def _luminance(color: str) -> float:
    shares = [c / 255 for c in _channels(color)]
    linear = [s / 12.92 if s <= 0.04045 else ((s + 0.055) / 1.055) ** 2.4 for s in shares]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def _channels(color: str) -> list[int]:
    return [int(color[k : k + 2], 16) for k in (1, 3, 5)]


def _local(name: str) -> str:
    """A tag or attribute without its namespace."""
    return name.rpartition("}")[2]


def _referenced(element: ElementTree.Element) -> Iterator[str]:
    """Identifiers that an element refers to."""
    for name, value in element.attrib.items():
        if (_local(name) == "href" and value.startswith("#")) or "url(#" in value:
            yield from REFERENCE.findall(value)


def _simplify(element: ElementTree.Element, references: set[str], prefix: str) -> None:
    """Rewrite one element's attributes: no namespaces, short numbers, own identifiers, variables for colours."""
    element.tag = _local(element.tag)
    kind = "text" if element.tag in ("text", "tspan") else "line"
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


def _value(name: str, value: str, kind: str, prefix: str) -> str:
    value = value.replace("url(#", f"url(#{prefix}-")
    if name == "style":
        value = FONT_FAMILY.sub("", value).replace("#000000", "currentColor").replace("#ffffff", "var(--paper)")
        value = COLOR.sub(rf"var(--{kind}-\1)", value)
        return value.replace(": ", ":").replace("; ", ";")
    if name in ("d", "points", "x", "y"):
        value = LONG_NUMBER.sub(lambda match: f"{float(match[0]):.2f}".rstrip("0").rstrip("."), value)
        return re.sub(r"\s*([A-Za-z])\s*", r"\1", value).strip() if name == "d" else value
    return value


def _prune(element: ElementTree.Element) -> None:
    """Drop white space, what browsers do not need, and groups that say nothing."""
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
