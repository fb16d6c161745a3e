"""Kernels as C functions of numbers and of vectors. All have the same arguments, whether they use them or not.

A kernel that is divided calls its parts, separate functions with only the arguments that they use.

The stage equations of the smallest programs are unrolled: one statement per residual, with the numbers of the tables.
Terms are in the order in which the loops of ``support/newton/stages.h`` add them, so that both round alike; products
with 0 are omitted, products with 1 simplified.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import accumulate
from typing import TypeAlias

from scvi_codegen.codegen.ir.equations import FixedPointIteration, LoweredStageGroup
from scvi_codegen.codegen.ir.kernel import Constant, Kernel, Load, Number, Part, RolledKernel, parts
from scvi_codegen.codegen.ir.program import FEW_UNKNOWNS, Layout, Program
from scvi_codegen.codegen.rendering.kernels.loop_nests import Nest
from scvi_codegen.codegen.rendering.kernels.printer import (
    ARRAYS,
    Target,
    print_lane_statements,
    print_number,
    print_statements,
)
from scvi_codegen.codegen.rendering.kernels.simd import DIRECTIONS, Lanes
from scvi_codegen.codegen.rendering.text import table, wrapped, wrapped_comment, wrapped_prototype
from scvi_codegen.systems.formulas.indices import Access, Place

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
        self.u = list(accumulate((group.points * group.value.arguments for group in stage_groups), initial=0))
        self.value = list(accumulate((group.points * group.value.values for group in stage_groups), initial=0))
        self.partials = [group.derivative.partials for group in stage_groups]
        counts = (group.points * count for group, count in zip(stage_groups, self.partials, strict=True))
        self.derivative = list(accumulate(counts, initial=0))

    def written(self, entries: dict[tuple[int, int, int, int], list[list[Term]]]) -> UnrolledEquations:
        program, blocks = self.program, self.program.equations.blocks
        sites = range(program.equations.sites)

        def residual(s: int, r: int) -> str:
            return _statement(f"rows[{s * (blocks + 1) + r}] = {self._sum(self._row(s, r))};")

        return UnrolledEquations(
            stage_groups=tuple(self._family(k, group) for k, group in enumerate(program.equations.stage_groups)),
            sizes=(self.u[-1], self.value[-1], self.derivative[-1]),
            residuals=tuple(residual(s, r) for s in sites for r in range(blocks)),
            increments=tuple(residual(s, blocks) for s in sites),
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

    @property
    def _momenta(self) -> str:
        return "step->theta0" if self.program.quantities.first_order_rates else "step->p0"

    def _row(self, site: int, row: int) -> list[Term]:
        """Return the terms of row ``row`` of a site, the last row that of p1."""
        program = self.program
        begins = row < program.equations.blocks and site < program.dimension
        terms = [(program.equations.momentum_rows[row], f"{self._momenta}[{site}]")] if begins else []
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
            momenta = [f"{self._momenta}[{s}]"] if s < program.dimension else []
            terms = [*momenta, *(self._sum([term]) for term in self._row(s, program.equations.blocks) if term[0])]
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
        powers = {0: [], 1: ["h"]}
        scale = powers.get(power, [f"({power_of_h(power)})"])
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
                minus, plus = (" - ", " + ") if text else ("-", "")
                text += (minus if coefficient < 0 else plus) + self._times(abs(coefficient), factor)
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


def power_of_h(k: int) -> str:
    """Return C source of h^k as a factor."""
    product = " * ".join(["h"] * abs(k)) or "1"
    return product if k >= 0 else f"1 / ({product})"


def _scaled(power: int, text: str) -> str:
    if power == 0:
        return text
    scale = "h" if power == 1 else f"({power_of_h(power)})"
    return f"{scale} * ({text})" if " " in text or text.startswith("-") else f"{scale} * {text}"


def _magnitude(terms: Sequence[str]) -> str:
    return " + ".join(f"MATH(fabs)({term})" for term in terms) or "0"


UNFORMATTED = "  /* clang-format off */\n{}\n  /* clang-format on */"
"""Wrapper for statements of several lines, whose layout differs from that of clang-format."""

PART = "static SCVI_NOINLINE"


Printed: TypeAlias = Callable[[Kernel | Part], list[str]]
"""Function that prints the statements of a kernel or of a part."""


def kernel_text(kernel: Kernel, target: Target, *, partials: bool = False) -> str:
    """Return a function of numbers, with its comment; ``partials``: always with the argument for derivatives."""
    if kernel.tangents is None:
        return _text(kernel, target, None, partial(print_statements, target=target), partials=partials)
    name, along, real = kernel.name, kernel.tangents, target.scalar
    purpose = f"Values of {name}, and their local derivatives."
    local = replace(kernel, name=f"{name}_at", tangents=None, entries=(), purpose=purpose)
    printed = partial(print_lane_statements, sources=DIRECTIONS.sources, number=target, vector_type=DIRECTIONS.vector)
    arguments = f"const {real} *u", f"{real} t", f"const {real} *parameters", f"{real} *value", f"{real} *derivative"
    statements = (
        f"{real} local[{local.partials}];",
        f"directions x[{along.arguments}], change[{along.values}];",
        f"{local.name}(u, t, parameters, value, local);",
        f"differentiate({along.name}, {along.arguments}, local, {name}_entry, {kernel.partials}, x, change, "
        "derivative);",
    )
    texts = (
        kernel_text(local, target),
        _text(along, target, DIRECTIONS, printed),
        table(f"static const int {name}_entry[{kernel.partials}][3]", [[*map(str, row)] for row in kernel.entries]),
        f"{wrapped_comment(kernel.purpose)}\n{_function('static', kernel, arguments, statements)}",
    )
    return "\n\n".join(texts)


def lane_kernel_text(kernel: Kernel, fixed_point: FixedPointIteration | None, lanes: Lanes, target: Target) -> str:
    """Return a function of vectors."""
    printed = partial(print_lane_statements, fixed_point=fixed_point, sources=lanes.sources, number=target)
    return _text(kernel, target, lanes, printed)


def _text(kernel: Kernel, target: Target, lanes: Lanes | None, printed: Printed, *, partials: bool = False) -> str:
    """Return a function of numbers or lanes, after its parts and the terms of its loops with their tables."""
    real = lanes.vector if lanes else target.scalar
    time, parameter = (lanes.type_of(name, target.scalar) if lanes else real for name in ("t", "parameters"))
    declared = {name: f"{real} *{name}" for name in ARRAYS} | {"u": f"const {real} *u", "t": f"{time} t"}
    declared |= {"parameters": f"const {parameter} *parameters", "kept": f"{real} *restrict kept"}
    texts = []
    if len(cut := parts(kernel)) > 1:
        arrays = [[declared[name] for name in filter(part.uses, ARRAYS)] for part in cut]
        texts = [_function(PART, *of, printed(of[0])) for of in zip(cut, arrays, strict=True)]
    statements = [*printed(kernel)]
    if kernel.cleared:
        statements.insert(0, f"memset(derivative, 0, {kernel.cleared} * sizeof *derivative);")
    for loop in kernel.sums:
        texts += _text(loop.kernel, target, lanes, printed), *_tables(loop, target)
        statements += _Rows(loop, real, parameter).lines()
    last = ["derivative"] if len(kernel.results) > kernel.values or partials else []
    names = ["u", "t", "parameters", *(["value"] if kernel.values or not last else []), *last]
    counts = ", ".join(f"{count} {operator}" for operator, count in kernel.operation_counts().items()) or "constants"
    comment = wrapped_comment(f"{kernel.purpose} Operations: {counts}.".strip())
    whole = _function("static inline" if lanes else "static", kernel, [declared[name] for name in names], statements)
    return "\n\n".join([*texts, f"{comment}\n{whole}"])


def lane_mass_text(kernel: Kernel, fixed_point: FixedPointIteration | None, lanes: Lanes, target: Target) -> str:
    """Return the function of constant masses: of numbers for one trajectory, or of vectors for many."""
    return kernel_text(kernel, target) if lanes.are_points else lane_kernel_text(kernel, fixed_point, lanes, target)


def _tables(loop: RolledKernel, target: Target) -> Iterator[str]:
    """Yield the constant tables of a loop, and the constants of its rows."""
    for name, rows in loop.tables:
        lines = [list(map(str, row)) for row in rows]
        yield table(f"static const int {_named(loop, name)}[{len(rows)}][{len(rows[0])}]", lines)
    for name, column in loop.columns:
        numbers = [target.number(entry.value) for entry in column if isinstance(entry, Constant)]
        places = [str(entry.index) for entry in column if isinstance(entry, Load)]
        kind = target.scalar if numbers else "int"
        yield table(f"static const {kind} {_named(loop, name)}[{len(column)}]", numbers or places)


def _named(loop: RolledKernel, name: str) -> str:
    return f"{loop.kernel.name}_{name}".upper()


class _Rows(Nest):
    """Loop of a kernel over the rows of constant tables: entries of ``u`` are read, and values added."""

    def __init__(self, rolled: RolledKernel, real: str, parameter: str) -> None:
        super().__init__(Layout(), rolled, real, "u")
        self.parameter, self.columns = parameter, dict(rolled.columns)

    def lines(self) -> list[str]:
        call = f"{self.rolled.kernel.name}(slot, t, parameters, term);"
        added = (
            f"{target.array.name}[{self.place(target)}] += term[{k}];" for k, target in enumerate(self.rolled.writes)
        )
        return self.text(innermost=[call, *added])

    def known(self, depth_of: int) -> Iterator[str]:
        """Yield the declarations of arguments and values, then the arguments."""
        if depth_of:
            yield f"{self.scalar} slot[{self.rolled.kernel.arguments}], term[{self.rolled.kernel.values}];"
        yield from super().known(depth_of)

    def read(self, k: int, slot: Access) -> str:
        return f"slot[{k}] = {self.source}[{self.place(slot)}];"

    def constant(self, k: int, access: Access) -> str:
        """Return the assignment of a constant of a row, one of the last arguments."""
        name, is_number = access.array.name, isinstance(self.columns[access.array.name][0], Constant)
        table = f"{_named(self.rolled, name)}[index_e]"
        text = table if is_number else f"parameters[{table}]"
        alike = self.scalar == "lanes" and (is_number or self.parameter == "double")
        return f"slot[{len(self.rolled.reads) + k}] = {f'lanes_of({text})' if alike else text};"

    def table_entry(self, place: Place) -> str:
        return f"{_named(self.rolled, place.table)}[index_{place.index}][{place.column}]"


def _function(storage: str, code: Kernel | Part, arguments: Sequence[str], statements: Sequence[str]) -> str:
    lines = [wrapped(statement) for statement in statements]
    body = "\n".join(lines)
    laid_out = UNFORMATTED.format(body) if any("\n" in line for line in lines) else body
    head = wrapped_prototype(f"{storage} void {code.name}({', '.join(arguments)})")
    return f"{head}\n{{\n{laid_out}\n}}"
