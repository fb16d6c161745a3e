"""Heat bath of a Lagrangian system: its friction, and the noise that keeps it at a temperature.

With the force -R v of a damping rate (R = gamma M) or of Rayleigh's function D = v^T R v/2,

    dp = (L_q - R v) dt + sqrt(2 kT) R^(1/2) dW + sigma dW',    p = M(q, t) v + A(q, t),

has the invariant measure exp(-H/kT) dq dp for sigma = 0. Steps are O(h/2) Phi_h O(h/2): the step Phi of the system
without friction between two exact steps of the process of p - A at fixed q (docs/theory/forces.md).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import sympy
from sympy import Expr, Symbol

from scvi_codegen.common.errors import SystemDefinitionError, closest
from scvi_codegen.systems.derived_expressions import forms_of
from scvi_codegen.systems.formulas.expressions import gradient_tuple, hessian

FRICTION = ("damping", "dissipation")
"""Arguments of the friction, which is the bath's if there is a temperature."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Bath:
    """Friction and noise that act on momenta between steps.

    Attributes:
        temperature: kT, energy per degree of freedom times 2, a formula of parameters, inputs and time.
        damping: rate gamma of the friction gamma M.
        dissipation: Rayleigh's function D(q, v, t) of further friction, in all coordinates.
        noise: m strengths sigma(q, t) of independent noise, or none.
    """

    temperature: Expr
    damping: Expr
    dissipation: Expr
    noise: tuple[Expr, ...] = ()

    @property
    def symbols(self) -> set[Symbol]:
        """Symbols of its formulas."""
        formulas = self.temperature, self.damping, self.dissipation, *self.noise
        return {symbol for formula in formulas for symbol in formula.free_symbols}


def bath_of(
    formulas: Mapping[str, Any],
    read: Callable[[Any], Expr],
    in_coordinates: Callable[[Expr], Expr],
    variables: tuple[str, ...],
) -> Bath | None:
    """Return the bath of the arguments of ``from_text``, ``None`` without temperature and noise."""
    temperature, noise = formulas.get("temperature"), formulas.get("noise")
    if temperature is None and noise is None:
        return None
    damping, dissipation = (None if temperature is None else formulas.get(name) for name in FRICTION)
    if unknown := [name for name in map(str, noise or ()) if name not in variables]:
        raise SystemDefinitionError(
            f"there is noise on '{unknown[0]}', which is not a coordinate{closest(unknown[0], variables)}"
        )
    strengths = {str(name): in_coordinates(read(sigma)) for name, sigma in (noise or {}).items()}
    return Bath(
        temperature=sympy.S.Zero if temperature is None else read(temperature),
        damping=sympy.S.Zero if damping is None else read(damping),
        dissipation=sympy.S.Zero if dissipation is None else in_coordinates(read(dissipation)),
        noise=tuple(strengths.get(name, sympy.S.Zero) for name in variables) if strengths else (),
    )


def friction_without_bath(formulas: Mapping[str, Any]) -> tuple[Any, Any]:
    """Return damping and dissipation of the equations of motion: none if they are the friction of a bath."""
    damping, dissipation = map(formulas.get, FRICTION)
    return (damping, dissipation) if formulas.get("temperature") is None else (None, None)


def check_bath(system: Any) -> None:
    """Raise :class:`SystemDefinitionError` if the process at fixed positions is none of Ornstein and Uhlenbeck."""
    bath, v, name = system.bath, system.velocities, system.name
    if bath is None:
        return
    constants, still = {*system.parameters, system.time}, dict.fromkeys(v, sympy.S.Zero)
    friction, reason = hessian(bath.dissipation, v), ""
    if others := sorted(free.name for free in bath.temperature.free_symbols - constants):
        reason = f"temperature={bath.temperature} depends on '{others[0]}': kT is a formula of parameters, inputs and t"
    elif not bath.noise and bath.damping == 0 and not friction:
        reason = "a temperature requires friction, by which heat is exchanged: give damping= or dissipation="
    elif any(slope.xreplace(still) != 0 for slope in gradient_tuple(bath.dissipation, v)) or any(
        entry.free_symbols & {*v} for entry in friction.values()
    ):
        reason = f"the dissipation {bath.dissipation} must be quadratic in velocities, v^T R(q) v/2, with a temperature"
    elif any(entry.free_symbols & {*v} for entry in forms_of(system).mass.values()):
        reason = "its masses depend on velocities: a temperature requires a kinetic energy quadratic in velocities"
    elif any(sigma.free_symbols & {*v} for sigma in bath.noise):
        reason = "its noise depends on velocities: its strengths are formulas of coordinates, parameters and t"
    elif system.is_rolling:
        reason = (
            "it has nonholonomic constraints, for which no invariant measure is known: omit temperature= and noise="
        )
    elif system.contacts or system.reactions or system.clock:
        kind = "a time transformation" if system.clock else "contacts"
        reason = f"a heat bath with {kind} is not available: omit temperature= and noise="
    if reason:
        raise SystemDefinitionError(f"'{name}': {reason}")
