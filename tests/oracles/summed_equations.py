"""Evaluates equations with sums, as the derivation page shows them, by writing every sum out term by term."""

import re
from collections.abc import Iterator

import sympy
from sympy import Symbol
from sympy.core.function import AppliedUndef

from scvi_codegen.interfaces.derivation.page.sums import (
    argument_symbol,
    column_of,
    end_formulas,
    gather_formulas,
    point_index,
    result_symbol,
    row_formulas,
)
from scvi_codegen.methods.stage_system import StageSystem
from scvi_codegen.systems.system import MechanicalSystem

Values = dict[str, sympy.Expr]
DIGITS = 30


class Evaluation:
    """All equations of one step in numbers, for a system of one coordinate.

    Args:
        known: of q_k, p_k, h, t_k and of every parameter, by name.
        unknowns: by name of the block.
    """

    def __init__(self, system: MechanicalSystem, stages: StageSystem, known: Values, unknowns: Values) -> None:
        self.system, self.stages = system, stages
        self.parameters = {parameter: known[parameter.name] for parameter in system.parameters}
        self.values: Values = dict(known) | dict(_table_values(stages)) | {"Q__0": known["q_k"]}
        for name, value in unknowns.items():
            letter, _, index = name.rpartition("_")
            self.values |= {f"{letter}_{index}": value, f"{letter}__{index}": value}
        for group in stages.stage_groups:
            self._evaluate_kernel(group)

    def _evaluate_kernel(self, group) -> None:
        formulas = {formula.left: formula.right for formula in gather_formulas(self.system, self.stages, group)}
        first = group.weight_names[0].point if group.weight_names[0] else 1
        for place, (abscissa, weight, name) in enumerate(
            zip(group.abscissae, group.weights, group.weight_names, strict=True)
        ):
            number, row = place + first, place + 1
            arguments = {self.system.time: self.values["t_k"] + sympy.Float(str(abscissa), DIGITS) * self.values["h"]}
            for gather in group.gathers:
                left = argument_symbol(self.system, gather, point_index(group))
                right = renamed(formulas.get(left, left), "n", row)
                arguments[gather.arguments[0]] = self.value(right)
            if name:
                self.values[name.number] = sympy.Float(str(weight), DIGITS)
            for scatter in group.scatters:
                symbol = result_symbol(self.system, group, scatter, point_index(group, number))
                result = scatter.results[0].xreplace(arguments).xreplace(self.parameters)
                self.values[symbol.name] = sympy.N(result, DIGITS)

    def residuals(self) -> Iterator[sympy.Expr]:
        """Return the residuals of all equations, in their order."""
        for _, formula in row_formulas(self.system, self.stages):
            bounds = re.search(r"i = (\d+),.* (\d+)$", formula.number)
            for index in range(int(bounds[1]), int(bounds[2]) + 1) if bounds else (None,):
                yield self.value(formula.right if index is None else renamed(formula.right, "i", index))

    def ends(self) -> tuple[sympy.Expr, ...]:
        """q_(k+1) and p_(k+1)."""
        return tuple(self.value(formula.right) for formula in end_formulas(self.system, self.stages))

    def value(self, expression: sympy.Expr) -> sympy.Expr:
        """A number; every name must be known."""
        written = _written_out(expression)
        numbers = {f: self.values[str(f)] for f in written.atoms(AppliedUndef)}
        numbers |= {s: self.values[s.name] for s in written.free_symbols if not s.name.startswith("tau")}
        return sympy.N(written.xreplace(numbers), DIGITS)


def _table_values(stages: StageSystem) -> Iterator[tuple[str, sympy.Expr]]:
    """Return the values of named table columns at each point."""
    tables = [part.table for group in stages.stage_groups for part in (*group.gathers, *group.scatters)]
    for table in (*tables, stages.end_position):
        for number in range(len(table.names[0])):
            column = column_of(table, number)
            for point, line in enumerate(table.entries, 1):
                if column.kind == "named":
                    name = renamed(column.entry(column.index) / column.factor, "n", point)
                    yield str(name), sympy.Float(str(line[number]), DIGITS) / column.factor


def _written_out(expression: sympy.Expr) -> sympy.Expr:
    """Every sum term by term."""
    if isinstance(expression, sympy.Sum):
        letter, first, last = expression.limits[0]
        span = range(int(first), int(sympy.sympify(str(last))) + 1)
        return sympy.Add(*(_written_out(renamed(expression.function, letter.name, k)) for k in span))
    if isinstance(expression, AppliedUndef) or not expression.args:
        return expression
    return expression.func(*map(_written_out, expression.args))


def renamed(expression: sympy.Expr, letter: str, number: int) -> sympy.Expr:
    """A number in place of a running index in the names of symbols and functions, and in the limits of sums."""

    def name(text: str) -> str:
        return re.sub(rf"(?<=_){letter}([+-]\d+)?(?=_|$)", lambda match: str(number + int(match[1] or 0)), text)

    if isinstance(expression, sympy.Sum):
        variable, first, last = expression.limits[0]
        end = sympy.sympify(re.sub(rf"\b{letter}\b", str(number), str(last)))
        return sympy.Sum(renamed(expression.function, letter, number), (variable, first, end))
    if isinstance(expression, Symbol):
        return Symbol(name(expression.name))
    if not expression.args:
        return expression
    arguments = [renamed(argument, letter, number) for argument in expression.args]
    if isinstance(expression, AppliedUndef):
        return sympy.Function(name(expression.func.__name__))(*arguments)
    return expression.func(*arguments)
