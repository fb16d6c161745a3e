"""SymPy expressions as presentation MathML, which browsers typeset.

    >>> from sympy import Symbol
    >>> Typeset.whole(Symbol("theta_1_dot") / 2)  # doctest: +ELLIPSIS
    '<math><mrow><mfrac><msub><mover accent="true"><mi mathvariant="normal" ...>θ</mi><mo ...>˙</mo></mover>...</math>'

Browsers do not break lines within ``<math>``, so :meth:`Typeset.terms` returns an equation as terms, between which a
line may end.

Names of symbols are parsed: ``theta_1_dot`` is a letter with an accent and an index, ``l_1_0`` is l_0(tau_1).
"""

import html
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any
from xml.dom.minidom import Element, Node

import sympy
from sympy.core.function import AppliedUndef
from sympy.printing.mathml import MathMLPresentationPrinter
from sympy.printing.precedence import PRECEDENCE
from sympy.printing.pretty.pretty_symbology import greek_unicode

ACCENTS = {"dot": "˙", "ddot": "¨", "hat": "^", "tilde": "~", "bar": "¯"}
LATEX_ACCENT = re.compile(r"\\(dot|ddot|hat|tilde|bar)\{?(\w+?)\}?(?=[_^]|$)")
RAISED = ("Q", "V", "P")
"""Letters whose first index counts nodes: Q_1_x is component x of Q at node 1, as the paper has it."""
CARDINAL = {"l": "", "dl": "dot"}
"""Tables of cardinal functions at points, with their accent: l_1_0 is l_0(tau_1)."""
PRODUCTS = {"DD": ("D_hat", "D_tilde"), "aa": ("A__2",), "bA": ("b", "A")}
"""Tables that are products of matrices: DD_1_0 is entry (1, 0) of the product, DD_n_j any."""
RUNNING = ("i", "j", "n")
"""Indices of sums."""
TOKEN = re.compile(r"[^\W\d]+\d*|\d+|\S")
"""Pieces of an index: letters with their digits, a number, or a sign."""
GREEK_NAMES = {letter: name for name, letter in greek_unicode.items()}


@dataclass(frozen=True, slots=True)
class Name:
    """Parts of a symbol's name: ``theta_1_dot`` is θ with an accent and one index."""

    letter: str
    accent: str = ""
    below: tuple[str, ...] = field(default=())
    above: tuple[str, ...] = field(default=())


def parsed(name: str) -> Name:
    """Return the parts of names as the package makes them (q_dot, p_q1_k, Q_2_x) and as SymPy does (Q__2_x, theta1)."""
    plain = LATEX_ACCENT.sub(r"\2_\1", name.strip("_") or name)
    head, *raised = re.split(r"__|\^", plain)
    above: list[str] = []
    letter, *below = head.split("_")
    for part in raised:
        first, *rest = part.split("_")
        above.append(first)
        below += rest
    accent = next((part for part in below if part in ACCENTS), "")
    if accent:
        below.remove(accent)
    if letter in RAISED and not above and below and below[0].isdigit():
        above.append(below.pop(0))
    if match := re.fullmatch(r"([^\W\d]+)(\d+)", letter):
        letter, below = match[1], [match[2], *below]
    return Name(str(greek_unicode.get(letter, letter)), accent, tuple(filter(None, below)), tuple(above))


@dataclass(frozen=True, slots=True)
class TableName:
    """An entry of a derived table: a cardinal function at a point, or matrices with the indices of their product."""

    factors: tuple[Name, ...]
    point: Name | None
    indices: tuple[str, ...]


def table_name(name: str) -> TableName | None:
    """Return the entry of a table that a symbol denotes if its name is that of one."""
    prefix, *indices = name.lstrip("_").split("_")
    if prefix in CARDINAL and len(indices) == 2 and all(map(str.isdigit, indices)):
        return TableName((Name("l", CARDINAL[prefix], below=(indices[1],)),), Name("τ", below=(indices[0],)), ())
    if prefix in PRODUCTS and indices and all(index.isdigit() or index in RUNNING for index in indices):
        return TableName(tuple(map(parsed, PRODUCTS[prefix])), None, tuple(indices))
    return None


def _latex(name: Name) -> str:
    letter = str(sympy.latex(sympy.Symbol(GREEK_NAMES.get(name.letter, name.letter))))
    accented = rf"\{name.accent}{{{letter}}}" if name.accent else letter
    return f"{accented}{_script('_', name.below)}{_script('^', name.above)}"


def _script(sign: str, parts: tuple[str, ...]) -> str:
    written = ",".join("".join(_latex(parsed(t)) if t[0].isalpha() else t for t in TOKEN.findall(p)) for p in parts)
    return f"{sign}{{{written}}}" if parts else ""


DIGITS = 6
"""Significant digits of floating-point numbers."""
SQUARED = ("sin", "cos", "tan", "sinh", "cosh", "tanh")
"""Functions whose power is written at their name."""
TYPESET = str.maketrans({"-": "\N{MINUS SIGN}", "ⅆ": "d", "ⅇ": "e", "ⅈ": "i"})
DOT = {"style": "font-weight:bold;padding-bottom:0.12em"}
"""Style of dots above a letter, which fonts without a table for mathematics would set onto the letter."""
DIGIT = re.compile("(<mrow>|<msup>)*<mn>")
"""Beginning of a factor that needs a visible sign of the product before it."""
FUNCTION = re.compile("(<mrow>|<msup>)*<mi>[a-z]{2,}</mi>")
"""Beginning of a factor that is a function, before which TeX sets a thin space."""
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
        tags = {(True, True): "msubsup", (False, True): "msup", (True, False): "msub"}
        return self.element(tags[bool(name.below), bool(name.above)], letter, *scripts) if scripts else letter

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
        if child.data == "\u2062":
            following = node.nextSibling.toxml()
            if DIGIT.match(following):
                child.data = "·"
            elif FUNCTION.match(following):
                node.setAttribute("rspace", "0.167em")
        if node.nodeName == "mi" and GREEK.fullmatch(child.data):
            for name, value in UPRIGHT.items():
                node.setAttribute(name, value)


class Typeset:
    """Formulas as MathML, which browsers typeset, and names in LaTeX."""

    @staticmethod
    def whole(expression: sympy.Basic) -> str:
        """Return an expression, a matrix or a relation as one ``<math>`` element; well-formed XML and HTML."""
        printer = Printer()
        return printer.text(printer._print(expression))

    @staticmethod
    def terms(right: sympy.Basic, left: sympy.Basic | None = None) -> tuple[str, ...]:
        """Return the terms of an expression or an equation as ``<math>`` elements of full size, each with its sign.

        ``left``: the left side of an equation, whose right side then begins with the equals sign.
        """
        if left is None and isinstance(right, sympy.Eq):
            left, right = right.lhs, right.rhs
        printer = Printer()
        terms = list(printer.terms(right))
        if left is not None:
            terms[0].insert(0, printer.element("mo", "=", form="infix"))
            terms = [*printer.terms(left), *terms]
        return tuple(printer.text(*term, displaystyle="true") for term in terms)

    @staticmethod
    def latex_name(name: str) -> str:
        """Return the name in LaTeX: ``l_1_0`` as l_0(tau_1), ``Q_2_x`` with 2 above and x below."""
        entry = table_name(name)
        if entry is None:
            return _latex(parsed(name))
        factors = "".join(map(_latex, entry.factors))
        return f"{factors}({_latex(entry.point)})" if entry.point else f"({factors}){_script('_', entry.indices)}"
