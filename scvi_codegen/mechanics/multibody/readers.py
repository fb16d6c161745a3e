"""Conversion of ``LagrangesMethod``, ``KanesMethod`` and ``System`` of ``sympy.physics.mechanics``."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING

import sympy
from sympy import Expr
from sympy.physics.mechanics import KanesMethod, dynamicsymbols

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.mechanics.multibody.description import Multibody
from scvi_codegen.mechanics.multibody.kinetics import load_forces
from scvi_codegen.mechanics.multibody.variables import Variables

if TYPE_CHECKING:
    from sympy.physics.mechanics import LagrangesMethod, System


def forces_of_lagranges_method(method: LagrangesMethod) -> dict[Expr, Expr]:
    """Return the generalised forces of its ``forcelist`` by coordinate; its bodies are part of its Lagrangian.

    Raises:
        SystemDefinitionError: if there are loads, but no inertial frame.
    """
    loads = tuple(method.forcelist or ())
    if loads and method.inertial is None:
        raise SystemDefinitionError(
            "this LagrangesMethod has a forcelist, but no inertial frame: create it with frame=..."
        )
    variables = Variables(tuple(method.q), dynamicsymbols._t)
    forces = load_forces(loads, method.inertial, variables)
    return {q: variables.write(f) for q, f in zip(method.q, forces, strict=True) if f != 0}


def of_kanes_method(method: KanesMethod) -> Multibody:
    """Return the bodies and loads of a ``KanesMethod``, whether or not its equations were formed.

    Raises:
        SystemDefinitionError: if it has no bodies or no kinematic equations.
    """
    if not method.bodies:
        raise SystemDefinitionError(
            "this KanesMethod has no bodies, so no kinetic energy: create it with KanesMethod(..., "
            "bodies=..., forcelist=...), or call kanes_equations(bodies, loads) first"
        )
    implicit = copy.copy(method)
    implicit.explicit_kinematics = False  # kinematic equations in implicit form, not solved for the rates
    if not implicit.mass_matrix_kin:
        raise SystemDefinitionError(
            "this KanesMethod has no kinematic equations between speeds and rates: create it with kd_eqs=..."
        )
    rates = method.q.diff(dynamicsymbols._t)
    constraints = method._k_nh * method.u + method._f_nh if method._k_nh else ()  # private; so below
    return Multibody(
        frame=method._inertial,
        time=dynamicsymbols._t,
        coordinates=tuple(method.q),
        speeds=tuple(method.u),
        kinematics=tuple(implicit.mass_matrix_kin * rates - implicit.forcing_kin),
        auxiliary=tuple(method._uaux),
        bodies=tuple(method.bodies),
        loads=tuple((load,) for load in method.loads or ()),
        configuration=tuple(method._f_h),
        velocity=tuple(constraints),
    )


def of_system(system: System) -> Multibody:
    """Return the bodies, joints, loads and actuators of a ``System``, whether or not its equations were formed.

    Potential energies of bodies are included unless its equations were formed by Kane's method, which omits them.
    """
    groups = [tuple(actuator.to_loads()) for actuator in system.actuators]
    return Multibody(
        frame=system.frame,
        time=dynamicsymbols._t,
        coordinates=tuple(system.q),
        speeds=tuple(system.u),
        kinematics=tuple(system.kdes),
        auxiliary=tuple(system.u_aux),
        bodies=tuple(system.bodies),
        loads=(*groups, *((load,) for load in system.loads)),
        potential=_potential(system),
        configuration=tuple(system.holonomic_constraints),
        velocity=tuple(system.velocity_constraints),
    )


def _potential(system: System) -> Expr:
    if isinstance(system.eom_method, KanesMethod):
        return sympy.S.Zero
    return sympy.Add(*(body.potential_energy for body in system.bodies))
