"""Pages of HTML that need nothing else: formulas as MathML, pictures inline, no script, no network.

What stands on a page (:mod:`~scvi_codegen.page.blocks`), its text typeset (:mod:`~scvi_codegen.page.typesetting`), and
the templates in which it is set (:mod:`~scvi_codegen.page.environment`).
"""
