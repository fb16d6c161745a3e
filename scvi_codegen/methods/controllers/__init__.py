"""Step-size controllers by name: how the step sizes of runs to a final time are chosen."""

from sympy import Expr

from scvi_codegen.common.errors import MethodError, SystemDefinitionError, closest
from scvi_codegen.methods.controllers.controller import PREDICTIVE, REVERSIBLE, Controller
from scvi_codegen.systems.system import MechanicalSystem
from scvi_codegen.systems.time_transformation import reparametrise, time_rescaling_function

__all__ = [
    "CONTROLLERS",
    "SYMPLECTIC",
    "Controller",
    "controller_named",
    "default_controller",
    "with_time_transformation",
]

CONTROLLERS = {
    "predictive": PREDICTIVE,  # the first one of adaptive steps, and the first of steps in tau, are the defaults
    "reversible": REVERSIBLE,
}
"""Step-size controllers by name."""
SYMPLECTIC = "symplectic"
"""Name of the system in transformed time (:func:`reparametrise`) beside those of the controllers."""


def default_controller(*, in_tau: bool) -> str:
    """Return the name of the default controller of adaptive steps, or of steps in tau."""
    return next(name for name, controller in CONTROLLERS.items() if controller.in_tau == in_tau)


def controller_named(name: str | None, *, in_tau: bool) -> Controller:
    """Return the controller of a name, ``None`` for the default one; MethodError unless it is one of such steps."""
    name = default_controller(in_tau=in_tau) if name is None else name
    if name not in CONTROLLERS:
        names = ", ".join(CONTROLLERS)
        raise MethodError(f"there is no controller '{name}'{closest(name, CONTROLLERS)} Known: {names}")
    if CONTROLLERS[name].in_tau != in_tau:
        remedy = "omit time_transformation" if in_tau else 'give time_transformation="frequency", or a formula'
        raise MethodError(f"the controller '{name}' is {'one of adaptive steps' if in_tau else 'one of tau'}: {remedy}")
    return CONTROLLERS[name]


def with_time_transformation(
    system: MechanicalSystem, g: str | Expr | None, controller: str | None = None
) -> tuple[MechanicalSystem, str | Expr | None]:
    """Return the system to integrate under a time transformation, and the ``time_transformation`` for its stepper.

    Args:
        system: the mechanical system.
        g: rate of dt = g dtau, or ``None`` for no time transformation.
        controller: ``"symplectic"`` (also ``None``): the system in transformed time, :func:`reparametrise`; or a name
            among :data:`CONTROLLERS`, such as ``"reversible"``: unchanged, for ``compile_stepper(...,
            time_transformation=...)``. Source of these names: E. Hairer, Ch. Lubich, G. Wanner, *Geometric Numerical
            Integration*, VIII.2 and VIII.3.
    """
    check_controller(controller, transformed=g is not None)
    if g is None:
        return system, None
    if controller in (None, SYMPLECTIC):
        return reparametrise(system, g), None
    if system.clock is not None:
        raise SystemDefinitionError(
            f"'{system.name}' has a time transformation already, which controls its steps: leave out "
            f"the {controller} controller, or use the system without the transformation"
        )
    time_rescaling_function(system, g, in_time=True)  # validated here rather than at the first step
    return system, g


def check_controller(controller: str | None, *, transformed: bool) -> None:
    """Raise ``SystemDefinitionError`` for a controller that is unknown or excluded.

    Those of tau require a transformation of time, which those of time exclude.
    """
    if controller not in (None, SYMPLECTIC, *CONTROLLERS):
        raise SystemDefinitionError(f"controller must be {' or '.join([SYMPLECTIC, *CONTROLLERS])}, not {controller!r}")
    in_tau = controller == SYMPLECTIC or (controller is not None and CONTROLLERS[controller].in_tau)
    if in_tau and not transformed:
        raise SystemDefinitionError(
            f'the {controller} controller requires a time transformation: give "frequency", or a formula'
        )
    if transformed and controller is not None and not in_tau:
        raise SystemDefinitionError(
            f"the {controller} controller determines adaptive steps: leave out the time transformation, or give "
            "another controller"
        )
