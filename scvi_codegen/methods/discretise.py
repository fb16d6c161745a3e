"""System and method to the equations of one step."""

from __future__ import annotations

from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.constraints import with_constraints
from scvi_codegen.methods.method import Method, check_regular
from scvi_codegen.methods.phase_space import with_auxiliaries
from scvi_codegen.methods.stage_system import StageSystem

__all__ = ["discretise", "paper_equations"]


def discretise(system: MechanicalSystem, method: Method) -> StageSystem:
    """The equations as compiled, with momenta at the points where a Hamiltonian is given, multipliers for constraints.

    Raises:
        MethodError: for a system that the method does not serve.
    """
    stages = method.stage_system(system)
    check_regular(method, system)
    return with_constraints(system, with_auxiliaries(system, stages), method.name)


def paper_equations(system: MechanicalSystem, method: Method) -> StageSystem:
    """The same equations as the paper prints them. Raises as :func:`discretise`."""
    check_regular(method, system)
    return with_constraints(system, with_auxiliaries(system, method.paper_form(system)), method.name)
