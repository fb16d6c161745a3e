"""Unrolled stage equations of the smallest programs: one statement per residual, with the numbers of the tables.

Terms are in the order in which the loops of ``support/newton/stages.h`` add them, so that both round alike;
products with 0 are omitted, products with 1 simplified.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import TypeAlias

from scvi_codegen.ir.equations import LoweredStageGroup
from scvi_codegen.ir.kernel import Number
from scvi_codegen.ir.program import FEW_UNKNOWNS, Program
from scvi_codegen.rendering.kernels.printer import print_number
from scvi_codegen.rendering.layout import wrapped
from scvi_codegen.rendering.target import Target

MOST_TERMS = 16
"""Largest number of terms of the Jacobian; beyond it loops over tables are shorter."""

Term: TypeAlias = tuple[Number, str]
"""A number and the factor that it multiplies."""


@dataclass(frozen=True, slots=True, kw_only=True)
class UnrolledGroup:
    """Offsets of arguments, values and derivatives of a stage group, and the statements of its arguments."""

    group: LoweredStageGroup
    u: int
    value: int
    derivative: int
    partials: int
    points: tuple[str, ...]
    uses_step: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class UnrolledEquations:
    """Statements; ``sizes`` are the numbers of arguments, values and derivatives."""

    stage_groups: tuple[UnrolledGroup, ...]
    sizes: tuple[int, int, int]
    residuals: tuple[str, ...]
    increments: tuple[str, ...]
    magnitudes: tuple[str, ...]
    jacobian: tuple[str, ...]


def unrolled_equations(program: Program, target: Target) -> UnrolledEquations | None:
    """Return the unrolled equations, ``None`` if loops over tables are shorter."""
    if not program.newton or program.equations.unknowns > FEW_UNKNOWNS or program.damping:
        return None
    writer = _Statements(program, target)
    entries = writer.entries()
    if sum(len(group) for groups in entries.values() for group in groups) > MOST_TERMS:
        return None
    return writer.written(entries)


class _Statements:
    """Writer of tables as sums."""

    def __init__(self, program: Program, target: Target) -> None:
        self.program, self.target = program, target
        stage_groups = program.equations.stage_groups
        self.u = list(accumulate((each.points * each.value.arguments for each in stage_groups), initial=0))
        self.value = list(accumulate((each.points * each.value.values for each in stage_groups), initial=0))
        self.partials = [len(each.derivative.results) - each.derivative.values for each in stage_groups]
        counts = (each.points * count for each, count in zip(stage_groups, self.partials, strict=True))
        self.derivative = list(accumulate(counts, initial=0))

    def written(self, entries: dict[tuple[int, int, int, int], list[list[Term]]]) -> UnrolledEquations:
        """Return all statements, with the given entries of the Jacobian."""
        program, blocks = self.program, self.program.equations.blocks
        sites = range(program.equations.sites)
        return UnrolledEquations(
            stage_groups=tuple(self._family(k, group) for k, group in enumerate(program.equations.stage_groups)),
            sizes=(self.u[-1], self.value[-1], self.derivative[-1]),
            residuals=tuple(
                _statement(f"rows[{s * (blocks + 1) + r}] = {self._sum(self._row(s, r))};")
                for s in sites
                for r in range(blocks)
            ),
            increments=tuple(
                _statement(f"rows[{s * (blocks + 1) + blocks}] = {self._sum(self._row(s, blocks))};") for s in sites
            ),
            magnitudes=tuple(map(_statement, self._magnitudes())),
            jacobian=tuple(
                _statement(f"*entry(jacobian, shape, {i}, {r}, {j}, {b}) = {self._sum_of_sums(groups)};")
                for (i, r, j, b), groups in entries.items()
            ),
        )

    def _family(self, k: int, group: LoweredStageGroup) -> UnrolledGroup:
        return UnrolledGroup(
            group=group,
            u=self.u[k],
            value=self.value[k],
            derivative=self.derivative[k],
            partials=self.partials[k],
            points=tuple(map(_statement, self._points(group))),
            uses_step=any(loop.power for loop in group.gathers),
        )

    def _points(self, group: LoweredStageGroup) -> Iterator[str]:
        for n in range(group.points):
            for loop in group.gathers:
                for i in range(loop.sites):
                    unknowns = [
                        f"z[{(loop.first + i) * self.program.equations.blocks + b}]"
                        for b in range(self.program.equations.blocks)
                    ]
                    terms = list(zip(loop.table[n], unknowns, strict=True))
                    text = _scaled(loop.power, self._sum(terms))
                    if loop.from_state:
                        text = f"step->q0[{i}] + (step->carry_q[{i}] + {text})"
                    yield f"u[{n * group.value.arguments + loop.offset + i}] = {text};"

    def _row(self, site: int, row: int) -> list[Term]:
        """Return the terms of row ``row`` of a site, the last row that of p1."""
        program = self.program
        begins = row < program.equations.blocks and site < program.dimension
        terms = [(program.equations.momentum_rows[row], f"step->p0[{site}]")] if begins else []
        for k, group in enumerate(program.equations.stage_groups):
            for loop in group.scatters:
                if loop.first <= site < loop.first + loop.sites:
                    for n, weight in enumerate(group.weights):
                        place = self.value[k] + n * group.value.values + loop.offset + site - loop.first
                        terms.append((loop.table[n][row], self._product(weight, loop.power, f"value[{place}]")))
        return terms

    def _magnitudes(self) -> Iterator[str]:
        """Yield the statements of the magnitudes of p1, then of q1: sums of absolute values."""
        program = self.program
        for s in range(program.equations.sites):
            own = [f"step->p0[{s}]"] if s < program.dimension else []
            terms = [*own, *(self._sum([term]) for term in self._row(s, program.equations.blocks) if term[0])]
            yield f"size_p[{s}] = {_magnitude(terms)};"
        for i in range(program.dimension):
            moves = [
                self._product(end, 1, f"z[{i * program.equations.blocks + b}]", first=True)
                for b, end in enumerate(program.equations.end_position)
                if end
            ]
            yield f"size_q[{i}] = {_magnitude([f'step->q0[{i}]', *moves])};"

    def entries(self) -> dict[tuple[int, int, int, int], list[list[Term]]]:
        """Return the sums by row (i, r) and column (j, b) of the Jacobian, one sum per pair of tables."""
        entries: dict[tuple[int, int, int, int], list[list[Term]]] = {}
        for k, group in enumerate(self.program.equations.stage_groups):
            for block in group.blocks:
                row, column = group.scatters[block.scatter], group.gathers[block.gather]
                for e, (i, j) in enumerate(block.entries):
                    for b in range(self.program.equations.blocks):
                        factors = [
                            self._derivative_factor(k, n, block.first + e, row.power + column.power, column.table[n][b])
                            for n in range(group.points)
                        ]
                        for r in range(self.program.equations.blocks):
                            coefficients = [line[r] for line in row.table]
                            terms = [(c, text) for c, text in zip(coefficients, factors, strict=True) if c and text]
                            if terms:
                                entries.setdefault((i, r, j, b), []).append(terms)
        return entries

    def _derivative_factor(self, k: int, n: int, e: int, power: int, coefficient: Number) -> str:
        """Return the product of weight, h^power, derivative and coefficient; empty if that is 0."""
        if not coefficient:
            return ""
        derivative = f"derivative[{self.derivative[k] + n * self.partials[k] + e}]"
        product = self._product(self.program.equations.stage_groups[k].weights[n], power, derivative)
        return product if coefficient == 1 else f"{product} * {self._signed(coefficient)}"

    def _product(self, weight: Number, power: int, factor: str, *, first: bool = False) -> str:
        """Return the product of weight, h^power and factor from the left; h before the weight if it is ``first``."""
        scale = [] if power == 0 else ["h" if power == 1 else f"({_power(power)})"]
        numbers = [] if weight == 1 else [self._signed(weight)]
        return " * ".join([*scale, *numbers, factor] if first else [*numbers, *scale, factor])

    def _signed(self, number: Number) -> str:
        text = print_number(number, self.target)
        return f"({text})" if number < 0 else text

    def _sum(self, terms: Sequence[Term]) -> str:
        """Return the terms that are not 0, joined by their signs; ``0`` if there is none."""
        text = ""
        for coefficient, factor in terms:
            if coefficient:
                sign = ("-" if coefficient < 0 else "") if not text else (" - " if coefficient < 0 else " + ")
                text += sign + self._times(abs(coefficient), factor)
        return text or "0"

    def _times(self, coefficient: Number, factor: str) -> str:
        if coefficient == 1:
            return factor
        inner = f"({factor})" if " * " in factor else factor
        return f"{print_number(coefficient, self.target)} * {inner}"

    def _sum_of_sums(self, groups: Sequence[Sequence[Term]]) -> str:
        first, *others = [self._sum(group) for group in groups]
        return " + ".join([first, *(f"({text})" for text in others)])


def _statement(text: str) -> str:
    """Return a statement that is broken between terms, not within products."""
    return wrapped(text.replace(" * ", "\0*\0"))


def _power(power: int) -> str:
    product = " * ".join(["h"] * abs(power))
    return product if power > 0 else f"1 / ({product})"


def _scaled(power: int, text: str) -> str:
    if power == 0:
        return text
    scale = "h" if power == 1 else f"({_power(power)})"
    return f"{scale} * ({text})" if " " in text or text.startswith("-") else f"{scale} * {text}"


def _magnitude(terms: Sequence[str]) -> str:
    return " + ".join(f"MATH(fabs)({term})" for term in terms) or "0"
