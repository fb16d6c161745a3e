"""Kernels as C functions of numbers and of vectors. All have the same arguments, whether they use them or not.

A kernel that is divided calls its parts, separate functions with only the arguments that they use.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from scvi_codegen.ir.iteration import FixedPointIteration
from scvi_codegen.ir.kernel import Constant, Kernel, Load, LoopedKernel, Part, parts
from scvi_codegen.rendering.layout import table, wrapped, wrapped_comment, wrapped_prototype
from scvi_codegen.rendering.printer import ARRAYS, print_lane_statements, print_statements
from scvi_codegen.rendering.simd import Lanes
from scvi_codegen.rendering.target import DOUBLE, Target

__all__ = ["kernel_text", "lane_kernel_text", "lane_mass_text"]

UNFORMATTED = "  /* clang-format off */\n{}\n  /* clang-format on */"
"""Wrapper for statements of several lines, whose layout differs from that of clang-format."""

PART = "static SCVI_NOINLINE"


def kernel_text(kernel: Kernel, target: Target, *, partials: bool = False) -> str:
    """Return a function of numbers, with its comment; ``partials``: always with the argument for derivatives."""
    real = target.scalar
    declared = {name: f"{real} *{name}" for name in ARRAYS}
    declared |= {"u": f"const {real} *u", "t": f"{real} t", "parameters": f"const {real} *parameters"}
    declared["kept"] = f"{real} *restrict kept"
    texts = [_function(PART, part, _used(part, declared), print_statements(part, target)) for part in _parts(kernel)]
    texts += [text for each in kernel.sums for text in (kernel_text(each.kernel, target), *_tables(each, target))]
    arguments = _arguments(kernel, declared, partials=partials)
    statements = [*print_statements(kernel, target), *_loops(kernel, real)]
    return "\n\n".join([*texts, _whole("static", kernel, arguments, statements)])


def lane_kernel_text(kernel: Kernel, fixed_point: FixedPointIteration, lanes: Lanes) -> str:
    """Return a function of vectors."""
    declared = {name: f"lanes *{name}" for name in ARRAYS}
    declared |= {"u": "const lanes *u", "t": f"{lanes.type_of('t')} t", "kept": "lanes *restrict kept"}
    declared["parameters"] = f"const {lanes.type_of('parameters')} *parameters"
    sources = lanes.sources
    texts = [
        _function(PART, part, _used(part, declared), print_lane_statements(part, fixed_point, sources))
        for part in _parts(kernel)
    ]
    texts += [
        text
        for each in kernel.sums
        for text in (lane_kernel_text(each.kernel, fixed_point, lanes), *_tables(each, DOUBLE))
    ]
    statements = [*print_lane_statements(kernel, fixed_point, sources), *_loops(kernel, "lanes", sources)]
    return "\n\n".join([*texts, _whole("static inline", kernel, _arguments(kernel, declared), statements)])


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


def _loops(kernel: Kernel, real: str, sources: Sequence[str] = ()) -> list[str]:
    """Return the statements of loops: gather slots, evaluate the kernel, add its values."""
    lines = []
    for each in kernel.sums:
        at, to = (_named(each, entries[0].places[0].table) for entries in (each.reads, each.writes))
        reads = [f"u[at[{slot.places[0].column}]]" for slot in each.reads]
        reads += [_constant(_named(each, name), column[0], real, sources) for name, column in each.columns]
        lines += [
            f"for (int e = 0; e < {each.rows}; e++) {{",
            f"  const int *at = {at}[e], *to = {to}[e];",
            f"  {real} slot[{each.kernel.arguments}], term[{each.kernel.values}];",
            *(f"  slot[{k}] = {text};" for k, text in enumerate(reads)),
            f"  {each.kernel.name}(slot, t, parameters, term);",
            *(f"  value[to[{target.places[0].column}]] += term[{k}];" for k, target in enumerate(each.writes)),
            "}",
        ]
    return lines


def _constant(name: str, first: Constant | Load, real: str, sources: Sequence[str]) -> str:
    """Return the C expression of a constant of a row."""
    is_number = isinstance(first, Constant)
    text = f"{name}[e]" if is_number else f"parameters[{name}[e]]"
    alike = real == "lanes" and (is_number or "parameters" not in sources)
    return f"lanes_of({text})" if alike else text


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
