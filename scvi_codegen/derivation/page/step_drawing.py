"""Drawing of a step as a line, with the nodes, stages and quadrature points of a method."""

from __future__ import annotations

from html import escape

from scvi_codegen.display.number_tables import Part, positions
from scvi_codegen.display.page.blocks import Drawing
from scvi_codegen.methods.method import Method
from scvi_codegen.tables.precision import Vector
from scvi_codegen.tables.quadrature import Quadrature

__all__ = ["step_drawing"]

WIDTH, MARGIN, ROW, RADIUS = 640, 30, 74, 5
TALLEST = 30
"""Height of the stem of the largest weight."""
INDEX = '<tspan dy="4" font-size="10">k</tspan>'


def step_drawing(method: Method) -> Drawing | None:
    """Return a drawing with one line per part of the method; ``None`` without parts."""
    if not method.parts:
        return None
    height = ROW * len(method.parts) + 34
    rows = [_row(part, ROW * (k + 1)) for k, part in enumerate(method.parts)]
    ends = _text(MARGIN, height - 8, f"t{INDEX}", "start") + _text(
        WIDTH - MARGIN, height - 8, f't{INDEX}<tspan dy="-4"> + h</tspan>', "end"
    )
    weighted = any(isinstance(part, Quadrature) for part in method.parts)
    caption = f"The step from t_k to t_k + h{', quadrature points as high as their weights' * weighted}."
    svg = (
        f'<svg viewBox="0 0 {WIDTH} {height}" role="img" aria-label="{escape(caption)}" style="--width: {WIDTH}px">'
        f"{''.join(rows)}{ends}</svg>"
    )
    return Drawing(svg, caption)


def _row(part: Part, y: int) -> str:
    line = f'<path d="M{MARGIN} {y}H{WIDTH - MARGIN}" stroke="currentColor" opacity="0.4"/>'
    marks = [_mark(float(c), y, stem) for c, stem in zip(positions(part), _stems(part), strict=True)]
    return line + _text(MARGIN, y - 46, escape(_words(part)), "start") + "".join(marks)


def _mark(c: float, y: int, stem: float | None) -> str:
    x = MARGIN + c * (WIDTH - 2 * MARGIN)
    if stem is None:
        return f'<circle cx="{x:.1f}" cy="{y}" r="{RADIUS}" fill="var(--link)"/>'
    top = y - stem
    return (
        f'<path d="M{x:.1f} {y}V{top:.1f}" stroke="var(--link)" stroke-width="2"/>'
        f'<circle cx="{x:.1f}" cy="{top:.1f}" r="{RADIUS - 1}" fill="var(--paper)" stroke="var(--link)" '
        'stroke-width="2"/>'
    )


def _stems(part: Part) -> list[float | None]:
    """Return heights by weight for a quadrature; ``None`` for nodes and stages."""
    if not isinstance(part, Quadrature):
        return [None] * len(positions(part))
    weights: Vector = part.weights
    largest = max(abs(weight) for weight in weights)
    return [float(TALLEST * weight / largest) for weight in weights]


def _words(part: Part) -> str:
    count = len(positions(part))
    if isinstance(part, Quadrature):
        return f"{count} quadrature point{'s' * (count > 1)} ({part.name})"
    what = "stage" if hasattr(part, "b") else "node"
    return f"{count} {what}{'s' * (count > 1)} ({part.name})"


def _text(x: float, y: float, text: str, anchor: str) -> str:
    return f'<text x="{x}" y="{y}" font-size="13" text-anchor="{anchor}">{text}</text>'
