"""Validated model: a system with a method, an initial state and a time span."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Real
from typing import TYPE_CHECKING, Any

from scvi_codegen.errors import MethodWarning, ModelFileError, warn
from scvi_codegen.formulas.inputs import input_parameters
from scvi_codegen.mechanics.system import SYSTEM, MechanicalSystem
from scvi_codegen.methods import Method, as_method
from scvi_codegen.methods.galerkin import SVI
from scvi_codegen.models.problems import Problem
from scvi_codegen.representation import summary
from scvi_codegen.validation.argument_types import check_kind
from scvi_codegen.validation.counts import LARGEST_COUNT, check_tolerance, checked_count

if TYPE_CHECKING:
    from scvi_codegen.models.input_tables import InputTable
    from scvi_codegen.native.options import SolverOptions
    from scvi_codegen.runtime.core.integrator import Integrator
    from scvi_codegen.runtime.core.stepper import Stepper
    from scvi_codegen.runtime.core.validation import Array
    from scvi_codegen.runtime.inputs.segments import Input
    from scvi_codegen.runtime.run.global_error import GlobalError
    from scvi_codegen.runtime.run.run import Run

__all__ = [
    "DEFAULT_METHOD",
    "Model",
    "check_adaptive",
    "check_length",
    "check_one_of",
    "check_step",
    "is_whole",
    "real",
    "steps_in",
    "whole_steps_in",
]

DEFAULT_METHOD = SVI(8)
"""Default method for the problems of the catalogue."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Model:
    """System, method, initial state and time span; equality is structural.

    Attributes:
        system: the mechanical system, with the parameter values of the run as its defaults.
        method: its discretisation; a name, ``"svi:8"``, is converted to the method.
        q: (m,) initial coordinates.
        p: (m,) initial momenta, or ``None`` if ``velocity`` is given.
        velocity: (m,) initial velocities, or ``None`` if ``p`` is given.
        h: step size, not 0, negative for a run backward in time; or ``None`` for adaptive steps. With a time
            transformation, the step size in tau.
        tolerance: relative error allowed to each adaptive step, below 1, or ``None`` for round-off. With a time
            transformation, :func:`largest_step` chooses the step size in tau for it.
        error: instead of both, bound of the relative global error of all states: runs choose their local tolerance as
            ``integrate(error=)`` does, and warn if the bound is not confirmed. Requires adaptive steps.
        span: time span, positive, or ``None`` if ``steps`` is given. With adaptive steps negative for a run backward.
        steps: number of fixed steps, or ``None`` if ``span`` is given.
        time_transformation: time-rescaling function of the reversible controller, as text, see
            :func:`~scvi_codegen.compile_stepper`; requires a span. A system in transformed time has its own.
        save_every: stride of saved states, in steps.
        t: initial time.
        inputs: by name a table of values, ``(t, values)`` or ``(t, values, kind)`` as :meth:`Stepper.integrate` accepts
            it; a run requires all inputs of the system.

    Raises:
        ModelFileError: naming the field, unless exactly one of p and velocity, at most one of h, tolerance and error,
            and exactly one of span and steps is given, each vector has m entries, and every number is finite and valid.
    """

    system: MechanicalSystem
    method: Method
    q: tuple[float, ...]
    p: tuple[float, ...] | None = None
    velocity: tuple[float, ...] | None = None
    h: float | None = None
    tolerance: float | None = None
    error: float | None = None
    span: float | None = None
    steps: int | None = None
    time_transformation: str | None = None
    save_every: int = 1
    t: float = 0.0
    inputs: Mapping[str, InputTable] = field(default_factory=dict, hash=False)

    __repr__ = summary("system", "method", "h", "span", "steps")

    def __post_init__(self) -> None:
        check_kind(SYSTEM, self.system, "system", ModelFileError)
        object.__setattr__(self, "method", as_method(self.method, self.system))
        check_one_of("p", self.p, "velocity (q_dot)", self.velocity)
        check_at_most_one(self.h, self.tolerance, self.error)
        check_one_of("span", self.span, "steps", self.steps)
        for name in ("q", "p", "velocity"):
            if (vector := getattr(self, name)) is not None:
                object.__setattr__(self, name, self._vector(name, vector))
        for name in ("h", "tolerance", "error", "t", "span"):
            if (value := getattr(self, name)) is not None:
                object.__setattr__(self, name, real(value, name))
        self._check_length()
        if self.steps is not None:
            object.__setattr__(self, "steps", checked_count(self.steps, "steps", least=0, error=ModelFileError))
        object.__setattr__(
            self, "save_every", checked_count(self.save_every, "save_every", least=1, error=ModelFileError)
        )
        if self.inputs:
            from scvi_codegen.models.input_tables import checked_tables  # not needed for reading a model

            object.__setattr__(self, "inputs", checked_tables(self.system, self.inputs))

    @classmethod
    def from_problem(cls, entry: Problem, method: Method = DEFAULT_METHOD) -> Model:
        """Return the model of a catalogue entry with a method."""
        return cls(
            system=entry.system,
            method=method,
            q=entry.q,
            p=entry.p,
            velocity=entry.velocity,
            h=entry.step,
            span=entry.span,
        )

    @property
    def step_count(self) -> int:
        """Number of fixed steps: ``steps``, or ``span`` / h rounded up, as the last step may be shorter.

        Raises:
            ModelFileError: if the number is not known in advance, because the run ends at a time.
        """
        if self.steps is not None:
            return self.steps
        step = self.step
        if self.ends_at_time:
            raise ModelFileError(
                "the number of steps in tau for a time span is not known in advance: give steps (--steps)"
            )
        assert self.span is not None  # by construction
        return steps_in(self.span, step)

    def whole_step_count(self) -> int:
        """Return the number of steps of a run that cannot end with a shorter step; see :func:`whole_steps_in`."""
        return self.step_count if self.span is None else whole_steps_in(self.span, self.step, self.t)

    @property
    def has_shorter_last_step(self) -> bool:
        """True if the span is not a whole number of fixed steps, so that the last step is shorter."""
        return not (self.span is None or self.ends_at_time or is_whole(self.span, self.step))

    @property
    def ends_at_time(self) -> bool:
        """True if the run ends at a time, after a number of steps that is not known in advance."""
        return self.h is None or (self.has_time_transformation and self.span is not None)

    @property
    def has_time_transformation(self) -> bool:
        """True if there is a time transformation, so that a step size is one in tau."""
        return self.time_transformation is not None or self.system.clock is not None

    @property
    def parameters(self) -> dict[str, float]:
        """Parameters by name: the system's defaults, without the energy of a transformation and inputs."""
        others = {self.system.clock.energy.name if self.system.clock else "", *input_parameters(self.system.inputs)}
        return {symbol.name: value for symbol, value in self.system.constants.items() if symbol.name not in others}

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

    def first_step(self, stepper: Stepper) -> float:
        """Return h, or the size of the first adaptive step; with a time transformation, the step size in tau."""
        if self.h is not None and self.time_transformation is None:
            return self.h
        run = self.start(stepper)
        if self.system.clock is not None:
            return run.h
        run.advance(1)
        return run.t - self.t

    @property
    def covered(self) -> float:
        """Time span, negative for a run backward in time."""
        if self.h is None:
            assert self.span is not None  # by construction
            return self.span
        return self.h * self.step_count if self.span is None else math.copysign(self.span, self.h)

    def stepper(self, *, solver: str = "auto") -> Stepper:
        """Compile a stepper for runs of this model; raises as :func:`~scvi_codegen.compile_stepper`."""
        from scvi_codegen.compiler import compile_stepper  # imported here: not needed for reading a model

        return compile_stepper(self.system, self.method, solver=solver, time_transformation=self.time_transformation)

    def momenta(self, stepper: Stepper) -> Array:
        """Return the (m,) initial momenta: ``p``, or the Legendre transform of the velocities."""
        import numpy as np  # imported here: not needed for reading a model

        if self.p is not None:
            return np.array(self.p)
        assert self.velocity is not None  # by construction
        return stepper.momentum(self.q, self.velocity, self.t, self.parameters_at_start(stepper))

    def parameters_at_start(self, stepper: Stepper) -> Mapping[str, float] | Array:
        """Return the initial parameters, including components of inputs if these are given."""
        if not self.inputs:
            return self.parameters
        from scvi_codegen.runtime.inputs.segments import first_inner_time

        return self._inputs_and_parameters(stepper)[1](first_inner_time(self.t, self.end))

    def segments(self, run: Run) -> Iterator[int | None]:
        """Prepare a run of this model for each segment of equal steps, between breakpoints of its inputs.

        Yields:
            Number of steps of the segment; ``None`` for steps up to the target time of the run.

        Raises:
            ModelFileError, StateError: for inputs that are missing, or do not cover the whole run.
        """
        if not (self.system.inputs or self.has_shorter_last_step):
            yield None if run.plan else self.step_count
            return
        from scvi_codegen.runtime.inputs.segments import prepared_segments  # imported here, as NumPy above

        inputs, values = self._inputs_and_parameters(run.stepper)
        yield from prepared_segments(run, inputs, self.end, values)

    @property
    def end(self) -> float:
        """Final time."""
        from scvi_codegen.runtime.inputs.segments import final_time

        return final_time(self.t, self.h, self.steps, None if self.span is None else self.t + self.covered)

    def all_inputs(self) -> Mapping[str, InputTable]:
        """Return the inputs; ModelFileError unless all inputs of the system are given."""
        for name in self.system.inputs:
            if name not in self.inputs:
                way = f'[inputs] {name} = {{ file = "{name}.csv" }}, or --input {name}=FILE'
                raise ModelFileError(f"the input {name} is not set: give {way}")
        return self.inputs

    def _inputs_and_parameters(self, stepper: Integrator) -> tuple[dict[str, Input], Callable[[float], Array]]:
        """Return the inputs, and the parameters as a function of time."""
        from scvi_codegen.runtime.inputs.segments import checked_inputs, parameters_of

        inputs = checked_inputs(stepper.interface, self.all_inputs())
        return inputs, parameters_of(stepper, self.parameters, inputs)

    def start(self, stepper: Stepper, *, options: SolverOptions | None = None) -> Run:
        """Start the run of this model at its initial state, to be advanced by its :meth:`segments` or to its end."""
        p, h = self.momenta(stepper), self.h
        if h is None and self.has_time_transformation:
            from scvi_codegen.runtime.run.largest_step import largest_step  # imported here: not needed for reading

            if self.system.inputs:
                raise ModelFileError(
                    "with inputs, a step size in tau cannot be found by a pilot run: give one (--step, [run] step)"
                )
            arguments: dict[str, Any] = {"t": self.t, "parameters": self.parameters, "options": options}
            h = largest_step(stepper, self.q, p, self.covered, self.tolerance or 0.0, **arguments)
        to_end = h is None or self.time_transformation is not None
        tolerance = self.tolerance if self.error is None else self.confirmed(stepper, options=options).local_tolerance
        return stepper.start(
            self.q,
            p,
            h=abs(h) if h is not None and to_end else h,
            t=self.t,
            t_end=self.t + self.covered if to_end else None,
            tolerance=tolerance if h is None else None,
            parameters=self.parameters_at_start(stepper),
            options=options,
        )

    def confirmed(self, stepper: Stepper, *, options: SolverOptions | None = None) -> GlobalError:
        """Return the local tolerance for :attr:`error`, confirmed by runs with other tolerances.

        Steps with that tolerance are bitwise equal to those that were confirmed.
        """
        p = self.momenta(stepper)
        common: dict[str, Any] = {"t": self.t, "t_end": self.t + self.covered, "error": self.error}
        common |= {"parameters": self.parameters, "options": options}
        if self.system.inputs:
            common["inputs"] = self.all_inputs()
        confirmation: GlobalError | None = stepper.integrate(self.q, p, **common).confirmation
        assert confirmation is not None  # by construction
        return confirmation

    def _check_length(self) -> None:
        if self.time_transformation is not None and (self.system.clock is not None or self.span is None):
            raise ModelFileError(
                f"the reversible controller of the time transformation {self.time_transformation} requires a time "
                "span (give span, not steps), and a system without a time transformation"
            )
        if self.h is None:
            check_adaptive(self.tolerance, self.span)
            check_error(self.error, has_time_transformation=self.has_time_transformation)
            return
        check_step(self.h, self.span)

    def _vector(self, name: str, values: Sequence[float]) -> tuple[float, ...]:
        names = [coordinate.name for coordinate in self.system.coordinates]
        if not isinstance(values, Iterable):
            raise ModelFileError(f"{name} must be {len(names)} numbers, not {values!r}")
        values = tuple(values)
        check_length(values, names, name)
        return tuple(real(value, f"{name}[{i}] ({names[i]})") for i, value in enumerate(values))


def check_step(h: float, span: float | None) -> None:
    """Raise an error for a step size of 0, and a span that is not a positive number of steps."""
    if h == 0.0:
        raise ModelFileError("the step size is 0: it must be positive, or negative for a run backward in time")
    if span is not None and not 0.0 < span / abs(h) <= LARGEST_COUNT:
        raise ModelFileError(
            f"span is {span:g} with a step size of {h:g}: it must be positive, also for a run "
            "backward in time, and less than 2^53 steps"
        )


def check_adaptive(tolerance: float | None, span: float | None) -> None:
    """Raise an error for an invalid tolerance or span of adaptive steps."""
    if tolerance is not None:
        check_tolerance(tolerance, ModelFileError)
    if span is None:
        raise ModelFileError("adaptive steps require a time span: give span, not steps")
    if span == 0.0:
        raise ModelFileError("span is 0: it must be positive, or negative for a run backward in time")


def is_whole(span: float, h: float) -> bool:
    """Return True if a span is a whole number of steps, up to rounding."""
    from scvi_codegen.runtime.run.times import WHOLE  # imported here: not needed for reading a model

    steps = span / abs(h)
    return round(steps) > 0 and abs(steps - round(steps)) <= WHOLE * max(1.0, steps)


def steps_in(span: float, h: float) -> int:
    """Return the number of steps in a span of which the last may be shorter."""
    return round(span / abs(h)) if is_whole(span, h) else math.ceil(span / abs(h))


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


def check_at_most_one(h: float | None, tolerance: float | None, error: float | None) -> None:
    """Raise an error for several step-size options; none means adaptive steps with errors at round-off level."""
    if sum(each is not None for each in (h, tolerance, error)) > 1:
        raise ModelFileError(
            "give only one of h (step: fixed step size), tolerance (error of each adaptive step) and "
            "error (error of the whole run)"
        )


def check_error(error: float | None, *, has_time_transformation: bool) -> None:
    """Raise an error for an invalid bound of the global error, and for one with a time transformation."""
    if error is not None and not 0.0 < error < 1.0:
        raise ModelFileError(f"error is {error:g}: the bound of the relative global error must be between 0 and 1")
    if error is not None and has_time_transformation:
        raise ModelFileError(
            f"error = {error:g} requires adaptive steps, but a time transformation has fixed steps in "
            "tau: give tolerance or step instead"
        )


def allowed_error(model: Any) -> float | None:
    """Return the relative error allowed to each adaptive step, 0 for round-off; ``None`` for a fixed step size."""
    return None if model.h is not None else model.tolerance or 0.0


def check_one_of(one: str, first: object, other: str, second: object) -> None:
    """Raise an error unless exactly one of two fields is given."""
    if (first is None) == (second is None):
        raise ModelFileError(f"give exactly one of {one} and {other}")


def real(value: Any, where: str) -> float:
    """Return a finite number, or raise an error that begins with ``where``."""
    if isinstance(value, bool) or not isinstance(value, Real):
        raise ModelFileError(f"{where} must be a number, not {value!r}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ModelFileError(f"{where} is {number}: it must be a finite number")
    return number
