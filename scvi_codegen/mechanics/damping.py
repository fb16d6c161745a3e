"""Uniform damping: one rate gamma for all momenta; each step contracts phase-space area by exactly exp(-gamma h).

The damped equations follow from the action of Caldirola and Kanai,

    delta int e^(gamma t) L dt = 0,      that is      d/dt L_v = L_q - gamma L_v,

whose flow is conformally symplectic: it multiplies dq ^ dp by e^(-gamma t). A step discretises this action like any
other, with time measured from the start of the step, and divides the final momentum by e^(gamma h): the quadrature
weights w_n become w_n e^(gamma c_n h). Nothing grows from step to step, the order is that of the method, masses are
unchanged, and the map contracts areas and momentum maps of L by e^(-gamma h), both to round-off, for any step size.
(A splitting, half of the damping before and half after each step, does so too, at order 2.)

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


def damping_rate(damping: Any, read: Callable[[Any], Expr]) -> Expr:
    """Return the damping rate gamma, 0 if it is ``None``."""
    return sympy.S.Zero if damping is None else read(damping)


def check_damping(name: str, damping: Expr, parameters: Sequence[Symbol]) -> None:
    """Raise :class:`SystemDefinitionError` unless the damping rate depends on parameters only."""
    others = sorted(free.name for free in damping.free_symbols.difference(parameters))
    if others:
        raise SystemDefinitionError(
            f"the damping {damping} of '{name}' depends on '{others[0]}': damping is one rate for all "
            "momenta, a number or a formula of parameters. Write damping that varies, or differs "
            "between momenta, as forces"
        )
