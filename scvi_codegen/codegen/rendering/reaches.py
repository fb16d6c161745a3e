"""Bounds of functions of time on intervals, by which a search for their zeros excludes intervals.

For |s - t| <= r the change |f(s) - f(t)| is at most the reach R of f, composed of those of its parts (arithmetic of
balls; R. E. Moore, *Interval Analysis*, 1966). A smooth g changes by r (|g'| + R of g') at most, too, and is monotone
where |g'| > R of g'. Where no bound exists, as of 1/f near f = 0, the formula is not finite.
"""

from typing import Any

import sympy
from sympy import Expr, Symbol

from scvi_codegen.systems.formulas.expressions import parts_of_type
from scvi_codegen.systems.formulas.kinks import absolute, minimum, rint, unit_step

STEEP = sympy.Integer(10) ** 30
"""Slope of a jump."""


def reaches(g: Expr, time: Symbol, r: Expr) -> tuple[Expr, Expr, Expr]:
    """Return the reach of a function in t +- r, its least slope, > 0 if it is monotone, and its rounding at t."""
    slope = sympy.diff(g, time)
    jumps = sympy.Add(*(_reach(step, time, r) for step in parts_of_type(unit_step, g) | parts_of_type(rint, g)))
    bend = _reach(slope, time, r) + STEEP * jumps
    return minimum(_reach(g, time, r), r * (absolute(slope) + bend)), absolute(slope) - bend, _rounding(g)


def _rounding(f: Expr) -> Expr:
    """Return a bound of the rounding error of a formula in ulps, to first order."""
    if f.is_Add:
        return sympy.Add(*(_rounding(term) + absolute(term) for term in f.args))
    if f.is_Mul:
        first, rest = f.as_two_terms()
        return absolute(first) * _rounding(rest) + absolute(rest) * _rounding(first) + absolute(f)
    return absolute(f) if f.args else sympy.S.Zero


def _reach(f: Expr, time: Symbol, r: Expr) -> Expr:
    """Return the largest change of a function in an interval."""
    if time not in f.free_symbols or f == time:
        return r if f == time else sympy.S.Zero
    if f.is_Add:
        return sympy.Add(*(_reach(term, time, r) for term in f.args))
    if f.is_Mul:
        first, rest = f.as_two_terms()
        a, b = _reach(first, time, r), _reach(rest, time, r)
        return absolute(first) * b + absolute(rest) * a + a * b
    if f.is_Pow and f.exp.free_symbols:
        return _reach(sympy.exp(f.exp * sympy.log(f.base)), time, r)
    if isinstance(f, sympy.tan):
        return _reach(sympy.sin(f.args[0]) / sympy.cos(f.args[0]), time, r)
    x, change = f.args[0], _reach(f.args[0], time, r)
    size = absolute(x)
    if f.is_Pow:
        n = absolute(f.exp)
        whole = (size + change) ** n - size**n if n.is_Integer or n > 1 else x**n - (x - change) ** n
        near = absolute(x**n)
        return whole / (near * absolute(near - whole) * unit_step(near - whole)) if f.exp.is_negative else whole
    convex = absolute(f.func(size + change) - f.func(size)) if f.func != sympy.atan2 else 1 / unit_step(-1 - r**2)
    rules: dict[Any, Expr] = {
        unit_step: unit_step(change - size),
        rint: rint(absolute(x - f) + change),
        sympy.exp: sympy.exp(x + change) - f,
        sympy.log: -sympy.log(1 - change / size),
        sympy.acosh: f - sympy.acosh(x - change),
    }
    rules |= dict.fromkeys((sympy.sin, sympy.cos, sympy.atan, sympy.tanh, sympy.asinh), minimum(change, sympy.S(4)))
    return rules.get(f.func, convex)
