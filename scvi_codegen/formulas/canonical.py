"""Canonical form of expressions, and the check that an expression is in the grammar."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import sympy
from sympy import Add, Expr, Mul, Pow, Rational, S
from sympy.core.function import AppliedUndef

from scvi_codegen.formulas.tape import evaluate
from scvi_codegen.formulas.vocabulary import CONSTANTS, FUNCTIONS, LARGEST, NAME_OF, shortened

MAX_EXPONENT = 64
MAX_EXPONENT_DENOMINATOR = 10_000
MAX_BITS = 2048
MAX_DIGITS = 616
"""Maximum number of decimal digits of an integer of ``MAX_BITS`` bits."""
MAX_PASSES = 8


def bits(number: Expr) -> int:
    """Return the size of a rational, the bits of its numerator or denominator; 0 for other expressions."""
    return max(int(number.p).bit_length(), int(number.q).bit_length()) if number.is_Rational else 0


def beyond_double(number: Expr) -> bool:
    """Return whether a rational overflows as a C double, or underflows to 0."""
    p, q = abs(int(number.p)), int(number.q)
    return p > int(LARGEST) * q or (p > 0 and p << 1075 <= q)


NODES = frozenset([Add, Mul, Pow, *NAME_OF])


_SMOOTHER = {
    "Abs": "the absolute value is not differentiable, and neither is sqrt(x**2)",
    "sign": "the sign is not differentiable",
    "Piecewise": "piecewise functions are not differentiable where pieces meet",
    "Heaviside": "step functions are not differentiable",
    "ImaginaryUnit": "a Lagrangian must be real",
}


def unsupported_part(expression: Expr) -> str | None:
    """Return why an expression is outside the grammar, or ``None``; shared by parser, printer and systems.

    Rejected are other functions, floating-point numbers, non-finite or non-real constants, numbers of more than
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
        if node.is_Rational and bits(node) > MAX_BITS:
            return f"a constant exceeds {MAX_BITS} bits, more than any C double can represent"
        if node.is_Rational:
            return f"the constant {shortened(node)} exceeds the range of a C double" if beyond_double(node) else None
        if node in (S.NaN, S.ComplexInfinity, S.Infinity, S.NegativeInfinity):
            return f"a part of the formula is not finite ({node})"
    elif node.func in NODES:
        return exponent_problem(node.exp) if node.is_Pow else None
    kind = type(node).__name__
    reason = f": {_SMOOTHER[kind]}" if kind in _SMOOTHER else ""
    known = ", ".join([*FUNCTIONS, *CONSTANTS])
    return f"{kind} ('{shortened(node)}') is not supported{reason}. Use + - * / ** and {known}"


def exponent_problem(exponent: Expr) -> str | None:
    """Return why the rational part of an exponent is too large: SymPy extracts 2**10**9 from 2**(x + 10**9)."""
    constant = exponent.as_coeff_Add(rational=True)[0]
    if abs(constant) <= MAX_EXPONENT and constant.q <= MAX_EXPONENT_DENOMINATOR:
        return None
    return (
        f"the constant {shortened(constant)} in an exponent is not supported: it must lie between "
        f"-{MAX_EXPONENT} and {MAX_EXPONENT}, with a denominator of at most {MAX_EXPONENT_DENOMINATOR}"
    )


def _constant_problem(expression: Expr) -> str | None:
    """Return why a maximal subexpression without symbols is not a finite real number, or ``None``."""
    pending = [expression]
    while pending:
        node = pending.pop()
        if not node.is_number:
            pending.extend(argument for argument in node.args if argument.args)
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
