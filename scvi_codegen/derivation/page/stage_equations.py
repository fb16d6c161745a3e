"""Definition of the system, its parameters, and the equations of motion.

Equations of a step: in compact form with sums, and component by component if they are short.
"""

from collections.abc import Iterator
from itertools import groupby

import sympy
from sympy import Symbol

from scvi_codegen.derivation.equations import StepEquations, derive
from scvi_codegen.derivation.notation import Equation
from scvi_codegen.derivation.page.sums import end_formulas, gather_formulas, meaning, row_formulas
from scvi_codegen.display.page.blocks import Content, Formula, Paragraph, Section, TableBlock, formulas, operations
from scvi_codegen.formulas.expressions import gradient_tuple
from scvi_codegen.mechanics.derived_expressions import forms_of
from scvi_codegen.mechanics.forces import with_constraint_forces
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.method import Method
from scvi_codegen.methods.stage_system import StageGroup, StageSystem


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
        contents += [Paragraph("Generalised forces f; below, L_q means L_q + f:"), *formulas(applied, "force")]
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
    by_momenta = gradient_tuple(system.formula, system.auxiliaries)
    rates = [Formula(rate, velocity, "19a") for rate, velocity in zip(by_momenta, system.velocities, strict=True)]
    kicks = [
        Formula(force, Symbol(f"{p.name}_dot"), "19b")
        for p, force in zip(system.auxiliaries, forms_of(system).momentum_rate, strict=True)
    ]
    yield Paragraph("Hamilton's equations (19), dq/dt = dH/dp and dp/dt = -dH/dq:")
    yield from formulas(rates, "equation")
    yield from formulas(kicks, "equation")
    yield Paragraph(
        "Methods see the function L = p . v - H of q, v and p (Hamilton's principle in phase space, section 1.1): it "
        "is denoted by L below."
    )


MOST_OPERATIONS = 6000
"""Approximate largest number of operations of all equations shown component by component."""
FAMILIES = {
    "quadrature": "At the quadrature points tau_n",
    "node": "At the nodes",
    "stage": "At the stages",
    "start": "At the start of the step",
    "end": "At its end",
    "kick": "At the kicks",
    "drift": "In the drifts",
}


def stage_section(system: MechanicalSystem, stages: StageSystem) -> Section:
    """Return the section on unknowns, arguments of kernels, and all equations but those with p_k."""
    return Section(
        name="stages",
        title="Stage equations",
        contents=(
            Paragraph(_unknowns(system, stages)),
            *stage_group_contents(system, stages),
            *_rows(system, stages, {"stage", "multiplier", "Legendre"}),
        ),
    )


def idel_section(system: MechanicalSystem, stages: StageSystem) -> Section:
    """Return the section on the implicit discrete Euler-Lagrange equations (5) and the end of the step."""
    rows = list(_rows(system, stages, {"IDEL"}))
    text = (
        "The equations that relate the momenta p_k and p_(k+1) to the curve, (5): p_k is known, p_(k+1) "
        "follows from the last one."
        if rows
        else "The end of the step:"
    )
    return Section(
        name="idel",
        title="Implicit discrete Euler-Lagrange equations",
        contents=(Paragraph(text), *rows, *end_formulas(system, stages)),
    )


def stage_group_contents(system: MechanicalSystem, stages: StageSystem) -> Iterator[Content]:
    """Yield the arguments of each stage group, and the names of its results."""
    meanings: dict[str, None] = {}
    for group in stages.stage_groups:
        gathered = list(gather_formulas(system, stages, group))
        if gathered:
            yield Paragraph(f"{_place(group)}:")
            yield from gathered
        meanings[meaning(group)] = None
    yield Paragraph(f"{'; '.join(meanings)}.")


def component_equations(system: MechanicalSystem, method: Method, stages: StageSystem) -> StepEquations | None:
    """Return the equations component by component, ``None`` if they would be too long."""
    points = sum(
        len(group.abscissae) * sum(1 + operations(result) for result in group.results) for group in stages.stage_groups
    )
    return derive(system, method) if points * len(stages.rows) <= MOST_OPERATIONS else None


def component_equations_section(derived: StepEquations | None) -> Section:
    """Return the section with all equations component by component."""
    title, name = "Written out", "written-out"
    if derived is None:
        text = (
            "By components, the equations of this system and method have many thousand operations: they are omitted "
            "here. The command scvi-codegen derive without --html prints them."
        )
        return Section(name=name, title=title, contents=(Paragraph(text),))
    contents: list[Content] = [
        Paragraph("The same equations by components, with positions and velocities substituted, not simplified:")
    ]
    for _, group in groupby(derived.equations, key=lambda equation: equation.kind):
        contents += formulas([_formula(equation) for equation in group], "equation", together=MOST_OPERATIONS)
    q, p = derived.state
    ends = zip((*q, *p), (*derived.end_position, *derived.end_momentum), strict=True)
    contents += formulas(
        [Formula(e.residual, Symbol(f"{symbol.name.lstrip('_')}+1"), e.number) for symbol, e in ends],
        "end value",
        together=MOST_OPERATIONS,
    )
    contents.append(Paragraph("Newton's method starts from uniform motion with the velocity that corresponds to p_k:"))
    contents += formulas([Formula(value, symbol) for symbol, value in derived.initial_guess.items()], "first value")
    return Section(name=name, title=title, contents=tuple(contents))


def _rows(system: MechanicalSystem, stages: StageSystem, kinds: set[str]) -> Iterator[Formula]:
    return (formula for row, formula in row_formulas(system, stages) if row.kind in kinds)


def _unknowns(system: MechanicalSystem, stages: StageSystem) -> str:
    groups = groupby(stages.blocks, key=lambda block: block.name.rpartition("_")[0])
    names = []
    for _, blocks in groups:
        members = [block.name.replace("_", "^") if block.name[0] in "QVP" else block.name for block in blocks]
        names.append(", ".join(members if len(members) < 4 else (members[0], "..", members[-1])))
    sizes = [system.dimension if block.size is None else block.size for block in stages.blocks]
    size = sum(sizes)
    each = f", each of them {sizes[0]} numbers" if sizes[0] > 1 and len(set(sizes)) == 1 else ""
    return f"Unknown are {', '.join(names)}{each}: {size} in all. Known are q_k, p_k, t_k and h."


def _place(group: StageGroup) -> str:
    first = group.name.partition("_")[0]
    named = FAMILIES.get(first, f"At the points of '{group.name}'")
    return named if len(group.abscissae) == 1 else f"{named}, {len(group.abscissae)} of them"


def _formula(equation: Equation) -> Formula:
    return Formula(equation.residual, sympy.S.Zero, equation.number)
