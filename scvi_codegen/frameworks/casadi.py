"""Flow map as a CasADi external function in C with derivatives, for trajectory optimisation and estimation."""

from __future__ import annotations

from typing import Any

from scvi_codegen.errors import StateError
from scvi_codegen.frameworks.flow import Flow, imported
from scvi_codegen.native import building
from scvi_codegen.rendering.flow import casadi_name, with_casadi_flow
from scvi_codegen.runtime.core.stepper import Stepper
from scvi_codegen.validation import SWITCH, checks_arguments, of

ARGUMENTS = ("q", "p", "parameters", "t", "h")


@checks_arguments(StateError, stepper=of("a compiled stepper", Stepper), hessian=SWITCH)
def casadi_flow(stepper: Stepper, *, steps: int, save_every: int | None = None, hessian: bool = False) -> Any:
    """Return a fixed number of steps of a stepper as a ``casadi.Function``.

    It is an external function in compiled C, which CasADi calls without Python, with Jacobian and adjoint in CasADi's
    naming convention: ``jacobian``, ``gradient``, ``jtimes``, ``map`` and nonlinear programs accept it. Derivatives are
    those of the computed map, exact up to round-off. Second derivatives require ``hessian``; without them pass
    ``{"ipopt.hessian_approximation": "limited-memory"}`` to IPOPT, or use steps as constraints
    (:func:`optimal_control`).

    Args:
        stepper: compiled stepper.
        steps: number of steps.
        save_every: save the initial state and every ``save_every``-th one; by default only the final state.
        hessian: derive and compile exact second derivatives, too.

    Returns:
        A ``casadi.Function`` of q (m), p (m), parameters (k), such as ``stepper.defaults``, t and h, by position or by
        name; t defaults to 0. Its values q1 and p1 are (m), with ``save_every`` (m, n), states in columns. If a step
        fails, the call fails, and solvers shorten their step. States that violate the constraints are not projected;
        the first step moves them onto the constraint manifold.

    Raises:
        MethodError: in transformed time, for steps of a time-rescaling function, and for second derivatives with
            damping.
        MissingLibraryError: without CasADi (extra ``casadi``).
        StateError: if ``steps`` is not a multiple of ``save_every``.
    """
    flow = Flow.checked(stepper, steps, save_every)
    ca = imported("casadi", "casadi")
    derivatives = flow.second_derivatives if hessian else flow.derivatives
    source = with_casadi_flow(derivatives, flow.steps, flow.spacing, second=hessian)
    library = building.load(source, flags=stepper.flags)
    name, m = casadi_name(source.prefix), stepper.dimension
    sizes = (m, m, len(stepper.parameters), 1, 1)
    arguments = [ca.MX.sym(word, size) for word, size in zip(ARGUMENTS, sizes, strict=True)]
    states = ca.external(name, str(library.path))(ca.vertcat(*arguments))
    states = states if flow.save_every else states[:, -1]
    result = [states[:m, :], states[m:, :]]
    missing = float("nan")
    defaults = [missing, missing, missing if stepper.parameters else 0.0, 0.0, missing]
    return ca.Function(name, arguments, result, [*ARGUMENTS], ["q1", "p1"], {"default_in": defaults})
