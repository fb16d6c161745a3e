"""Kernels of a system: what every one of them is given beside its formulas."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from sympy import Expr, Symbol

from scvi_codegen.ir.arithmetic import lower_kernel
from scvi_codegen.ir.kernel import Kernel
from scvi_codegen.mechanics.system import MechanicalSystem

__all__ = ["damping_kernel", "integrand_kernel", "system_kernel"]


def integrand_kernel(system: MechanicalSystem, name: str, of: Iterable[Symbol]) -> Kernel | None:
    """What a run of the system integrates along its curve, at the arguments u; ``None`` if nothing."""
    if not system.integrands:
        return None
    return system_kernel(system, name, system.integrands, of=of, purpose="What is integrated along the curve.")


def damping_kernel(system: MechanicalSystem) -> Kernel | None:
    """The rate of a uniform damping; ``None`` without one."""
    if system.damping == 0:
        return None
    return system_kernel(system, "damping", (system.damping,), of=(), purpose="The rate gamma of the damping.")


def system_kernel(
    system: MechanicalSystem,
    name: str,
    values: Iterable[Expr],
    *,
    of: Iterable[Symbol],
    slopes: Iterable[Expr] = (),
    purpose: str = "",
) -> Kernel:
    """The kernel ``name`` of a system's time and parameters.

    Args:
        system, name: whose, and the C identifier.
        values: what it gives.
        of: its arguments u.
        slopes: what it gives beside the values.
        purpose: what it computes, one sentence, for the comment above it.
    """
    kernel = lower_kernel(
        name,
        arguments=tuple(of),
        time=system.time,
        parameters=system.parameters,
        values=tuple(values),
        slopes=tuple(slopes),
    )
    return replace(kernel, purpose=purpose)
