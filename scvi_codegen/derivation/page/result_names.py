"""Symbols of arguments and results of kernels: q_n, L_q at point n, the Euler-Lagrange residual E_n."""

from __future__ import annotations

from sympy import Symbol

from scvi_codegen.lowering.stage_groups import argument_name
from scvi_codegen.mechanics.derived_expressions import forms_of
from scvi_codegen.mechanics.forces import constraint_rates, holonomic_expressions, nonholonomic_expressions
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.stage_system import Gather, Scatter, StageGroup

ARGUMENTS = {"v": "q_dot", "a": "q_ddot", "j": "q_d3", "s": "q_d4"}
"""Time derivatives of the curve as they are typeset."""
PLACES = {"start": "k", "end": "k+1"}
MEANINGS = {
    "L": "L the Lagrangian, whose index says by what it is differentiated",
    "S": "E the Euler-Lagrange residual and S its product with the multipliers, whose index says by what it is "
    "differentiated",
    "E": "E the Euler-Lagrange residual",
    "L_dot": "L with a dot its time derivative along the curve, by what its index says",
}

MULTIPLIED_FORCES = (
    ", without forces f; these add -f to E, f_v lambda to S_v and its time derivative less f_q lambda to S_q, the "
    "adjoint of what they add to E"
)


def point_index(group: StageGroup, point: object = "n") -> str:
    """Return the index of a point of a stage group: n, or k and k + 1 at an end of the step."""
    return PLACES.get(group.name, str(point if len(group.abscissae) > 1 else 1))


def argument_symbol(system: MechanicalSystem, gather: Gather, suffix: str) -> Symbol:
    """Return the symbol of the arguments of a gather at a point."""
    name = argument_name(system, gather)
    return Symbol(f"{ARGUMENTS.get(name, name)}_{suffix}")


def result_symbol(system: MechanicalSystem, group: StageGroup, scatter: Scatter, suffix: str) -> Symbol:
    """Return the symbol of the results of a scatter at a point; for gradients, scatters are parallel to gathers."""
    if system.constraints and scatter.results == holonomic_expressions(system):
        return Symbol(f"g_{suffix}")
    if system.constraints and scatter.results in (nonholonomic_expressions(system), constraint_rates(system)):
        return Symbol(f"g_dot_{suffix}")
    if group.scalar is None:
        forms = forms_of(system)
        known = {forms.force: "L_q", forms.momentum: "L_v", forms.euler_lagrange: "E", forms.constitutive: "L_p"}
        return Symbol(f"{known[scatter.results]}_{suffix}")
    name = argument_name(system, group.gathers[group.scatters.index(scatter)])
    return Symbol(f"E_{suffix}" if name == "lambda" else f"{scalar_name(group)}_{name}_{suffix}")


def scalar_name(group: StageGroup) -> str:
    """Return L, its k-th time derivative along the curve, or S."""
    if group.name == "node":
        return "S"
    return "L" if not group.scalar_power else "L_dot" if group.scalar_power == 1 else f"L_d{group.scalar_power}"


def meaning(group: StageGroup) -> str:
    """Return the meaning of the letter of a stage group's results."""
    if group.scalar is not None:
        name = scalar_name(group)
        return MEANINGS[name[:5]] + (MULTIPLIED_FORCES if name == "S" and group.forced else "")
    return MEANINGS["E"] if group.name == "node" else MEANINGS["L"]
