"""Uniform damping: one rate gamma for all momenta, and a phase area that shrinks by exactly exp(-gamma h) a step.

With damping the motion is that of the action of Caldirola and Kanai,

    delta int e^(gamma t) L dt = 0,      that is      d/dt L_v = L_q - gamma L_v,

whose flow is conformally symplectic: it multiplies dq ^ dp by e^(-gamma t). A step discretises this action as the
method does any other, time counted from where the step begins, and divides the momentum at its end by e^(gamma h): the
points of the quadrature weigh w_n e^(gamma c_n h) in place of w_n. Nothing grows from step to step, the order is that
of the method, masses stay as they are, and the map shrinks areas by e^(-gamma h) and the momentum maps of L likewise,
both to round-off, whatever the step. (A splitting, half of the damping before and half after each step, does so, too,
at order 2.)

Sources: P. Caldirola, Nuovo Cimento 18 (1941); E. Kanai, Prog. Theor. Phys. 3 (1948); R. McLachlan, M. Perlmutter,
Conformal Hamiltonian systems, J. Geom. Phys. 39 (2001); J. E. Marsden, M. West, Acta Numerica 10 (2001), section 1.3.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import sympy
from sympy import Expr, Symbol

from scvi_codegen.errors import SystemDefinitionError

__all__ = ["check_damping", "damping_rate"]


def damping_rate(given: Any, read: Callable[[Any], Expr]) -> Expr:
    """The rate gamma, 0 where none is given."""
    return sympy.S.Zero if given is None else read(given)


def check_damping(name: str, damping: Expr, parameters: Sequence[Symbol]) -> None:
    """Raise :class:`SystemDefinitionError` for a rate of the system of that name that is not a constant of it."""
    others = sorted(free.name for free in damping.free_symbols.difference(parameters))
    if others:
        raise SystemDefinitionError(
            f"the damping {damping} of '{name}' depends on '{others[0]}': it is one rate for all momenta, a number or "
            "a formula of parameters. Write what varies, or differs from momentum to momentum, as forces"
        )
