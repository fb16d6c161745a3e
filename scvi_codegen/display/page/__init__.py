"""Pages of HTML that need nothing else: formulas as MathML, pictures inline, no script, no network.

What stands on a page (:mod:`~scvi_codegen.display.page.blocks`), its text typeset
(:mod:`~scvi_codegen.display.page.typesetting`), and the templates in which it is set
(:mod:`~scvi_codegen.display.page.environment`).
"""
