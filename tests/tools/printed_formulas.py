"""Formulas as they are printed, read back into trees: MathML of pages, and their evaluation.

A tree is a tuple whose first entry is its kind. Names are text: letter, accent, lower and upper indices, so that
``l'_1`` is l with a dot and index 1, and ``Q_x^2`` has x below and 2 above. A reader knows nothing of the package: what
a mathematician reads on the page is what is evaluated.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any
from xml.etree import ElementTree

import mpmath
import numpy as np

mp = mpmath.MPContext()
mp.dps = 60

Tree = tuple[Any, ...]
Lookup = Callable[[str], Any]
"""From a name, its running indices replaced by numbers, to a number, an array, or a function of a name's arguments."""

ACCENTS = {"˙": "'", "¨": "''", "^": "hat", "~": "tilde"}
RAISED = ("Q", "V", "P")
"""Letters whose upper index counts nodes; of other letters it is a power."""
FUNCTIONS: dict[str, Callable[..., Any]] = {
    name: getattr(mp, name) for name in ("sin", "cos", "tan", "exp", "log", "sqrt", "sinh", "cosh", "tanh", "asin")
}
FUNCTIONS["ln"] = mp.log
OPENING, CLOSING = ("+", "-", "=", "(", "*"), ("+", "-", "=", ")", "*")
SIGNS = {"−": "-", "\u2062": "*", "·": "*", "×": "*", "⊗": "⊗"}


def trees_of_mathml(texts: Sequence[str]) -> Tree:
    """An equation or an expression set in one or several ``<math>`` elements."""
    tokens: list[Any] = []
    for text in texts:
        piece = [token for child in ElementTree.fromstring(text) for token in _tokens(child)]
        if tokens and tokens[-1] not in OPENING and piece[0] not in CLOSING:
            tokens.append("*")  # a long product goes on
        tokens += piece
    return _Parser(tokens).all()


def _name(letter: str, accent: str = "", below: str = "", above: str = "") -> Tree:
    return ("name", letter + accent, below, above)


def _tokens(element: ElementTree.Element) -> Iterator[Any]:  # noqa: C901
    """Signs as text, all else as trees."""
    children, text = list(element), element.text or ""
    match element.tag:
        case "mrow" if children and children[0].tag == "munderover":
            yield _sum(children)
        case "mrow":
            for child in children:
                yield from _tokens(child)
        case "mn":
            yield ("number", text.replace("−", "-"))
        case "mi" if text in FUNCTIONS:
            yield ("function", text, None)
        case "mi":
            yield _name(text)
        case "mo":
            yield SIGNS.get(text, text)
        case "mfrac":
            yield ("/", *(_tree(child) for child in children))
        case "msqrt":
            yield ("^", _Parser([token for child in children for token in _tokens(child)]).all(), ("number", "1/2"))
        case "mroot":
            yield ("^", _tree(children[0]), ("/", ("number", "1"), _tree(children[1])))
        case "mover":
            yield _name(children[0].text or "", ACCENTS[children[1].text or ""])
        case "msub":
            yield _arrays(children[0], _index(children[1]))
        case "msup" if children[0].tag == "mo":
            yield ")"
            yield ("power", _tree(children[1]))
        case "msup" if children[0].tag == "mi" and children[0].text in FUNCTIONS:
            yield ("function", children[0].text, _tree(children[1]))
        case "msup" if children[0].text in RAISED or (_index(children[1]) == "−1" and children[0].tag == "mi"):
            yield _name(children[0].text or "", above=_index(children[1]))
        case "msup":
            yield ("^", _tree(children[0]), _tree(children[1]))
        case "msubsup":
            base = _arrays(children[0], _index(children[1]))
            raised = base[0] == "name" and base[1].rstrip("'") in RAISED
            yield (*base[:3], _index(children[2])) if raised else ("^", base, _tree(children[2]))
        case _:
            raise AssertionError(f"what is {element.tag}?")


def _tree(element: ElementTree.Element) -> Tree:
    return _Parser(list(_tokens(element))).all()


def _index(element: ElementTree.Element) -> str:
    return "".join(element.itertext())


def _arrays(base: ElementTree.Element, index: str) -> Tree:
    """A letter with a lower index; a product of matrices in brackets is one name."""
    if base.tag == "mover":
        return _name(base[0].text or "", ACCENTS[base[1].text or ""], index)
    return _name("".join(base.itertext()).strip("()"), below=index)


def _sum(children: list[ElementTree.Element]) -> Tree:
    begin, end = _index(children[0][1]), _tree(children[0][2])
    variable, _, first = begin.partition("=")
    body = [token for child in children[1:] for token in _tokens(child)]
    return ("sum", variable, int(first), end, _Parser(body).all())


class _Parser:
    """Recursive descent over tokens: relations, sums, products, powers."""

    def __init__(self, tokens: list[Any]) -> None:
        self.tokens, self.place = tokens, 0

    def all(self) -> Tree:
        found = self.sum()
        if self.next == "=":
            self.take()
            found = ("=", found, self.sum())
        assert self.next is None, (self.next, self.tokens)
        return found

    @property
    def next(self) -> Any:
        return self.tokens[self.place] if self.place < len(self.tokens) else None

    def take(self) -> Any:
        self.place += 1
        return self.tokens[self.place - 1]

    def sum(self) -> Tree:
        terms: list[Tree] = []
        sign = self.take() if self.next in ("+", "-") else "+"
        while True:
            term = self.product()
            terms.append(term if sign == "+" else ("neg", term))
            if self.next not in ("+", "-"):
                return terms[0] if len(terms) == 1 else ("+", *terms)
            sign = self.take()

    def product(self) -> Tree:
        factors: list[Tree] = [self.factor()]
        while self.next is not None and self.next not in ("+", "-", ")", "=", ",", "/"):
            if self.next == "⊗":
                self.take()
                factors[-1] = ("⊗", factors[-1], self.factor())
                continue
            if self.next == "*":
                self.take()
            factors.append(self.factor())
        if self.next == "/":
            self.take()
            return ("/", ("*", *factors), self.factor())
        return factors[0] if len(factors) == 1 else ("*", *factors)

    def factor(self) -> Tree:
        token = self.take()
        if token == "(":
            inside = self.several()
            found = inside[0] if len(inside) == 1 else ("tuple", *inside)
        elif isinstance(token, tuple) and token[0] == "function":
            arguments = self.several() if self.next == "(" and self.take() else [self.factor()]
            found = ("call", token[1], *arguments)
            found = found if token[2] is None else ("^", found, token[2])
        elif token == "-":
            return ("neg", self.factor())
        else:
            assert isinstance(token, tuple), (token, self.tokens)
            found = token
            if token[0] == "name" and self.next == "(":
                self.take()
                found = ("apply", token, *self.several())
        while isinstance(self.next, tuple) and self.next[0] == "power":
            found = ("^", found, self.take()[1])
        return found

    def several(self) -> list[Tree]:
        """Return the comma-separated entries between brackets."""
        found = [self.sum()]
        while self.next == ",":
            self.take()
            found.append(self.sum())
        assert self.take() == ")"
        return found


# Evaluation.

INDEX = re.compile(r"(?<![A-Za-zα-ω])([ijn])([+−-]\d+)?(?![A-Za-zα-ω0-9])")


def value(tree: Tree, lookup: Lookup, running: dict[str, int] | None = None) -> Any:  # noqa: C901
    """A tree in numbers of 60 digits, or in arrays of them."""
    running = running or {}

    def of(branch: Tree) -> Any:
        return value(branch, lookup, running)

    match tree:
        case ("number", text):
            top, _, bottom = text.partition("/")
            return mp.mpf(top) / mp.mpf(bottom or 1)
        case ("name", *_):
            found = written(tree, running)
            whole = re.fullmatch(r"([ijn])([+-]\d+)?", found.replace("−", "-"))
            if whole and whole[1] in running:
                return mp.mpf(running[whole[1]] + int(whole[2] or 0))
            return lookup(found)
        case ("apply", name, *arguments):
            found = written(name, running)
            return lookup(f"{found}({', '.join(written(argument, running) for argument in arguments)})")
        case ("call", "exp" | "e", argument):
            return mp.exp(of(argument))
        case ("call", name, argument):
            return FUNCTIONS[name](of(argument))
        case ("neg", term):
            return -of(term)
        case ("+", *terms):
            total = of(terms[0])
            for term in terms[1:]:
                total = total + of(term)
            return total
        case ("*", *factors):
            total = of(factors[0])
            for factor in factors[1:]:
                other = of(factor)
                total = total @ other if np.ndim(total) == 2 and np.ndim(other) == 2 else total * other
            return total
        case ("⊗", left, right):
            return np.kron(of(left), of(right))
        case ("/", top, bottom):
            return of(top) / of(bottom)
        case ("^", ("name", "e", "", ""), exponent):
            return mp.exp(of(exponent))
        case ("^", base, exponent):
            below, power = of(base), of(exponent)
            if np.ndim(below) == 2:
                return np.linalg.matrix_power(below, int(power))
            return below ** (int(power) if power == int(power) else power)
        case ("sum", variable, first, end, body):
            last = int(running[end[1]] if end[0] == "name" and end[1] in running else of(end))
            terms = [value(body, lookup, running | {variable: k}) for k in range(first, last + 1)]
            return sum(terms[1:], terms[0]) if terms else mp.zero
    raise AssertionError(f"what is {tree}?")


def written(tree: Tree, running: dict[str, int]) -> str:
    """A name as text, with numbers in place of running indices."""
    if tree[0] == "apply":
        return f"{written(tree[1], running)}({', '.join(written(each, running) for each in tree[2:])})"
    assert tree[0] == "name", tree
    letter, below, above = tree[1:]
    found = letter
    for sign, index in (("_", below), ("^", above)):
        text = INDEX.sub(lambda m: str(running[m[1]] + _shift(m[2])) if m[1] in running else m[0], index)
        found += f"{sign}{text}" if text else ""
    return running_value(found, running)


def running_value(name: str, running: dict[str, int]) -> str:
    return str(running[name]) if name in running else name


def _shift(text: str | None) -> int:
    return int((text or "0").replace("−", "-"))


def names(tree: Tree) -> Iterator[str]:
    """Every name of a tree as it is printed."""
    if tree[0] in ("name", "apply"):
        yield written(tree, {})
    elif tree[0] == "sum":
        yield from names(tree[4])
    else:
        for branch in tree[1:]:
            if isinstance(branch, tuple):
                yield from names(branch)
