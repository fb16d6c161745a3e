"""Checks of runs with a time transformation or with adaptive step size, beyond those of their single steps."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.exact.motion import ExactMotion, exact_motion, numbers
from scvi_codegen.formulas.tape import Tape
from scvi_codegen.mechanics.monitors import monitor_function
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.runtime.stepper import Stepper
from scvi_codegen.runtime.trajectory import Trajectory
from scvi_codegen.tables.precision import mp
from scvi_codegen.verification.certificate import Check, Finding, checked
from scvi_codegen.verification.structure import ROUNDINGS, momentum_kept
from scvi_codegen.verification.subject import EPSILON, State, Subject

__all__ = ["Pace", "of_one_pace", "pace_checks"]

Array = NDArray[np.float64]

SHORTER = 8
"""Ratio of the test's step size to the one at which times are measured, where the error is near round-off."""
AS_NEAR = 100.0
"""Largest ratio of the error in t to that in tau: the quadrature of dt = g dtau has an error of the same order."""
THERE_AND_BACK, SPAN = 20, 40
"""Steps of tau there and back; length of adaptive runs in steps of the fixed size."""
CUT = (2, 0.6)
"""Target time in steps: two whole steps and part of a third."""
LOOKED_AT = 7
"""Number of steps of a run that are checked."""
LONGER = 4
"""Ratio of the step size of a run with a time-rescaling function to the fixed step size."""
NEARER = 2.5
"""Least ratio by which halving tau reduces the deviation of the step sizes from tau g."""
SOLVED_TO = 1 / 256
"""Residual of the stage equations of adaptive steps relative to the tolerance."""


@dataclass(frozen=True)
class Pace:
    """Runs with variable step sizes, and the fixed steps to compare with.

    Attributes:
        subject: fixed steps; for a time transformation those of the transformed system as an ordinary system in tau.
        stepper: stepper of the runs: with a time transformation, a time-rescaling function or adaptive step size.
        system: system in time t.
        transformed: system in the time of the stepper.
        tolerance: relative local error of adaptive steps; 0 for round-off.
    """

    subject: Subject
    stepper: Stepper
    system: MechanicalSystem
    transformed: MechanicalSystem
    tolerance: float | None

    @cached_property
    def parameters(self) -> dict[str, float]:
        """Parameters without the energy of the time transformation, which depends on the state."""
        own = {parameter.name for parameter in self.system.parameters}
        return {name: value for name, value in self.subject.parameters.items() if name in own}

    def at_level(self, state: State) -> dict[str, float]:
        """Return the parameters with the energy of a state."""
        level = self.stepper.energy(state.q, state.p, state.t, self.parameters)
        return {**self.parameters, self.stepper.interface.energy_parameter: level}

    @property
    def tau(self) -> float:
        """Step size with a time-rescaling function: so large that errors exceed round-off."""
        return LONGER * self.subject.states[0].h

    @property
    def unsolved(self) -> float:
        """Residual of the stage equations beyond round-off, relative to the state."""
        return SOLVED_TO * (self.tolerance or 0.0)

    @cached_property
    def motion(self) -> ExactMotion:
        """Exact motion in t."""
        return exact_motion(self.system.with_parameters(**self.parameters))

    @cached_property
    def motion_in_tau(self) -> ExactMotion:
        """Exact motion in tau, at the energy of the first state."""
        return exact_motion(self.subject.system.with_parameters(**self.at_level(self.subject.states[0])))

    def run(self, **how: Any) -> Trajectory:
        """Integrate from the first state of the subject."""
        first = self.subject.states[0]
        found: Trajectory = self.stepper.integrate(first.q, first.p, t=first.t, parameters=self.parameters, **how)
        return found

    def distance(self, motion: ExactMotion, start: State, span: Any, end: Array) -> float:
        """Return the distance of a state from the exact motion, in units of the sizes of q and p."""
        there = np.concatenate(motion.flow(start.q, start.p, span, start.t))
        return float(np.max(np.abs(there - numbers(end)).astype(float) / self.subject.scales(start)))

    def rounding(self, state: State) -> float:
        """Return the largest rounding error of a step, in the same units."""
        return float(np.max(self.subject.rounding(state) / self.subject.scales(state)))


def of_one_pace(system: MechanicalSystem, energy: float) -> MechanicalSystem:
    """Return the transformed system at an energy as an ordinary system in tau; other systems unchanged."""
    if system.clock is None:
        return system
    return replace(system, clock=None).with_parameters(**{system.clock.energy.name: energy})


def pace_checks(pace: Pace) -> Iterator[Check]:
    """Yield all checks of this module."""
    for name, promise, measure in _clock(pace) if pace.stepper.interface.energy_parameter else _lengths(pace):
        yield from checked(name, promise, partial(measure, pace))


def _clock(pace: Pace) -> Iterator[tuple[str, str, Any]]:
    yield "steps of tau", "they equal steps of the transformed system at the energy of their state", _at_their_energy
    yield "time", "the error in t is of the size of the error in tau (60 digits)", _in_time
    yield "final time", "a run to t_end ends at t_end with an error of that size (60 digits)", _at_its_end
    if pace.subject.method.symmetric:
        yield "reversal in tau", f"{THERE_AND_BACK} steps of h and of -h return to time and state", _there_and_back


def _lengths(pace: Pace) -> Iterator[tuple[str, str, Any]]:
    yield "adaptive steps", "each equals a single step of the same size", _of_that_length
    if pace.stepper.interface.monitor:
        yield "step density", "halving tau reduces the deviation from dt = g dtau at least 2.5-fold", _by_the_monitor
        if pace.subject.method.symmetric:
            yield "reversal of adaptive steps", "a run backward from its end returns to its start", _turned
    else:
        yield "local error", "the median over adaptive steps is below the tolerance (60 digits)", _within_tolerance
    described = pace.stepper.interface
    for k, name in enumerate(described.map_names):
        if pace.subject.method.symplectic and described.map_exact[k]:
            yield f"{name}, adaptive steps", "conserved at variable step size", partial(_conserved, k)


def _at_their_energy(pace: Pace) -> Finding:
    worst = 0.0
    for _, state, rounding in pace.subject.roundings():
        found = pace.stepper.step(state.q, state.p, state.h, state.t, pace.parameters)
        expected = pace.subject.stepper.step(state.q, state.p, state.h, state.t, pace.at_level(state))
        worst = max(worst, float(np.max(np.abs(np.concatenate(found) - np.concatenate(expected)) / rounding)))
    return Finding(worst, ROUNDINGS, "in units of rounding, 2 states")


def _in_time(pace: Pace) -> Finding:
    start = _shorter(pace)
    run = pace.run(h=start.h, steps=1)
    return _as_near(pace, start, 1, run.q[1], run.p[1], mp.mpf(float(run.t[1])) - mp.mpf(start.t))


def _at_its_end(pace: Pace) -> Finding:
    start, (whole, part) = _shorter(pace), CUT
    t = pace.run(h=start.h, steps=whole + 1).t
    end = float(t[whole] + part * (t[whole + 1] - t[whole]))
    run = pace.run(h=start.h, t_end=end)
    if run.t[-1] != end:
        return Finding(abs(run.t[-1] - end), 0.0, f"the run ends at t = {run.t[-1]!r}, not {end!r}")
    return _as_near(pace, start, whole + 1, run.q[-1], run.p[-1], mp.mpf(end) - mp.mpf(start.t))


def _shorter(pace: Pace) -> State:
    first = pace.subject.states[0]
    return replace(first, h=first.h / SHORTER)


def _as_near(pace: Pace, start: State, steps: int, q: Array, p: Array, span: Any) -> Finding:
    """Compare the state after a time ``span`` with the exact motion; the bound is the error of the steps in tau."""
    first = np.concatenate(pace.subject.stepper.step(start.q, start.p, start.h, start.t, pace.at_level(start)))
    error = pace.distance(pace.motion_in_tau, start, mp.mpf(start.h), first)
    bound = steps * (AS_NEAR * error + ROUNDINGS * pace.rounding(start))
    return Finding(pace.distance(pace.motion, start, span, np.concatenate([q, p])), bound, f"relative, h = {start.h:g}")


def _there_and_back(pace: Pace) -> Finding:
    first = pace.subject.states[0]
    how: dict[str, Any] = {"steps": THERE_AND_BACK, "save_every": THERE_AND_BACK, "parameters": pace.at_level(first)}
    there = pace.stepper.integrate(first.q, first.p, h=first.h, t=first.t, **how)
    back = pace.stepper.integrate(there.q[-1], there.p[-1], h=-first.h, t=float(there.t[-1]), **how)
    change = np.abs(np.concatenate([back.q[-1], back.p[-1]]) - first.z) / pace.subject.rounding(first)
    late = abs(float(back.t[-1]) - first.t) / (EPSILON * (abs(float(there.t[-1])) + abs(first.t)))
    return Finding(max(float(change.max()), late) / THERE_AND_BACK, ROUNDINGS, "in units of rounding per step")


def _chosen(pace: Pace, part: float = 1.0) -> Trajectory:
    first = pace.subject.states[0]
    end = first.t + SPAN * first.h
    if pace.stepper.interface.monitor:
        return pace.run(h=part * pace.tau, t_end=end)
    return pace.run(t_end=end, tolerance=pace.tolerance or None)


def _steps_of(pace: Pace) -> Iterator[tuple[State, Array]]:
    """Yield some steps of a run, including the first and the last: start with step size, and end."""
    run = _chosen(pace)
    for k in np.unique(np.linspace(0, len(run) - 2, LOOKED_AT).astype(int)):
        start = State(run.q[k], run.p[k], float(run.t[k]), float(run.t[k + 1] - run.t[k]))
        yield start, np.concatenate([run.q[k + 1], run.p[k + 1]])


def _of_that_length(pace: Pace) -> Finding:
    worst = 0.0
    for start, end in _steps_of(pace):
        unit = pace.subject.rounding(start) + pace.unsolved * pace.subject.scales(start)
        worst = max(worst, float(np.max(np.abs(pace.subject.ends(start) - end) / unit)))
    return Finding(worst, ROUNDINGS, f"in units of residual and rounding, {LOOKED_AT} steps")


def _by_the_monitor(pace: Pace) -> Finding:
    apart = [_apart_from_the_monitor(pace, _chosen(pace, part), part * pace.tau) for part in (1.0, 0.5)]
    remark = f"tau = {pace.tau:.3g}: deviation {apart[0]:.1e}, then {apart[1]:.1e}"
    return Finding(apart[0] / apart[1], NEARER, remark, at_least=True)


def _apart_from_the_monitor(pace: Pace, run: Trajectory, tau: float) -> float:
    """Return the largest relative deviation of the steps from tau (g_k + g_{k+1}) / 2."""
    system = pace.motion.system
    monitor = monitor_function(system, pace.stepper.interface.monitor, in_time=True)
    symbols = (*system.coordinates, *system.auxiliaries, system.time, *system.parameters)
    parameters = [mp.mpf(value) for value in system.defaults]
    tape, g = Tape([monitor], symbols), []
    for q, p, t in zip(run.q, run.p, run.t, strict=True):
        g += tape([*numbers(q), *numbers(p if system.auxiliaries else ()), mp.mpf(float(t)), *parameters])
    wanted = tau * (np.array(g[1:-1], dtype=float) + np.array(g[:-2], dtype=float)) / 2
    return float(np.max(np.abs(np.diff(run.t)[:-1] / wanted - 1)))


def _turned(pace: Pace) -> Finding:
    """Return the defect of a run restarted backward from its own saved step density."""
    first, end = pace.subject.states[0], float(_chosen(pace).t[-2])
    run = pace.stepper.start(first.q, first.p, h=pace.tau, t=first.t, t_end=end, parameters=pace.parameters)
    run.record()
    back = pace.stepper.from_checkpoint(run.checkpoint(), h=pace.tau, t_end=first.t, parameters=pace.parameters)
    back.record()
    change = np.abs(np.concatenate([back.q, back.p]) - first.z) / pace.subject.rounding(first)
    return Finding(float(change.max()) / run.steps, ROUNDINGS, f"in units of rounding per step, {run.steps} steps")


def _within_tolerance(pace: Pace) -> Finding:
    errors, rounding = [], 0.0
    for start, end in _steps_of(pace):
        errors.append(pace.distance(pace.motion, start, mp.mpf(start.h), end))
        rounding = max(rounding, ROUNDINGS * pace.rounding(start))
    remark = f"relative, {LOOKED_AT} steps, largest {max(errors):.1e}"
    return Finding(float(np.median(errors)), (pace.tolerance or EPSILON) + rounding, remark)


def _conserved(k: int, pace: Pace) -> Finding:
    run = _chosen(pace)
    found = momentum_kept(run, k)
    return found._replace(bound=found.bound + (len(run) - 1) * pace.unsolved)
