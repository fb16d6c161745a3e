"""Program to text: the only room that knows Jinja.

Entry templates are named after the file they make; parts live in ``templates/parts``. Templates hold shape only: loops
over the program's tables and the C that does not depend on it. Arithmetic arrives lowered and is printed by
:mod:`scvi_codegen.rendering.printer` through filters.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import chain
from typing import Literal, TypeAlias, get_args

from scvi_codegen.ir.kernel import Kernel
from scvi_codegen.ir.parts import parts
from scvi_codegen.ir.program import Program
from scvi_codegen.ir.sweeps import CoupledSweep, SeparableSweep, Sweep
from scvi_codegen.rendering.environment import template_environment
from scvi_codegen.rendering.printer import (
    constants,
    lane_functions,
    scalar_functions,
)
from scvi_codegen.rendering.single_precision import SINGLE_UNIT, check_single, to_single
from scvi_codegen.rendering.source import Interface, Source

__all__ = [
    "DEFAULT_TOLERANCE",
    "EMBEDDED",
    "MAX_ITERATIONS",
    "Embedded",
    "EventSearch",
    "ExampleRun",
    "render",
    "render_embedded",
    "render_events",
    "render_example",
]

Embedded: TypeAlias = Literal["double", "single"]
"""The precision of C text for a microcontroller."""

EMBEDDED: tuple[Embedded, ...] = get_args(Embedded)

DEFAULT_TOLERANCE = 2.0**-52
"""Relative update below which Newton's iteration has converged: the round-off unit of binary64."""

MAX_ITERATIONS = 50

ROUNDOFF_LEVEL = 1e-11

SINGLE_ROUNDOFF_LEVEL = 1e-4

KEEP_CHANGE = 1e-2

KEEP_RATE = 0.1

GOOD_GUESS = 1e-3
"""Relative error below which the next guess is continued from two steps, not one."""

MOST_TRIALS = 200

SMALL_PART = 0.03

STEEPNESS = 8.0

BISECTIONS = 30
"""Halvings of the place of an extremum: a misplacement of 2^-30 changes the extremum by 2^-60."""

POINT_SOURCES = ("u", "t")

TRAJECTORY_SOURCES = ("u", "parameters")

ENSEMBLE_LANES = 8

INVERSE_ROOT = "inverse_root_"

LARGEST_INLINED = 150
"""Operations of the kernels of a sweep that is made part of the loop over steps. Larger ones lose by it: six bodies
3 per cent, a chain of 64 masses 20."""

VECTOR_LIBRARY = ("sin", "cos", "exp", "log", "pow")
"""What glibc's libmvec has for every x86-64 vector width since 2.22."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ExampleRun:
    """What the generated ``main.c`` runs: initial state, step, and how often it prints."""

    q: tuple[float, ...]
    p: tuple[float, ...]
    parameters: tuple[float, ...]
    t: float
    h: float
    every: int
    outputs: int


@dataclass(frozen=True, slots=True, kw_only=True)
class EventSearch:
    """What the search for zeros of functions of the state is made from.

    Attributes:
        prefix, dimension: of the integrator.
        kernel: the functions at u = (q, p, v).
        uses_velocity: whether v occurs in them.
        nodes: (d + 1,) where they are evaluated on a part of a step, as fractions of it.
        coefficients: (d + 1, d + 1) from values there to coefficients of powers of x in [-1, 1].
        doubts: of the last two of these, what part of them is in doubt.
        splits: how many times over a step is split at most.
    """

    prefix: str
    dimension: int
    kernel: Kernel
    uses_velocity: bool
    nodes: tuple[float, ...]
    coefficients: tuple[tuple[float, ...], ...]
    doubts: tuple[float, float]
    splits: int


def render(program: Program) -> Source:
    """Header and source of a program; equal programs give equal bytes."""
    return _render(program.prefix, _context(program))


def render_embedded(program: Program, precision: Embedded) -> Source:
    """The same for a microcontroller: iterations bounded when it is compiled, in the precision of its registers.

    Raises:
        MethodError: for a number that single precision cannot hold.
    """
    bound = f"{program.prefix.upper()}_MAX_ITERATIONS"
    context = _context(program) | {
        "embedded": True,
        "most_iterations": MAX_ITERATIONS,
        "max_iterations": bound,
        "iteration_limit": f"least(options->max_iterations, {bound})",
        "halvings": 52,
    }
    if precision == "double":
        return _render(program.prefix, context)
    check_single((*program.parameter_defaults, *chain(*map(constants, _scalar_kernels(program)))))
    levels = {"real": "float", "halvings": 23, "tolerance": SINGLE_UNIT, "roundoff_level": SINGLE_ROUNDOFF_LEVEL}
    source = _render(program.prefix, context | levels)
    header, code, declarations = map(to_single, (source.header, source.code, source.declarations))
    return Source(prefix=source.prefix, header=header, code=code, declarations=declarations)


def _render(prefix: str, context: Mapping[str, object]) -> Source:
    environment = template_environment()
    return Source(
        prefix=prefix,
        header=environment.get_template("stepper.h.jinja").render(context),
        code=environment.get_template("stepper.c.jinja").render(context),
        declarations=environment.get_template("parts/declarations.h.jinja").render(context),
    )


def render_ensemble(program: Program) -> Source | None:
    """Text that integrates many trajectories at once, a lane each; ``None`` without a fixed-point solver."""
    sweep = program.sweep
    if not isinstance(sweep, SeparableSweep | CoupledSweep) or (isinstance(sweep, CoupledSweep) and sweep.projected):
        return None
    prefix = f"{program.prefix}_ensemble"
    context = {
        "program": program,
        "prefix": prefix,
        "cut": _is_cut(sweep.kernels),
        "tolerance": DEFAULT_TOLERANCE,
        "max_iterations": MAX_ITERATIONS,
        "width": ENSEMBLE_LANES,
        "lane_meaning": "trajectories",
        **_vector_context(sweep, TRAJECTORY_SOURCES),
    }
    environment = template_environment()
    return Source(
        prefix=prefix,
        header=environment.get_template("ensemble.h.jinja").render(context),
        code=environment.get_template("ensemble.c.jinja").render(context),
        declarations=environment.get_template("parts/ensemble_declarations.h.jinja").render(context),
    )


def render_events(search: EventSearch, source: Source) -> tuple[str, str]:
    """Declarations and code of the search for events, to stand behind those of an integrator."""
    needed = _inverse_roots(scalar_functions(search.kernel))
    context = {
        "prefix": search.prefix,
        "dimension": search.dimension,
        "kernel": search.kernel,
        "uses_velocity": search.uses_velocity,
        "nodes": search.nodes,
        "coefficients": search.coefficients,
        "doubts": search.doubts,
        "splits": search.splits,
        "events": search.kernel.values,
        "small_part": SMALL_PART,
        "steepness": STEEPNESS,
        "trials": MOST_TRIALS,
        "bisections": BISECTIONS,
        "inverse_roots": [k for k in needed if f" {INVERSE_ROOT}{k}(double" not in source.code],
    }
    environment = template_environment()
    return (
        environment.get_template("parts/events_declarations.h.jinja").render(context),
        environment.get_template("parts/events.c.jinja").render(context),
    )


def render_example(interface: Interface, start: ExampleRun, precision: Embedded = "double") -> dict[str, str]:
    """``main.c`` and ``Makefile`` that run the integrator with nothing but a C compiler."""
    context = {"interface": interface, "prefix": interface.prefix, "start": start}
    environment = template_environment()
    texts = {name: environment.get_template(f"{name}.jinja").render(context) for name in ("main.c", "Makefile")}
    if precision == "single":
        check_single((*start.q, *start.p, *start.parameters, start.t, start.h))
        texts["main.c"] = to_single(texts["main.c"])
    return texts


def workspace_size(program: Program) -> int:
    """Doubles of workspace: scratch, memory, and for Newton unknowns, point, update, pivots, rows and Jacobian."""
    if not program.newton:
        return scratch_size(program) + program.memory
    rows = program.unknowns + program.dimension
    jacobian = program.matrix_size(program.blocks + (1 if program.action else 0))
    return scratch_size(program) + program.memory + program.unknowns + program.point + 3 * rows + jacobian


def scratch_size(program: Program) -> int:
    """Doubles for the kernels of one family, or for the mass matrix with its slopes."""
    mass = program.matrix_size(1) + len(program.mass_entries)
    return max(mass, *(family.scratch for family in program.families)) if program.newton else mass


def _context(program: Program) -> dict[str, object]:
    return {
        "program": program,
        "prefix": program.prefix,
        "kernels": program.kernels,
        "cut": _is_cut((*_scalar_kernels(program), *(program.sweep.kernels if program.sweep else ()))),
        "inverse_roots": _inverse_roots(set().union(*map(scalar_functions, _scalar_kernels(program)))),
        "legendre": program.legendre,
        "workspace": workspace_size(program),
        "scratch": scratch_size(program),
        "tolerance": DEFAULT_TOLERANCE,
        "max_iterations": MAX_ITERATIONS,
        "iteration_limit": "options->max_iterations",
        "embedded": False,
        "real": "double",
        "roundoff_level": ROUNDOFF_LEVEL,
        "keep_change": KEEP_CHANGE,
        "keep_rate": KEEP_RATE,
        **_lane_context(program.sweep),
    }


def _scalar_kernels(program: Program) -> tuple[Kernel, ...]:
    return (*program.kernels, *(program.splitting.kernels if program.splitting else ()))


def _is_cut(kernels: Iterable[Kernel]) -> bool:
    """Whether one of them is several functions."""
    return any(len(parts(kernel)) > 1 for kernel in kernels)


def _lane_context(sweep: Sweep | None) -> dict[str, object]:
    """What the templates of the fixed-point solver need; nothing without one."""
    if sweep is None:
        return {}
    hot = "static inline __attribute__((always_inline)) " if _size(sweep) <= LARGEST_INLINED else "static "
    return _vector_context(sweep, POINT_SOURCES) | {"width": sweep.lanes, "lane_meaning": "points", "hot": hot}


def _size(sweep: Sweep) -> int:
    """Operations of all kernels with lanes."""
    return sum(sum(kernel.operation_counts().values()) for kernel in sweep.kernels)


def _vector_context(sweep: Sweep, sources: tuple[str, ...]) -> dict[str, object]:
    """Kernels in vectors, with the functions they call; ``sources`` differ from lane to lane."""
    kernels = applied = sweep.kernels
    if isinstance(sweep, SeparableSweep) and sources == TRAJECTORY_SOURCES:
        applied = (*kernels, sweep.mass)
    functions = set().union(*(lane_functions(kernel, sources) for kernel in applied))
    roots = _inverse_roots(functions)
    return {
        "sweep": sweep,
        "lane_kernels": kernels,
        "lane_functions": sorted(functions - {f"{INVERSE_ROOT}{k}" for k in roots} | ({"sqrt"} if roots else set())),
        "inverse_roots_in_lanes": roots,
        "root_for_inverses": "sqrt" not in functions,
        "series": _binomial_series,
        "good_guess": GOOD_GUESS**2,
        "vector_library": VECTOR_LIBRARY,
        "vector_sources": sources,
    }


def _inverse_roots(functions: set[str]) -> list[int]:
    """The k of all ``inverse_root_k``."""
    return sorted(int(name.removeprefix(INVERSE_ROOT)) for name in functions if name.startswith(INVERSE_ROOT))


def _binomial_series(k: int) -> list[float]:
    """Coefficients of e, .., e^4 in (1 - e)^(-k/2)."""
    coefficients = [1.0]
    for j in range(1, 5):
        coefficients.append(coefficients[-1] * (k / 2 + j - 1) / j)
    return coefficients[1:]
