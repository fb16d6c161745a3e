"""Formulas in the states at the ends of steps as CasADi functions, and the Legendre transform between v and p."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import sympy
from sympy import Expr, Symbol

from scvi_codegen.errors import MethodError
from scvi_codegen.formulas.grammar import parse_expression
from scvi_codegen.formulas.inputs import input_parameters
from scvi_codegen.formulas.vocabulary import CONSTANTS, FUNCTIONS
from scvi_codegen.mechanics.constraints import constraint_rates, holonomic_expressions
from scvi_codegen.mechanics.derived_expressions import forms_of
from scvi_codegen.mechanics.system import MechanicalSystem

__all__ = ["EndConditions", "numeric", "own_parameters", "read"]


@dataclass(frozen=True)
class EndConditions:
    """Functions of q, v, p, t and the parameters, without inputs, at the beginning or the end of a step."""

    ca: Any
    system: MechanicalSystem

    @cached_property
    def symbols(self) -> tuple[Symbol, ...]:
        """Symbols that formulas may contain."""
        system = self.system
        return (*system.coordinates, *system.velocities, *system.momentum_symbols, system.time, *own_parameters(system))

    def formula(self, text: str) -> Any:
        """Return a formula as a function; raises ExpressionError for one outside the grammar."""
        return self._function(read([text], self.symbols))

    @cached_property
    def legendre(self) -> Any:
        """Residual of the Legendre transform: p - L_v, or v - H_p for a Hamiltonian.

        Raises:
            MethodError: if it contains an input, at whose jumps it would be discontinuous.
        """
        forms, system = forms_of(self.system), self.system
        conditions = forms.constitutive or tuple(map(sympy.Add, system.momentum_symbols, (-p for p in forms.momentum)))
        if any(each.free_symbols - {*self.symbols} for each in conditions):
            raise MethodError("momenta depend on an input and would jump with it: use inputs only in forces")
        return self._function(conditions)

    @cached_property
    def constraint_residual(self) -> Any:
        """Residual of the constraints g(q) = 0 and of their time derivatives.

        Raises:
            MethodError: if they contain an input.
        """
        result = [each for each in (*holonomic_expressions(self.system), *constraint_rates(self.system)) if each != 0]
        if any(each.free_symbols - {*self.symbols} for each in result):
            raise MethodError("a constraint depends on an input and would jump with it: use inputs only in forces")
        return self._function(result)

    def momentum(self, q: Any, v: Any, t: Any, parameters: Any) -> Any:
        """Return the momentum of a velocity: exact if H is quadratic in p, otherwise an initial guess."""
        return self._updated("by_p", q=q, v=v, p=self.ca.DM.zeros(*q.shape), t=t, parameters=parameters)

    def velocity(self, q: Any, p: Any, t: Any, parameters: Any) -> Any:
        """Return the velocity of a momentum: exact if L is quadratic in v, otherwise an initial guess."""
        return self._updated("by_v", q=q, v=self.ca.DM.zeros(*q.shape), p=p, t=t, parameters=parameters)

    def _updated(self, derivative: str, **values: Any) -> Any:
        """Return the result of one Newton update from 0."""
        result = self._legendre_derivatives(**values)
        return -self.ca.solve(result[derivative], result["residual"], "qr")

    @cached_property
    def _legendre_derivatives(self) -> Any:
        """Residual of :attr:`legendre`, and its derivatives with respect to v and p."""
        arguments = self.legendre.sx_in()
        residual = self.legendre(*arguments)
        results = [residual, *(self.ca.jacobian(residual, arguments[k]) for k in (1, 2))]
        return self.ca.Function("partials", arguments, results, self.legendre.name_in(), ["residual", "by_v", "by_p"])

    def _function(self, expressions: Sequence[Expr]) -> Any:
        m, ca = self.system.dimension, self.ca
        shapes = {"q": m, "v": m, "p": m, "t": 1, "parameters": len(own_parameters(self.system))}
        arguments = [ca.SX.sym(name, size) for name, size in shapes.items()]
        result = numeric(ca, expressions, self.symbols)(*ca.vertsplit(ca.vertcat(*arguments)))
        return ca.Function("at_end", arguments, [ca.vertcat(*result)], [*shapes], ["value"])


def own_parameters(system: MechanicalSystem) -> Mapping[Symbol, float]:
    """Return the default values of the parameters that do not belong to inputs."""
    parts = input_parameters(system.inputs)
    return {name: value for name, value in system.constants.items() if name.name not in parts}


def read(texts: Sequence[str], symbols: Sequence[Symbol]) -> list[Expr]:
    """Return formulas as expressions in symbols; raises ExpressionError for one outside the grammar."""
    known = {each.name: each for each in symbols}
    return [parse_expression(text, known) for text in texts]


def numeric(ca: Any, expressions: Sequence[Expr], symbols: Sequence[Symbol]) -> Callable[..., list[Any]]:
    """Return expressions as a function of CasADi's symbols, with common subexpressions shared."""
    names = {name: getattr(ca, name) for name in FUNCTIONS}
    constants = {name: float(value) for name, value in CONSTANTS.items()} | {"e": float(sympy.E)}
    arguments: dict[str, Any] = {
        "modules": [names | constants],
        "cse": True,
        "dummify": True,
    }  # a symbol may be called e
    function: Callable[..., list[Any]] = sympy.lambdify(symbols, list(expressions), **arguments)
    return function
