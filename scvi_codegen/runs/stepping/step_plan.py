"""Step plan of a run: fixed step size, adaptive steps to a time, or constant steps in transformed time to a time."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from typing import Any, ClassVar, NamedTuple, Self, TypeAlias, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.codegen.native.arguments import checked_number
from scvi_codegen.codegen.native.option_table import DURATION, OPTION, check_agreement, checked_step, in_words, lacking
from scvi_codegen.codegen.rendering.source import Interface
from scvi_codegen.common.errors import AccuracyWarning, StateError, closest, warn
from scvi_codegen.runs.states.times import steps_to, steps_within, times_after
from scvi_codegen.runs.states.validation import coordinate_shapes
from scvi_codegen.runs.states.words import check_doubles
from scvi_codegen.runs.stepping.features import FEATURES, refusal

ROUNDOFF_OF_TWO_WORDS = 1e-27
"""Error of a step in double-double arithmetic that a run without a tolerance may have."""
LEAST_STEP = 4
"""Least value of ``max_step`` in roundings of the largest time."""
UNSEEN_GROWTH = (
    "masses depend on time, and the error estimate of adaptive steps of SCVI methods does not see how momenta grow: "
    "errors may exceed the tolerance by any factor. Compile the system by an SVI, such as 'svi:8'"
)
AbsoluteTolerance: TypeAlias = float | tuple[tuple[str, float], ...]
"""Absolute tolerance of all coordinates, or those of some coordinates, arrays and rotations by name."""


@dataclass(frozen=True, slots=True)
class FixedSteps:
    """Steps of one size h, of tau in transformed time; base of :class:`Fixed` and :class:`Until`."""

    SAME = 1e-9  # relative difference of step sizes that rounding explains
    h: float

    @property
    def size(self) -> float:
        """Step size."""
        return self.h

    @property
    def record(self) -> dict[str, Any]:
        """Numbers by name for files."""
        return {"h": self.h}

    def times(self, t: float, numbers: ArrayLike) -> NDArray[np.float64]:
        """Return the times after these numbers of steps from t, correctly rounded."""
        return times_after(t, self.h, numbers)[0]

    def number_in(self, spans: ArrayLike) -> NDArray[np.intp]:
        """Return the number of equal steps not longer than |h| in each span > 0; StateError if too large."""
        return steps_within(spans, self.h)


@dataclass(frozen=True, slots=True)
class Fixed(FixedSteps):
    """Fixed steps, as many as a call requests."""

    @classmethod
    def checked(cls, h: Any) -> Self:
        """Return the plan of an argument; StateError unless it is a finite number other than 0."""
        return cls(checked_step(h))


@dataclass(frozen=True, slots=True)
class Until(FixedSteps):
    """Fixed steps to the time ``t_end``, the last of which is shorter; it is not taken by the run itself."""

    t_end: float


@dataclass(frozen=True, slots=True)
class Adaptive:
    """Adaptive steps to a target time.

    The error of a step is at most ``tolerance * max(motion of the coordinate, absolute tolerance)``.

    Attributes:
        t_end: target time.
        tolerance: admissible relative error of a step; ``None`` for round-off.
        max_step: largest step size.
        first_step: size of the first trial step; ``None`` if trials determine it.
        absolute_tolerance: the absolute tolerances that are not 0.
    """

    t_end: float
    tolerance: float | None = None
    max_step: float = math.inf
    first_step: float | None = None
    absolute_tolerance: AbsoluteTolerance = ()

    sizes: ClassVar[str] = "of adaptive size"
    size: ClassVar[None] = None

    @property
    def record(self) -> dict[str, Any]:
        """Numbers by name for files; also arguments for users."""
        return {"t_end": self.t_end} | Steps.of(self).named

    @property
    def admissible_error(self) -> float:
        """Admissible relative error of a step in C, where errors below round-off count as round-off."""
        return 0.0 if self.tolerance is None else self.tolerance


@dataclass(frozen=True, slots=True)
class InTau:
    """Steps of one size in the fictitious time ``tau`` of a controller, to the time ``t_end``."""

    t_end: float
    tau: float

    @property
    def size(self) -> float:
        """Step size in tau."""
        return self.tau

    @property
    def sizes(self) -> str:
        """Step sizes in words."""
        return f"of {self.tau:g} in tau"

    @property
    def record(self) -> dict[str, Any]:
        """Numbers by name for files."""
        return {"t_end": self.t_end, "tau": self.tau}


StepPlan: TypeAlias = Fixed | Until | Adaptive | InTau
"""Step sizes of a run and the time at which it ends."""


def duration_of(plan: StepPlan, t: float) -> float:
    """Return the time of steps from t on: one fixed step, or all that are adaptive."""
    return plan.h if isinstance(plan, FixedSteps) else plan.t_end - t


def ending_at(plan: StepPlan, t_end: float) -> StepPlan:
    """Return a step plan with another target time."""
    return Until(plan.h, t_end) if isinstance(plan, FixedSteps) else replace(plan, t_end=t_end)


@dataclass(frozen=True, slots=True, eq=False)
class AdaptivePlans(Sequence[Adaptive]):
    """Adaptive steps of trajectories by one plan to (k,) ``ends`` of their own, made when they are read."""

    ends: NDArray[np.float64]
    plan: Adaptive

    def __len__(self) -> int:
        return len(self.ends)

    def __getitem__(self, j: Any) -> Any:
        if isinstance(j, slice):
            return AdaptivePlans(self.ends[j], self.plan)
        return replace(self.plan, t_end=float(self.ends[j]))


class Span(NamedTuple):
    """Duration of a run: its number of fixed steps, or its final time; ``None`` where a user omits it."""

    steps: int | None = None
    t_end: Any = None


class Steps(NamedTuple):
    """Sizes of steps as users ask for them; ``None`` where a user omits them.

    Attributes:
        tolerance: relative error of an adaptive step.
        absolute_tolerance: smallest size of a coordinate, relative to which errors are measured: a number, or by name.
        max_step, first_step: largest step size; size of the first trial.
        h: fixed step size.
        error: bound of the relative global error.
    """

    tolerance: float | None = None
    absolute_tolerance: float | Mapping[str, float] | None = None
    max_step: float | None = None
    first_step: float | None = None
    h: float | None = None
    error: float | None = None

    @property
    def named(self) -> dict[str, Any]:
        """The arguments of adaptive steps that are not omitted, by name."""
        return {name: value for name, value in zip(self._fields[:4], self, strict=False) if value is not None}

    @classmethod
    def of(cls, plan: Adaptive) -> Self:
        """Return the arguments of a step plan."""
        absolute: Any = plan.absolute_tolerance
        return cls(
            plan.tolerance,
            (dict(absolute) or None) if isinstance(absolute, tuple) else absolute,
            None if plan.max_step == math.inf else plan.max_step,
            plan.first_step,
        )

    def to(self, t_end: float) -> Adaptive:
        """Return the step plan to a target time; StateError if a number is invalid."""
        return Adaptive(checked_number(t_end, "t_end"), **self.checked())

    def checked(self) -> dict[str, Any]:
        """Return the fields of :class:`Adaptive` without its target time."""
        fields = self.named
        for name, value in fields.items():
            if name != "max_step" or value != math.inf:
                fields[name] = OPTION[name].checked(value)
        if isinstance(absolute := fields.get("absolute_tolerance", 0.0), Mapping):
            fields["absolute_tolerance"] = tuple((name, size) for name, size in absolute.items() if size)
        elif "absolute_tolerance" in fields:
            fields["absolute_tolerance"] = absolute or ()
        return fields


def plan_from_record(*, h: Any = None, tau: Any = None, **control: Any) -> Fixed | Adaptive | InTau:
    """Return the step plan of its ``record``; StateError or TypeError for other names and numbers."""
    if h is not None:
        if control or tau is not None:
            raise StateError("steps of one size have neither a target time nor a tolerance")
        return Fixed(checked_step(h))
    t_end = control.pop("t_end", None)
    if tau is not None:
        if control or not checked_number(tau, "tau") > 0.0:
            raise StateError(f"steps of tau = {tau:g} must be positive and have no tolerance")
        return InTau(checked_number(t_end, "t_end"), tau)
    return Steps(**control).to(t_end)


def absolute_tolerances(interface: Interface, dimension: int, absolute: AbsoluteTolerance) -> NDArray[np.float64]:
    """Return the (m,) absolute tolerances of the coordinates; StateError for names of no coordinates or rotation."""
    if not isinstance(absolute, tuple):
        return np.full(dimension, absolute)
    from scvi_codegen.runs.states.rotations import members_of  # here, because it imports runs

    values, first, columns = np.zeros(dimension), 0, dict[str, Any]()
    for name, shape in coordinate_shapes(interface):
        end = first + math.prod(shape)
        columns[name], first = slice(first, end), end
    if len(interface.coordinates) == dimension:
        columns |= {name: slice(k, k + 1) for k, name in enumerate(interface.coordinates) if name not in columns}
    if interface.rotations:
        members = members_of(dimension, interface.rotations)
        ordinary = members[0].columns.start
        names = {name: place for name, place in columns.items() if place.start < ordinary}
        columns = names | {member.name: member.columns for member in members}
    for name, value in absolute:
        if name not in columns:
            raise StateError(
                f"absolute_tolerance: there is no coordinate, array or rotation '{name}' (= {value:g}) in "
                f"'{interface.system}'{closest(name, [*columns])} Known: {', '.join(columns)}"
            )
        values[columns[name]] = value
    return values


def step_control(stepper: Any, plan: StepPlan) -> tuple[Any, ...]:
    """Return the control of steps in C, NULL for fixed ones, and its numbers; StateError if they cannot be met."""
    binding = stepper.binding
    match plan:
        case InTau(tau=tau):
            control = binding.new("step_control *")
            control.tau = tau
            return (control,)
        case Adaptive():
            if stepper.interface.words > 1:
                _check_resolved(plan.tolerance, binding.function("smallest_tolerance")())
            control = binding.new("step_control *")
            control.tolerance, control.max_step = plan.admissible_error, plan.max_step
            first, absolute = binding.null, np.empty(0)
            if plan.first_step is not None:
                first = binding.numbers("double *")
                first[0] = plan.first_step
            if plan.absolute_tolerance != ():
                absolute = absolute_tolerances(stepper.interface, stepper.dimension, plan.absolute_tolerance)
            control.first_step, control.absolute_tolerance = first, binding.pointer(absolute)
            return control, first, absolute
        case _:
            return (binding.null,)


def check_max_step(plan: StepPlan, t: float, words: int = 1) -> None:
    """Raise ``StateError`` if steps of the largest size do not advance the time of a run from t.

    Those of less than ``LEAST_STEP`` roundings of the time vanish in it, or change by a large part. Times of two words
    resolve all, but no run makes as many steps as the roundings of a double.
    """
    if not isinstance(plan, Adaptive) or plan.max_step == math.inf:
        return
    size = max(abs(t), abs(plan.t_end)) if words == 1 else abs(plan.t_end - t)
    if plan.max_step < (least := LEAST_STEP * math.ldexp(float(size), -53)):
        raise StateError(
            f"max_step = {plan.max_step:g} is below {least:.2g}, {LEAST_STEP} roundings of the times of a run from "
            f"t = {float(t):g} to t_end = {plan.t_end:g}: give a larger max_step, or omit it"
        )


def _check_resolved(tolerance: float | None, least: float) -> None:
    """Raise ``StateError`` if error estimates do not resolve a tolerance, or round-off, in double-double arithmetic.

    The estimates are computed in double from the leading coefficient of the curve of a step. Of methods whose order is
    lower than that of this coefficient squared, as ``sc``, it is a rounding error while the step still has an error.
    """
    required, label = ROUNDOFF_OF_TWO_WORDS, "the default tolerance, round-off,"
    if tolerance is not None:
        required, label = tolerance, f"tolerance={tolerance:g}"
    if required < least:
        raise StateError(
            f"{label} cannot be met: adaptive steps of this method resolve errors of {least:.1e} in double-double "
            f"arithmetic. Give tolerance={least:.1e} or more, fixed steps h=, or svi, whose estimates resolve "
            "round-off without constraints"
        )


def checked_plan(interface: Interface, steps: Steps, t_end: float | None) -> StepPlan:
    """Return the step plan of arguments of users; StateError if they are invalid or do not determine the steps."""
    h, named = steps.h, steps.named
    if interface.time_transformation is not None:
        if h is None or t_end is None or named:
            remedy = in_words(FEATURES["adaptive", "with a time transformation"])
            remedy += f"; omit {', '.join(str(OPTION[name]) for name in named)}" if named else ""
            raise StateError(
                f"the time transformation {interface.time_transformation} determines the step size: {remedy}"
            )
        tau = checked_step(h)
        if tau < 0.0:
            raise StateError(f"h = {h:g} must be positive with a time transformation: t_end determines the direction")
        return InTau(checked_number(t_end, "t_end"), tau)
    if h is None and interface.in_tau:
        raise refusal("adaptive", "in transformed time")
    if h is None:
        if t_end is None:
            raise StateError("give either h (fixed step size) or t_end (adaptive step size); got neither")
        if interface.has_unseen_growth:
            warn(UNSEEN_GROWTH, AccuracyWarning)
        return steps.to(t_end)
    check_agreement({"h": h, **named})
    if t_end is not None:
        raise StateError("give either h (fixed step size) or t_end (adaptive step size); got both")
    return Fixed(checked_step(h))


def planned_steps(
    interface: Interface, size: Steps, span: Span, save_every: int, t: float | Fraction
) -> tuple[StepPlan, int | None]:
    """Return the plan of :meth:`Stepper.integrate` and its number of steps, ``None`` to t_end.

    Runs in double-double end at t_end to 32 digits; t matters with t_end.
    """
    in_time, (steps, t_end) = interface.time_transformation is None, span
    check_agreement(span._asdict() | (size._asdict() if in_time else {}), partly=not in_time)
    plan = checked_plan(interface, size, None if in_time and size.h is not None else t_end)
    check_doubles(interface.words, t_end=t_end)
    if not isinstance(plan, FixedSteps):
        check_max_step(plan, cast(float, t), interface.words)
        return plan, None
    if t_end is None:
        if steps is None:
            raise StateError(lacking(DURATION))
        return plan, OPTION["steps"].checked(steps)
    count = None if interface.in_tau else steps_to(t, t_end, plan.h, exactly=interface.words > 1)
    if count is not None and count % OPTION["save_every"].checked(save_every) == 0:
        return plan, count
    end = checked_number(t_end, "t_end")
    if (end - checked_number(t, "t")) * plan.h < 0.0:
        raise StateError(f"h = {plan.h:g} has the wrong sign for a run from t = {t:g} to t_end = {end:g}")
    return Until(plan.h, end), None
