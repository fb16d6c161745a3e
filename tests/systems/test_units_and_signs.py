"""Signs and units against independent values: gauges, multipliers of orbits, constraints of arrays, forces with v."""

import numpy as np
import pytest
from notation import lagrange
from scipy.integrate import solve_ivp

import scvi_codegen as sc
from scvi_codegen.common.errors import MethodError


@pytest.mark.parametrize("method", ["stoermer-verlet", "composition:8"])
def test_velocity_dependent_forces_are_not_treated_as_kicks(method):
    """Explicit solvers refuse them, and where a step is made it is that of the motion."""
    system = lagrange("rubbed", "x", "m*x_dot**2/2 - k*x**2/2", m=1.75, k=0.625, forces={"x": "-x_dot/2"})
    with pytest.raises(MethodError):
        sc.compile_stepper(system, method, solver="explicit")
    try:
        stepper = sc.compile_stepper(system, method)
    except MethodError:
        return
    run = stepper.integrate([1.0], [0.5], h=0.002, steps=1000)
    end = solve_ivp(
        lambda t, z: [z[1] / 1.75, -0.625 * z[0] - z[1] / 3.5], (0, 2.0), [1.0, 0.5], rtol=1e-12, atol=1e-14
    ).y[:, -1]
    np.testing.assert_allclose([run.q[-1, 0], run.p[-1, 0]], end, rtol=0, atol=1e-6)
