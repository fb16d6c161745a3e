"""Vectorised values of formulas, and the forces of term groups at many points or at one point in 60 digits."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from sympy import Expr, Symbol

from scvi_codegen.formulas.tape import Tape, evaluate
from scvi_codegen.mechanics.symmetry.bodies import Body
from scvi_codegen.mechanics.term_groups import TermGroup
from scvi_codegen.tables.precision import Number, mp

LARGEST = 10**300
"""Bound below which numbers can be converted to binary64."""
FEW = 12
"""Number of bodies per term group that :func:`terms_among_few_bodies` selects."""


def terms_among_few_bodies(term_groups: Sequence[TermGroup], bodies: Sequence[Body]) -> tuple[TermGroup, ...]:
    """Return the terms among the first few bodies: what the system conserves, so does this system of few bodies."""
    body_of = {index: number for number, body in enumerate(bodies) for index in body.columns}
    chosen = dict[int, None]()
    for term_group in term_groups:
        met = dict.fromkeys(body_of.get(index, -1 - index) for row in term_group.places for index in row)
        chosen |= dict.fromkeys(list(met)[:FEW])
    return tuple(
        term_group.where([all(body_of.get(index, -1 - index) in chosen for index in row) for row in term_group.places])
        for term_group in term_groups
    )


def array_forces(
    term_groups: Sequence[TermGroup], coordinates: Sequence[Symbol], known: Mapping[Any, Any], count: int
) -> Sequence[Any]:
    """Return the force on each coordinate at ``count`` points; ``known`` has coordinates, parameters and time there."""
    if not term_groups:
        return [0.0] * len(coordinates)
    q, force = np.array([known[each] for each in coordinates]), np.zeros((len(coordinates), count))
    for term_group in term_groups:
        indices, values = np.array(term_group.places, dtype=int).reshape(-1, len(term_group.slots)), dict(known)
        values |= {slot: q[indices[:, k]] for k, slot in enumerate(term_group.slots)}
        for symbol, column in zip(term_group.constants, term_group.values, strict=True):
            values[symbol] = np.array([known[x] if x in known else np.full(count, float(x)) for x in column])
        for k, derivative in enumerate(term_group.partials):
            np.add.at(force, indices[:, k], array_value(derivative, values) + np.zeros((len(indices), count)))
    return list(force)


def exact_forces(
    term_groups: Sequence[TermGroup], coordinates: Sequence[Symbol], known: Mapping[Any, Number]
) -> list[Number]:
    """Return the force on each coordinate at one point, in 60 digits."""
    force: list[Number] = [mp.zero] * len(coordinates)
    for term_group in term_groups:
        shared_symbols = [symbol for symbol in known if symbol not in coordinates]
        tape = Tape(term_group.partials, (*term_group.slots, *term_group.constants, *shared_symbols))
        shared, numbers = [known[symbol] for symbol in shared_symbols], dict[Expr, Number]()
        for row, *constants in zip(term_group.places, *term_group.values, strict=True):
            for x in constants:
                numbers.setdefault(x, known[x] if x in known else evaluate(x, {}))
            derivatives = tape(
                [*(known[coordinates[index]] for index in row), *(numbers[x] for x in constants), *shared]
            )
            for index, force_term in zip(row, derivatives, strict=True):
                force[index] += force_term
    return force


def array_value(expression: Any, known: dict[Any, Any]) -> Any:
    """Return the values of an expression, NaN where undefined; ``known`` has its symbols and caches subexpressions."""
    if expression not in known:
        known[expression] = _array_node(expression, known)
    return known[expression]


def _array_node(expression: Any, known: dict[Any, Any]) -> Any:
    if not expression.args:
        return float(expression) if not expression.is_Rational or abs(expression) < LARGEST else np.nan
    arguments = [array_value(argument, known) for argument in expression.args]
    if expression.is_Add:
        return functools.reduce(np.add, arguments)
    if expression.is_Mul:
        return functools.reduce(np.multiply, arguments)
    if expression.is_Pow:
        return np.power(arguments[0], float(arguments[1]) if expression.exp.is_Number else arguments[1])
    name = type(expression).__name__
    return getattr(np, f"arc{name[1:]}" if name.startswith("a") else name)(*arguments)
