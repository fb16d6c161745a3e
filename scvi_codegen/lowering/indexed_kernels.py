"""Kernels of indexed systems: arguments are the variables, other entries of arrays the last parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from sympy import Expr, Symbol

from scvi_codegen.indices import Access
from scvi_codegen.ir.arithmetic import lower_kernel
from scvi_codegen.ir.kernel import Kernel
from scvi_codegen.mechanics.indexed.system import IndexedSystem

__all__ = ["constants_of", "kernel_of"]


def constants_of(slots: Sequence[tuple[Symbol, Access]], u: Sequence[Symbol]) -> tuple[Access, ...]:
    """Return the entries that are not variables."""
    return tuple(access for slot, access in slots if slot not in u)


def kernel_of(
    system: IndexedSystem,
    name: str,
    values: Sequence[Expr],
    slots: Sequence[tuple[Symbol, Access]],
    u: Sequence[Symbol],
    purpose: str,
) -> Kernel:
    """Return the kernel of functions of the slots, of which ``u`` are variables."""
    kernel = lower_kernel(
        name,
        arguments=tuple(u),
        time=system.time,
        parameters=(*system.parameters, *(slot for slot, _ in slots if slot not in u)),
        values=tuple(values),
        partials=(),
    )
    return replace(kernel, purpose=purpose)
