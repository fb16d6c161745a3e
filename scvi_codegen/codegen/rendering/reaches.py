"""Bounds of functions of time on intervals, by which a search for their zeros excludes intervals.

For |s - t| <= r the change |f(s) - f(t)| is at most the reach R of f, composed of those of its parts (arithmetic of
balls; R. E. Moore, *Interval Analysis*, 1966). A smooth g changes by r (|g'| + R of g') at most, too, and is monotone
where |g'| > R of g'. Where no bound exists, as of 1/f near f = 0, the formula is not finite.
"""

import sympy
from sympy import Expr, Symbol

from scvi_codegen.systems.formulas.expressions import parts_of_type
from scvi_codegen.systems.formulas.kinks import absolute, minimum, rint, unit_step

STEEP = sympy.Integer(10) ** 30
"""Slope of a jump."""
CONVEX = (sympy.asin, sympy.acos, sympy.sinh, sympy.cosh, sympy.atanh)
"""Functions whose size of change is largest away from 0."""
LIPSCHITZ = (sympy.sin, sympy.cos, sympy.atan, sympy.tanh, sympy.asinh)
"""Functions whose slope is at most 1."""


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
    if time not in f.free_symbols:
        return sympy.S.Zero
    if f == time:
        return r
    if f.is_Add:
        return sympy.Add(*(_reach(term, time, r) for term in f.args))
    if f.is_Mul:
        first, rest = f.as_two_terms()
        a, b = _reach(first, time, r), _reach(rest, time, r)
        return absolute(first) * b + absolute(rest) * a + a * b
    x, change = f.args[0], _reach(f.args[0], time, r)
    size = absolute(x)
    if isinstance(f, (sympy.tan, sympy.atan2)):
        return _reach(sympy.sin(x) / sympy.cos(x), time, r) if isinstance(f, sympy.tan) else 1 / unit_step(-1 - r**2)
    if f.is_Pow and not f.exp.free_symbols:
        n = absolute(f.exp)
        whole = (size + change) ** n - size**n if n.is_Integer or n > 1 else x**n - (x - change) ** n
        near = x**n
        inverse = whole / (absolute(near) * absolute(absolute(near) - whole) * unit_step(absolute(near) - whole))
        return inverse if f.exp.is_negative else whole
    if f.is_Pow:
        return _reach(sympy.exp(f.exp * sympy.log(f.base)), time, r)
    rules = {
        unit_step: lambda: unit_step(change - size),
        rint: lambda: rint(absolute(x - f) + change),
        sympy.exp: lambda: sympy.exp(x + change) - f,
        sympy.log: lambda: -sympy.log(1 - change / size),
        sympy.acosh: lambda: f - sympy.acosh(x - change),
        **{kind: lambda: absolute(f.func(size + change) - f.func(size)) for kind in CONVEX},
        **{kind: lambda: minimum(change, sympy.Integer(4)) for kind in LIPSCHITZ},
    }
    return rules[f.func]()
