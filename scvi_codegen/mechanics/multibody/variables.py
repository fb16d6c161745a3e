"""Variables of a multibody system: conversion of SymPy's functions of time and speeds to plain symbols, and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import sympy
from sympy import Dummy, Expr, Matrix, Symbol
from sympy.core.function import AppliedUndef
from sympy.matrices.exceptions import NonInvertibleMatrixError

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.formulas.expressions import evaluated, gradient


class Variables:
    """Plain symbols for q(t), dq/dt and generalised speeds u(t); other functions of time get symbols when first read.

    Args:
        coordinates: functions of time.
        time: their argument.
        speeds: generalised speeds; one that equals a dq/dt gets no symbol of its own.
        auxiliary: auxiliary speeds, which are 0.

    Attributes:
        x, v: symbols of coordinates and velocities, m each.
        u: symbols of the generalised speeds.
        time: symbol of time.
    """

    def __init__(
        self, coordinates: Sequence[Expr], time: Symbol, speeds: Sequence[Expr] = (), auxiliary: Sequence[Expr] = ()
    ) -> None:
        rates = [q.diff(time) for q in coordinates]
        independent = [u for u in speeds if u not in rates]
        self.time = time
        self.x, self.v, self.u = (tuple(map(_symbol, functions)) for functions in (coordinates, rates, independent))
        self._written: dict[Expr, Expr] = dict(
            zip((*self.x, *self.v, *self.u), (*coordinates, *rates, *independent), strict=True)
        )
        self._own = len(self._written)
        self._plain: dict[Expr, Expr] = {function: symbol for symbol, function in self._written.items()}
        self._plain |= dict.fromkeys(auxiliary, sympy.S.Zero)

    @property
    def other_functions(self) -> tuple[Symbol, ...]:
        """Symbols of the functions of time that are neither coordinates nor speeds."""
        return tuple(self._written)[self._own :]

    def substitute_speeds(self, speeds: Mapping[Symbol, Expr]) -> None:
        """Replace the generalised speeds by their expressions in coordinates and velocities in all later reads."""
        self._plain |= {self._written[u]: value for u, value in speeds.items()}

    def read(self, expression: Any) -> Expr:
        """Return an expression in plain symbols, with exact numbers."""
        expression = sympy.sympify(expression)
        others = expression.atoms(sympy.Derivative, AppliedUndef) - self._plain.keys()
        for function in sorted(others, key=str):
            self._plain[function] = _symbol(function)
            self._written[self._plain[function]] = function
        return evaluated(expression, self._plain)

    def write(self, expression: Expr) -> Expr:
        """Return an expression in the user's functions of time."""
        return expression.xreplace(self._written)

    def rate(self, function: Expr) -> Expr:
        """Return d/dt of a function of coordinates and time."""
        flow = dict(zip(self.x, self.v, strict=True)) | {self.time: sympy.S.One}
        along = tuple(flow)
        return sympy.Add(*(derivative * flow[along[j]] for j, derivative in gradient(function, along).items()))


def _symbol(function: Expr) -> Symbol:
    return Dummy(str(function), real=function.is_real, positive=function.is_positive)


def solved_for_speeds(equations: Sequence[Expr], variables: Variables) -> dict[Symbol, Expr]:
    """Return the generalised speeds in terms of coordinates and velocities, solved from linear equations.

    Raises:
        SystemDefinitionError: if the equations are singular or nonlinear in the speeds.
    """
    if not variables.u:
        return {}
    rows, resting = Matrix(equations), dict.fromkeys(variables.u, sympy.S.Zero)
    try:
        solution = rows.jacobian(variables.u).LUsolve(-rows.xreplace(resting))
        if not solution.has(*variables.u, sympy.nan, sympy.zoo):
            return dict(zip(variables.u, solution, strict=True))
    except NonInvertibleMatrixError:
        pass
    names = ", ".join(str(variables.write(u)) for u in variables.u)
    raise SystemDefinitionError(
        f"the kinematic equations cannot be solved for the generalised speeds {names}: they must be an invertible "
        "combination of the rates of the coordinates"
    )
