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
from scvi_codegen.systems.formulas.expressions import gradient_tuple, hessian, jacobian

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
    still, friction = dict.fromkeys(v, sympy.S.Zero), hessian(bath.dissipation, v)
    others = sorted(map(str, bath.temperature.free_symbols - {*system.parameters, system.time}))
    linear = any(slope.xreplace(still) for slope in gradient_tuple(bath.dissipation, v))
    requirements = {
        f"temperature={bath.temperature} depends on '{', '.join(others)}': kT is a formula of parameters, inputs "
        "and t": not others,
        "a temperature requires friction, by which heat is exchanged: give damping= or dissipation=": bath.noise
        or bath.damping
        or friction,
        f"the dissipation {bath.dissipation} must be quadratic in velocities, v^T R(q) v/2, with a temperature": not (
            linear or jacobian([*friction.values()], v)
        ),
        "its masses depend on velocities: a temperature requires a kinetic energy quadratic in velocities": not (
            jacobian([*forms_of(system).mass.values()], v)
        ),
        "its noise depends on velocities: its strengths are formulas of coordinates, parameters and t": not (
            jacobian(bath.noise, v)
        ),
        "it has nonholonomic constraints, for which no invariant measure is known: omit temperature= and noise=": not (
            system.is_rolling
        ),
        "a heat bath with contacts is not available: omit temperature= and noise=": not (
            system.contacts or system.reactions
        ),
        "a heat bath with a time transformation is not available: omit temperature= and noise=": not system.clock,
    }
    if reason := next((reason for reason, holds in requirements.items() if not holds), ""):
        raise SystemDefinitionError(f"'{name}': {reason}")
