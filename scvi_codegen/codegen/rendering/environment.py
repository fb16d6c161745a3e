"""Jinja environment of the C templates, with its filters."""

from collections.abc import Callable, Sequence
from functools import cache
from typing import TypeAlias

from jinja2 import Environment, FileSystemLoader, StrictUndefined, pass_context
from jinja2.runtime import Context

from scvi_codegen.codegen.ir.kernel import Kernel, Number
from scvi_codegen.codegen.rendering.kernels.functions import kernel_text, lane_kernel_text, lane_mass_text, power_of_h
from scvi_codegen.codegen.rendering.kernels.printer import print_number
from scvi_codegen.codegen.rendering.kernels.simd import Lanes
from scvi_codegen.codegen.rendering.text import table, wrapped, wrapped_comment, wrapped_comment_lines
from scvi_codegen.common.cache import template_folder

Rows: TypeAlias = Sequence[Sequence[Number]]


@pass_context
def _number(context: Context, value: Number) -> str:
    return print_number(value, context["target"])


def _numbers(context: Context, values: Sequence[Number]) -> list[str]:
    return [_number(context, value) for value in values]


@pass_context
def _vector(context: Context, name: str, values: Sequence[Number], size: str = "") -> str:
    """Return the table of numbers, padded with zeros to ``size``, an expression in C."""
    return table(f"static const {context['target'].scalar} {name}[{size or len(values)}]", _numbers(context, values))


@pass_context
def _matrix(context: Context, name: str, rows: Rows, columns: str = "") -> str:
    """Return the table of rows, padded with zeros to so many columns."""
    size = f"[{len(rows)}][{columns or len(rows[0])}]"
    return table(f"static const {context['target'].scalar} {name}{size}", [_numbers(context, row) for row in rows])


@pass_context
def _rests(context: Context, rows: Rows) -> Rows:
    """Return the low words of a table: the rounding errors of its numbers."""
    return [list(map(context["target"].rest, row)) for row in rows]


def _pairs(name: str, entries: Sequence[tuple[int, ...]]) -> str:
    """Return the table of tuples of integers of one length."""
    rows = [f"{{{', '.join(map(str, entry))}}}" for entry in entries]
    return table(f"static const int {name}[{len(entries)}][{len(entries[0])}]", rows)


@pass_context
def _kernel_text(context: Context, kernel: Kernel, *, partials: bool = False) -> str:
    return kernel_text(kernel, context["target"], partials=partials)


@pass_context
def _lane_kernel_text(context: Context, kernel: Kernel) -> str:
    return lane_kernel_text(kernel, context["program"].fixed_point, context["fixed_point"].meaning, context["target"])


@pass_context
def _lane_mass_text(context: Context, kernel: Kernel) -> str:
    meaning = context["fixed_point"].meaning
    return lane_mass_text(kernel, context["program"].fixed_point, meaning, context["target"])


def _pair_kernel_text(kernel: Kernel, *lanes: Lanes) -> str:
    from scvi_codegen.codegen.rendering.kernels.double_double import pair_kernel_text

    return pair_kernel_text(kernel, *lanes)


FUNCTIONS: dict[str, Callable[..., str]] = {
    "power_of_h": power_of_h,
    "vector": _vector,
    "matrix": _matrix,
    "integers": lambda name, values: table(f"static const int {name}", list(map(str, values))),
    "pairs": _pairs,
}
FILTERS: dict[str, Callable[..., object]] = {
    "number": _number,
    "kernel_text": _kernel_text,
    "lane_kernel_text": _lane_kernel_text,
    "lane_mass_text": _lane_mass_text,
    "pair_kernel_text": _pair_kernel_text,
    "rests": _rests,
    "transposed": lambda rows: tuple(zip(*rows, strict=True)),
    "wrapped": wrapped,
    "wrapped_comment": wrapped_comment,
    "wrapped_comment_lines": wrapped_comment_lines,
}


@cache
def template_environment() -> Environment:
    """Return the environment, which is created once."""
    environment = Environment(
        loader=FileSystemLoader(template_folder()),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,
    )
    environment.globals |= FUNCTIONS
    environment.filters |= FILTERS
    return environment


@cache
def support_text(name: str) -> str:
    """Return the source of a support header, a file below the folder ``support`` of the templates, with its guard."""
    path = template_folder() / name
    guard = f"SUPPORT_{path.stem.upper()}_H"
    return f"#ifndef {guard}\n#define {guard}\n\n{path.read_text(encoding='utf-8')}\n#endif\n"
