"""Formulas as text: a small whitelist grammar in both directions, never ``eval``, never ``sympify``.

    sum      = product (("+" | "-") product)*
    product  = signed (("*" | "/") signed)*
    signed   = ("+" | "-")* power
    power    = atom ["**" ("+" | "-")* atom]
    atom     = number | name | function "(" sum ("," sum)* ")" | "(" sum ")"

Precedences are Python's. A parser of its own, rather than Python's ``ast``, because ``ast`` gives up at a sum of some
three thousand terms (a long lattice has more), counts columns in bytes, and forgets the digits of a decimal and the
brackets of a tower of powers. Every number is exact (``0.1`` is 1/10), every node is built by a SymPy constructor, and
sizes are checked *before* a constructor could fold a constant that fills the memory.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple, NoReturn

import sympy
from sympy import Add, Expr, Integer, Mul, Pow, Rational, S, Symbol
from sympy.core.function import AppliedUndef

from scvi_codegen.errors import ExpressionError, SystemDefinitionError
from scvi_codegen.tables.precision import Number, mp

__all__ = ["FUNCTIONS", "closest", "evaluate", "evaluated", "format_expression", "parse_expression", "unsupported_part"]

MAX_CHARACTERS = 100_000
MAX_DEPTH = 100
MAX_EXPONENT = 64
MAX_EXPONENT_DENOMINATOR = 10_000
MAX_BITS = 2048
MAX_DIGITS = 616
"""Of a whole number of so many bits."""
MAX_PASSES = 8
LARGEST = 1.7976931348623157e308

FUNCTIONS: Mapping[str, Callable[..., Expr]] = {
    function.__name__: function
    for function in (
        *(sympy.sin, sympy.cos, sympy.tan, sympy.asin, sympy.acos, sympy.atan, sympy.atan2),
        *(sympy.sinh, sympy.cosh, sympy.tanh, sympy.asinh, sympy.acosh, sympy.atanh),
        *(sympy.exp, sympy.log, sympy.sqrt),
    )
}
"""The functions of the grammar by name; all take one argument, ``atan2`` two."""

_NAME_OF = {function: name for name, function in FUNCTIONS.items() if isinstance(function, type)}
_CONSTANTS = {"pi": S.Pi}

_TOKEN = re.compile(
    r"(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<name>[A-Za-z_]\w*)|(?P<operator>\*\*|[-+*/(),])", re.ASCII
)
_SPACE = re.compile(r"[ \t\r\n\f]*")

_HINTS = {
    ".": "attribute access is not part of the grammar",
    "[": "subscripts and lists are not part of the grammar",
    "^": "powers are written x**2",
    "=": "comparisons, assignments and keyword arguments are not part of the grammar",
    "<": "comparisons are not part of the grammar",
    ">": "comparisons are not part of the grammar",
    "'": "strings are not part of the grammar",
    '"': "strings are not part of the grammar",
    "#": "comments are not part of the grammar",
    "%": "there is no remainder in the grammar",
    "{": "sets are not part of the grammar",
    ":": "lambda, slices and dictionaries are not part of the grammar",
}


class _Token(NamedTuple):
    kind: str
    text: str
    column: int


def closest(name: str, known: Iterable[str]) -> str:
    """``"; did you mean 'x'?"`` for the known name nearest to ``name``, or a full stop."""
    matches = difflib.get_close_matches(name, list(known), n=1)
    return f"; did you mean '{matches[0]}'?" if matches else "."


def parse_expression(text: str, symbols: Mapping[str, Symbol]) -> Expr:
    """Read one formula.

    Args:
        text: the formula; line breaks count as spaces.
        symbols: the names it may use. ``pi`` and the names of ``FUNCTIONS`` are known besides.

    Returns:
        The SymPy expression, free of floating-point numbers.

    Raises:
        ExpressionError: for anything outside the grammar, with the column of the offence.

    >>> x = Symbol("x", real=True)
    >>> parse_expression("0.5*x**2 - cos(2*x)/3", {"x": x})
    x**2/2 - cos(2*x)/3
    """
    if len(text) > MAX_CHARACTERS:
        raise ExpressionError(
            f"a formula of {len(text)} characters is too long: the limit is {MAX_CHARACTERS}", text, 0
        )
    parser = _Parser(text, symbols)
    try:
        return parser.parse()
    except ExpressionError:
        raise
    except RecursionError:
        message = "the formula is nested too deeply: name a part of it, or write it as a sum"
        raise ExpressionError(message, text, parser.column) from None
    except (ArithmeticError, AttributeError, TypeError, ValueError) as error:
        # SymPy's own failures, for instance in sqrt(1e-300 - 9) and asin(sin(1e300)).
        message = "SymPy cannot evaluate the constants of this formula: make them parameters"
        raise ExpressionError(message, text, parser.column) from error


def _tokens(text: str) -> list[_Token]:
    tokens, position = [], _SPACE.match(text).end()  # type: ignore[union-attr]  # the pattern matches nothing, too
    while position < len(text):
        match = _TOKEN.match(text, position)
        if match is None:
            character = text[position]
            hint = _HINTS.get(character, "names are made of the letters a-z, A-Z, digits and underscores")
            raise ExpressionError(f"unexpected character {character!r}: {hint}", text, position)
        tokens.append(_Token(str(match.lastgroup), match.group(), position))
        position = _SPACE.match(text, match.end()).end()  # type: ignore[union-attr]  # as above
    tokens.append(_Token("end", "", len(text.rstrip())))
    return tokens


class _Parser:
    """Recursive descent over the tokens; sums and products of any length are loops, only brackets recurse."""

    def __init__(self, text: str, symbols: Mapping[str, Symbol]) -> None:
        self.text, self.symbols = text, symbols
        self.tokens = _tokens(text)
        self.position = self.depth = 0

    @property
    def column(self) -> int:
        return self.tokens[self.position].column

    def parse(self) -> Expr:
        result = self.sum()
        if self.tokens[self.position].kind != "end":
            self.refuse_leftover()
        result = evaluated(result)
        problem = unsupported_part(result)
        if problem:
            self.refuse(problem, 0)
        return result

    def refuse(self, message: str, column: int) -> NoReturn:
        raise ExpressionError(message, self.text, column)

    def refuse_leftover(self) -> NoReturn:
        kind, text, column = self.tokens[self.position]
        if kind == "operator" and text == "**":
            self.refuse("a tower of powers is ambiguous: write (x**y)**z or x**(y**z)", column)
        if kind == "operator" and text in "),":
            self.refuse(f"unexpected '{text}': it closes or separates nothing", column)
        if kind == "end":
            self.refuse("the formula ends inside brackets: a ')' is missing", column)
        what = "only the functions of the grammar can be called" if text == "(" else "write * for a product"
        self.refuse(f"an operator is missing before '{text}': {what}", column)

    def accept(self, *operators: str) -> _Token | None:
        token = self.tokens[self.position]
        if token.kind != "operator" or token.text not in operators:
            return None
        self.position += 1
        return token

    def close(self) -> None:
        if self.accept(")") is None:
            self.refuse_leftover()
        self.depth -= 1

    def open(self, column: int) -> None:
        self.depth += 1
        if self.depth > MAX_DEPTH:
            self.refuse(f"brackets are nested deeper than {MAX_DEPTH}", column)

    def sum(self) -> Expr:
        column, terms = self.column, [self.product(negative=False)]
        while token := self.accept("+", "-"):
            terms.append(self.product(negative=token.text == "-"))
        return terms[0] if len(terms) == 1 else self.bounded_sum(terms, column)

    def bounded_sum(self, terms: list[Expr], column: int) -> Expr:
        """Collect like terms, watching the size of each coefficient, then build one ``Add``."""
        coefficients: dict[Expr, Expr] = {}
        for term in terms:
            for part in Add.make_args(term):
                coefficient, rest = part.as_coeff_Mul(rational=True)
                coefficients[rest] = self.bounded(coefficients.get(rest, S.Zero) + coefficient, column)
        return Add(*(Mul(coefficient, rest) for rest, coefficient in coefficients.items()))

    def bounded(self, number: Expr, column: int) -> Expr:
        if _bits(number) > MAX_BITS:
            self.refuse(f"a constant grows beyond {MAX_BITS} bits here, more than any C double can hold", column)
        return number

    def product(self, *, negative: bool) -> Expr:
        column, coefficient, factors = self.column, S.NegativeOne if negative else S.One, []
        inverse = False
        while True:
            factor_column = self.column
            sign, factor = self.signed()
            if inverse and factor.is_zero:
                self.refuse("division by zero", factor_column)
            factor = Pow(factor, -1) if inverse else factor
            number, rest = (factor, S.One) if factor.is_Rational else (S.One, factor)
            coefficient = self.bounded(coefficient * sign * number, factor_column)
            if rest is not S.One:
                factors.append(rest)
            token = self.accept("*", "/")
            if token is None:
                break
            inverse = token.text == "/"
        result = Mul(coefficient, *factors) if coefficient is not S.One or len(factors) != 1 else factors[0]
        self.bounded(result.as_coeff_Mul(rational=True)[0], column)
        return result

    def sign(self) -> Expr:
        sign = S.One
        while token := self.accept("+", "-"):
            sign = -sign if token.text == "-" else sign
        return sign

    def signed(self) -> tuple[Expr, Expr]:
        return self.sign(), self.power()

    def power(self) -> Expr:
        column, base = self.column, self.atom()
        operator = self.accept("**")
        if operator is None:
            return base
        exponent_column = self.column
        exponent = self.sign() * self.atom()
        problem = _exponent_problem(exponent)
        if problem:
            self.refuse(problem, exponent_column)
        if base.is_zero and not exponent.is_positive:
            self.refuse("division by zero: 0 to a power that is not positive", operator.column)
        if exponent.is_Rational and _bits(base.as_coeff_Mul(rational=True)[0]) * abs(exponent) > MAX_BITS:
            self.refuse(f"a constant grows beyond {MAX_BITS} bits here, more than any C double can hold", column)
        return self.supported(Pow(base, exponent), operator.column)

    def supported(self, result: Expr, column: int) -> Expr:
        """Refuse what a constructor made of legal arguments: sqrt(-1), log(0), exp(10**9), sqrt(x**2) = Abs(x)."""
        if not result.free_symbols or (result.args and result.func not in _NODES) or result.is_Pow:
            problem = unsupported_part(result)
            if problem:
                self.refuse(problem, column)
        return result

    def atom(self) -> Expr:
        kind, text, column = self.tokens[self.position]
        if kind == "end":
            self.refuse(
                "the formula ends where a value is expected" if self.position else "the formula is empty", column
            )
        if kind == "operator" and text != "(":
            self.refuse(f"a value is expected, not '{text}'", column)
        self.position += 1
        if kind == "number":
            return self.number(text, column)
        if kind == "name":
            return self.name(text, column)
        self.open(column)
        result = self.sum()
        self.close()
        return result

    def number(self, text: str, column: int) -> Expr:
        following = self.tokens[self.position]
        if following.kind == "name" and following.text in ("j", "J") and following.column == column + len(text):
            self.refuse("complex numbers are not part of the grammar", column)
        mantissa, _, exponent = text.lower().partition("e")
        whole = text.isdigit()  # perhaps half of a fraction, which may be longer
        if len(mantissa) > (MAX_DIGITS if whole else 320) or len(exponent) > 8 or abs(int(exponent or 0)) > 640:
            self.refuse("this number has too many digits: a C double ends at 1.8e308", column)
        value = Rational(text)
        if not whole and _beyond_double(value):
            self.refuse("this number lies outside the range of a C double", column)
        return self.bounded(value, column)

    def name(self, name: str, column: int) -> Expr:
        if name in FUNCTIONS:
            return self.call(name, column)
        if self.tokens[self.position][:2] == ("operator", "("):
            known = ", ".join(FUNCTIONS)
            self.refuse(f"'{name}' is not a function of the grammar{closest(name, FUNCTIONS)} Known: {known}", column)
        value = self.symbols.get(name, _CONSTANTS.get(name))
        if value is None:
            known = ", ".join([*self.symbols, *_CONSTANTS])
            self.refuse(f"unknown name '{name}'{closest(name, self.symbols)} Known here: {known}", column)
        return value

    def call(self, name: str, column: int) -> Expr:
        opening = self.accept("(")
        if opening is None:
            self.refuse(f"'{name}' is a function: write {name}(...)", column)
        self.open(opening.column)
        arguments = [self.sum()]
        while self.accept(","):
            arguments.append(self.sum())
        self.close()
        expected = 2 if name == "atan2" else 1
        if len(arguments) != expected:
            self.refuse(f"{name} takes {expected} argument{'s'[: expected - 1]}, not {len(arguments)}", column)
        return self.supported(FUNCTIONS[name](*arguments), column)


def _bits(number: Expr) -> int:
    """Size of a rational, in bits of its larger half; 0 for anything else."""
    return max(int(number.p).bit_length(), int(number.q).bit_length()) if number.is_Rational else 0


def _beyond_double(number: Expr) -> bool:
    """Whether a rational is an infinity as a C double, or 0 without being 0."""
    p, q = abs(int(number.p)), int(number.q)
    return p > int(LARGEST) * q or (p > 0 and p << 1075 <= q)


_NODES = frozenset([Add, Mul, Pow, *_NAME_OF])
_SMOOTHER = {
    "Abs": "the absolute value is not differentiable; sqrt(x**2) is one, too",
    "sign": "the sign is not differentiable",
    "Piecewise": "pieces are not differentiable where they meet",
    "Heaviside": "steps are not differentiable",
    "ImaginaryUnit": "a Lagrangian is real",
}


def unsupported_part(expression: Expr) -> str | None:
    """Say what keeps an expression out of the grammar, or ``None``: the rule of the parser, the printer and the system.

    Refused are other functions, floating-point numbers, non-finite or non-real constants, numbers of more than
    ``MAX_BITS`` bits and constant exponents beyond ``MAX_EXPONENT``.
    """
    pending, seen = [expression], set()
    while pending:
        node = pending.pop()
        if node in seen:
            continue
        seen.add(node)
        problem = _node_problem(node)
        if problem:
            return problem
        pending.extend(node.args)
    return _constant_problem(expression)


def _node_problem(node: Any) -> str | None:
    if not node.args:
        if node.is_Symbol or node in (S.Pi, S.Exp1):
            return None
        if node.is_Rational and _bits(node) > MAX_BITS:
            return f"a constant grows beyond {MAX_BITS} bits, more than any C double can hold"
        if node.is_Rational:
            return f"the constant {_shortened(node)} lies beyond any C double" if _beyond_double(node) else None
        if node in (S.NaN, S.ComplexInfinity, S.Infinity, S.NegativeInfinity):
            return f"a part of the formula is not finite ({node})"
    elif node.func in _NODES:
        return _exponent_problem(node.exp) if node.is_Pow else None
    kind = type(node).__name__
    reason = f": {_SMOOTHER[kind]}" if kind in _SMOOTHER else ""
    known = ", ".join([*FUNCTIONS, *_CONSTANTS])
    return f"{kind} ('{_shortened(node)}') is not supported{reason}. Use + - * / ** and {known}"


def _exponent_problem(exponent: Expr) -> str | None:
    """Bound the rational part of an exponent: SymPy takes 2**1000000000 out of 2**(x + 1000000000), digit by digit."""
    constant = exponent.as_coeff_Add(rational=True)[0]
    if abs(constant) <= MAX_EXPONENT and constant.q <= MAX_EXPONENT_DENOMINATOR:
        return None
    return (
        f"the constant in an exponent lies between -{MAX_EXPONENT} and {MAX_EXPONENT}, with a denominator of at most "
        f"{MAX_EXPONENT_DENOMINATOR}, not {_shortened(constant)}"
    )


def _shortened(node: Any) -> str:
    text = str(node)
    return text if len(text) <= 60 else text[:57] + "..."


def _constant_problem(expression: Expr) -> str | None:
    """Look at the largest parts without symbols: each must be a finite real number."""
    pending = [expression]
    while pending:
        node = pending.pop()
        if node.free_symbols:
            pending.extend(argument for argument in node.args if argument.args)
        elif node.args:
            try:
                evaluate(node, {})
            except ArithmeticError:
                return f"the constant '{_shortened(node)}' is not a finite real number"
    return None


def evaluated(expression: Expr, replacements: Mapping[Expr, Expr] | None = None) -> Expr:
    """Replace parts, make floating-point numbers rational and call every constructor anew until nothing changes.

    SymPy leaves some nodes as no constructor would build them (``evaluate=False``, but also ``-((1/2)**x - 1)``);
    after this, an expression is the one its text means. A float becomes the rational its shortest decimal form says.
    """
    rules = dict(replacements or {})
    for _ in range(MAX_PASSES):
        result = _rebuilt(expression, rules)
        if result == expression:
            break
        expression, rules = result, {}
    return expression


def _rebuilt(expression: Expr, known: dict[Expr, Expr]) -> Expr:
    if expression not in known:
        known[expression] = _rebuilt_node(expression, known)
    return known[expression]


def _rebuilt_node(expression: Expr, known: dict[Expr, Expr]) -> Expr:
    if expression.is_Float:
        value = float(expression)
        return Rational(repr(value) if expression == value else str(expression))
    if not expression.args or isinstance(expression, (sympy.Derivative, AppliedUndef)):
        return expression
    return expression.func(*(_rebuilt(argument, known) for argument in expression.args))


def evaluate(expression: Expr, values: Mapping[Symbol, Number], known: dict[Expr, Number] | None = None) -> Number:
    """Value of an expression of the grammar in the arithmetic of ``precision``, 60 digits.

    Args:
        expression: an expression ``unsupported_part`` has nothing against.
        values: a number for each of its symbols.
        known: values of parts computed before at the same point; filled on the way.

    Raises:
        ArithmeticError: if the value, or that of a part, is not real or not within the range of a C double.
    """
    known = {} if known is None else known
    if expression in known:
        return known[expression]
    try:
        result = _evaluate_node(expression, values, known)
    except (ValueError, TypeError) as error:
        raise ArithmeticError(f"'{_shortened(expression)}' has no real value") from error
    if not isinstance(result, mp.mpf) or not abs(result) <= LARGEST:
        raise ArithmeticError(f"'{_shortened(expression)}' is not a finite real number")
    known[expression] = result
    return result


def _evaluate_node(expression: Any, values: Mapping[Symbol, Number], known: dict[Expr, Number]) -> Number:
    if expression.is_Symbol:
        return mp.mpf(values[expression])
    if expression.is_Rational:
        return mp.mpf(int(expression.p)) / int(expression.q)
    if not expression.args:
        return {S.Pi: +mp.pi, S.Exp1: +mp.e}[expression]
    arguments = [evaluate(argument, values, known) for argument in expression.args]
    if expression.is_Add:
        return mp.fsum(arguments)
    if expression.is_Mul:
        return mp.fprod(arguments)
    return mp.power(*arguments) if expression.is_Pow else getattr(mp, _NAME_OF[expression.func])(*arguments)


def format_expression(expression: Expr) -> str:
    """Write an expression as text of this grammar, so that ``parse_expression`` gives it back, node by node.

    The expression is taken as SymPy's constructors leave it; one built with ``evaluate=False`` comes back evaluated.

    Raises:
        SystemDefinitionError: for a part the grammar does not have.

    >>> x, y = sympy.symbols("x y", real=True)
    >>> format_expression(sympy.sqrt(x) / (3 * y) - sympy.exp(-y))
    'sqrt(x)/(3*y) - exp(-y)'
    """
    problem = unsupported_part(expression)
    if problem:
        raise SystemDefinitionError(problem)
    return _sum_text(expression)


def _sum_text(expression: Expr) -> str:
    if not expression.is_Add:
        return _product_text(expression)
    first, *others = (_product_text(term) for term in expression.as_ordered_terms())
    return first + "".join(f" - {term[1:]}" if term.startswith("-") else f" + {term}" for term in others)


def _product_text(expression: Expr) -> str:
    coefficient, rest = expression.as_coeff_Mul(rational=True)
    factors = [] if rest is S.One else rest.as_ordered_factors() if rest.is_Mul else [rest]
    below = [factor for factor in factors if factor.is_Pow and factor.exp.is_Rational and factor.exp < 0]
    above = [_power_text(factor) for factor in factors if factor not in below]
    divisors = [_power_text(Pow(factor.base, -factor.exp)) for factor in below]
    if coefficient.q != 1:
        divisors.insert(0, str(coefficient.q))
    if abs(coefficient.p) != 1 or not above:
        above.insert(0, str(abs(coefficient.p)))
    text = ("-" if coefficient < 0 else "") + "*".join(above)
    if len(divisors) < 2:
        return text + "".join(f"/{divisor}" for divisor in divisors)
    # A rational alone with a sum in brackets would be multiplied out when read: divide by one after the other.
    return (
        f"{text}/{'/'.join(divisors)}"
        if any(factor.base.is_Add for factor in below)
        else f"{text}/({'*'.join(divisors)})"
    )


def _power_text(expression: Expr) -> str:
    if not expression.is_Pow:
        return _atom_text(expression)
    base, exponent = expression.as_base_exp() if expression.exp.is_Rational else expression.args
    if exponent == S.Half:
        return f"sqrt({_sum_text(base)})"
    return f"{_atom_text(base)}**{_atom_text(exponent)}"


def _atom_text(expression: Expr) -> str:
    if expression.is_Symbol:
        return str(expression.name)
    if expression is S.Exp1:
        return "exp(1)"
    if expression is S.Pi or (isinstance(expression, Integer) and expression >= 0):
        return str(expression)
    if expression.func in _NAME_OF:
        return f"{_NAME_OF[expression.func]}({', '.join(map(_sum_text, expression.args))})"
    return f"({_sum_text(expression)})"
