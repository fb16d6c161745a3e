"""Kepler's problem with mu = 1: exact flow, and quantities measured on an orbit.

The "analytic solution" in section 2.2 of the paper has the time in place of the eccentric anomaly; here Kepler's
equation is solved.

Plots of Kepler orbits.

Structure of one step of Kepler's problem: symplectic form, angular momentum, and order.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from scvi_codegen.errors import StepFailedError
from scvi_codegen.methods.method import Method
from scvi_codegen.models.systems import kepler
from scvi_codegen.reproduce.laboratory.drawing import COLORS
from scvi_codegen.reproduce.laboratory.running import stepper_of
from scvi_codegen.runtime.core.stepper import Stepper

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = NDArray[np.float64]
Pair = tuple[float, float]

SYSTEM = kepler()
"""System q'' = -q / |q|^3, built once."""

NEWTON_STEPS = 60


def perihelion(e: float) -> tuple[Pair, Pair]:
    """Return (q, v) at perihelion for semi-major axis 1 (energy -1/2, period 2 pi) and eccentricity e."""
    return (1.0 - e, 0.0), (0.0, math.sqrt((1.0 + e) / (1.0 - e)))


def exact_flow(q: ArrayLike, p: ArrayLike, t: ArrayLike) -> tuple[Array, Array]:
    """Return (q, p) after times t, one row each, from Kepler's equation for the change x of the eccentric anomaly."""
    start, velocity = np.asarray(q, dtype=float), np.asarray(p, dtype=float)
    times = np.atleast_1d(np.asarray(t, dtype=float))
    r0 = float(np.hypot(*start))
    a = 1.0 / (2.0 / r0 - float(velocity @ velocity))
    inward, sigma = 1.0 - r0 / a, float(start @ velocity) / math.sqrt(a)
    mean = times / a**1.5
    x = mean.copy()
    for _ in range(NEWTON_STEPS):
        x -= (x - inward * np.sin(x) + sigma * (1 - np.cos(x)) - mean) / (1 - inward * np.cos(x) + sigma * np.sin(x))
    r = a * (1 - inward * np.cos(x) + sigma * np.sin(x))
    f, g = 1 - a / r0 * (1 - np.cos(x)), times - a**1.5 * (x - np.sin(x))
    f_dot, g_dot = -math.sqrt(a) / (r * r0) * np.sin(x), 1 - a / r * (1 - np.cos(x))
    return np.outer(f, start) + np.outer(g, velocity), np.outer(f_dot, start) + np.outer(g_dot, velocity)


def ellipse(e: float) -> tuple[Array, Array]:
    """Return points of the exact orbit from :func:`perihelion`."""
    anomaly = np.linspace(0.0, 2 * np.pi, 361)
    return np.cos(anomaly) - e, math.sqrt(1 - e * e) * np.sin(anomaly)


def angular_momentum(q: Array, p: Array) -> Array:
    """Return M = q1 p2 - q2 p1, along the last axis."""
    result: Array = q[..., 0] * p[..., 1] - q[..., 1] * p[..., 0]
    return result


def off_ellipse(q: Array, e: float) -> Array:
    """Return the distance of positions outside the exact orbit: half the sum of the distances to its foci, less 1."""
    result: Array = (np.hypot(q[:, 0], q[:, 1]) + np.hypot(q[:, 0] + 2 * e, q[:, 1])) / 2 - 1
    return result


def perihelion_turn(q: Array, p: Array) -> float:
    """Return the angle in radians by which the perihelion has rotated, whole turns included.

    It is the direction of the Laplace-Runge-Lenz vector p x M - q / |q|, which is constant on exact orbits.
    """
    m, r = angular_momentum(q, p), np.hypot(q[:, 0], q[:, 1])
    angle = np.unwrap(np.arctan2(-p[:, 0] * m - q[:, 1] / r, p[:, 1] * m - q[:, 0] / r))
    return float(angle[-1] - angle[0])


def revolutions(t: Array, q: Array, p: Array) -> Array:
    """Return the duration of each revolution, from apocentre to apocentre, where q . p changes sign."""
    outward = (q * p).sum(axis=1)
    before = np.flatnonzero((outward[:-1] > 0) & (outward[1:] <= 0))
    share = outward[before] / (outward[before] - outward[before + 1])
    return np.diff(t[before] + share * (t[before + 1] - t[before]))


def draw_states(axes: Axes, q: Array, scheme: str, label: str | None = None) -> None:
    """Draw positions of a long run as dots, rasterised also in SVG."""
    style: dict[str, Any] = {"color": COLORS[scheme], "markersize": 1.2, "rasterized": True}
    axes.plot(q[:, 0], q[:, 1], ".", label=label or scheme, **style)


def draw_ellipse(axes: Axes, e: float) -> None:
    """Draw the exact orbit."""
    axes.plot(*ellipse(e), color="black", linewidth=0.8, label="exact")


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
