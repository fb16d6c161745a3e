"""L, its derivatives and the Euler-Lagrange residual at a point, in 60 digits."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np
import sympy

from scvi_codegen.exact.newton import Array, Floats, Solve, newton, solver
from scvi_codegen.formulas.derivatives import jacobian
from scvi_codegen.formulas.tape import evaluate
from scvi_codegen.mechanics.forms import accelerations, forms_of
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.tables.precision import Number, mp

__all__ = ["Mechanics"]

Entries: TypeAlias = Mapping[tuple[int, int], sympy.Expr]


@lru_cache(maxsize=32)
def _formulas(system: LagrangianSystem) -> tuple[tuple[sympy.Expr, ...], tuple[Entries, Entries, Entries]]:
    """E and its derivatives by position, velocity and acceleration."""
    residual = forms_of(system).euler_lagrange
    by = (system.coordinates, system.velocities, accelerations(system))
    return residual, tuple(jacobian(residual, symbols) for symbols in by)  # type: ignore[return-value]


class Mechanics:
    """L, its derivatives and the Euler-Lagrange residual at a point, with given parameters."""

    def __init__(self, system: LagrangianSystem, parameters: Mapping[str, Number]) -> None:
        self.system, self.dimension = system, system.dimension
        self.constants = {symbol: parameters[symbol.name] for symbol in system.parameters}
        self.E, self.slopes_of_E = _formulas(system)
        forms = forms_of(system)
        self.p, self.mass = forms.momentum, forms.mass

    def _point(self, q: Array, v: Array, t: Number, a: Array | None = None) -> dict[sympy.Symbol, Number]:
        system = self.system
        values = dict(zip((*system.coordinates, *system.velocities), (*q, *v), strict=True))
        if a is not None:
            values |= dict(zip(accelerations(system), a, strict=True))
        return values | self.constants | {system.time: t}

    def lagrangian(self, q: Array, v: Array, t: Number) -> Number:
        """L."""
        return evaluate(self.system.lagrangian, self._point(q, v, t))

    def momentum(self, q: Array, v: Array, t: Number) -> Array:
        """(m,) dL/dv."""
        return _values(self.p, self._point(q, v, t))

    def velocity(self, q: Array, p: Array, t: Number, digits: int) -> Array:
        """(m,) velocities of momentum p, found from rest."""

        def linearised(v: Array) -> Solve:
            return solver(_matrix(self.mass, self._point(q, v, t), {}, self.dimension))

        rest = np.array([mp.zero] * self.dimension, dtype=object)
        return newton(lambda v: self.momentum(q, v, t) - p, linearised, rest, digits)

    def residual(self, q: Array, v: Array, t: Number, a: Array) -> Array:
        """(m,) Euler-Lagrange residual."""
        return _values(self.E, self._point(q, v, t, a))

    def slopes(self, q: Array, v: Array, t: Number, a: Array) -> Floats:
        """(3, m, m) derivatives of the residual by position, velocity and acceleration."""
        point, known = self._point(q, v, t, a), dict[Any, Any]()
        return np.array([_matrix(entries, point, known, self.dimension) for entries in self.slopes_of_E])


def _values(expressions: tuple[sympy.Expr, ...], point: dict[sympy.Symbol, Number]) -> Array:
    known: dict[sympy.Expr, Number] = {}
    return np.array([evaluate(expression, point, known) for expression in expressions], dtype=object)


def _matrix(entries: Entries, point: dict[sympy.Symbol, Number], known: dict[Any, Any], size: int) -> Floats:
    matrix = np.zeros((size, size))
    for place, entry in entries.items():
        matrix[place] = float(evaluate(entry, point, known))
    return matrix
