"""Kernels of a system, as functions of its time and parameters, and loops around kernels."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

from sympy import Expr, Symbol

from scvi_codegen.formulas.array_statements import ArrayForce
from scvi_codegen.formulas.arrays import ArrayTerm
from scvi_codegen.indices import Access
from scvi_codegen.ir.arithmetic import lower_kernel
from scvi_codegen.ir.kernel import Kernel, LoopedKernel
from scvi_codegen.mechanics.arrays.system import ArraySystem
from scvi_codegen.mechanics.system import MechanicalSystem


def integrand_kernel(system: MechanicalSystem, name: str, of: Iterable[Symbol]) -> Kernel | None:
    """Return the kernel of the functions that a run integrates along its curve; ``None`` if there are none."""
    if not system.integrands:
        return None
    return system_kernel(
        system, name, system.integrands, of=of, purpose="Functions that are integrated along the curve."
    )


def damping_kernel(system: MechanicalSystem) -> Kernel | None:
    """Return the kernel of the rate of a uniform damping; ``None`` without damping."""
    if system.damping == 0:
        return None
    return system_kernel(system, "damping", (system.damping,), of=(), purpose="The rate gamma of the damping.")


def system_kernel(
    system: MechanicalSystem,
    name: str,
    values: Iterable[Expr],
    *,
    of: Iterable[Symbol],
    partials: Iterable[Expr] = (),
    purpose: str = "",
) -> Kernel:
    """Return the kernel ``name`` as a function of the time and parameters of a system.

    Args:
        system, name: the system, and the C identifier.
        values: expressions of the values.
        of: the arguments u.
        partials: expressions of derivatives, stored after the values.
        purpose: one sentence on what it computes, for the comment above it.
    """
    kernel = lower_kernel(
        name,
        arguments=tuple(of),
        time=system.time,
        parameters=system.parameters,
        values=tuple(values),
        partials=tuple(partials),
    )
    return replace(kernel, purpose=purpose)


def looped_kernel(
    system: ArraySystem,
    name: str,
    values: Iterable[Expr],
    of: ArrayTerm | ArrayForce,
    u: Sequence[tuple[Symbol, Access]] = (),
    *,
    along: Sequence[Symbol] = (),
    targets: Sequence[Access] | None = None,
    text: str,
    purpose: str,
) -> LoopedKernel:
    """Return the kernel ``name`` in the loops of a term.

    Args:
        system, name, values, purpose: as of :func:`system_kernel`.
        of: the term, whose other entries are the last parameters.
        u: entries that are arguments.
        along: further arguments, the components of a direction by these entries.
        targets: entries that the values are added to; by default ``u``.
        text: formula for the comment.
    """
    symbols, accesses = [slot for slot, _ in u], tuple(access for _, access in u)
    given = [(slot, access) for slot, access in of.slots if slot not in symbols]
    kernel = lower_kernel(
        name,
        arguments=(*symbols, *along),
        time=system.time,
        parameters=(*system.parameters, *(slot for slot, _ in given)),
        values=tuple(values),
    )
    return LoopedKernel(
        kernel=replace(kernel, purpose=purpose),
        loops=of.loops,
        reads=accesses * (2 if along else 1),
        writes=accesses if targets is None else tuple(targets),
        given=tuple(access for _, access in given),
        text=comment_text(text),
        along=len(along),
    )


def comment_text(text: str) -> str:
    """Return one printable line that neither ends nor begins a C comment."""
    line = "".join(character if character.isprintable() else "?" for character in " ".join(text.split()))
    return line.replace("*/", "* /").replace("/*", "/ *").replace("??/", "? ? /")
