"""A system of sums over indices with a method, sizes, an initial state and the length of a run, checked."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from scvi_codegen.counts import checked_count
from scvi_codegen.errors import ModelFileError
from scvi_codegen.kinds import check_kind
from scvi_codegen.mechanics.indexed.system import INDEXED, IndexedSystem
from scvi_codegen.methods.method import Method
from scvi_codegen.models.model import check_step, real, steps_in

if TYPE_CHECKING:
    from scvi_codegen.native.options import SolverOptions
    from scvi_codegen.runtime.indexed_run import IndexedRun
    from scvi_codegen.runtime.indexed_stepper import IndexedStepper
    from scvi_codegen.runtime.indexed_trajectory import IndexedTrajectory

__all__ = ["IndexedModel"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class IndexedModel:
    """A system of sums over indices, a method, an initial state and the length of a run.

    Attributes:
        system: what moves.
        method: how its motion is discretised.
        q: initial positions by the name of their array; their shapes are the sizes.
        p, velocity: initial momenta or velocities by the same names, one of both; or neither: 0.
        h: step, not 0, negative for a run backward.
        span: length of time, positive, or ``None`` if ``steps`` is given.
        steps: number of steps, or ``None`` if ``span`` is given.
        every: distance between kept states in steps.
        t: initial time.
        parameters: numbers, and arrays of them, by name; others keep their defaults.
        tables: whole numbers, (rows, columns), by name.
        document: the sections of the file that it was read from.

    Raises:
        ModelFileError: naming the field; what the arrays are is checked where a run begins.
    """

    system: IndexedSystem
    method: Method
    q: Mapping[str, Any]
    h: float
    p: Mapping[str, Any] | None = None
    velocity: Mapping[str, Any] | None = None
    span: float | None = None
    steps: int | None = None
    every: int = 1
    t: float = 0.0
    parameters: Mapping[str, Any] = field(default_factory=dict)
    tables: Mapping[str, Any] = field(default_factory=dict)
    document: Mapping[str, Any] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        check_kind(INDEXED, self.system, "system", ModelFileError)
        if self.p is not None and self.velocity is not None:
            raise ModelFileError("give p or velocity (q_dot), not both")
        if (self.span is None) == (self.steps is None):
            raise ModelFileError("give exactly one of span and steps")
        for name in ("h", "t"):
            object.__setattr__(self, name, real(getattr(self, name), name))
        if self.span is not None:
            object.__setattr__(self, "span", real(self.span, "span"))
        check_step(self.h, self.span)
        if self.steps is not None:
            checked_count(self.steps, "steps", least=0, error=ModelFileError)
        checked_count(self.every, "every", least=1, error=ModelFileError)

    def __repr__(self) -> str:
        return f"<IndexedModel of {self.system.name}: {self.method.name}, {self.step_count} steps of {self.h:g}>"

    @property
    def step_count(self) -> int:
        """Number of steps: ``steps``, or the whole number (at least 1) of steps nearest to ``span``."""
        if self.steps is not None:
            return self.steps
        assert self.span is not None  # by construction
        return steps_in(self.span, self.h)

    def stepper(self) -> IndexedStepper:
        """Compiled for runs of any size; raises as :func:`~scvi_codegen.compile_indexed`."""
        from scvi_codegen.indexed_compiler import compile_indexed  # here: reading a model does not wait for it

        return compile_indexed(self.system, self.method)

    def start(self, stepper: IndexedStepper | None = None, *, options: SolverOptions | None = None) -> IndexedRun:
        """The run of this model from its initial state; raises as :meth:`IndexedStepper.start`."""
        return (stepper or self.stepper()).start(**self._beginning, h=self.h, options=options)

    def integrate(self, *, progress: Callable[[int], None] | None = None) -> IndexedTrajectory:
        """All of it; raises as :meth:`IndexedStepper.integrate`."""
        stepper, steps = self.stepper(), self.step_count
        return stepper.integrate(**self._beginning, h=self.h, steps=steps, every=self.every, progress=progress)

    @property
    def _beginning(self) -> dict[str, Any]:
        names = ("q", "p", "velocity", "t", "parameters", "tables")
        return {name: getattr(self, name) for name in names}
