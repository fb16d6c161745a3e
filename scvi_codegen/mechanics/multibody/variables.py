"""The variables of a system of bodies: SymPy's functions of time and generalised speeds as plain symbols, and back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import sympy
from sympy import Dummy, Expr, Matrix, Symbol
from sympy.core.function import AppliedUndef
from sympy.matrices.exceptions import NonInvertibleMatrixError

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.formulas.canonical import evaluated
from scvi_codegen.formulas.derivatives import gradient

__all__ = ["Variables", "solved_for_speeds"]


class Variables:
    """Symbols for q(t), dq/dt and generalised speeds u(t); other functions of time get theirs as they are read.

    Args:
        coordinates: functions of time.
        time: their argument.
        speeds: generalised speeds; one that is a dq/dt is none of its own.
        auxiliary: speeds that are 0.

    Attributes:
        x, v: of coordinates and velocities, m each.
        u: of the speeds.
        time: as given.
    """

    def __init__(
        self, coordinates: Sequence[Expr], time: Symbol, speeds: Sequence[Expr] = (), auxiliary: Sequence[Expr] = ()
    ) -> None:
        rates = [q.diff(time) for q in coordinates]
        own = [u for u in speeds if u not in rates]
        self.time = time
        self.x, self.v, self.u = (tuple(map(_symbol, functions)) for functions in (coordinates, rates, own))
        self._written: dict[Expr, Expr] = dict(
            zip((*self.x, *self.v, *self.u), (*coordinates, *rates, *own), strict=True)
        )
        self._own = len(self._written)
        self._plain: dict[Expr, Expr] = {function: symbol for symbol, function in self._written.items()}
        self._plain |= dict.fromkeys(auxiliary, sympy.S.Zero)

    @property
    def given(self) -> tuple[Symbol, ...]:
        """The symbols of what was read and is neither coordinate nor speed, but a function of time."""
        return tuple(self._written)[self._own :]

    def settle(self, speeds: Mapping[Symbol, Expr]) -> None:
        """From now on read speeds as what they are in coordinates and velocities."""
        self._plain |= {self._written[u]: value for u, value in speeds.items()}

    def read(self, expression: Any) -> Expr:
        """In plain symbols, its numbers exact."""
        expression = sympy.sympify(expression)
        others = expression.atoms(sympy.Derivative, AppliedUndef) - self._plain.keys()
        for function in sorted(others, key=str):
            self._plain[function] = _symbol(function)
            self._written[self._plain[function]] = function
        return evaluated(expression, self._plain)

    def write(self, expression: Expr) -> Expr:
        """In the user's functions of time."""
        return expression.xreplace(self._written)

    def rate(self, function: Expr) -> Expr:
        """d/dt of a function of coordinates and time."""
        flow = dict(zip(self.x, self.v, strict=True)) | {self.time: sympy.S.One}
        along = tuple(flow)
        return sympy.Add(*(slope * flow[along[j]] for j, slope in gradient(function, along).items()))


def _symbol(function: Expr) -> Symbol:
    return Dummy(str(function), real=function.is_real, positive=function.is_positive)


def solved_for_speeds(equations: Sequence[Expr], variables: Variables) -> dict[Symbol, Expr]:
    """The generalised speeds in coordinates and velocities, from as many linear equations in plain symbols.

    Raises:
        SystemDefinitionError: where they do not say them.
    """
    if not variables.u:
        return {}
    rows, resting = Matrix(equations), dict.fromkeys(variables.u, sympy.S.Zero)
    try:
        found = rows.jacobian(variables.u).LUsolve(-rows.xreplace(resting))
        if not found.has(*variables.u, sympy.nan, sympy.zoo):
            return dict(zip(variables.u, found, strict=True))
    except NonInvertibleMatrixError:
        pass
    names = ", ".join(str(variables.write(u)) for u in variables.u)
    raise SystemDefinitionError(
        f"the kinematic equations cannot be solved for the generalised speeds {names}: they must be an invertible "
        "combination of the rates of the coordinates"
    )
