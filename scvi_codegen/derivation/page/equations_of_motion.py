"""Definition of the system, its parameters, and the equations of motion."""

from __future__ import annotations

from collections.abc import Iterator

import sympy
from sympy import Symbol

from scvi_codegen.derivation.page.elision import formulas
from scvi_codegen.display.page.blocks import Content, Formula, Paragraph, Section, TableBlock
from scvi_codegen.formulas.derivatives import gradient
from scvi_codegen.mechanics.constraints import with_constraint_forces
from scvi_codegen.mechanics.derived_expressions import forms_of
from scvi_codegen.mechanics.system import MechanicalSystem

__all__ = ["motion_section", "system_section"]


def system_section(system: MechanicalSystem) -> Section:
    """Return the section on the Lagrangian or the Hamiltonian, coordinates and parameters."""
    names = ", ".join(q.name for q in system.coordinates)
    letter, what = ("H", "Hamiltonian") if system.auxiliaries else ("L", "Lagrangian")
    count = f"{system.dimension} coordinate{'s' * (system.dimension > 1)}"
    time = " and time" if system.depends_on_time else ""
    contents: list[Content] = [
        Paragraph(f"The {what} of {count}, {names}{time}:"),
        *formulas([Formula(system.formula, Symbol(letter))], "formula"),
    ]
    if system.forces:
        applied = [Formula(f, Symbol(f"f_{q.name}")) for q, f in zip(system.coordinates, system.forces, strict=True)]
        contents += [
            Paragraph("Generalised forces f; below, L_q means L_q + f:"),
            *formulas(applied, "force"),
        ]
    if system.damping != 0:
        contents += [
            Paragraph(
                "Momenta are damped at one rate, gamma; the points of a quadrature weigh exp(gamma c h) times as much, "
                "and the momentum at the end is divided by exp(gamma h):"
            ),
            *formulas([Formula(system.damping, Symbol("gamma"))], "damping"),
        ]
    if system.constraints:
        contents += [
            Paragraph(
                "Constraints g = 0, with Lagrange multipliers lambda and constraint forces G^T lambda added to L_q; "
                "G is g_q, or g_v for velocity constraints:"
            ),
            *formulas([Formula(g, Symbol(f"g_{k}")) for k, g in enumerate(system.constraints, 1)], "constraint"),
        ]
    if system.parameters:
        rows = tuple((symbol, value) for symbol, value in system.constants.items())
        table = TableBlock(columns=("parameter", "default"), rows=rows, formats={"default": ".17g"}, name="Parameters")
        contents.append(table)
    return Section(name="system", title="The system", contents=tuple(contents))


def motion_section(system: MechanicalSystem) -> Section:
    """Return the section with Hamilton's equations for H, else the Euler-Lagrange equations."""
    if system.auxiliaries:
        contents, title = tuple(_hamilton(system)), "Hamilton's equations"
    else:
        contents, title = tuple(_euler_lagrange(system)), "Euler-Lagrange equations"
    return Section(name="motion", title=title, contents=contents)


def _euler_lagrange(system: MechanicalSystem) -> Iterator[Content]:
    yield Paragraph("The momenta, p = dL/dv:")
    pairs = zip(system.coordinates, forms_of(system).momentum, strict=True)
    yield from formulas([Formula(value, Symbol(f"p_{q.name}")) for q, value in pairs], "momentum formula")
    yield Paragraph(
        "The Euler-Lagrange equations (2), d/dt dL/dv - dL/dq = 0, by the chain rule. They are linear in the "
        "accelerations; neither the derivation nor the C solves for these."
    )
    motion = [-f for f in with_constraint_forces(system, [-residual for residual in forms_of(system).euler_lagrange])]
    yield from formulas([Formula(value, sympy.S.Zero, "2") for value in motion], "equation")


def _hamilton(system: MechanicalSystem) -> Iterator[Content]:
    by_momenta = gradient(system.formula, system.auxiliaries)
    rates = [Formula(by_momenta.get(i, sympy.S.Zero), velocity, "19a") for i, velocity in enumerate(system.velocities)]
    kicks = [
        Formula(force, Symbol(f"{p.name}_dot"), "19b")
        for p, force in zip(system.auxiliaries, forms_of(system).momentum_rate, strict=True)
    ]
    yield Paragraph("Hamilton's equations (19), dq/dt = dH/dp and dp/dt = -dH/dq:")
    yield from formulas(rates, "equation")
    yield from formulas(kicks, "equation")
    yield Paragraph(
        "Methods see the function L = p . v - H of q, v and p (Hamilton's principle in phase space, section 1.1): it "
        "is what L stands for below."
    )
