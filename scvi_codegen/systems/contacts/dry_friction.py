"""Dry friction that forces state by a jump along a slip, as ``-mu*m*g*sign(x_dot)``.

Let the forces f(q, v, t, s) contain the step s of a slip w = T(q, t) v + b(q, t), 0 where w < 0 and 1 where w > 0. If

    f(s = 1) - f(s = 0) = -2 F T^T,     F(q, v, t) > 0,

motions may slide on w = 0 with the forces (f(1) + f(0))/2 + T^T tau, |tau| <= F (A. F. Filippov, *Differential
Equations with Discontinuous Righthand Sides*, 1988). That is friction of the limit F without a gap; jumps along other
directions, and friction that would supply energy, stay as they are.
"""

from __future__ import annotations

import re
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from scvi_codegen.systems.contact import Friction
from scvi_codegen.systems.formulas.expressions import parts_of_type
from scvi_codegen.systems.lagrangian import LagrangianSystem

if TYPE_CHECKING:
    from collections.abc import Sequence

    from sympy import Expr, Symbol

STEPS = re.compile(r"\b(sign|[aA]bs|where|unit_step|Heaviside|Piecewise|[mM]in|[mM]ax)\b")
"""Functions of formulas that consist of steps."""


def with_dry_friction(system: Any) -> Any:
    """Return the system with contacts in place of the dry friction in its forces; itself if there is none."""
    is_smooth = system._text is not None and not STEPS.search(system._text)
    if is_smooth or not isinstance(system, LagrangianSystem) or system.clock or system.gauge != 0 or system.rotations:
        return system
    from scvi_codegen.systems.formulas.kinks import switching_function, unit_step

    slips = {switching_function(step.args[0])[0] for step in parts_of_type(unit_step, *system.forces)}
    forces, contacts = system.forces, []
    for slip in sorted(slips, key=str):
        direction = [slip.diff(rate) for rate in system.velocities]
        is_linear = any(direction) and not any(row.free_symbols & {*system.velocities} for row in direction)
        if is_linear:
            pushes, others = zip(*(_divided(force, slip) for force in forces), strict=True)
            if limit := _limit(system, slip, direction, pushes):
                forces = others
                contacts.append(Friction(slip, limit))
    return replace(system, forces=forces, contacts=(*system.contacts, *contacts)) if contacts else system


def _divided(force: Expr, slip: Expr) -> tuple[Expr, Expr]:
    """Return the factor of sign(w) in a force, and its other terms; abs(w) = w sign(w) may be in both."""
    from sympy import Add, Dummy, Mul, S

    from scvi_codegen.systems.formulas.kinks import sign, switching_function, unit_step

    side, push, other = Dummy("sign"), S.Zero, S.Zero
    steps = {part: switching_function(part.args[0]) for part in force.atoms(unit_step)}
    own = {part: (1 + orientation * side) / 2 for part, (u, orientation) in steps.items() if u == slip}
    for term in Add.make_args(force.xreplace(own)):
        slope = term.diff(side)
        if not slope.has(side):
            push, other = push + slope, other + term.xreplace({side: S.Zero})
        elif side in Mul.make_args(term):
            push += term / side
        else:
            other += term
    return push.xreplace({side: sign(slip)}), other.xreplace({side: sign(slip)})


def _limit(system: LagrangianSystem, slip: Expr, direction: Sequence[Expr], pushes: Sequence[Expr]) -> Expr | None:
    """Return F of forces -F T^T sign(w) if they are so, with one positive F at w = 0; else ``None``."""
    from sympy import S, simplify, solve

    from scvi_codegen.systems.formulas.kinks import switching_function, unit_step

    limit = next(-push / row for push, row in zip(pushes, direction, strict=True) if row)
    if any(simplify(push + limit * row) for push, row in zip(pushes, direction, strict=True)):
        return None
    velocity: Symbol = next(rate for rate, row in zip(system.velocities, direction, strict=True) if row)
    at_rest = {velocity: solve(slip, velocity)[0]}
    own = [part for part in limit.atoms(unit_step) if switching_function(part.args[0])[0] == slip]
    above, below = (limit.xreplace(dict.fromkeys(own, side)).subs(at_rest) for side in (S.One, S.Zero))
    value = above.subs(dict(zip(system.parameters, system.defaults, strict=True)))
    is_continuous, is_positive = simplify(above - below) == 0, value.free_symbols or value > 0
    return limit if is_continuous and is_positive and above != 0 else None
