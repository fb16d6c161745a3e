"""Notebook cards as HTML: a title, facts, tables and small pictures, in the notebook's colours."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape

WIDTH, HEIGHT = 180, 28
"""Width and height of a small picture, in pixels."""
CELL = "text-align:left;padding:0.1em 1em 0.1em 0;vertical-align:middle;white-space:nowrap"
MOST_NAMES = 12


class Html(str):
    """HTML, for ``_repr_html_``; text becomes HTML by :meth:`plain`."""

    __slots__ = ()

    @staticmethod
    def plain(text: object) -> Html:
        """Return text as HTML."""
        return Html(escape(str(text)))

    @staticmethod
    def listed(names: Sequence[object]) -> Html:
        """Return names with commas between them, and the number of those beyond the first dozen."""
        shown = ", ".join(map(str, names[:MOST_NAMES]))
        return Html.plain(f"{shown}, .. ({len(names)})" if len(names) > MOST_NAMES else shown or "none")

    @staticmethod
    def card(title: str, facts: Iterable[tuple[str, Html]], *parts: Html) -> str:
        """Return a card: a title, a line for each fact (its name, as text, and value), and further parts below."""
        body = [f'<div style="font-weight:600;margin-bottom:0.3em">{Html.plain(title)}</div>']
        body.append(Html.grid([(Html.plain(name), value) for name, value in facts]))
        return f'<div class="scvi-codegen" style="overflow-x:auto">{"".join([*body, *parts])}</div>'

    @staticmethod
    def grid(rows: Iterable[Sequence[Html]], *, head: Sequence[str] = (), caption: str = "") -> Html:
        """Return a table; the first cell of a row is its heading."""
        style, lines = "text-align:left;white-space:nowrap;padding:0.5em 0 0.1em", list[str]()
        if caption:
            lines.append(f'<caption style="{style}">{Html.plain(caption)}</caption>')
        if any(head):
            lines.append(
                "<tr>" + "".join(f'<th scope="col" style="{CELL}">{Html.plain(name)}</th>' for name in head) + "</tr>"
            )
        for first, *others in rows:
            cells = "".join(f'<td style="{CELL}">{cell}</td>' for cell in others)
            lines.append(f'<tr><th scope="row" style="{CELL};font-weight:400;opacity:0.75">{first}</th>{cells}</tr>')
        return Html(f'<table style="border-collapse:collapse;border:0;margin:0">{"".join(lines)}</table>')

    @staticmethod
    def sparkline(values: Sequence[float], label: str) -> Html:
        """Return a curve of finite values at equal distances, without axes; ``label`` is read by screen readers."""
        finite = [(k, value) for k, value in enumerate(values) if abs(value) < float("inf")]
        low = min((value for _, value in finite), default=0.0)
        span = (max((value for _, value in finite), default=0.0) - low) or 1.0
        width = max(len(values) - 1, 1)
        points = " ".join(
            f"{1 + (WIDTH - 2) * k / width:.1f},{HEIGHT - 2 - (HEIGHT - 4) * ((value - low) / span):.1f}"
            for k, value in finite
        )
        size, text = f'width="{WIDTH}" height="{HEIGHT}" viewBox="0 0 {WIDTH} {HEIGHT}"', Html.plain(label)
        return Html(
            f'<svg {size} role="img" aria-label="{text}">'
            f'<polyline points="{points}" fill="none" stroke="currentColor" stroke-width="1.2"/></svg>'
        )


plain, listed, card, grid, sparkline = Html.plain, Html.listed, Html.card, Html.grid, Html.sparkline
