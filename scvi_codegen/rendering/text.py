"""Program to text: the only room that knows Jinja.

Entry templates are named after the file they make; parts live in ``templates/parts``. Templates hold shape only: loops
over the program's tables and the C that does not depend on it. Arithmetic arrives lowered and is printed by
:mod:`scvi_codegen.rendering.printer` through filters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Literal, NamedTuple, TypeAlias, cast, get_args

from scvi_codegen.ir.control import Control
from scvi_codegen.ir.derivatives import Derivatives
from scvi_codegen.ir.kernel import Kernel
from scvi_codegen.ir.parts import is_cut
from scvi_codegen.ir.program import Program
from scvi_codegen.ir.sweep import Kept, Sweep
from scvi_codegen.rendering.control import ladder_text
from scvi_codegen.rendering.environment import support_text, template_environment
from scvi_codegen.rendering.fallback import Fallback
from scvi_codegen.rendering.lanes import POINTS, TRAJECTORIES, sweep_text
from scvi_codegen.rendering.printer import INVERSE_ROOT, constants, scalar_functions
from scvi_codegen.rendering.source import Interface, Source, included
from scvi_codegen.rendering.stopping import MAX_ITERATIONS, NEAR, ROUNDED, TYPED
from scvi_codegen.rendering.target import DOUBLE, SINGLE, Target
from scvi_codegen.rendering.written_out import written_out

__all__ = [
    "EMBEDDED",
    "Embedded",
    "EventSearch",
    "ExampleRun",
    "render",
    "render_derivatives",
    "render_embedded",
    "render_events",
    "render_example",
]

Embedded: TypeAlias = Literal["double", "single"]
"""The precision of C text for a microcontroller."""

EMBEDDED: tuple[Embedded, ...] = get_args(Embedded)

TARGETS: dict[Embedded, Target] = {"double": DOUBLE, "single": SINGLE}

DECLARATIONS = {
    "stepper": "parts/declarations.h.jinja",
    "ensemble": "parts/ensemble_declarations.h.jinja",
    "events": "parts/events_declarations.h.jinja",
}
"""Inner part of a header by the name of its template."""


LARGEST_INLINED = 150
"""Operations of the kernels of a sweep that is made part of the loop over steps. Larger ones lose by it: six bodies
3 per cent, a chain of 64 masses 20."""


class ExampleInput(NamedTuple):
    """A function of time: (n + 1,) breakpoints, and from each on coefficients of powers of the time since, (n, 4)."""

    name: str
    breakpoints: tuple[float, ...]
    coefficients: tuple[tuple[float, ...], ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class ExampleRun:
    """What the generated ``main.c`` runs: initial state, step, and how often it prints.

    Attributes:
        h: of steps of one length, ``None`` where they choose theirs.
        span: of time.
        tolerance: of steps that choose their length; with a monitor in place of it tau.
        controlled: whether the integrator has these.
        to_end: whether it goes on to the end of the span, in steps of tau whose number is not known before.
        inputs: of a system that has any, if they are given; ``parameters`` has their values at the start.
        end: of a run with inputs.
    """

    q: tuple[float, ...]
    p: tuple[float, ...]
    parameters: tuple[float, ...]
    t: float
    h: float | None
    span: float
    tolerance: float
    controlled: bool
    save_every: int
    outputs: int
    to_end: bool = False
    inputs: tuple[ExampleInput, ...] = ()
    end: float = 0.0


@dataclass(frozen=True, slots=True, kw_only=True)
class EventSearch:
    """What the search for zeros of functions of the state is made from.

    Attributes:
        prefix, dimension: of the integrator.
        kernel: the functions at u = (q, p, v).
        uses_velocity: whether v occurs in them.
        transformed: whether time is, so that the integrator's velocities are dq/dtau.
        nodes: (d + 1,) where they are evaluated on a part of a step, as fractions of it.
        coefficients: (d + 1, d + 1) from values there to coefficients of powers of x in [-1, 1].
        doubts: of the last two of these, what part of them is in doubt.
    """

    prefix: str
    dimension: int
    kernel: Kernel
    uses_velocity: bool
    transformed: bool
    nodes: tuple[float, ...]
    coefficients: tuple[tuple[float, ...], ...]
    doubts: tuple[float, float]

    @property
    def velocity(self) -> str:
        """The support header that gives v."""
        return "event_velocity_by_clock" if self.transformed else "event_velocity"


def render(program: Program, control: Control | None = None, *, fallback: Fallback | None = None) -> Source:
    """Header and source of a program; with control, steps that choose their length. Equal programs give equal bytes.

    Where sweeps fail, Newton's iteration is the fallback if the program has it; or another is named.
    """
    return _render(program.prefix, _context(program, DOUBLE, control, fallback))


def render_derivatives(derivatives: Derivatives) -> Source:
    """The text of a program solved by Newton's iteration, with the derivative of steps and its transpose."""
    program = derivatives.program
    context = _context(program, DOUBLE, None, kernels=(*program.kernels, *derivatives.kernels), beside=derivatives)
    return _render(program.prefix, context | {"derivatives": derivatives, "written_out": None})


def render_embedded(program: Program, precision: Embedded, control: Control | None = None) -> Source:
    """The same for a microcontroller: one file, iterations bounded when it is compiled, the scalars of its registers.

    Raises:
        MethodError: for a number that single precision cannot hold.
    """
    target = TARGETS[precision]
    target.check((*program.parameter_defaults, *chain(*map(constants, _scalar_kernels(program, control)))))
    bound = f"{program.prefix.upper()}_MAX_ITERATIONS"
    bounded = {"embedded": True, "longest": MAX_ITERATIONS, "max_iterations": bound, "most_iterations": bound}
    return _render(program.prefix, _context(program, target, control) | bounded).amalgamated()


def _render(prefix: str, context: Mapping[str, object], entry: str = "stepper") -> Source:
    environment = template_environment()
    code = environment.get_template(f"{entry}.c.jinja").render(context)
    own = cast("Mapping[str, str]", context.get("own_headers", {}))
    return Source(
        prefix=prefix,
        header=environment.get_template(f"{entry}.h.jinja").render(context),
        code=code,
        declarations=environment.get_template(DECLARATIONS[entry]).render(context),
        support=tuple((name, own.get(name) or support_text(name)) for name in included(code)),
    )


def _control_context(program: Program, control: Control | None) -> dict[str, object]:
    """What the templates of steps that choose their length need; the ladder's tables are a header of their own."""
    name = f"support/{program.prefix}_ladder.h"
    if not (control and control.ladder and program.sweep):
        return {"control": control, "own_headers": {}}
    return {"control": control, "own_headers": {name: ladder_text(control.ladder)}}


def render_ensemble(program: Program) -> Source | None:
    """Text that integrates many trajectories at once, a lane each; ``None`` without a fixed-point solver.

    Also with integrals: where time is one of these, trajectories have no common times.
    """
    sweep = program.sweep
    if sweep is None or not sweep.serves_many or program.integrals:
        return None
    prefix = f"{program.prefix}_ensemble"
    context = {
        "program": program,
        "prefix": prefix,
        "target": DOUBLE,
        "real": DOUBLE.scalar,
        "max_iterations": MAX_ITERATIONS,
        "points": len(sweep.guess.abscissae),
        "cut": is_cut(sweep.kernels),
        "needs_velocities": sweep.kept is Kept.VELOCITIES,
        "hot": "static",
        "sweep": sweep_text(sweep, TRAJECTORIES, fallback="none"),
    }
    return _render(prefix, context, "ensemble")


def render_events(search: EventSearch) -> Source:
    """The search for events, a header and a source behind those of an integrator."""
    context = {
        "search": search,
        "prefix": search.prefix,
        "target": DOUBLE,
        "real": DOUBLE.scalar,
        "kernel": search.kernel,
        "cut": is_cut((search.kernel,)),
        "inverse_roots": _inverse_roots(scalar_functions(search.kernel)),
    }
    return _render(f"{search.prefix}_events", context, "events")


def render_example(interface: Interface, start: ExampleRun, precision: Embedded = "double") -> dict[str, str]:
    """``main.c`` and ``Makefile`` that run the integrator with nothing but a C compiler."""
    target = TARGETS[precision]
    target.check((*start.q, *start.p, *start.parameters, start.t, start.h or start.span))
    for each in start.inputs:
        target.check((*each.breakpoints, *chain(*each.coefficients)))
    context = {
        "interface": interface,
        "prefix": interface.prefix,
        "start": start,
        "distances": (ROUNDED, TYPED, NEAR),
        "target": target,
        "real": target.scalar,
        "threads": False,
    }
    environment = template_environment()
    return {name: environment.get_template(f"{name}.jinja").render(context) for name in ("main.c", "Makefile")}


def workspace_size(program: Program) -> int:
    """Doubles of workspace: scratch, memory, and for Newton unknowns, point, update, pivots, rows and Jacobian.

    Without Newton one in their place, for what a fallback may leave.
    """
    if not program.newton:
        return scratch_size(program) + program.memory + 1
    rows = program.unknowns + program.sites
    jacobian = program.matrix_size(program.sites, program.blocks + (1 if program.action else 0))
    return scratch_size(program) + program.memory + program.unknowns + program.point + 3 * rows + jacobian


def scratch_size(program: Program) -> int:
    """Doubles for the kernels of one family, or for the mass matrix with its slopes."""
    mass = program.matrix_size(program.dimension, 1) + len(program.mass_entries)
    return max(mass, *(family.scratch for family in program.families)) if program.newton else mass


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
    lanes = beside.lane_kernels if beside else ()
    return {
        "program": program,
        "prefix": program.prefix,
        "target": target,
        "real": target.scalar,
        "kernels": kernels,
        "cut": is_cut((*scalars, *(program.sweep.kernels if program.sweep else ()), *lanes)),
        "inverse_roots": _inverse_roots(set().union(*map(scalar_functions, scalars))),
        "workspace": workspace_size(program),
        "scratch": scratch_size(program),
        "max_iterations": MAX_ITERATIONS,
        "most_iterations": "INT_MAX",
        "embedded": False,
        "derivatives": None,
        "written_out": written_out(program, target),
        "fallback": fallback,
        **_control_context(program, control),
        **_lane_context(program, fallback, lanes),
    }


def _scalar_kernels(
    program: Program, control: Control | None, kernels: Sequence[Kernel] | None = None
) -> tuple[Kernel, ...]:
    own = program.kernels if kernels is None else kernels
    splitting = program.splitting.kernels if program.splitting else ()
    return (*own, *splitting, *((control.density,) if control and control.density else ()))


def _lane_context(program: Program, fallback: Fallback, beside: Sequence[Kernel]) -> dict[str, object]:
    """What the templates of the fixed-point solver need; nothing without one. ``beside``: kernels of its derivative."""
    sweep = program.sweep
    if sweep is None:
        return {"sweep": None}
    hot = "static inline __attribute__((always_inline))" if _size(sweep) <= LARGEST_INLINED else "static"
    kernels = (*sweep.kernels, *beside)
    text = sweep_text(sweep, POINTS, fallback=fallback, kernels=kernels, changes=bool(beside))
    return {"sweep": text, "hot": hot}


def _size(sweep: Sweep) -> int:
    """Operations of all kernels with lanes."""
    return sum(sum(kernel.operation_counts().values()) for kernel in sweep.kernels)


def _inverse_roots(functions: set[str]) -> list[int]:
    """The k of all ``inverse_root_k``."""
    return sorted(int(name.removeprefix(INVERSE_ROOT)) for name in functions if name.startswith(INVERSE_ROOT))
