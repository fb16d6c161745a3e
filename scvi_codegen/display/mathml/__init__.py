"""SymPy expressions as presentation MathML, which browsers typeset.

    >>> from sympy import Symbol
    >>> mathml(Symbol("theta_1_dot") / 2)  # doctest: +ELLIPSIS
    '<math><mfrac><msub><mover accent="true"><mi mathvariant="normal" ...>θ</mi><mo ...>˙</mo></mover>...</math>'

Fractions contain short factors, followed by wide ones, and nothing is rewritten: signs and factors are those of the
expression. Browsers do not break lines within ``<math>``, so :func:`mathml_terms` returns a long equation in pieces
between which a line may end.
"""

from __future__ import annotations

import sympy

from scvi_codegen.display.mathml.printer import ONE_LINE, Printer, length

__all__ = ["mathml", "mathml_terms"]


def mathml(expression: sympy.Basic, *, display: bool = False) -> str:
    """Return one ``<math>`` element; well-formed XML and HTML.

    Args:
        expression: an expression, a matrix or a relation.
        display: whether it is on a line of its own, with full-size fractions and limits above and below.
    """
    printer = Printer()
    return printer.text([printer.printed(expression)], display=display)


def mathml_terms(right: sympy.Basic, left: sympy.Basic | None = None) -> tuple[tuple[str, ...], ...]:
    """Return an equation as terms, and each of them as ``<math>`` elements, to be set one after the other.

    A line may end between terms, and between the pieces of a term that is longer than a line: before a factor, and
    before a sign within the brackets of a long factor. A short equation is one piece.

    Args:
        right: an expression, or an equation if ``left`` is ``None``.
        left: the left side; ``left =`` is the first piece if it is short.
    """
    if left is None and isinstance(right, sympy.Eq):
        left, right = right.lhs, right.rhs
    printer = Printer()
    terms = list(printer.terms(right))
    if left is not None and length(left) <= ONE_LINE:
        terms[0].insert(0, [printer.printed(left), printer.operator("=")])
    elif left is not None:
        terms[0][0].insert(0, printer.operator("=", form="infix"))
        terms = [*printer.terms(left), *terms]
    if length(right) + (0 if left is None else length(left)) <= ONE_LINE:
        terms = [[[element for term in terms for piece in term for element in piece]]]
    return tuple(tuple(printer.text(piece, display=True) for piece in term) for term in terms)
