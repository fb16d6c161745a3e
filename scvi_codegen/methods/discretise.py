"""Discretisation: the equations of one step for a system and a method."""

from __future__ import annotations

from dataclasses import replace

from scvi_codegen.errors import MethodError
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.constraints import with_constraints
from scvi_codegen.methods.method import Method, check_regular
from scvi_codegen.methods.phase_space import with_auxiliaries
from scvi_codegen.methods.stage_structure import Velocities
from scvi_codegen.methods.stage_system import StageSystem

__all__ = ["discretise", "paper_equations"]


def discretise(system: MechanicalSystem, method: Method) -> StageSystem:
    """Return the compiled equations, with momenta at the points for a Hamiltonian and multipliers for constraints.

    Raises:
        MethodError: for a system that the method does not support.
    """
    stages = method.stage_system(system)
    check_regular(method, system)
    _check_damping(system, method, stages)
    return _completed(system, stages, method.name)


def paper_equations(system: MechanicalSystem, method: Method) -> StageSystem:
    """Return the equations in the paper's notation. Raises as :func:`discretise`."""
    check_regular(method, system)
    return _completed(system, method.paper_form(system), method.name)


def _completed(system: MechanicalSystem, stages: StageSystem, name: str) -> StageSystem:
    """Add auxiliary variables, constraints and damping to the equations."""
    return replace(with_constraints(system, with_auxiliaries(system, stages), name), damping=system.damping)


def _check_damping(system: MechanicalSystem, method: Method, stages: StageSystem) -> None:
    if system.damping != 0 and not isinstance(stages.shape, Velocities):
        raise MethodError(
            f"{method.name} does not support the damping of '{system.name}', which weights L_q and "
            "L_v at quadrature points: use an SVI, or a Runge-Kutta method in phase space. Every "
            'method supports damping as forces, "-gamma*p", but then areas do not shrink by exactly '
            "exp(-gamma h)"
        )
