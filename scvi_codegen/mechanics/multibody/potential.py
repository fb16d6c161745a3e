"""Potential energy of forces, if they have one: f = -V_q.

One coordinate after the other is integrated: the part of its force that V does not yet account for, term by term.
Terms c s**e with roots or denominators are integrated by the chain rule if c/s_q is constant (weights, springs,
gravitation); products of powers, sines and exponentials by SymPy. The result is accepted if -V_q equals f at random
points in 60 digits.

Identities are tested probabilistically: expressions are evaluated at random points in 60 digits.
"""

from __future__ import annotations

import random
from collections.abc import Iterable, Sequence

import sympy
from sympy import Add, Dummy, Expr, Pow, Symbol
from sympy.integrals.manualintegrate import manualintegrate

from scvi_codegen.formulas.expressions import Tape, unsupported_part
from scvi_codegen.tables.precision import mp

NEGLIGIBLE = mp.mpf(10) ** -40
ATTEMPTS, POINTS = 24, 2
SEED = 20250101


def are_zero(expressions: Iterable[Expr]) -> bool:
    """Return whether all expressions are zero at two random points; false if fewer points of definition are found."""
    unlike = [expression for expression in expressions if expression != 0]
    if any(map(unsupported_part, unlike)):
        return False
    symbols = sorted(set().union(*(expression.free_symbols for expression in unlike)), key=str)
    tape, generator, tested = Tape(unlike, symbols), random.Random(SEED), 0
    for _ in range(ATTEMPTS):
        try:
            values = tape([mp.mpf(generator.uniform(0.1, 1.0)) for _ in symbols])
        except ArithmeticError:
            continue
        if any(abs(value) > NEGLIGIBLE for value in values):
            return False
        tested += 1
        if tested == POINTS:
            return True
    return not unlike


def potential_of(forces: Sequence[Expr], coordinates: Sequence[Symbol]) -> Expr | None:
    """Return V(q), or ``None`` if there is none, or none was found.

    >>> x, y, k = sympy.symbols("x y k")
    >>> potential_of([-k*x*y**2 - x/sympy.sqrt(x**2 + y**2), -k*x**2*y - y/sympy.sqrt(x**2 + y**2)], [x, y])
    k*x**2*y**2/2 + sqrt(x**2 + y**2)
    >>> potential_of([y, -x], [x, y])
    """
    potential: Expr = sympy.S.Zero
    for q, force in zip(coordinates, forces, strict=True):
        part = _antiderivative(force + potential.diff(q), q)
        if part is None:
            return None
        potential -= part
    return potential if are_zero(f + potential.diff(q) for q, f in zip(coordinates, forces, strict=True)) else None


def _antiderivative(expression: Expr, q: Symbol) -> Expr | None:
    """Return the antiderivative with respect to ``q``, or ``None`` if no rule applies."""
    powers = [power for power in expression.atoms(Pow) if _is_steep(power, q)]
    bases = {power.base: Dummy(positive=True) for power in powers}
    hidden = expression.xreplace({power: bases[power.base] ** power.exp for power in powers})
    coefficients: dict[Expr, Expr] = {}
    for term in Add.make_args(sympy.expand(hidden)):
        coefficient, power = term.as_independent(*bases.values(), as_Add=False)
        coefficients[power] = coefficients.get(power, sympy.S.Zero) + coefficient
    plain = manualintegrate(coefficients.pop(sympy.S.One, sympy.S.Zero), q)
    plain = plain.replace(sympy.Piecewise, lambda generic, *special: generic[0])
    behind = {symbol: base for base, symbol in bases.items()}
    parts = [_by_chain_rule(factor, power, behind, q) for power, factor in coefficients.items() if factor != 0]
    if plain.has(sympy.Integral) or None in parts:
        return None
    return Add(plain, *parts)


def _is_steep(power: Expr, q: Symbol) -> bool:
    """Return whether ``power`` of a function of ``q`` has an exponent other than a positive integer."""
    return bool(power.base.has(q) and not (power.exp.is_Integer and power.exp.is_positive))


def _by_chain_rule(factor: Expr, power: Expr, behind: dict[Symbol, Expr], q: Symbol) -> Expr | None:
    """Return the integral of c s**e if c/s_q does not depend on ``q``, else ``None``."""
    symbol, exponent = power.as_base_exp()
    if symbol not in behind or exponent.has(*behind, q):
        return None
    base = behind[symbol]
    constant = sympy.cancel(factor.xreplace(behind) / base.diff(q))
    if constant.has(q):
        return None
    return constant * (sympy.log(base) if exponent == -1 else base ** (exponent + 1) / (exponent + 1))
