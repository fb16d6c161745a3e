"""Event detection: the compiled search for zero crossings along the states of a trajectory."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.codegen.native.options import step_failure
from scvi_codegen.common.errors import EventError, EventWarning, StepFailedError, warn
from scvi_codegen.runs.events.contacts import (
    check_forward,
    modes_in_failure,
    refusal_of,
    undefined_friction,
    warn_of_choices,
)
from scvi_codegen.runs.results.saved_states import Array, ContactsBySteps, ModeHistory, SavedStates
from scvi_codegen.runs.stepping.integrator import Integrator
from scvi_codegen.runs.stepping.step_plan import Fixed
from scvi_codegen.systems.event import (
    ACCUMULATED,
    BEHIND,
    CHATTERS,
    CORNER,
    INSEPARABLE,
    JAMMED,
    PASSED,
    SLIDING,
    THROUGH,
    UNDEFINED,
    UNDEFINED_CHANGE,
    Crossings,
    Event,
    Kink,
    Switches,
    Transition,
)

if TYPE_CHECKING:
    from scvi_codegen.runs.stepping.memory import Memory

INITIAL_CAPACITY, LEAST_CAPACITY, CROSSING_NUMBERS = 256, 16, 2**24
"""Initial number of crossings that one call can return, doubled when exceeded; fewer of over 65,536 coordinates."""
MOST_BYTES = 2**30
"""Largest memory for the states of crossings of a run; if they exceed it, none is kept."""


class CrossingSearch:
    """Crossings of a stepper's events along consecutive parts of one run.

    Args:
        stepper: the stepper, with its events.
        watch: state of the search in an earlier part of the run, which has not ended; ``None`` starts anew.
        terminal: whether terminal events end the search.

    Attributes:
        ended: whether a terminal event occurred; ``last`` then contains its crossing.
        recorded: structured arrays (t, function, q, p), in the order of the run.
        changes: whether crossings change the state, so that the run must be advanced by :meth:`advance`.
    """

    def __init__(self, stepper: Integrator, watch: Any = None, *, terminal: bool = True) -> None:
        self.stepper, self.binding = stepper, stepper.binding
        self.recorded: list[NDArray[Any]] = []
        self.watch = self.binding.new("watch *") if watch is None else watch
        self.changes = terminal and stepper.divides_steps
        for number, event in enumerate(stepper.searched if watch is None else ()):
            self.watch.direction[number] = event.direction
            self.watch.acts[number] = terminal and event.changes_state
            self.watch.remaining[number] = terminal and int(event.terminal)
        if stepper.strict_energy:
            self.watch.steps.is_strict = 1
        self._bytes, self._buffers = 0, (None, [np.empty(0)])
        self._capacity = min(INITIAL_CAPACITY, max(LEAST_CAPACITY, CROSSING_NUMBERS // stepper.dimension))

    @property
    def ended(self) -> bool:
        """Return whether a terminal event occurred."""
        return bool(self.watch.ended)

    def search(self, part: SavedStates, first: int = 0) -> int:
        """Search between consecutive states of a trajectory; return the number of steps before the search ended.

        Args:
            part: the trajectory.
            first: index of its first state in the run, for messages.

        Raises:
            EventError: if an event function is not finite.
            StepFailedError: if a partial step fails.
        """
        h, t, q, p = map(np.ascontiguousarray, (part.step_sizes, part.t, part.q, part.p))
        parameters, options = self.binding.pointer(part.parameters), self.binding.options(part.options)
        workspace, report = self.binding.workspace(), self.binding.new("report *")
        done = 0
        while True:
            crossings, filled = self.binding.new(f"crossing[{self._capacity}]"), self.binding.numbers("long long *")
            rows = [self.binding.pointer(column[done:]) for column in (h, t, q, p)]
            to = self._capacity, crossings, filled, report, workspace
            status = self.binding.function("crossings")(self.watch, len(t) - done, *rows, parameters, options, *to)
            self._record(crossings, int(filled[0]))
            done += int(report.steps)
            if status:
                raise self._failure(status, report, first + done, float(h[done]))
            if self.ended:
                return done - 1
            if done == len(t) - 1:
                return done
            self._capacity *= 2

    def advance(
        self, run: Memory, size: int
    ) -> tuple[tuple[Array, Array, Array, NDArray[np.int32]], Array, NDArray[np.int64], Exception | None]:
        """Advance a run by at most ``size`` steps with events that change its state.

        Returns:
            The arrays t, q, p and iterations of the present state, of those at the ends of steps and of those after
            changes; the sizes of the steps that follow them; the numbers of the steps that end there, -1 within a step;
            and the failure that ended the run, or ``None``.
        """
        plan, binding, number = run._plan, self.binding, run.steps
        check_forward(run)
        most = 2 * size + self._capacity
        crossings, rows = self._buffers  # kept for later calls, as new memory of large states is slow
        if crossings is None or len(crossings) != self._capacity:
            crossings = binding.new(f"crossing[{self._capacity}]")
        if len(rows[0]) != most + 1:
            rows = [np.empty((most + 1, *shape)) for shape in ((), run._q.shape, run._p.shape, ())]
        self._buffers = crossings, rows
        rows[0][0], rows[1][0], rows[2][0] = run.t, run._q, run._p
        iterations, numbers = np.zeros(most + 1, np.int32), np.full(most + 1, number, np.int64)
        filled = binding.numbers("long long *")
        t_end = np.inf if isinstance(plan, Fixed) else plan.t_end
        arguments = self.watch, t_end, run._control, size, *run._arguments, most
        states = *(binding.pointer(column[1:]) for column in rows), binding.integers(iterations[1:])
        to = self._capacity, crossings, filled, run._report, run._workspace
        name = "advance_by_steps" if self.stepper.by_steps else "advance_with_changes"
        advance = binding.function(name, run._memory)
        status = advance(*arguments, *states, binding.whole_numbers(numbers[1:]), *to)
        self._record(crossings, int(filled[0]))
        report, count = run._report, int(run._report.stored) + 1
        failure = self._failure(status, report, number + int(report.steps), run._step_size) if status else None
        if isinstance(failure, StepFailedError):
            failure = undefined_friction(run, self.watch) or failure
        if not (failure or self.ended or report.steps == size or run.arrived):
            self._capacity *= 2  # too small for the crossings of a step
        t, q, p, lengths = (column[:count] for column in rows)
        sizes = np.append(lengths[1:], np.nan if run.h is None else run.h)
        return (t, q, p, iterations[:count]), sizes, numbers[:count], failure

    def _record(self, crossings: Any, count: int) -> None:
        """Record the first crossings of an array; discard all states if these would exceed ``MOST_BYTES``."""
        records = self.binding.records(crossings, count)
        if count:
            self.last = float(records["t"][-1]), records["q"][-1], records["p"][-1]
        before, self._bytes = self._bytes, self._bytes + records.nbytes
        self.recorded.append(records)
        if self._bytes > MOST_BYTES:
            kept = {"t", "function", "direction", "element", "acted", "mode"}
            names: Any = [name for name in records.dtype.names or () if name in kept]
            self.recorded = [
                records[names].copy() if records.dtype.names != (*names,) else records for records in self.recorded
            ]
        if before <= MOST_BYTES < self._bytes:
            warn(
                f"the states of crossings until t = {self.last[0]:.6g} exceed {MOST_BYTES / 2**30:g} GiB and are not "
                "kept: run.events has times and elements. Integrate in parts, or compute states with run.at(t)",
                EventWarning,
            )

    def _failure(self, status: int, report: Any, step: int, h: float) -> Exception:
        if refusal := refusal_of(self.stepper, self.watch, report.t):
            return refusal
        behind = getattr(self.watch, "behind", 0.0)
        through = BEHIND if behind < 0.0 else THROUGH
        undefined = UNDEFINED_CHANGE if getattr(self.watch, "undefined", 0) < 0 else UNDEFINED
        messages = {"undefined": undefined, "accumulated": ACCUMULATED, "through": through, "jammed": JAMMED}
        messages |= {"sliding": SLIDING, "chatters": CHATTERS, "inseparable": INSEPARABLE}
        for name, message in messages.items():
            number = getattr(self.watch, name, 0)
            if number and not (name == "accumulated" and self.ended):
                event = self.stepper.searched[abs(number) - 1]
                message = PASSED if message is THROUGH and isinstance(event, Kink | Transition) else message
                message = CORNER if message is SLIDING and self._is_of_positions(event) else message
                modes = zip(self.stepper.modes, getattr(self.watch, "mode", ()), strict=False)
                changed = next((f"parameter '{mode}'" for mode, value in modes if not math.isfinite(value)), "state")
                recent = self.watch.recent if name == "chatters" else [of is event for of in self.stepper.searched]
                titles = [of.title for of, count in zip(self.stepper.searched, recent, strict=True) if count]
                texts = {"function": " and ".join(titles[:3]), "changed": changed, "lacks": getattr(event, "lacks", "")}
                t = self.watch.end if name == "chatters" else report.t
                return EventError(message.format(**texts, t=t, g=behind))
        remark = modes_in_failure(self.stepper, self.watch)
        return step_failure(status, report, step=step, h=h, remark=remark, failures=self.binding.failures)

    def _is_of_positions(self, event: Any) -> bool:
        """Return whether neither velocities nor momenta occur in the function of an event."""
        rates = {*(f"{name}_dot" for name in self.stepper.coordinates), *self.stepper.interface.momentum_names}
        return rates.isdisjoint(re.findall(r"\w+", str(event.function)))

    def warn_of_accumulation(self) -> None:
        """Issue a :class:`EventWarning` if the run ended where crossings accumulate, and for choices of contacts."""
        warn_of_choices(self.stepper, self.watch)
        if self.changes and self.watch.accumulated:
            title, t = self.stepper.searched[self.watch.accumulated - 1].title, self.last[0]
            warn(
                f"the crossings of {title} accumulate at t = {self.watch.end:.17g} (infinitely many impacts in "
                f"finite time): the run ended at t = {t:.17g}. Continue with a constraint, or ignore this warning",
                EventWarning,
            )

    def crossings(self) -> tuple[Crossings, ...]:
        """Return the crossings by event."""
        return self._by_event(self.stepper.events, self._joined(self.recorded))

    def transitions(self, recorded: Sequence[NDArray[Any]]) -> tuple[Switches, ...]:
        """Return the transitions of contacts, and the changes of the side of each kink, among some of the records."""
        kinks = len(self.stepper.searched) - len(self.stepper.events)
        if not kinks or self.stepper.by_steps:  # whose changes of modes have no functions
            return ()
        records = self._joined(recorded)
        records = records[records["direction"] != 0]  # without touches, which keep their side
        crossings = self._by_event(self.stepper.searched, records)[-kinks:]
        numbers = range(len(self.stepper.searched) - kinks, len(self.stepper.searched))
        sides = [records["direction"][records["function"] == number].astype(np.int64) for number in numbers]
        return tuple(
            Switches(event=of.event, t=of.t, q=of.q, p=of.p, element=of.element, side=side)
            for of, side in zip(crossings, sides, strict=True)
        )

    def modes(self, recorded: Sequence[NDArray[Any]]) -> ModeHistory | None:
        """Return the modes of contacts and kinks along some of the records, the last of which are the latest."""
        if not (self.changes and self.stepper.modes):
            return None
        records = self._joined(recorded)
        records = records[records["acted"] != 0]
        latest = np.array(list(self.watch.mode))
        values = np.concatenate([records["mode"], latest[np.newaxis]])
        ambiguous, missed = (getattr(self.watch, name, 0) for name in ("ambiguous", "missed"))
        steps = self.watch.steps if self.stepper.by_steps else None
        by_steps = steps and ContactsBySteps(steps.residual, steps.compliance, steps.lost_energy)
        return ModeHistory(records["t"], values, bool(ambiguous), float(missed), by_steps)

    def _joined(self, recorded: Sequence[NDArray[Any]]) -> Any:
        none = self.binding.records(self.binding.new("crossing[1]"), 0)
        return np.concatenate(recorded) if len(recorded) > 1 else [*recorded, none][0]

    def _by_event(self, events: Sequence[Event], records: Any) -> tuple[Crossings, ...]:
        named, crossings = self.stepper.named, []
        for number, event in enumerate(events):
            mine, names = records["function"] == number, records.dtype.names
            values = {name: records[name][mine] for name in ("t", "q", "p", "element") if name in names}
            unknown = np.broadcast_to(np.nan, (len(values["t"]), self.stepper.dimension))
            values |= {name: named(values.get(name, unknown)) for name in "qp"}
            values.setdefault("element", np.zeros(len(unknown), np.int64))
            crossings.append(Crossings(event=event, **values))
        return tuple(crossings)
