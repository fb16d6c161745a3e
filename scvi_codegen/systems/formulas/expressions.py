"""SymPy expressions: canonical form, check against the grammar, derivatives, evaluation in 60 digits.

Derivatives are computed by forward accumulation, in which each node carries only its own non-zero partial derivatives.
The Lagrangian of a lattice has a thousand terms and hundreds of variables, but each term depends on two or three.
Nothing is simplified; entries that SymPy's constructors evaluate to 0 are omitted. Every distinct node is
differentiated once, with respect to all variables, which is much faster than ``Expr.diff``, term by term.

Values are computed by straight-line programs that evaluate each subexpression once.
"""

from __future__ import annotations

import math
import operator
import random
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import lru_cache
from itertools import islice
from typing import Any

import numpy as np
import sympy
from sympy import Add, Expr, Function, Mul, Pow, Rational, S, Symbol, log
from sympy.core.function import AppliedUndef

from scvi_codegen.common.errors import SystemDefinitionError
from scvi_codegen.common.precision import Number, mp
from scvi_codegen.systems.formulas.adjoints import Elimination, Gradient, gradient_by_adjoints
from scvi_codegen.systems.formulas.intermediates import (
    Intermediate,
    intermediate,
    intermediates,
    parts,
    product,
    total,
    without_abs,
)
from scvi_codegen.systems.formulas.kinks import (
    OF_SYMPY,
    absolute,
    maximum,
    minimum,
    positive_part,
    rint,
    sign,
    switching_function,
    unit_step,
    where,
    wrap,
)

LARGEST = sys.float_info.max
"""Largest finite C double."""


def kinks_of(expressions: Iterable[Expr]) -> set[Expr]:
    """Return functions at whose zeros expressions may jump or have a kink: u of unit_step(u), cos(pi x) of rint(x).

    Arguments that differ by sign or a positive number are one function u.
    """
    formulas = {f for e in expressions for f in (e, *(quantity.definition for quantity in intermediates(e)))}
    nodes = parts(*formulas)
    ends = {part.base for part in nodes if part.is_Pow and part.exp == -1}  # 1/unit_step(u): undefined where u < 0
    jumps = {part for part in nodes if isinstance(part, unit_step | rint) and part not in ends}
    return {
        switching_function(jump.args[0])[0] if isinstance(jump, unit_step) else sympy.cos(sympy.pi * jump.args[0])
        for jump in jumps
    }


RESERVED: Mapping[str, Callable[..., Expr]] = {
    function.__name__: function
    for function in (
        *(sympy.sin, sympy.cos, sympy.tan, sympy.asin, sympy.acos, sympy.atan, sympy.atan2),
        *(sympy.sinh, sympy.cosh, sympy.tanh, sympy.asinh, sympy.acosh, sympy.atanh),
        *(sympy.exp, sympy.log, sympy.sqrt),
        *(rint, unit_step, wrap, positive_part),
    )
}
"""Functions of the grammar by name, without those that may be names of coordinates, parameters and arrays."""
KINKED: Mapping[str, Callable[..., Expr]] = {
    "abs": absolute,
    "sign": sign,
    "min": minimum,
    "max": maximum,
    "where": where,
}
"""Further functions; a coordinate, parameter or array of one of these names replaces it."""
FUNCTIONS = {**RESERVED, **KINKED}
REWRITTEN: Mapping[str, Callable[..., Expr]] = {
    "sec": lambda x: 1 / sympy.cos(x),
    "csc": lambda x: 1 / sympy.sin(x),
    "cot": lambda x: sympy.cos(x) / sympy.sin(x),
    "sech": lambda x: 1 / sympy.cosh(x),
    "csch": lambda x: 1 / sympy.sinh(x),
    "coth": lambda x: 1 / sympy.tanh(x),
    "asec": lambda x: sympy.acos(1 / x),
    "acsc": lambda x: sympy.asin(1 / x),
    "acot": lambda x: sympy.pi / 2 * sign(x) - sympy.atan(x),
    "asech": lambda x: sympy.acosh(1 / x),
    "acsch": lambda x: sympy.asinh(1 / x),
    "acoth": lambda x: sympy.atanh(1 / x),
}
"""Functions that are written by others at once, as SymPy defines them: acot is odd and jumps at 0, where it is pi/2.

A coordinate, parameter or array of one of these names replaces it.
"""
REWRITTEN_CONSTANTS = {"GoldenRatio": (1 + sympy.sqrt(5)) / 2}
"""Constants that are written by others at once."""
WRITTEN_OTHERWISE = {
    **dict.fromkeys(("Abs", "fabs"), "abs(x)"),
    **dict.fromkeys(("Max", "fmax"), "max(x, y)"),
    **dict.fromkeys(("Min", "fmin"), "min(x, y)"),
    **dict.fromkeys(("Heaviside", "heaviside"), "unit_step(x)"),
    "sgn": "sign(x)",
    "Piecewise": "where(x > 0, a, b)",
    "clip": "min(max(x, a), b)",
    "ln": "log(x)",
    "log10": "log(x)/log(10)",
    "log2": "log(x)/log(2)",
    "log1p": "log(1 + x)",
    "exp2": "2**x",
    "expm1": "exp(x) - 1",
    "pow": "x**y",
    "square": "x**2",
    "hypot": "sqrt(x**2 + y**2)",
    "cbrt": "x**(1/3), for x < 0 -(-x)**(1/3)",
    "root": "x**(1/n)",
    **{f"arc{name}": f"a{name}(x)" for name in ("sin", "cos", "tan", "sinh", "cosh", "tanh")},
    "arctan2": "atan2(y, x)",
    "tg": "tan(x)",
    "ctg": "cot(x)",
    "sinc": "sin(x)/x",
    "round": "rint(x), the nearest whole number",
    "floor": "rint(x - 1/2)",
    **dict.fromkeys(("ceil", "ceiling"), "rint(x + 1/2)"),
    "trunc": "where(x > 0, rint(x - 1/2), rint(x + 1/2))",
    **dict.fromkeys(("mod", "Mod"), "x - y*rint(x/y - 1/2)"),
    "fmod": "where(x > 0, x - y*rint(x/y - 1/2), x - y*rint(x/y + 1/2))",
    **dict.fromkeys(
        ("erf", "erfc", "gamma", "besselj", "lambertw", "LambertW", "zeta"), "a table: functions={'f': sc.Table(x, y)}"
    ),
}
"""What stands for functions of SymPy, C and NumPy that have another name here, or none."""
ARGUMENTS = {"atan2": 2, "wrap": 2, "min": 2, "max": 2, "where": 3}
"""Numbers of arguments of functions with more than one; min and max take any more, too."""
PIECEWISE_CONSTANT: Mapping[str, tuple[Callable[[Number], Number], Callable[..., Any]]] = {
    "rint": (mp.nint, np.rint),
    "unit_step": (lambda x: mp.mpf(x >= 0), lambda x: np.heaviside(x, 1.0)),
}
"""Piecewise constant functions of mpmath and NumPy."""

NAME_OF = {function: name for name, function in FUNCTIONS.items() if isinstance(function, type)}
CONSTANTS = {"pi": S.Pi}


def shortened(node: Any) -> str:
    """Return the text of an expression, cut to 60 characters."""
    text = str(node)
    return text if len(text) <= 60 else text[:57] + "..."


def parts_of_type(kind: type, *expressions: sympy.Basic) -> set[Any]:
    """Return the distinct subexpressions of a class."""
    return {part for part in parts(*expressions) if isinstance(part, kind)}


CONSTANT_VALUES = {sympy.S.Pi: mp.pi, sympy.S.Exp1: mp.e}


class Tape:
    """Straight-line program of several expressions of the grammar, in the same symbols."""

    def __init__(self, expressions: Sequence[sympy.Expr], symbols: Sequence[sympy.Symbol]) -> None:
        self.symbols = tuple(symbols)
        self._start: list[Number] = [mp.zero] * len(symbols)
        self._places: dict[sympy.Expr, int] = {symbol: register for register, symbol in enumerate(symbols)}
        self._steps: list[tuple[int, Callable[..., Number], tuple[int, ...]]] = []
        for quantity in intermediates(*expressions):
            self._place(quantity)
        self._results = [self._place(expression) for expression in expressions]

    def __call__(self, numbers: Sequence[Number]) -> list[Number]:
        """Return the values at a point; ArithmeticError if one is not real or not within the range of a C double."""
        values = [*numbers, *self._start[len(numbers) :]]
        try:
            for register, operation, operands in self._steps:
                values[register] = operation(*[values[operand] for operand in operands])
        except (ValueError, TypeError, AttributeError) as error:
            raise ArithmeticError(f"no real value: {error}") from error
        results = [values[register] for register in self._results]
        if not all(isinstance(value, mp.mpf) and abs(value) <= LARGEST for value in results):
            raise ArithmeticError("a value is not a finite real number: the state is outside the domain of the formula")
        return results

    @classmethod
    def samples(cls, expressions: Sequence[Expr]) -> Iterator[list[Number]]:
        """Yield values in 60 digits at reproducible random points of order 1, without those where one is undefined.

        Raises:
            SystemDefinitionError: for what is outside the grammar.
        """
        if problem := next(filter(None, map(unsupported_part, expressions)), None):
            raise SystemDefinitionError(problem)
        symbols = sorted(set().union(*(expression.free_symbols for expression in expressions)), key=str)
        tape, generator = cls(expressions, symbols), random.Random(20250101)
        for _ in range(ATTEMPTS):
            with suppress(ArithmeticError):
                yield tape([mp.mpf(generator.uniform(0.3, 1.3)) for _ in symbols])

    @staticmethod
    def cancels(terms: Sequence[Expr]) -> bool:
        """Return whether the sum of terms is zero at random points; false where it is undefined."""
        return sums_to_zero(terms)

    def _place(self, expression: sympy.Expr) -> int:
        """Return the index of an expression's value, appending the operations that compute it."""
        if expression in self._places:
            return self._places[expression]
        if expression.args:
            operands = tuple(self._place(argument) for argument in expression.args)
            operation, operands = _operation(expression, operands)
            self._steps.append((len(self._start), operation, operands))
            self._start.append(mp.zero)
        else:
            constant = CONSTANT_VALUES.get(expression)
            self._start.append(mp.mpf(int(expression.p)) / int(expression.q) if constant is None else mp.mpf(constant))
        self._places[expression] = len(self._start) - 1
        return self._places[expression]


def _operation(expression: sympy.Expr, operands: tuple[int, ...]) -> tuple[Callable[..., Number], tuple[int, ...]]:
    """Return the function of mpmath for a node, and the registers of its operands."""
    if expression.is_Add:
        return (operator.add if len(operands) == 2 else lambda *terms: mp.fsum(terms)), operands
    if expression.is_Mul:
        return (operator.mul if len(operands) == 2 else lambda *factors: mp.fprod(factors)), operands
    if isinstance(expression, Intermediate):
        return operator.pos, operands
    if not expression.is_Pow:
        name = NAME_OF[expression.func]
        return PIECEWISE_CONSTANT[name][0] if name in PIECEWISE_CONSTANT else getattr(mp, name), operands
    exponent = expression.exp
    if exponent.is_Integer:
        power = int(exponent)
        return (lambda x: x**power), operands[:1]
    return mp.power, operands


def evaluate(expression: sympy.Expr, values: Mapping[sympy.Symbol, Number]) -> Number:
    """Return the value of an expression at a point, in 60 digits; ArithmeticError if not real, or beyond C doubles."""
    try:
        return Tape(list(parts(expression)), list(values))(list(map(mp.mpf, values.values())))[0]
    except ArithmeticError as error:
        raise ArithmeticError(f"'{shortened(expression)}' is not a finite real number") from error


ATTEMPTS, SAMPLES = 24, 4
"""Numbers of random points at which formulas are evaluated at most, and at which an identity must hold."""
NEGLIGIBLE = mp.mpf(10) ** -40
"""Largest sum that counts as 0, relative to the sum of the absolute values of its terms."""


def cancel(terms: Sequence[Number]) -> bool:
    """Return whether the sum of numbers is 0 to 40 digits, relative to their sizes or to 1."""
    return bool(abs(mp.fsum(terms)) <= NEGLIGIBLE * (1 + mp.fsum(map(abs, terms))))


def sums_to_zero(terms: Sequence[Expr]) -> bool:
    """Return whether the sum of terms is zero at ``SAMPLES`` random points; false where it is undefined."""
    values = list(islice(Tape.samples(terms), SAMPLES)) if Add(*terms) != 0 else [[mp.zero]] * SAMPLES
    zeros = (abs(mp.fsum(parts)) <= NEGLIGIBLE * mp.fsum(map(abs, parts)) for parts in values)
    return len(values) == SAMPLES and all(zeros)


MAX_EXPONENT = 64
MAX_EXPONENT_DENOMINATOR = 10_000
MAX_BITS = 2048
MAX_DIGITS = int(MAX_BITS * math.log10(2.0))
"""Maximum number of decimal digits of an integer of ``MAX_BITS`` bits."""
MAX_PASSES = 8


def bits(number: Expr) -> int:
    """Return the size of a rational, the bits of its numerator or denominator; 0 for other expressions."""
    return max(int(number.p).bit_length(), int(number.q).bit_length()) if number.is_Rational else 0


def beyond_double(number: Expr) -> bool:
    """Return whether a rational overflows as a C double, or underflows to 0."""
    p, q = abs(int(number.p)), int(number.q)
    return p > int(LARGEST) * q or (p > 0 and p << 1075 <= q)


NODES = frozenset([Add, Mul, Pow, Intermediate, *NAME_OF])


def unsupported_part(expression: Expr) -> str | None:
    """Return why an expression is outside the grammar, or ``None``; shared by parser, printer and systems.

    Rejected are other functions, floating-point numbers, non-finite or non-real constants, numbers of more than
    ``MAX_BITS`` bits and constant exponents beyond ``MAX_EXPONENT``.
    """
    return next(filter(None, map(_node_problem, parts(expression))), None) or _constant_problem(expression)


def _node_problem(node: Any) -> str | None:
    """Return why a node itself is outside the grammar, or ``None``."""
    if not node.args:
        if node.is_Symbol or node in (S.Pi, S.Exp1):
            return None
        if node.is_Rational and bits(node) > MAX_BITS:
            return f"a constant exceeds {MAX_BITS} bits, more than any C double can represent"
        if node.is_Rational:
            return f"the constant {shortened(node)} exceeds the range of a C double" if beyond_double(node) else None
        if node in (S.NaN, S.ComplexInfinity, S.Infinity, S.NegativeInfinity):
            return f"a part of the formula is not finite ({node})"
    elif node.func in NODES:
        return exponent_problem(node.exp) if node.is_Pow else None
    kind = type(node).__name__
    reason = ": the formulas of a system are real" if kind == "ImaginaryUnit" else ""
    names = ", ".join([*FUNCTIONS, *REWRITTEN, *CONSTANTS, *REWRITTEN_CONSTANTS])
    if not node.args and node.is_number and not reason:
        reason = f": make it a parameter, parameters={{'{kind}': {float(node)!r}}}"
    elif kind in WRITTEN_OTHERWISE:
        reason = f": write {WRITTEN_OTHERWISE[kind]}"
    return f"{kind} ('{shortened(node)}') is not supported{reason}. Use + - * / ** and {names}"


def exponent_problem(exponent: Expr) -> str | None:
    """Return why the rational part of an exponent is too large: SymPy extracts 2**10**9 from 2**(x + 10**9)."""
    constant = exponent.as_coeff_Add(rational=True)[0]
    if abs(constant) <= MAX_EXPONENT and constant.q <= MAX_EXPONENT_DENOMINATOR:
        return None
    return (
        f"the constant {shortened(constant)} in an exponent is not supported: it must lie between "
        f"-{MAX_EXPONENT} and {MAX_EXPONENT}, with a denominator of at most {MAX_EXPONENT_DENOMINATOR}; "
        f"make it a parameter: x**n, parameters={{'n': {float(constant)!r}}}"
    )


def _constant_problem(expression: Expr) -> str | None:
    """Return why a maximal subexpression without symbols is not a finite real number, or ``None``."""
    pending, seen = [expression], {expression}
    while pending:
        node = pending.pop()
        if not node.is_number:
            new = [argument for argument in node.args if argument.args and argument not in seen]
            seen.update(new)
            pending += new
        elif node.args:
            try:
                evaluate(node, {})
            except ArithmeticError:
                return f"the constant '{shortened(node)}' is not a finite real number"
    return None


def evaluated(expression: Expr, replacements: Mapping[Expr, Expr] | None = None) -> Expr:
    """Replace parts, make floating-point numbers rational and re-evaluate all constructors until nothing changes.

    SymPy leaves some nodes as no constructor would build them (``evaluate=False``, but also ``-((1/2)**x - 1)``); the
    result equals the parsed text of the expression. A float becomes the rational of its shortest decimal form.
    """
    rules = dict(replacements or {})
    for _ in range(MAX_PASSES):
        for quantity in intermediates(expression):
            _rebuilt(quantity, rules)
        result = _rebuilt(expression, rules)
        if result == expression:
            break
        expression, rules = result, {}
    return expression


_BUILT = {**OF_SYMPY, **{getattr(sympy, name): function for name, function in REWRITTEN.items()}}
"""How functions of SymPy are made of those of the grammar."""


def _rebuilt(expression: Expr, replacements: dict[Expr, Expr]) -> Expr:
    if expression not in replacements:
        replacements[expression] = _rebuilt_node(expression, replacements)
    return replacements[expression]


def _rebuilt_node(expression: Expr, replacements: dict[Expr, Expr]) -> Expr:
    """Return a node made again from its rebuilt arguments."""
    if expression.is_Float:
        value = float(expression)
        return Rational(repr(value) if expression == value else str(expression))
    if expression.is_number and not expression.args:
        return REWRITTEN_CONSTANTS.get(str(expression), expression)
    if not expression.args or isinstance(expression, (sympy.Derivative, AppliedUndef)):
        return expression
    arguments = [_rebuilt(argument, replacements) for argument in expression.args]
    if isinstance(expression, Intermediate):
        return intermediate(arguments[0])
    rebuilt = _BUILT.get(expression.func, expression.func)(*arguments)
    return without_abs(rebuilt) if expression.is_Pow and not expression.exp.is_integer else rebuilt


def gradient(expression: Expr, variables: Sequence[Symbol]) -> dict[int, Expr]:
    """Return the non-zero first derivatives of ``expression``, by index into ``variables``, ascending.

    >>> from sympy.abc import x, y, z
    >>> gradient(x**2 * z + z, [x, y, z])
    {0: 2*x*z, 2: x**2 + 1}
    """
    return dict(sorted(_accumulation(tuple(variables)).total(expression).items()))


def gradient_tuple(expression: Expr, variables: Sequence[Symbol]) -> tuple[Expr, ...]:
    """Return the first derivatives of ``expression`` by all variables, zeros included."""
    derivatives = gradient(expression, variables)
    return tuple(derivatives.get(k, S.Zero) for k in range(len(variables)))


def derivative_along(expression: Expr, variables: Sequence[Symbol], direction: Sequence[Expr]) -> Expr:
    """Return the derivative along a direction; along the rates of the variables it is that in time."""
    return tangents([expression], variables, direction)[0]


def tangents(expressions: Sequence[Expr], variables: Sequence[Symbol], direction: Sequence[Expr]) -> tuple[Expr, ...]:
    """Return the derivatives of several expressions along a direction, from the first quantity to the last.

    This is forward accumulation: it takes a small multiple of the operations of the expressions.

    >>> from sympy.abc import x, y, z
    >>> tangents([x * y, y**2], [x, y], [z, x])
    (x**2 + y*z, 2*x*y)
    """
    local, moved = _accumulation(tuple(variables)).of, dict[Any, Expr](enumerate(direction))

    def along(expression: Expr) -> Expr:
        return total([product(derivative, moved[key]) for key, derivative in local(expression).items()])

    for quantity in intermediates(*expressions):
        moved[quantity] = intermediate(along(quantity.definition))
    return tuple(map(along, expressions))


def dot(a: Sequence[Expr], b: Sequence[Expr]) -> Expr:
    """Return the scalar product a . b."""
    return Add(*(x * y for x, y in zip(a, b, strict=True)))


def jacobian(
    expressions: Sequence[Expr] | Mapping[int, Expr], variables: Sequence[Symbol], *, symmetric: bool = False
) -> dict[tuple[int, int], Expr]:
    """Return the non-zero first derivatives of several expressions, by (row, column), ascending.

    Args:
        expressions: the rows, as a sequence or by index (what ``gradient`` returns).
        variables: the columns.
        symmetric: whether the upper triangle equals the lower one, from which it may be copied.

    >>> from sympy.abc import x, y
    >>> jacobian([x * y, y**2], [x, y])
    {(0, 0): y, (0, 1): x, (1, 1): 2*y}
    """
    rows = expressions if isinstance(expressions, Mapping) else dict(enumerate(expressions))
    return dict(sorted(_accumulation(tuple(variables)).rows(rows, symmetric=symmetric).items()))


def hessian(expression: Expr, variables: Sequence[Symbol]) -> dict[tuple[int, int], Expr]:
    """Return the non-zero second derivatives by (row, column), ascending; both triangles, which share their entries.

    >>> from sympy.abc import x, y
    >>> hessian(x**2 * y, [x, y])
    {(0, 0): 2*y, (0, 1): 2*x, (1, 0): 2*x}
    """
    entries = jacobian(gradient(expression, variables), variables, symmetric=True)
    upper = {(row, column): entry for (row, column), entry in entries.items() if row <= column}
    lower = {(column, row): entry for (row, column), entry in upper.items()}
    return dict(sorted((upper | lower).items()))


@lru_cache(maxsize=8)
def _accumulation(variables: tuple[Symbol, ...]) -> _Accumulation:
    """Return the shared cache for these variables, since the derivatives of a system are requested repeatedly."""
    return _Accumulation(variables)


class _Accumulation:
    """Cache of the non-zero partial derivatives of every visited node, by index of the variable."""

    def __init__(self, variables: Sequence[Symbol]) -> None:
        self.variables = frozenset(variables)
        self.gradients: dict[Expr, Gradient] = {variable: {index: S.One} for index, variable in enumerate(variables)}
        self.totals: dict[Expr, dict[int, Expr]] = {}
        self.products: dict[tuple[Expr, Expr], Expr] = {}
        self.jacobians: dict[tuple[tuple[Expr, ...], bool], dict[tuple[int, int], Expr]] = {}

    def total(self, expression: Expr) -> dict[int, Expr]:
        """Return the derivatives with respect to variables, also by way of intermediate quantities."""
        if expression not in self.totals:
            self.totals[expression] = gradient_by_adjoints(self.of(expression), self.of)
        return self.totals[expression]

    def rows(self, expressions: Mapping[int, Expr], *, symmetric: bool) -> dict[tuple[int, int], Expr]:
        """Return the derivatives of several expressions, by (row, column)."""
        if not any(isinstance(key, Intermediate) for expression in expressions.values() for key in self.of(expression)):
            return {(i, j): entry for i, expression in expressions.items() for j, entry in self.of(expression).items()}
        key = (*expressions.values(),), symmetric
        if key not in self.jacobians:
            entries = Elimination(expressions, self.of, lower=symmetric).jacobian()
            upper = {(j, i): entry for (i, j), entry in entries.items() if i > j} if symmetric else {}
            self.jacobians[key] = entries | upper
        return self.jacobians[key]

    def of(self, node: Expr) -> Gradient:
        if not node.args:
            return self.gradients.get(node, {})
        derivative = self.gradients.get(node)
        if derivative is None:
            derivative = self.gradients[node] = self.derived(node)
        return derivative

    def derived(self, node: Expr) -> Gradient:
        if isinstance(node, Intermediate):
            return {} if self.variables.isdisjoint(node.varies_with) else {node: S.One}
        inner = [self.of(argument) for argument in node.args]
        return self._combined(
            [
                (factor, derivatives)
                for position, derivatives in enumerate(inner)
                if derivatives and (factor := node_derivative(node, position)) is not S.Zero
            ]
        )

    def _combined(self, pairs: Sequence[tuple[Expr, Gradient]]) -> Gradient:
        """Return the sum of factor times gradient: the chain rule, in which equal terms occur once with their number.

        Second derivatives of ``sum_k x_k^2`` with n terms in each x_k are n^3 products, of which n^2 are different.
        """
        parts: dict[Any, dict[Expr, int]] = {}
        for factor, derivatives in pairs:
            for index, derivative in derivatives.items():
                term = derivative if factor is S.One else self._product(factor, derivative)
                terms = parts.setdefault(index, {})
                terms[term] = terms.get(term, 0) + 1
        entries = {
            index: total([n * term if n > 1 else term for term, n in terms.items()]) for index, terms in parts.items()
        }
        return {index: entry for index, entry in entries.items() if entry is not S.Zero}

    def _product(self, factor: Expr, derivative: Expr) -> Expr:
        if (factor, derivative) not in self.products:
            self.products[factor, derivative] = product(factor, derivative)
        return self.products[factor, derivative]


def node_derivative(node: Expr, position: int) -> Expr:
    """Return the derivative of a node with respect to its argument in ``position``."""
    if isinstance(node, Add):
        return S.One
    if isinstance(node, Mul):
        return Mul(*node.args[:position], *node.args[position + 1 :])
    if isinstance(node, Pow):
        base, exponent = node.args
        return Mul(exponent, Pow(base, exponent - 1)) if position == 0 else Mul(node, log(base))
    if isinstance(node, Function):
        return node.fdiff(position + 1)
    raise TypeError(f"cannot differentiate a {type(node).__name__}")
