"""Kernels as C functions of numbers and of vectors. All have the same arguments, whether they use them or not.

A kernel that is divided calls its parts, separate functions with only the arguments that they use.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from typing import TypeAlias

from scvi_codegen.indices import Access, Place
from scvi_codegen.ir.equations import FixedPointIteration
from scvi_codegen.ir.kernel import Constant, Kernel, Load, LoopedKernel, Part, parts
from scvi_codegen.ir.program import Layout
from scvi_codegen.rendering.kernels.loop_nests import Nest
from scvi_codegen.rendering.kernels.printer import ARRAYS, print_lane_statements, print_statements
from scvi_codegen.rendering.kernels.simd import Lanes
from scvi_codegen.rendering.layout import table, wrapped, wrapped_comment, wrapped_prototype
from scvi_codegen.rendering.target import DOUBLE, Target

UNFORMATTED = "  /* clang-format off */\n{}\n  /* clang-format on */"
"""Wrapper for statements of several lines, whose layout differs from that of clang-format."""

PART = "static SCVI_NOINLINE"


Printed: TypeAlias = Callable[[Kernel | Part], list[str]]
"""Function that prints the statements of a kernel or of a part."""


def kernel_text(kernel: Kernel, target: Target, *, partials: bool = False) -> str:
    """Return a function of numbers, with its comment; ``partials``: always with the argument for derivatives."""
    return _text(kernel, target, None, partial(print_statements, target=target), partials=partials)


def lane_kernel_text(kernel: Kernel, fixed_point: FixedPointIteration, lanes: Lanes) -> str:
    """Return a function of vectors."""
    printed = partial(print_lane_statements, fixed_point=fixed_point, sources=lanes.sources)
    return _text(kernel, DOUBLE, lanes, printed)


def _text(kernel: Kernel, target: Target, lanes: Lanes | None, printed: Printed, *, partials: bool = False) -> str:
    """Return a function of numbers or lanes, after its parts and the terms of its loops with their tables."""
    real = "lanes" if lanes else target.scalar
    time, parameter = (lanes.type_of(name) if lanes else real for name in ("t", "parameters"))
    declared = {name: f"{real} *{name}" for name in ARRAYS} | {"u": f"const {real} *u", "t": f"{time} t"}
    declared |= {"parameters": f"const {parameter} *parameters", "kept": f"{real} *restrict kept"}
    texts = [_function(PART, part, _used(part, declared), printed(part)) for part in _parts(kernel)]
    texts += [
        text for each in kernel.sums for text in (_text(each.kernel, target, lanes, printed), *_tables(each, target))
    ]
    statements = [*printed(kernel), *(line for each in kernel.sums for line in _Rows(each, real, parameter).lines())]
    storage = "static inline" if lanes else "static"
    return "\n\n".join([*texts, _whole(storage, kernel, _arguments(kernel, declared, partials=partials), statements)])


def lane_mass_text(kernel: Kernel, fixed_point: FixedPointIteration, lanes: Lanes, target: Target) -> str:
    """Return the function of constant masses: of numbers for one trajectory, or of vectors for many."""
    return kernel_text(kernel, target) if lanes.are_points else lane_kernel_text(kernel, fixed_point, lanes)


def _tables(each: LoopedKernel, target: Target) -> Iterator[str]:
    """Yield the constant tables of a loop, and the constants of its rows."""
    for name, rows in each.tables:
        lines = [list(map(str, row)) for row in rows]
        yield table(f"static const int {_named(each, name)}[{len(rows)}][{len(rows[0])}]", lines)
    for name, column in each.columns:
        numbers = [target.number(one.value) for one in column if isinstance(one, Constant)]
        places = [str(one.index) for one in column if isinstance(one, Load)]
        kind = target.scalar if numbers else "int"
        yield table(f"static const {kind} {_named(each, name)}[{len(column)}]", numbers or places)


def _named(each: LoopedKernel, name: str) -> str:
    return f"{each.kernel.name}_{name}".upper()


class _Rows(Nest):
    """Loop of a kernel over the rows of constant tables: entries of ``u`` are read, and values added."""

    def __init__(self, looped: LoopedKernel, real: str, parameter: str) -> None:
        super().__init__(Layout(), looped, real, "u")
        self.parameter, self.columns = parameter, dict(looped.columns)

    def lines(self) -> list[str]:
        """Return the statements."""
        call = f"{self.looped.kernel.name}(slot, t, parameters, term);"
        added = (f"value[{self.place(target)}] += term[{k}];" for k, target in enumerate(self.looped.writes))
        return self.text(innermost=[call, *added])

    def known(self, depth_of: int) -> Iterator[str]:
        """Yield the declarations of arguments and values, then the arguments."""
        if depth_of:
            yield f"{self.scalar} slot[{self.looped.kernel.arguments}], term[{self.looped.kernel.values}];"
        yield from super().known(depth_of)

    def read(self, k: int, slot: Access) -> str:
        """Return the assignment of an argument."""
        return f"slot[{k}] = {self.source}[{self.place(slot)}];"

    def constant(self, k: int, access: Access) -> str:
        """Return the assignment of a constant of a row, one of the last arguments."""
        name, is_number = access.array.name, isinstance(self.columns[access.array.name][0], Constant)
        table = f"{_named(self.looped, name)}[index_e]"
        text = table if is_number else f"parameters[{table}]"
        alike = self.scalar == "lanes" and (is_number or self.parameter == "double")
        return f"slot[{len(self.looped.reads) + k}] = {f'lanes_of({text})' if alike else text};"

    def table_entry(self, place: Place) -> str:
        """Return an index in a constant table."""
        return f"{_named(self.looped, place.table)}[index_{place.index}][{place.column}]"


def _parts(kernel: Kernel) -> tuple[Part, ...]:
    """Return the functions that a kernel calls if it is divided into several."""
    cut = parts(kernel)
    return cut if len(cut) > 1 else ()


def _used(part: Part, declared: Mapping[str, str]) -> list[str]:
    return [declared[name] for name in ARRAYS if part.uses(name)]


def _arguments(kernel: Kernel, declared: Mapping[str, str], *, partials: bool = False) -> list[str]:
    last = ["derivative"] if len(kernel.results) > kernel.values or partials else []
    return [declared[name] for name in ("u", "t", "parameters", "value", *last)]


def _whole(storage: str, kernel: Kernel, arguments: Sequence[str], statements: Sequence[str]) -> str:
    """Return a kernel with its comment; unused arguments are cast to void first."""
    counts = ", ".join(f"{count} {operator}" for operator, count in kernel.operation_counts().items()) or "constants"
    names = [argument.split()[-1].lstrip("*") for argument in arguments]
    unused = ", ".join(f"(void){name}" for name in names if name != "value" and not kernel.uses(name))
    body = [*([f"{unused};"] if unused else []), *statements]
    comment = wrapped_comment(f"{kernel.purpose} Operations: {counts}.".strip())
    return f"{comment}\n{_function(storage, kernel, arguments, body)}"


def _function(storage: str, code: Kernel | Part, arguments: Sequence[str], statements: Sequence[str]) -> str:
    lines = [wrapped(statement) for statement in statements]
    body = "\n".join(lines)
    laid_out = UNFORMATTED.format(body) if any("\n" in line for line in lines) else body
    head = wrapped_prototype(f"{storage} void {code.name}({', '.join(arguments)})")
    return f"{head}\n{{\n{laid_out}\n}}"
