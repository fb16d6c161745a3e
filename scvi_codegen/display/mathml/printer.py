"""SymPy's presentation MathML printer with other fractions, signs, names and numbers, and long products in pieces."""

from __future__ import annotations

import html
import re
from collections.abc import Iterator, Sequence
from itertools import chain, takewhile
from typing import Any, TypeAlias
from xml.dom.minidom import Element, Node

import sympy
from mpmath.libmp import to_str
from sympy.core.function import AppliedUndef
from sympy.printing.mathml import MathMLPresentationPrinter
from sympy.printing.precedence import PRECEDENCE, precedence_traditional

from scvi_codegen.display.mathml.names import ACCENTS, TOKEN, Name, parsed, table_name

DIGITS = 6
"""Significant digits of floating-point numbers."""
SHORT = 24
"""Largest number of characters of an expression that is put into a numerator whole."""
ONE_LINE = 48
"""Largest number of characters of an equation, or of a term, that is not broken."""
WIDE = 80
"""Number of characters beyond which a factor is broken within its brackets."""
TALL = "2.2em"
"""Height of brackets whose contents are in other pieces."""
SQUARED = ("sin", "cos", "tan", "sinh", "cosh", "tanh")
"""Functions whose power is written at their name."""
TYPESET = str.maketrans({"-": "\N{MINUS SIGN}", "ⅆ": "d", "ⅇ": "e", "ⅈ": "i"})
TALL_TAGS = ("mfrac", "mtable", "munderover")
DOT = {"style": "font-weight:bold;padding-bottom:0.12em"}
"""Style of dots above a letter, which fonts without a table for mathematics would set onto the letter."""
GREEK = re.compile("[\u0370-\u03ff]")
UPRIGHT = {"mathvariant": "normal", "style": "font-style:italic"}
"""Style of Greek letters: the slanted ones that browsers would substitute are missing in most fonts."""

Child: TypeAlias = Element | str
Piece: TypeAlias = list[Element]
"""Elements that become one ``<math>`` element."""


class Printer(MathMLPresentationPrinter):  # type: ignore[misc]  # SymPy has no stubs
    """SymPy's MathML printer with other fractions, signs, names and numbers."""

    def text(self, elements: Sequence[Element], *, display: bool) -> str:
        """Return ``<math>`` around elements."""
        root = self._element("math", *elements)
        if display:
            root.setAttribute("displaystyle", "true")
        _finish(root)
        return str(root.toxml())

    def printed(self, expression: Any) -> Element:
        """Return an expression as one element."""
        element: Element = self._print(expression)
        return element

    def operator(self, sign: str, **attributes: str) -> Element:
        """Return a sign with attributes."""
        element = self._element("mo", sign)
        for name, value in attributes.items():
            element.setAttribute(name, value)
        return element

    def terms(self, expression: sympy.Basic) -> Iterator[list[Piece]]:
        """Yield the terms of a sum with their signs, in pieces between which a line may end."""
        if not isinstance(expression, sympy.Add | sympy.Mul):
            yield [[self.printed(expression)]]
            return
        for number, term in enumerate(self._as_ordered_terms(expression) if expression.is_Add else [expression]):
            negative, size = _sign_and_size(term)
            pieces = list(self._product_pieces(size)) if length(term) > ONE_LINE else [[self._operand(size)]]
            if negative or number:
                form = "infix" if number else "prefix"
                pieces[0].insert(0, self.operator("-" if negative else "+", form=form))
            yield pieces

    def _product_pieces(self, product: sympy.Expr) -> Iterator[Piece]:
        """Yield a fraction or narrow factors, then the wide factors one by one, those in brackets in pieces, too."""
        fraction, factors = self._fraction(product, longest=WIDE)
        narrow = list(takewhile(_is_narrow, factors))
        if fraction is not None or narrow:
            yield [*([] if fraction is None else [fraction]), *self._factors(narrow)]
        for factor in factors[len(narrow) :]:
            base, exponent = factor.args if factor.is_Pow else (factor, sympy.S.One)
            if base.is_Add and length(base) > WIDE:
                yield from self._bracketed_pieces(base, exponent)
            else:
                yield self._factors([factor])

    def _bracketed_pieces(self, base: sympy.Expr, exponent: sympy.Expr) -> list[Piece]:
        pieces = [piece for term in self.terms(base) for piece in term]
        tall = any(map(_is_tall, chain.from_iterable(pieces)))
        begin, end = self._brackets(tall=tall, **({"minsize": TALL} if tall else {}))
        pieces[0].insert(0, begin)
        pieces[-1].append(end if exponent == 1 else self._element("msup", end, self._exponent(exponent)))
        return pieces

    def _element(self, tag: str, *children: Child) -> Element:
        element: Element = self.dom.createElement(tag)
        for child in children:
            element.appendChild(self.dom.createTextNode(child) if isinstance(child, str) else child)
        return element

    def _row(self, *children: Element) -> Element:
        return children[0] if len(children) == 1 else self._element("mrow", *children)

    def _fenced(self, *contents: Element) -> Element:
        """Return elements in brackets, which grow with fractions and matrices only."""
        begin, end = self._brackets(tall=any(map(_is_tall, contents)))
        return self._row(begin, *contents, end)

    def _brackets(self, *, tall: bool, **shape: str) -> list[Element]:
        """Return brackets, not symmetric about the fraction line, whose height not all fonts define."""
        shape |= {"symmetric": "false"} if tall else {"stretchy": "false"}
        return [self.operator(sign, **shape) for sign in "()"]

    def _bracketed(self, expression: Any) -> Element:
        return self._fenced(self.printed(expression))

    def _paren_comma_separated(self, *args: Any) -> Element:
        elements = [element for arg in args for element in (self._comma(), self.printed(arg))]
        return self._fenced(*elements[1:])

    def parenthesize(self, item: Any, level: int, strict: bool = False) -> Element:
        """Return ``item``, in brackets if its precedence is lower than that of its surroundings."""
        binding = precedence_traditional(item)
        return self._bracketed(item) if binding < level or (not strict and binding == level) else self.printed(item)

    def _print_Add(self, expr: sympy.Expr, order: Any = None) -> Element:
        children = []
        for number, term in enumerate(self._as_ordered_terms(expr, order=order)):
            negative, size = _sign_and_size(term)
            if negative or number:
                children.append(self.operator("-" if negative else "+"))
            children.append(self._operand(size))
        return self._row(*children)

    def _operand(self, term: sympy.Expr) -> Element:
        """Return a term without its sign; a sum within a sum keeps its brackets."""
        return self._bracketed(term) if term.is_Add else self.printed(term)

    def _print_Mul(self, expr: sympy.Expr) -> Element:
        negative, size = _sign_and_size(expr)
        product = self._product(size) if size.is_Mul else [self._operand(size)]
        return self._row(*([self.operator("-")] if negative else []), *product)

    def _product(self, expr: sympy.Expr) -> list[Element]:
        """Return a product without a sign."""
        fraction, factors = self._fraction(expr)
        return [*([] if fraction is None else [fraction]), *self._factors(factors)]

    def _fraction(self, expr: sympy.Expr, *, longest: int | None = None) -> tuple[Element | None, list[sympy.Expr]]:
        """Return a fraction of the short factors, and the wide factors behind it.

        A denominator of more than ``longest`` characters is one of these, as a negative power.
        """
        top, bottom = _numerator_and_denominator(expr)
        wide = [] if length(sympy.Mul(*top, evaluate=False)) <= SHORT else [x for x in top if not _is_narrow(x)]
        deep = [factor for factor in bottom if not _is_narrow(factor)]
        if deep and longest is not None and length(sympy.Mul(*deep, evaluate=False)) > longest:
            bottom = [factor for factor in bottom if factor not in deep]
            wide += [sympy.Pow(*_inverted(factor), evaluate=False) for factor in deep]
        elif deep:
            wide = []
        narrow = [factor for factor in top if factor not in wide]
        if not bottom:
            return None, [*narrow, *wide] if wide and deep else top
        return self._element("mfrac", self._whole(narrow), self._whole(bottom)), wide

    def _whole(self, factors: Sequence[sympy.Expr]) -> Element:
        """Return a numerator or a denominator: a single factor needs no brackets."""
        if not factors:
            return self._element("mn", "1")
        return self.printed(factors[0]) if len(factors) == 1 else self._row(*self._factors(factors))

    def _factors(self, factors: Sequence[sympy.Expr]) -> list[Element]:
        """Return factors with the invisible sign of a product between them, or a dot before a digit."""
        elements = []
        for number, factor in enumerate(factors):
            last = number == len(factors) - 1 and isinstance(factor, sympy.Sum | sympy.Integral | sympy.Derivative)
            element = self.parenthesize(factor, PRECEDENCE["Mul"], strict=last)
            if number:
                element = self._row(self.operator("·" if _starts_with_digit(factor) else "\u2062"), element)
            elements.append(element)
        return elements

    def _print_Pow(self, expr: sympy.Pow) -> Element:
        base, exponent = expr.args
        if exponent.is_Rational and exponent.is_negative:
            return self._element("mfrac", self._element("mn", "1"), self.printed(base**-exponent))
        if exponent.is_Rational and exponent.p == 1 and exponent.q > 1:
            root = [self.printed(base)] + ([] if exponent.q == 2 else [self.printed(exponent.q)])
            return self._element("msqrt" if exponent.q == 2 else "mroot", *root)
        if exponent.is_Integer and type(base).__name__ in SQUARED:
            name = self._element("msup", self._element("mi", self.mathml_tag(base)), self.printed(exponent))
            return self._row(name, self._paren_comma_separated(*base.args))
        plain = (base.is_Symbol and not parsed(base.name).above) or (base.is_Integer and base.is_nonnegative)
        below = self.printed(base) if plain else self._bracketed(base)
        if below.tagName == "msub" and plain:
            below.tagName = "msubsup"
            below.appendChild(self._exponent(exponent))
            return below
        return self._element("msup", below, self._exponent(exponent))

    def _exponent(self, exponent: sympy.Expr) -> Element:
        if exponent.is_Rational and not exponent.is_Integer:
            return self._row(self.printed(exponent.p), self.operator("/"), self.printed(exponent.q))
        return self.printed(exponent)

    def _print_Sum(self, e: sympy.Sum) -> Element:
        (index, low, high), *others = e.limits
        if others:
            return self._print_Sum(sympy.Sum(sympy.Sum(e.function, *e.limits[:-1]), e.limits[-1]))
        begin = self._row(self.printed(index), self.operator("="), self.printed(low))
        sign = self._element("munderover", self.operator("∑"), begin, self.printed(high))
        return self._row(sign, self._operand(e.function))

    def _print_Integer(self, expr: sympy.Integer) -> Element:
        return self._print_int(int(expr))

    def _print_int(self, p: int) -> Element:
        number = self._element("mn", str(abs(p)))
        return number if p >= 0 else self._row(self.operator("-"), number)

    def _print_Float(self, expr: sympy.Float) -> Element:
        digits, _, exponent = to_str(expr._mpf_, DIGITS, strip_zeros=True).partition("e")
        number = self._element("mn", digits.removeprefix("-").removesuffix(".0"))
        sign = [self.operator("-")] if digits.startswith("-") else []
        if not exponent:
            return self._row(*sign, number)
        power = self._element("msup", self._element("mn", "10"), self.printed(int(exponent)))
        return self._row(*sign, number, self.operator("×"), power)

    def _print_Function(self, e: sympy.Function) -> Element:
        undefined = isinstance(e, AppliedUndef)
        name = self._named(e.func.__name__) if undefined else self._element("mi", self.mathml_tag(e))
        return self._row(name, self._paren_comma_separated(*e.args))

    def _print_Piecewise(self, expr: sympy.Piecewise) -> Element:
        rows = []
        for value, condition in expr.args:
            when = self._element("mtext", "otherwise") if condition == sympy.true else self.printed(condition)
            rows.append(self._element("mtr", self._element("mtd", self.printed(value)), self._element("mtd", when)))
        return self._row(self._l_brace(), self._element("mtable", *rows))

    def _print_KroneckerProduct(self, expr: sympy.MatrixExpr) -> Element:
        first, *others = (self.parenthesize(arg, PRECEDENCE["Mul"]) for arg in expr.args)
        return self._row(first, *(element for other in others for element in (self.operator("⊗"), other)))

    def _print_Symbol(self, sym: sympy.Symbol, style: str = "plain") -> Element:
        return self._named(sym.name)

    _print_MatrixSymbol = _print_Dummy = _print_Symbol

    def _named(self, name: str) -> Element:
        """Return a symbol: letter, accent, indices; an entry of a derived table as a function or matrix entry."""
        entry = table_name(name)
        if entry is None:
            return self._typeset(parsed(name))
        factors = [self._typeset(factor) for factor in entry.factors]
        if entry.point is not None:
            return self._row(*factors, self._fenced(self._typeset(entry.point)))
        return self._element("msub", self._fenced(*factors), self._indices(entry.indices))

    def _typeset(self, name: Name) -> Element:
        letter = self._element("mi", name.letter)
        if name.accent:
            shape = DOT if name.accent.endswith("dot") else {}
            letter = self._element("mover", letter, self.operator(ACCENTS[name.accent], **shape))
            letter.setAttribute("accent", "true")
        scripts = [self._indices(part) for part in (name.below, name.above) if part]
        tag = "msubsup" if len(scripts) == 2 else "msup" if name.above else "msub"
        return self._element(tag, letter, *scripts) if scripts else letter

    def _indices(self, parts: Sequence[str]) -> Element:
        """Return indices with commas between them; ``k+1`` is a sum, ``q1`` has its own index."""
        elements: list[Element] = []
        for number, part in enumerate(parts):
            elements += [self._comma()] if number else []
            for token in TOKEN.findall(part.strip("{}()")):
                if token[0].isalpha():
                    elements.append(self._typeset(parsed(token)))
                else:
                    elements.append(self._element("mn" if token.isdigit() else "mo", token.replace("'", "′")))
        return self._row(*elements)


def _sign_and_size(term: sympy.Expr) -> tuple[bool, sympy.Expr]:
    """Return whether the leading number is negative, and the term without that sign."""
    if not isinstance(term, sympy.Mul) or term.is_Matrix:
        negative = bool(term.is_Number and term.is_negative)
        return negative, -term if negative else term
    first, *rest = term.args
    if not (first.is_Number and first.is_negative):
        return False, term
    size = rest if first == -1 else [-first, *rest]
    return True, size[0] if len(size) == 1 else sympy.Mul(*size, evaluate=False)


def _numerator_and_denominator(product: sympy.Expr) -> tuple[list[sympy.Expr], list[sympy.Expr]]:
    """Return the factors above and below the fraction line, in SymPy's order."""
    top: list[sympy.Expr] = []
    bottom: list[sympy.Expr] = []
    for factor in product.as_ordered_factors():
        if factor.is_Rational:
            top += [sympy.Integer(factor.p)] if factor.p != 1 else []
            bottom += [sympy.Integer(factor.q)] if factor.q != 1 else []
        elif factor.is_Pow and factor.exp.is_Rational and factor.exp.is_negative:
            bottom.append(factor.base**-factor.exp)
        else:
            top.append(factor)
    return top, bottom


def _inverted(factor: sympy.Expr) -> tuple[sympy.Expr, sympy.Expr]:
    """Return base and exponent of 1 / factor."""
    base, exponent = factor.args if factor.is_Pow else (factor, sympy.S.One)
    return base, -exponent


def _is_narrow(factor: sympy.Expr) -> bool:
    """Return whether a factor is a number, a symbol, or a power or root of these."""
    return bool(factor.is_Atom or (factor.is_Pow and factor.base.is_Atom and factor.exp.is_Atom))


def _starts_with_digit(factor: sympy.Expr) -> bool:
    if factor.is_Pow and not (factor.exp.is_Rational and factor.exp.p == 1):
        return bool(factor.base.is_Number)
    return bool(factor.is_Number)


def length(expression: sympy.Basic) -> int:
    """Return the approximate width of an expression, in characters."""
    return len(str(expression))


def _is_tall(element: Element) -> bool:
    """Return whether brackets around an element should grow."""
    return element.tagName in TALL_TAGS or any(_is_tall(child) for child in element.childNodes if child.nodeType == 1)


def _finish(node: Any) -> None:
    """Make the text well-formed (SymPy's printer writes HTML entities) and its Greek letters visible."""
    for child in node.childNodes:
        if child.nodeType != Node.TEXT_NODE:
            _finish(child)
            continue
        child.data = html.escape(html.unescape(child.data).translate(TYPESET), quote=False)
        if node.nodeName == "mi" and GREEK.fullmatch(child.data):
            for name, value in UPRIGHT.items():
                node.setAttribute(name, value)
