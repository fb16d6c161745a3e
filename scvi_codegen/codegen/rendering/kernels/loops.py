"""Systems of arrays as C: functions of nested loops around kernels, lattices, and the template's context."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import accumulate, groupby
from math import prod
from typing import Any

from scvi_codegen.codegen.ir.equations import ConstrainedSteps
from scvi_codegen.codegen.ir.kernel import CallsApart, Kernel, RolledKernel, calls_apart, is_divided
from scvi_codegen.codegen.ir.program import ArrayProgram, Layout
from scvi_codegen.codegen.rendering.kernels.functions import kernel_text
from scvi_codegen.codegen.rendering.kernels.loop_nests import (
    DIRECTION,
    Nest,
    Sharing,
    count_text,
    counter,
    describing_function,
    function_of_sizes,
    product_text,
    sharing_of,
    sharing_text,
    size_text,
)
from scvi_codegen.codegen.rendering.kernels.printer import DOUBLE, inverse_roots
from scvi_codegen.codegen.rendering.kernels.simd import LIBRARY, OF_TWO, POINTS, iteration_source, loop_functions
from scvi_codegen.systems.formulas.indices import MOST_THREADS, Array, Convolution, couples_elements


def _reach(layout: Layout, rolled: RolledKernel) -> int | None:
    """Return the largest distance of coupled rows, the entries with the same first index; ``None`` if unknown."""
    loops, entries = rolled.loops, (*rolled.reads, *rolled.writes)
    if not loops or loops[0].near or any(not access.places for access in entries):
        return None
    rows = [access.places[0] for access in entries]
    along = all(row.index == loops[0].index and not (row.table or row.minus or row.base.name) for row in rows)
    whole = {array.axes[0] for array in layout.coordinates if array.axes} == {loops[0].end} or not loops[0].periodic
    return max(abs(row.base.number) for row in rows) if along and whole else None


MOST_ADDENDS = 4
"""Largest number of values that are added to an element in the loop that continues it (array_rows.h)."""


def rows_text(layout: Layout, forces: Sequence[RolledKernel]) -> tuple[str, str, str] | None:
    """Return constants and functions of forces row by row, for templates/support/arrays/array_rows.h.

    Then the name of the group that continues coordinates itself, or nothing. ``None`` unless all coordinates have the
    same first axis, and at most one term group couples rows, at a distance. In other loops over rows
    functions of a library must not occur, since vectors of them round differently.
    """
    axes = {array.axes[:1] for array in layout.coordinates}
    reaches = [reach for rolled in forces if (reach := _reach(layout, rolled)) is not None]
    if len(axes) != 1 or axes == {()} or not forces or len(reaches) < len(forces) or sum(map(bool, reaches)) > 1:
        return None
    lead, ((axis,),) = reaches.index(max(reaches)), axes
    coupling, before, behind = forces[lead], forces[:lead], forces[lead + 1 :]
    others = _kernels_of(rolled for rolled in (*before, *behind) if len(rolled.loops) == 1)
    if {*map(sharing_of, forces)} != {Sharing.IN_TURN} or loop_functions(others):
        return None
    # in a lattice of one axis the terms behind an element of all targets neither read nor change it
    writes, chunked = coupling.writes, len(coupling.loops) == 1
    fused = chunked and not behind and len(layout.coordinates) == 1 and {*coupling.reads} <= {*writes}
    fused &= 1 < len(writes) <= MOST_ADDENDS and all(len(target.places) == 1 for target in writes)
    constants = {"REACH": reaches[lead], "CHUNKED_ROWS": int(chunked), "FUSED": int(fused), "FRESH": int(not before)}
    rows = function_of_sizes(layout, "static long long rows_of(const problem *arrays)", [f"return {size_text(axis)};"])
    listed = ",\n  ".join(f"{name} = {number}" for name, number in constants.items())
    parts = (("prepare", before), ("add", (coupling,)), ("complete", behind))
    return (
        f"enum {{\n  {listed}\n}};\n#define share_rows share_{coupling.kernel.name}\n\n{rows}",
        "\n\n".join(_part(*part, fused=fused and name == "add") for part in parts for name in part[:1]),
        coupling.kernel.name if fused else "",
    )


def _part(name: str, forces: Sequence[RolledKernel], *, fused: bool) -> str:
    """Return the function of some term groups."""
    head = f"static void {name}_rows({'' if name == 'add' else 'const '}sweep *of, section rows)"
    lines = [head, "{", "  window here;", "  (void)here;"]
    for rolled in forces:
        group = rolled.kernel.name
        lines.append(f"  here = window_of_rows(share_{group}(of->run, of->arrays, of->work->n), rows);")
        lines.append(f"  add_{group}(of->arrays, of->X, of->t, of->by, of->F, &here{', of' if fused else ''});")
    return "\n".join([*lines, "}"])


EXPLICIT_VECTORS, CONSTRAINED_VECTORS, ITERATION_VECTORS = 7, 7, 4
"""Number of vectors in ``work``.

Positions, forces, and a former state with its forces; with constraints positions, forces, increments, constraint forces
and trial increments; for iterations positions at the points, forces in this step and in two former ones.
"""
NEWTON_VECTORS = 4 + 17
"""Further vectors: residual, correction, products, and the basis of GMRES (templates/support/arrays/newton_gmres.h)."""
FOURIER_VECTORS = 2
"""Further vectors: Fourier transforms (templates/support/arrays/preconditioner.h)."""
PLAN_VECTORS, TRANSFORM_VECTORS, TRANSFORM_ALIGNMENT = 7, 4, 8
"""Further vectors: plan of each circulant matrix, transforms and their alignment (support/arrays/circulant.h)."""
STEP_VECTORS = 14
"""Further vectors: inverse sizes, parts of a step, its increments (templates/support/arrays/work_arrays.h)."""


def loop_context(program: ArrayProgram) -> dict[str, Any]:
    """Return the template's context for the program of a system of arrays."""
    loops, constrained, pairs = program.loops, program.loops.constrained, _circulants(program)
    sums, fixed_point, layout = _convolutions(program), program.fixed_point, program.layout
    rows = rows_text(layout, loops.forces) if program.splitting and not (pairs or sums) else None
    lengths = [*map(product_text, layout.fields)]
    terms = [(rolled, rolled.scalar) for rolled in loops.forces if rolled.scalar]
    terms += [(rolled, rolled.kernel) for rolled in loops.constants]
    constants = (*loops.masses, *loops.frictions, *loops.heats)
    applied, forces = _kernels_of(loops.applied), _kernels_of(loops.forces)
    scalars = _scalar_kernels(program, [*_kernels_of(constants), *(scalar for _, scalar in terms)])
    return {
        "program": program,
        "most_threads": 1 if constrained else MOST_THREADS,
        "cut": is_divided((*scalars, *applied)),
        "forces": [_force_text(program, rolled, rows[2] if rows else "") for rolled in loops.applied],
        "energies": [_energy_text(program, rolled, scalar, declared=rolled in pairs) for rolled, scalar in terms],
        "masses": [_mass_text(program, rolled) for rolled in constants],
        "lists": [(name, _list_text(program, count, lengths)) for name, count, lengths in loops.neighbours],
        "force_names": [kernel.name for kernel in forces],
        "energy_names": [(scalar.name, _has_sums(rolled)) for rolled, scalar in terms],
        "equal_masses": [*map(_is_uniform, loops.masses)] == [True],
        "mass_names": [kernel.name for kernel in _kernels_of(loops.masses)],
        "scalar_kernels": [kernel_text(kernel, DOUBLE) for kernel in scalars],
        "inverse_roots": inverse_roots(scalars),
        "vector_functions": loop_functions([] if program.fixed_point else forces),  # of an explicit method
        "coordinates": function_of_sizes(
            layout,
            "static long long coordinates_of(const problem *arrays)",
            [f"return {' + '.join(map(product_text, layout.coordinates))};"],
        ),
        "fixed_point": fixed_point and iteration_source(fixed_point, POINTS, kernels=applied),
        "work": _step_work(program) + _transform_work(program),
        "continued": loops.continued,
        "site_functions": [_site_text(program, rolled) for rolled in (*loops.velocities, *loops.momenta)],
        "field_lengths": function_of_sizes(
            layout,
            "static void field_lengths(const problem *arrays, long long *length)",
            [*(f"length[{k}] = {length};" for k, length in enumerate(lengths)), "(void)length;"],
        ),
        "maps": describing_function(layout, "maps", "momentum_map", [*_map_texts(program)]),
        "hot": "static",
        "rows": rows,
        "arrays": function_of_sizes(
            layout,
            "static inline void describe_coordinate_arrays(const problem *arrays, coordinate_array *all)",
            ["long long end = 0;", *_appended_arrays(program)],
        ),
        **_constraint_context(program, constrained),
        **_transform_context(program, pairs, sums),
    }


def _kernels_of(groups: Iterable[RolledKernel]) -> list[Kernel]:
    return [rolled.kernel for rolled in groups]


def _scalar_kernels(program: ArrayProgram, first: Sequence[Kernel]) -> list[Kernel]:
    """Return the kernels of numbers: the first ones, of explicit forces, of constraints and of sites."""
    loops, kernels = program.loops, [*first]
    for rolled in loops.forces if program.fixed_point is None else ():
        apart = _apart(rolled)
        kernels += apart[1:] if apart else [rolled.kernel]
    if loops.constrained:
        kernels += _kernels_of((*loops.constrained.conditions, *loops.constrained.curvatures))
    return kernels + _kernels_of((*loops.velocities, *loops.momenta))


def _transform_context(program: ArrayProgram, pairs: Sequence[RolledKernel], sums: Sequence[str]) -> dict[str, Any]:
    """Return the context of Fourier transforms: forces of circulant pairs, convolutions, plans and lattices."""
    return {
        "circulants": {rolled.kernel.name: _circulant_text(program, rolled) for rolled in pairs},
        "sums": len(sums),
        "convolutions": describing_function(program.layout, "convolutions", "convolution", sums),
        "summed": [rolled.kernel.name for rolled in program.loops.applied if _has_sums(rolled)],
        "plans": len(_plans(program)),
        "most_stages": max((len(_stages(convolutions)) for convolutions in program.layout.sums), default=0),
        "waves": _lattice_context(program) if _on_lattices(program) else None,
    }


def _is_uniform(mass: RolledKernel) -> bool:
    """Return whether a mass adds the same number once to every element that it adds to."""
    places = mass.writes[0].places
    return not mass.constants and len(mass.loops) == len(places) and not any(place.table for place in places)


def _appended_arrays(program: ArrayProgram) -> Iterator[str]:
    """Yield the statements that describe the arrays of coordinates."""
    for k, array in enumerate(program.layout.coordinates):
        is_field = any(couples_elements(array, rolled.reads, rolled.constants) for rolled in program.loops.applied)
        yield f"end = append_array(&all[{k}], end, {product_text(array)}, {int(is_field)});"


def _map_texts(program: ArrayProgram) -> Iterator[str]:
    """Yield the initialisers of the descriptions of momentum maps (templates/support/arrays/array_states.h)."""
    arrays = {array.name: array for array in program.layout.coordinates}
    for conserved in program.loops.maps:
        array, component, other = arrays[conserved.array], conserved.component, conserved.other
        kind = "TRANSLATION" if other is None else "ROTATION"
        if conserved.phase:
            kind = "PHASE"
        components = 1 if component is None else array.axes[-1].number
        numbers, start = f"{component or 0}, {other or 0}", f"start_{array.name}"
        yield f"{{{start}, {start} + {product_text(array)}, {components}, {numbers}, {kind}}}"


def _site_text(program: ArrayProgram, rolled: RolledKernel) -> str:
    """Return a function that computes velocities or momenta of the elements of a term, from the joined state."""
    place_of, name = Nest(program.layout, rolled, "", "").place_of, rolled.kernel.name
    stored = [f"result[{place_of(access)}] = value[{k}];" for k, access in enumerate(rolled.writes)]
    arguments = ["const double *X", "double t", "double *result"]
    lines = [f"{name}(u, t, parameters, value);", *stored]
    return _function(program, rolled, f"find_{name}", arguments, lines, values=len(stored))


def _circulants(program: ArrayProgram) -> list[RolledKernel]:
    """Return the terms whose forces, or products with a direction, are products with circulant matrices."""
    return [rolled for rolled in program.loops.applied if rolled.circulant is not None]


def _has_sums(rolled: RolledKernel) -> bool:
    return any(access.sums for access in rolled.reads)


def _stages(sums: Sequence[Convolution]) -> list[tuple[int, str, int]]:
    """Return the axis, the array of coefficients and the power of each circulant matrix of convolutions in turn."""
    alike = groupby(sums, key=lambda convolution: (convolution.axis, convolution.coefficients.name))
    return [(*stage, len([*group])) for stage, group in alike]


def _plans(program: ArrayProgram) -> list[tuple[str, int]]:
    """Return the arrays of coefficients and powers of all circulant matrices; of sums over pairs the power is 0."""
    pairs = [(rolled.constants[0].array.name, 0) for rolled in _circulants(program)]
    return [*dict.fromkeys([*pairs, *(stage[1:] for sums in program.layout.sums for stage in _stages(sums))])]


def _convolutions(program: ArrayProgram) -> list[str]:
    """Return the convolutions of each array in C: their number, whether forces are derivatives by them, stages."""
    kernels = program.loops.applied
    reads, writes = (
        dict.fromkeys(
            (access.sums, access.array) for rolled in kernels for access in getattr(rolled, kind) if access.sums
        )
        for kind in ("reads", "writes")
    )
    texts = []
    for sums, array in reads:
        stages = [_circulant_matrix(program, array, *stage) for stage in _stages(sums)]
        number, target = program.layout.sums.index(sums), int((sums, array) in writes)
        texts.append(f"{{{number}, {target}, {len(stages)}, {{{', '.join(stages)}}}}}")
    return texts


def _transform_work(program: ArrayProgram) -> int:
    """Return the number of doubles per coordinate of Fourier transforms."""
    lanes, plans = program.fixed_point.lanes if program.fixed_point else 1, len(_plans(program))
    states = 2 if program.layout.momenta or program.layout.velocities else 1
    kinds = 3 if program.loops.products else 2  # values, derivatives by them, and values along a direction
    vectors = TRANSFORM_VECTORS + states * kinds * len(program.layout.sums)
    return vectors * lanes + TRANSFORM_ALIGNMENT + PLAN_VECTORS * plans if plans else 0


def _step_work(program: ArrayProgram) -> int:
    """Return the number of doubles per coordinate that the method uses."""
    if program.fixed_point is None:
        return CONSTRAINED_VECTORS + bool(program.layout.velocities) if program.loops.constrained else EXPLICIT_VECTORS
    momenta, velocities = bool(program.layout.momenta), bool(program.layout.velocities)
    iteration = (1 + momenta) * ITERATION_VECTORS + velocities
    newton = (1 + momenta + velocities) * NEWTON_VECTORS + program.fixed_point.lanes
    linear = newton if program.loops.products else 0
    roots = 2 * max(map(_axes, program.layout.coordinates))  # of unity, of every axis
    waves = (1 + momenta) * FOURIER_VECTORS * program.fixed_point.lanes + roots if _on_lattices(program) else 0
    return (iteration + linear) * program.fixed_point.lanes + waves + STEP_VECTORS


def _apart(rolled: RolledKernel) -> CallsApart | None:
    """Return the kernel of an explicit method's forces on a lattice with calls of the vector library apart."""
    return calls_apart(rolled.kernel, {*LIBRARY} - {*OF_TWO}) if sharing_of(rolled) is Sharing.IN_TURN else None


def _force_text(program: ArrayProgram, rolled: RolledKernel, fused_group: str) -> str:
    """Return a function that adds to the forces; for an explicit method, with a factor."""
    explicit, fused = program.fixed_point is None, rolled.kernel.name == fused_group
    chunked, sharing = explicit and bool(rolled.loops), sharing_of(rolled)
    apart = _apart(rolled) if explicit else None
    rolled = replace(rolled, kernel=apart.rest) if apart else rolled
    nest = Nest(program.layout, rolled, "lanes", "X", chunked=chunked, fused=fused, sharing=sharing, apart=apart)
    slots = range(len(rolled.writes))
    inner = [nest.is_innermost(target) for target in rolled.writes]

    def added(k: int, value: str) -> list[str]:
        return nest.adding(k, value) if inner[k] else [f"sum_{k} += {value};"]

    call, functions = f"{rolled.kernel.name}(u, t, parameters, value);", apart.functions if apart else ()
    if nest.chunked:
        at = counter(rolled.loops[-1])
        here, first = f"[{at} - begin]", len(rolled.reads)
        called = [f"u[{first + k}] = called[{k}][{at} - chunk];" for k in range(len(functions))]
        (sign, at_once), by = nest.signed[0], [f"{'by * ' * (not fused)}value[{k}]" for k in nest.stored]
        innermost = [*called, call, *(added(0, f"{sign.strip('+')}{by[at_once]}") if nest.adds_at_once else [])]
        kept = [n for n in range(len(by)) if n != at_once or not nest.adds_at_once]
        innermost += [f"values[{n}]{here} = {by[n]};" for n in kept]
        behind = [added(k, f"{sign.strip('+')}values[{n}]{here}") for k, (sign, n) in enumerate(nest.signed)]
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
    direction = [f"const lanes *{DIRECTION}"] if rolled.along else []
    alone = "" if fused else "restrict "  # X and F may be the state that is continued
    arguments = ["const problem *arrays", f"const lanes *{alone}X", "times t", *direction, *factor, f"lanes *{alone}F"]
    arguments += ["const window *here", *(["const images *sums"] if _has_sums(rolled) else [])]
    arguments += ["sweep *of"] if fused else []
    if sharing is Sharing.BY_PLACES:
        zero.append("const int whole = here->whole;")
    body = [*zero, *lines]
    head, values = f"static void add_{rolled.kernel.name}", f"lanes value[{max(len(rolled.writes), len(functions))}]"
    text = nest.function(head, arguments, body, values=values)
    return f"{text}\n\n{_sharing_text(program, rolled)}"


def _circulant_text(program: ArrayProgram, rolled: RolledKernel) -> str:
    """Return functions that describe the circulant matrix of a term and return its factor, and that add its energy."""
    nest, name, scalar = Nest(program.layout, rolled, "lanes", "X"), rolled.kernel.name, rolled.scalar
    matrix = _matrix_of_pairs(program, rolled)
    unit = f"parameters[{len(program.layout.parameters)}] = 1.0;"
    lines = [
        f"*matrix = {matrix};",
        *(f"u[{k}] = lanes_of({1 - k % 2}.0);" for k in range(len(rolled.reads))),
        unit,
        f"{name}(u, t, parameters, value);",
        "return value[0];",
    ]
    arguments = ["const problem *arrays", "times t", "circulant *matrix"]
    force = nest.function(f"static lanes describe_{name}", arguments, lines, values="lanes value[2]")
    return f"{force}\n\n{_energy_text(program, rolled, scalar, before=[unit])}" if scalar else force


def _matrix_of_pairs(program: ArrayProgram, rolled: RolledKernel) -> str:
    """Return the description of the circulant matrix of a sum over pairs in C."""
    array, name = rolled.reads[0].array, rolled.constants[0].array.name
    return f"(circulant){_circulant_matrix(program, array, rolled.circulant or 0, name, 0)}"


def _circulant_matrix(program: ArrayProgram, array: Array, axis: int, coefficients: str, power: int) -> str:
    """Return the initialiser of the description of a circulant matrix in C."""
    outer, inner = (product_text(replace(array, axes=axes)) for axes in (array.axes[:axis], array.axes[axis + 1 :]))
    plan, size = _plans(program).index((coefficients, power)), size_text(array.axes[axis])
    field = [array.name for array in program.layout.fields].index(coefficients)
    return f"{{start_{array.name}, {outer}, {size}, {inner}, arrays->field[{field}], {power}, {plan}}}"


def _list_text(program: ArrayProgram, components: int, lengths: RolledKernel) -> str:
    """Return a function that describes the points of a list of neighbours."""
    nest = Nest(program.layout, lengths, "double", "")
    start, name = nest.place_of(lengths.writes[0]), lengths.kernel.name
    lines = [
        f"{name}(NULL, 0.0, arrays->parameters, of->lengths);",
        f"of->start = {start};",
        f"of->count = {size_text(lengths.writes[0].array.axes[0])};",
        f"of->components = {components};",
    ]
    text = nest.function(f"static void describe_{name}", ["const problem *arrays", "point_list *of"], lines)
    return f"{kernel_text(lengths.kernel, DOUBLE)}\n\n{text}"


def _sharing_text(program: ArrayProgram, rolled: RolledKernel) -> str:
    """Return a function that describes how threads share a term group."""
    head = f"static sharing share_{rolled.kernel.name}(const run_memory *run, const problem *arrays, long long n)"
    lines = [f"return {sharing_text(rolled)};"]
    return f"/* Its rounds of tasks. */\n{function_of_sizes(program.layout, head, lines)}"


def _function(
    program: ArrayProgram,
    rolled: RolledKernel,
    name: str,
    arguments: Sequence[str],
    lines: Sequence[str],
    *,
    values: int = 1,
    source: str = "X",
    before: Sequence[str] = (),
) -> str:
    """Return a function of numbers with the same statements for every element, and others before."""
    nest = Nest(program.layout, rolled, "double", source)
    text = [*before, *nest.text(innermost=lines)]
    declared = f"double value[{values}]" if values else ""
    return nest.function(f"static void {name}", ["const problem *arrays", *arguments], text, values=declared)


def _energy_text(
    program: ArrayProgram, rolled: RolledKernel, kernel: Kernel, *, declared: bool = False, before: Sequence[str] = ()
) -> str:
    """Return a function that sums the terms; ``before``: for the factor of a circulant matrix, at u = (1, 0)."""
    arguments = ["const double *q", "double t", "compensated *total"]
    arguments += ["const double *image", "long long length"] if _has_sums(rolled) else []
    call = f"{kernel.name}(u, t, parameters, value);"
    if declared:
        return f"static void sum_{kernel.name}(const problem *arrays, {', '.join(arguments)});"
    if before:
        matrix = _matrix_of_pairs(program, rolled)
        added = "if (add_energy(&matrix, q, value[0], total))"
        before = [f"const circulant matrix = {matrix};", "u[0] = 1.0, u[1] = 0.0;", *before, call, added, "  return;"]
    lines = [call, "add_to_sum(total, value[0]);"]
    return _function(program, rolled, f"sum_{kernel.name}", arguments, lines, source="q", before=before)


def _mass_text(program: ArrayProgram, rolled: RolledKernel) -> str:
    name, place = rolled.kernel.name, Nest(program.layout, rolled, "", "").place_of(rolled.writes[0])
    lines = [f"{name}(NULL, 0.0, parameters, value);", f"mass[{place}] += value[0];"]
    return _function(program, rolled, f"add_{name}", ["double *mass"], lines, source="")


def _constraint_context(program: ArrayProgram, held: ConstrainedSteps | None) -> dict[str, Any]:
    if held is None:
        return {"held": None}
    counts = [count_text(condition.loops) for condition in held.conditions]
    entries = [f"{count} * {len(condition.reads)}" for count, condition in zip(counts, held.conditions, strict=True)]
    pairs = zip(held.conditions, held.curvatures, strict=True)
    context = {
        "functions": [text for pair in pairs for text in _constraint_texts(program, *pair)],
        "conditions": [condition.kernel.name for condition in held.conditions],
        "curvatures": [curvature.kernel.name for curvature in held.curvatures],
        "counts": function_of_sizes(
            program.layout,
            "static void count_constraints(const problem *arrays, run_memory *run)",
            [f"run->constraints = {' + '.join(counts)};", f"run->entries = {' + '.join(entries)};"],
        ),
    }
    return {"held": context, "part_ends": list(accumulate(held.parts))}


def _constraint_texts(program: ArrayProgram, condition: RolledKernel, curvature: RolledKernel) -> Iterator[str]:
    """Yield functions of a constraint: g, g_t and derivatives; second derivatives; indices of its coordinates."""
    name, count = condition.kernel.name, len(condition.reads)
    X, now = "const double *restrict X", "condition *now"
    lines = [
        f"{name}(u, t, parameters, value);",
        "now->g[now->count] = value[0];",
        "now->rate[now->count++] = value[1];",
        *(f"now->derivative[now->entries++] = value[{k + 2}];" for k in range(count)),
    ]
    yield _function(program, condition, f"find_{name}", [X, "double t", now], lines, values=count + 2)
    second = curvature.kernel.name
    lines = [f"{second}(u, t, parameters, value);", "now->g[now->count++] = value[0];"]
    arguments = [X, f"const double *restrict {DIRECTION}", "double t", now]
    yield _function(program, curvature, f"find_{second}", arguments, lines)
    bare = replace(condition, reads=(), constants=())
    places = map(Nest(program.layout, bare, "", "").place_of, condition.writes)
    lines = [
        "now->first[now->count++] = (int)now->entries;",
        *(f"now->place[now->entries++] = (int)({place});" for place in places),
    ]
    yield _function(program, bare, f"place_{name}", [now], lines, values=0, source="")


def _on_lattices(program: ArrayProgram) -> bool:
    """Return whether Newton's method has the Fourier preconditioner: places in stencils, or circulant matrices."""
    alike = all(array.is_lattice for array in program.layout.coordinates) and not program.layout.tables
    return bool(program.loops.reach or (program.loops.diagonals and _plans(program) and alike))


def _lattice_context(program: ArrayProgram) -> dict[str, Any]:
    arrays, lattices = program.layout.coordinates, []
    for array in arrays:
        sizes = ", ".join(size_text(axis) for axis in array.axes if axis.name)
        lattices.append(
            f"{{.first = start_{array.name}, .components = {_components(array)}, .size = {{{sizes}}}, "
            f".axes = {_axes(array)}}}"
        )
    return {
        "lattices": len(arrays),
        "axes": max(map(_axes, arrays)),
        "components": sum(map(_components, arrays)),
        "describing": describing_function(program.layout, "lattices", "lattice", lattices),
    }


def _axes(array: Array) -> int:
    return sum(bool(axis.name) for axis in array.axes)


def _components(array: Array) -> int:
    return prod(axis.number for axis in array.axes if not axis.name)
