"""SymPy expressions as presentation MathML, which browsers typeset.

    >>> from sympy import Symbol
    >>> mathml(Symbol("theta_1_dot") / 2)  # doctest: +ELLIPSIS
    '<math><mrow><mfrac><msub><mover accent="true"><mi mathvariant="normal" ...>θ</mi><mo ...>˙</mo></mover>...</math>'

Browsers do not break lines within ``<math>``, so :func:`mathml_terms` returns an equation as terms, between which a
line may end.
"""

import sympy

from scvi_codegen.display.mathml.printer import Printer

__all__ = ["mathml", "mathml_terms"]


def mathml(expression: sympy.Basic) -> str:
    """Return an expression, a matrix or a relation as one ``<math>`` element; well-formed XML and HTML."""
    printer = Printer()
    return printer.text(printer._print(expression))


def mathml_terms(right: sympy.Basic, left: sympy.Basic | None = None) -> tuple[str, ...]:
    """Return the terms of an expression or an equation as ``<math>`` elements of full size; each begins with its sign.

    Args:
        right: an expression, or an equation if ``left`` is ``None``.
        left: the left side; the first term of the right side begins with the equals sign.
    """
    if left is None and isinstance(right, sympy.Eq):
        left, right = right.lhs, right.rhs
    printer = Printer()
    terms = list(printer.terms(right))
    if left is not None:
        terms[0].insert(0, printer.element("mo", "=", form="infix"))
        terms = [*printer.terms(left), *terms]
    return tuple(printer.text(*term, displaystyle="true") for term in terms)
