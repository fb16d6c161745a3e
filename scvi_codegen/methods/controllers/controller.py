"""Interface of step-size controllers: their C, their memory in a run, and the formulas that they evaluate."""

from collections.abc import Callable
from dataclasses import dataclass

import sympy
from sympy import Expr

from scvi_codegen.systems.derived_expressions import forms_of
from scvi_codegen.systems.formulas.expressions import derivative_along
from scvi_codegen.systems.system import MechanicalSystem
from scvi_codegen.systems.time_transformation import time_rescaling_function

__all__ = ["Controller"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Controller:
    """Step-size controller of runs to a final time; C computes all step sizes.

    A controller without ``values`` determines the sizes h = 2^(k/4) of adaptive steps. After each step its C function
    ``static int next_change(run_memory *run, real error, real before, const error_limits *limits)`` returns the change
    of the level k, from -4 to 2: ``error`` is the error estimate of the step, ``before`` that of the step before,
    converted to the size of this one (0: none), and ``limits`` are the admissible errors; ``error_at(error, change)``
    converts an estimate to another level (``templates/support/step_size/step_size_levels.h``).

    A controller with ``values`` takes steps of equal size in tau, dt = g dtau, for a time-rescaling function g. Its C
    defines the type ``trial`` and the functions ``begin_trials``, ``find_step``, ``confirm_step`` and ``accept_trial``,
    which ``templates/support/run/advance_to.h`` calls, and calls the C function of its values, ``step_density``.

    Attributes:
        summary: one line for the help.
        code: C, included before the loop over steps; it may consist of ``#include`` lines of ``templates/support``.
        memory: further fields of the struct of a run, real numbers that are 0 at the start of a run and are parts of
            its checkpoints: names and comments.
        values: function of a system and g that returns formulas of (q, v, t), of a Hamiltonian (q, p, t).
    """

    summary: str
    code: str
    memory: tuple[tuple[str, str], ...] = ()
    values: Callable[[MechanicalSystem, str | Expr], tuple[Expr, ...]] | None = None

    @property
    def in_tau(self) -> bool:
        """True if steps are of equal size in tau, which requires a time-rescaling function."""
        return self.values is not None


PREDICTIVE = Controller(
    summary="adaptive steps (default)", code='#include "support/step_size/predictive_controller.h"\n'
)
"""Source: K. Gustafsson, ACM Trans. Math. Softw. 20 (1994) 496."""


def density_and_growth(system: MechanicalSystem, g: str | Expr) -> tuple[Expr, ...]:
    """Return 1/g and -d(log g)/dt along the motion of a system in physical time; SystemDefinitionError for other g."""
    rate = time_rescaling_function(system, g, in_time=True)
    forms = forms_of(system)
    rates = dict(zip(system.coordinates, forms.legendre if system.auxiliaries else system.velocities, strict=True))
    if system.auxiliaries:
        rates |= dict(zip(system.auxiliaries, forms.momentum_rate, strict=True))
    rates[system.time] = sympy.S.One
    change = derivative_along(rate, list(rates), list(rates.values()))
    return 1 / rate, -change / rate


REVERSIBLE = Controller(
    summary="equal steps of tau in any system (default of compiled time transformations)",
    code='#include "support/step_size/density.h"\n',
    memory=(
        ("density", "step density, in the middle of the last step; 0 before the first"),
        ("part", "fraction of a whole step that the last one was: less than 1 if it ended at t_end"),
    ),
    values=density_and_growth,
)
