"""Constraints compared with IDA: multipliers as unknowns of a differential-algebraic equation."""

import numpy as np
import pytest

import scvi_codegen as sc

G, SPAN = 9.81, 2.0
MASSES = np.array([1.0, 1.0, 2.0, 2.0])


def partials(q):
    """Return the (2, 4) derivatives of x1^2 + y1^2 - 1 and (x2 - x1)^2 + (y2 - y1)^2 - 1/4, which are linear."""
    x, y = q[2] - q[0], q[3] - q[1]
    return 2 * np.array([[q[0], q[1], 0, 0], [-x, -y, x, y]])


@pytest.mark.second
def test_double_pendulum_of_rods_agrees_with_ida():
    """IDA solves the index-1 form, with constraints differentiated twice, to about 1e-7."""
    ida = pytest.importorskip("sksundae.ida")
    rods = sc.LagrangianSystem.from_text(
        name="rods",
        coordinates=["x1", "y1", "x2", "y2"],
        lagrangian="(x1_dot**2 + y1_dot**2)/2 + m*(x2_dot**2 + y2_dot**2)/2 - g*y1 - m*g*y2",
        parameters={"m": 2.0, "g": G},
        constraints=["x1**2 + y1**2 - 1", "(x2 - x1)**2 + (y2 - y1)**2 - 1/4"],
    )
    q, weight = np.array([1.0, 0.0, 1.0, 0.5]), -G * MASSES * np.array([0, 1, 0, 1])
    run = sc.compile_stepper(rods, sc.SVI(4, "gauss-lobatto:5")).integrate(q, velocity=0 * q, h=0.005, steps=400)

    def residual(t, y, rates, out):
        q, v, multipliers = y[:4], y[4:8], y[8:]
        out[:4] = rates[:4] - v
        out[4:8] = MASSES * rates[4:8] - weight + partials(q).T @ multipliers
        out[8:] = partials(q) @ rates[4:8] + partials(v) @ v

    at_rest = partials(q)
    multipliers = np.linalg.solve(at_rest / MASSES @ at_rest.T, at_rest @ (weight / MASSES))
    start = np.concatenate([q, 0 * q, multipliers])
    rates = np.concatenate([0 * q, (weight - at_rest.T @ multipliers) / MASSES, [0, 0]])
    solver = ida.IDA(residual, algebraic_idx=[8, 9], rtol=1e-10, atol=1e-10, max_num_steps=100_000)
    found = solver.solve(np.array([0.0, SPAN]), start, rates)
    assert found.success
    assert np.abs(found.y[-1, :4] - run.q[-1]).max() < 1e-6
