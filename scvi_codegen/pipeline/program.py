"""Lowered program of a system and a method."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial

from scvi_codegen.ir.program import Program
from scvi_codegen.lowering.constraints import rattle_of
from scvi_codegen.lowering.loops import with_sums
from scvi_codegen.lowering.program import lower
from scvi_codegen.lowering.solvers.selection import check_solver, iteration_of, splitting_of
from scvi_codegen.mechanics.symmetry.symmetry import Symmetry, all_symmetries
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.mechanics.term_groups import rolled
from scvi_codegen.methods.discretise import discretise
from scvi_codegen.methods.method import Method

__all__ = ["c_identifier", "program_of"]

LONGEST_PREFIX = 64
C_HEADERS = frozenset(
    """
    assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal stdarg stdbool stddef
    stdint stdio stdlib string tgmath time wchar wctype unistd
    """.split()  # noqa: SIM905  (a paragraph of words reads better than thirty quoted ones)
)
SOLVERS = ("auto", "explicit", "fixed-point", "newton")


def program_of(
    system: MechanicalSystem,
    method: Method,
    *,
    solver: str = "auto",
    prefix: str | None = None,
    symmetries: Sequence[Symmetry] = (),
    lanes: bool = True,
    fallback: bool = True,
) -> Program:
    """Return the lowered program of an integrator; other arguments as of :func:`compile_stepper`.

    Args:
        lanes: allow a solver that uses SIMD lanes.
        fallback: include Newton's iteration as a fallback. Systems with integrals along the curve always include it.
    """
    name = c_identifier(prefix or f"{system.name}_{method.name}")
    tracked = all_symmetries(system, symmetries)
    program_part = partial(
        _program, method=method, solver=solver, prefix=name, symmetries=tracked, lanes=lanes, fallback=fallback
    )
    parts = rolled(system)
    looped = with_sums(program_part(parts.rest), parts) if parts else None
    return looped or program_part(system)


def _program(
    system: MechanicalSystem,
    *,
    method: Method,
    solver: str,
    prefix: str,
    symmetries: Sequence[Symmetry],
    lanes: bool,
    fallback: bool,
) -> Program:
    """Lower a system without rolling its terms into loops."""
    stages = discretise(system, method)
    explicit = solver in ("auto", "explicit") and not system.integrands
    splitting = splitting_of(system, method) if explicit else None
    use_fixed_point = lanes and solver in ("auto", "fixed-point") and splitting is None
    fixed_point = iteration_of(system, stages) if use_fixed_point else None
    check_solver(solver, method, SOLVERS, found=splitting if solver == "explicit" else fixed_point)
    alone = fixed_point is not None and not fallback and not system.integrands
    newton = solver in ("auto", "newton") and splitting is None and not alone
    return lower(
        system,
        method,
        stages,
        prefix=prefix,
        fixed_point=fixed_point,
        splitting=splitting,
        newton=newton,
        rattle=rattle_of(system, stages) if solver == "auto" else None,
        symmetries=symmetries,
    )


def c_identifier(name: str) -> str:
    """Return a name of lower-case letters, digits and underscores that begins with a letter, of limited length.

    Single letters (``X_OK`` is a POSIX macro) and names of C headers get a suffix.
    """
    cleaned = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")[:LONGEST_PREFIX].strip("_")
    if not cleaned[:1].isalpha():
        return f"integrator_{cleaned}".rstrip("_")
    return f"{cleaned}_integrator" if len(cleaned) == 1 or cleaned in C_HEADERS else cleaned
