"""Jinja environment of pages, ``templates/page.html.jinja`` and those that extend it, with their filters."""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache

from jinja2 import Environment, FileSystemLoader, StrictUndefined, Template
from markupsafe import Markup, escape

from scvi_codegen.display.mathml import mathml_terms
from scvi_codegen.display.page import blocks
from scvi_codegen.display.page.typesetting import cell, column_class, column_heading, prose
from scvi_codegen.files.templates import template_folder

__all__ = ["page_template", "style_sheet"]

KINDS = {
    "paragraph": blocks.Paragraph,
    "formula": blocks.Formula,
    "listing": blocks.Listing,
    "code": blocks.Code,
    "drawing": blocks.Drawing,
    "beside": blocks.SideBySide,
    "table": blocks.TableBlock,
}
"""Tests of blocks in templates."""
COMMENT = re.compile(r"/\*.*?\*/", re.DOTALL)


def page_template(name: str, **filters: Callable[..., object]) -> Template:
    """Return the template of that file name, with ``filters`` in addition to those of all pages."""
    environment = _environment()
    if not filters:
        return environment.get_template(name)
    overlay = environment.overlay()
    overlay.filters = environment.filters | filters
    return overlay.get_template(name)


def style_sheet(*names: str) -> Markup:
    """Return the contents of style sheets, one after the other."""
    return Markup("\n".join((template_folder() / name).read_text(encoding="utf-8") for name in names))


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FileSystemLoader(template_folder()),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        autoescape=True,
    )
    environment.filters |= {
        "prose": prose,
        "cell": cell,
        "column_heading": column_heading,
        "column": column_class,
        "equation": _equation,
        "c_text": _c_text,
        "markup": Markup,
    }
    environment.tests |= {name: _is_a(kind) for name, kind in KINDS.items()}
    return environment


def _is_a(kind: type) -> Callable[[object], bool]:
    return lambda block: isinstance(block, kind)


def _equation(formula: blocks.Formula) -> Markup:
    """Return terms that are not broken if they fit a line."""
    terms = mathml_terms(formula.right, formula.left)
    return Markup(" ".join(f'<span class="term">{" ".join(pieces)}</span>' for pieces in terms))


def _c_text(text: str) -> Markup:
    return Markup(COMMENT.sub(lambda match: f'<span class="comment">{match[0]}</span>', str(escape(text))))
