"""Checks of constraint elimination: the motion in the angles of rods is that of the system with constraints."""

from collections.abc import Iterator, Sequence
from functools import partial

import numpy as np
import sympy
from sympy import Expr, Symbol

from scvi_codegen.analysis.verification.certificate import Check, Finding, checked
from scvi_codegen.analysis.verification.system_under_test import MAX_COORDINATES, State
from scvi_codegen.common.errors import StateError
from scvi_codegen.common.precision import mp
from scvi_codegen.common.representation import counted
from scvi_codegen.methods.exact.solution import DIGITS, Numbers, exact_motion, numbers
from scvi_codegen.systems.derived_systems import rate_of
from scvi_codegen.systems.formulas.expressions import Tape, gradient
from scvi_codegen.systems.formulas.symbols import DOT, symbol
from scvi_codegen.systems.system import MechanicalSystem

BOUND = 10.0 ** (5 - DIGITS)
"""Bound on relative differences in 60 digits, of which projections onto constraints of loops leave ``DIGITS``."""


def elimination_checks(system: MechanicalSystem, state: State) -> Iterator[Check]:
    """Yield the comparison of a system in angles of rods with the original one at a state; none for other systems."""
    if getattr(system, "elimination", None) is None:
        return
    statement = "positions satisfy the constraints; accelerations are those with constraints (60 digits)"
    yield from checked("eliminated constraints", statement, partial(_compare, system, state))


def _compare(system: MechanicalSystem, state: State) -> Finding:
    """Return the largest relative difference of accelerations, or the largest g and g_q v relative to the state."""
    elimination = system.elimination  # type: ignore[attr-defined]
    original = elimination.original
    if original.dimension > 2 * MAX_COORDINATES:
        raise StateError(f"{original.dimension} coordinates exceed the limit of {2 * MAX_COORDINATES} in 60 digits")
    motion, with_constraints, t = exact_motion(system), exact_motion(original), mp.mpf(state.t)
    q, p = motion.met(state.q, state.p, t)
    v = motion.velocity(q, p, t)
    a = motion.acceleration(q, v, t)
    x, rate, second = _mapped(system, elimination.positions, np.concatenate([q, v, a]), t)
    expected = with_constraints.acceleration(x, rate, t)
    _, (_, positions, rates) = with_constraints._constraint_terms(x, rate, t)
    sizes = [max(map(abs, each)) or mp.one for each in (x, rate, expected)]
    errors = [
        max(map(abs, error)) / size for error, size in zip((positions, rates, second - expected), sizes, strict=True)
    ]
    return Finding(float(max(errors)), BOUND, counted(len(elimination.rods), "rod"))


def _mapped(system: MechanicalSystem, positions: Sequence[Expr], state: Numbers, t: object) -> Numbers:
    """Return (3, m) original coordinates and their first two derivatives by time."""
    q, v = system.coordinates, system.velocities
    a = [symbol(each.name + DOT) for each in v]
    rates = [rate_of(f, q, system.time) for f in positions]
    variables = (*q, *v, system.time)
    second = [_total(f, variables, (*v, *a, sympy.S.One)) for f in rates]
    tape = Tape([*positions, *rates, *second], [*q, *v, *a, system.time, *system.parameters])
    return np.array(tape([*state, t, *numbers(system.defaults)]), dtype=object).reshape(3, -1)


def _total(function: Expr, variables: Sequence[Symbol], rates: Sequence[Expr]) -> Expr:
    return sympy.Add(*(derivative * rates[k] for k, derivative in gradient(function, variables).items()))
