"""Printer for expressions: text of the grammar of :mod:`scvi_codegen.formulas.grammar`."""

from __future__ import annotations

from sympy import Expr, Integer, Pow, S

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.formulas.expressions import unsupported_part
from scvi_codegen.formulas.vocabulary import NAME_OF


def format_expression(expression: Expr) -> str:
    """Return an expression as text of the grammar, from which ``parse_expression`` rebuilds it node by node.

    The expression is taken as SymPy's constructors leave it; one built with ``evaluate=False`` comes back evaluated.

    Raises:
        SystemDefinitionError: for an expression outside the grammar.

    >>> import sympy
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
    # A rational factor in front of a sum in brackets would be expanded by the parser: divide factor by factor.
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
    if expression.func in NAME_OF:
        return f"{NAME_OF[expression.func]}({', '.join(map(_sum_text, expression.args))})"
    return f"({_sum_text(expression)})"
