"""Accuracy warnings: steps too large for the motion, and energy errors at the end of a run."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from itertools import islice
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import AccuracyWarning, StateError, warn
from scvi_codegen.runtime.run.step_plan import StepPlan

if TYPE_CHECKING:
    from scvi_codegen.runtime.core.integrator import Integrator

TOLERABLE_ERROR: Final = 1e-3
"""Largest relative error of a step, and largest relative change of the energy of a run, without a warning."""

ADAPTIVE_REMEDY: Final = ", or use adaptive steps (t_end= without h)"

GROSS_ERROR: Final = 0.5
"""Relative energy change that triggers a warning in fixed-step runs without an error estimate."""

MOST_CHECKED: Final = 1000
"""Largest number of trajectories of an ensemble whose energy is checked."""

ERROR_AMPLIFIED: Final = (
    "although every step met the tolerance: the motion amplifies errors, as close encounters do. Reduce the tolerance, "
    "or use regularised coordinates"
)
FIXED_STEP_REMEDY: Final = (
    "although the system conserves it: h is too large, perhaps for a close encounter. Reduce h, or use an SVI with "
    "adaptive steps (t_end=)"
)

Array = NDArray[np.float64]

_warnings_enabled: ContextVar[bool] = ContextVar("accuracy warnings are wanted", default=True)


class StepData(Protocol):
    """Step data of a trajectory."""

    @property
    def plan(self) -> StepPlan: ...
    @property
    def h(self) -> float: ...
    @property
    def step_error(self) -> float: ...
    @property
    def worst_step_time(self) -> float: ...


class EnergyData(StepData, Protocol):
    """States of a trajectory, including the first and the last."""

    @property
    def stepper(self) -> Integrator: ...
    @property
    def t(self) -> Array: ...
    @property
    def q(self) -> Array: ...
    @property
    def p(self) -> Array: ...
    @property
    def parameters(self) -> Array: ...


class RunWithEnergies(Protocol):
    """Run whose states are checked."""

    def _end_energies(self, t: Array, q: Array, p: Array) -> tuple[float, float] | None: ...


class EnsembleEnergyData(Protocol):
    """States of an ensemble; ``each`` yields times, positions, momenta, status and step count of each trajectory."""

    @property
    def plans(self) -> tuple[StepPlan, ...]: ...
    @property
    def stepper(self) -> Integrator: ...
    @property
    def parameters(self) -> Array: ...
    def each(self) -> Iterator[tuple[Array, Array, Array, str, int]]: ...


@contextmanager
def without_accuracy_warnings() -> Iterator[None]:
    """Suppress accuracy warnings within a ``with`` block or a decorated function that takes large steps on purpose."""
    token = _warnings_enabled.set(False)
    try:
        yield
    finally:
        _warnings_enabled.reset(token)


def warnings_wanted() -> bool:
    """Return whether accuracy warnings are wanted: not inside :func:`without_accuracy_warnings`."""
    return _warnings_enabled.get()


def warn_of_large_steps(trajectory: StepData, *, before: float = 0.0, remedy: str = ADAPTIVE_REMEDY) -> None:
    """Issue an :class:`AccuracyWarning` for the worst fixed step, unless an error ``before`` already caused one."""
    error = trajectory.step_error
    if not error > TOLERABLE_ERROR:
        return
    if trajectory.plan.adaptive or before > TOLERABLE_ERROR or not _warnings_enabled.get():
        return
    warn(
        f"the step size h = {trajectory.h:g} is too large: the relative error of the step from "
        f"t = {trajectory.worst_step_time:g} is about {error:.1e}. Reduce h{remedy}",
        AccuracyWarning,
    )


def warn_of_energy_error(trajectory: EnergyData, run: RunWithEnergies) -> None:
    """Issue an :class:`AccuracyWarning` if an adaptive run does not conserve an energy that the system conserves.

    Runs over arrays of run-time sizes with fixed steps and no error estimate are checked for gross errors.
    """
    plan, stepper = trajectory.plan, trajectory.stepper
    limits: dict[str, Any] = {}
    if plan.h and trajectory.step_error == trajectory.step_error:
        return
    if plan.h and stepper.interface.layout.coordinates:
        limits = {"tolerable": GROSS_ERROR, "why": FIXED_STEP_REMEDY}
    elif plan.h or plan.tau:
        return
    if not stepper.interface.conserves_energy or not _warnings_enabled.get():
        return
    t, q, p = trajectory.t, trajectory.q, trajectory.p
    ends = run._end_energies(t, q, p)
    if ends is None or not abs(ends[1] - ends[0]) > 0.5 * TOLERABLE_ERROR * max(abs(ends[0]), abs(ends[1])):
        return
    if energies := _changed_energies(stepper, t, q, p, trajectory.parameters):
        warn_of_energies(*energies, **limits)


def warn_of_energy_errors(ensemble: EnsembleEnergyData) -> None:
    """Issue the warning of :func:`warn_of_energy_error` for the worst of ``MOST_CHECKED`` trajectories."""
    plans, stepper = ensemble.plans, ensemble.stepper
    if not plans or not stepper.interface.conserves_energy or not _warnings_enabled.get():
        return
    by_trajectory = {}
    for j, (t, q, p, _, _) in islice(enumerate(ensemble.each()), 0, None, -(-len(plans) // MOST_CHECKED)):
        if len(t) and (energies := _changed_energies(stepper, t, q, p, ensemble.parameters[j])):
            by_trajectory[j] = energies
    worst = max(by_trajectory, key=lambda j: relative_energy_change(*by_trajectory[j]), default=None)
    if worst is not None:
        warn_of_energies(*by_trajectory[worst], where=f" of trajectory {worst}")


def warn_of_energies(
    first: float,
    last: float,
    size: float,
    *,
    tolerable: float = TOLERABLE_ERROR,
    where: str = "",
    why: str = ERROR_AMPLIFIED,
) -> None:
    """Issue an :class:`AccuracyWarning` if a conserved energy differs between the first and the last state.

    Args:
        first, last: energies of the first and the last state.
        size: scale of the energy terms (largest |p.v|), for energies near zero.
        tolerable: tolerated change relative to the largest of the three.
        where: description of the trajectory, appended to "the energy".
        why: probable cause and remedy.
    """
    if relative_energy_change(first, last, size) > tolerable and _warnings_enabled.get():
        warn(f"the energy{where} changed from {first:.3g} to {last:.3g} {why}", AccuracyWarning)


def relative_energy_change(first: float, last: float, size: float) -> float:
    """Return the relative change of an energy; 0 if it is NaN."""
    part = abs(last - first) / max(abs(first), abs(last), size, sys.float_info.min)
    return part if part == part else 0.0


def _changed_energies(
    stepper: Integrator, t: Array, q: Array, p: Array, parameters: Array
) -> tuple[float, float, float] | None:
    """Return the first and the last energy and the largest |p.v| if the energy changed; ``None`` otherwise.

    ``None`` is also returned outside the domain of L. Velocities are computed only if the energies differ.
    """
    t, q, p = (each[:: max(1, len(each) - 1)].copy() for each in (t, q, p))
    try:
        energies = stepper._energies_of(t, q, p, parameters)
        first, last = float(energies[0]), float(energies[-1])
        if not relative_energy_change(first, last, 0.0) > TOLERABLE_ERROR:
            return None
        sizes = np.sum(p * stepper.velocity(q, p, t, parameters), axis=1)
    except StateError:
        return None
    return first, last, float(np.abs(sizes).max())
