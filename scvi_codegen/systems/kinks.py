"""Kinks as modes: a step goes on with the formula of one side, and a search of its curve locates the other.

A function ``unit_step(u)`` of a system, of which positive_part, abs, sign, min, max and where consist, becomes
``unit_step(u + mode)`` with a parameter of the step, 0 by default: the sign of u decides, at each point of the curve.
Runs that locate the zeros of u set it to +-2^1000, so that all points of a step are on one side (hybrid systems with
located transitions, E. Hairer & G. Wanner, Solving Ordinary Differential Equations I, II.6; E. Eich-Soellner &
C. Fuehrer, Numerical Methods in Multibody Dynamics, 6).
"""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import fields
from typing import TYPE_CHECKING, Any

from scvi_codegen.systems.event import Kink
from scvi_codegen.systems.formulas.expressions import parts_of_type
from scvi_codegen.systems.formulas.intermediates import parts
from scvi_codegen.systems.formulas.kinks import Mode, switching_function, unit_step

if TYPE_CHECKING:
    from sympy import Expr

    from scvi_codegen.systems.system import MechanicalSystem

MOST_KINKS = 256
"""Largest number of switching functions that every step is searched for."""
FORMULAS = ("lagrangian", "hamiltonian", "forces")
"""Fields of systems with the formulas of their motion."""


def located_kinks(system: MechanicalSystem) -> tuple[MechanicalSystem, tuple[Kink, ...]]:
    """Return the system with a mode for each of its switching functions, and these; itself if it has none.

    Systems in transformed time, and with more than ``MOST_KINKS`` switching functions, stay as they are.
    """
    owned = [field.name for field in fields(system) if field.name in FORMULAS]
    formulas = [formula for name in owned for formula in _formulas(getattr(system, name))]
    steps = sorted(parts_of_type(unit_step, *formulas), key=str)
    one_sided = _one_sided(formulas)
    located = [step for step in steps if _moves(step, system) and step not in one_sided]
    arguments = {switching_function(step.args[0])[0] for step in located}
    if not arguments or len(arguments) > MOST_KINKS or system.clock:
        return system, ()
    taken = {free.name for formula in formulas for free in formula.free_symbols}
    taken |= {variable.name for variable in (*system.coordinates, *system.velocities, *system.parameters)}
    numbers = (k for k in range(1, 10**6) if f"mode_{k}" not in taken)
    modes = {u: Mode(f"mode_{k}", real=True) for u, k in zip(sorted(arguments, key=str), numbers, strict=False)}
    rules: dict[Expr, Expr] = {}
    for step in steps:
        u, sign = switching_function(step.args[0])
        if u in modes:
            rules[step] = unit_step(step.args[0] + sign * modes[u])
    with_modes = copy.copy(system)  # not made anew, as it would be checked again
    changes: dict[str, Any] = {name: _replaced(getattr(system, name), rules) for name in owned}
    changes["parameters"] = (*system.parameters, *modes.values())
    changes["defaults"] = (*system.defaults, *(0.0 for _ in modes))
    for name, value in (changes | {"_key": None, "_text": None}).items():
        object.__setattr__(with_modes, name, value)
    functions = {mode.name: system.text_of(u.xreplace(rules)) for u, mode in modes.items()}  # u may contain kinks, too
    return with_modes, tuple(Kink(function, mode=mode) for mode, function in functions.items())


def _formulas(value: Any) -> tuple[Expr, ...]:
    return value if isinstance(value, tuple) else (value,)


def _replaced(value: Any, rules: dict[Expr, Expr]) -> Any:
    return tuple(_replaced(formula, rules) for formula in value) if isinstance(value, tuple) else value.xreplace(rules)


def _moves(step: Expr, system: MechanicalSystem) -> bool:
    """Return whether the argument of a step varies along motions."""
    return not step.free_symbols.issubset(system.parameters)


def _one_sided(formulas: Iterable[Expr]) -> set[Expr]:
    """Return steps whose formulas may be undefined on the other side.

    They are in the base of a power that is not whole, or in the argument of a root, logarithm or inverse function.
    """
    domains = [part for part in parts(*formulas) if isinstance(part, _domains()) and not _is_whole_power(part)]
    return parts_of_type(unit_step, *domains)


def _domains() -> tuple[type, ...]:
    import sympy

    return sympy.Pow, sympy.log, sympy.asin, sympy.acos, sympy.acosh, sympy.atanh


def _is_whole_power(part: Any) -> bool:
    return bool(part.is_Pow and part.exp.is_Integer and part.exp > 0)
