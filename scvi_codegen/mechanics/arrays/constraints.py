"""Constraints of array systems: g(array entries at e, parameters, t) = 0 for every element e of loops.

    m q'' = F + G^T lambda,        g(q, t) = 0,        G = g_q,        hidden constraint G v + g_t = 0

with a multiplier lambda for every element. Rods between nodes ``bonds[b, 0]`` and ``bonds[b, 1]`` of a net are
``sum(k in 3, (r[bonds[b, 0], k] - r[bonds[b, 1], k])**2) = l[b]**2 for b in B``. Each constraint contains few entries,
so G M^-1 G^T is sparse; its pattern is that of the net and is known when a run begins.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence

from sympy import Add, Expr, S, Symbol

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.formulas.arrays import ArrayTerm
from scvi_codegen.formulas.canonical import unsupported_part
from scvi_codegen.formulas.derivatives import gradient
from scvi_codegen.indices import Access, Array

__all__ = [
    "check_constraint",
    "constraint_force_terms",
    "constraint_gradient",
    "constraint_second_rate",
    "constraint_text",
    "coordinate_accesses",
]


def constraint_text(term: ArrayTerm) -> str:
    """Return the constraint as text."""
    return f"{term.formula} = 0" + (f" for {', '.join(map(str, _named(term)))}" if term.loops else "")


def _named(term: ArrayTerm) -> Iterator[object]:
    behind = {loop.behind for loop in term.loops}
    return (loop for loop in term.loops if loop.index not in behind)


def check_constraint(term: ArrayTerm, coordinates: Sequence[Array], fields: Sequence[Array], inputs: str) -> None:
    """Raise :class:`SystemDefinitionError` unless a constraint contains coordinates, and neither velocities nor inputs.

    Args:
        term: the constraint.
        coordinates, fields: arrays that it may contain.
        inputs: regular expression that matches the symbols of inputs.
    """
    shown = constraint_text(term)
    if problem := unsupported_part(term.formula):
        raise SystemDefinitionError(f"in the constraint '{shown}': {problem}")
    if moving := {access.array for _, access in term.slots} - {*coordinates, *fields}:
        name = min(array.name for array in moving)
        raise SystemDefinitionError(
            f"the constraint '{shown}' contains the velocity {name}: constraints of array systems "
            "must be holonomic (coordinates and time only)"
        )
    if not coordinate_accesses(term, coordinates):
        raise SystemDefinitionError(
            f"the constraint '{shown}' contains no coordinate: remove it, or write the condition in terms "
            "of the coordinates"
        )
    if inputs and any(re.fullmatch(inputs, each.name) for each in term.formula.free_symbols):
        raise SystemDefinitionError(
            f"the constraint '{shown}' depends on an input, which may be discontinuous: use a "
            "parameter or a formula in t instead"
        )


def coordinate_accesses(term: ArrayTerm, coordinates: Sequence[Array]) -> tuple[tuple[Symbol, Access], ...]:
    """Return the coordinate accesses of a constraint, with their symbols."""
    return tuple(pair for pair in term.slots if pair[1].array in coordinates)


def constraint_gradient(term: ArrayTerm, coordinates: Sequence[Array], time: Symbol) -> tuple[Expr, ...]:
    """Return the row of G of one element, by its coordinates, followed by g_t."""
    variables = [*(slot for slot, _ in coordinate_accesses(term, coordinates)), time]
    derivatives = gradient(term.formula, variables)
    return tuple(derivatives.get(k, S.Zero) for k in range(len(variables)))


def constraint_force_terms(
    term: ArrayTerm, coordinates: Sequence[Array], time: Symbol
) -> tuple[tuple[Access, Expr], ...]:
    """Return G^T of one element: each coordinate access with its factor of the multiplier."""
    derivatives = constraint_gradient(term, coordinates, time)
    return tuple((access, derivatives[k]) for k, (_, access) in enumerate(coordinate_accesses(term, coordinates)))


def constraint_second_rate(
    term: ArrayTerm, coordinates: Sequence[Array], time: Symbol, velocities: Sequence[Symbol]
) -> Expr:
    """Return d^2 g / dt^2 at zero acceleration: v^T g_qq v + 2 g_qt v + g_tt."""
    variables = [*(slot for slot, _ in coordinate_accesses(term, coordinates)), time]
    rates = [*velocities, S.One]
    rate = Add(*(derivative * rates[k] for k, derivative in gradient(term.formula, variables).items()))
    return Add(*(derivative * rates[k] for k, derivative in gradient(rate, variables).items()))
