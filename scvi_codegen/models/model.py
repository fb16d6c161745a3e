"""Validated model: a system with a method, an initial state and a time span."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from scvi_codegen.errors import ModelFileError
from scvi_codegen.formulas.inputs import input_parameters
from scvi_codegen.mechanics.system import SYSTEM, MechanicalSystem
from scvi_codegen.methods import Method, as_method
from scvi_codegen.methods.galerkin import SVI
from scvi_codegen.models.problems import Problem
from scvi_codegen.models.time_span import TimeSpan, check_length, check_one_of, real
from scvi_codegen.representation import summary
from scvi_codegen.validation.argument_types import check_kind

if TYPE_CHECKING:
    from scvi_codegen.models.input_tables import InputTable
    from scvi_codegen.native.options import SolverOptions
    from scvi_codegen.runtime.core.integrator import Integrator
    from scvi_codegen.runtime.core.stepper import Stepper
    from scvi_codegen.runtime.core.validation import Array
    from scvi_codegen.runtime.inputs.segments import Input
    from scvi_codegen.runtime.run.global_error import GlobalError
    from scvi_codegen.runtime.run.run import Run

__all__ = ["DEFAULT_METHOD", "Model"]

DEFAULT_METHOD = SVI(8)
"""Default method for the problems of the catalogue."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Model(TimeSpan):
    """System, method, initial state and time span; equality is structural.

    Attributes:
        system: the mechanical system, with the parameter values of the run as its defaults.
        method: its discretisation; a name, ``"svi:8"``, is converted to the method.
        q: (m,) initial coordinates.
        p: (m,) initial momenta, or ``None`` if ``velocity`` is given.
        velocity: (m,) initial velocities, or ``None`` if ``p`` is given.
        h, tolerance, error, span, steps, save_every, t: as of :class:`~scvi_codegen.models.time_span.TimeSpan`.
        time_transformation: time-rescaling function of the reversible controller, as text, see
            :func:`~scvi_codegen.compile_stepper`; requires a span. A system in transformed time has its own.
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
    time_transformation: str | None = None
    inputs: Mapping[str, InputTable] = field(default_factory=dict, hash=False)

    __repr__ = summary("system", "method", "h", "span", "steps")

    def __post_init__(self) -> None:
        check_kind(SYSTEM, self.system, "system", ModelFileError)
        object.__setattr__(self, "method", as_method(self.method, self.system))
        check_one_of("p", self.p, "velocity (q_dot)", self.velocity)
        for name in ("q", "p", "velocity"):
            if (vector := getattr(self, name)) is not None:
                object.__setattr__(self, name, self._vector(name, vector))
        if self._varies_steps and (self.system.clock is not None or self.span is None):
            raise ModelFileError(
                f"the reversible controller of the time transformation {self.time_transformation} requires a time "
                "span (give span, not steps), and a system without a time transformation"
            )
        self._check_time_span(has_time_transformation=self.has_time_transformation)
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
    def ends_at_time(self) -> bool:
        """True if the run ends at a time, after a number of steps that is not known in advance."""
        return self.h is None or (self.has_time_transformation and self.span is not None)

    @property
    def _varies_steps(self) -> bool:
        """True if the reversible controller varies the step size."""
        return self.time_transformation is not None

    @property
    def has_time_transformation(self) -> bool:
        """True if there is a time transformation, so that a step size is one in tau."""
        return self.time_transformation is not None or self.system.clock is not None

    @property
    def parameters(self) -> dict[str, float]:
        """Parameters by name: the system's defaults, without the energy of a transformation and inputs."""
        others = {self.system.clock.energy.name if self.system.clock else "", *input_parameters(self.system.inputs)}
        return {symbol.name: value for symbol, value in self.system.constants.items() if symbol.name not in others}

    def first_step(self, stepper: Stepper) -> float:
        """Return h, or the size of the first adaptive step; with a time transformation, the step size in tau."""
        if self.h is not None and self.time_transformation is None:
            return self.h
        run = self.start(stepper)
        if self.system.clock is not None:
            return run.h
        run.advance(1)
        return run.t - self.t

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

    def _vector(self, name: str, values: Sequence[float]) -> tuple[float, ...]:
        names = [coordinate.name for coordinate in self.system.coordinates]
        if not isinstance(values, Iterable):
            raise ModelFileError(f"{name} must be {len(names)} numbers, not {values!r}")
        values = tuple(values)
        check_length(values, names, name)
        return tuple(real(value, f"{name}[{i}] ({names[i]})") for i, value in enumerate(values))
