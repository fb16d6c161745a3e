"""Names of momentum maps: ``angular momentum z``, ``momentum of phi``, ``boost x``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import sympy
from sympy import Expr

from scvi_codegen.mechanics.symmetry.ansatz import (
    Terms,
    bodies_of,
    planes_of,
    rotation_columns,
    total_angular_momentum,
    turn,
)
from scvi_codegen.mechanics.symmetry.bodies import AXES
from scvi_codegen.mechanics.system import MechanicalSystem

NAMED_TERMS = 4


def name_of(system: MechanicalSystem, terms: Terms) -> tuple[str, Expr | int]:
    """Return the name of a momentum map, and the factor (a sign without rotations) with which it has this name."""
    m = system.dimension
    if system.rotations and (named := _rotation_name(system, terms)):
        return named
    turning = {a: x for a, x in terms.items() if len(a.factors) == 2 and a.factors[0] < m <= a.factors[1]}
    shifting = {
        k: {a.factors[0] - m: x for a, x in terms.items() if a.power == k and len(a.factors) == 1 and a.factors[0] >= m}
        for k in (0, 1, 2)
    }
    if turning:
        return _turning_name(system, turning)
    for k, kind in enumerate(("momentum", "boost", "acceleration")):
        if shifting[k]:
            return _shifting_name(system, kind, shifting[k]), -1 if k else 1
    return ("linear" if all(len(a.factors) <= 1 for a in terms) else "quadratic") + " invariant", 1


def _rotation_name(system: MechanicalSystem, terms: Terms) -> tuple[str, Expr] | None:
    """Return the name of an angular momentum of all or one of the rotations and bodies, and the factor for it."""
    for name, known in {**total_angular_momentum(system), **rotation_columns(system)}.items():
        first, value = next(iter(known.items()))
        factor = terms.get(first, sympy.S.Zero) / value
        if factor != 0 and terms == {monomial: factor * x for monomial, x in known.items()}:
            return name, 1 / factor
    return None


def _turning_name(system: MechanicalSystem, turning: Terms) -> tuple[str, int]:
    m, bodies = system.dimension, bodies_of(system)
    for plane in planes_of(bodies):
        rotation = turn(m, bodies, plane)
        axis = f" {AXES[3 - sum(plane)]}" if len(bodies[0].columns) == 3 else ""
        first = turning.get(next(iter(rotation)), sympy.S.Zero)
        if turning == {monomial: first * x for monomial, x in rotation.items()}:
            return f"angular momentum{axis}", -1 if first.could_extract_minus_sign() else 1
    q = [coordinate.name for coordinate in system.coordinates]
    touched = sorted({i % m for a in turning for i in a.factors})
    scaled = [a.factors[0] == a.factors[1] - m for a in turning]
    what = "scaling" if all(scaled) else "linear symmetry" if any(scaled) else "angular momentum"
    return f"{what} of {_listed([q[i] for i in touched])}", 1


def _shifting_name(system: MechanicalSystem, kind: str, shifts: Mapping[int, Expr]) -> str:
    """Return ``momentum of x``, ``linear momentum x`` of all bodies, ``momentum of q1 + q3``; likewise for boosts."""
    bodies, equal = bodies_of(system), set(shifts.values()) == {sympy.S.One}
    if len(bodies) > 1 and equal:
        for k, axis in enumerate(AXES[: len(bodies[0].columns)]):
            if set(shifts) == {body.columns[k] for body in bodies}:
                return f"{'linear momentum' if kind == 'momentum' else kind} {axis}"
    if equal and len(shifts) == system.dimension > 1:
        return f"{kind} of all coordinates"
    terms = [x * system.coordinates[i] for i, x in sorted(shifts.items())]
    return f"{kind} of {_joined([str(term) for term in terms])}"


def _listed(names: Sequence[str]) -> str:
    shown = names if len(names) <= NAMED_TERMS else [*names[: NAMED_TERMS - 1], "...", names[-1]]
    return ", ".join(shown)


def _joined(terms: Sequence[str]) -> str:
    shown = terms if len(terms) <= NAMED_TERMS else [*terms[: NAMED_TERMS - 1], "...", terms[-1]]
    return " + ".join(shown).replace("+ -", "- ")
