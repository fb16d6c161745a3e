"""Stepper of arrays of run-time sizes, which each call binds to its arrays."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from functools import partial, wraps
from typing import Any, Self, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.codegen.ir.variants import Variant
from scvi_codegen.codegen.native import building
from scvi_codegen.codegen.native.binding import Binding, with_calls
from scvi_codegen.codegen.rendering.source import Source
from scvi_codegen.common.errors import MethodError
from scvi_codegen.common.once import Once
from scvi_codegen.runs.forwarding import Forwarded
from scvi_codegen.runs.states.validation import flat_state
from scvi_codegen.runs.stepper import Stepper
from scvi_codegen.runs.stepping.array_interface import RunSizes, interface_of_sizes, shapes_of_call, sizes_of_run
from scvi_codegen.runs.stepping.compiled_method import Variants
from scvi_codegen.runs.stepping.features import require
from scvi_codegen.systems.event import Event
from scvi_codegen.systems.formulas.indices import SIZES_REQUIRED

Called = TypeVar("Called", bound=Callable[..., Any])


class UnavailableError(MethodError, AttributeError):
    """Error of an attribute that requires known sizes; ``hasattr`` is false."""


def _bound(method: Called, *, at_rest: bool = False) -> Called:
    """Return a method of steppers of run-time sizes that binds a stepper to its arrays and calls the method of this.

    It has the further argument ``tables``. The first argument is a position; ``at_rest``: without p and velocity the
    initial velocity is 0.
    """

    @wraps(method)
    def call(self: StepperOfRunTimeSizes, q: Any, *arguments: Any, **named: Any) -> Any:
        return self._call_bound(method, at_rest, q, arguments, **named)

    return cast(Called, call)


def _bound_path(method: Called) -> Called:
    """Return the method ``path``; the positions that determine the sizes are q0, or of closed paths the first."""

    @wraps(method)
    def call(self: StepperOfRunTimeSizes, q0: Any = None, *arguments: Any, **named: Any) -> Any:
        start = named.get("start")
        if q0 is not None or start is None:
            return self._call_bound(method, False, q0, arguments, **named)
        if callable(start):
            first = start(named.get("t", 0.0))
        else:
            first = {name: x[0] for name, x in start.items()} if isinstance(start, Mapping) else start[0]
        return self.bind(first, named.get("parameters"))[0].path(None, *arguments, **named)

    return cast(Called, call)


class StepperOfRunTimeSizes(Stepper):
    """Stepper of arrays whose sizes each call determines: its methods bind a stepper to the arrays of the call."""

    run_time_sizes = True
    _last: tuple[Hashable, Stepper | None] = None, None
    _latest: tuple[Hashable, Stepper] | None = None

    chaos_indicators_ensemble: Any = Forwarded("steppers", "chaos_indicators_ensemble", partial(_bound, at_rest=True))
    path: Any = Forwarded("steppers", "path", _bound_path)

    def _call_bound(
        self,
        method: Callable[..., Any],
        at_rest: bool,
        q: Any,
        arguments: tuple[Any, ...],
        *,
        parameters: Any = None,
        tables: Mapping[str, ArrayLike] | None = None,
        **named: Any,
    ) -> Any:
        """Call a method of the stepper that is bound to the arrays of the call."""
        if method in (Stepper.integrate_ensemble, Stepper._ensemble):
            operations = {"observe": "observe_ensemble", "precision": "single"}
            for argument, operation in operations.items():
                if named.get(argument) not in (None, "double"):
                    require(self, operation)
        threads = named.pop("threads", None) if method in PER_STEP else None
        stepper = self.with_events(named.pop("events", None))
        bound, state = stepper.bind(q, parameters, tables, threads)
        if len(arguments) == 1 and arguments[0] is None:  # p=None by position
            arguments = ()
        if at_rest and not arguments and named.get("p") is None and named.get("velocity") is None:
            layout = self.interface.layout
            general = layout.momentum_formulas or (self._reason is not None and not layout.momenta)
            spins = any(rotation.startswith("spin") for rotation in bound.interface.rotations)
            if not (spins or bound.interface.variables):  # their state has momenta of its own
                positions, *_ = bound._states.start(state, None, None)
                named["velocity" if general else "p"] = np.zeros(np.shape(positions))
        return method(bound, state, *arguments, parameters=parameters, **named)

    def bind(
        self, q: Any, parameters: Any = None, tables: Mapping[str, ArrayLike] | None = None, threads: int | None = None
    ) -> tuple[Any, Any]:
        """See :meth:`CompiledMethod.bind`."""
        shapes, (last, bound) = None if tables is not None else shapes_of_call(q, parameters, threads), self._last
        if shapes is None or shapes != last or bound is None:
            problem = sizes_of_run(self.interface, q, parameters, tables, threads)
            if self._reason is None:
                bound = self._bound_to(problem)
            elif problem.threads > 1:
                raise MethodError(f"omit threads: this system is compiled with the sizes of each call. {self._reason}")
            else:
                bound = self.with_sizes(problem.sizes, tables=problem.places)
            self._last = shapes, bound
        bound = bound.with_events(self.events)
        if (type(q) is np.ndarray and q.ndim == 1) or bound.interface.rotations or bound.interface.variables:
            return bound, q
        return bound, flat_state(bound.interface, q, "q")

    def _bound_to(self, problem: RunSizes) -> Stepper:
        """Return the stepper bound to these sizes and tables; the latest one is kept for later calls."""
        if self._latest is None or self._latest[0] != problem.key:

            def make(variant: Variant) -> Source | None:
                stepper = bound.known if variant.of_known_sizes else self
                return stepper._variants[variant]

            interface = interface_of_sizes(self.interface, problem.sizes)
            looser = None if self._looser is None else Once(lambda: cast(Any, self._looser)()._bound_to(problem))
            further: dict[str, Any] = {"variants": Variants(make=make), "flags": self.flags, "looser": looser}
            bound = Stepper(self._plain, interface, origin=self, problem=problem, **further)
            self._latest = problem.key, bound
        return self._latest[1]

    def _rebuilt(self, problem: RunSizes, events: tuple[Event, ...]) -> Stepper:
        """Return the stepper bound to these sizes with these events, of a pickle."""
        return self._bound_to(problem)._copy(events)

    def _load(self) -> None:
        """Load nothing: bound steppers load the library."""

    def __getattr__(self, name: str) -> Any:
        if name in ("binding", "dimension"):  # of which the properties raised this error
            raise self._unavailable(name)
        raise AttributeError(f"'{type(self).__name__}' has no attribute '{name}'")

    def _unavailable(self, name: str) -> UnavailableError:
        return UnavailableError(f"{name} is not available for {self!r}: {SIZES_REQUIRED}")

    @property
    def binding(self) -> Binding:
        """Unavailable: bound steppers have one."""
        raise self._unavailable("binding")

    @property
    def dimension(self) -> int:
        """Unavailable: it depends on the sizes."""
        raise self._unavailable("dimension")

    @property
    def known(self) -> Self:
        """Unavailable: a stepper of these sizes is required."""
        raise MethodError(f"{self!r} requires sizes here: pass stepper.with_sizes(..). {SIZES_REQUIRED}")

    def _compile(self) -> None:
        if self._reason is None:
            building.load(with_calls(self.source), flags=self.flags)

    @property
    def _has_error_estimate(self) -> bool:
        """True if the method has adaptive steps; also if that follows from the sizes."""
        return self._reason is not None or "advance_to" in self.source.contents.functions


AT_REST = "integrate start project integrate_ensemble _ensemble"
"""Methods that bind the stepper, and begin with the velocity 0 where none is given."""
BOUND = (
    "multipliers constraint_values step step_positions discrete_lagrangian discrete_legendre_minus "
    "discrete_legendre_plus work_and_impulses rates energy momentum_maps momentum velocity initial_momentum jacobian "
    "sensitivity jvp vjp"
)
"""Further methods that bind the stepper."""
for _name in f"{AT_REST} {BOUND}".split():
    setattr(StepperOfRunTimeSizes, _name, _bound(getattr(Stepper, _name), at_rest=_name in AT_REST.split()))
PER_STEP = (Stepper.integrate, Stepper.start)
"""Methods whose ``threads`` are those of each step."""
