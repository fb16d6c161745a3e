"""Memory of a run: one plain C struct that is started, advanced, saved and restored bitwise.

C functions modify the struct, so a second thread that enters raises an error.
"""

import functools
import math
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from fractions import Fraction
from typing import Any, Self, TypeVar, cast

import numpy as np

from scvi_codegen.codegen.native.option_table import checked_step
from scvi_codegen.codegen.native.options import SolverOptions, checked_options, step_failure
from scvi_codegen.common.errors import StateError, StepFailedError
from scvi_codegen.common.validation import LARGEST_COUNT, checked_count
from scvi_codegen.runs.states.layout import Initial
from scvi_codegen.runs.states.validation import Array, Parameters, States, inputs_not_given, missing_input, no_input
from scvi_codegen.runs.states.words import Word, Words, stacked, with_low, word
from scvi_codegen.runs.stepping.chunks import drive
from scvi_codegen.runs.stepping.features import require
from scvi_codegen.runs.stepping.integrator import Integrator
from scvi_codegen.runs.stepping.noise import (
    DEFAULT_NOISE,
    Noise,
    check_strengths,
    negative_strength,
    remark_on_strengths,
)
from scvi_codegen.runs.stepping.projection import check_reachable, singular_position
from scvi_codegen.runs.stepping.saving import checkpoint
from scvi_codegen.runs.stepping.step_plan import (
    Adaptive,
    Fixed,
    FixedSteps,
    InTau,
    StepPlan,
    check_max_step,
    step_control,
)

FIRST_STEPS, MOST_FIRST = 256, 1024
"""Number of saved states of the first C call, before the speed of the steps is known; the same for few positions."""
LONGEST_FIRST, FIRST_NUMBERS = 4096, 2**14
"""Largest number of steps of the first C call, times positions: few saved states must not delay Ctrl-C."""
STEPS_PER_CALL, MOST_UNTIMED = 10**5, 2**10
"""Largest number of steps per call into C, between checks for Ctrl-C, and of coordinates of which it is not timed."""
LARGEST_STEP, MOST_GRID_LEVEL, MOST_SUSPENDED = 2**53, 2**16, 64
"""Largest number of steps that a double represents; a bound of step-size levels beyond all exponents of a double; that
of ``suspension.h``."""
RANGES = {
    **dict.fromkeys(
        ("step", "iterations", "rejected", "fallback_steps", "steps_to_compare", "many", "suspended"), (0, LARGEST_STEP)
    ),
    "guess": (1 - 2 * MOST_SUSPENDED, 2),
    "turn": (0, 2),
    **dict.fromkeys(
        ("grid_level", "change", "change_before", "direction", "failed"), (-MOST_GRID_LEVEL, MOST_GRID_LEVEL)
    ),
    "avoiding": (-MOST_GRID_LEVEL, LARGEST_STEP),
}
"""Smallest and largest values of whole numbers in the memory of a run, which C uses as counts and indices."""
STEPS_NEAR_REST = 16
"""Number of steps in which a force moves a state away from rest."""
EVENT_NUMBERS = ("undefined", "inseparable", "accumulated", "through", "jammed", "sliding", "chatters")
"""Numbers of events, from 1 on, in the state of the search for events; 0 for none, < 0 for an undefined change."""
NO_PLAN = Fixed(math.nan)
"""Plan of a run that was not started."""

Called = TypeVar("Called", bound=Callable[..., Any])


def in_use() -> StateError:
    """Return the error for a second thread."""
    return StateError(
        "this run is in use by another thread: only one thread may use a run at a time. Start a run for each thread "
        "(stepper.start(...), copy.copy(run)); the stepper may be shared"
    )


def alone(method: Called) -> Called:
    """Decorate a method to lock its run; the method raises as :meth:`Memory.alone`."""

    @functools.wraps(method)
    def locked(self: Any, *arguments: Any, **keywords: Any) -> Any:
        lock = self._lock
        if not lock.acquire(False):
            raise in_use()
        try:
            return method(self, *arguments, **keywords)
        finally:
            lock.release()

    return cast(Called, locked)


class Memory:
    """State of a run: positions, momenta, compensation terms and the predictor for the next step.

    Attributes:
        stepper: the compiled integrator.
        longest: largest difference of t between consecutive saved states so far.

    Steps of a system with inputs require every input to be set, by :meth:`set_inputs` or parameters. The arguments of
    C calls are allocated once per run, so a call costs little more than its steps.
    """

    def __init__(self, stepper: Integrator) -> None:
        self._lock = threading.RLock()  # re-entrant: callbacks in the owning thread may call methods
        self.stepper, binding = stepper, stepper.binding
        self._memory = memory = binding.new("run *")
        self._q, self._p = map(binding.vector, (memory.q, memory.p))
        values = self._parameters = stepper.defaults
        if stepper.interface.words > 1:
            carries = (binding.vector(carry)[: stepper.dimension] for carry in (memory.carry_q, memory.carry_p))
            self._q, self._p = (with_low(high, low) for high, low in zip((self._q, self._p), carries, strict=True))
            values = np.concatenate([values, np.zeros(len(values))])
            self._parameters = stepper._states.numbers(values)
        self._longest_first = max(FIRST_STEPS, min(LONGEST_FIRST, FIRST_NUMBERS // len(self._q)))
        self._first_saved = min(MOST_FIRST, self._longest_first)
        self._arguments = binding.pointer(values), binding.null
        self._control = binding.null  # of steps in C that are not fixed
        self._control_data: Sequence[Any] = ()  # that it refers to
        self._options: SolverOptions | None = None
        self._has_defaults = False  # whether no parameter differs from its default
        self._watch: Any = None  # state of the search for events in C
        self._noise = DEFAULT_NOISE
        self._takes_noise = stepper.interface.temperature is not None
        self._rows: Any = None  # memory for the states of short runs
        self._starts_at_origin = False
        self._ends: tuple[float, float] | None = None  # energies at both ends of a short run
        self._has_tau = stepper.in_tau  # whether steps are steps of tau
        self._report, self._workspace = binding.new("report *"), binding.workspace(memory)
        self._calls: tuple[Any, ...] = ()
        self._call = self._new_call(*(binding.null,) * 4)  # no arrays: no states are stored
        self._take = binding.call("advance", self._call)  # function of numbers of steps and of those between states
        self._untimed = len(self._q) <= MOST_UNTIMED  # whether ``advance`` takes steps without looking at the clock
        self._chunk = 1  # steps of the next C call otherwise
        self._start_function = binding.function("start", memory)
        self._step_error = None
        if binding.has("step_error") and not stepper.by_steps:
            self._step_error = binding.function("step_error", memory)
        self._plan: StepPlan = NO_PLAN
        self._h = cast("float | None", NO_PLAN.h)  # fixed step size; None for other steps
        self.longest, self._can_measure_growth = 0.0, hasattr(memory, "measures_growth")
        self._sums_action = hasattr(memory, "actions")
        firsts = {name: stepper.interface.parameter_index(f"{name}_0") for name in stepper.interface.inputs}
        self._inputs = {name: slice(first, first + 5) for name, first in firsts.items()}
        self._ranges = {name: limits for name, *limits in stepper.interface.input_ranges}

    def _new_call(self, t: Any, q: Any, p: Any, iterations: Any) -> Any:
        """Return the arguments of C calls that store states in this memory."""
        call = self.stepper.binding.new("call *")
        call.run, (call.parameters, call.options) = self._memory, self._arguments
        call.t, call.q, call.p, call.iterations = t, q, p, iterations
        call.report, call.workspace = self._report, self._workspace
        call.words = self.stepper.interface.words
        call.coordinates = call.words * len(self._q)
        self._calls = *self._calls, call
        return call

    @classmethod
    def started(cls, stepper: Integrator, q: States, p: States, **arguments: Any) -> Self:
        """Construct at (q, p) before the first step; arguments as of :meth:`_start`."""
        run = cls(stepper)
        run._start(q, p, **arguments)
        return run

    def _start(
        self,
        q: States,
        p: States,
        *,
        plan: StepPlan,
        t: float = 0.0,
        parameters: Parameters = None,
        options: SolverOptions | None = None,
        noise: Noise = DEFAULT_NOISE,
    ) -> None:
        """Start at (q, p) and t; nothing of an earlier run remains."""
        self._noise = noise
        initial = Initial(q, p, None, self.stepper._states.time(t), parameters, options)
        self._set_up(plan, initial)
        self._begin(q, p, initial.t)

    def _begin(self, q: States, p: States, t: float, *, growth: bool = False) -> None:
        """Start at (q, p) and t after :meth:`_set_up`; ``growth``: whether the run carries its error."""
        check_max_step(self._plan, t, self.stepper.interface.words)
        states = self.stepper._states
        q, p = map(states.block, states.pair(q, p))
        self._starts_at_origin = not (np.any(q) or np.any(p))
        self._start_function(t, 0.0 if self._h is None else self._h, *self.stepper.binding.pointers(q, p))
        if isinstance(t, Word):
            self._memory.t_low = t.low
        if growth and self._can_measure_growth:
            self._memory.measures_growth = growth
        if self.stepper.interface.temperature is not None:
            check_strengths(self.stepper, t, self._h, self._parameters, self._q)
            self._noise.store(self._memory)

    def _set_up(self, plan: StepPlan, initial: Initial) -> None:
        """Set what holds for all steps of a run; momenta are required in transformed time only."""
        q, p, _, _, parameters, options = initial
        if parameters is not None or not self._has_defaults:
            stepper, interface = self.stepper, self.stepper.interface
            self._parameters[:] = stepper._parameters_at(q, p, parameters)
            self._check_masses()
            self._unset_inputs = inputs_not_given(interface, parameters)
            self._has_defaults = parameters is None and not stepper.in_tau
        if plan is not self._plan:
            self.plan = plan
        if options is not self._options:
            self._set_options(options)
        self.longest, self._watch, self._ends = 0.0, None, None

    def _set_options(self, options: SolverOptions | None) -> None:
        self._arguments = self._arguments[0], self.stepper.binding.options(checked_options(options))
        for call in self._calls:
            call.options = self._arguments[1]
        self._options = options

    @classmethod
    def restored(
        cls,
        stepper: Integrator,
        saved: bytes,
        *,
        parameters: Parameters = None,
        options: SolverOptions | None = None,
        plan: StepPlan | None = None,
    ) -> Self:
        """Construct from :attr:`snapshot`; raise ``StateError`` for invalid bytes or another kind of steps."""
        run = cls(stepper)
        memory = run._memory
        run.rollback(saved)
        vectors = map(stepper.binding.vector, (memory.q, memory.p, memory.carry_q, memory.carry_p))
        if not np.isfinite(np.concatenate([[memory.t, memory.h], *vectors])).all():
            raise StateError(f"invalid saved run: its state is not finite, h = {memory.h:g}")
        count = len(stepper.searched)
        searched = {**dict.fromkeys(EVENT_NUMBERS, (0, count)), "undefined": (-count, count)}
        owned = (memory, RANGES), (run._watch, searched)
        numbers = [(owner, *allowed) for owner, ranges in owned for allowed in ranges.items()]
        for owner, name, (least, most) in numbers:
            if not least <= (value := getattr(owner, name, least)) <= most:
                raise StateError(f"invalid saved run: {name} is {value}, not a whole number from {least} to {most}")
        if plan is None and memory.h == 0.0:
            raise StateError("the saved run has adaptive steps: give t_end")
        plan = Fixed(memory.h) if plan is None else plan
        if (plan.h if isinstance(plan, FixedSteps) else 0.0) != memory.h:
            raise StateError("the saved run has fixed steps: omit t_end")
        if not stepper._has_energy(parameters):
            raise StateError("a saved run in transformed time requires its energy: give parameters=run.parameters")
        check_max_step(plan, memory.t, stepper.interface.words)
        run._parameters[:], run._has_defaults = stepper._parameters(parameters), False
        run.plan = plan
        run._set_options(options)
        run._unset_inputs = inputs_not_given(stepper.interface, parameters)
        return run

    @property
    def plan(self) -> StepPlan:
        """Step sizes and target time."""
        return self._plan

    @plan.setter
    def plan(self, plan: StepPlan) -> None:
        if not (isinstance(plan, FixedSteps) or self.stepper._has_error_estimate):
            require(self.stepper, "adaptive")
        self._control, *self._control_data = step_control(self.stepper, plan)
        self._plan, self._h = plan, plan.h if isinstance(plan, FixedSteps) else None
        self._has_tau = isinstance(plan, InTau) or self.stepper.in_tau
        for call in self._calls:
            call.control = self._control
            if isinstance(plan, FixedSteps):
                call.h = plan.h
            else:
                call.t_end = plan.t_end

    @property
    def h(self) -> float | None:
        """Step size; ``None`` for adaptive steps and steps of tau."""
        return None if self._h is None else float(self._memory.h)

    @property
    def _step_size(self) -> float:
        """Size of the next one of fixed steps; in C 0 for others."""
        return float(self._memory.h)

    @property
    def parameters(self) -> Array:
        """(k,) values in the order of ``stepper.parameters``, with those that events have set."""
        return self._with_set_by_events(self._parameters.copy())

    def _with_set_by_events(self, values: Array) -> Array:
        """Put the parameters that events have set among the values of all."""
        own = len(self.stepper.modes) - len(self.stepper.interface.mode_names)  # modes of contacts and kinks follow
        if own and self._watch is not None and self._watch.begun:
            values[self.stepper.mode_columns[:own]] = list(self._watch.mode)[:own]
        return values

    @property
    def _parameters_in_modes(self) -> Array:
        """(k,) values of the present step, with those that events have set and the modes of contacts and kinks."""
        values, modes = self._parameters.copy(), self.stepper.modes
        if modes and self._watch is not None and self._watch.begun:
            values[self.stepper.mode_columns] = list(self._watch.mode)[: len(modes)]
        return values

    @property
    def options(self) -> SolverOptions | None:
        """Convergence criterion of the solver; ``None`` for the defaults."""
        return self._options

    @property
    def t(self) -> float:
        """Time, the rounded compensated sum of all steps; both words in double-double arithmetic."""
        t = float(self._memory.t)
        return t if self.stepper.interface.words == 1 else word(t, self._memory.t_low)

    @property
    def _times(self) -> Array:
        """(1,) time, with its low word in double-double arithmetic."""
        return stacked([self.t])

    @property
    def _exact_time(self) -> Fraction:
        return Fraction(self.t) + Fraction(float(getattr(self._memory, "t_low", 0.0)))

    def _step_to(self, end: float | Fraction) -> None:
        """Let the next step, in double-double arithmetic, end at a time: its size has two words as well."""
        self._set_step(Fraction(end) - self._exact_time)

    def _set_step(self, size: Fraction) -> None:
        """Set the size of the next step, in double-double arithmetic."""
        self._memory.h = float(size)
        self._memory.h_low = float(size - Fraction(self._memory.h))

    def left_to(self, end: float) -> float:
        """Return the time left to ``end``, computed with the low word of the run's time."""
        return (end - float(self.t)) - float(getattr(self._memory, "t_low", 0.0))

    @alone
    def update(self, *, parameters: Parameters = None, h: float | None = None, plan: StepPlan | None = None) -> None:
        """Set parameters, step size or step plan; what is omitted is unchanged.

        Args:
            parameters: values by name, the others unchanged; or all in order.

        Raises:
            StateError: if a name or number is invalid, or position constraints would jump.
        """
        interface = self.stepper.interface
        if plan is not None:
            check_max_step(plan, self.t, interface.words)
        missing = inputs_not_given(interface, parameters)
        if parameters is not None:
            self._set_parameters(self.stepper._parameters(parameters, self.parameters))
            self._unset_inputs = tuple(name for name in self._unset_inputs if name in missing)
        if h is not None and checked_step(h) != self._memory.h:
            self.plan = Fixed(checked_step(h))
            self._memory.h, self._memory.guess = h, 0
            if self.stepper.interface.words > 1:
                self._memory.h_low = 0.0
        if plan is not None:
            self.plan = plan

    @alone
    def set_inputs(self, **inputs: Any) -> None:
        """Set inputs to constant numbers for the following steps (zero-order hold), clamped to their ranges.

        >>> run.set_inputs(u=-1.5); run.advance(10)  # doctest: +SKIP
        """
        values = self._parameters.copy()
        for name, value in inputs.items():
            if name not in self._inputs:
                raise no_input(name, self._inputs)
            high, low = self.stepper._states.number(value, f"the input {name}")
            if name in self._ranges and not self._ranges[name][0] <= high <= self._ranges[name][1]:
                high, low = min(max(high, self._ranges[name][0]), self._ranges[name][1]), 0.0
            np.asarray(values)[self._inputs[name]] = high, 0.0, 0.0, 0.0, 0.0
            if isinstance(values, Words):
                values.low[self._inputs[name]] = low, 0.0, 0.0, 0.0, 0.0
        self._set_parameters(values)
        if self._unset_inputs:
            self._unset_inputs = tuple(name for name in self._unset_inputs if name not in inputs)

    def _set_parameters(self, values: Array) -> None:
        """Set parameter values; raise ``StateError`` if position constraints jump."""
        if self.stepper.interface.constraints:
            check_reachable(self.stepper, self.q, self.p, self.t, values)
        if self.stepper.modes and self._watch is not None:
            self._watch.begun = 0  # forces may jump: the modes follow from the state
        self._parameters[:] = values
        self._has_defaults = False
        if self.stepper.interface.solver == "explicit":
            self._memory.guess = 0  # the last force is that of the former parameters
        self._check_masses()

    def _check_masses(self) -> None:
        """Raise ``StateError`` if a coordinate has no positive mass; of known sizes the steps fail."""
        binding = self.stepper.binding
        if not binding.has("data_at") or binding.function("data_at")(self._arguments[0], self._workspace):
            return
        inverse = binding.vector(self._memory.inverse_mass)
        index = int(np.argmin(np.where((inverse > 0.0) & np.isfinite(inverse), 1.0, -1.0)))
        raise StateError(
            f"coordinate {index} of {len(inverse)} has no positive mass: add its kinetic energy to L, or check the "
            "parameters"
        )

    @property
    def steps(self) -> int:
        """Number of completed steps."""
        return int(self._memory.step)

    @property
    def q(self) -> Array:
        """(m,) positions; arrays by name, ``q["u"]``."""
        return self.stepper.named(self._q.copy())

    @property
    def p(self) -> Array:
        """(m,) momenta; arrays by name, ``p["u"]``."""
        return self.stepper.named(self._p.copy())

    @property
    def _compensation(self) -> tuple[Array, Array]:
        """(m,) compensation terms of :attr:`q` and of :attr:`p`, added in the following steps."""
        vector, memory = self.stepper.binding.vector, self._memory
        return self.stepper.named(vector(memory.carry_q).copy()), self.stepper.named(vector(memory.carry_p).copy())

    @alone
    def _resume_at(
        self, steps: int, time: tuple[float, float], carries: tuple[Array, Array], unknowns: Array | None = None
    ) -> None:
        """Continue a run made elsewhere: set its step number, double-double time and compensation terms of q and p.

        With the unknowns of the last step the next one is predicted by them.
        """
        self._memory.step = steps
        self._memory.t, self._memory.t_low = time
        for i, (cut_q, cut_p) in enumerate(zip(*map(np.ravel, carries), strict=True)):
            self._memory.carry_q[i], self._memory.carry_p[i] = cut_q, cut_p
        if unknowns is not None:
            self._memory.guess = 1
            for i in range(len(self._memory.memory)):
                self._memory.memory[i] = unknowns[i]

    @property
    def snapshot(self) -> bytes:
        """Bitwise copy of the present state for :meth:`rollback`."""
        buffer = self.stepper.binding.buffer
        return bytes(buffer(self._memory)) + (b"" if self._watch is None else bytes(buffer(self._watch)))

    @alone
    def checkpoint(self) -> bytes:
        """Return a bitwise copy of the run for :meth:`Stepper.from_checkpoint` on the same kind of machine."""
        return checkpoint(self)

    def check_inputs(self) -> None:
        """Raise :class:`StateError` if an input is not set."""
        if self._unset_inputs:
            raise missing_input(self._unset_inputs[0])

    @alone
    def rollback(self, saved: bytes) -> None:
        """Restore the state of :attr:`snapshot`; raise ``StateError`` for bytes of another length."""
        binding, stepper = self.stepper.binding, cast(Any, self.stepper)
        buffer = binding.buffer(self._memory)
        watch = None
        if stepper.searched and len(saved) > len(buffer):
            watch = (binding if stepper.interface.words == 1 else stepper._in_double.binding).new("watch *")
        size = len(buffer) + (0 if watch is None else len(binding.buffer(watch)))
        if len(saved) != size:
            raise StateError(f"invalid saved run: it has {len(saved)} bytes, those of this stepper have {size}")
        buffer[:], self._watch = saved[: len(buffer)], watch
        if self._sums_action:
            self._memory.actions = binding.null
        if watch is not None:
            binding.buffer(watch)[:] = saved[len(buffer) :]

    def advance(
        self, steps: int, *, progress: Callable[[int], None] | None = None, stop: Callable[[], bool] | None = None
    ) -> None:
        """Take ``steps`` steps; adaptive steps end at the target time.

        Args:
            steps: number of steps.
            progress: called after each chunk with the number of steps of the run.
            stop: called as often; the run ends early if it returns true.

        Raises:
            StepFailedError: if a step fails; the run is left at the state before it.
        """
        left = steps if type(steps) is int and 0 <= steps <= STEPS_PER_CALL else checked_count(steps, "steps", least=0)
        if not self._lock.acquire(False):  # as ``alone``, at half the cost
            raise in_use()
        try:
            if progress is None and stop is None and self._untimed:
                fixed = self._h is not None
                while left > 0 and (fixed or not self.arrived):
                    size = left if left < STEPS_PER_CALL else STEPS_PER_CALL
                    if self._unset_inputs:
                        self.check_inputs()
                    if status := self._take(size, 1):
                        raise self._failure(status)
                    left -= size if fixed else self._report.steps
            else:
                self._advance_timed(left, progress and (lambda _: progress(self.steps)), stop or (lambda: False))
        finally:
            self._lock.release()

    def _advance_timed(self, steps: int, progress: Callable[[int], None] | None, stop: Callable[[], bool]) -> None:
        """Advance as :meth:`advance` in C calls of bounded duration."""
        first, ended = self._chunk, lambda: self.arrived or stop()
        self._chunk = drive(self._taken, steps, first=first, ended=ended, progress=progress)

    def _failure(self, status: int) -> StepFailedError:
        remark, stepper, here = "", self.stepper, (self._parameters, self._q)
        if stepper.interface.temperature is not None:
            ends = (self.t, self.t + self._step_size)
            remark = next((f". Cause: {cause}" for t in ends if (cause := negative_strength(stepper, t, *here))), "")
            remark = remark or remark_on_strengths(stepper, self.t, *here)
        remark = remark or singular_position(stepper, self._q, self.t, self._parameters)
        failures = stepper._failures_from(self.q, self.p, self.t, self._parameters)
        return step_failure(status, self._report, step=self.steps, h=self._step_size, remark=remark, failures=failures)

    def _taken(self, steps: int) -> int:
        if self._unset_inputs and steps:
            self.check_inputs()
        if status := self._take(steps, 1):
            raise self._failure(status)
        taken: int = self._report.steps
        return taken

    def _fill(self, steps: int) -> tuple[Array, Array, Array]:
        """Take steps in one C call; return the times and the states after each."""
        binding, words = self.stepper.binding, self.stepper.interface.words
        t, q, p = (np.empty((steps, words * count)) for count in (1, len(self._q), len(self._p)))
        iterations = binding.pointer(np.empty(steps, dtype=np.int32))
        if status := self._advance(steps, 1, (*map(binding.pointer, (t, q, p)), iterations)):
            raise self._failure(status)
        states = self.stepper._states
        return states.times(t), states.numbers(q), states.numbers(p)

    def _run_to_target(self) -> None:
        """Advance to the target time without saving intermediate states."""
        self.advance(LARGEST_COUNT)

    def _advance(self, steps: int, save_every: int, output_arrays: tuple[Any, ...]) -> int:
        """Take steps in one C call; every ``save_every``-th state goes to ``output_arrays``. Return the status."""
        if self._unset_inputs and steps:
            self.check_inputs()
        call = self._call
        call.t, call.q, call.p, call.iterations, *actions = output_arrays
        if actions:
            (self._memory.actions,) = actions
        try:
            return self._take(steps, save_every)
        finally:
            call.t = call.q = call.p = call.iterations = self.stepper.binding.null
            if actions:
                self._memory.actions = self.stepper.binding.null

    @property
    def iterations(self) -> int:
        """Number of solver iterations since the last saved state."""
        return int(self._memory.iterations)

    @iterations.setter
    def iterations(self, count: int) -> None:
        self._memory.iterations = count

    @property
    def arrived(self) -> bool:
        """Return whether the run has reached its target time."""
        return not isinstance(self._plan, FixedSteps) and self.left_to(self._plan.t_end) == 0.0

    @property
    def ended(self) -> bool:
        """Return whether a terminal event ended the run."""
        return self._watch is not None and bool(self._watch.ended)

    @property
    def rejected_steps(self) -> int:
        """Number of rejected steps."""
        return int(self._memory.rejected) if isinstance(self._plan, Adaptive) else 0

    @property
    def fallback_steps(self) -> int:
        """Number of steps that the iteration did not solve, but its fallback, Newton's method.

        Where they are many, a smaller fixed step or ``solver="newton"`` is faster. Arrays of run-time sizes have no
        fallback.
        """
        return int(getattr(self._memory, "fallback_steps", 0))

    @property
    def step_error(self) -> float:
        """Estimated relative error of the worst step; NaN without an estimate."""
        if self._step_error is None:
            return math.nan
        error: float = self._step_error()
        return error if error >= 0.0 else math.nan

    @property
    def worst_step_time(self) -> float:
        """Start time of the worst step; NaN without an error estimate."""
        return float(self._memory.error_t) if self.step_error >= 0.0 else np.nan

    def _end_energies(self, t: Array, q: Array, p: Array) -> tuple[float, float] | None:
        """Return the energies of the first and the last state of a run so far; ``None`` outside the domain of L."""
        if self._ends is not None:
            return self._ends
        if self.stepper.interface.words > 1:
            try:
                energies = self.stepper._energies_of(t[[0, -1]], q[[0, -1]], p[[0, -1]], self._parameters)
            except StateError:
                return None
            return float(energies[0]), float(energies[1])
        binding, values = self.stepper.binding, []
        (start, positions, momenta), m = binding.pointers(t, q, p), len(self._q)
        function, energy = binding.function("energies"), binding.numbers("double *")
        for j, k in ((0, 0), (len(t) - 1, len(q) - 1)):  # observed runs have the states at both ends alone
            row = start + j, positions + k * m, momenta + k * m
            if function(1, *row, self._arguments[0], energy, self._workspace):
                return None
            values.append(energy[0])
        return values[0], values[1]

    @property
    def _growth(self) -> tuple[float, float, float, float] | None:
        """Largest error relative to the motion, the one that is reported, and the times until which it and 1e-2 hold.

        ``None`` if the run does not carry its error, or if its steps were too large for that.
        """
        memory = self._memory
        if not (self._can_measure_growth and memory.tangent_steps):
            return None
        return memory.growth, memory.growth_limit, memory.accurate_until, memory.meaningful_until

    @property
    def _leaving(self) -> bool:
        """Return whether the run started at the origin and is still near it, where relative errors are undefined."""
        return self._starts_at_origin and self.steps <= STEPS_NEAR_REST

    @contextmanager  # the last method, because it hides the decorator of its name
    def alone(self) -> Iterator[None]:
        """Lock the run for several calls.

        Raises:
            StateError: if another thread has locked it.
        """
        if not self._lock.acquire(blocking=False):
            raise in_use()
        try:
            yield
        finally:
            self._lock.release()
