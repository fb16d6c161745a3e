"""Vectorised values of formulas, and the forces of term groups at many points or at one point in 60 digits."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from sympy import Expr, Symbol

from scvi_codegen.formulas.tape import Tape, evaluate
from scvi_codegen.mechanics.rolled import RolledTerms
from scvi_codegen.mechanics.symmetry.bodies import Body
from scvi_codegen.tables.precision import Number, mp

__all__ = ["LARGEST", "among_few", "array_pulls", "array_value", "exact_pulls"]

LARGEST = 10**300
"""Bound below which numbers can be converted to binary64."""
FEW = 12
"""Number of bodies per term group that :func:`among_few` selects."""


def among_few(families: Sequence[RolledTerms], bodies: Sequence[Body]) -> tuple[RolledTerms, ...]:
    """Return the terms among the first few bodies: what the system conserves, so does this system of few bodies."""
    own = {place: number for number, body in enumerate(bodies) for place in body.columns}
    chosen = dict[int, None]()
    for family in families:
        met = dict.fromkeys(own.get(place, -1 - place) for row in family.places for place in row)
        chosen |= dict.fromkeys(list(met)[:FEW])
    return tuple(
        family.where([all(own.get(place, -1 - place) in chosen for place in row) for row in family.places])
        for family in families
    )


def array_pulls(
    families: Sequence[RolledTerms], coordinates: Sequence[Symbol], known: Mapping[Any, Any], count: int
) -> Sequence[Any]:
    """Return the force on each coordinate at ``count`` points; ``known`` has coordinates, parameters and time there."""
    if not families:
        return [0.0] * len(coordinates)
    q, force = np.array([known[each] for each in coordinates]), np.zeros((len(coordinates), count))
    for family in families:
        places, values = np.array(family.places, dtype=int).reshape(-1, len(family.slots)), dict(known)
        values |= {slot: q[places[:, k]] for k, slot in enumerate(family.slots)}
        for symbol, column in zip(family.given, family.values, strict=True):
            values[symbol] = np.array([known[x] if x in known else np.full(count, float(x)) for x in column])
        for k, slope in enumerate(family.slopes):
            np.add.at(force, places[:, k], array_value(slope, values) + np.zeros((len(places), count)))
    return list(force)


def exact_pulls(
    families: Sequence[RolledTerms], coordinates: Sequence[Symbol], known: Mapping[Any, Number]
) -> list[Number]:
    """Return the force on each coordinate at one point, in 60 digits."""
    force: list[Number] = [mp.zero] * len(coordinates)
    for family in families:
        beside = [symbol for symbol in known if symbol not in coordinates]
        tape = Tape(family.slopes, (*family.slots, *family.given, *beside))
        shared, numbers = [known[symbol] for symbol in beside], dict[Expr, Number]()
        for row, *given in zip(family.places, *family.values, strict=True):
            for x in given:
                numbers.setdefault(x, known[x] if x in known else evaluate(x, {}))
            found = tape([*(known[coordinates[place]] for place in row), *(numbers[x] for x in given), *shared])
            for place, pull in zip(row, found, strict=True):
                force[place] += pull
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
