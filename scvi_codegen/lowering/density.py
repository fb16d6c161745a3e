"""The density of steps: what a monitor g lets them be long by, as a quantity with an equation of motion of its own.

With dt = g dtau and rho = 1/g, drho/dtau = -d(log g)/dt along the motion. Leapfrog steps of rho, explicit, between
those of a symmetric method make one that is symmetric as a whole, on (q, p, rho), whatever the system: it may depend on
time, and forces may act. Source: E. Hairer, G. Soederlind, SIAM J. Sci. Comput. 26 (2005), section 2.
"""

from __future__ import annotations

import sympy
from sympy import Expr

from scvi_codegen.formulas.derivatives import gradient
from scvi_codegen.ir.control import Control
from scvi_codegen.lowering.kernels import system_kernel
from scvi_codegen.mechanics.forms import forms_of
from scvi_codegen.mechanics.monitors import monitor_function
from scvi_codegen.mechanics.system import MechanicalSystem

__all__ = ["density_of"]


def density_of(system: MechanicalSystem, monitor: str | Expr) -> Control:
    """Steps that a monitor of the system chooses.

    Args:
        system: what moves, in time as it is.
        monitor: as of :func:`~scvi_codegen.mechanics.monitors.monitor_function`, in the time, too.

    Raises:
        SystemDefinitionError: for a monitor that is none.
    """
    g = monitor_function(system, monitor, in_time=True)
    forms = forms_of(system)
    rates = dict(zip(system.coordinates, forms.legendre if system.auxiliaries else system.velocities, strict=True))
    if system.auxiliaries:
        rates |= dict(zip(system.auxiliaries, forms.thrust, strict=True))
    rates[system.time] = sympy.S.One
    variables = list(rates)
    change = sympy.Add(*(slope * rates[variables[i]] for i, slope in gradient(g, variables).items()))
    kernel = system_kernel(
        system,
        "density",
        (1 / g, -change / g),
        of=forms.legendre_arguments,
        purpose=f"1/g and -d(log g)/dt of the monitor g at u = {'(q, p)' if system.auxiliaries else '(q, v)'}.",
    )
    return Control(density=kernel)
