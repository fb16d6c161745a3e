"""Leapfrog of two coupled oscillators whose coupling depends on time, with exact first derivatives by all numbers."""

import numpy as np
from notation import lagrange
from samples import QUICK_FLAGS

from scvi_codegen import StoermerVerlet, compile_stepper

STEP_INPUTS = ("x", "y", "p_x", "p_y", "m", "k", "a", "w", "t", "h")
DEFAULTS = {"m": 1.0, "k": 1.0, "a": 0.0, "w": 1.0}
ROWS = np.array(
    [[0.4, -0.3, 0.2, 0.5, 1.7, 0.8, 0.6, 1.3, 2.5, 0.04], [-0.1, 0.6, 0.3, -0.2, 0.9, 1.9, -0.7, 2.1, -3.1, -0.05]]
)
STEPS, EVERY = 150, 50
"""Three segments of at most 64 steps; no saved state is at their ends."""


def stepper():
    """Compiled; a flow that took default parameters, t = 0 or the time of another piece is off by more than 1e-3."""
    system = lagrange(
        "pumped", "x y", "m*(x_dot**2 + y_dot**2)/2 - k*x**2/2 - y**2/2 - a*cos(w*t)*x*y", parameters=DEFAULTS
    )
    return compile_stepper(system, StoermerVerlet(), flags=QUICK_FLAGS)


def states(row):
    """(kept, 4) states from the numbers of ``STEP_INPUTS``, which may be complex."""
    q, p, (m, k, a, w, t, h) = row[:2], row[2:4], row[4:]
    saved = [np.concatenate([q, p])]

    def force(q, t):
        coupling = a * np.cos(w * t)
        return -np.array([k * q[0] + coupling * q[1], q[1] + coupling * q[0]])

    for n in range(STEPS):
        p = p + h / 2 * force(q, t + n * h)
        q = q + h * p / m
        p = p + h / 2 * force(q, t + (n + 1) * h)
        if (n + 1) % EVERY == 0:
            saved.append(np.concatenate([q, p]))
    return np.array(saved)


def partials(row):
    """(kept, 4, 10) derivatives of :func:`states`, by complex steps: right to rounding."""
    tiny = 1e-40
    changes = [states(row + 1j * tiny * direction).imag / tiny for direction in np.eye(len(row))]
    return np.moveaxis(np.array(changes), 0, -1)


def weights():
    """(kept, 4) of a function of the states."""
    return np.random.default_rng(5).normal(size=(STEPS // EVERY + 1, 4))


def hessian(row):
    """(10, 10) second derivatives of the states times :func:`weights`, to 1e-8."""
    steps = 3e-7 * np.eye(len(row))
    gradient = [np.tensordot(weights(), partials(row + e) - partials(row - e), 2) / 6e-7 for e in steps]
    return np.array(gradient)
