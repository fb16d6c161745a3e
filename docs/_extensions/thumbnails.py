"""Thumbnails of the gallery: the first large panel of each picture, cut out of its file.

Pictures are drawn by matplotlib, whose files have a group ``axes_N`` for each panel that begins with
its background, or has curves in space.
"""

import re
from pathlib import Path
from typing import Any

from sphinx.application import Sphinx

__all__ = ["setup"]

PAGE = "gallery/index"
PANEL = re.compile(r'<g id="axes_\d+">(.*?)(?=<g id="axes_|\Z)', re.DOTALL)
GLYPHS = re.compile(r"<defs>.*?</defs>", re.DOTALL)
BACKGROUND = re.compile(r'\s*<g id="patch_\d+">\s*<path d="([^"]*)"')
CURVE = re.compile(r'<path d="([^"]*)"')
NUMBER = re.compile(r"-?\d+(?:\.\d+)?")
SOURCE = re.compile(r'src="\.\./_images/(\w+)\.svg"')
ROOT, SIZE = (
    re.compile(r"<svg([^>]*)>"),
    re.compile(r' (?:viewBox|width|height)="[^"]*"'),
)
MARGIN = 3
"""Points around a panel, half of the width of a body at its edge."""


def first_panel(text: str) -> tuple[float, float, float, float] | None:
    """Return left, top, width and height in points of the first panel of at least half of the largest area."""
    boxes = []
    for panel in PANEL.findall(text):
        framed = BACKGROUND.match(panel)
        paths = [framed[1]] if framed else CURVE.findall(GLYPHS.sub("", panel))
        numbers = [float(number) for path in paths for number in NUMBER.findall(path)]
        if not numbers:
            return None  # an image
        (left, right), (top, bottom) = (
            (min(part), max(part)) for part in (numbers[::2], numbers[1::2])
        )
        boxes.append((left, top, right - left, bottom - top))
    largest = max((width * height for _, _, width, height in boxes), default=0.0)
    left, top, width, height = next(
        box for box in boxes if box[2] * box[3] >= largest / 2
    )
    return left - MARGIN, top - MARGIN, width + 2 * MARGIN, height + 2 * MARGIN


def _crop(
    app: Sphinx, pagename: str, templatename: str, context: Any, doctree: Any
) -> None:
    if pagename != PAGE:
        return

    folder = Path(app.outdir, "_images")
    folder.mkdir(exist_ok=True)

    def cropped(match: re.Match[str]) -> str:
        text = Path(app.srcdir, "gallery", f"{match[1]}.svg").read_text(
            encoding="utf-8"
        )
        if (box := first_panel(text)) is None:
            return match[0]
        left, top, width, height = (f"{number:.1f}" for number in box)
        size = f'viewBox="{left} {top} {width} {height}" width="{width}pt" height="{height}pt"'
        text = ROOT.sub(
            lambda root: f"<svg {size}{SIZE.sub('', root[1])}>", text, count=1
        )
        Path(folder, f"panel_{match[1]}.svg").write_text(text, encoding="utf-8")
        return f'src="../_images/panel_{match[1]}.svg"'

    context["body"] = SOURCE.sub(cropped, context["body"])


def setup(app: Sphinx) -> dict[str, Any]:
    """Crop the pictures when the page of the gallery is written."""
    app.connect("html-page-context", _crop)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
