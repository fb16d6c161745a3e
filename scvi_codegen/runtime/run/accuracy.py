"""Accuracy warnings: steps too large for the motion, energy errors at the end of a run, exponential error growth.

The growth of errors along an adaptive run of a conservative Lagrangian system is that of a tangent vector, which C
propagates beside the run (``error_growth.h``). Along other runs it is checked afterwards, by repeating the run from a
perturbed initial state: the difference of two runs shows how the motion amplifies an initial error. A coarse run with a
larger tolerance shows in the first half of the steps whether errors grow exponentially; only then is the run repeated
from a state perturbed in its last place. The repeated run stores no states and has a bounded number of steps.
"""

import math
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import lru_cache
from typing import Any, Final

import numpy as np

from scvi_codegen.errors import AccuracyWarning, StateError, StepFailedError, warn
from scvi_codegen.runtime.constraints.projection import projected
from scvi_codegen.runtime.core.features import require
from scvi_codegen.runtime.core.integrator import Integrator
from scvi_codegen.runtime.core.validation import Array, coordinate_shapes
from scvi_codegen.runtime.core.words import by_name
from scvi_codegen.runtime.run.memory import Memory
from scvi_codegen.runtime.run.step_plan import StepPlan
from scvi_codegen.runtime.trajectory.saved_states import SavedStates

TOLERABLE_ERROR: Final = 1e-3
"""Largest relative error of a step, and largest relative change of the energy of a run, without a warning."""

ADAPTIVE_REMEDY: Final = ", or use adaptive steps (t_end= without h)"

GROSS_ERROR: Final = 0.5
"""Relative energy change that triggers a warning in fixed-step runs without an error estimate."""

MOST_CHECKED: Final = 1000
"""Largest number of trajectories of an ensemble whose energy is checked."""

UNRESOLVED: Final = 1e-5
"""Largest part of the squared amplitude of fields in the highest modes of their mesh without a warning."""

MOST_SPECTRA, MOST_VALUES = 64, 2**20
"""Largest numbers of saved states whose spectrum is checked, and of their values; at least four are checked."""

ERROR_AMPLIFIED: Final = (
    "although every step met the tolerance: errors of steps accumulate, and close encounters amplify them. Reduce the "
    "tolerance, or use regularised coordinates"
)
FIXED_STEP_REMEDY: Final = (
    "although the system conserves it: h is too large, perhaps for a close encounter. Reduce h, or use an SVI with "
    "adaptive steps (t_end=)"
)


_warnings_enabled: ContextVar[bool] = ContextVar("accuracy warnings are wanted", default=True)


@contextmanager
def without_accuracy_warnings() -> Iterator[None]:
    """Suppress accuracy warnings within a ``with`` block or a decorated function that takes large steps on purpose."""
    token = _warnings_enabled.set(False)
    try:
        yield
    finally:
        _warnings_enabled.reset(token)


def warnings_wanted() -> bool:
    """Return whether accuracy warnings are wanted: not inside :func:`without_accuracy_warnings`."""
    return _warnings_enabled.get()


def warn_of_inaccuracy(trajectory: SavedStates, run: Memory, *, before: float = 0.0) -> None:
    """Issue the warnings of large steps, of energy errors and of unresolved fields for the states of a run."""
    error = trajectory.step_error
    if error > TOLERABLE_ERROR:
        warn_of_large_steps(trajectory, before=before)
    if error != error or not trajectory.plan.h:
        warn_of_energy_error(trajectory, run)
    if trajectory.stepper.interface.layout.mesh is not None:
        warn_of_unresolved_fields(trajectory)


def warn_of_large_steps(trajectory: SavedStates, *, before: float = 0.0, remedy: str = ADAPTIVE_REMEDY) -> None:
    """Issue an :class:`AccuracyWarning` for the worst fixed step, unless an error ``before`` already caused one."""
    error = trajectory.step_error
    if not error > TOLERABLE_ERROR:
        return
    if trajectory.plan.adaptive or before > TOLERABLE_ERROR or not _warnings_enabled.get():
        return
    warn(
        f"the step size h = {trajectory.h:g} is too large: the relative error of the step from "
        f"t = {trajectory.worst_step_time:g} is about {error:.1e}. Reduce h{remedy}",
        AccuracyWarning,
    )


def warn_of_energy_error(trajectory: SavedStates, run: Memory) -> None:
    """Issue an :class:`AccuracyWarning` if an adaptive run does not conserve an energy that the system conserves.

    Runs over arrays of run-time sizes with fixed steps and no error estimate are checked for gross errors.
    """
    plan, stepper = trajectory.plan, trajectory.stepper
    limits: dict[str, Any] = {}
    if plan.h and trajectory.step_error == trajectory.step_error:
        return
    if plan.h and stepper.interface.layout.coordinates:
        limits = {"tolerable": GROSS_ERROR, "why": FIXED_STEP_REMEDY}
    elif plan.h or plan.tau:
        return
    if not stepper.interface.conserves_energy or stepper.changes_states or not _warnings_enabled.get():
        return
    t, q, p = trajectory.t, trajectory.q, trajectory.p
    ends = run._end_energies(t, q, p)
    if ends is None or not abs(ends[1] - ends[0]) > 0.5 * TOLERABLE_ERROR * max(abs(ends[0]), abs(ends[1])):
        return
    if energies := _changed_energies(stepper, t, q, p, trajectory.parameters):
        warn_of_energies(*energies, **limits)


def warn_of_energy_errors(ensemble: Any, ends: Array | None = None) -> None:
    """Issue the warning of :func:`warn_of_energy_error` for the worst of ``MOST_CHECKED`` trajectories.

    ``ends``: (k, 2) energies of the first and the last state where they are known, else NaN.
    """
    plans, stepper = ensemble.plans, ensemble.stepper
    if stepper.changes_states or not (plans and stepper.interface.conserves_energy and _warnings_enabled.get()):
        return
    by_trajectory, stride = {}, -(-len(plans) // MOST_CHECKED)
    chosen = np.arange(0, len(plans), stride)
    if ends is not None:
        first, last = np.abs(ends[chosen]).T, np.abs(np.diff(ends[chosen])[:, 0])
        chosen = chosen[~(last <= 0.5 * TOLERABLE_ERROR * np.maximum(first[0], first[1]))]
    for j in chosen.tolist():
        t, q, p, _, _ = ensemble._one(j)
        if len(t) and (energies := _changed_energies(stepper, t, q, p, ensemble.parameters[j])):
            by_trajectory[j] = energies
    worst = max(by_trajectory, key=lambda j: relative_energy_change(*by_trajectory[j]), default=None)
    if worst is not None:
        warn_of_energies(*by_trajectory[worst], where=f" of trajectory {worst}")


def unresolved_parts(stepper: Integrator, q: Array) -> Array | None:
    """Return (n,) parts of the squared amplitude of fields in the highest modes of their mesh; ``None`` without one."""
    mesh = stepper.interface.layout.mesh
    if mesh is None:
        return None
    fields = by_name(np.asarray(q), coordinate_shapes(stepper.interface))
    return np.asarray(np.max([mesh.unresolved(fields[name]) for name in mesh.field_system.fields], axis=0))


def warn_of_unresolved_members(ensemble: Any) -> None:
    """Issue the warning of :func:`warn_of_unresolved_fields` for the first of some trajectories that need it."""
    count = len(ensemble.parameters) if ensemble.stepper.interface.layout.mesh is not None else 0
    for j in range(0, count, -(-count // MOST_SPECTRA) or 1):
        t, q, *_ = ensemble._one(j)
        h = ensemble.plans[j].h if ensemble.plans else 0.0
        if len(t) and _unresolved(ensemble.stepper, t, q, h or math.nan, f"trajectory {j}, "):
            return


def warn_of_unresolved_fields(trajectory: SavedStates) -> None:
    """Issue an :class:`AccuracyWarning` if the highest modes of a mesh contain too much in one of some saved states."""
    _unresolved(trajectory.stepper, trajectory.t, trajectory.q, trajectory.h)


def _unresolved(stepper: Integrator, t: Array, q: Array, h: float, where: str = "") -> bool:
    """Issue the warning of :func:`warn_of_unresolved_fields` for saved states; true if it is necessary."""
    if stepper.interface.layout.mesh is None:
        return False
    count = max(4, min(MOST_SPECTRA, MOST_VALUES // max(1, q.shape[-1])))
    stride = -(-max(len(t) - 1, 1) // count)
    rows = slice((len(t) - 1) % stride, None, stride)
    parts = unresolved_parts(stepper, q[rows]) if warnings_wanted() else None
    if parts is None:
        return False
    sizes = np.abs(np.asarray(q[rows])).max(axis=1)  # a wave that enters a mesh at rest is small at first
    parts = parts * (sizes / (sizes.max() or 1.0)) ** 2
    if parts.max() <= UNRESOLVED:
        return False
    first = int(np.argmax(~(parts <= UNRESOLVED)))
    phase = abs(h) * stepper.interface.layout.mesh.highest_frequency()
    warn(
        f"the mesh does not resolve the fields: {where}at t = {t[rows][first]:g} the highest modes have "
        f"{parts[first]:.1e} of the squared amplitude ({UNRESOLVED:g} is tolerable). Use more elements or points, or a "
        f"smaller h if the run is unstable (h times the highest frequency is {phase:.2g}); shocks are not supported",
        AccuracyWarning,
    )
    return True


def warn_of_energies(
    first: float,
    last: float,
    size: float,
    *,
    tolerable: float = TOLERABLE_ERROR,
    where: str = "",
    why: str = ERROR_AMPLIFIED,
) -> None:
    """Issue an :class:`AccuracyWarning` if a conserved energy differs between the first and the last state.

    Args:
        first, last: energies of the first and the last state.
        size: scale of the energy terms (largest |p.v|), for energies near zero.
        tolerable: tolerated change relative to the largest of the three.
        where: description of the trajectory, appended to "the energy".
        why: probable cause and remedy.
    """
    if relative_energy_change(first, last, size) > tolerable and _warnings_enabled.get():
        warn(f"the energy{where} changed from {first:.3g} to {last:.3g} {why}", AccuracyWarning)


def relative_energy_change(first: float, last: float, size: float) -> float:
    """Return the relative change of an energy; 0 if it is NaN."""
    part = abs(last - first) / max(abs(first), abs(last), size, sys.float_info.min)
    return part if part == part else 0.0


def _changed_energies(
    stepper: Integrator, t: Array, q: Array, p: Array, parameters: Array
) -> tuple[float, float, float] | None:
    """Return the first and the last energy and the largest |p.v| if the energy changed; ``None`` otherwise.

    ``None`` is also returned outside the domain of L. Velocities are computed only if the energies differ.
    """
    t, q, p = (each[:: max(1, len(each) - 1)].copy() for each in (t, q, p))
    try:
        energies = stepper._energies_of(t, q, p, parameters)
        first, last = float(energies[0]), float(energies[-1])
        if not relative_energy_change(first, last, 0.0) > TOLERABLE_ERROR:
            return None
        sizes = np.sum(p * stepper.velocity(q, p, t, parameters), axis=1)
    except StateError:
        return None
    return first, last, float(np.abs(sizes).max())


MOST_STEPS, MOST_NUMBERS = 2048, 2**18
"""Default limits of the second run: number of steps, and that number times the number of coordinates."""
DECADES_PER_STEP = math.log10(1.15)
"""Assumed largest growth of an error per step; runs with too few steps to reach the threshold are not checked."""
NUDGE = 2.0**-50
"""Relative perturbation of the initial state, unless the local tolerance is larger."""
TOLERABLE, LOOSE, LARGEST = 1e-7, 1e5, 0.1
"""Reporting threshold of the relative difference: max(TOLERABLE, LOOSE * tolerance), at most LARGEST."""
COARSE = 1e-8
"""Local tolerance and relative perturbation of the coarse run, unless the tolerance of the run is larger."""
FIRST, DECISIVE = 1.0 / 4.0, 1.0 / 2.0
"""Fractions of the steps at which the coarse run is compared: for the growth rate, and for the decision.

A decision after a quarter misses half of the chaotic motions with late close encounters.
"""
MANY = 256
"""Number of steps from which on the coarse run is also compared at the fraction FIRST."""
SMALLEST = 1e-140
"""Numbers below this, or above its inverse, are scaled before squaring to avoid underflow and overflow."""
ALGEBRAIC = 4.0
"""Growth of a difference by twice the steps that is algebraic (2: linear), where the threshold is LARGEST."""
SLOW = 0.6
"""Fraction of the decades to the threshold that the extrapolated growth must reach for the run to be repeated.

With 0.9, eight of 52 chaotic double pendulums were not repeated: they grow faster in the second half.
"""


LEAST_GROWTH, EXPONENT = math.log(2e4), 8.0
"""Reported growth g of the logarithm of a tangent vector, if 2 (g - mean g) was at least EXPONENT: 2 a for t^a.

Bodies that are ejected move regularly from then on, which brings the mean closer to g.
"""
ROUNDOFF, LOOSE_TOLERANCE = 1e-14, 1e-6
"""Tolerances above which the propagation of the tangent vector needs four stages, and more corrections."""


def warn_of_error_growth(
    run: Memory, states: SavedStates, requested: bool | None, advance_until: Callable[[float], None] | None = None
) -> None:
    """Warn if errors grew exponentially along an adaptive run; if it is repeated, it is left where that ends.

    Args:
        run: the run at its end.
        states: its states.
        requested: ``True``: repeat the whole run; ``None``: use the growth measured along the run, or else repeat up to
            ``MOST_STEPS`` of its steps, and only if a coarse run shows exponential growth; ``False``: no check.
        advance_until: function that advances the run to a time; by default adaptive steps to that time.
    """
    plan = run._plan
    if plan.h or plan.tau or requested is False or len(states.t) < 2 or not _warnings_enabled.get():
        return
    if run.stepper.changes_states or run.stepper.interface.words > 1:
        return
    measured = run._growth
    if measured is not None and not requested:
        grown, excess = measured
        if grown >= LEAST_GROWTH and 2.0 * excess >= EXPONENT:
            factor = f"{math.exp(grown):.0e}".replace("+", "")
            _warn_of_amplification(f"small perturbations of the initial state grew by a factor of {factor}")
        return
    if requested or run.steps * DECADES_PER_STEP >= _thresholds(plan.tolerance)[2]:
        _Repetition(run, states, advance_until).warn(requested=bool(requested))


def measured_growth(stepper: Integrator, plan: StepPlan, requested: bool | None) -> int:
    """Return how C measures the growth of errors along a run: 0 no, 1 to 3 by a tangent vector (``measures_growth``).

    Raises:
        MethodError: for a requested check, if events change the state.
        StateError: for a requested check, unless steps are adaptive.
    """
    if requested:
        require(stepper, "check_growth")
        if not plan.adaptive:
            raise StateError(
                "check_growth=True requires adaptive steps, but the step size is fixed: give t_end without h, or omit "
                "check_growth"
            )
    double = stepper.interface.words == 1 and not stepper.changes_states
    if requested is not None or not plan.adaptive or not double or not _warnings_enabled.get():
        return 0
    return 1 + (plan.tolerance > ROUNDOFF) + (plan.tolerance > LOOSE_TOLERANCE)


def _warn_of_amplification(what: str) -> None:
    warn(
        f"the motion amplifies errors: {what}, so later states are not reproducible. Use error= to find the time until "
        "which digits are confirmed, or check_growth=False to skip this check",
        AccuracyWarning,
    )


@lru_cache(maxsize=64)
def _thresholds(tolerance: float) -> tuple[float, float, float]:
    """Return the perturbation, the tolerable difference, and the decades between them."""
    nudge, tolerable = max(NUDGE, tolerance), min(max(TOLERABLE, LOOSE * tolerance), LARGEST)
    return nudge, tolerable, math.log10(tolerable / nudge)


class _Repetition:
    """Repetition of a run from a perturbed initial state; arguments as of :func:`warn_of_error_growth`."""

    def __init__(self, run: Memory, states: SavedStates, advance_until: Callable[[float], None] | None) -> None:
        self.run, self.states, self.advance_until = run, states, advance_until or self._to
        self.steps, self.tolerance = run.steps, run.plan.tolerance
        self.nudge, self.tolerable, self.decades = _thresholds(self.tolerance)
        self.reached, self.quarter = 0, 0.0

    def warn(self, *, requested: bool) -> None:
        """Repeat the run; without a request only up to ``MOST_STEPS`` steps, and if errors grow exponentially."""
        states, last = self.states, self._last(requested=requested)
        coarse, loose, before = max(self.nudge, COARSE), self.tolerable == LARGEST, 0.0
        if last == 0 or (not requested and self._grows_slowly(last, coarse)):
            return
        try:
            if coarse == self.nudge == self.tolerance and 0.0 < self.quarter <= self.tolerable:
                before = self.quarter  # the coarse run is this one, and goes on from where it ended
            else:
                self.reached = 0
                self._begin(self.nudge, self.tolerance)
            for k in sorted({last >> i for i in range(8 if loose else 2)} - {0}):
                if k < self.reached:
                    continue
                if k > self.reached:
                    self.advance_until(float(states.t[k]))
                apart = self._relative_difference(k)
                if not apart <= self.tolerable:
                    if not (loose and apart < ALGEBRAIC * before):
                        self._report(f"differs by {apart:.1e} (relative) at t = {states.t[k]:g}")
                    return
                before = apart
        except StepFailedError as failure:
            self._report(f"fails at t = {failure.t:g}")

    def _grows_slowly(self, last: int, tolerance: float) -> bool:
        """Return whether errors grow too slowly to matter, by a coarse run of at most half of the steps.

        The growth A(k) until step k of n is extrapolated exponentially from the start, A(k)^(n/k), and from the
        previous comparison at step j, A(k) (A(k) / A(j))^((n - k) / (k - j)); the smaller value counts. For algebraic
        growth the second is smaller.
        """
        first, needed = {int(last * FIRST)} if last >= MANY else set(), SLOW * self.decades
        before, grown_before = 0, 0.0
        try:
            self._begin(tolerance, tolerance)
            for k in sorted((first | {int(last * DECISIVE)}) - {0}):
                self.advance_until(float(self.states.t[k]))
                little = 0.0 if k in first else needed * k / last
                apart = self._relative_difference(k, tolerance * 10.0**little)
                grown = math.log10(max(apart / tolerance, 1.0))
                rate = max(grown - grown_before, 0.0) / (k - before)
                if k not in first and (grown < little or grown + rate * (last - k) < needed):
                    return True
                self.quarter = apart if k in first else self.quarter
                self.reached, before, grown_before = k, k, grown
        except StepFailedError:
            self.quarter = 0.0
        return False

    def _last(self, *, requested: bool) -> int:
        """Return the index of the last state to compare; 0 unless all states of the run are saved."""
        count = len(self.states.t) - 1
        if len(self.states.q) != len(self.states.t):
            return 0
        most = float(min(MOST_STEPS, MOST_NUMBERS // len(self.run._q)))
        return count if requested or self.steps <= most else int(count * most / self.steps)

    def _begin(self, nudge: float, tolerance: float) -> None:
        """Start the run at its perturbed initial state, on its constraints, with another local tolerance."""
        run, states = self.run, self.states
        plan, t, given = StepPlan(t_end=run.plan.t_end, tolerance=tolerance), float(states.t[0]), states.parameters
        factors = _factors(len(run._q), nudge)
        q, p = np.asarray(states.q[0] * factors[0]), np.asarray(states.p[0] * factors[1])
        if run.stepper.interface.constraints:
            q, p, _ = projected(run.stepper, q, p, t, given)
        run._start(q, p, plan=plan, t=t, parameters=given, options=run.options)

    def _to(self, t: float) -> None:
        self.run.plan = StepPlan(t_end=t, tolerance=self.run.plan.tolerance)
        self.run._run_to_target()

    def _relative_difference(self, k: int, small: float = 0.0) -> float:
        """Return the larger of |dq|/|q| and |dp|/|p| at a state, relative to the largest norms up to that state.

        If the difference relative to the state itself is at most ``small``, this cheaper bound is returned.
        """
        ratios = []
        for mine, each in zip((self.run._q, self.run._p), (self.states.q, self.states.p), strict=True):
            row = each[k]
            difference = mine - row
            largest = float(np.abs(row).max())
            apart = size = 0.0
            if SMALLEST < max(largest, float(np.abs(difference).max())) < 1.0 / SMALLEST:  # squares do not overflow
                apart, size = math.sqrt(difference @ difference), math.sqrt(row @ row)
            if not (size > 0.0 and apart <= small * size):
                rows = each[: k + 1]
                unit = float(np.abs(rows).max()) or 1.0
                size = float(np.linalg.norm(rows / unit, axis=1).max())
                apart = float(np.linalg.norm(difference / unit))
            ratios.append(apart / size if apart and size else apart)
        return max(ratios)

    def _report(self, difference_text: str) -> None:
        perturbed = f"a run with the initial state perturbed by {self.nudge:.1e} (relative)"
        _warn_of_amplification(f"{perturbed} {difference_text}")


@lru_cache(maxsize=8)
def _factors(size: int, nudge: float) -> tuple[Array, Array]:
    """Return factors for positions and momenta that change them by about ``nudge``, relatively."""
    return 1.0 + nudge * np.cos(np.arange(size)), 1.0 + nudge * np.cos(np.arange(size) + 1)
