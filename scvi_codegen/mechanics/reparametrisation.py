"""Time transformation (Poincare): a fixed step size in fictitious time tau, a varying one in t, and a symplectic map.

With dt = g dtau, g > 0 (:mod:`scvi_codegen.mechanics.time_rescaling`), Poincare's transformation K = g (H - E) of an
autonomous Hamiltonian has the same orbits on the energy surface K = 0, that is H = E, parametrised by tau. If g
depends on the coordinates only, its Lagrangian is

    L^(q, q') = g(q) (L(q, q'/g(q)) + E),                                       p = dL^/dq' = dL/dv unchanged,

which is regular wherever L is. Every method and solver applies to it; E is a parameter, the energy of the initial
state. Time is the integral of g along the curve, computed by the method's own quadrature.

Sources: S. Reich, SIAM J. Numer. Anal. 36 (1999); E. Hairer, Appl. Numer. Math. 25 (1997); V. Duruisseaux, J. Schmitt,
M. Leok, SIAM J. Sci. Comput. 43 (2021), where the singular p_t direction of K = g (H + p_t) rules a Lagrangian out;
with p_t = -E constant it does not.

Alternatively g may leave the system unchanged and control the step sizes of its runs: see
:func:`with_time_transformation`.
"""

from __future__ import annotations

from dataclasses import replace

import sympy
from sympy import Expr, Symbol

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.formulas.symbols import symbol
from scvi_codegen.formulas.writing import format_expression
from scvi_codegen.mechanics.constraints import nonholonomic_expressions
from scvi_codegen.mechanics.hamiltonian import HamiltonianSystem
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.mechanics.system import SYSTEM, MechanicalSystem, TimeTransformation
from scvi_codegen.mechanics.time_rescaling import time_rescaling_function
from scvi_codegen.validation.argument_types import checks_arguments

__all__ = ["CONTROLLERS", "reparametrise", "with_time_transformation"]

CONTROLLERS = ("symplectic", "reversible")
"""Uses of a time-rescaling function: transform the time of a system, or control the step sizes of its runs."""

ENERGY_NAMES = ("E", "E_0", "energy", "initial_energy")
"""Candidate names of the energy parameter; the first that is unused is taken."""
REVERSIBLE = 'the reversible controller: compile_stepper(time_transformation=...), controller = "reversible" in [run]'


@checks_arguments(system=SYSTEM)
def reparametrise(system: MechanicalSystem, time_transformation: str | Expr) -> MechanicalSystem:
    """Return the system in a fictitious time tau with dt = g dtau; holonomic constraints are unchanged.

    Args:
        system: an autonomous Lagrangian or Hamiltonian system.
        time_transformation: g > 0, as text or expression in the coordinates (for a Hamiltonian also in the momenta), or
            ``"frequency"``, ``"distance"``, ``"potential"``, ``"arclength"``.

    Returns:
        A system of the same kind with one more parameter, the energy, and a ``clock``, the rate dt/dtau = g.

    Raises:
        SystemDefinitionError: if the system depends on time, has forces, damping or nonholonomic constraints, or is
            transformed already, and for an invalid ``time_transformation``.

    >>> kepler = LagrangianSystem.from_text(
    ...     name="Kepler", coordinates=["r", "phi"], lagrangian="(r_dot**2 + r**2*phi_dot**2)/2 + 1/r")
    >>> expected = LagrangianSystem.from_text(
    ...     name="expected", coordinates=["r", "phi"], parameters={"E": 0},
    ...     lagrangian="r_dot**2/(2*r) + r*phi_dot**2/2 + 1 + E*r")
    >>> sympy.simplify(reparametrise(kepler, "r").lagrangian - expected.lagrangian)
    0
    """
    if system.clock is not None:
        raise SystemDefinitionError(
            f"'{system.name}' has a time transformation already, dt = {system.clock.rate} dtau: apply only one"
        )
    if system.depends_on_time:
        raise SystemDefinitionError(
            f"'{system.name}' depends on time, so its energy is not conserved, which the symplectic "
            f"time transformation requires. Use adaptive steps (t_end=...), or {REVERSIBLE}"
        )
    if system.forces or system.damping != 0:
        cause = "forces act" if system.forces else "damping acts"
        raise SystemDefinitionError(
            f"{cause} on '{system.name}', so its energy is not conserved, which the symplectic time "
            f"transformation requires. Use adaptive steps (t_end=...), or {REVERSIBLE}"
        )
    if any(nonholonomic_expressions(system)):
        raise SystemDefinitionError(
            f"'{system.name}' has nonholonomic constraints, which a symplectic time transformation "
            f"does not support. Use adaptive steps (t_end=...), or {REVERSIBLE}"
        )
    energy_symbol = _free_symbol(system)
    rate = time_rescaling_function(system, time_transformation)
    named = replace(
        system,
        name=f"{system.name} in transformed time",
        parameters=(*system.parameters, energy_symbol),
        defaults=(*system.defaults, 0.0),
        clock=TimeTransformation(
            rate=rate,
            energy=energy_symbol,
            time_transformation=time_transformation
            if isinstance(time_transformation, str)
            else format_expression(rate),
            plain=system,
        ),
    )
    if isinstance(named, HamiltonianSystem):
        return replace(named, hamiltonian=_distributed(rate, named.hamiltonian - energy_symbol))
    assert isinstance(named, LagrangianSystem)
    slowed = named.lagrangian.xreplace({v: v / rate for v in named.velocities})
    return replace(named, lagrangian=_distributed(rate, slowed + energy_symbol))


def with_time_transformation(
    system: MechanicalSystem, g: str | Expr | None, controller: str | None = None
) -> tuple[MechanicalSystem, str | Expr | None]:
    """Return the system to integrate under a time transformation, and the ``time_transformation`` for its stepper.

    Args:
        system: the mechanical system.
        g: rate of dt = g dtau, or ``None`` for no time transformation.
        controller: ``"symplectic"`` (also ``None``): the system in transformed time, :func:`reparametrise`;
            ``"reversible"``: unchanged, for ``compile_stepper(..., time_transformation=...)``. Source of the names:
            E. Hairer, Ch. Lubich, G. Wanner, *Geometric Numerical Integration*, VIII.2 and VIII.3.

    Raises:
        SystemDefinitionError: for a controller without a time transformation, an unknown controller, and as
            :func:`reparametrise`.
    """
    if controller is not None and controller not in CONTROLLERS:
        raise SystemDefinitionError(f"controller must be {' or '.join(CONTROLLERS)}, not {controller!r}")
    if g is None:
        if controller is not None:
            raise SystemDefinitionError(
                f'the {controller} controller requires a time transformation: give "frequency", or a formula'
            )
        return system, None
    if controller != "reversible":
        return reparametrise(system, g), None
    if system.clock is not None:
        raise SystemDefinitionError(
            f"'{system.name}' has a time transformation already, which controls its steps: leave out "
            "the reversible controller, or use the system without the transformation"
        )
    time_rescaling_function(system, g, in_time=True)  # validated here rather than at the first step
    return system, g


def _distributed(factor: Expr, total: Expr) -> Expr:
    """Return factor * total with the factor multiplied into every term, so that its powers combine."""
    return sympy.Add(*(factor * term for term in sympy.Add.make_args(total)))


def _free_symbol(system: MechanicalSystem) -> Symbol:
    taken = {symbol.name for symbol in (*system.coordinates, *system.auxiliaries, *system.parameters)}
    return symbol(next(name for name in ENERGY_NAMES if name not in taken))
