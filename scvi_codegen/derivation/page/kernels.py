"""Formulas of each kernel next to its C, and the operations saved by common subexpressions.

Functions around the kernels, in the order of their calls: their purpose, and their C.
"""

import re
from collections.abc import Iterator, Mapping
from itertools import count, takewhile

import sympy
from sympy import Function as Applied
from sympy import Symbol

from scvi_codegen.derivation.page.stage_equations import stage_group_contents
from scvi_codegen.derivation.page.sums import end_formulas, row_formulas
from scvi_codegen.display.page.blocks import (
    MOST_FORMULAS,
    Content,
    Formula,
    Paragraph,
    Section,
    SideBySide,
    TableBlock,
    formulas,
    lines,
    operations,
)
from scvi_codegen.ir.kernel import Kernel
from scvi_codegen.ir.program import Program
from scvi_codegen.mechanics.derived_expressions import auxiliary_multipliers, multipliers
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods.discretise import discretise
from scvi_codegen.methods.method import Method
from scvi_codegen.methods.stage_system import StageSystem
from scvi_codegen.rendering.outline import Function, reached

COUNTS = re.compile(r" Operations: .*$")


def kernels_of(program: Program) -> tuple[Kernel, ...]:
    """Return every kernel of the C, each name once."""
    kernels = list(program.kernels)
    if program.fixed_point:
        kernels += program.fixed_point.kernels
        kernels += [program.fixed_point.constant_mass] if program.fixed_point.constant_mass else []
    if program.splitting:
        kernels += program.splitting.kernels
    return tuple({kernel.name: kernel for kernel in kernels}.values())


def operations_section(program: Program) -> Section:
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


def kernels_section(system: MechanicalSystem, program: Program, functions: Mapping[str, Function]) -> Section:
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
    named = ((multipliers(system), "lambda"), (auxiliary_multipliers(system), "nu"))
    return {
        symbol: Symbol(f"{letter}_{q.name}")
        for symbols, letter in named
        for symbol, q in zip(symbols, system.coordinates, strict=False)
    }


def kernel_text(functions: Mapping[str, Function], name: str) -> str:
    """Return the C of a kernel; a large one is divided into parts, which it calls in order."""
    parts = takewhile(functions.__contains__, (f"{name}_{k}" for k in count(1)))
    return "\n".join(functions[part].text for part in (*parts, name))


def _pair(
    program: Program, kernel: Kernel, functions: Mapping[str, Function], names: Mapping[Symbol, Symbol]
) -> SideBySide:
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


def functions_section(
    system: MechanicalSystem, method: Method, program: Program, functions: Mapping[str, Function]
) -> Section:
    """Return the section on functions, from the loop over the steps down: formulas or words left, C right."""
    stages = discretise(system, method)
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


def _function_pair(function: Function, start: str, all_formulas: Iterator[Content]) -> SideBySide:
    words = function.comment or "The loop over the steps, with compensated sums."
    return SideBySide(
        title=f"{function.name}({', '.join(function.arguments)})",
        left=(Paragraph(words if words.endswith(".") else f"{words}."), *all_formulas),
        right=(lines(function.text),),
        folded=not OPENED.fullmatch(function.name) and function.name != start,
    )


def _formulas(name: str, system: MechanicalSystem, stages: StageSystem, program: Program) -> Iterator[Content]:
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


ITERATIONS: dict[str, tuple[Content, ...]] = {
    "separable": (
        Paragraph("Positions q_n at the points, F the forces L_q, M the constant masses; iterated to convergence:"),
        Formula(q + h * Symbol("c_n") * v0 + h**2 * _sum("a_n_j", inverse_mass * Symbol("F_j")), Symbol("q_n")),
        Formula(q + h * v0 + h**2 * _sum("beta_j", inverse_mass * Symbol("F_j")), Symbol("q_k+1")),
        Formula(p + h * _sum("b_j", Symbol("F_j")), Symbol("p_k+1")),
    ),
    "coupled": (
        Paragraph("Velocities V_n at the points, corrected to convergence; M = L_vv there:"),
        Formula(q + h * _sum("a_n_j", Symbol("V_j")), Symbol("q_n")),
        Formula(p + h * _sum("A_n_j", Symbol("L_q_j")), Symbol("P_n")),
        Formula(Symbol("V_n") + inverse_mass * (Symbol("P_n") - Symbol("L_v_n")), Symbol("V_n_new")),
        Paragraph(
            "If the masses of few coordinates depend on positions, the correction includes its first-order effect on "
            "P_n and L_v. After convergence:"
        ),
        Formula(q + h * _sum("b_j", Symbol("V_j")), Symbol("q_k+1")),
        Formula(p + h * _sum("B_j", Symbol("L_q_j")), Symbol("p_k+1")),
    ),
    "Hamiltonian": (
        Paragraph("Positions, forces, momenta and velocities V_n = H_p at the points, in turn to convergence:"),
        Formula(q + h * _sum("a_n_j", Symbol("V_j")), Symbol("q_n")),
        Formula(-Applied("H_q")(Symbol("q_n"), Symbol("P_n")), Symbol("F_n")),
        Formula(p + h * _sum("A_n_j", Symbol("F_j")), Symbol("P_n")),
        Formula(Applied("H_p")(Symbol("q_n"), Symbol("P_n")), Symbol("V_n")),
        Formula(q + h * _sum("b_j", Symbol("V_j")), Symbol("q_k+1")),
        Formula(p + h * _sum("B_j", Symbol("F_j")), Symbol("p_k+1")),
    ),
    "shooting": (
        Paragraph(
            "Scaled accelerations z_n at the nodes, corrected by the Euler-Lagrange residuals E; then p_(k+1), the "
            "velocity v_0 at the start and the multipliers, in turn to convergence:"
        ),
        Formula(v0 + _sum("a_n_j", Symbol("z_j")), Symbol("V_n")),
        Formula(q + h * _sum("a_n_j", Symbol("V_j")), Symbol("q_n")),
        Formula(Symbol("z_n") - h * inverse_mass * Symbol("E_n"), Symbol("z_n_new")),
    ),
    "collocation": (
        Paragraph("Scaled accelerations z_n at the nodes, F = L_q - L_vq v - L_vt, M = L_vv; iterated to convergence:"),
        Formula(v0 + _sum("a_n_j", Symbol("z_j")), Symbol("V_n")),
        Formula(q + h * _sum("a_n_j", Symbol("V_j")), Symbol("q_n")),
        Formula(h * inverse_mass * Symbol("F_n"), Symbol("z_n")),
    ),
}
