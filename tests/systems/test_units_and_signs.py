"""Signs and units against independent values: gauges, multipliers of orbits, constraints of arrays, forces with v."""

import numpy as np
import pytest
from notation import lagrange
from scipy.integrate import solve_ivp

import scvi_codegen as sc
from scvi_codegen.common.errors import MethodError


@pytest.mark.second
def test_multipliers_of_an_orbit_are_those_of_its_variations():
    """A damped pendulum that is driven: two multipliers, not in pairs, by differences of DOP853."""
    parameters = {"m": 1.75, "k": 2.5, "a": 0.375, "w": 1.25}
    text = "m*x_dot**2/2 - k*x**2/2 - x**4/4 + a*x*cos(w*t)"
    system = lagrange("driven", "x", text, parameters=dict.fromkeys(parameters, 1.0), forces={"x": "-x_dot/4"})
    stepper, period = sc.compile_stepper(system, "svi:4"), 2 * np.pi / parameters["w"]
    orbit = sc.periodic_orbit(stepper, [0.3], [0.1], period=period, steps=200, parameters=parameters, fixed_period=True)

    def motion(t, z):
        x, p = z
        force = -parameters["k"] * x - x**3 + parameters["a"] * np.cos(parameters["w"] * t)
        return [p / parameters["m"], force - p / parameters["m"] / 4]

    def end(z):
        return solve_ivp(motion, (0, period), z, method="DOP853", rtol=1e-12, atol=1e-14).y[:, -1]

    z, unit = np.concatenate([orbit.q, orbit.p]), 1e-5 * np.eye(2)
    np.testing.assert_allclose(end(z), z, rtol=0, atol=1e-9)
    expected = np.linalg.eigvals(np.array([(end(z + e) - end(z - e)) / 2e-5 for e in unit]).T)
    key = lambda x: (round(abs(x), 6), x.imag)  # noqa: E731
    np.testing.assert_allclose(sorted(orbit.multipliers, key=key), sorted(expected, key=key), rtol=0, atol=1e-7)
    assert orbit.stable == bool(np.all(np.abs(expected) <= 1.0))


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
