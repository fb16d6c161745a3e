"""Estimate of the correct digits of a final state, by a second, more accurate run from a perturbed state.

The second run uses another method, SVI(8) with adaptive step size, so that the difference includes all errors of the
first run: truncation, round-off, and their growth along the trajectory.

Verification, on the whole run, of the error for which a step size was recommended.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from scvi_codegen.common.errors import ScviCodegenError, StateError
from scvi_codegen.runs.accuracy.size import relative_to_motion
from scvi_codegen.runs.accuracy.warning_switch import without_accuracy_warnings
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.states.words import Words
from scvi_codegen.runs.stepper import Stepper
from scvi_codegen.runs.trajectory import Trajectory

SECOND_RUN = 10_000
"""Steps that a second run may take in addition to four times those of the first."""
SAMPLES, LINEAR_DISTANCE = 1024, 0.01
"""Number of states compared, and the distance relative to their size up to which linearised growth is assumed."""
QUARTERS, DECADES = 4, 0.5
"""Growth is exponential if the distance grows by ``DECADES`` decades in each quarter of the time."""
PERTURBATION = 2.0**-50
"""Relative perturbation of the initial positions."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Known:
    """Error estimate of the last state of a run.

    Attributes:
        q, p: (m,) absolute errors.
        tenfold: time in which neighbouring trajectories diverge tenfold; infinite unless they diverge exponentially.
    """

    q: Array
    p: Array
    tenfold: float

    @property
    def chaotic(self) -> bool:
        """True if neighbouring trajectories diverge exponentially."""
        return math.isfinite(self.tenfold)


class _TooLongError(Exception):
    """Raised if the second run would take too many steps."""


@without_accuracy_warnings()
def known_digits(
    second: Callable[[], Stepper], trajectory: Trajectory, *, most: int, inputs: Mapping[str, Any] | None = None
) -> Known | None:
    """Estimate the error of the last state of ``trajectory`` with ``inputs`` by a run of the stepper ``second()``.

    Returns ``None`` if a second run fails, would take more than about ``most`` steps, or time is transformed.
    """
    if trajectory.stepper.in_tau or len(trajectory) < 2:
        return None

    def count(steps: int) -> None:
        if steps > most:
            raise _TooLongError

    rows = np.unique(np.linspace(0, len(trajectory) - 1, SAMPLES).astype(int))
    times = trajectory.t[rows]
    first, last = float(times[0]), float(times[-1])
    start = trajectory.q[0] * (1.0 + PERTURBATION * np.cos(np.arange(trajectory.q.shape[1]))), trajectory.p[0]
    arguments: dict[str, Any] = {"t": first, "t_end": last, "parameters": trajectory.parameters, "progress": count}
    try:
        stepper = second()
        if stepper.interface.inputs:
            q, p = stepper.integrate(*start, inputs=inputs or {}, **arguments).at(times)
        else:
            repeated = stepper.integrate(*start, t_eval=times, **arguments)
            q, p = repeated.q, repeated.p
    except (ScviCodegenError, _TooLongError):
        return None
    q_errors, p_errors = np.abs(q - trajectory.q[rows]), np.abs(p - trajectory.p[rows])
    distances = relative_to_motion(np.linalg.norm(q_errors, axis=1), q)
    return Known(q=_final_error(q_errors), p=_final_error(p_errors), tenfold=_tenfold(distances, abs(last - first)))


def _final_error(difference: Array) -> Array:
    """Return the error at the last state, at least the mean over the last sixteenth, as zero crossings occur."""
    late = difference[-max(1, len(difference) // 16) :]
    error: Array = np.maximum(difference[-1], np.sqrt(np.mean(late**2, axis=0)))
    return error


def _tenfold(difference: Array, span: float) -> float:
    """Return the time of tenfold growth from relative distances at equal times; infinity if not exponential."""
    far = np.flatnonzero(difference > LINEAR_DISTANCE)
    near = difference[1 : int(far[0]) if len(far) else len(difference)]
    length = len(near) // QUARTERS
    if length < 2:
        return math.inf
    means = [math.sqrt(float(np.mean(near[k * length : (k + 1) * length] ** 2))) for k in range(QUARTERS)]
    if means[0] == 0.0:
        return math.inf
    gained = np.diff(np.log10(means))
    if gained.min() < DECADES:
        return math.inf
    return float(span * length / (len(difference) - 1) / gained.mean())


STEP_MARGIN = 10.0
"""Safety factor for the estimate of the local error, which is inaccurate for large steps."""
ENERGY_MARGIN = 100.0
"""Ratio of the relative energy error allowed to the tolerance; energies are sensitive near collisions."""
ROUNDING = 1e-11
"""Relative energy error that round-off may cause."""
SECOND_MARGIN, SECOND_RUN_ERROR, SECOND_STEP = 2.0, 1e-12, 0.75
"""Safety factor and absolute slack for the error measured with a second run, which has errors, too; ratio of its step
size to that of a run of two words."""
REMEDY = "use adaptive step size (t_end, --tolerance)"
"""Remedy that the messages name."""


def missed_tolerance(
    second: Callable[[], Stepper], trajectory: Trajectory, tolerance: float, final_error: Known | None = None
) -> str:
    """Return why the error at the end of a run exceeds ``tolerance``; ``""`` if there is no evidence for it.

    The comparison with a second run decides, if there is one. Otherwise the largest local error and the energy error,
    if energy is conserved, are compared with the tolerance. These estimates are often too large; a run that fails them
    is compared with a second run.

    Args:
        second: function that returns a stepper of the same system with adaptive steps, for a second run.
        trajectory: run whose states are all at the ends of steps.
        tolerance: error |q - q_exact| / |q - mean q| for which the step size was recommended.
        final_error: error estimate from a second run.
    """
    if isinstance(trajectory.q, Words):
        return _missed_in_two_words(trajectory, tolerance)
    doubt = _worst_step(trajectory, tolerance) or _lost_energy(trajectory, tolerance)
    if final_error is None and doubt:
        final_error = known_digits(second, trajectory, most=SECOND_RUN + 4 * trajectory.steps)
    if final_error is None or final_error.chaotic:
        return f"{doubt}; {REMEDY}" if doubt else ""
    error = float(relative_to_motion(np.asarray(np.linalg.norm(final_error.q)), trajectory.q))
    if error <= SECOND_MARGIN * tolerance + SECOND_RUN_ERROR:
        return ""
    message = doubt or f"the tolerance {tolerance:g} is missed"
    return f"{message}: a second run with other steps differs by {error:.1e} at the end; {REMEDY}"


def _missed_in_two_words(trajectory: Trajectory, tolerance: float) -> str:
    """Return why the error of a run of two words exceeds the tolerance, from a second run with other steps."""
    settings: dict[str, Any] = {"t": float(trajectory.t[0]), "parameters": trajectory.parameters}
    h, end = SECOND_STEP * trajectory.h, float(trajectory.t[-1])
    try:
        second = cast(Stepper, trajectory.stepper).integrate(
            trajectory.q[0], trajectory.p[0], h=h, t_end=end, save_every=trajectory.steps, **settings
        )
    except ScviCodegenError:
        return ""
    late = np.asarray(second.velocity[-1]) * float(second.t[-1] - trajectory.t[-1])
    difference = np.asarray(np.linalg.norm(second.q[-1] - trajectory.q[-1] - late))
    error = float(relative_to_motion(difference, trajectory.q))
    if error <= SECOND_MARGIN * tolerance:
        return ""
    return f"the tolerance {tolerance:g} is missed: a second run differs by {error:.1e} at the end; {REMEDY}"


def _worst_step(trajectory: Trajectory, tolerance: float) -> str:
    if not trajectory.step_error > STEP_MARGIN * tolerance:
        return ""
    return (
        f"the tolerance {tolerance:g} is missed: the step from t = {trajectory.worst_step_time:g} alone has a "
        f"relative error of about {trajectory.step_error:.1e}"
    )


def _lost_energy(trajectory: Trajectory, tolerance: float) -> str:
    if not trajectory.stepper.interface.conserves_energy:
        return ""
    try:
        energy = trajectory.energy()
    except StateError:
        return ""
    size = float(np.abs(energy).max() + np.abs(trajectory.p * trajectory.velocity).sum(axis=1).max())
    change = float(np.abs(energy - energy[0]).max()) / (size or 1.0)
    if math.isfinite(change) and change <= ENERGY_MARGIN * tolerance + ROUNDING:
        return ""
    return f"the tolerance {tolerance:g} is missed: the conserved energy has a relative error of {change:.1e}"
