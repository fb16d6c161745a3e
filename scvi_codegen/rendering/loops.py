"""Systems of arrays as C: nested loops around kernels, and the template's context."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate
from typing import Any

from scvi_codegen.ir.constraints import ConstrainedSteps
from scvi_codegen.ir.kernel import Kernel, LoopedKernel
from scvi_codegen.ir.kernel_parts import is_divided
from scvi_codegen.ir.program import Program
from scvi_codegen.rendering.convergence import MAX_ITERATIONS
from scvi_codegen.rendering.functions import kernel_text
from scvi_codegen.rendering.lattices import lattice_context, roots_per_coordinate
from scvi_codegen.rendering.loop_nests import DIRECTION, Nest
from scvi_codegen.rendering.printer import inverse_roots, scalar_functions
from scvi_codegen.rendering.simd import LIBRARY, POINTS, IterationSource, iteration_source
from scvi_codegen.rendering.sizes import count_text, product_text, sizes_text
from scvi_codegen.rendering.target import DOUBLE
from scvi_codegen.rendering.thread_partition import MOST_THREADS, Sharing, sharing_of, sharing_text

__all__ = ["loop_context"]

EXPLICIT_VECTORS, CONSTRAINED_VECTORS, ITERATION_VECTORS = 4, 7, 4
"""Number of vectors in ``work``.

Positions, forces, increments; with constraints also constraint forces and trial increments; for iterations positions
at the points, forces in this step and in two former ones.
"""
NEWTON_VECTORS = 4 + 17
"""Further vectors: residual, correction, products, and the basis of GMRES (templates/support/gmres.h)."""
FOURIER_VECTORS = 2
"""Further vectors: scratch of Fourier transforms (templates/support/fourier_preconditioner.h)."""
HALVES_VECTORS = 7
"""Further vectors: the state at the start of a step and three increments (templates/support/indexed_halves.h)."""
X = "const double *restrict X"
CURSOR = "condition *now"


def loop_context(program: Program) -> dict[str, Any]:
    """Return the template's context for the program of a system of arrays."""
    loops, constrained = program.loops, program.loops.constrained
    terms = [(each, each.scalar) for each in loops.forces if each.scalar]
    terms += [(each, each.kernel) for each in loops.constants]
    scalars = [each.kernel for each in loops.masses] + [scalar for _, scalar in terms]
    if program.fixed_point is None:
        scalars += [each.kernel for each in loops.forces]
    if constrained:
        scalars += [each.kernel for each in (*constrained.conditions, *constrained.curvatures)]
    return {
        "program": program,
        "prefix": program.prefix,
        "target": DOUBLE,
        "real": DOUBLE.scalar,
        "max_iterations": MAX_ITERATIONS,
        "most_threads": 1 if constrained else MOST_THREADS,
        "cut": is_divided((*scalars, *(each.kernel for each in loops.applied))),
        "forces": [_force_text(program, each) for each in loops.applied],
        "energies": [_energy_text(program, each, scalar) for each, scalar in terms],
        "masses": [_mass_text(program, each) for each in loops.masses],
        "force_names": [each.kernel.name for each in loops.forces],
        "energy_names": [scalar.name for _, scalar in terms],
        "mass_names": [each.kernel.name for each in loops.masses],
        "scalar_kernels": [kernel_text(kernel, DOUBLE) for kernel in scalars],
        "inverse_roots": inverse_roots(scalars),
        "vector_functions": _vector_functions(program),
        "coordinates": " + ".join(map(product_text, program.layout.coordinates)),
        "fixed_point": _iteration_text(program),
        "work": _work(program),
        "iteration_vectors": ITERATION_VECTORS,
        "halves_vectors": HALVES_VECTORS,
        "hot": "static",
        "waves": lattice_context(program) if loops.reach else None,
        **_constraint_context(program, constrained),
    }


def _work(program: Program) -> int:
    """Return the number of doubles of ``work`` per coordinate."""
    if program.fixed_point is None:
        return CONSTRAINED_VECTORS if program.loops.constrained else EXPLICIT_VECTORS
    own = 2 * ITERATION_VECTORS if program.layout.momenta else ITERATION_VECTORS + bool(program.layout.velocities)
    linear = NEWTON_VECTORS + program.fixed_point.lanes if program.loops.products else 0
    waves = FOURIER_VECTORS * program.fixed_point.lanes + roots_per_coordinate(program) if program.loops.reach else 0
    return (own + linear) * program.fixed_point.lanes + waves + HALVES_VECTORS


def _iteration_text(program: Program) -> IterationSource | None:
    fixed_point, kernels = program.fixed_point, [each.kernel for each in program.loops.applied]
    return iteration_source(fixed_point, POINTS, fallback="none", kernels=kernels) if fixed_point else None


def _vector_functions(program: Program) -> list[str]:
    """Return the functions of the vector library that occur in the forces of an explicit method."""
    kernels = [each.kernel for each in program.loops.forces] if program.fixed_point is None else []
    return sorted(set(LIBRARY) & set().union(*map(scalar_functions, kernels)))


def _force_text(program: Program, looped: LoopedKernel) -> str:
    """Return a function that adds to the forces; for an explicit method, with a factor."""
    explicit = program.fixed_point is None
    chunked, sharing = explicit and bool(looped.loops), sharing_of(looped)
    nest = Nest(program, looped, "lanes", "X", chunked=chunked, sharing=sharing)
    slots = range(len(looped.targets))
    inner = [nest.is_innermost(target) for target in looped.targets]

    def added(k: int, value: str) -> list[str]:
        return nest.adding(k, value) if inner[k] else [f"sum_{k} += {value};"]

    call = f"{looped.kernel.name}(u, t, parameters, value);"
    if nest.chunked:
        here = f"[index_{looped.loops[-1].index} - begin]"
        innermost = [call, *(f"values[{k}]{here} = by * value[{k}];" for k in slots)]
        behind = [added(k, f"values[{k}]{here}") for k in slots]
    else:
        innermost = [call, *(line for k in slots for line in added(k, f"{'by * ' * explicit}value[{k}]"))]
        behind = []
    lines = nest.text(
        prepare=lambda k: [f"lanes sum_{k} = zero;"],
        innermost=innermost,
        behind=behind,
        finish=lambda k: nest.adding(k, f"sum_{k}"),
    )
    zero = [] if all(inner) else ["const lanes zero = {0};"]
    factor = ["double by"] if explicit else []
    direction = [f"const lanes *{DIRECTION}"] if looped.along else []
    arguments = ["const problem *given", "const lanes *restrict X", "times t", *direction, *factor, "lanes *restrict F"]
    arguments += ["const window *here"]
    if sharing is Sharing.BY_PLACES:
        zero.append("const int whole = here->whole;")
    unused = ["(void)here;"] if sharing is Sharing.ALONE else []
    values = f"lanes value[{len(looped.targets)}]"
    text = nest.function(f"static void add_{looped.kernel.name}", arguments, [*unused, *zero, *lines], values=values)
    return f"{text}\n\n{_sharing_text(program, looped)}"


def _sharing_text(program: Program, looped: LoopedKernel) -> str:
    """Return a function that describes how threads share a term group."""
    how = sharing_text(looped)
    known = [*sizes_text(program, how), *(f"(void){name};" for name in ("run", "given", "n"))]
    head = f"static sharing share_{looped.kernel.name}(const run_memory *run, const problem *given, long long n)"
    lines = "\n".join(f"  {line}" for line in [*known, f"return {how};"])
    return f"/* Its rounds of tasks. */\n{head}\n{{\n{lines}\n}}"


def _energy_text(program: Program, looped: LoopedKernel, kernel: Kernel) -> str:
    """Return a function that computes the sum of the terms."""
    nest = Nest(program, looped, "double", "q")
    lines = nest.text(
        prepare=lambda k: [],
        innermost=[f"{kernel.name}(u, t, parameters, value);", "add_to_sum(total, value[0]);"],
        finish=lambda k: [],
    )
    arguments = ["const problem *given", "const double *q", "double t", "compensated *total"]
    return nest.function(f"static void sum_{kernel.name}", arguments, lines, values="double value[1]")


def _mass_text(program: Program, looped: LoopedKernel) -> str:
    """Return a function that adds to the masses."""
    nest = Nest(program, looped, "", "")
    place = nest.place_of(looped.targets[0])
    lines = nest.text(
        prepare=lambda k: [],
        innermost=[
            f"{looped.kernel.name}(NULL, 0.0, parameters, value);",
            f"mass[{place}] += value[0];",
        ],
        finish=lambda k: [],
    )
    arguments = ["const problem *given", "double *mass"]
    return nest.function(f"static void add_{looped.kernel.name}", arguments, lines, values="double value[1]")


def _constraint_context(program: Program, held: ConstrainedSteps | None) -> dict[str, Any]:
    """Return the template's context for constraints."""
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


def _texts(program: Program, held: ConstrainedSteps) -> tuple[list[str], list[str], list[str]]:
    """Return one function per constraint for g, g_t and derivatives, one for second derivatives, one for indices."""
    return (
        [_condition(program, each) for each in held.conditions],
        [_curvature(program, each) for each in held.curvatures],
        [_places(program, each) for each in held.conditions],
    )


def _condition(program: Program, looped: LoopedKernel) -> str:
    name, count = looped.kernel.name, len(looped.slots)
    lines = [
        f"{name}(u, t, parameters, value);",
        "now->g[now->count] = value[0];",
        "now->rate[now->count++] = value[1];",
        *(f"now->derivative[now->entries++] = value[{k + 2}];" for k in range(count)),
    ]
    arguments = ["const problem *given", X, "double t", CURSOR]
    return _function(Nest(program, looped, "double", "X"), f"find_{name}", arguments, lines, count + 2)


def _curvature(program: Program, looped: LoopedKernel) -> str:
    name = looped.kernel.name
    lines = [f"{name}(u, t, parameters, value);", "now->g[now->count++] = value[0];"]
    arguments = ["const problem *given", X, f"const double *restrict {DIRECTION}", "double t", CURSOR]
    return _function(Nest(program, looped, "double", "X"), f"find_{name}", arguments, lines, 1)


def _places(program: Program, looped: LoopedKernel) -> str:
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
