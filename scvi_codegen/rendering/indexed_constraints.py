"""Constraints of indexed systems as C: values, derivatives, and the coordinates they act on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate
from typing import Any

from scvi_codegen.ir.indexed import ConstrainedSteps, IndexedProgram
from scvi_codegen.ir.kernel import LoopedKernel
from scvi_codegen.rendering.loop_nests import DIRECTION, Nest
from scvi_codegen.rendering.sizes import count_text, sizes_text

__all__ = ["constraint_context"]

X = "const double *restrict X"
CURSOR = "condition *now"


def constraint_context(program: IndexedProgram) -> dict[str, Any]:
    """Return the template's context for constraints."""
    held = program.held
    if held is None:
        return {"held": None}
    counts = [count_text(each.loops) for each in held.conditions]
    entries = [f"{count} * {len(each.slots)}" for count, each in zip(counts, held.conditions, strict=True)]
    found = {
        "functions": [text for pair in zip(*_texts(program, held), strict=True) for text in pair],
        "conditions": [each.kernel.name for each in held.conditions],
        "curvatures": [each.kernel.name for each in held.curvatures],
        "sizes": list(sizes_text(program, " ".join(counts))),
        "count": " + ".join(counts),
        "entries": " + ".join(entries),
    }
    return {"held": found, "part_ends": list(accumulate(held.parts))}


def _texts(program: IndexedProgram, held: ConstrainedSteps) -> tuple[list[str], list[str], list[str]]:
    """Return one function per constraint for g, g_t and derivatives, one for second derivatives, one for indices."""
    return (
        [_condition(program, each) for each in held.conditions],
        [_curvature(program, each) for each in held.curvatures],
        [_places(program, each) for each in held.conditions],
    )


def _condition(program: IndexedProgram, looped: LoopedKernel) -> str:
    name, count = looped.kernel.name, len(looped.slots)
    lines = [
        f"{name}(u, t, parameters, value);",
        "now->g[now->count] = value[0];",
        "now->rate[now->count++] = value[1];",
        *(f"now->derivative[now->entries++] = value[{k + 2}];" for k in range(count)),
    ]
    arguments = ["const problem *given", X, "double t", CURSOR]
    return _function(Nest(program, looped, "double", "X"), f"find_{name}", arguments, lines, count + 2)


def _curvature(program: IndexedProgram, looped: LoopedKernel) -> str:
    name = looped.kernel.name
    lines = [f"{name}(u, t, parameters, value);", "now->g[now->count++] = value[0];"]
    arguments = ["const problem *given", X, f"const double *restrict {DIRECTION}", "double t", CURSOR]
    return _function(Nest(program, looped, "double", "X"), f"find_{name}", arguments, lines, 1)


def _places(program: IndexedProgram, looped: LoopedKernel) -> str:
    bare = replace(looped, slots=(), given=())
    nest = Nest(program, bare, "", "")
    lines = [
        "now->first[now->count++] = (int)now->entries;",
        *(f"now->place[now->entries++] = (int)({nest.place_of(target)});" for target in looped.targets),
    ]
    return _function(nest, f"place_{looped.kernel.name}", ["const problem *given", CURSOR], lines, 0)


def _function(nest: Nest, name: str, arguments: Sequence[str], lines: Sequence[str], values: int) -> str:
    text = ["(void)given;", *nest.text(prepare=lambda k: [], innermost=lines, finish=lambda k: [])]
    return nest.function(f"static void {name}", arguments, text, values=f"double value[{values}]" if values else "")
