"""Nonlinear program for IPOPT: named unknowns, their bounds, constraints and cost."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from scvi_codegen.runtime.core.validation import Array

__all__ = ["NonlinearProgram"]

QUIET = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False}
"""Options that suppress the output of IPOPT."""


@dataclass(frozen=True)
class NonlinearProgram:
    """Unknowns and constraints as symbols and expressions of CasADi, each a matrix.

    Attributes:
        ca: module ``casadi``.
        unknowns: symbols by name.
        limits: least and largest values of unknowns by name; other unknowns are unbounded.
        constraints: expressions, each with least and largest value.
        cost: expression to minimise.
    """

    ca: Any
    unknowns: dict[str, Any]
    limits: dict[str, tuple[Any, Any]]
    constraints: list[tuple[Any, float, float]]
    cost: Any

    def solved(self, first: Mapping[str, Any], options: Mapping[str, Any]) -> tuple[Any, Mapping[str, Any]]:
        """Solve by IPOPT from initial values by name; return the solution and the solver's statistics."""
        program = {"x": self.x, "f": self.cost, "g": self.residual}
        solver = self.ca.nlpsol("program", "ipopt", program, {**QUIET, **options})
        low, high = (self._vector(self._limits(side)) for side in (0, 1))
        least, largest = (self._spread(side) for side in (1, 2))
        result = solver(x0=self._vector(first), lbx=low, ubx=high, lbg=least, ubg=largest)
        return result, solver.stats()

    def split(self, vector: Any) -> dict[str, Array]:
        """Return the values of the unknowns by name, each in its shape."""
        flat, result, begin = np.asarray(vector).ravel(), {}, 0
        for name, each in self.unknowns.items():
            result[name] = flat[begin : begin + each.numel()].reshape(each.shape, order="F")
            begin += each.numel()
        return result

    @cached_property
    def x(self) -> Any:
        """Vector of all unknowns."""
        return self.ca.veccat(*self.unknowns.values())

    @cached_property
    def residual(self) -> Any:
        """Vector of all constraints."""
        return self.ca.veccat(*(expression for expression, _, _ in self.constraints))

    def _limits(self, side: int) -> dict[str, Any]:
        return {name: self.limits.get(name, (-np.inf, np.inf))[side] for name in self.unknowns}

    def _vector(self, values: Mapping[str, Any]) -> Array:
        parts = [np.broadcast_to(values[name], each.shape).ravel("F") for name, each in self.unknowns.items()]
        return np.concatenate(parts)

    def _spread(self, side: int) -> Array:
        return np.concatenate([np.full(each[0].numel(), each[side]) for each in self.constraints])
