"""Kernels of a system, as functions of its time and parameters."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from sympy import Expr, Symbol

from scvi_codegen.ir.arithmetic import lower_kernel
from scvi_codegen.ir.kernel import Kernel
from scvi_codegen.mechanics.system import MechanicalSystem

__all__ = ["damping_kernel", "integrand_kernel", "system_kernel"]


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
        slopes: expressions of derivatives, stored after the values.
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
