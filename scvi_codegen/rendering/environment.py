"""The Jinja environment of the C templates: its filters and what they know of C."""

from __future__ import annotations

from functools import cache

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from scvi_codegen.files.templates import template_folder
from scvi_codegen.ir.kernel import Kernel
from scvi_codegen.ir.parts import Part, parts
from scvi_codegen.rendering.printer import (
    ARRAYS,
    print_lane_statements,
    print_number,
    print_statements,
)

__all__ = ["template_environment"]


def _signature(code: Kernel | Part) -> str:
    """C parameters of a kernel or of a part of one: only what it uses."""
    declared = {"u": "const double *u", "t": "double t", "parameters": "const double *parameters"}
    declared |= {"kept": "double *restrict kept"}
    return ", ".join(declared.get(array, f"double *{array}") for array in ARRAYS if code.uses(array))


def _lane_signature(code: Kernel | Part, sources: tuple[str, ...]) -> str:
    """The same with vectors in place of numbers."""
    vectors = ("*u", "*restrict kept", "*value", "*slope", *(("t",) if "t" in sources else ("*parameters",)))
    signature = _signature(code)
    for name in vectors:
        signature = signature.replace(f"double {name}", f"lanes {name}")
    return signature


def _parts(kernel: Kernel) -> tuple[Part, ...]:
    """The functions that a kernel calls, if it is cut into several."""
    cut = parts(kernel)
    return cut if len(cut) > 1 else ()


def _call_arguments(kernel: Kernel, u: str, t: str, parameters: str, value: str, slope: str | None) -> str:
    """The same parameters in a call."""
    parts = [u] if kernel.uses_arguments else []
    parts += [t] if kernel.uses_time else []
    parts += [parameters] if kernel.uses_parameters else []
    parts += [value]
    parts += [slope] if slope is not None else []
    return ", ".join(parts)


def _power_of_h(k: int) -> str:
    """C text of h^k as a factor."""
    product = "*".join(["h"] * abs(k))
    if k == 0:
        return "1.0"
    return product if k > 0 else f"1.0/({product})"


def _counts(kernel: Kernel) -> str:
    return ", ".join(f"{count} {operator}" for operator, count in kernel.operation_counts().items()) or "constants"


@cache
def template_environment() -> Environment:
    """The templates with the filters they use, loaded once."""
    environment = Environment(
        loader=FileSystemLoader(template_folder()),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        autoescape=False,
    )
    environment.globals["power_of_h"] = _power_of_h
    environment.filters |= {
        "number": print_number,
        "signature": _signature,
        "parts": _parts,
        "call_arguments": _call_arguments,
        "counts": _counts,
        "pairs": lambda entries: ", ".join(f"{{{i}, {j}}}" for i, j in entries),
        "transposed": lambda rows: tuple(zip(*rows, strict=True)),
        "lane_signature": _lane_signature,
        "statements": print_statements,
        "lane_statements": print_lane_statements,
    }
    return environment
