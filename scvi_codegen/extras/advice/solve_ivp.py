"""The names of SciPy's ``solve_ivp`` for ``compile_stepper(system, method).integrate(..)``."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from scvi_codegen.api.checks import Kind, checks_arguments
from scvi_codegen.api.states import Array, checked_number, real_array
from scvi_codegen.api.systems import MechanicalSystem
from scvi_codegen.api.text import summary
from scvi_codegen.common.errors import ArgumentError, StateError, StepFailedError
from scvi_codegen.runs.compiler import compile_stepper
from scvi_codegen.runs.stepper import Stepper
from scvi_codegen.runs.trajectory import Trajectory

WORDS = "a system or its stepper (for a function f(t, y) use scipy.integrate.solve_ivp, see docs/limits.md)"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OdeResult:
    """Fields of SciPy's result, y = (q, p) of shape (2 m, n); ``trajectory``: the run, its ``steps`` and energies."""

    t: Array
    y: Array
    sol: Any
    t_events: list[Array] | None
    y_events: list[Array] | None
    status: int
    message: str
    success: bool
    trajectory: Trajectory
    __repr__ = summary("t", "y", "status", "message")


@checks_arguments(dense_output=Kind.SWITCH, system=Kind(WORDS, lambda s: isinstance(s, MechanicalSystem | Stepper)))
def solve_ivp(system: Any, t_span: Any, y0: Any, *, velocity: Any = None, method: Any = None, t_eval: Any = None,
              dense_output: bool = False, events: Any = None, args: Any = None, rtol: Any = None, atol: Any = None,
              max_step: Any = math.inf, first_step: Any = None, **others: Any) -> OdeResult:  # fmt: skip
    """Integrate by adaptive steps with the names of SciPy's ``solve_ivp``; further options: :meth:`Stepper.integrate`.

    y0: (2 m,) positions and momenta, or (m,) positions beside ``velocity``, also by name; args: parameters; rtol (by
    default round-off), atol: a step errs by at most ``max(rtol * motion, atol)``; events: formulas or :class:`Event`.
    """
    for name in others:
        raise ArgumentError(f"solve_ivp() takes no {name!r}: omit it, or use compile_stepper(system).integrate(..)")
    if isinstance(system, Stepper) and method is not None:
        raise StateError("method needs a system, not a compiled stepper: omit it, or compile the system by it")
    if (span := real_array(t_span, "t_span")).shape != (2,):
        raise StateError(f"t_span must be two times, not {t_span!r}")
    if atol is not None and not rtol:
        raise StateError(f"atol = {atol} requires rtol: the error of a step is at most max(rtol * motion, atol)")
    absolute = None if atol is None else checked_number(atol, "atol") / checked_number(rtol, "rtol")
    if velocity is None and (isinstance(y0, dict) or np.ndim(y0) != 1 or len(y0) % 2):
        raise StateError(f"y0 must be 2 m numbers, positions and then momenta, or give velocity, too: not {y0!r}")
    stepper = system if isinstance(system, Stepper) else compile_stepper(system, method)
    q, p = (y0, None) if velocity is not None else np.split(real_array(y0, "y0"), 2)
    times = None if t_eval is None else real_array(t_eval, "t_eval")
    plan: Any = {"t": span[0], "t_end": span[1], "tolerance": rtol, "absolute_tolerance": absolute,
                 "first_step": first_step, "max_step": None if max_step == math.inf else max_step,
                 "parameters": args, "events": events, "t_eval": None if dense_output else times}  # fmt: skip
    status, message = 0, "The end of the span was reached."
    try:
        run = stepper.integrate(q, p, velocity=velocity, **plan)
        if run.ended_by is not None:
            status, message = 1, f"The terminal event '{run.ended_by.function}' occurred."
    except StepFailedError as failure:
        run, status, message = Trajectory.before(failure), -1, str(failure)
    sol: Any = lambda t: np.concatenate([half.T for half in run.at(t)])  # noqa: E731
    t, y = run.t, np.hstack([run.q, run.p]).T
    if dense_output and times is not None:
        t = times[(times - run.t[-1]) * (span[1] - span[0]) <= 0.0]
        y = sol(t)
    t_events, y_events = [e.t for e in run.events] or None, [np.hstack([e.q, e.p]) for e in run.events] or None
    return OdeResult(t=t, y=y, sol=sol if dense_output else None, status=status, message=message, success=status >= 0,
                     t_events=t_events, y_events=y_events, trajectory=run)  # fmt: skip
