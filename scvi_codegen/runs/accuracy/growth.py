"""Growth of errors along adaptive runs, by a tangent vector or by a run from a perturbed initial state.

The growth along a run of a conservative Lagrangian system is that of a tangent vector, which C propagates beside the
run (``error_growth.h``). It may be that of the coordinates alone, as of angles near a pole, and errors that grow may
still be small. A run is therefore reported only if its repetition from a perturbed initial state, whose difference
shows how the motion amplifies an initial error, confirms that fewer than ten digits are left. Along other runs growth
is checked by repetition alone: a coarse run with a larger tolerance shows in the first half of the steps whether errors
grow exponentially; only then is the run repeated from a state perturbed in its last place. The repeated run stores no
states and has a bounded number of steps.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import cast

import numpy as np

from scvi_codegen.codegen.rendering.text import OF_SMALL_STEPS
from scvi_codegen.common.errors import AccuracyWarning, StateError, StepFailedError, warn
from scvi_codegen.common.representation import counted
from scvi_codegen.runs.accuracy.size import (
    Motion,
    first_of_groups,
    largest_range,
    momenta_of_velocities,
    relative,
    roundoff,
)
from scvi_codegen.runs.accuracy.warning_switch import warnings_wanted
from scvi_codegen.runs.results.saved_states import SavedStates
from scvi_codegen.runs.states.validation import Array
from scvi_codegen.runs.stepping.features import require
from scvi_codegen.runs.stepping.integrator import Integrator
from scvi_codegen.runs.stepping.memory import Memory
from scvi_codegen.runs.stepping.projection import projected, roots_of_masses
from scvi_codegen.runs.stepping.step_plan import Adaptive, StepPlan

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
RIGHT, LOOSER, MOST_REPEATED, PARTS, DIGITS = 1e-10, 1e4, 2**16, 16, 15
"""Difference that leaves ten digits, and its ratio to the tolerance if that is larger; most steps of a repetition that
confirms a growth, and number of its comparisons; digits of a double."""
SECOND, LOOSE_TOLERANCE = 2, 1e-5
"""Every second step measures the growth above this tolerance, where an orbit has few steps; below fewer do."""


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
    if requested is False or not isinstance(plan, Adaptive) or len(states.t) < 2 or not warnings_wanted():
        return
    if not _continuous_in_double(run.stepper):
        return
    measured = run._growth
    if measured is not None and not requested:
        grown, excess = measured
        if grown >= LEAST_GROWTH and 2.0 * excess >= EXPONENT:
            _Repetition(run, states, advance_until).confirm(grown)
        return
    if requested or run.steps * DECADES_PER_STEP >= _thresholds(plan.admissible_error)[2]:
        _Repetition(run, states, advance_until).warn(requested=bool(requested))


def _continuous_in_double(stepper: Integrator) -> bool:
    """Return whether runs have a tangent vector in double: without events that change the state, and contacts."""
    return stepper.interface.words == 1 and not stepper.changes_states and not stepper.interface.masked


def measured_growth(stepper: Integrator, plan: StepPlan, requested: bool | None) -> int:
    """Return in one of how many steps C measures the growth of a tangent vector; 0: it has none (``measures_growth``).

    Raises:
        MethodError: for a requested check, if events change the state.
        StateError: for a requested check, unless steps are adaptive.
    """
    if requested:
        require(stepper, "check_growth")
        if not isinstance(plan, Adaptive):
            raise StateError(
                "check_growth=True requires adaptive steps, but the step size is fixed: give t_end without h, or omit "
                "check_growth"
            )
    is_measured = requested is None and _continuous_in_double(stepper) and warnings_wanted()
    if not (is_measured and isinstance(plan, Adaptive)):
        return 0
    return OF_SMALL_STEPS if plan.tolerance is None or plan.tolerance <= LOOSE_TOLERANCE else SECOND


def _by_factor(growth: float) -> str:
    return "small perturbations of the initial state grew by a factor of " + f"{growth:.0e}".replace("+", "")


def _warn_of_amplification(what: str, difference: float, t: float) -> None:
    digits = min(max(0, math.floor(-math.log10(difference))) if difference > 0.0 else DIGITS, DIGITS)
    left = f"about {counted(digits, 'digit')}" if digits else "no digit"
    warn(
        f"the motion amplifies errors: {what}, which leaves {left} at t = {t:g} (estimated). Use error= to find the "
        "time until which digits are confirmed, or check_growth=False to skip this check",
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
        self.steps, self.tolerance = run.steps, self._plan().admissible_error
        self.nudge, self.tolerable, self.decades = _thresholds(self.tolerance)
        self.reached, self.quarter = 0, 0.0
        self.firsts = first_of_groups(run.stepper.interface, len(run._q))

    def confirm(self, grown: float) -> None:
        """Warn of the growth exp(``grown``) of a tangent vector if a repetition confirms it, or would take too long.

        It is confirmed by a difference of the last states, or of earlier ones by which nearly all digits are lost.
        """
        states, count = self.states, len(self.states.t) - 1
        tolerable = min(max(RIGHT, LOOSER * self.tolerance), LARGEST)
        distance = float(np.abs(states.q[0]).max()) / (largest_range(states.q) or math.inf)  # of the origin
        growth, perturbation = math.exp(min(grown, 600.0)) / max(distance, 1.0), max(self.nudge, NUDGE * distance)
        expected = growth * perturbation
        if expected < tolerable:
            return None
        if len(states.q) != len(states.t):
            return _warn_of_amplification(_by_factor(growth), expected, float(states.t[-1]))
        last = count if self.steps <= MOST_REPEATED else max(1, count * MOST_REPEATED // self.steps)
        apart, k = 0.0, 0
        try:
            self._begin(self.nudge, self.tolerance)
            times = np.linspace(states.t[0], states.t[last], PARTS + 1)[1:]  # not by number: encounters take most steps
            forward = math.copysign(1.0, times[-1] - states.t[0])
            for k in sorted({*np.searchsorted(forward * states.t[:last], forward * times).tolist()} - {0}):
                self.advance_until(float(states.t[k]))
                apart = self._relative_difference(k)
                if apart > LARGEST:
                    break
        except StepFailedError:
            apart = 1.0
        if k == last < count and apart <= LARGEST:
            apart = expected
        elif apart <= LARGEST:  # the size of a motion that begins at an equilibrium, and so `grown`, has changed
            growth = apart / perturbation
        if apart > tolerable:
            _warn_of_amplification(_by_factor(growth), apart, float(states.t[k]))
        return None

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
                        self._report(f"differs by {apart:.1e} (relative)", apart, float(states.t[k]))
                    return
                before = apart
        except StepFailedError as failure:
            self._report("fails", 1.0, failure.t)

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
                apart = self._relative_difference(k)
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
        plan, t, values = replace(self._plan(), tolerance=tolerance), float(states.t[0]), states.parameters
        q, p = (_perturbed(np.asarray(vectors), nudge, i) for i, vectors in enumerate((states.q, states.p)))
        if run.stepper.interface.constraints:
            q, p, _ = projected(run.stepper, q, p, t, values)
        run._start(q, p, plan=plan, t=t, parameters=values, options=run.options)

    def _plan(self) -> Adaptive:
        return cast(Adaptive, self.run.plan)

    def _to(self, t: float) -> None:
        self.run.plan = replace(self._plan(), t_end=t)
        self.run._run_to_target()

    def _relative_difference(self, k: int) -> float:
        """Return the largest difference at a state relative to the size of the motion up to there.

        What rounding leaves open, as of the height of a pendulum that moves by 1e-13 of its length, is no growth. Nor
        are k local errors of the largest momentum in one that is tied to it by constraints, unless they are reported:
        |dp_i| / sqrt(M_ii) <= min(k nudge, tolerable) max_j |p_j| / sqrt(M_jj), which has no units.
        """
        states, rows = self.states, slice(k + 1)
        q, p = np.asarray(states.q)[rows], np.asarray(states.p)[rows]
        errors = np.abs(np.array([self.run._q - q[-1], self.run._p - p[-1]]))
        no_growth = NUDGE * np.array([np.abs(q).max(axis=0), np.abs(p).max(axis=0)])
        if self.run.stepper.interface.constraints:
            roots = roots_of_masses(self.run.stepper, q[-1], float(states.t[k]), states.parameters)
            largest = (np.abs(p) / roots).max()
            no_growth[1] = np.maximum(no_growth[1], min(k * self.nudge, self.tolerable) * largest * roots)
        errors = np.where(errors <= no_growth, 0.0, errors)
        motion = Motion(states.t[rows], q, p, self.firsts, roundoff(1))
        kinetic = momenta_of_velocities(self.run.stepper, states.t[rows], q, p, states.parameters).max(axis=0)
        return float(relative(errors, motion.sizes(float(states.t[k]), errors, kinetic)).max())

    def _report(self, what: str, difference: float, t: float) -> None:
        perturbed = f"a run with the initial state perturbed by {self.nudge:.1e} (relative)"
        _warn_of_amplification(f"{perturbed} {what}", difference, t)


def _perturbed(values: Array, nudge: float, first: int) -> Array:
    """Return the first of (n, m) positions or momenta, changed by ``nudge`` of itself, or of its range if smaller.

    The change is at least about the rounding error. A state of zeros is changed by parts of its ranges.
    """
    sizes, ranges = np.abs(values[0]), np.ptp(values, axis=0)
    changes = np.maximum(NUDGE * sizes, nudge * (np.minimum(sizes, ranges) if values[0].any() else ranges))
    return np.asarray(values[0] + np.copysign(changes, values[0]) * np.cos(np.arange(first, first + len(sizes))))
