"""Derivation report on one page of HTML, from the Lagrangian to the C: every equation, table and operation count.

    >>> from scvi_codegen.extras.derivation.page.document import derivation_html
    >>> from scvi_codegen.methods import SVI
    >>> from scvi_codegen.interfaces.models.problems import problem
    >>> "Euler-Lagrange equations" in derivation_html(problem("planar-pendulum").system, SVI(2))
    True

The page is self-contained: formulas are MathML, pictures inline, without scripts or network. Formulas that are too long
are replaced by their size (:mod:`scvi_codegen.extras.derivation.writing`), so that the page of a large system remains
readable.
"""
