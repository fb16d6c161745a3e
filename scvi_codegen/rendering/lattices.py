"""Lattices of indexed systems as C: their location in the state, and their axes."""

from __future__ import annotations

from math import prod
from typing import Any

from scvi_codegen.indices import Array
from scvi_codegen.ir.program import Program
from scvi_codegen.rendering.sizes import product_text, size_text, sizes_text

__all__ = ["lattice_context", "roots_per_coordinate"]


def lattice_context(program: Program) -> dict[str, Any]:
    """Return the template's context for lattices."""
    before: list[str] = []
    lines: list[str] = []
    for array in program.layout.coordinates:
        sizes = ", ".join(size_text(axis) for axis in array.axes if axis.name)
        first = " + ".join(before) or "0"
        lines.append(
            f"{{.first = {first}, .components = {_components(array)}, .size = {{{sizes}}}, .axes = {_axes(array)}}}"
        )
        before.append(product_text(array))
    return {
        "lattices": lines,
        "axes": max(map(_axes, program.layout.coordinates)),
        "components": sum(map(_components, program.layout.coordinates)),
        "sizes": list(sizes_text(program, " ".join(lines))),
    }


def roots_per_coordinate(program: Program) -> int:
    """Return the doubles per coordinate that suffice for the roots of unity of every axis."""
    return 2 * max(map(_axes, program.layout.coordinates))


def _axes(array: Array) -> int:
    return sum(bool(axis.name) for axis in array.axes)


def _components(array: Array) -> int:
    return prod(axis.number for axis in array.axes if not axis.name)
