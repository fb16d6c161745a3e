"""Intermediate quantities: nodes of expressions that are computed once, and never expanded into what contains them.

The velocity of the tenth body of a chain is a sum of ten terms times rotations if it is written in joint coordinates,
and that of the hundredth of a hundred; as a function of the velocity of the body before it, all have the same length.
SymPy merges nested sums and products. An :class:`Intermediate` is opaque to it, so that an expression remains a
straight-line program, whose length is that of its definitions, and whose derivatives are computed by adjoints
(:func:`~scvi_codegen.systems.formulas.expressions.gradient`).

SymPy traverses expressions as trees, which takes exponential time where quantities share others. Comparisons, free
symbols and replacements of an intermediate quantity are therefore computed once per definition.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Container, Iterable, Mapping, Sequence
from functools import cache, cmp_to_key, lru_cache, reduce
from itertools import count
from typing import Any
from weakref import WeakValueDictionary

from sympy import Abs, Add, Basic, Expr, Mul, Rational, S, Symbol, cos, sin
from sympy.core.evalf import prec_to_dps

from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.systems.formulas.kinks import absolute, rint, unit_step

LONGEST_WRITTEN = 20_000
"""Largest number of nodes of a formula that is displayed or stored as text."""

LONGEST_SHOWN = 1_000
"""That of formulas of contacts in messages and comments."""

_NUMBERS = count()
_KNOWN: WeakValueDictionary[Expr, Intermediate] = WeakValueDictionary()


class Intermediate(Expr):  # type: ignore[misc]  # SymPy is untyped
    """Expression with the value of its definition, which SymPy neither expands nor compares term by term.

    Quantities with equal definitions are one object. Numbers ascend: those in a definition precede its own.
    """

    number: int
    inner: tuple[Intermediate, ...]
    varies_with: frozenset[Symbol]
    """Symbols by which its derivatives are not 0 everywhere."""
    arguments: tuple[Expr, ...] = ()
    """Arguments of the function that is written in its place; none of other quantities."""
    is_commutative = True
    is_real = True

    def __new__(cls, definition: Expr) -> Intermediate:
        """Return the quantity with this definition."""
        quantity = _KNOWN.get(definition)
        if quantity is None:
            quantity = Expr.__new__(cls, definition)
            quantity.number = next(_NUMBERS)
            quantity.inner, symbols, has_steps = _contents([definition])
            quantity._free = symbols.union(*(inner._free for inner in quantity.inner))
            varying, symbols, _ = _contents([definition], *STEPS) if has_steps else (quantity.inner, symbols, False)
            quantity.varies_with = symbols.union(*(inner.varies_with for inner in varying))
            _KNOWN[definition] = quantity
        return quantity

    @property
    def definition(self) -> Expr:
        """The expression that it abbreviates."""
        return self.args[0]

    @property
    def free_symbols(self) -> set[Symbol]:
        """Symbols of its definition and of all quantities in it."""
        return set(self._free)

    @property
    def is_number(self) -> bool:
        """True if its definition is a constant."""
        return not self._free

    def _hashable_content(self) -> tuple[int]:
        return (self.number,)

    def _replaced(self, definition: Expr, _: Any) -> Expr:
        return intermediate(definition)

    def _printed(self, printer: Any, *_: Any) -> str:
        """Return its definition in parentheses, or its number where that is too long to read."""
        if printer.printmethod == "_sympystr" and written_size(self) > LONGEST_WRITTEN:
            return f"w{self.number}"
        return f"({printer._print(self.definition)})"

    _sympystr = _latex = _pythoncode = _numpycode = _scipycode = _mpmathcode = _printed

    def _eval_evalf(self, precision: int) -> Expr:
        return self.definition.evalf(prec_to_dps(precision))

    def _eval_derivative(self, symbol: Symbol) -> Expr:
        return self.definition.diff(symbol) if symbol in self._free else S.Zero

    def _xreplace(self, rule: Any) -> tuple[Expr, bool]:
        if _LAST[0] != rule:
            _LAST[:] = dict(rule), {}
        replaced: dict[Intermediate, tuple[Expr, bool]] = _LAST[1]
        for quantity in intermediates(self, without=replaced):
            if quantity in rule:
                replaced[quantity] = (rule[quantity], True)
            else:
                value, changed = quantity.definition._xreplace(rule)
                replaced[quantity] = (quantity._replaced(value, rule), True) if changed else (quantity, False)
        return replaced[self]

    @staticmethod
    def named(expression: Expr) -> Expr:
        """Return an expression as an intermediate quantity; symbols, numbers and multiples of them as they are."""
        return intermediate(expression)

    @staticmethod
    def within(*expressions: Expr) -> list[Intermediate]:
        """Return all quantities in expressions, each after those that it depends on."""
        return intermediates(*expressions)

    @staticmethod
    def written_out(expression: Expr) -> Expr:
        """Return an expression without these quantities; SystemDefinitionError if it is too long."""
        return written_out(expression)

    @staticmethod
    def sum_of_products(*factors: Iterable[Expr]) -> Expr:
        """Return the sum of a_k b_k .. over entries of sequences, in a third of SymPy's time."""
        return total(reduce(product, entries) for entries in zip(*factors, strict=True))


STEPS = (unit_step, rint)
"""Functions that are constant but for jumps."""


def _contents(
    expressions: Iterable[Expr], *types: type, without: Container[Any] = ()
) -> tuple[tuple[Intermediate, ...], frozenset[Symbol], bool]:
    """Return quantities and symbols in expressions, outside of some functions, and whether these have ``STEPS``.

    Each subexpression that they share is visited once, unlike by SymPy's ``free_symbols``, and none of ``without``.
    """
    seen, has_steps = {*expressions}, False
    pending = [*seen]
    quantities, symbols = list[Intermediate](), list[Symbol]()
    while pending:
        node = pending.pop()
        if node in without:
            continue
        if isinstance(node, Intermediate):
            quantities.append(node)
        elif isinstance(node, Symbol):
            symbols.append(node)
        elif not isinstance(node, types):
            has_steps = has_steps or isinstance(node, STEPS)
            new = [argument for argument in node.args if argument not in seen]
            seen.update(new)
            pending += new
    return tuple(quantities), frozenset(symbols), has_steps


def symbols_of(*expressions: Expr) -> frozenset[Symbol]:
    """Return the symbols of expressions and of all quantities in them, of each subexpression once."""
    quantities, symbols, _ = _contents(expressions)
    return symbols.union(*(quantity._free for quantity in quantities))


_LAST: list[Any] = [{}, {}]
"""The last rule of replacements, and the quantities replaced by it, which an equal rule replaces next."""


def intermediate(expression: Expr) -> Expr:
    """Return an expression as an intermediate quantity; symbols, numbers and multiples of them as they are.

    >>> from sympy.abc import x, y
    >>> total = intermediate(x + y)
    >>> (2 * total + x).free_symbols == {x, y}, intermediate(x + y) is total, intermediate(-x)
    (True, True, -x)
    """
    rest = expression.as_coeff_Mul()[1]
    return expression if rest.is_Atom or isinstance(rest, Intermediate) else Intermediate(expression)


_FACTORS = Symbol, Intermediate, sin, cos
_IN_ORDER = cmp_to_key(Basic.compare)


def _factors_of(node: Expr) -> tuple[Expr, tuple[Expr, ...]]:
    """Return the number in a product, and its other factors."""
    factors = node.args if node.is_Mul else (node,)
    return (factors[0], factors[1:]) if isinstance(factors[0], Rational) else (S.One, factors)


def product(a: Expr, b: Expr) -> Expr:
    """Return ``Mul(a, b)``, in a third of its time if no factor is a sum or power, and none occurs twice.

    >>> from sympy.abc import x, y
    >>> product(2 * x, cos(y)) == Mul(2 * x, cos(y)), product(x, x)
    (True, x**2)
    """
    (number, factors), (other, others) = _factors_of(a), _factors_of(b)
    factors += others
    if not all(isinstance(factor, _FACTORS) for factor in factors) or len({*factors}) < len(factors):
        return Mul(a, b)
    if number is S.Zero or other is S.Zero:
        return S.Zero
    number = number if other is S.One else number * other
    return _node(Mul, () if number is S.One else (number,), factors)


def total(terms: Iterable[Expr]) -> Expr:
    """Return ``Add(*terms)``, in a third of its time if no term is a sum, and no two are alike.

    >>> from sympy.abc import x, y
    >>> total([2 * x, y, S(3)]) == 2 * x + y + 3, total([x, 2 * x])
    (True, 3*x)
    """
    terms = [term for term in terms if term is not S.Zero]
    if len(terms) == 1:
        return terms[0]
    alike = {_factors_of(term)[1] for term in terms}
    numbers = tuple(term for term in terms if isinstance(term, Rational))
    written = all(term.is_Mul or isinstance(term, (*_FACTORS, Rational)) for term in terms)
    if not written or len(alike) < len(terms) or len(numbers) > 1:
        return Add(*terms)
    return _node(Add, numbers, [term for term in terms if not isinstance(term, Rational)])


def _node(kind: type, number: tuple[Expr, ...], arguments: Sequence[Expr]) -> Expr:
    """Return a sum or product with its arguments in SymPy's order."""
    return kind._from_args((*number, *sorted(arguments, key=_IN_ORDER)), is_commutative=True)  # type: ignore[attr-defined]


def _independence(variables: Collection[Symbol]) -> Callable[[Expr], bool]:
    """Return whether an expression contains none of the variables, as a function that visits each part once."""

    @cache
    def constant(node: Expr) -> bool:
        if isinstance(node, Intermediate) or not node.args:
            return bool(node.free_symbols.isdisjoint(variables))
        return all(map(constant, node.args))

    return constant


def separated(expressions: Sequence[Expr], variables: Collection[Symbol]) -> tuple[list[Expr], dict[Expr, Symbol]]:
    """Return expressions as functions of variables and of new symbols, and the parts that these abbreviate.

    The parts are the largest ones that do not depend on the variables, and are no numbers: values that need not be
    computed again when only the variables change.
    """
    rebuilt: dict[Expr, Expr] = {}
    parts: dict[Expr, Symbol] = {}
    constant = _independence(variables)

    def read(node: Expr) -> Expr:
        if node not in rebuilt:
            rebuilt[node] = written(node)
        return rebuilt[node]

    def written(node: Expr) -> Expr:
        if node in variables:
            return node
        if constant(node):
            factor, part = node.as_coeff_Mul()
            return node if part.is_number else factor * parts.setdefault(part, Symbol(f"_{len(parts)}", real=True))
        if isinstance(node, Intermediate):
            return intermediate(read(node.definition))
        if not (node.is_Add or node.is_Mul):
            return node.func(*map(read, node.args))
        fixed = [part for part in node.args if constant(part)]
        return node.func(read(node.func(*fixed)), *(read(part) for part in node.args if not constant(part)))

    for quantity in intermediates(*expressions):
        if not constant(quantity):
            read(quantity)
    return [*map(read, expressions)], parts


def written_out(expression: Expr) -> Expr:
    """Return an expression without intermediate quantities, tables by name; SystemDefinitionError if it is too long."""
    size = written_size(expression)
    if size > LONGEST_WRITTEN and inner_of(expression):
        raise SystemDefinitionError(
            f"the formula has {size} terms and factors if its intermediate quantities are written out; at most "
            f"{LONGEST_WRITTEN} can be displayed or stored as text. Use a smaller mechanism, or keep the file from "
            "which the system was read"
        )
    rules: dict[Expr, Expr] = {}
    named = {quantity for quantity in intermediates(expression) if quantity.arguments}
    for quantity in intermediates(expression, without=named):
        rules[quantity] = quantity.definition.xreplace(dict(rules))
    return without_abs(expression.xreplace(rules)) if rules else expression


@lru_cache(maxsize=4)
def parts(*expressions: Basic) -> Mapping[Any, None]:
    """Return all distinct subexpressions, beginning with the expressions themselves, and definitions of quantities."""
    result = dict.fromkeys(expressions)
    waiting = list(expressions)
    while waiting:
        new = [argument for argument in waiting.pop().args if argument not in result]
        result.update(dict.fromkeys(new))
        waiting += new
    return result


def without_abs(expression: Expr) -> Expr:
    """Write ``Abs(u)``, which SymPy makes of even roots of powers of u, by the sign of u.

    >>> x = Symbol("x", real=True)
    >>> without_abs(abs(x))
    x*(2*unit_step(x) - 1)
    """
    return expression.replace(Abs, absolute) if expression.has(Abs) else expression


def written_size(expression: Expr) -> int:
    """Return the number of nodes of an expression with all intermediate quantities written out."""
    sizes: dict[Expr, int] = {}

    def size(node: Expr) -> int:
        return sizes.get(node) or 1 + sum(map(size, node.args))

    for quantity in intermediates(expression):
        written = quantity.arguments or quantity.args
        sizes[quantity] = sum(map(size, written))
    return size(expression)


def inner_of(*expressions: Expr, without: Container[Any] = ()) -> tuple[Intermediate, ...]:
    """Return the quantities in expressions, without those in their definitions."""
    return _contents(expressions, without=without)[0]


def intermediates(*expressions: Expr, without: Container[Any] = ()) -> list[Intermediate]:
    """Return all quantities in expressions and in their definitions, each after those that it depends on.

    Parts of ``without`` are left out, and so are quantities that occur in these alone.
    """
    seen: set[Intermediate] = set()
    pending = [*inner_of(*expressions, without=without)]
    while pending:
        node = pending.pop()
        if node not in seen and node not in without:
            seen.add(node)
            pending += node.inner
    return sorted(seen, key=lambda quantity: quantity.number)
