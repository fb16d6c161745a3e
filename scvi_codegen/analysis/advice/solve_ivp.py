"""Solution of initial value problems by one call, with the arguments and the result of SciPy's ``solve_ivp``."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from sympy import Expr

from scvi_codegen.analysis.advice.advice import advise
from scvi_codegen.analysis.advice.tolerance_check import missed_tolerance
from scvi_codegen.codegen.native.arguments import checked_number, checked_step, real_array
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.common.errors import StateError, StepFailedError
from scvi_codegen.common.representation import summary
from scvi_codegen.common.validation import ArgumentType, checks_arguments
from scvi_codegen.methods import Method, as_method, default_method
from scvi_codegen.methods.controllers import SYMPLECTIC, with_time_transformation
from scvi_codegen.runs.accuracy.global_error import checked_error
from scvi_codegen.runs.compiler import compile_stepper, second_stepper
from scvi_codegen.runs.driver.largest_step import accuracy_message, largest_step
from scvi_codegen.runs.results.dense_output import times_of_run
from scvi_codegen.runs.states.validation import Array, States
from scvi_codegen.runs.stepper import Stepper
from scvi_codegen.runs.stepping.features import require
from scvi_codegen.runs.stepping.step_plan import ErrorControl
from scvi_codegen.runs.trajectory import Trajectory
from scvi_codegen.systems.event import EventLike
from scvi_codegen.systems.rolling import unrolled_at
from scvi_codegen.systems.system import MechanicalSystem

Solution: TypeAlias = Callable[[ArrayLike], Array]
REACHED, EVENT, FAILED, MISSED = 0, 1, -1, -2
DEFAULT_TOLERANCE = 1e-9
"""Tolerance of the recommended fixed step size for methods without adaptive steps, if none is passed."""


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class OdeResult:
    """Result of :func:`solve_ivp`; y is (q, p), positions and then momenta.

    Attributes:
        t: (n,) times.
        y: (2 m, n) states.
        sol: function from times to states, (2 m,) for a number, (2 m, n) for n times; ``None`` without
            ``dense_output``.
        t_events: (k,) times of the crossings of each event, ``None`` without events.
        y_events: (k, 2 m) states at these times.
        status: 0 end of the span, 1 terminal event, -1 a step failed, -2 the tolerance was missed.
        message: description of the status.
        trajectory: states as a :class:`~scvi_codegen.Trajectory`, with energies; its ``steps``,
            ``rejected_steps`` and ``iterations`` take the place of SciPy's ``nfev``, ``njev`` and ``nlu``.
    """

    t: Array
    y: Array
    sol: Solution | None
    t_events: list[Array] | None
    y_events: list[Array] | None
    status: int
    message: str
    trajectory: Trajectory

    __repr__ = summary("t", "y", "status", "message")

    @property
    def success(self) -> bool:
        """True if the end of the span or a terminal event was reached within the tolerance."""
        return self.status >= 0


SYSTEM_OR_STEPPER = ArgumentType(
    "a system or its stepper (for a function f(t, y) use scipy.integrate.solve_ivp, see docs/limits.md)",
    lambda value: isinstance(value, MechanicalSystem | Stepper),
)


@checks_arguments(system=SYSTEM_OR_STEPPER)
def solve_ivp(
    system: MechanicalSystem | Stepper,
    t_span: Sequence[float],
    y0: States,
    *,
    velocity: States | None = None,
    method: Method | str | None = None,
    h: float | None = None,
    tolerance: float | None = None,
    rtol: float | None = None,
    error: float | None = None,
    time_transformation: str | Expr | None = None,
    controller: str | None = None,
    t_eval: ArrayLike | None = None,
    dense_output: bool = False,
    events: EventLike | Sequence[EventLike] | None = None,
    parameters: Mapping[str, float] | Sequence[float] | None = None,
    args: Sequence[float] | None = None,
    options: SolverOptions | None = None,
    atol: float | ArrayLike | Mapping[str, float] | None = None,
    max_step: float | None = None,
    first_step: float | None = None,
) -> OdeResult:
    """Solve the initial value problem of a mechanical system, with the arguments of ``scipy.integrate.solve_ivp``.

    The run leads from ``t_span[0]`` to ``t_span[1]``, which may be earlier. The system replaces the right-hand side.

    The step size is adaptive by default; it is fixed with ``h`` or ``tolerance`` and for methods without adaptive
    steps.

    Args:
        system: mechanical system; or its compiled stepper, which takes the place of ``method``.
        t_span: two times.
        y0: (2 m,) initial positions, then momenta; (m,) positions alone, also arrays by name, if ``velocity`` is
            passed. They determine the sizes of arrays that are known at run time only.
        velocity: (m,) initial velocities, instead of momenta, or arrays by name.
        method: method, or its name, as ``"svi:6"``; by default ``SVI(8)``, with constraints at Gauss-Lobatto points.
        h: upper bound of a fixed step size, reduced so that whole steps fill the span.
        tolerance: instead of ``h``: error ``|q - q_exact| / |q - mean q|`` at the end, for which :func:`advise` chooses
            ``h``. ``success`` is False if the run misses it.
        rtol: relative local error of adaptive steps, relative to the motion of each coordinate in the step; by default
            round-off.
        atol: absolute local error of adaptive steps: that of a step is at most ``max(rtol * motion, atol)``. A number,
            (m,) or (2 m,) numbers in the order of y0, or numbers by name of coordinate, array or rotation; requires
            ``rtol``. Errors of momenta have no bound of their own, so that their numbers are not used.
        max_step, first_step: largest and first size of adaptive steps, as of ``scipy.integrate.solve_ivp``.
        error: bound on the relative global error of the whole run, as of :meth:`Stepper.integrate`;
            ``trajectory.global_error`` and ``confirmed_until`` report the estimate. ``success`` is False if the bound
            is not confirmed.
        time_transformation: time-rescaling function g of :func:`reparametrise`: equal steps of tau, dt = g dtau,
            symplectic and with variable step size in t. ``h`` is then in tau; without it :func:`largest_step` finds one
            for ``rtol``, and ``success`` is False if the run misses that.
        controller: ``"reversible"``: the time-rescaling function of :func:`compile_stepper`, also for systems with
            explicit time or forces; ``"symplectic"`` (default): that of :func:`reparametrise`.
        t_eval: (n,) times at which to return states; by default the ends of the steps.
        dense_output: return ``sol``; all steps are then saved.
        events: zero crossings to record, and to end at, as of :meth:`Stepper.integrate`.
        parameters, options: as of :meth:`Stepper.integrate`.
        args: as of ``solve_ivp``: all parameters in order, instead of ``parameters``.

    Raises:
        StateError, EventError: on wrong shapes, names or numbers.
    """
    if args is not None and parameters is not None:
        raise StateError("args are the parameters in order: give args or parameters, not both")
    parameters = parameters if args is None else args
    start, end = _span(t_span)
    q, p0 = (y0, None) if velocity is not None or isinstance(y0, Mapping) else _halves(y0)
    requested_times = None if t_eval is None else times_of_run(t_eval, start, end)
    if error is not None:
        checked_error(error, {"h": h, "tolerance": tolerance, "rtol": rtol})
    request = _StepRequest(h, rtol, tolerance, error)
    if isinstance(system, Stepper):
        system = system.bind(q, parameters)[0]
    else:
        system, parameters = unrolled_at(system, q, parameters)
    stepper, uncompiled = _stepper(system, method, (time_transformation, controller), request)
    q, p0, velocity = stepper._states.start(q, p0, velocity)
    if p0 is None and velocity is None:
        raise StateError("y0 contains positions by name: give velocity, too, or numbers for positions and momenta")
    control = _error_control(stepper, request, atol, max_step, first_step)
    p: Any = stepper._initial_momenta(q, p0, velocity, start, parameters)
    along: dict[str, Any] = {"t": start, "parameters": parameters, "options": options}
    steps, missed = _plan(stepper, uncompiled, request, (q, p, start, end), along)
    settings = {**steps, **control.named, **along, "events": events}
    try:
        trajectory = stepper.integrate(q, p, **settings, t_eval=None if dense_output else requested_times)
        status, message = _outcome(trajectory, missed(trajectory))
    except StepFailedError as failure:
        trajectory, status, message = Trajectory.before(failure), FAILED, str(failure)
    return _motion(trajectory, requested_times if dense_output else None, dense_output, status, message)


def _outcome(trajectory: Trajectory, shortfall: str) -> tuple[int, str]:
    """Return status and message of a run; ``shortfall``: why it misses its tolerance."""
    if shortfall:
        return MISSED, shortfall
    if trajectory.ended_by is not None:
        return EVENT, f"The terminal event '{trajectory.ended_by.function}' occurred."
    return REACHED, "The end of the span was reached."


class _StepRequest(NamedTuple):
    """Requested step-size selection; adaptive if nothing is requested."""

    h: float | None
    rtol: float | None
    tolerance: float | None
    error: float | None


def _stepper(
    system: MechanicalSystem | Stepper,
    method: Method | str | None,
    transformation: tuple[str | Expr | None, str | None],
    request: _StepRequest,
) -> tuple[Stepper, tuple[MechanicalSystem, Method] | None]:
    """Return the stepper, and its system and method if compiled here; ``transformation``: g and its controller."""
    if request.tolerance is not None and (
        request.h is not None or request.rtol is not None or transformation != (None, None)
    ):
        raise StateError(
            "tolerance (fixed step size for an error at the end), h (fixed step size) and rtol (adaptive step size) "
            "exclude each other: give one of them, and with a time transformation h or rtol"
        )
    if not isinstance(system, Stepper):
        system, g = with_time_transformation(system, *transformation)
        method = default_method(system) if method is None else as_method(method, system)
        controller = None if transformation[1] == SYMPLECTIC else transformation[1]
        return compile_stepper(system, method, time_transformation=g, controller=controller), (system, method)
    if method is not None or transformation != (None, None) or request.tolerance is not None:
        raise StateError(
            "method, time_transformation, controller and tolerance need a system, not a compiled stepper: omit them, "
            "give h (fixed step size) or rtol (adaptive step size)"
        )
    return system, None


def _plan(
    stepper: Stepper,
    uncompiled: tuple[MechanicalSystem, Method] | None,
    request: _StepRequest,
    motion: tuple[States, States, float, float],
    along: dict[str, Any],
) -> tuple[dict[str, Any], Callable[[Trajectory], str]]:
    """Return the step-size arguments of :meth:`Stepper.integrate`, and a check of the run by a message if it misses.

    ``motion``: initial state (q, p), first and last time. Fixed steps fill the span.
    """
    q, p, start, end = motion
    if request.h is None and stepper.interface.temperature is not None:
        require(stepper, "adaptive")
    met: Callable[[Trajectory], str] = lambda run: ""  # noqa: E731
    if request.error is not None:
        return {"t_end": end, "error": request.error}, _unconfirmed
    if request.rtol is not None and (request.h is not None or not stepper._has_tau):
        return {"h": request.h, "t_end": end, "tolerance": request.rtol}, met
    h, missed = request.h, met
    if stepper._has_tau:
        if h is None:
            error = request.rtol or 0.0
            h = largest_step(stepper, q, p, end - start, error, **along)
            missed = lambda run: accuracy_message(run.step_error, run.worst_step_time, error) or ""  # noqa: E731
        sign = end - start if stepper.interface.time_transformation is None else 1.0
        return {"h": math.copysign(checked_step(h), sign), "t_end": end}, missed
    if h is None:
        adaptive = request.tolerance is not None or stepper.binding.has("advance_to")
        advised = request.tolerance if adaptive else DEFAULT_TOLERANCE
        if uncompiled is None or advised is None:
            return {"t_end": end}, met
        system, method = uncompiled
        h = advise(system, method, q, p, end - start, advised, **along).h
        missed = lambda run: missed_tolerance(second_stepper(system), run, advised)  # noqa: E731
    steps = max(1, math.ceil(abs((end - start) / checked_step(h)) * (1.0 - 1e-12)))
    return {"h": (end - start) / steps, "steps": steps}, missed


def _unconfirmed(trajectory: Trajectory) -> str:
    """Return the time until which the global error is confirmed, as a message; empty at the end of the run."""
    result = trajectory.confirmation
    if result is None or result.confirmed:
        return ""
    return (
        f"The bound {result.requested:g} on the global error is confirmed only until t = {result.confirmed_until:.6g}."
    )


def _error_control(
    stepper: Stepper, request: _StepRequest, atol: Any, max_step: float | None, first_step: float | None
) -> ErrorControl:
    """Return the arguments of :meth:`Stepper.integrate` for those of SciPy but the tolerance; StateError if invalid."""
    max_step = None if max_step == math.inf else max_step  # SciPy's default
    if atol is None:
        return ErrorControl(None, None, max_step, first_step)
    if request.rtol is None:
        raise StateError(f"atol = {atol} requires rtol: the error of a step is at most max(rtol * motion, atol)")
    for value in real_array([*atol.values()] if isinstance(atol, Mapping) else atol, "atol").flat:
        if not value >= 0.0:
            raise StateError(f"atol = {value:g} must be at least 0: give the size below which errors do not matter")
    if isinstance(atol, Mapping):
        by_name = {name: float(value) / request.rtol for name, value in atol.items()}
        return ErrorControl(None, by_name, max_step, first_step)
    values = real_array(atol, "atol")
    if not values.ndim:
        return ErrorControl(None, float(values) / request.rtol, max_step, first_step)
    names = stepper.interface.coordinates
    if values.shape not in ((len(names),), (2 * len(names),)):
        raise StateError(
            f"atol must be a number, {len(names)} or {2 * len(names)} numbers, or numbers by name, not an array of "
            f"shape {values.shape}"
        )
    pairs = zip(names, (values[: len(names)] / request.rtol).tolist(), strict=True)
    return ErrorControl(None, dict(pairs), max_step, first_step)


def _motion(
    trajectory: Trajectory, requested_times: Array | None, dense_output: bool, status: int, message: str
) -> OdeResult:
    t, y = trajectory.t, np.hstack([trajectory.q, trajectory.p]).T
    if requested_times is not None:
        t = requested_times[(requested_times - trajectory.t[-1]) * trajectory.h <= 0.0]
        y = _states(trajectory, t)
    result = trajectory.events
    return OdeResult(
        t=t,
        y=y,
        sol=(lambda times: _states(trajectory, times)) if dense_output else None,
        t_events=[crossings.t for crossings in result] if result else None,
        y_events=[np.hstack([crossings.q, crossings.p]) for crossings in result] if result else None,
        status=status,
        message=message,
        trajectory=trajectory,
    )


def _states(trajectory: Trajectory, t: ArrayLike) -> Array:
    """Return the states at times t, (2 m,) or (2 m, n)."""
    return np.concatenate([half.T for half in trajectory.at(t)])


def _span(t_span: Sequence[float]) -> tuple[float, float]:
    try:
        start, end = t_span
    except (TypeError, ValueError) as error:
        raise StateError(f"t_span must be two times, not {t_span!r}") from error
    start, end = checked_number(start, "t_span[0]"), checked_number(end, "t_span[1]")
    if start == end:
        raise StateError(f"t_span begins and ends at {start:g}: there is nothing to integrate")
    return start, end


def _halves(y0: ArrayLike) -> tuple[Array, Array]:
    try:
        y = np.array(y0, dtype=float)
    except (TypeError, ValueError) as error:
        raise StateError(f"y0 must be real numbers: {error}") from error
    if y.ndim != 1 or y.size % 2:
        raise StateError(f"y0 must be 2 m numbers, positions and then momenta, not an array of shape {y.shape}")
    return y[: y.size // 2], y[y.size // 2 :]
