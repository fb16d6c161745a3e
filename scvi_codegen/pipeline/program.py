"""Lowered program of a system and a method."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import partial

from scvi_codegen.ir.program import Program
from scvi_codegen.lowering.loops import with_sums
from scvi_codegen.lowering.program import lower
from scvi_codegen.mechanics.symmetry.symmetry import Symmetry, all_symmetries
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.mechanics.term_groups import rolled
from scvi_codegen.methods.method import Method

LONGEST_PREFIX = 64
C_HEADERS = frozenset(
    """
    assert complex ctype errno fenv float inttypes iso646 limits locale math setjmp signal stdarg stdbool stddef
    stdint stdio stdlib string tgmath time wchar wctype unistd
    """.split()  # noqa: SIM905  (a paragraph of words reads better than thirty quoted ones)
)


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

    ``lanes`` and ``fallback`` are those of :func:`~scvi_codegen.lowering.program.lower`.
    """
    name = c_identifier(prefix or f"{system.name}_{method.name}")
    tracked = all_symmetries(system, symmetries)
    program_part = partial(
        lower, method=method, prefix=name, solver=solver, symmetries=tracked, lanes=lanes, fallback=fallback
    )
    parts = rolled(system)
    looped = with_sums(program_part(parts.rest), parts) if parts else None
    return looped or program_part(system)


def c_identifier(name: str) -> str:
    """Return a name of lower-case letters, digits and underscores that begins with a letter, of limited length.

    Single letters (``X_OK`` is a POSIX macro) and names of C headers get a suffix.
    """
    cleaned = re.sub(r"[^a-z0-9]+", "_", name.lower()).strip("_")[:LONGEST_PREFIX].strip("_")
    if not cleaned[:1].isalpha():
        return f"integrator_{cleaned}".rstrip("_")
    return f"{cleaned}_integrator" if len(cleaned) == 1 or cleaned in C_HEADERS else cleaned
