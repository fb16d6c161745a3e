"""Formulas of each kernel next to its C, and the operations saved by common subexpressions."""

from __future__ import annotations

import re
from collections.abc import Mapping
from itertools import count, takewhile

import sympy
from sympy import Symbol

from scvi_codegen.derivation.page.elision import MOST_FORMULAS, formulas, lines, operations
from scvi_codegen.display.page.blocks import Content, Formula, Paragraph, Section, SideBySide, TableBlock
from scvi_codegen.ir.kernel import Kernel
from scvi_codegen.ir.program import Program
from scvi_codegen.mechanics.derived_expressions import auxiliary_multipliers, multipliers
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.rendering.outline import Function

__all__ = ["kernel_text", "kernels_of", "kernels_section", "operations_section"]

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
    if kernel.uses_arguments:
        left.append(Formula(sympy.Tuple(*kernel.symbols).xreplace(names), Symbol("u")))
    if kernel.uses_parameters:
        left.append(Formula(sympy.Tuple(*map(Symbol, program.layout.parameters)), Symbol("parameters")))
    left += [*formulas(values, "value"), *formulas(partials, "derivative")]
    title = f"{kernel.name}({', '.join(function.arguments)})"
    return SideBySide(title=title, left=tuple(left), right=(lines(kernel_text(functions, kernel.name)),))
