"""Rendering of programs through the Jinja templates.

Entry templates are named after the file they make; parts are in ``templates/parts``. Templates contain only structure:
loops over the program's tables and the C that does not depend on it. Kernels are printed by
:mod:`scvi_codegen.codegen.rendering.kernels.printer` through filters.

Flow of many steps as one C function with its derivatives, added to a source that has those of a step.

The support headers contain all of it: ``flow.h`` the function, ``xla_flow.h`` and ``casadi_flow.h`` the interfaces of
frameworks.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import accumulate, chain
from typing import Any, ClassVar, Literal, TypeAlias, cast, get_args

from scvi_codegen.codegen.ir.derivatives import Derivatives, PointDerivatives
from scvi_codegen.codegen.ir.equations import Control, FixedPointIteration, IterationTable, Splitting, StoredValues
from scvi_codegen.codegen.ir.kernel import Kernel, Number, is_divided
from scvi_codegen.codegen.ir.program import ArrayProgram, Program
from scvi_codegen.codegen.rendering.environment import support_text, template_environment
from scvi_codegen.codegen.rendering.kernels.functions import unrolled_equations
from scvi_codegen.codegen.rendering.kernels.loops import loop_context
from scvi_codegen.codegen.rendering.kernels.printer import (
    DOUBLE,
    SINGLE,
    Target,
    constants,
    inverse_roots,
    uses_functions,
)
from scvi_codegen.codegen.rendering.kernels.simd import (
    POINTS,
    TRAJECTORIES,
    Fallback,
    constrained_source,
    iteration_source,
    loop_functions,
    predictor_text,
    splitting_source,
)
from scvi_codegen.codegen.rendering.preprocessor import included
from scvi_codegen.codegen.rendering.source import Contents, ExampleInput, Interface, LaneContents, Sizes, Source
from scvi_codegen.codegen.rendering.text import (
    INPUT_PRECISION,
    LARGEST_VIOLATION,
    MAX_ITERATIONS,
    ROUNDING_UNITS,
    HeaderRecord,
    wrapped_functions,
)

Embedded: TypeAlias = Literal["double", "single"]
"""Precision of C source for a microcontroller."""

EMBEDDED: tuple[Embedded, ...] = get_args(Embedded)

TARGETS: dict[Embedded, Target] = {"double": DOUBLE, "single": SINGLE}

DECLARATIONS = {
    "stepper": "parts/declarations.h.jinja",
    "arrays": "parts/array_declarations.h.jinja",
    "ensemble": "parts/ensemble_declarations.h.jinja",
    "events": "parts/events_declarations.h.jinja",
    "array_events": "parts/array_events_declarations.h.jinja",
    "step_terms": "parts/step_terms_declarations.h.jinja",
}
"""Inner part of a header by the name of its template."""


OF_THREE_WORDS = ("DRIFT", "PRODUCT", "POINT_END_POSITION", "POINT_END_MOMENTUM")
"""Tables of a separable iteration in double-double arithmetic, by their names in C."""
LEAP = "support/iteration/leap.h"
"""Header of the increments of an explicit step, which is generated."""
SHOOTING = "shooting_iteration"
"""Part of an iteration that is a tenth slower, like Newton's method, if its short loops are not unrolled."""
LARGEST_INLINED = 150
"""Largest number of operations of the kernels of an iteration that is inlined into the loop over steps.

Larger ones are slower inlined: six bodies by 3 per cent, a chain of 64 masses by 20.
"""


LARGEST_BATH_IN_LANES = 1024
"""Largest number of factors of a heat bath of which each lane has its own, on the stack."""
LARGEST_IN_LANES = 256
"""Largest number of values at the points of a step in two words in which trajectories, not points, are SIMD lanes.

With 216 (outer solar system, SVI(12)) a trajectory takes 0.7 of the time, with 288 or 512 (SVI(16); chain of 64 masses,
SVI(8)) there is no gain: the vectors exceed the cache.
"""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExampleArrays:
    """Arrays of an example run whose sizes are known at run time, which ``main.c`` reads from text files.

    Attributes:
        count: number of coordinates.
        sizes: by name.
        fields: number of entries by file.
        tables: number of entries, and limits of the indices in each column, by file.
        moving: file of the initial momenta or velocities, "p" or "velocity", or nothing for a start from rest.
    """

    count: int
    sizes: dict[str, int]
    fields: dict[str, int]
    tables: dict[str, tuple[int, list[int]]]
    moving: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ExampleRun:
    """Run of the generated ``main.c``: initial state, step, and output interval.

    Attributes:
        h: step size, ``None`` for adaptive steps.
        span: of time.
        tolerance: of adaptive steps; with a time transformation the step tau.
        max_step, first_step: largest and first size of adaptive steps, or ``None``.
        absolute_tolerances: (m,) of adaptive steps; none if all are 0.
        controlled: whether the integrator has adaptive steps or a time transformation.
        save_every, outputs: steps to an output and number of outputs.
        last: steps to the last output.
        to_end: whether it continues to the end of the span, in a number of steps of tau that is not known before.
        inputs: of a system that has any, if they are set; ``parameters`` has their values at the start.
        end: of a run with inputs.
        arrays: of a system whose array sizes are known at run time; ``outputs`` is then the number of steps.
        events: of the run, also of its source.
        by_steps, strict_energy: whether contacts act in steps, without transitions, and none may raise energy.
    """

    q: tuple[float, ...]
    p: tuple[float, ...]
    parameters: tuple[float, ...]
    t: float
    h: float | None
    span: float
    tolerance: float
    max_step: float | None = None
    first_step: float | None = None
    absolute_tolerances: tuple[float, ...] = ()
    controlled: bool
    save_every: int
    outputs: int
    last: int = 0
    to_end: bool = False
    inputs: tuple[ExampleInput, ...] = ()
    end: float = 0.0
    arrays: ExampleArrays | None = None
    events: tuple[Any, ...] = ()
    by_steps: bool = False
    strict_energy: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class EventSearch:
    """Data of the search for zeros of functions of the state.

    Attributes:
        prefix, dimension: of the integrator.
        transformed: whether time is, so that the integrator's velocities are dq/dtau.
        constrained: whether states satisfy constraints, also after changes.
        nodes: (d + 1,) fractions of a part of a step at which they are evaluated.
        coefficients: (d + 1, d + 1) from values there to coefficients of powers of x in [-1, 1].
        doubts: factors of the last two coefficients in the error estimate.
        timed: for each event 1 if its function is one of time alone, 2 if it is affine, else 0.
        guarded: index of the function of each condition of crossings.
        impacts: 1 for each event that is the wall of an impact, else 0.
        conditional: 1 for each event with conditions, else 0.
        controlled: whether the integrator has adaptive steps.
        by_steps, steps_alone: whether runs may have contacts by steps, and no others.
        changes_states: whether crossings change the state of a run.
        kernels: the functions at u = (q, p, v); conditions; values of variables that crossings change, gradient and
            restitution of impacts.
        uses_velocity: whether v occurs in the formulas.
        multipliers: number of multipliers if one occurs in the formulas, else 0.
        changed: index among (q, p, v, modes) of the variable of each value of the changes.
        first_values: index of the first value of each function, and the number of values.
        parameters: number of parameters.
        modes: indices of the parameters that change along runs: by events, as modes of contacts, and of kinks.
        kinks: number of kinks, which are the last events.
        powers: below and above the zero of each of them, whether a power that is not whole acts; empty if none does.
        refracts: 1 for each event that is the zero of a kink where L jumps, else 0; empty if there is none.
        contacts: normal and first tangential row of each contact, number of its slips, and its closed, first sticks,
            first direction and held among the modes; -1 for what it does not have; law of impacts, and 1 if its
            friction varies along its slip, else 0.
        vectors: number of components of each coordinate, rotation and direction, in order.
        knots, weights: on [0, 1], of the quadrature by which friction that varies along a slip is judged; empty if
            there is none.
        contact_rows, first_contact_row: number of rows, and of the constraints before them.
        transitions: contact and kind of each of their transitions, the events before the kinks.
        dissipates: whether energy cannot grow, also at events.
        elements: number of functions of each event, one for each element of its loops.
        ENTRY: name of the entry templates.
    """

    prefix: str
    dimension: int
    transformed: bool
    constrained: bool
    nodes: tuple[float, ...]
    coefficients: tuple[tuple[float, ...], ...]
    doubts: tuple[float, float]
    timed: tuple[int, ...]
    guarded: tuple[int, ...]
    impacts: tuple[int, ...]
    conditional: tuple[int, ...]
    controlled: bool
    by_steps: bool
    steps_alone: bool
    changes_states: bool
    kernels: tuple[Kernel, ...]
    uses_velocity: bool
    multipliers: int = 0
    changed: tuple[int, ...] = ()
    first_values: tuple[int, ...] = ()
    elements: tuple[int, ...] = ()
    parameters: int = 0
    modes: tuple[int, ...] = ()
    kinks: int = 0
    powers: tuple[tuple[int, int], ...] = ()
    refracts: tuple[int, ...] = ()
    contacts: tuple[tuple[int, ...], ...] = ()
    vectors: tuple[int, ...] = ()
    knots: tuple[float, ...] = ()
    weights: tuple[float, ...] = ()
    contact_rows: int = 0
    first_contact_row: int = 0
    transitions: tuple[tuple[int, str], ...] = ()
    dissipates: bool = False
    ENTRY: ClassVar[str] = "events"

    @property
    def first_functions(self) -> list[int]:
        """Index of the first function of each event, and the number of functions."""
        return [0, *accumulate(self.elements)]

    @property
    def event_of_function(self) -> list[int]:
        """Index of the event of each function."""
        return [event for event, count in enumerate(self.elements) for _ in range(count)]


@dataclass(frozen=True, slots=True, kw_only=True)
class ArrayEventSearch(EventSearch):
    """Search for zeros of functions of arrays of run-time sizes, with the index of its event for each condition.

    Attributes:
        arrays: :class:`~scvi_codegen.codegen.rendering.events.ArrayEvents`, whose functions have the kernels.
    """

    arrays: Any
    ENTRY = "array_events"


def render(program: Program, control: Control | None = None, *, fallback: Fallback | None = None) -> Source:
    """Return header and source of a program; with control, with adaptive steps. Equal programs give equal bytes.

    If the fixed-point iteration fails, Newton's method is the fallback if the program has it, unless another is named.
    """
    return _render(program.prefix, _context(program, DOUBLE, control, fallback))


def render_arrays(program: ArrayProgram, control: Control | None) -> Source:
    """Return the source of a program of arrays of run-time sizes; control as of :func:`render`."""
    return _render(program.prefix, loop_context(program) | _control_context(program, control), "arrays")


def render_derivatives(derivatives: Derivatives) -> Source:
    """Return the source of a program solved by Newton's method, with the derivative of steps and its transpose."""
    program = derivatives.program
    context = _context(program, DOUBLE, None, kernels=(*program.kernels, *derivatives.kernels), beside=derivatives)
    return _render(program.prefix, context | {"derivatives": derivatives, "unrolled_equations": None})


def render_double_double(
    program: Program, derivatives: PointDerivatives | None, control: Control | None = None
) -> Source:
    """Return the source of a program in double-double arithmetic; control as of :func:`render`.

    Args:
        program: with a fixed-point iteration of separable systems, or with Newton's method, also as the fallback of
            another iteration.
        derivatives: at the points of a fixed-point iteration, which correct it to two words.
    """
    fixed_point = program.fixed_point
    if in_pairs(program):
        return _render_explicit(program)
    if program.newton:
        return _render_mixed_newton(program, derivatives, control)
    assert fixed_point is not None  # by the caller
    assert derivatives is not None
    mass = fixed_point.constant_mass
    assert mass is not None  # of separable systems
    program = _in_three_words(program)
    quantities, lanes = program.quantities, (derivatives.partials, derivatives.products[0])
    states = (quantities.energy, *((quantities.momentum_kernel,) if quantities.momentum_kernel else ()))
    numbers, vectors = (mass, *states), derivatives.in_pairs
    context = _context(program, DOUBLE, control)
    context |= {
        **_lane_context(program, lanes, changes=False),
        "cut": context["cut"] or is_divided(lanes),
        "two_words": {
            "derivatives": derivatives.count,
            "anchor": _anchor(program),
            "of_numbers": numbers,
            "of_vectors": vectors,
            "meaning": POINTS,
            "functions": uses_functions((*numbers, *vectors)),
        },
    }
    return _render(program.prefix, context)


def _in_three_words(program: Program) -> Program:
    """Return a program of a separable iteration whose tables have the low words that steps in pairs use."""
    fixed_point = program.fixed_point
    assert fixed_point is not None  # by the caller
    tables = [
        replace(table, in_two_parts=not table.is_matrix or table.in_two_parts) for table in fixed_point.own_tables
    ]
    tables += [_lowest_words(table) for table in tables if table.name in OF_THREE_WORDS]
    return replace(program, fixed_point=replace(fixed_point, own_tables=tuple(tables), linear_part=None))


def _anchor(program: Program) -> float:
    """Return three times the largest sum of the absolute values of a row of the tables of the forces."""
    fixed_point = program.fixed_point
    assert fixed_point is not None  # by the caller
    rows = (row for name in OF_THREE_WORDS[1:] for row in fixed_point.numbers(name))
    return 3 * max(float(sum(map(abs, row))) for row in rows)


def _lowest_words(table: IterationTable) -> IterationTable:
    """Return the table of what two words of each number leave."""

    def lowest(x: Number) -> Number:
        return DOUBLE.rest(DOUBLE.rest(x))

    numbers: Any = tuple(tuple(map(lowest, x)) if isinstance(x, tuple) else lowest(x) for x in table.numbers)
    return replace(table, name=f"{table.name}_LOWEST", numbers=numbers, in_two_parts=False)


def in_pairs(program: Program) -> bool:
    """Return whether double-double steps are explicit: kicks by forces of position and time, drifts by masses."""
    return program.splitting is not None and program.splitting.by_masses


def memory_in_pairs(program: Program) -> int:
    """Return the doubles of memory of explicit steps in pairs: inverse masses, last force."""
    return 4 * program.dimension + 1


def workspace_in_pairs(program: Program) -> int:
    """Return the doubles of workspace of explicit steps in pairs."""
    return workspace_size(program) - program.memory + memory_in_pairs(program)


def _render_explicit(program: Program) -> Source:
    """Return the source of explicit steps in pairs."""
    quantities, split = program.quantities, program.splitting
    assert split is not None  # by the caller
    states = quantities.energy, *((quantities.momentum_kernel,) if quantities.momentum_kernel else ())
    kernels = split.drift, split.force, *states
    context = _context(program, DOUBLE, None)
    words = {"derivatives": 0, "of_numbers": kernels, "of_vectors": (), "functions": uses_functions(kernels)}
    sizes = {"memory": memory_in_pairs(program), "workspace": workspace_in_pairs(program)}
    headers = _leap(split, words=2, action=False)
    return _render(program.prefix, context | sizes | {"two_words": words, "own_headers": headers})


def render_ensemble_in_pairs(program: Program, derivatives: PointDerivatives | None) -> Source | None:
    """Return the source of steps in pairs of many trajectories, which are lanes.

    ``None`` for steps by Newton's method, and for many values at the points of a step.

    Args:
        program: with explicit steps, or with a fixed-point iteration of separable systems.
        derivatives: as of :func:`render_double_double`.
    """
    split, fixed_point = program.splitting, program.fixed_point
    kernels, beside, own = tuple[Kernel, ...](), tuple[Kernel, ...](), dict[str, object]()
    if split is not None and in_pairs(program):
        kernels = split.drift, split.force
        own = {"points": 2, "stored": 2, "fixed_point": None}  # points: words of the stored force
    elif fixed_point and derivatives and program.dimension * fixed_point.points <= LARGEST_IN_LANES:
        program, mass = _in_three_words(program), fixed_point.constant_mass
        assert mass is not None  # of separable systems
        kernels, beside = (mass, *fixed_point.kernels), (derivatives.partials, derivatives.products[0])
        iteration = cast(FixedPointIteration, program.fixed_point)
        source = iteration_source(iteration, TRAJECTORIES, kernels=(*fixed_point.kernels, *beside))
        own = {"points": fixed_point.points, "stored": fixed_point.points, "fixed_point": source}
    else:
        return None
    context = own | {
        "program": program,
        "observed": 0,
        "counts": False,
        "tangents": 0,
        "cut": is_divided((*kernels, *beside)),
        "needs_velocities": False,
        "line_velocities": False,
        "hot": "static",
        "two_words": {
            **({"derivatives": derivatives.count, "anchor": _anchor(program)} if derivatives else {}),
            "of_numbers": (),
            "of_vectors": kernels,
            "meaning": TRAJECTORIES,
            "functions": uses_functions(kernels),
        },
    }
    if split is not None:
        context["own_headers"] = _leap(split, words=2, lanes=True, action=False)
    return _render(f"{program.prefix}_ensemble", context, "ensemble")


def _render_mixed_newton(program: Program, correction: PointDerivatives | None, control: Control | None) -> Source:
    """Return the source of a program with Newton's method, whose solution is corrected in pairs.

    With a correction, of the fixed-point iteration that Newton's method is the fallback of.
    """
    quantities, constraints = program.quantities, program.constraints
    of_states = (
        *(group.value for group in program.equations.stage_groups),
        *(quantities.energy, quantities.inverse_legendre, quantities.momentum_kernel),
        *(quantities.first_order_rates, program.damping),
        quantities.integrals and quantities.integrals.kernel,
        constraints.motion,
    )
    with_partials = quantities.legendre, constraints.kernel
    kernels = (
        *(kernel for kernel in of_states if kernel),
        *(replace(kernel, values=len(kernel.results)) for kernel in with_partials if kernel),
    )
    rattle, vectors = program.rattle, tuple[Kernel, ...]()
    plain = not (program.damping or quantities.integrals)
    of_forces = rattle.part == "rattle" and not rattle.macros  # of constant masses and forces of positions
    if rattle.points > 1 and plain and of_forces:
        kernels = *kernels, *rattle.kernels
        of_points = *rattle.kernels, replace(constraints.kernel, values=len(constraints.kernel.results))
        vectors = tuple(replace(kernel, name=f"{kernel.name}_of_points") for kernel in of_points)
    in_pairs, lanes = vectors != (), tuple[Kernel, ...]()
    if correction and program.fixed_point:
        own = tuple(replace(table, in_two_parts=True) for table in program.fixed_point.own_tables)
        program = replace(program, fixed_point=replace(program.fixed_point, own_tables=own))
        vectors, lanes = correction.in_pairs, (correction.partials, correction.products[0])
    context = _context(program, DOUBLE, control)
    context |= {
        **_lane_context(program, lanes, changes=False),
        "cut": context["cut"] or is_divided(lanes),
        "unrolled_equations": None,
        "rattle_in_pairs": in_pairs,
        "two_words": {
            "derivatives": correction.count if correction else 0,
            "of_numbers": kernels,
            "of_vectors": vectors,
            "meaning": POINTS,
            "functions": bool(program.damping) or uses_functions((*kernels, *vectors)),
        },
    }
    return _render(program.prefix, context)


def render_embedded(program: Program, precision: Embedded, control: Control | None = None) -> Source:
    """Return one file for a microcontroller, bounded iterations in its scalars; MethodError out of their range."""
    target = TARGETS[precision]
    target.check((*program.layout.defaults, *chain(*map(constants, _scalar_kernels(program, control)))))
    bound = f"{program.prefix.upper()}_MAX_ITERATIONS"
    bounded = {"embedded": True, "longest": MAX_ITERATIONS, "max_iterations": bound, "most_iterations": bound}
    return _render(program.prefix, _context(program, target, control) | bounded).single_file()


def _render(prefix: str, context: Mapping[str, object], entry: str = "stepper") -> Source:
    """Return the source of entry templates from their context, with defaults for all of them."""
    common = {"prefix": prefix, "target": DOUBLE, "real": DOUBLE.scalar}
    numbers = {"max_iterations": MAX_ITERATIONS}
    absent = {"two_words": None, "rattle_in_pairs": False, "derivatives": None, "fallback": "none", "embedded": False}
    environment, context = template_environment(), {"diagonal_masses": None, **common, **numbers, **absent, **context}
    context["diagonal_masses"] = None if context["two_words"] else context["diagonal_masses"]
    record = HeaderRecord(cast(str, context["prefix"]), cast(str, context["real"]))
    recorded = context | {"prototype": record.prototype, "optional": record.optional}
    declarations = environment.get_template(DECLARATIONS[entry]).render(recorded)
    code = environment.get_template(f"{entry}.c.jinja").render(context)
    headers = dict(cast("Mapping[str, str]", context.get("own_headers", {})))
    if context["two_words"]:
        from scvi_codegen.codegen.rendering.kernels.double_double import arithmetic_headers

        headers |= arithmetic_headers()
    program = context.get("program")
    if isinstance(program, Program) and program.bath:
        from scvi_codegen.codegen.statements.steps import half_step

        headers["support/run/exchange_heat.h"] = half_step(program.bath)
    if isinstance(program, Program) and program.rattle:
        from scvi_codegen.codegen.statements.steps import pair_rattle_functions, rattle_functions

        features = [name.lower() for name in program.rattle.macros]
        headers["support/constraints/iterate.h"] = wrapped_functions(rattle_functions(program.rattle.part, features))
        headers["support/double_double/correct_points.h"] = wrapped_functions(pair_rattle_functions())
    source = Source(
        prefix=prefix,
        header=environment.get_template(f"{entry}.h.jinja").render(context | {"declarations": declarations}),
        code=code,
        declarations=declarations,
        support=included(code, lambda name: headers.get(name) or support_text(name)),
        contents=Contents(
            functions=tuple(record.functions),
            run_fields=tuple(record.run_fields),
            divided=bool(context["cut"]),
            **CONTENTS[entry](context),
        ),
    )
    return source.with_distinct_names(cast(str, context["prefix"]))


def _contents_of_step(context: Mapping[str, Any]) -> dict[str, Any]:
    """Return the sizes of an integrator of named coordinates, and which loops it has."""
    program: Program = context["program"]
    by_newton = program.newton and not program.splitting
    shooting = program.fixed_point is not None and SHOOTING in program.fixed_point.parts
    return {
        "rolled": not (by_newton or shooting),
        "points_in_loops": bool(program.rattle),
        "sizes": Sizes(
            coordinates=program.dimension,
            parameters=len(program.layout.parameters),
            unknowns=program.equations.unknowns,
            workspace=context["workspace"],
            maps=len(program.momentum_maps),
            constraints=program.constraints.count,
            sums=program.sums,
        ),
    }


def _contents_of_lanes(context: Mapping[str, Any]) -> dict[str, Any]:
    return {"lanes": LaneContents(observed=context["observed"])}


CONTENTS: dict[str, Callable[[Mapping[str, Any]], dict[str, Any]]] = {
    "stepper": _contents_of_step,
    "arrays": lambda context: {"threads": True},
    "events": lambda context: {},
    "array_events": lambda context: {},
    "step_terms": lambda context: {},
    "ensemble": _contents_of_lanes,
}
"""Contents of the C of an entry template, from its context."""


def _leap(split: Splitting, *, words: int = 1, lanes: bool = False, action: bool) -> dict[str, str]:
    """Return the header with the increments of an explicit step, by its name."""
    from scvi_codegen.codegen.statements.printing import Layout
    from scvi_codegen.codegen.statements.steps import splitting_header

    return {LEAP: splitting_header(split, Layout(words, lanes), action=action)}


def _control_context(program: Program, control: Control | None) -> dict[str, object]:
    """Return the template's context for adaptive steps; the predictor tables are a separate header."""
    if program.splitting:
        action = program.splitting.at_rest is not None
        return {"control": control, "own_headers": _leap(program.splitting, action=action)}
    name = f"support/{program.prefix}_predictor.h"
    if not (control and control.predictor and program.fixed_point):
        return {"control": control, "own_headers": {}}
    return {"control": control, "own_headers": {name: predictor_text(control.predictor)}}


def render_ensemble(
    program: Program,
    observed: Kernel | None = None,
    *,
    counts: bool = False,
    tangents: int = 0,
    precision: Embedded = "double",
) -> Source | None:
    """Return source that integrates many trajectories at once, one per lane, by fixed-point iteration or explicitly.

    ``None`` for other steps, for large heat baths, and with integrals: with a time transformation, trajectories have no
    common times.

    Args:
        program: the program.
        observed: functions whose extremes are recorded.
        counts: whether changes of their signs are counted instead.
        tangents: number of tangent vectors among the coordinates.
        precision: of the lanes.
    """
    fixed_point, split, headers = program.fixed_point, program.splitting, dict[str, str]()
    bath, target, of_observer = program.bath, TARGETS[precision], (observed,) if observed else ()
    if program.quantities.integrals or (bath and bath.sizes["BATH_FACTORS"] > LARGEST_BATH_IN_LANES):
        return None
    if split is not None:
        kernels, points, source = split.kernels, 1, splitting_source(split, observed, target)
        headers = _leap(split, lanes=True, action=program.acts_along)
    elif program.rattle and not program.damping:
        kernels, points = program.rattle.kernels, program.rattle.points + 1
        source = constrained_source(program.rattle, program.constraints)
    elif fixed_point is not None and fixed_point.serves_many:
        kernels, points = fixed_point.kernels, len(fixed_point.guess.abscissae)
        source = iteration_source(fixed_point, TRAJECTORIES, kernels=(*kernels, *of_observer), number=target)
    else:
        return None
    if precision == "single":
        target.check(chain.from_iterable(map(constants, source.kernels)))
    prefix, by_masses = f"{program.prefix}_ensemble", bool(program.rattle.lower_masses)
    velocities = by_masses or (fixed_point is not None and fixed_point.kept is StoredValues.VELOCITIES)
    quantities = program.quantities
    between = bath.kernel if bath else None, quantities.legendre, quantities.inverse_legendre, quantities.energy
    context = {
        "program": program,
        "target": target,
        "real": target.scalar,
        "points": points,
        "stored": points * (fixed_point.curves if fixed_point else 1),
        "observed": observed.values if observed else 0,
        "counts": counts,
        "tangents": tangents,
        "cut": is_divided((*kernels, *of_observer)),
        "diagonal_masses": _diagonal_masses(program),
        "metropolis": bool(bath and split and not any(bath.kernel.formulas[1 : 1 + program.dimension])),  # L is even
        "needs_velocities": velocities and not bath,
        "line_velocities": velocities and bath,
        "hot": "static",
        "inverse_roots": inverse_roots([kernel for kernel in between if kernel]) if bath else (),
        "fixed_point": source,
        "own_headers": headers,
        "scratch": scratch_size(program),
    }
    return _render(prefix, context, "ensemble")


def render_events(search: EventSearch) -> Source:
    """Return header and source of the search for events."""
    context = {
        "search": search,
        "prefix": search.prefix,
        "cut": is_divided(search.kernels),
        "inverse_roots": inverse_roots(search.kernels),
    }
    return _render(f"{search.prefix}_events", context, search.ENTRY)


def render_step_terms(
    prefix: str, system: Any, kernel: Kernel, entries: Sequence[tuple[int, int]], values: int, columns: int
) -> Source:
    """Return the source of the terms of contacts by steps, so many values, with their derivatives by rows."""
    moving = 2 * system.dimension
    context = {
        "kernel": kernel,
        "entries": entries,
        "arguments": moving + len(system.constraints),
        "values": values,
        "columns": columns,
        "inputs": moving + len(system.parameters) + 2,
        "cut": is_divided((kernel,)),
        "inverse_roots": inverse_roots((kernel,)),
    }
    return _render(prefix, context, "step_terms")


def render_example(interface: Interface, start: ExampleRun, precision: Embedded = "double") -> dict[str, str]:
    """Return ``main.c`` and ``Makefile`` that run the integrator with nothing but a C compiler."""
    target = TARGETS[precision]
    names = (*interface.coordinates, *interface.momenta)
    target.check((*start.q, *start.p), [f"the initial {name} =" for name in names])
    target.check((*start.parameters, start.t, start.h or start.span))
    for of_input in start.inputs:
        target.check((*of_input.breakpoints, *chain(*of_input.coefficients)))
    context = {
        "interface": interface,
        "prefix": interface.prefix,
        "start": start,
        "distances": (ROUNDING_UNITS, INPUT_PRECISION, LARGEST_VIOLATION),
        "target": target,
        "real": target.scalar,
        "threads": start.arrays is not None,
    }
    environment = template_environment()
    return {name: environment.get_template(f"{name}.jinja").render(context) for name in ("main.c", "Makefile")}


def workspace_size(program: Program) -> int:
    """Return the doubles of workspace: scratch, memory; unknowns, rows, update, pivots, Jacobian, point of Newton.

    Without Newton's method one instead, for the result of a fallback.
    """
    if not program.newton:
        return scratch_size(program) + program.memory + 1
    rows = program.equations.unknowns + program.equations.sites
    newton = program.equations.unknowns + program.point + 3 * rows + jacobian_size(program)
    return scratch_size(program) + program.memory + newton


def jacobian_size(program: Program) -> int:
    """Return the doubles of Newton's factors, with p0 as a further unknown for a step between positions."""
    return program.matrix_size(program.equations.sites, program.equations.blocks + program.between)


def scratch_size(program: Program) -> int:
    """Return the doubles for kernels: of one stage group, of the mass matrix, or of the constraints.

    These are the mass matrix with its derivatives, and a saddle point matrix with its pivots and a right-hand side.
    """
    sites, matrix_size = program.equations.sites, program.matrix_size
    mass = matrix_size(program.dimension, 1) + len(program.quantities.mass_entries)
    saddle = matrix_size(sites, 1) + 2 * sites if program.constraints else 0
    return max(mass, saddle, *(group.scratch for group in program.equations.stage_groups)) if program.newton else mass


def _context(
    program: Program,
    target: Target,
    control: Control | None,
    fallback: Fallback | None = None,
    *,
    kernels: Sequence[Kernel] | None = None,
    beside: Derivatives | None = None,
) -> dict[str, object]:
    kernels = program.kernels if kernels is None else kernels
    fallback, scalars = fallback or ("own" if program.newton else "none"), _scalar_kernels(program, control, kernels)
    growth = control.growth if control else None
    of_growth = (growth.partials, growth.product) if growth else ()
    lanes = beside.lane_kernels if beside else of_growth
    return {
        "program": program,
        "target": target,
        "real": target.scalar,
        "kernels": kernels,
        "cut": is_divided((*scalars, *(program.fixed_point.kernels if program.fixed_point else ()), *lanes)),
        "inverse_roots": inverse_roots(scalars),
        "memory": program.memory,
        "workspace": workspace_size(program) + (fallback == "external"),
        "scratch": scratch_size(program) + (fallback == "external"),
        "jacobian": jacobian_size(program),
        "most_iterations": "INT_MAX",
        "held": program.constraints,
        "unrolled_equations": unrolled_equations(program, target),
        "vector_functions": loop_functions(_kernels_of_points(program)),
        "fallback": fallback,
        "diagonal_masses": _diagonal_masses(program),
        "legendre_in_lanes": program.fixed_point is not None and program.quantities.legendre is None,
        **_control_context(program, control),
        **_lane_context(program, lanes, changes=beside is not None and bool(lanes)),
    }


def _diagonal_masses(program: Program) -> Literal["exact", "rounded"] | None:
    """Return how velocities follow from momenta by constant masses, without a matrix; ``None`` if they do not.

    Products and quotients by powers of 2 are exact, by other masses rounded.
    """
    split, fixed_point, quantities = program.splitting, program.fixed_point, program.quantities
    if split:
        constant = split.drift if split.by_masses else None
    else:
        constant = fixed_point.constant_mass if fixed_point else None
    otherwise = program.newton or quantities.hamiltonian or quantities.inverse_legendre
    diagonal = tuple(quantities.mass_entries) == tuple((i, i) for i in range(program.dimension))
    if constant is None or otherwise or not diagonal:
        return None
    powers = all(mass.is_number and math.frexp(float(mass))[0] == 0.5 for mass in constant.formulas)
    return "exact" if powers and constant.formulas else "rounded"


def _kernels_of_points(program: Program) -> tuple[Kernel, ...]:
    """Return the kernels that are evaluated in loops over the points of a constrained step."""
    rattle = program.rattle
    return (*rattle.kernels, program.constraints.kernel) if rattle.points > 1 else ()


def _scalar_kernels(
    program: Program, control: Control | None, kernels: Sequence[Kernel] | None = None
) -> tuple[Kernel, ...]:
    kernels_of_step = program.kernels if kernels is None else kernels
    splitting = program.splitting.kernels if program.splitting else ()
    return (*kernels_of_step, *splitting, *((control.density,) if control and control.density else ()))


def _lane_context(program: Program, beside: Sequence[Kernel], *, changes: bool) -> dict[str, object]:
    """Return the template's context for the iteration, with kernels of its derivative; ``changes``: it has tangents."""
    fixed_point = program.fixed_point
    hot_kernels = (fixed_point or program.splitting or program).kernels
    operations = sum(sum(kernel.operation_counts().values()) for kernel in hot_kernels)
    if fixed_point is None:
        return {"fixed_point": None, "hot": "static inline" if operations <= LARGEST_INLINED else "static"}
    hot = "static inline __attribute__((always_inline))" if operations <= LARGEST_INLINED else "static"
    kernels = (*fixed_point.kernels, *beside)
    text = iteration_source(fixed_point, POINTS, kernels=kernels, changes=changes)
    return {"fixed_point": text, "hot": hot}


def with_fmu(
    source: Source,
    interface: Interface,
    start: ExampleRun,
    *,
    by_velocity: bool,
    input_indices: Sequence[int],
    token: str,
    events: Sequence[tuple[int, int, int]] = (),
) -> Source:
    """Return the source of an integrator with the functions of FMI.

    Args:
        source, interface: of the integrator.
        start: initial state, with velocities instead of p if ``by_velocity``; parameters, time, and the step size.
        by_velocity: whether initial velocities are set instead of momenta.
        input_indices: index of the first parameter of each input.
        token: instantiation token of the model description.
        events: of the source, which change the state: direction, number of the crossing that ends the simulation, and
            1 if its crossings change the state.
    """
    context = {
        "events": events,
        "interface": interface,
        "prefix": interface.prefix,
        "start": start,
        "by_velocity": by_velocity,
        "places": input_indices,
        "token": token,
        "target": DOUBLE,
    }
    environment = template_environment()
    code = environment.get_template("fmu.c.jinja").render(context)
    beside = Source(
        prefix=f"{interface.prefix}_fmu",
        header=environment.get_template("fmu.h.jinja").render(context),
        code=code,
        declarations="",
        support=included(code, support_text),
    )
    beside = replace(beside.with_distinct_names(interface.prefix), beside=source.beside)
    return replace(source, beside=beside)


def with_flow(source: Source, text: str, headers: Sequence[str], declarations: str, *, second: bool) -> Source:
    """Return a source with derivatives of steps and, after ``text``, headers of ``support/frameworks``.

    Args:
        source: of the integrator and the derivatives.
        text: definitions before the headers.
        headers: names of headers.
        declarations: of the functions that the headers define.
        second: whether they use second derivatives, which the source must have.
    """
    tail = (
        text
        + "#define SECOND_DERIVATIVES\n" * second
        + "".join(f'#include "support/frameworks/{header}.h"\n' for header in headers)
    )
    texts = dict(source.support)
    code = source.code + tail
    return replace(
        source,
        code=code,
        declarations=source.declarations + declarations,
        support=included(code, lambda name: texts.get(name) or support_text(name)),
    )
