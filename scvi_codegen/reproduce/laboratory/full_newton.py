"""Newton's method on the derived equations of a step, in Python: slow, and independent of the C solvers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
import sympy
from numpy.typing import NDArray

from scvi_codegen.derivation.equations import StepEquations, derive
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.methods.method import Method
from scvi_codegen.reproduce.laboratory.running import SECTION_3

__all__ = ["newton_counts"]

Array = NDArray[np.float64]
Function: TypeAlias = Callable[[Array, Sequence[float]], Array]
"""Function of the unknowns and of (q_k, p_k, h)."""


def newton_counts(
    system: LagrangianSystem, method: Method, q: Sequence[float], p: Sequence[float], *, h: float, steps: int
) -> list[int]:
    """Return the iterations of every step: new Jacobian at every iterate, straight-line guess, until |dQ| < 1e-14.

    For systems of unit masses without explicit time (velocity = momentum), and methods that end in Q^s. The end
    momentum, a sum of large terms, is excluded from the criterion: its rounding alone is of the size of the tolerance.
    """
    derived = derive(system, method)
    equations = sympy.Matrix([equation.residual for equation in derived.equations])
    residual, jacobian_function = _function(derived, equations), _function(derived, sympy.Matrix(derived.jacobian))
    end = _function(derived, sympy.Matrix([equation.residual for equation in derived.end_momentum]))
    line = _function(derived, sympy.Matrix([derived.initial_guess[unknown] for unknown in derived.unknowns]))
    position, momentum, counts = np.array(q, dtype=float), np.array(p, dtype=float), []
    for _ in range(steps):
        state = (*position, *momentum, h)
        unknowns = line(np.zeros(len(derived.unknowns)), state).ravel()
        unknowns, count = _solved(unknowns, state, residual, jacobian_function)
        position, momentum = unknowns[-system.dimension :], end(unknowns, state).ravel()
        counts.append(count)
    return counts


def _function(derived: StepEquations, expression: sympy.Matrix) -> Function:
    q, p = derived.state
    values = dict(zip(derived.system.parameters, map(sympy.Float, derived.system.defaults), strict=True))
    values |= {entry.symbol: sympy.Float(str(entry.value), 17) for entry in derived.entries}
    values |= {
        sympy.Symbol(f"{coordinate.name}_dot_k", real=True): momentum
        for coordinate, momentum in zip(derived.system.coordinates, p, strict=True)
    }
    arguments = [*derived.unknowns, *q, *p, derived.step]
    function: Any = sympy.lambdify(arguments, expression.xreplace(values), "numpy", cse=True)
    return lambda unknowns, state: np.array(function(*unknowns, *state), dtype=float)


def _solved(
    unknowns: Array, state: Sequence[float], residual: Function, jacobian_function: Function
) -> tuple[Array, int]:
    """Return the unknowns and the number of updates."""
    count, size = 0, np.inf
    while size >= SECTION_3.tolerance and count < SECTION_3.max_iterations:
        update = np.linalg.solve(jacobian_function(unknowns, state), residual(unknowns, state).ravel())
        unknowns, size, count = unknowns - update, np.abs(update).max(), count + 1
    return unknowns, count
