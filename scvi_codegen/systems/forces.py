"""Forces and damping of a system; the derivations are in docs/theory/forces.md.

**Forces** f, by coordinate or by Rayleigh's function, follow the principle of Lagrange and d'Alembert: d/dt L_v = L_q +
f. For a Hamiltonian they are forces on momenta, p' = -H_q + f(q, p, t).

**Uniform damping** at the rate gamma makes the action of e^(gamma t) L stationary: d/dt L_v = L_q - gamma L_v. The map
of a step contracts areas and momentum maps of L by e^(-gamma h), both to round-off, for any step size.

Constraints: :mod:`scvi_codegen.systems.constraints`.

Sources: C. Kane, J. E. Marsden, M. Ortiz, M. West, Int. J. Numer. Meth. Eng. 49 (2000); J. E. Marsden, M. West, Acta
Numerica 10 (2001), sections 1.3 and 3; C. M. Campos, S. Ober-Bloebaum, Math. Model. Numer. Anal. 49 (2015);
P. Caldirola, Nuovo Cimento 18 (1941); E. Kanai, Prog. Theor. Phys. 3 (1948); R. McLachlan, M. Perlmutter, J. Geom.
Phys. 39 (2001).
"""

from collections.abc import Callable, Sequence
from typing import Any

import sympy
from sympy import Expr, Symbol

from scvi_codegen.common.errors import SystemDefinitionError


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
