"""Sections of the page: system and equations of motion, equations of a step, kernels and functions with their C."""

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import count, groupby, takewhile
from typing import Any

import sympy
from sympy import Function as Applied
from sympy import Symbol

from scvi_codegen.api.formulas import jacobian
from scvi_codegen.api.methods import Discretisation, Method, StageSystem
from scvi_codegen.api.program import Derivation
from scvi_codegen.api.systems import MechanicalSystem, forms_of
from scvi_codegen.api.text import TableBlock, counted
from scvi_codegen.extras.derivation.equations import StepEquations, derive
from scvi_codegen.extras.derivation.notation import contact_lines, events_text, table_entries
from scvi_codegen.extras.derivation.page.drawings import curve_section, jacobian_section, tables_section
from scvi_codegen.extras.derivation.page.sums import end_formulas, gather_formulas, meaning, row_formulas
from scvi_codegen.extras.derivation.writing import (
    MOST_FORMULAS,
    Content,
    Formula,
    Listing,
    Paragraph,
    Section,
    SideBySide,
    formulas,
    lines,
    operations,
    page_template,
    style_sheet,
)
from scvi_codegen.systems.event import Event
from scvi_codegen.version import __version__


def system_section(system: MechanicalSystem) -> Section:
    """Return the section on the Lagrangian or the Hamiltonian, coordinates and parameters."""
    names = ", ".join(q.name for q in system.coordinates)
    letter, title = ("H", "Hamiltonian") if system.auxiliaries else ("L", "Lagrangian")
    count = counted(system.dimension, "coordinate")
    time = " and time" if system.depends_on_time else ""
    contents: list[Content] = [
        Paragraph(f"The {title} of {count}, {names}{time}:"),
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
    if lines := contact_lines(system):
        contents.append(Listing("\n".join(lines)))
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
    motion = [
        -f for f in forms_of(system).with_constraint_forces([-residual for residual in forms_of(system).euler_lagrange])
    ]
    yield from formulas([Formula(value, sympy.S.Zero, "2") for value in motion], "equation")


def _hamilton(system: MechanicalSystem) -> Iterator[Content]:
    by_momenta = jacobian([system.formula], system.auxiliaries)
    rates = [
        Formula(by_momenta.get((0, k), sympy.S.Zero), velocity, "19a") for k, velocity in enumerate(system.velocities)
    ]
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
    text = "The end of the step:"
    if rows:
        text = (
            "The equations that relate the momenta p_k and p_(k+1) to the curve, (5): p_k is known, p_(k+1) "
            "follows from the last one."
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
        contents += formulas(
            [Formula(equation.residual, sympy.S.Zero, equation.number) for equation in group],
            "equation",
            together=MOST_OPERATIONS,
        )
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
    groups = groupby(stages.blocks, key=lambda block: block.letter)
    names = []
    for _, blocks in groups:
        members = [f"{block.letter}^{block.index}" if block.letter in "QVP" else block.name for block in blocks]
        names.append(", ".join(members if len(members) < 4 else (members[0], "..", members[-1])))
    sizes = [system.dimension if block.size is None else block.size for block in stages.blocks]
    size = sum(sizes)
    components = f", each of them {sizes[0]} numbers" if sizes[0] > 1 and len(set(sizes)) == 1 else ""
    return f"Unknown are {', '.join(names)}{components}: {size} in all. Known are q_k, p_k, t_k and h."


def _place(group: Any) -> str:
    first = group.name.partition("_")[0]
    named = FAMILIES.get(first, f"At the points of '{group.name}'")
    return named if len(group.abscissae) == 1 else f"{named}, {len(group.abscissae)} of them"


def derivation_html(system: MechanicalSystem, method: Method, *, events: Sequence[Event] = ()) -> str:
    """Return the derivation of ``method`` for ``system``, with ``events`` of runs, as a self-contained page of HTML."""
    system = Derivation(system, method).in_all_modes
    Discretisation(system, method).check()
    more = [Section(name="events", title="Events", contents=(Listing(events_text(events, system)),))] if events else []
    return page_template("derivation.html.jinja").render(
        title=f"{system.name}: {method.title}",
        body_class="derivation",
        system=system,
        method=method,
        sections=[*_sections(system, method), *more],
        css=style_sheet("page.css", "derivation.css"),
        version=__version__,
    )


def _sections(system: MechanicalSystem, method: Method) -> Iterator[Section]:
    derivation = Derivation(system, method)
    program, functions = derivation.program, derivation.functions
    stages = Discretisation(system, method).paper
    derived = component_equations(system, method, stages)
    yield system_section(system)
    yield motion_section(system)
    yield curve_section(method)
    yield tables_section(method, table_entries(stages, method))
    yield stage_section(system, stages)
    yield idel_section(system, stages)
    yield component_equations_section(derived)
    if texts := derivation.statements:
        yield statements_section(texts)
    yield jacobian_section(system, stages, derived, program)
    yield operations_section(program)
    yield kernels_section(system, program, functions)
    yield functions_section(system, method, program, functions)


def statements_section(texts: Mapping[str, str]) -> Section:
    """Return the section with the statements that the C of a step is generated from."""
    paragraph = Paragraph(
        "The C of a step is generated from these statements, for all coordinates i, constraints k and nonzero "
        "derivatives e of constraints; A @ x[i] is a sum over the points of a step."
    )
    contents: list[Content] = [paragraph]
    for title, text in texts.items():
        contents += Paragraph(f"{title.capitalize()}:"), Listing(text)
    return Section(name="statements", title="Statements", contents=tuple(contents))


COUNTS = re.compile(r" Operations: .*$")


def kernels_of(program: Any) -> tuple[Any, ...]:
    """Return every kernel of the C, each name once."""
    kernels = list(program.kernels)
    if program.fixed_point:
        kernels += program.fixed_point.kernels
        kernels += [program.fixed_point.constant_mass] if program.fixed_point.constant_mass else []
    if program.splitting:
        kernels += program.splitting.kernels
    return tuple({kernel.name: kernel for kernel in kernels}.values())


def operations_section(program: Any) -> Section:
    """Return the section on operations of every kernel before and after sharing of common subexpressions."""
    rows = tuple(
        (
            kernel.name,
            len(kernel.formulas),
            sum(map(operations, kernel.formulas)),
            sum(kernel.operation_counts().values()),
            len(kernel.temporaries),
        )
        for kernel in kernels_of(program)
    )
    columns = ("kernel", "results", "before", "after", "temporaries")
    contents: tuple[Content, ...] = (
        Paragraph(
            "Operations of one evaluation at one point. Before: of the formulas as they were derived, each on its own, "
            "as SymPy counts them. After: of the C, with common parts computed once; a call of a function is one, and "
            "a power such as x^(-3/2) is one call. A kernel of a few formulas may gain nothing: powers are written out "
            "as products there."
        ),
        TableBlock(
            columns=columns, rows=rows, formats=dict.fromkeys(columns[1:], "d"), name="Operations of the kernels"
        ),
    )
    return Section(name="operations", title="Operation counts", contents=contents)


def kernels_section(system: MechanicalSystem, program: Any, functions: Mapping[str, Any]) -> Section:
    """Return the section with one pair per kernel: formulas at the left, C at the right."""
    names = _names(system)
    pairs = tuple(_pair(program, kernel, functions, names) for kernel in kernels_of(program))
    text = (
        "Only the kernels depend on the system: straight-line arithmetic at one point. Those named _lanes "
        "evaluate all points at once."
    )
    return Section(name="kernels", title="The kernels: formulas and C", contents=(Paragraph(text), *pairs))


def _names(system: MechanicalSystem) -> dict[Symbol, Symbol]:
    """Return short symbols for the multipliers: lambda and nu with the name of their coordinate."""
    named = ((forms_of(system).multipliers, "lambda"), (forms_of(system).auxiliary_multipliers, "nu"))
    return {
        symbol: Symbol(f"{letter}_{q.name}")
        for symbols, letter in named
        for symbol, q in zip(symbols, system.coordinates, strict=False)
    }


def kernel_text(functions: Mapping[str, Any], name: str) -> str:
    """Return the C of a kernel; a large one is divided into parts, which it calls in order."""
    parts = takewhile(functions.__contains__, (f"{name}_{k}" for k in count(1)))
    return "\n".join(functions[part].text for part in (*parts, name))


def _pair(program: Any, kernel: Any, functions: Mapping[str, Any], names: Mapping[Symbol, Symbol]) -> SideBySide:
    function = functions[kernel.name]
    values, partials = (
        [
            Formula(formula.xreplace(names) if k < MOST_FORMULAS else formula, Symbol(f"{name}_{k}"))
            for k, formula in enumerate(all_formulas)
        ]
        for name, all_formulas in (
            ("value", kernel.formulas[: kernel.values]),
            ("derivative", kernel.formulas[kernel.values :]),
        )
    )
    left: list[Content] = [Paragraph(COUNTS.sub("", function.comment))] if function.comment else []
    if kernel.uses("u"):
        left.append(Formula(sympy.Tuple(*kernel.symbols).xreplace(names), Symbol("u")))
    if kernel.uses("parameters"):
        left.append(Formula(sympy.Tuple(*map(Symbol, program.layout.parameters)), Symbol("parameters")))
    left += [*formulas(values, "value"), *formulas(partials, "derivative")]
    title = f"{kernel.name}({', '.join(function.arguments)})"
    return SideBySide(title=title, left=tuple(left), right=(lines(kernel_text(functions, kernel.name)),))


OPENED = re.compile(r"\w+_advance|solve|fixed_point|newton|evaluate")
"""Functions that are unfolded: the loop over the steps, and the solvers of the stages."""
LANE_FUNCTION = re.compile(r"(lanes_)?inverse_root_\d|lanes_\w+")
n, j = Symbol("n", integer=True), Symbol("j", integer=True)
h, q, p, v0, g = (Symbol(name) for name in ("h", "q_k", "p_k", "v_0", "g"))
inverse_mass = Symbol("M__-1")


def functions_section(system: MechanicalSystem, method: Method, program: Any, functions: Mapping[str, Any]) -> Section:
    """Return the section on functions, from the loop over the steps down: formulas or words left, C right."""
    stages = Discretisation(system, method).equations
    kernels = {kernel.name for kernel in kernels_of(program)}
    start = f"{program.prefix}_advance"
    pairs = [
        _function_pair(function, start, _formulas(function.name, system, stages, program))
        for function in reached(functions, start)
        if function.name not in kernels and not LANE_FUNCTION.fullmatch(function.name)
        if function.comment or function.name == start
    ]
    text = (
        "Everything else consists of loops over tables, the same for every system: from the loop over the steps down, "
        "each function once, in the order of the calls. Folded ones can be opened."
    )
    return Section(name="functions", title="The step: what the C does", contents=(Paragraph(text), *pairs))


def reached(functions: Mapping[str, Any], start: str) -> Iterator[Any]:
    """Yield ``start`` and the functions that it calls, directly or not, each once, callers first."""
    done, pending = set[str](), [start]
    while pending:
        if (name := pending.pop()) not in done:
            done.add(name)
            pending.extend(reversed(functions[name].calls))
            yield functions[name]


def _function_pair(function: Any, start: str, all_formulas: Iterator[Content]) -> SideBySide:
    words = function.comment or "The loop over the steps, with compensated sums."
    return SideBySide(
        title=f"{function.name}({', '.join(function.arguments)})",
        left=(Paragraph(words if words.endswith(".") else f"{words}."), *all_formulas),
        right=(lines(function.text),),
        folded=not OPENED.fullmatch(function.name) and function.name != start,
    )


def _formulas(name: str, system: MechanicalSystem, stages: StageSystem, program: Any) -> Iterator[Content]:
    """Yield the equations that a function computes, if any."""
    if name == "evaluate":
        yield Paragraph(
            "The stage equations as they are compiled: unknowns are velocities or accelerations times h in place of "
            "positions, whose differences would lose digits."
        )
        yield from stage_group_contents(system, stages)
        for _, formula in row_formulas(system, stages):
            yield formula
        yield from end_formulas(system, stages)
    elif name == "newton":
        yield from _newton()
    elif name in ("fixed_point", "iterate") and program.fixed_point is not None:
        yield from ITERATIONS[program.fixed_point.name]
    elif name == "gather":
        yield Formula(sympy.Sum(Symbol("table_j_n") * Symbol("z_j"), (j, 1, Symbol("B"))), Symbol("u_n"))


def _newton() -> Iterator[Content]:
    R, J, z, change = Symbol("R"), Symbol("J"), Symbol("z"), Symbol("delta")
    yield Paragraph("R the residuals of evaluate and J their Jacobian, factorised with partial pivoting:")
    yield Formula(R, J * change)
    yield Formula(z - change, Symbol("z_new"))
    yield Paragraph("until the updates of stages and end momentum are below the tolerance, or at round-off level.")


def _sum(coefficient: str, value: sympy.Expr) -> sympy.Expr:
    return sympy.Sum(Symbol(coefficient) * value, (j, 1, g))


_END = Formula(q + h * _sum("b_j", Symbol("V_j")), Symbol("q_k+1"))
_POSITIONS = Formula(q + h * _sum("a_n_j", Symbol("V_j")), Symbol("q_n"))
_VELOCITIES = Formula(v0 + _sum("a_n_j", Symbol("z_j")), Symbol("V_n"))
ITERATIONS: dict[str, tuple[Content, ...]] = {
    "separable": (
        Paragraph("Positions q_n at the points, F the forces L_q, M the constant masses; iterated to convergence:"),
        Formula(q + h * Symbol("c_n") * v0 + h**2 * _sum("a_n_j", inverse_mass * Symbol("F_j")), Symbol("q_n")),
        Formula(q + h * v0 + h**2 * _sum("beta_j", inverse_mass * Symbol("F_j")), Symbol("q_k+1")),
        Formula(p + h * _sum("b_j", Symbol("F_j")), Symbol("p_k+1")),
    ),
    "coupled": (
        Paragraph("Velocities V_n at the points, corrected to convergence; M = L_vv there:"),
        _POSITIONS,
        Formula(p + h * _sum("A_n_j", Symbol("L_q_j")), Symbol("P_n")),
        Formula(Symbol("V_n") + inverse_mass * (Symbol("P_n") - Symbol("L_v_n")), Symbol("V_n_new")),
        Paragraph(
            "If the masses of few coordinates depend on positions, the correction includes its first-order effect on "
            "P_n and L_v. After convergence:"
        ),
        _END,
        Formula(p + h * _sum("B_j", Symbol("L_q_j")), Symbol("p_k+1")),
    ),
    "Hamiltonian": (
        Paragraph("Positions, forces, momenta and velocities V_n = H_p at the points, in turn to convergence:"),
        _POSITIONS,
        Formula(-Applied("H_q")(Symbol("q_n"), Symbol("P_n")), Symbol("F_n")),
        Formula(p + h * _sum("A_n_j", Symbol("F_j")), Symbol("P_n")),
        Formula(Applied("H_p")(Symbol("q_n"), Symbol("P_n")), Symbol("V_n")),
        _END,
        Formula(p + h * _sum("B_j", Symbol("F_j")), Symbol("p_k+1")),
    ),
    "shooting": (
        Paragraph(
            "Scaled accelerations z_n at the nodes, corrected by the Euler-Lagrange residuals E; then p_(k+1), the "
            "velocity v_0 at the start and the multipliers, in turn to convergence:"
        ),
        _VELOCITIES,
        _POSITIONS,
        Formula(Symbol("z_n") - h * inverse_mass * Symbol("E_n"), Symbol("z_n_new")),
    ),
    "collocation": (
        Paragraph("Scaled accelerations z_n at the nodes, F = L_q - L_vq v - L_vt, M = L_vv; iterated to convergence:"),
        _VELOCITIES,
        _POSITIONS,
        Formula(h * inverse_mass * Symbol("F_n"), Symbol("z_n")),
    ),
}
