"""Self-contained pages of HTML: formulas as MathML, pictures inline, without scripts or network.

Modules: contents of a page (:mod:`~scvi_codegen.display.page.blocks`), typesetting of its text
(:mod:`~scvi_codegen.display.page.environment`), and its templates (:mod:`~scvi_codegen.display.page.environment`).
"""
