"""Interface of step-size controllers: their C, their memory in a run, and the formulas that they evaluate."""

from collections.abc import Callable
from dataclasses import dataclass

from sympy import Expr

from scvi_codegen.systems.system import MechanicalSystem

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
