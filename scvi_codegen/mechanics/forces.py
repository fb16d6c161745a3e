"""Forces and damping of a system; the derivations are in docs/theory/forces.md.

**Forces** f, by coordinate or by Rayleigh's function, follow the principle of Lagrange and d'Alembert: d/dt L_v = L_q +
f. For a Hamiltonian they are forces on momenta, p' = -H_q + f(q, p, t).

**Uniform damping** at the rate gamma makes the action of e^(gamma t) L stationary: d/dt L_v = L_q - gamma L_v. The map
of a step contracts areas and momentum maps of L by e^(-gamma h), both to round-off, for any step size.

Constraints: :mod:`scvi_codegen.mechanics.constraints`.

Sources: C. Kane, J. E. Marsden, M. Ortiz, M. West, Int. J. Numer. Meth. Eng. 49 (2000); J. E. Marsden, M. West, Acta
Numerica 10 (2001), sections 1.3 and 3; C. M. Campos, S. Ober-Bloebaum, Math. Model. Numer. Anal. 49 (2015);
P. Caldirola, Nuovo Cimento 18 (1941); E. Kanai, Prog. Theor. Phys. 3 (1948); R. McLachlan, M. Perlmutter, J. Geom.
Phys. 39 (2001).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import sympy
from sympy import Expr, Symbol

from scvi_codegen.errors import SystemDefinitionError, closest
from scvi_codegen.formulas.expressions import gradient
from scvi_codegen.formulas.symbols import name_of_key


def forces_by_coordinate(
    coordinates: Sequence[Symbol], by_name: Mapping[Any, Any], read: Callable[[Any], Expr]
) -> tuple[Expr, ...]:
    """Return the m forces, 0 for coordinates without one; an empty tuple if all are 0.

    Args:
        coordinates: of the system.
        by_name: force by coordinate, which is a symbol or its name.
        read: converts a value to an expression in canonical symbols.

    Raises:
        SystemDefinitionError: for keys that are not coordinates.
    """
    if not isinstance(by_name, Mapping):
        raise SystemDefinitionError(f"forces must be a mapping from coordinates to formulas, not {by_name!r}")
    names = [q.name for q in coordinates]
    forces = {name_of_key(key): value for key, value in by_name.items()}
    for name in forces:
        if name not in names:
            hint = f"{closest(name, names)} Coordinates: {', '.join(names)}"
            raise SystemDefinitionError(f"there is a force on '{name}', which is not a coordinate{hint}")
    ordered = tuple(read(forces[name]) if name in forces else sympy.S.Zero for name in names)
    return ordered if any(f != 0 for f in ordered) else ()


def dissipative_forces(dissipation: Expr, velocities: Sequence[Symbol]) -> tuple[Expr, ...]:
    """Return the forces -dD/dv of Rayleigh's dissipation function D(q, v, t)."""
    derivatives = gradient(dissipation, velocities)
    if not derivatives:
        raise SystemDefinitionError(
            f"the dissipation {dissipation} contains no velocity: Rayleigh's function D(q, v) defines "
            "the forces -dD/dv. Add velocities, or remove it"
        )
    return tuple(-derivatives.get(i, sympy.S.Zero) for i in range(len(velocities)))


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
