"""Dense output: the state at any time, by a partial step of the method from the saved state before it.

Dense output has the accuracy of the method, for every method and solver. It is continuous in time, equals the saved
states at both ends of a step, and needs no additional storage. Interpolating polynomials are cheaper to evaluate but of
order 4 (Hermite cubics through states and velocities) or of about half the order of the method (the stage polynomial).
Measured over one revolution of the Kepler problem, e = 0.5, largest position errors at 2001 times:

    method, steps    saved states    dense output    cubics through positions and velocities
    SVI(4), 40       7.0e-8          7.0e-8          9.7e-5
    SVI(8), 20       4.2e-11         4.2e-11         1.3e-3

One state takes 0.65 microseconds there, four times as long as a step of the run, whose predictor is better.
"""

from fractions import Fraction
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.codegen.native.arguments import checked_number, real_array
from scvi_codegen.codegen.native.options import step_failure
from scvi_codegen.common.errors import StateError
from scvi_codegen.runs.nouns import Save
from scvi_codegen.runs.results.saved_states import ROUNDINGS, SavedStates
from scvi_codegen.runs.results.time_transformation import part_of_step, states_in_transformed_time
from scvi_codegen.runs.states.times import number_until
from scvi_codegen.runs.states.words import Words, fraction_of, low_words, split, with_low
from scvi_codegen.runs.stepping.features import require
from scvi_codegen.runs.stepping.memory import Memory
from scvi_codegen.runs.stepping.step_plan import Fixed, FixedSteps, StepPlan, ending_at

Array = NDArray[np.float64]


def states_at(states: SavedStates, times: Array) -> tuple[Array, Array]:
    """Return (n, m) positions and momenta at (n,) times within the range of the saved states, in any order."""
    q, p, _ = states_and_steps_at(states, times)
    return q, p


def states_and_steps_at(states: SavedStates, times: Array) -> tuple[Array, Array, Array]:
    """Return the states of :func:`states_at` and (n,) values of the independent variable of the steps, tau or t."""
    require(states.stepper, "dense_output")
    times = within(times, states.t[0], states.t[-1])
    if states.tau is not None:
        _check_on_grid(states)
        return states_in_transformed_time(states, times)
    left = number_until(states.t, times, states.forward) - 1
    if states.stepper.by_steps:  # linear in between
        right = np.minimum(left + 1, len(states) - 1)
        part = ((times - states.t[left]) / np.fmax(states.t[right] - states.t[left], np.finfo(float).tiny))[
            :, np.newaxis
        ]
        q, p = (x[left] + part * (x[right] - x[left]) for x in (states.q, states.p))
        return q, p, times
    lengths, fixed, several = states.step_sizes[:-1], isinstance(states.plan, FixedSteps), False
    if states.stepper.divides_steps:
        several = not (np.abs(np.diff(states.t)) < 1.5 * np.abs(lengths) + states.grid_tolerance[:-1]).all()
        several |= getattr(states, "modes", None) is None and bool(states.stepper.modes)  # not known
    if several or (not fixed and np.isnan(lengths).any()):
        return *_integrate_to_each(states, left, times, states.plan), times
    t, q, p = states.t[left], states.q[left], states.p[left]
    if fixed:  # adaptive steps are all saved here
        _check_on_grid(states)
        whole = whole_steps(times - t, np.nan_to_num(states.step_sizes[left], nan=np.inf))
        between = np.flatnonzero(whole > 0)  # a time of one word may be before the first state by a rounding
        saved, run = -1, None
        for k in between[np.lexsort((whole[between], left[between]))]:
            if run is None or left[k] != saved:
                saved = int(left[k])
                run = states._restarted(saved, float(states.step_sizes[saved]))
            run.advance(int(whole[k]) - run.steps)
            t[k : k + 1], q[k], p[k] = run._times, run.q, run.p
    if isinstance(q, Words):
        for k in np.flatnonzero(t - times):
            q[k], p[k] = stepped_to(states, q[k], p[k], t[k : k + 1], times[k])
    else:
        forward = states.forward * (times - t) > 0.0  # whole steps may pass a time by a rounding
        _take_partial_steps(states, t, np.where(forward, times - t, 0.0), q, p)
    return q, p, times


def _integrate_to_each(
    states: SavedStates, left: NDArray[np.intp], times: Array, plan: StepPlan
) -> tuple[Array, Array]:
    """Integrate from each saved state to the times before the next one, with adaptive steps or events."""
    q, p = states.q[left], states.p[left]
    stepper: Any = states.stepper
    between = np.flatnonzero(times - states.t[left])
    between = between[np.lexsort((states.forward * times[between], left[between]))]
    for rows in np.split(between, np.flatnonzero(np.diff(left[between])) + 1) if between.size else ():
        to_last = ending_at(plan, float(times[rows[-1]]))
        start = states.t[left[rows[0]]]
        settings = {"t": start, "parameters": parameters_set_until(states, start), "options": states.options}
        run = stepper._run(q[rows[0]], p[rows[0]], plan=to_last, **settings)
        reached = run._recorded(None, Save(t_eval=times[rows]))
        q[rows], p[rows] = reached.q, reached.p
    return q, p


def parameters_set_until(states: SavedStates, t: float) -> Array:
    """Return the parameters of a run that is started at time t, as events have set them; modes are its own."""
    stepper, modes = cast(Any, states.stepper), getattr(states, "modes", None)
    parameters, own = states.parameters.copy(), len(stepper.modes) - len(stepper.interface.mode_names)
    if own and modes is not None:
        set_values = modes.at(t, states.forward)[:own]
        parameters[stepper.mode_columns[:own]] = set_values
    return parameters


def whole_steps(spans: Array, h: Array, slack: float = 0.0) -> NDArray[np.int64]:
    """Return the number of steps h that fit into spans, tolerating rounding and an excess of ``slack`` steps."""
    ratio = spans / h
    nearest = np.rint(ratio)
    fits = np.abs(ratio - nearest) <= slack + ROUNDINGS * np.finfo(float).eps * np.maximum(1.0, nearest)
    return np.where(fits, nearest, np.floor(ratio)).astype(np.int64)


def _take_partial_steps(states: SavedStates, t: Array, h: Array, q: Array, p: Array) -> int:
    """Take one step of size h[k] from each state k, in place; return the number of iterations of their equations."""
    binding, m = states.stepper.binding, states.stepper.dimension
    step, report, workspace = binding.function("step"), binding.new("report *"), binding.workspace()
    parameters, options = binding.pointer(states.parameters), binding.options(states.options)
    q_start, p_start = binding.pointer(q), binding.pointer(p)
    numbers, iterations = np.flatnonzero(h), 0
    for k, begin, length in zip(numbers.tolist(), t[numbers].tolist(), h[numbers].tolist(), strict=True):
        q_k, p_k = q_start + k * m, p_start + k * m
        if states.stepper.modes:
            parameters = binding.pointer(sides := states.parameters_on_sides(begin))  # noqa: F841  (kept for C)
        status = step(begin, length, q_k, p_k, parameters, options, q_k, p_k, report, workspace)
        if status:
            raise step_failure(status, report, step=0, h=length, failures=binding.failures)
        iterations += report.iterations
    return iterations


def stepped_to(
    states: SavedStates | Memory, q: Array, p: Array, t: Array, end: float | Fraction
) -> tuple[Array, Array]:
    """Return the state after one step from (1,) time t of two words to ``end``, whose size has two words as well."""
    if states.stepper.in_tau:
        return part_of_step(states, t[0], cast(float, states.h), end, q, p)[:2]
    settings: dict[str, Any] = {"parameters": states.parameters, "options": states.options}
    target = fraction_of(end)
    h = float(target - Fraction(float(t[0])))
    run = Memory.started(states.stepper, q, p, plan=Fixed(h), t=float(t[0]), **settings)
    run._memory.t_low = low_words(t)[0]
    run._step_to(target)
    run.advance(1)
    return run.q, run.p


def checked_times(t: ArrayLike, name: str) -> Array:
    """Return a copy of finite times of any shape."""
    times = real_array(t, name)
    if not np.isfinite(times).all():
        checked_number(float(times[~np.isfinite(times)][0]), f"a value in {name}")
    return times


def times_of_words(t: ArrayLike, words: int) -> Array:
    """Return a copy of finite times of any shape; those of runs of two words have both."""
    if words == 1:
        return checked_times(t, "t")
    high, low = split(t, "t")
    both: Array = with_low(checked_times(high, "t"), low)
    return both


def times_of_run(t_eval: ArrayLike, t: float, t_end: float) -> Array:
    """Return (n,) times within a run, sorted in its direction."""
    times = checked_times(t_eval, "t_eval")
    if times.ndim != 1:
        raise StateError(f"t_eval must be a one-dimensional array of times, not of shape {times.shape}")
    if not times.size:
        raise StateError("t_eval is empty: give output times, or omit it to save every step")
    check_one_side(times, t)
    if (np.diff(times) * (t_end - t) < 0.0).any():
        raise StateError(
            "t_eval must be sorted in the direction of the run: ascending, or descending for a backward run"
        )
    return within(times, t, t_end)


def check_one_side(times: Array, t: float) -> None:
    """Raise ``StateError`` for output times before and after the initial one: a run has one direction."""
    if times.size and times.min() < t < times.max():
        first, last = times.min(), times.max()
        raise StateError(
            f"t_eval has times before and after t = {t:g}, from {first:g} to {last:g}, but a run has one direction: "
            f"make two, with t_end={first:g} and t_end={last:g}, with the times of t_eval on each side"
        )


def check_has_end(t_eval: ArrayLike | None, t: float, h: float | None, t_end: ArrayLike | None) -> None:
    """Raise ``StateError`` for output times of a run without h and t_end."""
    if t_eval is None or h is not None or t_end is not None:
        return
    times = checked_times(t_eval, "t_eval")
    check_one_side(times, t)
    last = f"t_end={times.flat[np.abs(times - t).argmax()]:g}" if times.size else "t_end"
    raise StateError(f"t_eval has times of a run whose end is missing: give {last}, or h and steps, too")


def within(times: Array, first: float, last: float) -> Array:
    """Return the times, clipped to the range of a run; times outside by more than rounding raise ``StateError``."""
    low, high = min(first, last), max(first, last)
    slack = ROUNDINGS * np.finfo(float).eps * max(abs(first), abs(last))
    outside = times[(times < low - slack) | (times > high + slack)]
    if outside.size:
        raise StateError(f"t = {outside[0]:.17g} is outside the trajectory from t = {first:.17g} to {last:.17g}")
    inside: Array = np.clip(times, low, high)
    if isinstance(times, Words):
        return with_low(inside, np.where(inside == times, times.low, 0.0))  # type: ignore[no-any-return]
    return inside


def step_sizes_at(states: SavedStates, times: Array) -> Array:
    """Return (n,) sizes of the steps that begin at the given times; NaN at times between two steps."""
    before = number_until(states.t, times, states.forward) - 1
    after = np.minimum(before + 1, len(states) - 1)
    nearest = np.where(np.abs(states.t[after] - times) < np.abs(times - states.t[before]), after, before)
    off = np.abs(times - states.t[nearest]) > states.grid_tolerance[nearest]
    return np.where(off, np.nan, states.step_sizes[nearest])


def _check_on_grid(states: SavedStates) -> None:
    """Raise ``StateError`` unless all states but the last (an event may end it) are at whole steps from the first."""
    if np.isnan(states.step_sizes[:-1]).any():
        raise StateError(
            "dense output and events require states at whole steps, but this trajectory was made with t_eval: "
            "integrate without t_eval"
        )
