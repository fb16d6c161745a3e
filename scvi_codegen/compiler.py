"""The whole tour: a system and a method go in, a stepper comes out.

    MechanicalSystem, Method
      -> derive    StepEquations   the equations as the paper prints them, to look at (:mod:`scvi_codegen.equations`)
      -> solvers   Sweep           a solver without a matrix, where there is one (:mod:`scvi_codegen.solvers`)
      -> lower     Program         kernels, tables, loops: C without syntax (:mod:`scvi_codegen.lowering`)
      -> render    Source          header and source text, from ``templates/`` (:mod:`scvi_codegen.rendering`)
      -> build     module          compiled, bound and cached (:mod:`scvi_codegen.building`)
      -> Stepper                   step, integrate (:mod:`scvi_codegen.stepper`)

Each stage is a pure function from frozen data to frozen data; only ``build`` touches the disk. Texts and modules are
kept in the user's cache folder (:mod:`scvi_codegen.text_cache`), so the second time is quick.
"""

from __future__ import annotations

import re

from scvi_codegen.building import TUNED_FLAGS
from scvi_codegen.lowering import lower
from scvi_codegen.mechanical_system import MechanicalSystem
from scvi_codegen.methods.composition import Composition
from scvi_codegen.methods.method import Method
from scvi_codegen.program import Program
from scvi_codegen.rendering import render, render_ensemble, workspace_size
from scvi_codegen.solvers.choice import check_solver, sweep_of
from scvi_codegen.solvers.splitting import splitting_of
from scvi_codegen.source import Interface, Source
from scvi_codegen.stepper import Stepper
from scvi_codegen.text_cache import Texts, remembered_texts

__all__ = ["c_identifier", "compile_stepper", "describe", "generate_source", "program_of"]

LONGEST_PREFIX = 64
C_HEADERS = frozenset(
    """
    assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal stdarg stdbool stddef
    stdint stdio stdlib string tgmath time wchar wctype unistd
    """.split()  # noqa: SIM905  (a paragraph of words reads better than thirty quoted ones)
)
SOLVERS = ("auto", "explicit", "fixed-point", "newton")


def compile_stepper(
    system: MechanicalSystem,
    method: Method,
    *,
    solver: str = "auto",
    flags: tuple[str, ...] = TUNED_FLAGS,
    prefix: str | None = None,
) -> Stepper:
    """Derive, generate, compile and load the integrator of ``system`` by ``method``.

    Args:
        system: what moves.
        method: how its motion is discretised.
        solver: of the stage equations: ``"fixed-point"`` (fast, points as vector lanes; for every method of at most 32
            points on every system, but variational SCVI with more than 8 coordinates, and SVI with fewer points than
            the degree), ``"newton"`` (always, also for stiff systems and large steps), ``"explicit"`` (Stoermer-Verlet
            and compositions on separable systems) or ``"auto"``: explicit or fixed point where there is one, Newton
            where it fails.
        flags: for the C compiler; by default tuned to this processor.
        prefix: of the C names; by default made from the names of system and method.

    Raises:
        BuildError: if there is no C compiler.
        MethodError: for a solver that the method does not have.
    """

    def make() -> Texts:
        program = program_of(system, method, solver=solver, prefix=prefix)
        return render(program), describe(program, system, method), render_ensemble(program)

    source, interface, ensemble = remembered_texts(system, method, solver, prefix, make)
    return Stepper(source, interface, ensemble=ensemble, flags=flags)


def generate_source(
    system: MechanicalSystem, method: Method, *, solver: str = "auto", prefix: str | None = None
) -> tuple[Source, Interface]:
    """C text of the integrator, and what a caller must know of it; arguments as of :func:`compile_stepper`."""
    program = program_of(system, method, solver=solver, prefix=prefix)
    return render(program), describe(program, system, method)


def program_of(system: MechanicalSystem, method: Method, *, solver: str = "auto", prefix: str | None = None) -> Program:
    """The integrator without syntax; arguments as of :func:`compile_stepper`."""
    name = c_identifier(prefix or f"{system.name}_{method.name}")
    splitting = splitting_of(system, method) if solver in ("auto", "explicit") else None
    swept = solver in ("auto", "fixed-point") and splitting is None
    sweep = sweep_of(system, method) if swept else None
    check_solver(solver, method, SOLVERS, found=splitting if solver == "explicit" else sweep)
    newton = solver in ("auto", "newton") and not (splitting and isinstance(method, Composition))
    return lower(system, method, prefix=name, sweep=sweep, splitting=splitting, newton=newton)


def describe(program: Program, system: MechanicalSystem, method: Method) -> Interface:
    """The interface of a program."""
    return Interface(
        prefix=program.prefix,
        title=program.title,
        notes=program.notes,
        system=system.name,
        method=method.name,
        coordinates=program.coordinate_names,
        parameters=program.parameter_names,
        defaults=program.parameter_defaults,
        unknowns=program.unknowns,
        workspace=workspace_size(program),
        has_action=program.action,
    )


def c_identifier(name: str) -> str:
    """Lower-case letters, digits and underscores, beginning with a letter, of limited length.

    A single letter (``X_OK`` is a macro of POSIX) and names of C headers get a longer name.
    """
    cleaned = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")[:LONGEST_PREFIX].strip("_")
    if not cleaned[:1].isalpha():
        return f"integrator_{cleaned}".rstrip("_")
    return f"{cleaned}_integrator" if len(cleaned) == 1 or cleaned in C_HEADERS else cleaned
