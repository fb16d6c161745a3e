"""Dry friction that forces state by a jump along a slip, as ``-mu*m*g*sign(x_dot)``.

Let the forces f(q, v, t, s) contain the step s of a slip w = T(q, t) v + b(q, t), 0 where w < 0 and 1 where w > 0. If

    f(s = 1) - f(s = 0) = -2 F T^T,     F(q, v, t) > 0,

motions may slide on w = 0 with the forces (f(1) + f(0))/2 + T^T tau, abs(tau) <= F (A. F. Filippov, *Differential
Equations with Discontinuous Righthand Sides*, 1988). That is friction of the limit F without a gap, as are in space
forces -F T^T w/sqrt(w_1^2 + w_2^2) of two slips. Jumps along other directions, and forces
that may supply energy, stay as they are.
"""

from __future__ import annotations

import json
import random
import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING, Any

from scvi_codegen.common.precision import mp
from scvi_codegen.common.validation import OfRunTimeSizes
from scvi_codegen.systems.contact import MOST_ROWS, Friction

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from sympy import Expr, Symbol

    from scvi_codegen.systems.lagrangian import LagrangianSystem

STEPS = re.compile(
    r"\b(sign|sqrt|[aA]bs|where|unit_step|positive_part|Heaviside|Piecewise|[mM]in|[mM]ax|acot)\b|\*\*\s*[-(.\d]*[.(/]"
)
"""Functions of formulas that consist of steps, and powers that may be the length of a slip, or its inverse."""
STATES = 192
"""Random states at which a limit must not be negative: one that is so at 5 % of them is missed once in 20,000."""


def with_dry_friction(system: Any) -> Any:
    """Return the system with contacts in place of the dry friction in its forces; itself if there is none."""
    from scvi_codegen.systems.lagrangian import LagrangianSystem

    if not isinstance(system, LagrangianSystem) or isinstance(system, OfRunTimeSizes) or _is_smooth(system):
        return system
    if _lacks_friction(system):
        return system
    forces, contacts = system.forces, []
    for slip, divided in _slips(system):
        if isinstance(found := _friction_of(system, slip, divided, forces), tuple):
            limit, forces = found
            contacts.append(Friction(slip if len(slip) > 1 else slip[0], limit))
    whole = (*system.contacts, *contacts)
    if not contacts or sum(item.rows for item in whole) > MOST_ROWS:
        return system
    return replace(system, forces=forces, contacts=whole)


def violated_conditions(system: Any) -> dict[Expr, str]:
    """Return why forces that jump where a slip vanishes are no dry friction, by slip; empty if they are.

    Those of methods without contacts, and of more than these may have, stay forces although they are.
    """
    from scvi_codegen.systems.lagrangian import LagrangianSystem

    if not isinstance(system, LagrangianSystem) or isinstance(system, OfRunTimeSizes) or _lacks_friction(system):
        return {}
    found = {slip: _friction_of(system, slip, divided, system.forces) for slip, divided in _slips(system)}
    return {slip[0]: of if isinstance(of, str) else "" for slip, of in found.items() if len(slip) == 1}


def _lacks_friction(system: LagrangianSystem) -> bool:
    """Return whether forces of a system never become contacts."""
    return bool(system.clock or system.gauge != 0 or system.rotations or system.bath is not None)


def _friction_of(
    system: LagrangianSystem, slip: Sequence[Expr], divided: Callable[[Expr], tuple[Expr, Expr]], forces: Sequence[Expr]
) -> tuple[Expr, tuple[Expr, ...]] | str:
    """Return the limit F of the friction of a slip, and the other forces, or the condition that the forces violate."""
    from sympy import S

    moving, rates = [part.free_symbols for part in slip], {*system.velocities}
    directions = [
        [part.diff(rate) if rate in names else S.Zero for rate in system.velocities]
        for part, names in zip(slip, moving, strict=True)
    ]
    if not all(map(any, directions)):
        return "it contains no velocity"
    if any(row.free_symbols & rates for row in chain(*directions)):
        return "it is not linear in the velocities"
    pushes, others = zip(*map(divided, forces), strict=True)
    limit = _limit(system, slip, directions, pushes)
    return limit if isinstance(limit, str) else (limit, others)


def _is_smooth(system: LagrangianSystem) -> bool:
    """Return whether the forces of a system from text have no steps; reads no formulas."""
    if system._text is None:
        return not system.forces
    arguments = json.loads(system._text)[1]
    return not STEPS.search(f"{arguments.get('forces')} {arguments.get('dissipation')}")


def _slips(system: LagrangianSystem) -> Iterator[tuple[tuple[Expr, ...], Callable[[Expr], tuple[Expr, Expr]]]]:
    """Yield the slips of steps and of inverse lengths in forces, and what divides a force by sign(w) or 1/abs(w)."""
    from sympy import Pow, Rational

    from scvi_codegen.systems.formulas.expressions import parts_of_type
    from scvi_codegen.systems.formulas.kinks import switching_function, unit_step

    steps = {switching_function(step.args[0])[0] for step in parts_of_type(unit_step, *system.forces)}
    for slip in sorted(steps, key=str):
        yield (slip,), partial(_divided, slip=slip)
    for length in sorted(parts_of_type(Pow, *system.forces), key=str):
        squares = length.base.args if length.exp == Rational(-1, 2) and length.base.is_Add else ()
        if len(squares) == 2 and all(square.is_Pow and square.exp == 2 for square in squares):
            yield tuple(square.base for square in squares), partial(_divided_by_length, inverse=length)


def _divided_by_length(force: Expr, inverse: Expr) -> tuple[Expr, Expr]:
    """Return the factor of 1/abs(w) in a force, and the other terms."""
    from sympy import Dummy, S

    marked = force.xreplace({inverse: (factor := Dummy("inverse"))})
    push = marked.diff(factor)
    return push.xreplace({factor: inverse}), marked.xreplace({factor: S.Zero})


def _divided(force: Expr, slip: Expr) -> tuple[Expr, Expr]:
    """Return the factor of sign(w) in a force, and its other terms; abs(w) = w sign(w) may be in both."""
    from sympy import Add, Dummy, Mul, Pow, S

    from scvi_codegen.systems.formulas.kinks import sign, switching_function, unit_step

    side, push, other = Dummy("sign"), S.Zero, S.Zero
    steps = {part: switching_function(part.args[0]) for part in force.atoms(unit_step)}
    own = {part: (1 + orientation * side) / 2 for part, (u, orientation) in steps.items() if u == slip}
    if not own:
        return push, force
    sided = force.xreplace(own)
    odd = {part: side ** (part.exp % 2) for part in sided.atoms(Pow) if part.base == side and part.exp.is_Integer}
    for term in Add.make_args(sided.xreplace(odd)):
        slope = term.diff(side)
        if not slope.has(side):
            push, other = push + slope, other + term.xreplace({side: S.Zero})
        elif side in Mul.make_args(term):
            push += term / side
        else:
            other += term
    return push.xreplace({side: sign(slip)}), other.xreplace({side: sign(slip)})


def _limit(
    system: LagrangianSystem, slip: Sequence[Expr], directions: Sequence[Sequence[Expr]], pushes: Sequence[Expr]
) -> Expr | str:
    """Return F of forces -F T^T w/abs(w) if they are so, with one F >= 0 for the default parameters; else why not."""
    from sympy import Add, S

    from scvi_codegen.systems.formulas.kinks import switching_function, unit_step

    along = slip if len(slip) > 1 else (S.One,)
    rows = [Add(*(row * w for row, w in zip(column, along, strict=True))) for column in zip(*directions, strict=True)]
    limit = next(_quotient(-push, row) for push, row in zip(pushes, rows, strict=True) if row)
    for coordinate, push, row in zip(system.coordinates, pushes, rows, strict=True):
        if not _vanishes(push + limit * row):
            return f"the force on {coordinate} jumps otherwise than by -2*F*d(slip)/d({coordinate}_dot), F = {limit}"
    at_rest: list[tuple[Expr, Expr]] = []
    for component in slip:  # linear: one rate of each, by the others
        part = component.subs(at_rest)
        rates = [(rate, row) for rate in system.velocities if rate in part.free_symbols and (row := part.diff(rate))]
        at_rest += [(rate, rate - part / row) for rate, row in rates[:1]]
    own = [part for part in limit.atoms(unit_step) if switching_function(part.args[0])[0] in slip]
    resting = dict.fromkeys(slip, S.Zero)
    above, below = (limit.xreplace(dict.fromkeys(own, side) | resting).subs(at_rest) for side in (S.One, S.Zero))
    if above == 0 or not _vanishes(above - below):
        return f"F = {limit} is 0 at rest, or depends on the motion before"
    return limit if _is_nowhere_negative(limit, system.constants) else f"F = {limit} is negative at some states"


def _quotient(numerator: Expr, denominator: Expr) -> Expr:
    """Return a quotient without common factors; functions stay as written: exp(-u**2) is not 1/exp(u**2)."""
    from sympy import Dummy, Function, cancel

    quotient = numerator / denominator
    written = {part: Dummy() for part in quotient.atoms(Function)}
    return cancel(quotient.xreplace(written)).xreplace({mark: part for part, mark in written.items()})


def _is_nowhere_negative(limit: Expr, constants: Mapping[Symbol, float]) -> bool:
    """Return whether a limit is so by its formula, or at random states of sizes from .01 to 100."""
    from scvi_codegen.systems.formulas.expressions import Tape

    value = limit.subs(constants)
    if value.is_nonnegative is not None:
        return bool(value.is_nonnegative)
    symbols, random_ = sorted(limit.free_symbols, key=str), random.Random(20250101)
    tape, examined = Tape([limit], symbols), 0
    for k in range(STATES):
        with suppress(ArithmeticError):  # outside the domain of the formula
            size = 100.0 ** (1.0 - k % 3)
            state = [constants.get(symbol, size * random_.uniform(-1.0, 1.0)) for symbol in symbols]
            if tape(list(map(mp.mpf, state)))[0] < 0:
                return False
            examined += 1
    return examined > 0


def _vanishes(expression: Expr) -> bool:
    from sympy import simplify

    return bool(expression == 0 or expression.expand() == 0 or simplify(expression) == 0)
