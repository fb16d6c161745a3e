"""SymPy's presentation MathML printer with names, numbers, sums and functions of the package."""

import html
import re
from collections.abc import Iterator, Sequence
from typing import Any
from xml.dom.minidom import Element, Node

import sympy
from sympy.core.function import AppliedUndef
from sympy.printing.mathml import MathMLPresentationPrinter
from sympy.printing.precedence import PRECEDENCE

from scvi_codegen.display.mathml.names import ACCENTS, TOKEN, Name, parsed, table_name

DIGITS = 6
"""Significant digits of floating-point numbers."""
SQUARED = ("sin", "cos", "tan", "sinh", "cosh", "tanh")
"""Functions whose power is written at their name."""
TYPESET = str.maketrans({"-": "\N{MINUS SIGN}", "ⅆ": "d", "ⅇ": "e", "ⅈ": "i"})
DOT = {"style": "font-weight:bold;padding-bottom:0.12em"}
"""Style of dots above a letter, which fonts without a table for mathematics would set onto the letter."""
DIGIT = re.compile("(<mrow>|<msup>)*<mn>")
"""Beginning of a factor that needs a visible sign of the product before it."""
GREEK = re.compile("[\u0370-\u03ff]")
UPRIGHT = {"mathvariant": "normal", "style": "font-style:italic"}
"""Style of Greek letters: the slanted ones that browsers would substitute are missing in most fonts."""


class Printer(MathMLPresentationPrinter):  # type: ignore[misc]  # SymPy has no stubs
    """SymPy's MathML printer with other names, numbers and sums, and brackets that unevaluated products need."""

    def text(self, *elements: Element, **attributes: str) -> str:
        """Return ``<math>`` around elements."""
        root = self.element("math", *elements, **attributes)
        _finish(root)
        return str(root.toxml())

    def terms(self, expression: sympy.Basic) -> Iterator[list[Element]]:
        """Yield the terms of a sum, each as its sign (the first one only a minus) and its absolute value."""
        if not isinstance(expression, sympy.Expr):
            yield [self._print(expression)]
            return
        for number, term in enumerate(self._as_ordered_terms(expression) if expression.is_Add else [expression]):
            negative = not term.is_Add and term.could_extract_minus_sign()
            size = self.parenthesize(-term if negative else term, PRECEDENCE["Add"])
            sign = [self.element("mo", "-" if negative else "+", form="infix" if number else "prefix")]
            yield [*sign, size] if negative or number else [size]

    def element(self, tag: str, *children: Element | str, **attributes: str) -> Element:
        """Return an element with its contents."""
        element: Element = self.dom.createElement(tag)
        for child in children:
            element.appendChild(self.dom.createTextNode(child) if isinstance(child, str) else child)
        for name, value in attributes.items():
            element.setAttribute(name, value)
        return element

    def _row(self, *children: Element) -> Element:
        return children[0] if len(children) == 1 else self.element("mrow", *children)

    def _print_Add(self, expr: sympy.Expr, order: Any = None) -> Element:
        return self._row(*(element for term in self.terms(expr) for element in term))

    def _print_Mul(self, expr: sympy.Expr) -> Any:
        """Return a product; SymPy omits the brackets of an unevaluated one of a sum and 1 or -1."""
        sign, size = expr.as_coeff_Mul()
        if abs(sign) == 1 and size.is_Add:
            return self._row(*([self.element("mo", "-")] if sign < 0 else []), self._paren_comma_separated(size))
        return super()._print_Mul(expr)

    def _print_Pow(self, expr: sympy.Pow) -> Any:
        base, exponent = expr.args
        if exponent.is_Integer and exponent > 0 and type(base).__name__ in SQUARED:
            name = self.element("msup", self.element("mi", self.mathml_tag(base)), self._print(exponent))
            return self._row(name, self._paren_comma_separated(*base.args))
        return super()._print_Pow(expr)

    def parenthesize(self, item: Any, level: int, strict: bool = False) -> Any:
        """Return ``item``, in brackets if its precedence requires them or its name has an upper index of its own."""
        raised = level == PRECEDENCE["Pow"] and item.is_Symbol and parsed(item.name).above
        return self._paren_comma_separated(item) if raised else super().parenthesize(item, level, strict)

    def _print_Sum(self, e: sympy.Sum) -> Element:
        *others, (index, low, high) = e.limits
        begin = self._row(self._print(index), self.element("mo", "="), self._print(low))
        sign = self.element("munderover", self.element("mo", "∑"), begin, self._print(high))
        summand = sympy.Sum(e.function, *others) if others else e.function
        return self._row(sign, self.parenthesize(summand, PRECEDENCE["Add"]))

    def _print_Float(self, expr: sympy.Float) -> Any:
        return super()._print_Float(sympy.Float(expr, DIGITS))

    def _print_AppliedUndef(self, e: AppliedUndef) -> Element:
        return self._row(self._named(e.func.__name__), self._paren_comma_separated(*e.args))

    def _print_KroneckerProduct(self, expr: sympy.MatrixExpr) -> Element:
        first, *others = (self.parenthesize(arg, PRECEDENCE["Mul"]) for arg in expr.args)
        return self._row(first, *(element for other in others for element in (self.element("mo", "⊗"), other)))

    def _print_Symbol(self, sym: sympy.Symbol) -> Element:
        return self._named(sym.name)

    _print_MatrixSymbol = _print_Symbol

    def _named(self, name: str) -> Element:
        """Return a symbol: letter, accent, indices; an entry of a derived table as a function or matrix entry."""
        entry = table_name(name)
        if entry is None:
            return self._typeset(parsed(name))
        factors = [self._typeset(factor) for factor in entry.factors]
        if entry.point is not None:
            return self._row(*factors, self._l_paren(), self._typeset(entry.point), self._r_paren())
        return self.element("msub", self._row(self._l_paren(), *factors, self._r_paren()), self._indices(entry.indices))

    def _typeset(self, name: Name) -> Element:
        letter = self.element("mi", name.letter)
        if name.accent:
            shape = DOT if name.accent.endswith("dot") else {}
            letter = self.element("mover", letter, self.element("mo", ACCENTS[name.accent], **shape), accent="true")
        scripts = [self._indices(part) for part in (name.below, name.above) if part]
        tag = "msubsup" if len(scripts) == 2 else "msup" if name.above else "msub"
        return self.element(tag, letter, *scripts) if scripts else letter

    def _indices(self, parts: Sequence[str]) -> Element:
        """Return indices with commas between them; ``k+1`` is a sum, ``q1`` has its own index."""
        elements: list[Element] = []
        for number, part in enumerate(parts):
            elements += [self._comma()] if number else []
            for token in TOKEN.findall(part.strip("{}()")):
                if token[0].isalpha():
                    elements.append(self._typeset(parsed(token)))
                else:
                    elements.append(self.element("mn" if token.isdigit() else "mo", token.replace("'", "′")))
        return self._row(*elements)


def _finish(node: Any) -> None:
    """Make the text well-formed (SymPy's printer writes HTML entities), Greek letters and products visible."""
    for child in node.childNodes:
        if child.nodeType != Node.TEXT_NODE:
            _finish(child)
            continue
        child.data = html.escape(html.unescape(child.data).translate(TYPESET), quote=False)
        if child.data == "\u2062" and DIGIT.match(node.nextSibling.toxml()):
            child.data = "·"
        if node.nodeName == "mi" and GREEK.fullmatch(child.data):
            for name, value in UPRIGHT.items():
                node.setAttribute(name, value)
