"""Formulas as MathML, rendered by the browser: docutils translates LaTeX, without script and network."""

import re
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx

__all__ = ["setup"]

DOTTED = re.compile(
    r"<munderover>\s*<mi>(\w)</mi>\s*(.*?)\s*(<mo stretchy=\"false\">˙</mo>)\s*</munderover>",
    re.DOTALL,
)
"""Dotted letter with a subscript, which docutils translates with the subscript below the letter."""


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the MathML renderer with Sphinx."""
    app.add_html_math_renderer("mathml", (_inline, None), (_display, None))
    app.config.html_math_renderer = "mathml"
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _mathml(latex: str, *, as_block: bool) -> str:
    """Return MathML in which the index of a dotted letter is a subscript."""
    translated = tex2mathml(latex, as_block=as_block)
    return DOTTED.sub(
        r'<msub><mover accent="true"><mi>\1</mi>\3</mover>\2</msub>', translated
    )


def _inline(writer: Any, node: nodes.math) -> None:
    writer.body.append(_mathml(node.astext(), as_block=False))
    raise nodes.SkipNode


def _display(writer: Any, node: nodes.math_block) -> None:
    writer.body.append(
        f'<div class="formula">{_mathml(node.astext(), as_block=True)}</div>'
    )
    raise nodes.SkipNode
