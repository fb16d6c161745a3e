"""Validated model of an array system: method, sizes, initial state and time span."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

from scvi_codegen.errors import ModelFileError
from scvi_codegen.lowering.arrays import SOLVERS, check_solver
from scvi_codegen.mechanics.arrays.system import ARRAYS, ArraySystem
from scvi_codegen.methods.method import Method
from scvi_codegen.models.time_span import TimeSpan
from scvi_codegen.representation import LONGEST, clipped
from scvi_codegen.validation.argument_types import check_kind

if TYPE_CHECKING:
    from scvi_codegen.native.options import SolverOptions
    from scvi_codegen.runtime.arrays.run import ArrayRun
    from scvi_codegen.runtime.arrays.stepper import ArrayStepper
    from scvi_codegen.runtime.arrays.trajectory import ArrayTrajectory
    from scvi_codegen.runtime.run.global_error import GlobalError

__all__ = ["ArrayModel"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ArrayModel(TimeSpan):
    """Array system with a method, an initial state and a time span.

    Attributes:
        system: the array system.
        method: its discretisation.
        solver: of the stage equations, as of :func:`~scvi_codegen.compile_stepper`.
        q: initial positions by the name of their array; their shapes determine the sizes.
        p, velocity: initial momenta or velocities by the same names, at most one of both; default: 0.
        h, tolerance, error, span, steps, save_every, t: as of :class:`~scvi_codegen.models.time_span.TimeSpan`.
        parameters: numbers, and arrays of them, by name; others keep their defaults.
        tables: index tables of shape (rows, columns), by name.
        document: the sections of the file that it was read from.

    Raises:
        ModelFileError: naming the field; arrays are validated when a run begins.
    """

    system: ArraySystem
    method: Method
    q: Mapping[str, Any]
    solver: str = SOLVERS[0]
    p: Mapping[str, Any] | None = None
    velocity: Mapping[str, Any] | None = None
    parameters: Mapping[str, Any] = field(default_factory=dict)
    tables: Mapping[str, Any] = field(default_factory=dict)
    document: Mapping[str, Any] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        check_kind(ARRAYS, self.system, "system", ModelFileError)
        check_solver(self.solver, ModelFileError)
        if self.p is not None and self.velocity is not None:
            raise ModelFileError("give p or velocity (q_dot), not both")
        self._check_time_span(has_time_transformation=False)

    REQUIRES_SIZES: ClassVar[str] = (
        "the sizes of its arrays are known at run time only. Write sizes as numbers, coordinates = ['q[8]']"
    )

    def __repr__(self) -> str:
        steps = f"span {self.span:g}" if self.h is None else f"{self.step_count} steps of {self.h:g}"
        return clipped(f"<ArrayModel of {self.system.name}: {self.method.name}, {steps}>", LONGEST)

    def segments(self, run: ArrayRun) -> Iterator[int | None]:
        """Prepare a run of this model for each segment of equal steps, and yield its number of steps.

        ``None`` means steps up to the target time of the run.
        """
        if not self.has_shorter_last_step:
            yield None if run.plan else self.step_count
            return
        from scvi_codegen.runtime.inputs.segments import planned_segments  # imported here: not needed for reading

        for segment in planned_segments(run.t, self.t + self.covered, run.h, {}):
            run.update(h=segment.h)
            yield segment.steps

    def stepper(self) -> ArrayStepper:
        """Compile a stepper for runs of any size; raises as :func:`~scvi_codegen.compile_stepper`."""
        from scvi_codegen.compiler import compile_stepper  # imported here: not needed for reading a model

        return compile_stepper(self.system, self.method, solver=self.solver)

    def start(
        self,
        stepper: ArrayStepper | None = None,
        *,
        options: SolverOptions | None = None,
        threads: int | None = None,
    ) -> ArrayRun:
        """Start the run of this model at its initial state; raises as :meth:`ArrayStepper.start`."""
        run_options: dict[str, Any] = {"options": options, "threads": threads}
        stepper, lengths = stepper or self.stepper(), self._step_arguments
        if self.error is not None:
            confirmation = self.confirmed(stepper, **run_options)
            lengths = {"t_end": lengths["t_end"], "tolerance": confirmation.local_tolerance}
        return stepper.start(**self._initial_arguments, **lengths, **run_options)

    def confirmed(self, stepper: ArrayStepper, **run_options: Any) -> GlobalError:
        """Return the local tolerance for :attr:`error`, confirmed by further runs, as in :class:`Model`."""
        confirmation = stepper.integrate(**self._initial_arguments, **self._step_arguments, **run_options).confirmation
        assert confirmation is not None  # by construction
        return confirmation

    def integrate(self, *, progress: Callable[[int], None] | None = None) -> ArrayTrajectory:
        """Integrate over the whole span; raises as :meth:`ArrayStepper.integrate`."""
        lengths = self._step_arguments
        if self.has_shorter_last_step:
            lengths["t_end"] = self.t + self.covered
        elif self.h is not None:
            lengths["steps"] = self.step_count
        return self.stepper().integrate(
            **self._initial_arguments, **lengths, save_every=self.save_every, progress=progress
        )

    @property
    def _step_arguments(self) -> dict[str, Any]:
        """Arguments for the step size: h, or t_end with a tolerance."""
        if self.h is not None:
            return {"h": self.h}
        chosen = {"tolerance": self.tolerance} if self.error is None else {"error": self.error}
        return {"t_end": self.t + self.covered, **chosen}

    @property
    def _initial_arguments(self) -> dict[str, Any]:
        names = ("q", "p", "velocity", "t", "parameters", "tables")
        return {name: getattr(self, name) for name in names}
