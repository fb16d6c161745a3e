"""Sums over indices know no size of their own: a linear system scaled by a power of two moves the same, bit for bit.

How many iterations runs of them take stands beside it: what is slower than it was has forgotten former steps.
"""

import re
from functools import cache

import numpy as np
import pytest
from either_system import either_system
from notation import hamilton, lagrange

import scvi_codegen as sc

SMALL = 2.0**-40
STEPS = 40
Q = np.sin(np.arange(6.0)) + 0.1
P = np.cos(2.0 * np.arange(6.0)) / 2
WAYS = {
    ("svi:4", "fixed-point"): {0.1: 83, 0.4: 215},
    ("svi:4", "newton"): {0.1: 81, 0.8: 80},
    ("stoermer-verlet", "fixed-point"): {0.1: 40},
    ("hamiltonian", "fixed-point"): {0.1: 157, 0.4: 323},
}
"""Iterations of so many steps of h, when each was looked at."""


def springs(form):
    energy = "sum(i in N periodic, (q[i+1] - q[i])**2)/2 + sum(i in N, q[i]**2)/2"
    if form == "hamiltonian":
        momenta = "sum(i in N, p[i]**2)/2 + sum(i in N, q[i]*p[i])/8"
        return hamilton("springs", "q[N]", f"{momenta} + {energy}", momenta="p[N]")
    return lagrange("springs", "q[N]", f"sum(i in N, q_dot[i]**2)/2 - ({energy})")


@cache
def run_of(method, solver, h, scale):
    form = "hamiltonian" if method == "hamiltonian" else ""
    made = sc.compile_stepper(springs(form), "svi:4" if form else method, solver=solver)
    run = made.start(scale * Q, scale * P, h=h)
    run.advance(STEPS)
    return run


EACH = [(*way, h) for way, counts in WAYS.items() for h in counts]


@pytest.mark.tiers(0, 1)
@pytest.mark.sampled(2)
@pytest.mark.parametrize(("method", "solver", "h"), EACH)
def test_linear_system_is_scale_invariant(method, solver, h):
    one, small = run_of(method, solver, h, 1.0), run_of(method, solver, h, SMALL)
    assert np.array_equal(SMALL * one.q["q"], small.q["q"])
    assert np.array_equal(SMALL * one.p["q"], small.p["q"])
    assert small.iterations == one.iterations


def test_nan_momentum_fails_the_step():
    """The last kick of a leapfrog step is at a wall, which the positions just reach."""
    wall = lagrange("wall", "q[N]", "sum(i in N, q_dot[i]**2)/2 - sum(i in N, 1/(q[i] - 1))")
    run = sc.compile_stepper(wall, "stoermer-verlet").start([0.0], [0.5], h=1.0)
    with pytest.raises(sc.StepFailedError, match="finite"):
        run.advance(1)
    assert run.q["q"][0] == 0.0


@pytest.mark.rotated
@pytest.mark.parametrize(
    ("form", "method", "solver", "error"),
    [
        ("lagrangian", "svi:8", "fixed-point", 2e-14),
        ("hamiltonian", "svi:8", "fixed-point", 2e-14),
        ("lagrangian", "svi:2", "newton", 2e-13),
    ],
)
def test_light_stiff_mass_conserves_energy_next_to_a_slow_one(form, method, solver, error):
    """The 2-norm of both would leave 1e-10 of it after 2,000 steps, of the Hamiltonian and Newton's iteration 1e-9."""
    light, frequency, amplitude = 1e-8, 20.0, 1e-6
    if form == "hamiltonian":
        text = {"momenta": ["p[N]"], "hamiltonian": "sum(i in N, p[i]**2/m[i] + k[i]*q[i]**2 + c[i]*q[i]**4)/2"}
    else:
        text = {"lagrangian": "sum(i in N, m[i]*q_dot[i]**2 - k[i]*q[i]**2 - c[i]*q[i]**4)/2"}
    parameters = {"m[N]": 1, "k[N]": 1, "c[N]": 1}
    system = either_system(name="pair", coordinates=["q[N]"], parameters=parameters, **text)
    stiffness = light * frequency**2
    data = {"m": [1.0, light], "k": [1.0, stiffness], "c": [0.5, 0.0]}
    stepper = sc.compile_stepper(system, method, solver=solver)
    run = stepper.start([1.0, amplitude], np.zeros(2), h=0.05, parameters=data)
    run.advance(2000)
    energy = run.p["q"][1] ** 2 / light + stiffness * run.q["q"][1] ** 2
    assert abs(energy / (stiffness * amplitude**2) - 1) < error


@pytest.mark.tiers(1, 2)
@pytest.mark.parametrize(("method", "solver", "h"), EACH)
@pytest.mark.parametrize("exponent", [-900, -660, 660, 900])
def test_squares_of_states_neither_overflow_nor_underflow(method, solver, h, exponent):
    one, scaled = run_of(method, solver, h, 1.0), run_of(method, solver, h, 2.0**exponent)
    assert np.abs(np.ldexp(scaled.q["q"], -exponent) - one.q["q"]).max() < 1e-14
    assert scaled.iterations == pytest.approx(one.iterations, rel=0.02, abs=2)


@pytest.mark.second
@pytest.mark.parametrize("exponent", [-660, 660])
@pytest.mark.parametrize(("method", "solver"), [way for way in WAYS if way[0] != "stoermer-verlet"])
def test_adaptive_steps_are_controlled_at_every_scale(method, solver, exponent):
    form = "hamiltonian" if method == "hamiltonian" else ""
    made = sc.compile_stepper(springs(form), "svi:4" if form else method, solver=solver)
    one, scaled = (made.integrate(s * Q, s * P, t_end=2.0, tolerance=1e-9) for s in (1.0, 2.0**exponent))
    assert scaled.steps == pytest.approx(one.steps, abs=2)
    assert np.abs(np.ldexp(scaled.q["q"][-1], -exponent) - one.q["q"][-1]).max() < 1e-8


@pytest.mark.second
def test_steps_of_two_arrays_are_those_of_coordinates():
    """Steps of one coefficient are controlled by the displacement and the curvature of each array."""
    energy = "x_dot**2/2 + y_dot**2/2 - x**4/4 - 8*y**2 - x*y/4"
    one = sc.compile_stepper(lagrange("pair", "x y", energy), "svi:1")
    indexed = re.sub(r"\b([xy](?:_dot)?)\b", r"\1[i]", energy)
    two = sc.compile_stepper(lagrange("pairs", "x[N] y[N]", f"sum(i in N, {indexed})"), "svi:1")
    run = two.integrate({"x": [1.0], "y": [0.01]}, t_end=0.01, tolerance=1e-3)
    assert np.array_equal(run.t, one.integrate([1.0, 0.01], [0.0, 0.0], t_end=0.01, tolerance=1e-3).t)
