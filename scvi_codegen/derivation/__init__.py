"""From the Lagrangian to the emitted C on one page of HTML: every equation, table and count, and the C beside them.

    >>> from scvi_codegen.methods import SVI
    >>> from scvi_codegen.models.systems import planar_pendulum
    >>> "Euler-Lagrange equations" in derivation_html(planar_pendulum(), SVI(2))
    True

The page needs nothing else: formulas are MathML, pictures inline, no script, no network. What is too long to be read
is left out, and its size stands in its place (:mod:`scvi_codegen.derivation.page.elision`), so that a large system has
a page of the same kind.
"""

from __future__ import annotations

from scvi_codegen.derivation.page.document import derivation_html
from scvi_codegen.derivation.page.jacobian import Start

__all__ = ["Start", "derivation_html"]
