"""Program to text: the only room that knows Jinja.

Entry templates are named after the file they make; parts live in ``templates/parts``. Templates hold shape only: loops
over the program's tables and the C that does not depend on it. Arithmetic arrives lowered and is printed by
:mod:`scvi_codegen.c_printer` through filters.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from scvi_codegen.c_printer import (
    lane_functions,
    print_lane_statements,
    print_number,
    print_statements,
    scalar_functions,
)
from scvi_codegen.program import CoupledSweep, Family, Kernel, Program, SeparableSweep, Sweep
from scvi_codegen.source import Interface, Source

__all__ = ["DEFAULT_TOLERANCE", "MAX_ITERATIONS", "ExampleRun", "render", "render_example", "template_folder"]

DEFAULT_TOLERANCE = 2.0**-52
"""Relative update below which Newton's iteration has converged: the round-off unit of binary64."""

MAX_ITERATIONS = 50
ROUNDOFF_LEVEL = 1e-11
KEEP_CHANGE = 1e-2
KEEP_RATE = 0.1
GOOD_GUESS = 1e-3
"""Relative error below which the next guess is continued from two steps, not one."""
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


def template_folder() -> Path:
    """The templates: inside the installed package, or beside it in a checkout."""
    package = Path(__file__).parent
    for folder in (package / "templates", package.parent / "templates"):
        if (folder / "stepper.c.jinja").is_file():
            return folder
    raise FileNotFoundError("the C templates are missing: reinstall scvi-codegen")


def render(program: Program) -> Source:
    """Header and source of a program; equal programs give equal bytes."""
    context = _context(program)
    environment = _environment()
    return Source(
        prefix=program.prefix,
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
        "purpose": _purposes(program),
        "tolerance": DEFAULT_TOLERANCE,
        "max_iterations": MAX_ITERATIONS,
        "width": ENSEMBLE_LANES,
        "lane_meaning": "trajectories",
        **_vector_context(sweep, TRAJECTORY_SOURCES),
    }
    environment = _environment()
    return Source(
        prefix=prefix,
        header=environment.get_template("ensemble.h.jinja").render(context),
        code=environment.get_template("ensemble.c.jinja").render(context),
        declarations=environment.get_template("parts/ensemble_declarations.h.jinja").render(context),
    )


def render_example(interface: Interface, start: ExampleRun) -> dict[str, str]:
    """``main.c`` and ``Makefile`` that run the integrator with nothing but a C compiler."""
    context = {"interface": interface, "prefix": interface.prefix, "start": start}
    environment = _environment()
    return {name: environment.get_template(f"{name}.jinja").render(context) for name in ("main.c", "Makefile")}


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
    scalar_kernels = (*program.kernels, *(program.splitting.kernels if program.splitting else ()))
    return {
        "program": program,
        "prefix": program.prefix,
        "kernels": program.kernels,
        "inverse_roots": _inverse_roots(set().union(*map(scalar_functions, scalar_kernels))),
        "purpose": _purposes(program),
        "legendre": program.legendre,
        "workspace": workspace_size(program),
        "scratch": scratch_size(program),
        "tolerance": DEFAULT_TOLERANCE,
        "max_iterations": MAX_ITERATIONS,
        "roundoff_level": ROUNDOFF_LEVEL,
        "keep_change": KEEP_CHANGE,
        "keep_rate": KEEP_RATE,
        **_lane_context(program.sweep),
    }


def _purposes(program: Program) -> dict[str, str]:
    """One sentence a kernel, for the comment above it."""
    purposes = {
        "legendre": "Momenta L_v and mass matrix L_vv at u = (q, v).",
        "lagrangian": "L at u = (q, v).",
        "derivative_1_action": "dL/dt at u = (q, v, a).",
        "derivative_2_action": "d^2L/dt^2 at u = (q, v, a, j).",
        "derivative_3_action": "d^3L/dt^3 at u = (q, v, a, j, s).",
        "hamiltonian": "H at u = (q, p).",
        "force_lanes": "L_q at all points.",
        "node_lanes": "E, (m . E)_q, (m . E)_v and the lower triangle of L_vv at all nodes, u = (q, v, a, m).",
        "action_lanes": "L_q and L_v at all points, u = (q, v).",
        "applied_force_lanes": "L_q - L_vq v - L_vt and the lower triangle of L_vv at all nodes, u = (q, v).",
        "point_lanes": "L_q, L_v and the lower triangle of L_vv at all points, u = (q, v).",
    }
    if program.hamiltonian:
        purposes |= {"legendre": "H_p and H_pp at u = (q, p).", "lagrangian": "p . v - H at u = (q, v, p)."}
    for family in program.families:
        arguments = f"({', '.join(family.arguments)})"
        purposes[family.value.name] = f"{_results(family)} at u = {arguments}."
        purposes[family.slope.name] = f"The same, and the non-zero derivatives with respect to u = {arguments}."
    return purposes


def _results(family: Family) -> str:
    if family.name == "node":
        return "Derivatives of lambda . E" if "lambda" in family.arguments else "The Euler-Lagrange residual E"
    if family.action_power:
        return f"Derivatives of d^{family.action_power}L/dt^{family.action_power}"
    slopes = " and ".join(f"L_{name}" for name in family.arguments)
    return slopes if len(family.scatters) == len(family.gathers) else "L_v"


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


def _signature(kernel: Kernel) -> str:
    """C parameters of a kernel: only what it uses."""
    parts = ["const double *u"] if kernel.uses_arguments else []
    parts += ["double t"] if kernel.uses_time else []
    parts += ["const double *parameters"] if kernel.uses_parameters else []
    parts += ["double *value"]
    parts += ["double *slope"] if len(kernel.results) > kernel.values else []
    return ", ".join(parts)


def _lane_signature(kernel: Kernel, sources: tuple[str, ...]) -> str:
    """The same with vectors in place of numbers."""
    signature = _signature(kernel).replace("const double *u", "const lanes *u").replace("double *value", "lanes *value")
    signature = signature.replace("double *slope", "lanes *slope")
    if "t" in sources:
        return signature.replace("double t", "lanes t")
    return signature.replace("const double *parameters", "const lanes *parameters")


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
def _environment() -> Environment:
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
        "call_arguments": _call_arguments,
        "counts": _counts,
        "pairs": lambda entries: ", ".join(f"{{{i}, {j}}}" for i, j in entries),
        "transposed": lambda rows: tuple(zip(*rows, strict=True)),
        "lane_signature": _lane_signature,
        "statements": print_statements,
        "lane_statements": print_lane_statements,
    }
    return environment
