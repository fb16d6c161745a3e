"""Time span and step size of a model."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from fractions import Fraction
from typing import Any, Self

from scvi_codegen.codegen.native.option_table import DURATION, LOCATED, STEP_SIZE, check_agreement, in_words
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.codegen.rendering.source import DOUBLE_DOUBLE
from scvi_codegen.common.errors import MethodWarning, ModelFileError, warn
from scvi_codegen.common.validation import LARGEST_COUNT
from scvi_codegen.interfaces.models.options import (
    OF_ADAPTIVE_STEPS,
    OPTIONS,
    ROWS,
    RUN_FIELDS,
    ModelOptions,
    options_of,
)
from scvi_codegen.methods.controllers import default_controller


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class TimeSpan(ModelOptions):
    """Step size or tolerance, and time span or number of steps; models derive from it.

    Attributes:
        h: step size, not 0, negative for a run backward in time; or ``None`` for adaptive steps. With a time
            transformation, the step size in tau.
        tolerance: relative error allowed to each adaptive step, below 1, or ``None`` for round-off. With a time
            transformation, :func:`largest_step` chooses the step size in tau for it.
        absolute_tolerance: size below which errors of an adaptive step do not matter, a number or numbers by name of
            coordinate, array or rotation; ``None`` for 0.
        max_step, first_step: largest and first size of adaptive steps, or ``None``.
        error: instead of a step size and a tolerance, bound of the relative global error of all states: runs choose
            their local tolerance as ``integrate(error=)`` does, and warn if the bound is not confirmed.
        span: time span, positive, or ``None`` if ``steps`` is given. With adaptive steps negative for a run backward.
        steps: number of fixed steps, or ``None`` if ``span`` is given.
        save_every: stride of saved states, in steps.
        t_eval: times at which states are saved instead, as of :meth:`Stepper.integrate`.
        t: initial time.
        time_transformation: time-rescaling function of the reversible controller, as text, see
            :func:`~scvi_codegen.compile_stepper`; requires a span. A system in transformed time has its own.
        controller: name of the step-size controller, ``None`` for the default; without ``time_transformation`` it
            requires adaptive steps.
        precision: ``"double-double"`` for runs with states of two words; ``"auto"``: double, and double-double for
            ``error`` that double does not confirm; ``None`` means ``"double"``.
        sums: ``"plain"`` for explicit steps of arrays without compensation, as of
            :func:`~scvi_codegen.compile_stepper`; ``None`` means ``"compensated"``.
        observe: ``"extremes"`` or ``"energy"`` of ensembles, as of :meth:`Stepper.integrate_ensemble`.
        solver_tolerance, max_iterations: of the iteration on the stage equations, as of
            :class:`~scvi_codegen.SolverOptions`.
        threads: number of threads per step, for array sizes known at run time.
        action: whether runs sum the action, as of :meth:`Stepper.integrate <scvi_codegen.Stepper.integrate>`.
    """

    def _check_time_span(self) -> None:
        """Raise :class:`ModelFileError`, naming the field, for invalid values, and convert the others."""
        stated = {row.field: value for row in RUN_FIELDS if (value := getattr(self, row.field)) is not None}
        check_agreement(stated, ModelFileError, required=DURATION, rows=ROWS)
        for name, value in stated.items():
            object.__setattr__(self, name, ROWS[name].checked(value, ModelFileError))
        if None not in (self.h, self.span) and not 0.0 < self.span / abs(self.h) <= LARGEST_COUNT:  # type: ignore
            backward = f"a run backward in time has {{h}} = {-abs(self.h):g} and {{t_end}} = {abs(self.span):g}"  # type: ignore
            remedy = in_words(backward) if self.span < 0.0 else "give a positive one of less than 2^53 steps"  # type: ignore
            raise ModelFileError(f"{ROWS['span']} = {self.span:g} with a step size of {self.h:g}: {remedy}")

    def _check_controller(self) -> None:
        """Raise an error if a controller of adaptive steps is given beside a step size."""
        if self.controller is not None and self.time_transformation is None and self.h is not None:
            raise ModelFileError(
                f"the controller {self.controller} determines adaptive steps: leave out the step size or the controller"
            )

    @property
    def in_double_double(self) -> bool:
        """True if states have two words."""
        return self.precision == DOUBLE_DOUBLE

    def _check_double(self, what: str) -> None:
        """Raise an error if states have two words, which something is not available with."""
        if self.in_double_double:
            raise ModelFileError(
                f"{what} is not available with precision = 'double-double': omit it, or use precision = 'double' "
                "([run] precision)"
            )

    def _check_located(self, what: str) -> None:
        """Raise an error if contacts are by steps, which something does not have."""
        if self.transitions != LOCATED:
            raise ModelFileError(
                f"{what} has located transitions alone: omit transitions = {self.transitions!r} ([run])"
            )

    def _check_alone(self) -> None:
        """Raise an error for a single run with an option of ensembles."""
        if self.observe is not None:
            raise ModelFileError(
                f"observe = {self.observe!r} is for ensembles only: give --ensemble FILE, or omit observe"
            )

    def _run_section(self) -> dict[str, Any]:
        defaults = {field.name: field.default for field in fields(self)}
        rows = options_of("run")
        section = {row.key: value for row in rows if (value := getattr(self, row.field)) != defaults[row.field]}
        if self.time_transformation is not None and self.controller is None:
            section["controller"] = default_controller(in_tau=True)
        return section

    @property
    def _control(self) -> dict[str, Any]:
        """Arguments of adaptive steps besides the tolerance, by name."""
        return {name: getattr(self, name) for name in OF_ADAPTIVE_STEPS}

    def _with_step_size(self, *, steps: int | None = None, **settings: Any) -> Self:
        """Return the model whose step size another option determines, over the same time span or ``steps`` steps."""
        others = {option.field: None for option in OPTIONS if option.determines == STEP_SIZE and option.section}
        if settings.get("h") is not None:
            others |= dict.fromkeys(self._control)
        return replace(self, **{**others, **settings, "steps": steps, "span": None if steps else self.covered})

    @property
    def solver_options(self) -> SolverOptions | None:
        """Convergence criterion of the solver; ``None`` for the default one."""
        rows = [row for row in RUN_FIELDS if row.solver_option and getattr(self, row.field) is not None]
        return SolverOptions(**{row.solver_option: getattr(self, row.field) for row in rows}) if rows else None

    @property
    def ends_at_time(self) -> bool:
        """True if the run ends at a time, after a number of steps that is not known in advance."""
        return self.h is None

    @property
    def step(self) -> float:
        """Fixed step size h; ModelFileError for adaptive steps."""
        if self.h is None:
            raise ModelFileError(
                "this requires a fixed step size, but the model has adaptive steps: give a step h (--step, [run] step)"
            )
        if self.time_transformation is not None:
            raise ModelFileError(
                "this requires a fixed step size, but the reversible controller varies it: leave out the controller"
            )
        return self.h

    @property
    def step_count(self) -> int:
        """Number of fixed steps: ``steps``, or ``span`` / h rounded up, as the last step may be shorter.

        ModelFileError if the number is not known in advance, because the run ends at a time.
        """
        if self.steps is not None:
            return self.steps
        step = self.step
        if self.ends_at_time:
            raise ModelFileError(
                "the number of steps in tau for a time span is not known in advance: give steps (--steps)"
            )
        assert self.span is not None  # by construction
        return round(self.span / abs(step)) if is_whole(self.span, step) else math.ceil(self.span / abs(step))

    def whole_step_count(self) -> int:
        """Return the number of steps of a run that cannot end with a shorter step; see :func:`whole_steps_in`."""
        return self.step_count if self.span is None else whole_steps_in(self.span, self.step, self.t)

    @property
    def has_shorter_last_step(self) -> bool:
        """True if the span is not a whole number of fixed steps, so that the last step is shorter."""
        if self.span is None or self.ends_at_time:
            return False
        if self.in_double_double:
            return Fraction(self.span) % abs(Fraction(self.step)) != 0
        return not is_whole(self.span, self.step)

    @property
    def covered(self) -> float:
        """Time span, negative for a run backward in time."""
        if self.h is None:
            assert self.span is not None  # by construction
            return self.span
        return self.h * self.step_count if self.span is None else math.copysign(self.span, self.h)

    @property
    def allowed_error(self) -> float | None:
        """Relative error allowed to each adaptive step, 0 for round-off; ``None`` for a fixed step size."""
        return None if self.h is not None else self.tolerance or 0.0


def is_whole(span: float, h: float) -> bool:
    """Return True if a span is a whole number of steps, up to rounding."""
    from scvi_codegen.runs.states.times import WHOLE  # imported here: not needed for reading a model

    steps = span / abs(h)
    return round(steps) > 0 and abs(steps - round(steps)) <= WHOLE * max(1.0, steps)


def whole_steps_in(span: float, h: float, t: float) -> int:
    """Return the number (at least 1) of equal steps nearest to a span; warn of the end of the run if it differs."""
    steps = max(1, round(span / abs(h)))
    if not is_whole(span, h):
        warn(
            f"span {span:g} is not a whole number of steps of {abs(h):g}, and recorded runs and C programs have equal "
            f"steps: {steps} steps end at t = {t + steps * h:.12g}, not {t + math.copysign(span, h):g}; give a step "
            "that divides the span",
            MethodWarning,
        )
    return steps


def check_length(values: Sequence[object], names: Sequence[str], where: str) -> None:
    """Raise an error unless there is one value per name."""
    if len(values) != len(names):
        shown = ", ".join(names[:6]) + (", ..." if len(names) > 6 else "")
        raise ModelFileError(f"{where} must have {len(names)} numbers for ({shown}), not {len(values)}")
