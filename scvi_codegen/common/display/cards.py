"""Notebook cards as HTML: a title, facts, tables and small pictures, in the notebook's colours."""

from collections.abc import Iterable, Sequence
from html import escape
from typing import NewType

Html = NewType("Html", str)
WIDTH, HEIGHT = 180, 28
"""Width and height of a small picture, in pixels."""
CELL = "text-align:left;padding:0.1em 1em 0.1em 0;vertical-align:middle;white-space:nowrap"
MOST_NAMES = 12


def plain(text: object) -> Html:
    """Return text as HTML."""
    return Html(escape(str(text)))


def listed(names: Sequence[object]) -> Html:
    """Return names with commas between them, and the number of those beyond the first dozen."""
    shown = ", ".join(map(str, names[:MOST_NAMES]))
    return plain(f"{shown}, .. ({len(names)})" if len(names) > MOST_NAMES else shown or "none")


def card(title: str, facts: Iterable[tuple[str, Html]], *parts: Html) -> str:
    """Return a card: a title, a line for each fact (its name, as text, and value), and further parts below."""
    body = [f'<div style="font-weight:600;margin-bottom:0.3em">{plain(title)}</div>']
    body.append(grid([(plain(name), value) for name, value in facts]))
    return f'<div class="scvi-codegen" style="overflow-x:auto">{"".join([*body, *parts])}</div>'


def grid(rows: Iterable[Sequence[Html]], *, head: Sequence[str] = (), caption: str = "") -> Html:
    """Return a table; the first cell of a row is its heading."""
    lines = (
        [f'<caption style="text-align:left;white-space:nowrap;padding:0.5em 0 0.1em">{plain(caption)}</caption>']
        if caption
        else []
    )
    if any(head):
        lines.append("<tr>" + "".join(f'<th scope="col" style="{CELL}">{plain(name)}</th>' for name in head) + "</tr>")
    for first, *others in rows:
        cells = "".join(f'<td style="{CELL}">{cell}</td>' for cell in others)
        lines.append(f'<tr><th scope="row" style="{CELL};font-weight:400;opacity:0.75">{first}</th>{cells}</tr>')
    return Html(f'<table style="border-collapse:collapse;border:0;margin:0">{"".join(lines)}</table>')


def sparkline(values: Sequence[float], label: str) -> Html:
    """Return a curve of finite values at equal distances, without axes; ``label`` describes it to screen readers."""
    finite = [(k, value) for k, value in enumerate(values) if abs(value) < float("inf")]
    low = min((value for _, value in finite), default=0.0)
    span = (max((value for _, value in finite), default=0.0) - low) or 1.0
    width = max(len(values) - 1, 1)
    points = " ".join(
        f"{1 + (WIDTH - 2) * k / width:.1f},{HEIGHT - 2 - (HEIGHT - 4) * ((value - low) / span):.1f}"
        for k, value in finite
    )
    return Html(
        f'<svg width="{WIDTH}" height="{HEIGHT}" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{plain(label)}">'
        f'<polyline points="{points}" fill="none" stroke="currentColor" stroke-width="1.2"/></svg>'
    )
