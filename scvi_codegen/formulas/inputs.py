"""Inputs: functions of time passed to runs as data, such as a motor force or a measured ground motion.

Between two breakpoints an input u is a cubic of the time since the first of them,

    u(t) = u_0 + u_1 s + u_2 s^2 + u_3 s^3,        s = t - u_t,

with five parameters of the system. A run updates them at the breakpoints, which are ends of steps: other data need no
recompilation, every method and solver supports them, and no step contains a breakpoint, so orders are preserved.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sympy import Basic, Expr, Integer, Symbol

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.formulas.symbols import check_name, symbol

PARTS = ("0", "1", "2", "3", "t")
"""Suffixes of the five parameters of an input: coefficients by power, and the breakpoint."""


def input_parameters(inputs: Sequence[str]) -> dict[str, float]:
    """Return the parameters of all inputs, with default value 0."""
    for name in inputs:
        check_name(name)
    return {f"{name}_{part}": 0.0 for name in inputs for part in PARTS}


def with_inputs(parameters: Mapping[str, float], inputs: Sequence[str]) -> dict[str, float]:
    """Return the default values of parameters, including those of inputs.

    Raises:
        SystemDefinitionError: if a parameter has the name of an input's parameter.
    """
    parts = input_parameters(inputs)
    for name in parameters:
        if name in parts:
            raise SystemDefinitionError(
                f"'{name}' is the name of both a parameter and a component of the input '{name[:-2]}': rename one"
            )
    return {**parameters, **parts}


def input_formulas(inputs: Sequence[str], time: Symbol) -> Mapping[Symbol, Expr]:
    """Return the cubic polynomial of each input, by its symbol."""
    formulas: dict[Symbol, Expr] = {}
    for name in inputs:
        c0, c1, c2, c3, start = (symbol(f"{name}_{part}") for part in PARTS)
        s = time - start
        formulas[symbol(name)] = c0 + s * (c1 + s * (c2 + s * c3))
    return formulas


def inputs_by_name(formula: Expr, inputs: Sequence[str]) -> Expr:
    """Return a formula with each input's polynomial replaced by its symbol (coefficient 0; others set to 0)."""
    rules: dict[Basic, Basic] = {symbol(part): Integer(0) for part in input_parameters(inputs)}
    return formula.xreplace(rules | {symbol(f"{name}_0"): symbol(name) for name in inputs})
