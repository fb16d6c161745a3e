"""Reversible controller: the step density rho = 1/g of a time transformation dt = g dtau has an equation of its own.

It is drho/dtau = -d(log g)/dt along the motion. Explicit leapfrog steps of rho between the steps of a symmetric method
give a method that is symmetric on (q, p, rho), for any system, also time-dependent or forced. Source: E. Hairer,
G. Soederlind, SIAM J. Sci. Comput. 26 (2005), section 2.
"""

import sympy
from sympy import Expr

from scvi_codegen.methods.controllers.controller import Controller
from scvi_codegen.systems.derived_expressions import forms_of
from scvi_codegen.systems.formulas.expressions import derivative_along
from scvi_codegen.systems.system import MechanicalSystem
from scvi_codegen.systems.time_transformation import time_rescaling_function

__all__ = ["REVERSIBLE"]


def density_and_growth(system: MechanicalSystem, g: str | Expr) -> tuple[Expr, ...]:
    """Return 1/g and -d(log g)/dt along the motion of a system in physical time; SystemDefinitionError for other g."""
    rate = time_rescaling_function(system, g, in_time=True)
    forms = forms_of(system)
    rates = dict(zip(system.coordinates, forms.legendre if system.auxiliaries else system.velocities, strict=True))
    if system.auxiliaries:
        rates |= dict(zip(system.auxiliaries, forms.momentum_rate, strict=True))
    rates[system.time] = sympy.S.One
    change = derivative_along(rate, list(rates), list(rates.values()))
    return 1 / rate, -change / rate


REVERSIBLE = Controller(
    summary="equal steps of tau in any system (default of compiled time transformations)",
    code='#include "support/step_size/density.h"\n',
    memory=(
        ("density", "step density, in the middle of the last step; 0 before the first"),
        ("part", "fraction of a whole step that the last one was: less than 1 if it ended at t_end"),
    ),
    values=density_and_growth,
)
