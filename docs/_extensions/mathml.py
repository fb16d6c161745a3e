"""Formulas as MathML, rendered by the browser: docutils translates LaTeX, without script and network."""

import re
from typing import Any

from docutils import nodes
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.application import Sphinx

__all__ = ["setup"]

DOTTED = re.compile(
    r"<munderover>\s*<mi>(\w)</mi>\s*((?:(?!</?munderover>).)*?)\s*"
    r"(<mo stretchy=\"false\">[˙¨ˆ~ˉ]</mo>)\s*</munderover>",
    re.DOTALL,
)
"""Accented letter with a subscript, which docutils translates with the subscript below the letter."""
DOT = '<mo stretchy="false" style="padding-bottom:0.08em">'
"""Dot that does not touch a tall letter, such as theta."""
SPACED = r'\1<mspace width="0.167em"/>'
FUNCTION = r'<mi(?: mathvariant="normal")?>[a-z]{2,}</mi>'
AFTER_FACTOR = re.compile(
    rf"(</m(?:i|n|sup|sub|subsup|frac|over)>|\)</mo>)(?=\s*(?:<msup>\s*)?{FUNCTION})"
)
"""End of a factor before the name of a function: TeX sets a thin space between them."""
BEFORE_ARGUMENT = re.compile(
    rf"(<mo>&ApplyFunction;</mo>|<msup>\s*{FUNCTION}\s*<mn>\d</mn>\s*</msup>)(?=\s*<m)(?!\s*<mo[^>]*>\()"
)
"""End of the name of a function before an argument without brackets, where TeX sets one, too."""


def setup(app: Sphinx) -> dict[str, Any]:
    """Register the MathML renderer with Sphinx."""
    app.add_html_math_renderer("mathml", (_inline, None), (_display, None))
    app.config.html_math_renderer = "mathml"
    return {"parallel_read_safe": True, "parallel_write_safe": True}


def _mathml(latex: str, *, as_block: bool) -> str:
    """Return MathML in which the index of a dotted letter is a subscript, and functions stand apart."""
    translated = DOTTED.sub(
        r'<msub><mover accent="true"><mi>\1</mi>\3</mover>\2</msub>',
        tex2mathml(latex, as_block=as_block),
    )
    apart = re.sub(r'<mo stretchy="false">(?=[˙¨])', DOT, translated)
    return AFTER_FACTOR.sub(SPACED, BEFORE_ARGUMENT.sub(SPACED, apart))


def _inline(writer: Any, node: nodes.math) -> None:
    writer.body.append(_mathml(node.astext(), as_block=False))
    raise nodes.SkipNode


def _display(writer: Any, node: nodes.math_block) -> None:
    writer.body.append(
        f'<div class="formula">{_mathml(node.astext(), as_block=True)}</div>'
    )
    raise nodes.SkipNode
