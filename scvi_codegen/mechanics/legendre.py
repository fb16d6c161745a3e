"""Symbolic Legendre transforms: of quadratic forms by matrix inverses, otherwise variable by variable."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import sympy
from sympy import Expr, Symbol

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.formulas.canonical import unsupported_part
from scvi_codegen.formulas.derivatives import gradient, hessian
from scvi_codegen.formulas.tape import evaluate
from scvi_codegen.mechanics.regularity import coupled_blocks, sample_points
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.tables.precision import mp

__all__ = ["legendre_dual", "positive_parameters"]

LARGEST_INVERSE = 3
"""Largest number of coupled momenta (velocities) whose quadratic form is inverted symbolically."""
NEGLIGIBLE = mp.mpf(10) ** -30


def legendre_dual(system: MechanicalSystem, variables: Sequence[Symbol], duals: Sequence[Symbol]) -> Expr:
    """Return the Legendre transform x . y - f(x), where y = df/dx is solved for x; f is the system's formula."""
    # f = f0 + b . x + x . C x / 2 has the transform (y - b) . C^-1 (y - b) / 2 - f0, block by block.
    f = system.formula
    hessian_entries = hessian(f, variables)
    origin = dict.fromkeys(variables, sympy.S.Zero)
    derivatives = gradient(f, variables)
    if all(not (entry.free_symbols & set(variables)) for entry in hessian_entries.values()):
        shifted = [y - derivatives[i].xreplace(origin) for i, y in enumerate(duals)]
        forms = [
            _inverse_form(hessian_entries, block, shifted) for block in coupled_blocks(hessian_entries, len(variables))
        ]
        return sympy.Add(*forms, -f.xreplace(origin))
    solution = {x: _inverse_derivative(system, derivatives[i], x, duals[i], variables) for i, x in enumerate(variables)}
    still, moving = f.as_independent(*variables, as_Add=True)
    dual = sympy.Add(*(x * y for x, y in zip(solution.values(), duals, strict=True)), -moving.xreplace(solution))
    positive = positive_parameters(system)
    return (
        sympy.simplify(dual.xreplace(positive)).xreplace({dummy: parameter for parameter, dummy in positive.items()})
        - still
    )


def positive_parameters(system: MechanicalSystem) -> dict[Symbol, Symbol]:
    """Return positive dummies for the parameters with positive defaults, so that roots of their squares simplify."""
    return {
        parameter: sympy.Dummy(parameter.name, positive=True)
        for parameter, value in system.constants.items()
        if value > 0
    }


def _inverse_form(hessian_entries: Mapping[tuple[int, int], Expr], block: Sequence[int], y: Sequence[Expr]) -> Expr:
    """Return y . C^-1 y / 2 over one block."""
    if len(block) == 1:
        (i,) = block
        return y[i] ** 2 / (2 * hessian_entries[i, i])
    if len(block) > LARGEST_INVERSE:
        raise SystemDefinitionError(
            f"the Legendre transform couples {len(block)} variables, more than are inverted "
            f"symbolically ({LARGEST_INVERSE}). Define the other function yourself, or use the system "
            "as it is"
        )
    size = len(block)
    matrix = sympy.Matrix(size, size, lambda a, b: hessian_entries.get((block[a], block[b]), 0))
    adjugate, determinant = matrix.adjugate(), matrix.det(method="berkowitz")
    terms = [adjugate[a, b] * y[i] * y[j] for a, i in enumerate(block) for b, j in enumerate(block)]
    return sympy.Add(*terms) / (2 * determinant)


def _inverse_derivative(
    system: MechanicalSystem, derivative: Expr, x: Symbol, y: Symbol, variables: Sequence[Symbol]
) -> Expr:
    """Return the x with y = L_v(x), whose branch is checked at random points near the default parameters."""
    if derivative.free_symbols & (set(variables) - {x}):
        raise SystemDefinitionError(
            f"the Legendre transform of '{system.name}' requires the solution of coupled nonlinear "
            "equations. Define the other function yourself, or use the system as it is"
        )
    positive = positive_parameters(system)
    back = {dummy: symbol for symbol, dummy in positive.items()}
    for root in _roots(derivative.xreplace(positive) - y, x):
        solution = root.xreplace(back)
        if unsupported_part(solution) is None and _is_inverse(system, solution, derivative, x, y):
            return solution
    raise SystemDefinitionError(
        f"SymPy does not solve {y} = {derivative} for {x}, as the Legendre transform requires: define the "
        "other function yourself"
    )


def _roots(expression: Expr, x: Symbol) -> list[Expr]:
    """Return unchecked solutions of SymPy, without the formulas of Cardano and Ferrari, which take minutes."""
    try:
        return list(sympy.solve(expression, x, check=False, simplify=False, cubics=False, quartics=False))
    except (NotImplementedError, ArithmeticError, AttributeError, TypeError, ValueError, RecursionError):
        return []


def _is_inverse(system: MechanicalSystem, root: Expr, derivative: Expr, x: Symbol, y: Symbol) -> bool:
    tried = 0
    for point in sample_points([x], (*system.coordinates, system.time), system.constants):
        try:
            value = evaluate(derivative, point)
            again = evaluate(root, point | {y: value})
        except ArithmeticError:
            continue
        tried += 1
        if abs(again - point[x]) > NEGLIGIBLE * (1 + abs(point[x])):
            return False
    return tried > 0
