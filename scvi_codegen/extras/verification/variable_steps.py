"""Checks of runs with a time transformation or with adaptive step size, beyond those of their single steps."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from scvi_codegen.api.formulas import Tape, mp
from scvi_codegen.api.methods import Discretisation
from scvi_codegen.api.states import Array
from scvi_codegen.api.systems import MechanicalSystem
from scvi_codegen.extras.exact.solution import ExactMotion, exact_motion, numbers
from scvi_codegen.extras.verification.certificate import Check, Finding, checked
from scvi_codegen.extras.verification.structure import momentum_error
from scvi_codegen.extras.verification.system_under_test import (
    EPSILON,
    ROUNDINGS,
    SAMPLED,
    SHORT_RUN,
    STEP_DIVISOR,
    State,
    SystemUnderTest,
)
from scvi_codegen.runs.stepper import Stepper
from scvi_codegen.runs.trajectory import Trajectory

ERROR_RATIO = 100.0
"""Largest ratio of the error in t to that in tau: the quadrature of dt = g dtau has an error of the same order."""
CUT = (2, 0.6)
"""Target time in steps: two whole steps and part of a third."""
STEP_FACTOR = 4
"""Ratio of the step size of a run with a time-rescaling function to the fixed step size."""
LEAST_REDUCTION = 2.5
"""Least ratio by which halving tau reduces the deviation of the step sizes from tau g."""
RESIDUAL_RATIO = 1 / 256
"""Residual of the stage equations of adaptive steps relative to the tolerance."""


@dataclass(frozen=True)
class VariableSteps:
    """Runs with variable step sizes, and the fixed steps to compare with.

    Attributes:
        tested: fixed steps; for a time transformation those of the transformed system as an ordinary system in tau.
        stepper: stepper of the runs: with a time transformation, a time-rescaling function or adaptive step size.
        system: system in time t.
        transformed: system in the time of the stepper.
        tolerance: relative local error of adaptive steps; 0 for round-off.
    """

    tested: SystemUnderTest
    stepper: Stepper
    system: MechanicalSystem
    transformed: MechanicalSystem
    tolerance: float | None

    @cached_property
    def parameters(self) -> dict[str, float]:
        """Parameters without the energy of the time transformation, which depends on the state."""
        names = {parameter.name for parameter in self.system.parameters}
        return {name: value for name, value in self.tested.parameters.items() if name in names}

    def at_energy(self, state: State) -> dict[str, float]:
        """Return the parameters with the energy of a state."""
        energy = self.stepper.energy(state.q, state.p, state.t, self.parameters)
        return {**self.parameters, str(self.stepper.interface.energy_parameter): energy}

    @property
    def tau(self) -> float:
        """Step size with a time-rescaling function: so large that errors exceed round-off."""
        return STEP_FACTOR * self.tested.states[0].h

    @property
    def residual(self) -> float:
        """Residual of the stage equations beyond round-off, relative to the state."""
        return RESIDUAL_RATIO * (self.tolerance or 0.0)

    @cached_property
    def motion(self) -> ExactMotion:
        """Exact motion in t."""
        return exact_motion(self.system.with_parameters(**self.parameters))

    def run(self, **how: Any) -> Trajectory:
        """Integrate from the first state of the subject."""
        first = self.tested.states[0]
        result: Trajectory = self.stepper.integrate(first.q, first.p, t=first.t, parameters=self.parameters, **how)
        return result

    def distance(self, motion: ExactMotion, start: State, span: Any, end: Array) -> float:
        """Return the distance of a state from the exact motion, in units of the sizes of q and p."""
        there = np.concatenate(motion.flow(start.q, start.p, span, start.t))
        return float(np.max(np.abs(there - numbers(end)).astype(float) / self.tested.scales(start)))

    def rounding(self, state: State) -> float:
        """Return the largest rounding error of a step, in the same units."""
        return float(np.max(self.tested.rounding(state) / self.tested.scales(state)))


def at_fixed_energy(system: MechanicalSystem, energy: float) -> MechanicalSystem:
    """Return the transformed system at an energy as an ordinary system in tau; other systems unchanged."""
    if system.clock is None:
        return system
    return replace(system, clock=None).with_parameters(**{system.clock.energy.name: energy})


def variable_step_checks(runs: VariableSteps) -> Iterator[Check]:
    """Yield all checks of this module."""
    checks = _time_transformation_checks if runs.stepper.interface.in_tau else _adaptive_checks
    for name, statement, measure in checks(runs):
        yield from checked(name, statement, partial(measure, runs))


def _time_transformation_checks(runs: VariableSteps) -> Iterator[tuple[str, str, Any]]:
    yield "steps of tau", "they equal steps of the transformed system at the energy of their state", _at_their_energy
    yield "time", "the error in t is of the size of the error in tau (60 digits)", _in_time
    yield "final time", "a run to t_end ends at t_end with an error of that size (60 digits)", _at_final_time
    if runs.tested.method.symmetric:
        yield "reversal in tau", f"{SHORT_RUN} steps of h and of -h return to time and state", _there_and_back


def _adaptive_checks(runs: VariableSteps) -> Iterator[tuple[str, str, Any]]:
    yield "adaptive steps", "each equals a single step of the same size", _equal_single_steps
    if runs.stepper.interface.time_transformation is not None:
        yield (
            "step density",
            "halving tau reduces the deviation from dt = g dtau at least 2.5-fold",
            _follow_step_density,
        )
        if runs.tested.method.symmetric:
            yield "reversal of adaptive steps", "a run backward from its end returns to its start", _reversed
    else:
        yield "local error", "the median over adaptive steps is below the tolerance (60 digits)", _within_tolerance
    described = runs.stepper.interface
    for k, name in enumerate(described.map_names):
        if runs.tested.method.symplectic and described.map_exact[k]:
            yield f"{name}, adaptive steps", "conserved at variable step size", partial(_conserved, k)


def _at_their_energy(runs: VariableSteps) -> Finding:
    deviations = []
    for state in runs.tested.states:
        start = state.q, state.p, state.h, state.t
        end = np.concatenate(runs.stepper.step(*start, runs.parameters))
        expected = np.concatenate(runs.tested.stepper.step(*start, runs.at_energy(state)))
        deviations.append(runs.tested.in_roundings(end - expected, state))
    return Finding(max(deviations), ROUNDINGS, "in units of rounding, 2 states")


def _in_time(runs: VariableSteps) -> Finding:
    start = _shorter(runs)
    run = runs.run(h=start.h, steps=1)
    return _compared_with_exact(runs, start, 1, run.q[1], run.p[1], mp.mpf(float(run.t[1])) - mp.mpf(start.t))


def _at_final_time(runs: VariableSteps) -> Finding:
    start, (whole, part) = _shorter(runs), CUT
    t = runs.run(h=start.h, steps=whole + 1).t
    end = float(t[whole] + part * (t[whole + 1] - t[whole]))
    run = runs.run(h=start.h, t_end=end)
    if run.t[-1] != end:
        return Finding(abs(run.t[-1] - end), 0.0, f"the run ends at t = {run.t[-1]!r}, not {end!r}")
    return _compared_with_exact(runs, start, whole + 1, run.q[-1], run.p[-1], mp.mpf(end) - mp.mpf(start.t))


def _shorter(runs: VariableSteps) -> State:
    first = runs.tested.states[0]
    return replace(first, h=first.h / STEP_DIVISOR)


def _compared_with_exact(runs: VariableSteps, start: State, steps: int, q: Array, p: Array, span: Any) -> Finding:
    """Compare the state after a time ``span`` with the exact motion; the bound is the error of the steps in tau."""
    first = np.concatenate(runs.tested.stepper.step(start.q, start.p, start.h, start.t, runs.at_energy(start)))
    in_tau = exact_motion(runs.tested.system.with_parameters(**runs.at_energy(runs.tested.states[0])))
    error = runs.distance(in_tau, start, mp.mpf(start.h), first)
    bound = steps * (ERROR_RATIO * error + ROUNDINGS * runs.rounding(start))
    return Finding(runs.distance(runs.motion, start, span, np.concatenate([q, p])), bound, f"relative, h = {start.h:g}")


def _there_and_back(runs: VariableSteps) -> Finding:
    first = runs.tested.states[0]
    how: dict[str, Any] = {"steps": SHORT_RUN, "save_every": SHORT_RUN, "parameters": runs.at_energy(first)}
    there = runs.stepper.integrate(first.q, first.p, h=first.h, t=first.t, **how)
    back = runs.stepper.integrate(there.q[-1], there.p[-1], h=-first.h, t=float(there.t[-1]), **how)
    change = runs.tested.in_roundings(np.concatenate([back.q[-1], back.p[-1]]) - first.z, first)
    late = abs(float(back.t[-1]) - first.t) / (EPSILON * (abs(float(there.t[-1])) + abs(first.t)))
    return Finding(max(change, late) / SHORT_RUN, ROUNDINGS, "in units of rounding per step")


def _adaptive_run(runs: VariableSteps, part: float = 1.0) -> Trajectory:
    first = runs.tested.states[0]
    end = first.t + SHORT_RUN * first.h
    if runs.stepper.interface.time_transformation is not None:
        return runs.run(h=part * runs.tau, t_end=end)
    return runs.run(t_end=end, tolerance=runs.tolerance or None)


def _steps_of(runs: VariableSteps) -> Iterator[tuple[State, Array]]:
    """Yield some steps of a run, including the first and the last: start with step size, and end."""
    run = _adaptive_run(runs)
    for k in np.unique(np.linspace(0, len(run) - 2, SAMPLED).astype(int)):
        start = State(run.q[k], run.p[k], float(run.t[k]), float(run.t[k + 1] - run.t[k]))
        yield start, np.concatenate([run.q[k + 1], run.p[k + 1]])


def _equal_single_steps(runs: VariableSteps) -> Finding:
    worst = 0.0
    for start, end in _steps_of(runs):
        unit = runs.tested.rounding(start) + runs.residual * runs.tested.scales(start)
        worst = max(worst, float(np.max(np.abs(runs.tested.ends(start) - end) / unit)))
    return Finding(worst, ROUNDINGS, f"in units of residual and rounding, {SAMPLED} steps")


def _follow_step_density(runs: VariableSteps) -> Finding:
    difference = [_density_deviation(runs, _adaptive_run(runs, part), part * runs.tau) for part in (1.0, 0.5)]
    remark = f"tau = {runs.tau:.3g}: deviation {difference[0]:.1e}, then {difference[1]:.1e}"
    return Finding(difference[0] / difference[1], LEAST_REDUCTION, remark, at_least=True)


def _density_deviation(runs: VariableSteps, run: Trajectory, tau: float) -> float:
    """Return the largest relative deviation of the steps from tau (g_k + g_{k+1}) / 2."""
    system = runs.motion.system
    rate = Discretisation.time_rate(system, runs.stepper.interface.time_transformation)
    symbols = (*system.coordinates, *system.auxiliaries, system.time, *system.parameters)
    parameters = [mp.mpf(value) for value in system.defaults]
    tape, g = Tape([rate], symbols), []
    for q, p, t in zip(run.q, run.p, run.t, strict=True):
        g += tape([*numbers(q), *numbers(p if system.auxiliaries else ()), mp.mpf(float(t)), *parameters])
    tau_g = tau * (np.array(g[1:-1], dtype=float) + np.array(g[:-2], dtype=float)) / 2
    return float(np.max(np.abs(np.diff(run.t)[:-1] / tau_g - 1)))


def _reversed(runs: VariableSteps) -> Finding:
    """Return the defect of a run restarted backward from its own saved step density."""
    first, end = runs.tested.states[0], float(_adaptive_run(runs).t[-2])
    run = runs.stepper.start(first.q, first.p, h=runs.tau, t=first.t, t_end=end, parameters=runs.parameters)
    run.record()
    back = runs.stepper.from_checkpoint(run.checkpoint(), h=runs.tau, t_end=first.t, parameters=runs.parameters)
    back.record()
    change = runs.tested.in_roundings(np.concatenate([back.q, back.p]) - first.z, first)
    return Finding(change / run.steps, ROUNDINGS, f"in units of rounding per step, {run.steps} steps")


def _within_tolerance(runs: VariableSteps) -> Finding:
    errors, rounding = [], 0.0
    for start, end in _steps_of(runs):
        errors.append(runs.distance(runs.motion, start, mp.mpf(start.h), end))
        rounding = max(rounding, ROUNDINGS * runs.rounding(start))
    remark = f"relative, {SAMPLED} steps, largest {max(errors):.1e}"
    return Finding(float(np.median(errors)), (runs.tolerance or EPSILON) + rounding, remark)


def _conserved(k: int, runs: VariableSteps) -> Finding:
    run = _adaptive_run(runs)
    result = momentum_error(run, k)
    return result._replace(bound=result.bound + (len(run) - 1) * runs.residual)
