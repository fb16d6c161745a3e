"""States between steps in CasADi: formulas in them, and how velocities and momenta belong together."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import sympy
from sympy import Expr, Symbol

from scvi_codegen.errors import MethodError
from scvi_codegen.formulas.grammar import parse_expression
from scvi_codegen.formulas.vocabulary import CONSTANTS, FUNCTIONS
from scvi_codegen.mechanics.constraints import constraint_rates, positions_held
from scvi_codegen.mechanics.forms import forms_of
from scvi_codegen.mechanics.inputs import input_parameters
from scvi_codegen.mechanics.system import MechanicalSystem

__all__ = ["Ends", "numeric", "own_parameters", "read"]


@dataclass(frozen=True)
class Ends:
    """Functions of q, v, p, t and the parameters that are no parts of inputs, at the beginning or the end of a step."""

    ca: Any
    system: MechanicalSystem

    @cached_property
    def symbols(self) -> tuple[Symbol, ...]:
        """What formulas may have in them."""
        system = self.system
        return (*system.coordinates, *system.velocities, *system.momentum_symbols, system.time, *own_parameters(system))

    def formula(self, text: str) -> Any:
        """A formula. Raises ExpressionError for one outside the grammar."""
        return self._function(read([text], self.symbols))

    @cached_property
    def legendre(self) -> Any:
        """What vanishes where v and p belong together: p - L_v, or v - H_p of a Hamiltonian.

        Raises:
            MethodError: where they do so by an input, as which they would jump.
        """
        forms, system = forms_of(self.system), self.system
        bound = forms.constitutive or tuple(map(sympy.Add, system.momentum_symbols, (-p for p in forms.momentum)))
        if any(each.free_symbols - {*self.symbols} for each in bound):
            raise MethodError("momenta depend on an input, and would jump where it does: let inputs be forces")
        return self._function(bound)

    @cached_property
    def held(self) -> Any:
        """What vanishes at a state on the constraints: their g of positions, and what they say of velocities.

        Raises:
            MethodError: where they have an input in them.
        """
        found = [each for each in (*positions_held(self.system), *constraint_rates(self.system)) if each != 0]
        if any(each.free_symbols - {*self.symbols} for each in found):
            raise MethodError("a constraint has an input in it, and would jump where it does: let inputs be forces")
        return self._function(found)

    def momentum(self, q: Any, v: Any, t: Any, parameters: Any) -> Any:
        """P of a velocity: exact unless H is not quadratic in p, when it is a first guess."""
        return self._updated("by_p", q=q, v=v, p=self.ca.DM.zeros(*q.shape), t=t, parameters=parameters)

    def velocity(self, q: Any, p: Any, t: Any, parameters: Any) -> Any:
        """V of a momentum: exact unless L is not quadratic in v, when it is a first guess."""
        return self._updated("by_v", q=q, v=self.ca.DM.zeros(*q.shape), p=p, t=t, parameters=parameters)

    def _updated(self, slopes: str, **values: Any) -> Any:
        """What one update of Newton's iteration makes of 0."""
        found = self._slopes(**values)
        return -self.ca.solve(found[slopes], found["residual"], "qr")

    @cached_property
    def _slopes(self) -> Any:
        """The residual of :attr:`legendre`, and its derivatives by v and by p."""
        given = self.legendre.sx_in()
        residual = self.legendre(*given)
        results = [residual, *(self.ca.jacobian(residual, given[place]) for place in (1, 2))]
        return self.ca.Function("slopes", given, results, self.legendre.name_in(), ["residual", "by_v", "by_p"])

    def _function(self, expressions: Sequence[Expr]) -> Any:
        m, ca = self.system.dimension, self.ca
        shapes = {"q": m, "v": m, "p": m, "t": 1, "parameters": len(own_parameters(self.system))}
        given = [ca.SX.sym(name, size) for name, size in shapes.items()]
        found = numeric(ca, expressions, self.symbols)(*ca.vertsplit(ca.vertcat(*given)))
        return ca.Function("at_end", given, [ca.vertcat(*found)], [*shapes], ["value"])


def own_parameters(system: MechanicalSystem) -> Mapping[Symbol, float]:
    """Default values of the parameters that are no parts of inputs."""
    parts = input_parameters(system.inputs)
    return {name: value for name, value in system.constants.items() if name.name not in parts}


def read(texts: Sequence[str], symbols: Sequence[Symbol]) -> list[Expr]:
    """Formulas in symbols. Raises ExpressionError for one outside the grammar."""
    known = {each.name: each for each in symbols}
    return [parse_expression(text, known) for text in texts]


def numeric(ca: Any, expressions: Sequence[Expr], symbols: Sequence[Symbol]) -> Callable[..., list[Any]]:
    """Expressions as a function of CasADi's symbols, common parts shared."""
    names = {name: getattr(ca, name) for name in FUNCTIONS}
    constants = {name: float(value) for name, value in CONSTANTS.items()} | {"e": float(sympy.E)}
    given: dict[str, Any] = {"modules": [names | constants], "cse": True, "dummify": True}  # a symbol may be called e
    function: Callable[..., list[Any]] = sympy.lambdify(symbols, list(expressions), **given)
    return function
