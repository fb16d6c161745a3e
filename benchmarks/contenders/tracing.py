"""Conversion of accelerations, written for any kind of number, into straight-line Python source for Numba."""

from collections.abc import Mapping
from types import SimpleNamespace

import sympy
from sympy.printing.pycode import PythonCodePrinter

from benchmarks.cases.unforced import Rates


class _SourcePrinter(PythonCodePrinter):  # type: ignore[misc]  # SymPy ships no stubs
    def _print_Pow(self, expr: sympy.Pow, rational: bool = False) -> str:
        """Return multiples of 1/2 as products and square roots, which are several times faster than ``pow``."""
        base, halves = self._print(expr.base), int(2 * abs(expr.exp))
        power = "*".join([f"({base})"] * (halves // 2) + [f"sqrt({base})"] * (halves % 2))
        return f"(1.0/({power}))" if expr.exp < 0 else f"({power})"

    def _print_Rational(self, expr: sympy.Rational) -> str:
        return repr(float(expr))

    _print_Integer = _print_Rational


def assignments(rates: Rates, parameters: Mapping[str, float], size: int) -> list[tuple[str, str]]:
    """Return names and expressions that compute the derivative of x: shared subexpressions, then ``out[n]``.

    The expressions are valid in Python and, because all numbers in them are decimal fractions, in C.
    """
    functions = SimpleNamespace(sin=sympy.sin, cos=sympy.cos, sqrt=sympy.sqrt, time=sympy.Symbol("t"))
    x = [sympy.Symbol(f"x[{n}]") for n in range(size)]
    shared, results = sympy.cse(rates(x, parameters, functions), sympy.numbered_symbols("w"))
    printer = _SourcePrinter({"fully_qualified_modules": False})
    lines = [*shared, *((f"out[{n}]", result) for n, result in enumerate(results))]
    return [(str(name), printer.doprint(sympy.sympify(value))) for name, value in lines]


def rates_text(rates: Rates, parameters: Mapping[str, float], size: int) -> str:
    """Return the source of ``def rates(out, t, x, unused)``, which fills ``out`` with the derivative of ``x``."""
    body = "".join(f"    {name} = {value}\n" for name, value in assignments(rates, parameters, size))
    return f"def rates(out, t, x, unused):\n{body}"
