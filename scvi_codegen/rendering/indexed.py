"""Indexed systems as C: nested loops around kernels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from scvi_codegen.ir.indexed import IndexedProgram
from scvi_codegen.ir.kernel import Kernel, LoopedKernel
from scvi_codegen.ir.kernel_parts import is_divided
from scvi_codegen.rendering.control import predictor_text
from scvi_codegen.rendering.convergence import MAX_ITERATIONS
from scvi_codegen.rendering.environment import support_text, template_environment
from scvi_codegen.rendering.functions import kernel_text
from scvi_codegen.rendering.indexed_constraints import constraint_context
from scvi_codegen.rendering.lattices import lattice_context, roots_per_coordinate
from scvi_codegen.rendering.loop_nests import DIRECTION, Nest
from scvi_codegen.rendering.printer import INVERSE_ROOT, scalar_functions
from scvi_codegen.rendering.simd import LIBRARY, POINTS, IterationSource, iteration_source
from scvi_codegen.rendering.sizes import product_text, sizes_text
from scvi_codegen.rendering.source import Source, included
from scvi_codegen.rendering.target import DOUBLE
from scvi_codegen.rendering.thread_partition import MOST_THREADS, Sharing, sharing_of, sharing_text

__all__ = ["render_indexed", "render_indexed_example"]

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


def render_indexed(program: IndexedProgram) -> Source:
    """Return header and source of a program. Equal programs give equal bytes."""
    environment = template_environment()
    terms = [(each, each.scalar) for each in program.forces if each.scalar]
    terms += [(each, each.kernel) for each in program.constants]
    scalars = [each.kernel for each in program.masses] + [scalar for _, scalar in terms]
    if program.fixed_point is None:
        scalars += [each.kernel for each in program.forces]
    if program.held:
        scalars += [each.kernel for each in (*program.held.conditions, *program.held.curvatures)]
    applied = (*program.forces, *program.products, *program.diagonals)
    context = {
        "program": program,
        "prefix": program.prefix,
        "target": DOUBLE,
        "real": DOUBLE.scalar,
        "max_iterations": MAX_ITERATIONS,
        "most_threads": 1 if program.held else MOST_THREADS,
        "cut": is_divided((*scalars, *(each.kernel for each in applied))),
        "forces": [_force_text(program, each) for each in applied],
        "energies": [_energy_text(program, each, scalar) for each, scalar in terms],
        "masses": [_mass_text(program, each) for each in program.masses],
        "force_names": [each.kernel.name for each in program.forces],
        "energy_names": [scalar.name for _, scalar in terms],
        "mass_names": [each.kernel.name for each in program.masses],
        "scalar_kernels": [kernel_text(kernel, DOUBLE) for kernel in scalars],
        "inverse_roots": _inverse_roots(scalars),
        "vector_functions": _vector_functions(program),
        "coordinates": " + ".join(map(product_text, program.coordinates)),
        "fixed_point": _iteration_text(program),
        "work": _work(program),
        "iteration_vectors": ITERATION_VECTORS,
        "halves_vectors": HALVES_VECTORS,
        "hot": "static",
        "waves": lattice_context(program) if program.reach else None,
        **constraint_context(program),
    }
    code = environment.get_template("indexed.c.jinja").render(context)
    control = program.control
    own = (
        {f"support/{program.prefix}_predictor.h": predictor_text(control.predictor)}
        if control and control.predictor
        else {}
    )
    return Source(
        prefix=program.prefix,
        header=environment.get_template("indexed.h.jinja").render(context),
        code=code,
        declarations=environment.get_template("parts/indexed_declarations.h.jinja").render(context),
        support=tuple((name, own.get(name) or support_text(name)) for name in included(code)),
    )


def render_indexed_example(prefix: str, **start: Any) -> dict[str, str]:
    """Return ``main.c`` and ``Makefile`` that run the integrator from arrays in files of the same folder.

    Args:
        prefix: of the C names.
        start: title, momenta (whether the system is Hamiltonian), numbers, sizes, fields and tables with their lengths,
            moving ("p", "velocity" or nothing), constraints (whether there are any), run (t, h, steps, save_every).
    """
    environment, context = template_environment(), {"prefix": prefix, "target": DOUBLE, "threads": True, **start}
    templates = {"main.c": "indexed_main.c.jinja", "Makefile": "Makefile.jinja"}
    return {name: environment.get_template(template).render(context) for name, template in templates.items()}


def _work(program: IndexedProgram) -> int:
    """Return the number of doubles of ``work`` per coordinate."""
    if program.fixed_point is None:
        return CONSTRAINED_VECTORS if program.held else EXPLICIT_VECTORS
    own = 2 * ITERATION_VECTORS if program.momenta else ITERATION_VECTORS + bool(program.velocities)
    linear = NEWTON_VECTORS + program.fixed_point.lanes if program.products else 0
    waves = FOURIER_VECTORS * program.fixed_point.lanes + roots_per_coordinate(program) if program.reach else 0
    return (own + linear) * program.fixed_point.lanes + waves + HALVES_VECTORS


def _iteration_text(program: IndexedProgram) -> IterationSource | None:
    applied = (*program.forces, *program.products, *program.diagonals)
    fixed_point, kernels = program.fixed_point, [each.kernel for each in applied]
    return iteration_source(fixed_point, POINTS, fallback="none", kernels=kernels) if fixed_point else None


def _vector_functions(program: IndexedProgram) -> list[str]:
    """Return the functions of the vector library that occur in the forces of an explicit method."""
    kernels = [each.kernel for each in program.forces] if program.fixed_point is None else []
    return sorted(set(LIBRARY) & set().union(*map(scalar_functions, kernels)))


def _inverse_roots(kernels: Sequence[Kernel]) -> list[int]:
    names = set().union(*map(scalar_functions, kernels))
    return sorted(int(name.removeprefix(INVERSE_ROOT)) for name in names if name.startswith(INVERSE_ROOT))


def _force_text(program: IndexedProgram, looped: LoopedKernel) -> str:
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


def _sharing_text(program: IndexedProgram, looped: LoopedKernel) -> str:
    """Return a function that describes how threads share a term group."""
    how = sharing_text(looped)
    known = [*sizes_text(program, how), *(f"(void){name};" for name in ("run", "given", "n"))]
    head = f"static sharing share_{looped.kernel.name}(const run_memory *run, const problem *given, long long n)"
    lines = "\n".join(f"  {line}" for line in [*known, f"return {how};"])
    return f"/* Its rounds of tasks. */\n{head}\n{{\n{lines}\n}}"


def _energy_text(program: IndexedProgram, looped: LoopedKernel, kernel: Kernel) -> str:
    """Return a function that computes the sum of the terms."""
    nest = Nest(program, looped, "double", "q")
    lines = nest.text(
        prepare=lambda k: [],
        innermost=[f"{kernel.name}(u, t, parameters, value);", "add_to_sum(total, value[0]);"],
        finish=lambda k: [],
    )
    arguments = ["const problem *given", "const double *q", "double t", "compensated *total"]
    return nest.function(f"static void sum_{kernel.name}", arguments, lines, values="double value[1]")


def _mass_text(program: IndexedProgram, looped: LoopedKernel) -> str:
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
