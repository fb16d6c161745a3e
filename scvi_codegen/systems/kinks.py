"""Kinks as modes: a step goes on with the formula of one side, and a search of its curve locates the other.

A function ``unit_step(u)`` of a system, of which positive_part, abs, sign, min, max and where consist, becomes
``unit_step(u + mode)`` with a parameter of the step, 0 by default: the sign of u decides, at each point of the curve.
Runs that locate the zeros of u set it to +-2^1000, so that all points of a step are on one side (hybrid systems with
located transitions, E. Hairer & G. Wanner, Solving Ordinary Differential Equations I, II.6; E. Eich-Soellner &
C. Fuehrer, Numerical Methods in Multibody Dynamics, 6).

A whole number changes between even and odd where cos(pi x) is 0, and either formula goes on for half a unit beyond:

    rint(x) = 2 rint(x/2) where cos(pi x) >= 0, else 2 rint((x - 1)/2) + 1
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import fields, replace
from itertools import count, filterfalse
from typing import TYPE_CHECKING, Any

from scvi_codegen.common.errors import MethodError
from scvi_codegen.systems.checks.continuity import MOST_SURFACES, changes_with, jump_message, jumps_of
from scvi_codegen.systems.event import Kink, Refraction
from scvi_codegen.systems.formulas.expressions import parts_of_type
from scvi_codegen.systems.formulas.intermediates import LONGEST_WRITTEN, parts, written_size
from scvi_codegen.systems.formulas.kinks import Mode, by_parity, rint, steps_on_sides, switching_function, unit_step
from scvi_codegen.systems.formulas.tables import without_tables

if TYPE_CHECKING:
    from sympy import Expr

    from scvi_codegen.systems.system import MechanicalSystem

MOST_KINKS = 256
"""Largest number of switching functions that every step is searched for."""
FORMULAS = ("lagrangian", "hamiltonian", "forces", "constraints")
"""Fields of systems with the formulas of their motion."""


def located_kinks(system: MechanicalSystem) -> tuple[MechanicalSystem, tuple[Kink, ...]]:
    """Return the system with a mode for each of its switching functions, and these; itself if it has none.

    Systems in transformed time, and with more than ``MOST_KINKS`` switching functions, stay as they are.
    """
    stated = {field.name: getattr(system, field.name) for field in fields(system) if field.name in FORMULAS}
    parities = _parities([*_flat(stated.values())], system)
    owned = {name: _replaced(value, parities) for name, value in stated.items()}
    formulas = [*_flat(owned.values()), *_flat(reaction.direction for reaction in system.reactions)]  # of friction
    steps = sorted(parts_of_type(unit_step, *formulas), key=str)
    powers = _vanishing_powers(formulas)
    one_sided = _one_sided(formulas, powers)
    located = [step for step in steps if _moves(step, system) and step not in one_sided and _is_written(step)]
    arguments = {switching_function(step.args[0])[0] for step in located}
    if not arguments or len(arguments) > MOST_KINKS or system.clock:
        return system, ()
    taken = {free.name for formula in formulas for free in formula.free_symbols}
    taken |= {variable.name for variable in (*system.coordinates, *system.velocities, *system.parameters)}
    names = filterfalse(taken.__contains__, map("mode_{}".format, count(1)))
    modes = {u: Mode(name, real=True) for u, name in zip(sorted(arguments, key=str), names, strict=False)}
    rules = steps_on_sides(located, modes)
    factors = {power: step for power, step in powers.items() if step in rules}
    rules |= {power: rules[step] * power for power, step in factors.items()}
    jumps, lacks = set(_jumps(system)), _lacks(arguments, system)
    jumps = arguments if jumps and len(arguments) > MOST_SURFACES else jumps
    sides = {switching_function(step.args[0]) for step in factors.values()}
    kinks = tuple(
        (Refraction if u in jumps else Kink)(
            system.text_of(u.xreplace(rules)),
            mode=mode.name,
            power_sides=tuple(side for side in (-1, 1) if (u, side) in sides),
            held=_held(u, system),
            lacks=lacks.get(u, ""),
        )
        for u, mode in modes.items()
    )
    return _on_sides(system, owned, rules, tuple(modes.values())), kinks


def _on_sides(
    system: MechanicalSystem, stated: Mapping[str, Any], rules: dict[Expr, Expr], modes: tuple[Mode, ...]
) -> MechanicalSystem:
    """Return the system with the formulas of the sides that the values of its modes choose."""
    from scvi_codegen.systems.contacts.modes import mapped

    changes = {name: _replaced(value, rules) for name, value in stated.items()} | {
        "reactions": tuple(replace(r, direction=_replaced(r.direction, rules)) for r in system.reactions),
        "contacts": tuple(mapped(item, lambda part, _: part.xreplace(rules)) for item in system.contacts),
        "parameters": (*system.parameters, *modes),
        "defaults": (*system.defaults, *(0.0 for _ in modes)),
        "_key": None,
        "_text": None,
    }
    with_modes = copy.copy(system)  # not made anew, as it would be checked again
    for name, value in changes.items():
        object.__setattr__(with_modes, name, value)
    return with_modes


def _parities(formulas: Iterable[Expr], system: MechanicalSystem) -> dict[Expr, Expr]:
    """Return each rint(x) by its parity where a formula is not the same function on both sides of a change.

    Images of particles in a periodic box, whose forces end before, have no such change.
    """
    wholes = [part for part in parts_of_type(rint, *formulas) if _moves(part, system)]
    wholes = [part for part in wholes if _is_written(part)]
    if system.lengths or len(wholes) > MOST_KINKS:
        return {}
    moving = {*system.coordinates, *system.velocities, *system.auxiliaries, system.time}
    changing = [n for n in wholes if any(changes_with(n, f, moving, system.constants) for f in formulas)]
    for outer in changing:
        if parts_of_type(rint, outer.args[0]):
            raise MethodError(
                f"'{system.text_of(outer)}' of '{system.name}' contains whole numbers in others, whose changes are not "
                "located: write rint(u + n) with a whole n as rint(u) + n, and other steps with unit_step(..)"
            )
    return {n: by_parity(n.args[0]) for n in changing}


def _jumps(system: MechanicalSystem) -> dict[Expr, Expr]:
    """Return functions u without modes at whose zeros L or H jumps, of the first ``MOST_SURFACES``, and terms."""
    if system.lengths:
        return {}  # lists of neighbours end at a cutoff
    moving = {*system.coordinates, *system.velocities, *system.auxiliaries}
    return dict(jumps_of(without_tables(system.formula), moving, system.constants))


def check_continuity(system: MechanicalSystem) -> None:
    """Raise :class:`MethodError` if L or H jumps at a surface without a mode, where steps do not refract momenta."""
    for jump in _jumps(system).items():
        raise MethodError(jump_message(f"the function of '{system.name}'", *jump))


def _held(u: Expr, system: MechanicalSystem) -> str:
    """Return the sum of the masks of contacts whose gap, its rate or slip is a multiple of u."""
    held: set[str] = set()
    for row, reaction in zip(system.constraints[-len(system.reactions) :], system.reactions, strict=False):
        terms = (row.diff(q) * v for q, v in zip(system.coordinates, system.velocities, strict=True))
        rate = sum(terms, row.diff(system.time))
        held |= {str(reaction.active) for part in (row, rate) if switching_function(part)[0] == u}
    return " + ".join(sorted(held)) or "0"


def _lacks(arguments: Iterable[Expr], system: MechanicalSystem) -> dict[Expr, str]:
    """Return why forces that jump at zeros of functions of velocities are no dry friction."""
    from scvi_codegen.systems.contacts.dry_friction import violated_conditions

    rates = {*getattr(system, "velocities", ())}
    slips = [u for u in arguments if not rates.isdisjoint(u.free_symbols)]
    violated = violated_conditions(system) if slips else {}
    without = "an svi: has no quadrature= with contacts, and at most 192 gaps and slips"
    return {u: violated.get(u, "contacts are not available with this system") or without for u in slips}


def _flat(values: Iterable[Any]) -> Iterator[Expr]:
    """Yield formulas, which are values or parts of such."""
    for value in values:
        yield from value if isinstance(value, tuple) else (value,)


def _replaced(value: Any, rules: dict[Expr, Expr]) -> Any:
    return tuple(_replaced(formula, rules) for formula in value) if isinstance(value, tuple) else value.xreplace(rules)


def _moves(step: Expr, system: MechanicalSystem) -> bool:
    """Return whether the argument of a step varies along motions."""
    return not step.free_symbols.issubset(system.parameters)


def _is_written(step: Expr) -> bool:
    """Return whether runs can store its function as text."""
    return written_size(switching_function(step.args[0])[0]) <= LONGEST_WRITTEN


def _vanishing_powers(formulas: Iterable[Expr]) -> dict[Expr, Expr]:
    """Return powers that are not whole, and the step by which their base is 0 on a side, as positive_part(u)**(5/2).

    There u**(5/2) is undefined: its factor unit_step(u + mode) is that of the side, the base that of the formula.
    """
    powers = [part for part in parts(*formulas) if part.is_Pow and part.exp.is_positive and not part.exp.is_Integer]
    bases = {power: [factor for factor in power.base.args if isinstance(factor, unit_step)] for power in powers}
    return {power: factors[0] for power, factors in bases.items() if power.base.is_Mul and len(factors) == 1}


def _one_sided(formulas: Iterable[Expr], powers: Mapping[Expr, Expr]) -> set[Expr]:
    """Return steps whose formulas may be undefined on the other side.

    They are in the base of a power that is not whole, or in the argument of a root, logarithm or inverse function.
    """
    domains = [part for part in parts(*formulas) if isinstance(part, _domains()) and not _is_whole_power(part)]
    return {step for part in domains for step in parts_of_type(unit_step, part) if step != powers.get(part)}


def _domains() -> tuple[type, ...]:
    import sympy

    return sympy.Pow, sympy.log, sympy.asin, sympy.acos, sympy.acosh, sympy.atanh


def _is_whole_power(part: Any) -> bool:
    return bool(part.is_Pow and part.exp.is_Integer and part.exp > 0)
