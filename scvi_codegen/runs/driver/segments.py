"""Runs with inputs: integrate from breakpoint to breakpoint of piecewise cubic functions of time.

Steps end at breakpoints; compensated sums continue across them. See :mod:`scvi_codegen.systems.formulas.symbols`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import numpy as np

from scvi_codegen.codegen.native.arguments import checked_number, real_array
from scvi_codegen.codegen.native.capacity import room_for_states, too_many_states
from scvi_codegen.codegen.native.option_table import checked_step
from scvi_codegen.codegen.rendering.source import Interface
from scvi_codegen.common.errors import StateError, StepFailedError
from scvi_codegen.common.validation import checked_count
from scvi_codegen.runs.accuracy.local_error import warn_of_large_steps
from scvi_codegen.runs.accuracy.resolution import warn_of_unresolved_fields
from scvi_codegen.runs.results.dense_output import checked_times
from scvi_codegen.runs.results.joining import joined
from scvi_codegen.runs.states.times import times_after
from scvi_codegen.runs.states.validation import Array, check_left_to_inputs, no_input
from scvi_codegen.runs.states.words import exact_product, exact_sum, low_words, split, with_low
from scvi_codegen.runs.stepping.features import refusal
from scvi_codegen.runs.stepping.memory import Memory
from scvi_codegen.runs.stepping.step_plan import Fixed, FixedSteps, StepPlan, ending_at
from scvi_codegen.runs.trajectory import Trajectory

if TYPE_CHECKING:
    from scvi_codegen.runs.driver.run import Run
    from scvi_codegen.runs.stepping.integrator import Integrator

POWERS = 4
NO_TIME = np.array([1.0] * POWERS + [0.0])
"""Factors of the C parameters of a piece that omit its breakpoint, which is a double."""
ALL = slice(None)
KINDS_OF_INPUTS = "a number, (t, values) or (t, values, 'cubic')"
NEGLIGIBLE_STEP = 1e-9
"""Fraction of a step below which the remainder before a breakpoint is skipped."""


@dataclass(frozen=True, slots=True)
class Input:
    """Piecewise cubic function of time.

    Attributes:
        breakpoints: (n + 1,) ascending times.
        pieces: (n, 5) C parameters of each piece: ascending coefficients in powers of the time since its breakpoint,
            and that breakpoint; (n, k, 5) for k trajectories. A constant has one piece without ends, from time 0.
    """

    breakpoints: Array
    pieces: Array

    def parameters(self, t: float, part: slice = ALL) -> Array:
        """Return the (5,) parameters of the piece that contains t, or (k, 5) for the trajectories ``part``."""
        piece = int(self.breakpoints.searchsorted(t, side="right")) - 1
        coefficients: Array = self.pieces[min(max(piece, 0), len(self.pieces) - 1)]
        return coefficients[part] if coefficients.ndim == 2 else coefficients

    def clamped(self, low: float, high: float) -> Input:
        """Return the function clamped to a range, with further breakpoints where polynomials take a bound."""
        ends, pieces = [float(self.breakpoints[0])], []
        for piece, end in zip(self.pieces, self.breakpoints[1:].tolist(), strict=True):
            rows = np.asarray(piece).reshape(-1, POWERS + 1)
            times = ((row[-1], np.roots([*row[3:0:-1], row[0] - bound])) for row in rows for bound in (low, high))
            cuts = {first + x.real for first, roots in times for x in roots if x.imag == 0}
            for cut in (*sorted(float(x) for x in cuts if ends[-1] < x < end), end):
                part, middle = piece.copy(), ends[-1] + (cut - ends[-1]) / 2 if np.isfinite(cut) else 0.0
                for k in np.ndindex(piece.shape[:-1]):
                    value = np.polyval(np.asarray(piece)[k][3::-1], middle - piece[k][POWERS])
                    if not low <= value <= high:
                        part[k] = min(max(value, low), high), 0.0, 0.0, 0.0, float(piece[k][POWERS])
                ends.append(cut)
                pieces.append(part[np.newaxis])
        return Input(np.array(ends), np.concatenate(pieces))


def clamped_inputs(limited: Any, inputs: Mapping[str, Input]) -> dict[str, Input]:
    """Return inputs by name, those with a range clamped to it."""
    bounds = {name: limits for name, *limits in limited.input_ranges}
    return {name: data.clamped(*bounds[name]) if name in bounds else data for name, data in inputs.items()}


def checked_inputs(
    interface: Interface, argument: Mapping[str, Any] | None, trajectories: int | None = None
) -> dict[str, Input]:
    """Return validated inputs: (t, values), (t, values, kind), a number or a piecewise polynomial of SciPy by name.

    With a number of trajectories, values may have one row for each trajectory, and constants one number.
    """
    if interface.in_tau and argument is not None:
        raise refusal("inputs", "in transformed time")
    names, argument = interface.inputs, dict(argument or {})
    for name in argument:
        if name not in names:
            raise no_input(name, names)
    if missing := [name for name in names if name not in argument]:
        raise StateError(
            f"the input '{missing[0]}' is not set: pass inputs={{'{missing[0]}': (t, values)}}, or a number"
        )
    read = input_of if interface.words == 1 else _in_two_words
    return clamped_inputs(interface, {name: read(name, value, trajectories) for name, value in argument.items()})


def input_of(name: str, argument: Any, trajectories: int | None = None) -> Input:
    """Return one validated input; raises as :func:`checked_inputs`."""
    if isinstance(argument, Input):
        return argument
    if callable(argument) and not hasattr(argument, "c"):
        raise StateError(
            f"the input '{name}' is a Python function, which the C code cannot call: sample it and pass (t, values) or "
            "scipy.interpolate.CubicSpline(t, values)"
        )
    if hasattr(argument, "c") and hasattr(argument, "x"):
        return _from_pieces(name, *_powers(name, argument), trajectories)
    if isinstance(argument, str):
        read = f"t, values = numpy.loadtxt({argument!r}, delimiter=',', skiprows=1, unpack=True)"
        raise StateError(f"the input '{name}' must be {KINDS_OF_INPUTS}, not text; read a file first: {read}")
    if not isinstance(argument, tuple):
        constant = real_array(argument, f"the input '{name}'")
        if constant.shape in ((), (trajectories,)):
            return _from_pieces(name, np.array([-np.inf, np.inf]), constant[np.newaxis, ..., np.newaxis], trajectories)
    if not isinstance(argument, tuple) or len(argument) not in (2, 3):
        raise StateError(f"the input '{name}' must be {KINDS_OF_INPUTS}, not {argument!r:.60}")
    t, values = (
        checked_times(part, f"{label} of the input {name}")
        for part, label in zip(argument, ("t", "values"), strict=False)
    )
    kind = argument[2] if len(argument) == 3 else "linear"
    if kind not in list(KINDS):
        raise StateError(f"the interpolation of the input '{name}' must be {' or '.join(KINDS)}, not {kind!r}")
    if t.ndim != 1 or len(t) < 2 or values.shape not in (t.shape, (trajectories, *t.shape)):
        rows = "" if trajectories is None else f" (or one row of values for each of {trajectories} trajectories)"
        raise StateError(
            f"the input '{name}' must have equally many times and values, at least two{rows}; got shapes {t.shape} and "
            f"{values.shape}"
        )
    _check_ascending(name, t)
    return _from_pieces(name, t, KINDS[kind](t, values), trajectories)


def _in_two_words(name: str, argument: Any, trajectories: int | None) -> Input:
    """Return a constant, or values that are constant or linear between times, with coefficients of two words.

    Splines have coefficients of one word.
    """
    if isinstance(argument, Input) or callable(argument):
        return input_of(name, argument, trajectories)
    if not isinstance(argument, tuple):
        try:
            high, low = split(argument, f"the input {name}")
        except StateError:
            return input_of(name, argument, trajectories)  # raises an error with a remedy
        t = np.array([-np.inf, np.inf])
        data, rest = input_of(name, high, trajectories), low[np.newaxis, ..., np.newaxis]
    elif len(argument) in (2, 3):
        high, low = split(argument[1], f"values of the input {name}")
        data = input_of(name, (argument[0], high, *argument[2:]), trajectories)
        t, kind = data.breakpoints, argument[2] if len(argument) == 3 else "linear"
        if kind == "cubic":
            return data
        rest = _constant(t, low) if kind == "constant" else np.array([low[..., :-1], _rates_of_lines(t, high, low)[1]])
    else:
        return input_of(name, argument, trajectories)
    return replace(data, pieces=with_low(data.pieces, _from_pieces(name, t, rest, trajectories).pieces * NO_TIME))


def _rates_of_lines(t: Array, high: Array, low: Array) -> tuple[Array, Array]:
    """Return the time derivatives of linear pieces between values of two words, in two words."""
    (rise, rest), (run, run_low) = (_differences(np.asarray(values)) for values in (high, t))
    rates = rise / run
    product, cut = exact_product(rates, run)
    return rates, ((rise - product) - cut + (rest + np.diff(low)) - rates * run_low) / run


def _differences(x: Array) -> tuple[Array, Array]:
    """Return the differences of successive numbers without rounding error, as double-double numbers (TwoSum)."""
    first, second = x[..., :-1], x[..., 1:]
    difference = second - first
    part = difference - second
    return difference, (second - (difference - part)) - (first + part)


def _powers(name: str, argument: Any) -> tuple[Array, Array]:
    """Return breakpoints and ascending coefficients of a SciPy piecewise polynomial, without pieces of zero length."""
    from scipy.interpolate import PPoly  # here: slow to import

    if not isinstance(argument, PPoly):
        raise StateError(
            f"the input '{name}' is a {type(argument).__name__}: convert it, as by PPoly.from_bernstein_basis"
        )
    x, c = (checked_times(argument.x, f"x of the input {name}"), checked_times(argument.c, f"c of the input {name}"))
    long = np.diff(x) != 0.0
    breakpoints = np.append(x[:-1][long], x[-1])
    _check_ascending(name, breakpoints)
    return breakpoints, np.moveaxis(c[::-1, long], 1, -1)


def _check_ascending(name: str, t: Array) -> None:
    if (late := np.flatnonzero(np.diff(t) <= 0.0)).size:
        k = int(late[0])
        raise StateError(f"the times of the input '{name}' must be ascending: {t[k + 1]:g} follows {t[k]:g}")


def _constant(t: Array, values: Array) -> Array:
    return values[np.newaxis, ..., :-1]


def _linear(t: Array, values: Array) -> Array:
    return np.array([values[..., :-1], np.diff(values) / np.diff(t)])


def _cubic(t: Array, values: Array) -> Array:
    from scipy.interpolate import CubicSpline  # here: slow to import

    return np.moveaxis(CubicSpline(t, values, axis=-1).c[::-1], 1, -1)


KINDS: dict[str, Callable[[Array, Array], Array]] = {"constant": _constant, "linear": _linear, "cubic": _cubic}


def _from_pieces(name: str, breakpoints: Array, ascending: Array, trajectories: int | None) -> Input:
    shaped = ascending.shape[1:-1] in ((), (trajectories,))
    if not shaped or len(ascending) > POWERS or not np.isfinite(ascending).all():
        raise StateError(
            f"the input '{name}' must be piecewise polynomial, of degree 3 at most, with finite coefficients"
        )
    pieces = np.zeros((ascending.shape[-1], *ascending.shape[1:-1], POWERS + 1))
    pieces[..., : len(ascending)] = ascending.T
    pieces.T[POWERS] = np.where(np.isfinite(breakpoints[:-1]), breakpoints[:-1], 0.0)
    return Input(breakpoints, pieces)


def inputs_of_slice(inputs: Mapping[str, Input], part: slice | int) -> dict[str, Input]:
    """Return the inputs of a slice of the trajectories of an ensemble, or of one of them."""
    return {
        name: replace(data, pieces=data.pieces[:, part]) if data.pieces.ndim == 3 else data
        for name, data in inputs.items()
    }


def record_segments(
    run: Run,
    segments: Iterable[int | None],
    recorded: Callable[[int | None], Trajectory],
    stopped: Callable[[], bool] = lambda: False,
) -> Trajectory:
    """Record a run by :func:`prepared_segments`; their ends, and the last state before a failure, are also saved.

    ``recorded`` records a number of steps; ``stopped`` tells whether the run was stopped; terminal events end it, too.
    """
    pieces, size = list[Trajectory](), 0
    for steps in segments:
        try:
            if size > room_for_states():
                raise too_many_states(sum(len(piece) - 1 for piece in pieces) + 1, run.steps, float(run.t))
            piece = recorded(steps)
        except StepFailedError as failure:
            last = [] if failure.trajectory is None else [with_final_state(Trajectory.before(failure), run)]
            failure.trajectory = joined([*pieces, *last])
            raise
        pieces.append(piece if run.ended else with_final_state(piece, run))
        size += sum(column.nbytes for column in (piece.t, piece.q, piece.p))
        if run.ended or stopped():
            break
    return joined(pieces or [recorded(0)])


class InputSegments:
    """Segments of a run between the breakpoints of its inputs.

    Args:
        stepper: the compiled integrator.
        inputs: validated inputs by name.
        parameters: of the run, without those of inputs.
        t, t_end: initial and final time.

    Attributes:
        values: function of time that returns the parameters of the piece containing it.
        first: parameters at the start.
    """

    def __init__(
        self, stepper: Integrator, inputs: Mapping[str, Input], parameters: Any, t: float, t_end: float
    ) -> None:
        self.inputs, self.t_end, self.values = inputs, t_end, parameters_of(stepper, parameters, inputs)
        self.first = self.values(first_inner_time(t, t_end))

    def plan(self, plan: StepPlan) -> StepPlan:
        """Return the step plan of the run; fixed steps have no end, as each segment ends where the next begins."""
        return Fixed(plan.h) if isinstance(plan, FixedSteps) else plan

    def record(self, run: Run, save_every: int, progress: Callable[[int], None] | None) -> Trajectory:
        """Integrate segment by segment; states at breakpoints are saved as well."""
        first, run._watch = run.steps, None
        report = None if progress is None else lambda _: progress(run.steps - first)
        recorded = partial(run.record, save_every=save_every, progress=report)
        trajectory = record_segments(run, prepared_segments(run, self.inputs, self.t_end, self.values), recorded)
        if run._leaving:
            warn_of_large_steps(trajectory)
        warn_of_unresolved_fields(trajectory)
        return trajectory


def prepared_segments(
    run: Memory, inputs: Mapping[str, Input], t_end: float, values: Callable[[float], Array]
) -> Iterator[int | None]:
    """Prepare the run for each segment between breakpoints, in order.

    Yields:
        The number of steps of the segment; ``None`` for adaptive steps to the target time of the run.
    """
    if isinstance(run.plan, FixedSteps):
        for segment in planned_segments(
            run._times[0], t_end, run._step_size, inputs, words=run.stepper.interface.words
        ):
            run.update(parameters=run._with_set_by_events(values(segment.middle)), h=segment.h)
            if run.stepper.interface.words > 1 and segment.end is not None:
                run._step_to(segment.end)
            yield segment.steps
        return
    for end in breakpoints_until(run.t, t_end, inputs):
        parameters = run._with_set_by_events(values(run.t + 0.5 * (end - run.t)))
        run.update(parameters=parameters, plan=ending_at(run.plan, end))
        yield None


class Segment(NamedTuple):
    """Segment of equal steps within one piece of every input.

    Attributes:
        start: start time as a double-double number.
        middle: a time inside the piece.
        end: time at which a shorter step ends.
    """

    steps: int
    h: float
    start: tuple[float, float]
    middle: float
    end: float | None = None


def planned_segments(t: float, t_end: float, h: float, inputs: Mapping[str, Input], *, words: int = 1) -> list[Segment]:
    """Return the segments from t to t_end: steps of h, and a shorter one before each breakpoint and the end.

    In two words (``words``), a step that differs from h by its rounding error is not a multiple of h.
    """
    forward, now, segments = np.sign(t_end - t), (float(t), float(low_words(t))), []
    negligible = NEGLIGIBLE_STEP * min(abs(h), abs(t_end - t))
    for end in breakpoints_until(t, t_end, inputs):
        middle = now[0] + 0.5 * (end - now[0])
        whole = int(np.floor(((end - now[0]) - now[1]) / h + NEGLIGIBLE_STEP))
        if words > 1 and 0 < abs(Fraction(end) - sum(map(Fraction, now)) - whole * Fraction(h)) <= negligible:
            whole -= 1
        if whole > 0:
            segments.append(Segment(whole, h, now, middle))
            now = time_after_steps(now, h, whole)
        rest = (end - now[0]) - now[1]
        if forward * rest > negligible:
            segments.append(Segment(1, rest, now, middle, end))
            now = time_after_steps(now, rest, 1)
    return segments


def time_after_steps(now: tuple[float, float], h: float, steps: int) -> tuple[float, float]:
    """Return the double-double time after ``steps`` steps of h."""
    high, low = map(float, exact_sum(now[0], h) if steps == 1 else times_after(now[0], h, steps))
    total = high + (low + now[1])
    return total, (low + now[1]) - (total - high)


def with_final_state(piece: Trajectory, run: Run) -> Trajectory:
    """Append the final state of a segment if the output stride skipped it."""
    if piece.t[-1] == run.t:
        return piece
    iterations, run.iterations = run.iterations, 0
    return replace(
        piece,
        t=np.concatenate([piece.t, run._times]),
        q=np.concatenate([piece.q, run.q[None]]),
        p=np.concatenate([piece.p, run.p[None]]),
        iterations=np.append(piece.iterations, np.int32(iterations)),
        step_sizes=np.append(piece.step_sizes, run._step_size),
    )


def breakpoints_until(t: float, t_end: float, inputs: Mapping[str, Input]) -> list[float]:
    """Return the breakpoints between t and t_end in the direction of the run, followed by t_end."""
    low, high = min(t, t_end), max(t, t_end)
    inner: set[float] = set()
    for name, data in inputs.items():
        first, last = data.breakpoints[0], data.breakpoints[-1]
        slack = NEGLIGIBLE_STEP * (last - first)
        if low < first - slack or high > last + slack:
            raise StateError(
                f"the input '{name}' covers t = {first:g} to {last:g}, but the run goes from {low:g} to {high:g}: "
                "extend the data, or shorten the run"
            )
        inner |= {float(x) for x in data.breakpoints if low < x < high}
    ends = sorted(inner, reverse=bool(t_end < t))
    return [*ends, *([t_end] if t_end != t else [])]


def final_time(t: float, h: float | None, steps: int | None, t_end: float | None) -> float:
    """Return the final time of a run, given by t_end or by h and steps."""
    t = checked_number(t, "t")
    if t_end is not None:
        return checked_number(t_end, "t_end")
    return float(times_after(t, checked_step(cast(float, h)), checked_count(steps, "steps", least=0))[0])


def first_inner_time(t: float, t_end: float) -> float:
    """Return a time inside the first piece of a run: just after t, or just before it for a run backward."""
    return float(np.nextafter(t, t_end))


def parameters_of(stepper: Integrator, argument: Any, inputs: Mapping[str, Input]) -> Callable[[float], Array]:
    """Return a function of time that evaluates all parameters, those of inputs by their pieces."""
    check_left_to_inputs(stepper.interface, argument)
    return partial(parameters_at, stepper.interface.parameters, stepper._parameters(argument), inputs)


def parameters_at(
    names: Sequence[str], others: Array, inputs: Mapping[str, Input], t: float, part: slice = ALL
) -> Array:
    """Return (p,) parameter values at t, or (k, p) for a slice of the trajectories; inputs override ``others``."""
    values = others[part].copy()
    for name, data in inputs.items():
        first = names.index(f"{name}_0")
        values[..., first : first + POWERS + 1] = data.parameters(t, part)
    return values
