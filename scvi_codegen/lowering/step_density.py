"""Step density of a time transformation g, integrated by an equation of motion of its own.

With dt = g dtau and rho = 1/g, drho/dtau = -d(log g)/dt along the motion. Explicit leapfrog steps of rho between the
steps of a symmetric method give a method that is symmetric on (q, p, rho), for any system, also time-dependent or
forced. Source: E. Hairer, G. Soederlind, SIAM J. Sci. Comput. 26 (2005), section 2.
"""

from __future__ import annotations

import sympy
from sympy import Expr

from scvi_codegen.formulas.derivatives import gradient
from scvi_codegen.ir.control import Control
from scvi_codegen.lowering.kernels import system_kernel
from scvi_codegen.mechanics.derived_expressions import forms_of
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.mechanics.time_rescaling import time_rescaling_function

__all__ = ["density_of"]


def density_of(system: MechanicalSystem, g: str | Expr) -> Control:
    """Return the step density of a time-rescaling function of the system.

    Args:
        system: in physical time.
        g: as in :func:`~scvi_codegen.mechanics.time_rescaling.time_rescaling_function`, or of time.

    Raises:
        SystemDefinitionError: for an invalid time-rescaling function.
    """
    rate = time_rescaling_function(system, g, in_time=True)
    forms = forms_of(system)
    rates = dict(zip(system.coordinates, forms.legendre if system.auxiliaries else system.velocities, strict=True))
    if system.auxiliaries:
        rates |= dict(zip(system.auxiliaries, forms.momentum_rate, strict=True))
    rates[system.time] = sympy.S.One
    variables = list(rates)
    change = sympy.Add(*(derivative * rates[variables[i]] for i, derivative in gradient(rate, variables).items()))
    kernel = system_kernel(
        system,
        "density",
        (1 / rate, -change / rate),
        of=forms.legendre_arguments,
        purpose=f"1/g and -d(log g)/dt of the time rescaling g at u = {'(q, p)' if system.auxiliaries else '(q, v)'}.",
    )
    return Control(density=kernel)
