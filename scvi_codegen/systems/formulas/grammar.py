"""Parser for formulas: a small whitelist grammar, without ``eval`` or ``sympify``.

    sum      = product (("+" | "-") product)*
    product  = signed (("*" | "/") signed)*
    signed   = ("+" | "-")* power
    power    = atom ["**" ("+" | "-")* atom]
    atom     = number | name | function "(" argument ("," sum)* ")" | "(" sum ")"
    argument = sum | sum ("<" | "<=" | ">" | ">=") sum                     the second one of where(condition, a, b)

Precedences are Python's. Python's ``ast`` is not used because it fails for sums of some three thousand terms (long
lattices have more), counts columns in bytes, and loses the digits of decimals and the brackets in towers of powers.
Every number is exact (``0.1`` is 1/10), every node is built by a SymPy constructor, and sizes are checked *before* a
constructor could fold a constant that fills the memory.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Container, Iterable, Mapping
from typing import Any, ClassVar, NamedTuple, NoReturn

from sympy import Add, Expr, Mul, Pow, Rational, S, Symbol

from scvi_codegen.common.errors import ExpressionError, SystemDefinitionError, closest
from scvi_codegen.systems.formulas.expressions import (
    ARGUMENTS,
    CONSTANTS,
    FUNCTIONS,
    KINKED,
    MAX_BITS,
    MAX_DIGITS,
    NODES,
    REWRITTEN,
    REWRITTEN_CONSTANTS,
    WRITTEN_OTHERWISE,
    beyond_double,
    bits,
    evaluated,
    exponent_problem,
    unsupported_part,
)
from scvi_codegen.systems.formulas.intermediates import without_abs
from scvi_codegen.systems.formulas.kinks import comparison
from scvi_codegen.systems.formulas.symbols import DOT, check_name
from scvi_codegen.systems.formulas.table import Table
from scvi_codegen.systems.formulas.tables import NamedTable

MAX_CHARACTERS = 1_000_000
"""Length limit; parsing time grows with length times bracket depth (fifty atoms in a gas: 212 000 characters)."""
MAX_DEPTH, MAX_KINK_DEPTH = 100, 8
"""Limits of the depth of brackets, and of functions that contain their arguments two to four times."""
REPEATING = frozenset([*KINKED, "positive_part", "wrap"])

_TOKEN = re.compile(
    r"(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|(?P<name>[A-Za-z_]\w*)|(?P<operator>\*\*|[<>]=?|[-+*/(),])",
    re.ASCII,
)

_SPACE = re.compile(r"[ \t\r\n\f]*")

_HINTS = {
    ".": "attributes are not part of the grammar: write cos(q), not np.cos(q)",
    "[": 'subscripts require arrays: declare coordinates=["q[3]"], or parameters={"m[2]": [1.0, 2.0]}, whose entries '
    "m[0] and m[1] systems of named coordinates may use, too (of a rotation: R_11)",
    "^": "powers are written x**2",
    "=": "write the right-hand side only; equalities, assignments and keyword arguments are not part of the grammar",
    "'": "write the velocity of q as q_dot; strings are not part of the grammar",
    '"': "strings are not part of the grammar",
    "|": "write abs(x)",
    "\\": "LaTeX is not part of the grammar: write names and functions, as theta and sin(theta)",
    "−": "write a minus sign as -",
    "·": "write * for a product",
    "×": "write * for a product",
    "²": "powers are written x**2",
    "#": "comments are not part of the grammar",
    "%": "the remainder % is not part of the grammar",
    "{": "sets are not part of the grammar",
    ":": "lambda, slices and dictionaries are not part of the grammar",
}


_CONSTANTS_ELSEWHERE = {"E": "exp(1)", "Pi": "pi", "PI": "pi", "M_PI": "pi"}
_VALUES_ELSEWHERE = {"EulerGamma": 0.5772156649015329, "Catalan": 0.915965594177219}
"""Constants of SymPy, C and NumPy that are written otherwise here, or are parameters."""


def declaration_of(name: str) -> str:
    """Return how to declare an unknown name; of a multiplier, which is no number, what to write in its place."""
    if re.fullmatch(r"lambda_\d+", name):
        return (
            "multipliers are names of events alone, of systems with constraints. Friction by the force of a constraint "
            "g = 0 is that of two contacts in its place, contact(g, slip=.., friction=..) and contact(-g, ..) with the "
            "same slip and friction: its limit is friction times the constraint force"
        )
    constant = _VALUES_ELSEWHERE.get(name, 1.0)
    in_file = f"in files [parameters] {name} = {constant}"
    return f"declare a constant as a parameter: parameters={{'{name}': {constant}}}, {in_file}"


class Token(NamedTuple):
    """Token of a formula: a number, a name, an operator or the end."""

    kind: str
    text: str
    column: int


def parse_expression(text: str | Expr, symbols: Mapping[Any, Expr]) -> Expr:
    """Parse one formula.

    Args:
        text: the formula; line breaks count as spaces. Also a SymPy expression, whose constructors are evaluated.
        symbols: the names it may use, in addition to ``pi`` and the names of ``FUNCTIONS``; of a SymPy expression the
            parts that are replaced.

    Returns:
        The SymPy expression, free of floating-point numbers.

    Raises:
        ExpressionError: for anything outside the grammar, with its column.

    >>> x = Symbol("x", real=True)
    >>> parse_expression("0.5*x**2 - cos(2*x)/3", {"x": x})
    x**2/2 - cos(2*x)/3
    """
    return evaluated(text, symbols) if isinstance(text, Expr) else parsed(Parser(text, symbols))


def named_tables(functions: Iterable[tuple[str, Table]], names: Container[str] = ()) -> dict[str, NamedTable]:
    """Return functions by name, for formulas; SystemDefinitionError for an invalid name, and for one of ``names``."""
    tables = {}
    for name, table in functions:
        check_name(name)
        if name in names:
            raise SystemDefinitionError(f"'{name}' is the name of both a function and another quantity: rename one")
        tables[name] = NamedTable(name, table)
    return tables


def parsed(parser: Parser) -> Expr:
    """Run a parser; any failure of SymPy becomes an :class:`ExpressionError`."""
    text = parser.text
    try:
        return parser.parse()
    except ExpressionError:
        raise
    except RecursionError:
        message = "the formula is nested too deeply: name a part of it, or write it as a sum"
        raise ExpressionError(message, text, parser.column) from None
    except (ArithmeticError, AttributeError, TypeError, ValueError) as error:
        # SymPy's own failures, for instance in sqrt(1e-300 - 9) and asin(sin(1e300))
        message = "SymPy cannot evaluate the constants of this formula: make them parameters"
        raise ExpressionError(message, text, parser.column) from error


def sides_of(equation: str) -> list[str]:
    """Return the sides of ``left = right``, or the whole text without ``=``; ``<=`` and ``>=`` are comparisons."""
    return re.split(r"(?<![<>])=", equation)


def _is_zero(part: Expr) -> bool:
    """Return whether a constant is 0; formulas with symbols are not tested, which SymPy would do slowly."""
    return bool(part.is_number and part.is_zero)


def _spellings(name: str) -> tuple[str, ...]:
    """Return usual other spellings of a velocity; none for other names."""
    q = name.removesuffix(DOT)
    return () if q == name else (f"v_{q}", f"v{q}", f"{q}dot", f"d{q}", f"d{q}_dt", f"{q}_d", f"{q}_t", f"dot_{q}")


def _tokens(text: str, pattern: re.Pattern[str]) -> list[Token]:
    """Return the tokens of a text, an end token last."""
    if len(text) > MAX_CHARACTERS:
        message = f"a formula of {len(text)} characters is too long: the limit is {MAX_CHARACTERS}"
        raise ExpressionError(message, text, 0)
    tokens, position = [], _SPACE.match(text).end()  # type: ignore[union-attr]  # the pattern matches nothing, too
    while position < len(text):
        match = pattern.match(text, position)
        if match is None:
            character = text[position]
            hint = _HINTS.get(character, "names are made of the letters a-z, A-Z, digits and underscores")
            raise ExpressionError(f"unexpected character {character!r}: {hint}", text, position)
        tokens.append(Token(str(match.lastgroup), match.group(), position))
        position = _SPACE.match(text, match.end()).end()  # type: ignore[union-attr]  # as above
    tokens.append(Token("end", "", len(text.rstrip())))
    return tokens


class Parser:
    """Recursive-descent parser; sums and products of any length are loops, only brackets recurse.

    A grammar with further kinds of atoms is a subclass with its own ``pattern`` of tokens and :meth:`name`.
    """

    pattern: ClassVar[re.Pattern[str]] = _TOKEN

    def __init__(self, text: str, symbols: Mapping[str, Symbol]) -> None:
        if not isinstance(text, str):
            raise SystemDefinitionError(f"a formula must be text, not {text!r:.60}: write it between quotes")
        self.text, self.symbols = text, symbols
        self.tokens = _tokens(text, self.pattern)
        self.position = self.depth = self.kink_depth = 0

    @property
    def column(self) -> int:
        """Column of the next token."""
        return self.tokens[self.position].column

    def parse(self) -> Expr:
        """Parse the whole text."""
        result = self.sum()
        if self.tokens[self.position].kind != "end":
            self.refuse_leftover()
        result = evaluated(result)
        problem = unsupported_part(result)
        if problem:
            self.refuse(problem, 0)
        return result

    def refuse(self, message: str, column: int) -> NoReturn:
        """Raise an :class:`ExpressionError` at a column."""
        raise ExpressionError(message, self.text, column)

    def refuse_leftover(self) -> NoReturn:
        """Raise an :class:`ExpressionError` at a token that fits nowhere."""
        kind, text, column = self.tokens[self.position]
        if kind == "operator" and text == "**":
            self.refuse("a tower of powers is ambiguous: write (x**y)**z or x**(y**z)", column)
        if kind == "operator" and text in "),":
            self.refuse(f"unexpected '{text}': there is nothing for it to close or separate", column)
        if kind == "end":
            self.refuse("the formula ends inside brackets: a ')' is missing", column)
        if kind == "operator" and text[0] in "<>":
            self.refuse("a comparison must be the first argument of where, as in where(x > 0, a, b)", column)
        remedy = "only the functions of the grammar can be called" if text == "(" else "write * for a product"
        self.refuse(f"an operator is missing before '{text}': {remedy}", column)

    def accept(self, *operators: str) -> Token | None:
        """Return and consume the next token if it is one of these operators, else ``None``."""
        token = self.tokens[self.position]
        if token.kind != "operator" or token.text not in operators:
            return None
        self.position += 1
        return token

    def close(self) -> None:
        """Consume a closing bracket."""
        if self.accept(")") is None:
            self.refuse_leftover()
        self.depth -= 1

    def open(self, column: int) -> None:
        """Increase the bracket depth."""
        self.depth += 1
        if self.depth > MAX_DEPTH:
            self.refuse(f"brackets are nested deeper than {MAX_DEPTH}", column)

    def sum(self) -> Expr:
        """Parse ``product (("+" | "-") product)*``."""
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
        """Return the number; raise an error if it is too long."""
        if bits(number) > MAX_BITS:
            self.refuse(f"a constant exceeds {MAX_BITS} bits here, more than any C double can represent", column)
        return number

    def product(self, *, negative: bool) -> Expr:
        """Parse ``signed (("*" | "/") signed)*``."""
        column, coefficient, factors = self.column, S.NegativeOne if negative else S.One, []
        inverse = False
        while True:
            factor_column = self.column
            sign, factor = self.signed()
            if inverse and _is_zero(factor):
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
        """Parse signs and return their product."""
        sign = S.One
        while token := self.accept("+", "-"):
            sign = -sign if token.text == "-" else sign
        return sign

    def signed(self) -> tuple[Expr, Expr]:
        """Parse a signed power and return sign and power."""
        return self.sign(), self.power()

    def power(self) -> Expr:
        """Parse ``atom ["**" exponent]``."""
        column, base = self.column, self.atom()
        operator = self.accept("**")
        if operator is None:
            return base
        exponent_column = self.column
        exponent = self.sign() * self.atom()
        problem = exponent_problem(exponent)
        if problem:
            self.refuse(problem, exponent_column)
        if _is_zero(base) and not exponent.is_positive:
            self.refuse("division by zero: 0 to a power that is not positive", operator.column)
        if exponent.is_Rational and bits(base.as_coeff_Mul(rational=True)[0]) * abs(exponent) > MAX_BITS:
            self.refuse(f"a constant exceeds {MAX_BITS} bits here, more than any C double can represent", column)
        return self.supported(Pow(base, exponent), operator.column)

    def supported(self, result: Expr, column: int) -> Expr:
        """Return the result, without SymPy's Abs; raise an error if it is invalid: sqrt(-1), exp(10**9)."""
        result = without_abs(result)
        if result.is_number or (result.args and result.func not in NODES) or result.is_Pow:
            problem = unsupported_part(result)
            if problem:
                self.refuse(problem, column)
        return result

    def atom(self) -> Expr:
        """Parse a number, a name, a call or a bracket."""
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
        """Return the exact value of a number."""
        following = self.tokens[self.position]
        if following.kind == "name" and following.text in ("j", "J") and following.column == column + len(text):
            self.refuse("complex numbers are not part of the grammar", column)
        mantissa, _, exponent = text.lower().partition("e")
        whole = text.isdigit()  # an integer, perhaps the numerator of a fraction, may be longer
        if len(mantissa) > (MAX_DIGITS if whole else 320) or len(exponent) > 8 or abs(int(exponent or 0)) > 640:
            self.refuse("this number has too many digits: the largest C double is 1.8e308", column)
        value = Rational(text)
        if not whole and beyond_double(value):
            self.refuse("this number exceeds the range of a C double", column)
        return self.bounded(value, column)

    def name(self, name: str, column: int) -> Expr:
        """Return the symbol, constant or function call of a name."""
        function = self.symbols.get(name) or FUNCTIONS.get(name) or REWRITTEN.get(name)
        if callable(function):
            return self.call(name, function, column)
        if self.tokens[self.position][:2] == ("operator", "("):
            if name in KINKED:
                self.refuse(f"'{name}' is a name of this system, not the function {name}(..): rename it", column)
            written = WRITTEN_OTHERWISE.get(name)
            hint = f": write {written}." if written else closest(name, [*FUNCTIONS, *REWRITTEN])
            names = f"{hint} Known: {', '.join([*FUNCTIONS, *REWRITTEN])}"
            self.refuse(f"'{name}' is not a function of the grammar{names}", column)
        value = self.symbols.get(name, CONSTANTS.get(name, REWRITTEN_CONSTANTS.get(name)))
        if value is None:
            names = ", ".join([*self.symbols, *CONSTANTS])
            spelled = {other: symbol for symbol in self.symbols for other in _spellings(symbol)} | _CONSTANTS_ELSEWHERE
            hint = f"; did you mean '{spelled[name]}'?" if name in spelled else closest(name, self.symbols)
            self.refuse(f"unknown name '{name}'{hint} Known here: {names}; {declaration_of(name)}", column)
        return value

    def call(self, name: str, function: Callable[..., Expr], column: int) -> Expr:
        """Parse a call of a function."""
        opening = self.accept("(")
        if opening is None:
            self.refuse(f"'{name}' is a function: write {name}(...)", column)
        self.open(opening.column)
        self.kink_depth += name in REPEATING
        if self.kink_depth > MAX_KINK_DEPTH:
            self.refuse(f"abs, max and the like are nested too deeply: at most {MAX_KINK_DEPTH} in another", column)
        arguments = [self.condition() if function is FUNCTIONS["where"] else self.sum()]
        while self.accept(","):
            arguments.append(self.sum())
        self.close()
        self.kink_depth -= name in REPEATING
        expected, more = ARGUMENTS.get(name, 1), " or more" if name in ("min", "max") else ""
        if isinstance(function, NamedTable):
            expected, more = len(function.table.axes), ""
        if len(arguments) != expected and not (more and len(arguments) > expected):
            plural = "s" if expected > 1 else ""
            self.refuse(f"{name} takes {expected}{more} argument{plural}, not {len(arguments)}", column)
        return self.supported(function(*arguments), column)

    def condition(self) -> Expr:
        """Parse the condition of ``where``, and return 1 where it holds, 0 elsewhere."""
        left, column = self.sum(), self.column
        relation = self.accept("<", "<=", ">", ">=")
        if relation is None:
            self.refuse("where needs a comparison first, by <, <=, > or >=, as in where(x > 0, a, b)", column)
        return comparison(left, relation.text, self.sum())
