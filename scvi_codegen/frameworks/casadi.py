"""A flow for CasADi: an external function in C, with its derivatives, for trajectory optimisation and estimation."""

from __future__ import annotations

from typing import Any

from scvi_codegen.errors import StateError
from scvi_codegen.frameworks.flow import Flow, imported
from scvi_codegen.given.kinds import SWITCH, of, takes
from scvi_codegen.native import building
from scvi_codegen.rendering.flow import casadi_name, with_casadi_flow
from scvi_codegen.runtime.stepper import Stepper

__all__ = ["casadi_flow"]

ARGUMENTS = ("q", "p", "parameters", "t", "h")


@takes(StateError, stepper=of("a compiled stepper", Stepper), hessian=SWITCH)
def casadi_flow(stepper: Stepper, *, steps: int, every: int | None = None, hessian: bool = False) -> Any:
    """So many steps of a stepper as a ``casadi.Function``.

    It is an external function in compiled C, which CasADi calls without Python, with its Jacobian and its adjoint by
    CasADi's naming convention: ``jacobian``, ``gradient``, ``jtimes``, ``map`` and nonlinear programs take it like any
    other. Derivatives are exact, those of the computed map. Second ones are there with ``hessian``; without, give IPOPT
    ``{"ipopt.hessian_approximation": "limited-memory"}``, or steps as constraints (:func:`optimal_control`).

    Args:
        stepper: system and method.
        steps: how many.
        every: keep every so-many-th state and the initial one; by default that at the end alone.
        hessian: with second derivatives, exact, too, whose kernels are then derived and compiled.

    Returns:
        A ``casadi.Function`` of q (m), p (m), parameters (k), such as ``stepper.defaults``, t and h, by place or by
        name, t then being 0 where it is left out. Its values q1 and p1 are (m), with ``every`` (m, n), states in
        columns. Where a step fails, so does the call, and solvers try shorter ways. Where there are constraints,
        states off them are taken as they are, and the first step leads to them.

    Raises:
        MethodError: in transformed time, and where a monitor chooses the steps; for second derivatives with damping.
        MissingLibraryError: without CasADi (extra ``casadi``).
        StateError: for steps that are no multiple of ``every``.
    """
    flow = Flow.checked(stepper, steps, every)
    ca = imported("casadi", "casadi")
    derivatives = flow.second_derivatives if hessian else flow.derivatives
    source = with_casadi_flow(derivatives, flow.steps, flow.spacing, second=hessian)
    library = building.load(source, flags=stepper.flags)
    name, m = casadi_name(source.prefix), stepper.dimension
    sizes = (m, m, len(stepper.parameters), 1, 1)
    given = [ca.MX.sym(word, size) for word, size in zip(ARGUMENTS, sizes, strict=True)]
    states = ca.external(name, str(library.path))(ca.vertcat(*given))
    states = states if flow.every else states[:, -1]
    found = [states[:m, :], states[m:, :]]
    missing = float("nan")
    defaults = [missing, missing, missing if stepper.parameters else 0.0, 0.0, missing]
    return ca.Function(name, given, found, [*ARGUMENTS], ["q1", "p1"], {"default_in": defaults})
