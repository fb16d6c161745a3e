"""Structure of one step of Kepler's problem: symplectic form, angular momentum, and order."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from scvi_codegen.errors import StepFailedError
from scvi_codegen.methods.method import Method
from scvi_codegen.reproduce.kepler.orbits import SYSTEM, angular_momentum, exact_flow
from scvi_codegen.reproduce.laboratory.drawing import Array
from scvi_codegen.reproduce.laboratory.running import stepper_of
from scvi_codegen.runtime.core.stepper import Stepper

STATE = np.array([0.3, 0.8]), np.array([-1.1, 0.4])
"""State (q, p) off the symmetry axes of the orbit (eccentricity 0.17), so that no error vanishes by symmetry."""
LONG_STEP_SIZE = 0.3
SPAN = 2.4
STEPS = (2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96)
ABOVE_ROUNDOFF = 1e-13
POINTS_OF_A_RATE = 3
DERIVATIVE_WEIGHTS = {1: 3 / 4, 2: -3 / 20, 3: 1 / 60}
WIDTH = 2e-3
"""Width of central differences of order six; round-off and truncation are then both near 1e-13."""


@dataclass(frozen=True, slots=True)
class Structure:
    """Structure of a step.

    Attributes:
        defect: max |J^T Omega J - Omega|, J the Jacobian of the step; its measurement has noise 1e-13.
        momentum: change of the angular momentum in the step.
        order: slope of the error over h, above round-off.
    """

    defect: float
    momentum: float
    order: float


@lru_cache(maxsize=64)
def structure_of(method: Method) -> Structure:
    """Return the structure of one step from :data:`STATE`; the order is from runs over 2.4."""
    stepper = stepper_of(SYSTEM, method, "newton")
    q, p = stepper.step(*STATE, LONG_STEP_SIZE)
    return Structure(
        symplecticity_defect(stepper, *STATE, LONG_STEP_SIZE),
        float(angular_momentum(q, p) - angular_momentum(*STATE)),
        _order(stepper),
    )


def symplecticity_defect(stepper: Stepper, q: Array, p: Array, h: float) -> float:
    """Return max |J^T Omega J - Omega| of the step of h from (q, p)."""
    m = len(q)
    jacobian = _jacobian(lambda z: np.concatenate(stepper.step(z[:m], z[m:], h)), np.concatenate([q, p]))
    omega = np.kron([[0, 1], [-1, 0]], np.eye(m))
    return float(np.abs(jacobian.T @ omega @ jacobian - omega).max())


def _jacobian(step: Callable[[Array], Array], state: Array) -> Array:
    columns = [
        sum(w / WIDTH * (step(state + k * unit) - step(state - k * unit)) for k, w in DERIVATIVE_WEIGHTS.items())
        for unit in np.eye(len(state)) * WIDTH
    ]
    return np.array(columns).T


def _order(stepper: Stepper) -> float:
    """Return the slope through the smallest errors that are above round-off."""
    errors = {steps: error for steps in STEPS if (error := _error(stepper, steps)) > ABOVE_ROUNDOFF}
    smallest: Sequence[int] = sorted(errors)[-POINTS_OF_A_RATE:]
    derivative, _ = np.polyfit(np.log([SPAN / n for n in smallest]), np.log([errors[n] for n in smallest]), 1)
    return float(derivative)


def _error(stepper: Stepper, steps: int) -> float:
    """Return the error of the state after :data:`SPAN`; 0, which is ignored, if a step fails."""
    try:
        run = stepper.integrate(*STATE, h=SPAN / steps, steps=steps, save_every=steps)
    except StepFailedError:
        return 0.0
    exact = np.concatenate(exact_flow(*STATE, SPAN), axis=1)[0]
    return float(np.abs(np.concatenate([run.q[-1], run.p[-1]]) - exact).max())
