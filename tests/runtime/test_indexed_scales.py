"""Sums over indices know no size of their own: a linear system scaled by a power of two moves the same, bit for bit.

How many iterations runs of them take stands beside it: what is slower than it was has forgotten former steps.
"""

from functools import cache

import numpy as np
import pytest

import scvi_codegen as sc

SMALL = 2.0**-40
STEPS = 40
Q = np.sin(np.arange(6.0)) + 0.1
P = np.cos(2.0 * np.arange(6.0)) / 2
WAYS = {
    ("svi:4", "fixed-point"): {0.1: 83, 0.4: 280},
    ("svi:4", "newton"): {0.1: 81, 0.8: 80},
    ("stoermer-verlet", "fixed-point"): {0.1: 40},
    ("hamiltonian", "fixed-point"): {0.1: 162, 0.4: 361},
}
"""Iterations of so many steps of h, when each was looked at."""


def springs(form):
    energy = "sum(i in N periodic, (q[i+1] - q[i])**2)/2 + sum(i in N, q[i]**2)/2"
    if form == "hamiltonian":
        momenta = "sum(i in N, p[i]**2)/2 + sum(i in N, q[i]*p[i])/8"
        return sc.IndexedSystem.from_text(
            name="springs", coordinates=["q[N]"], momenta=["p[N]"], hamiltonian=f"{momenta} + {energy}"
        )
    return sc.IndexedSystem.from_text(
        name="springs", coordinates=["q[N]"], lagrangian=f"sum(i in N, q_dot[i]**2)/2 - ({energy})"
    )


@cache
def run_of(method, solver, h, scale):
    form = "hamiltonian" if method == "hamiltonian" else ""
    made = sc.compile_indexed(springs(form), "svi:4" if form else method, solver=solver)
    run = made.start(scale * Q, scale * P, h=h)
    run.advance(STEPS)
    return run


EACH = [(*way, h) for way, counts in WAYS.items() for h in counts]


@pytest.mark.parametrize(("method", "solver", "h"), EACH)
def test_a_linear_system_is_the_same_at_every_scale(method, solver, h):
    one, small = run_of(method, solver, h, 1.0), run_of(method, solver, h, SMALL)
    assert np.array_equal(SMALL * one.q["q"], small.q["q"])
    assert np.array_equal(SMALL * one.p["q"], small.p["q"])
    assert small.iterations == one.iterations


@pytest.mark.parametrize(("method", "solver", "h"), EACH)
def test_runs_take_as_many_iterations_as_they_did(method, solver, h):
    assert run_of(method, solver, h, 1.0).iterations == pytest.approx(WAYS[method, solver][h], rel=0.02, abs=2)


@pytest.mark.parametrize(("method", "solver"), WAYS)
@pytest.mark.parametrize("force", [0.0, 2.0**-90])
def test_forces_from_rest_at_the_origin_know_no_size_either(method, solver, force):
    """Where there is nothing yet, beside which a change would be small."""
    hamiltonian = {"momenta": ["p[N]"], "hamiltonian": "sum(i in N, p[i]**2/2 + q[i]**2/2) - e*cos(t)*q[0]"}
    lagrangian = {"lagrangian": "sum(i in N, q_dot[i]**2/2 - q[i]**2/2) + e*cos(t)*q[0]"}
    form = hamiltonian if method == "hamiltonian" else lagrangian
    driven = sc.IndexedSystem.from_text(name="driven", coordinates=["q[N]"], parameters={"e": 1}, **form)
    made = sc.compile_indexed(driven, "svi:4" if method == "hamiltonian" else method, solver=solver)
    ends = []
    for e in (1.0, force):
        run = made.start(np.zeros(6), h=0.1, parameters={"e": e})
        run.advance(3)
        ends.append(run.q["q"])
    assert np.abs(ends[1] - force * ends[0]).max() <= 1e-15 * force


def test_a_momentum_that_is_no_number_is_no_step():
    """The last kick of a leapfrog step is at a wall, which the positions just reach."""
    wall = sc.IndexedSystem.from_text(
        name="wall", coordinates=["q[N]"], lagrangian="sum(i in N, q_dot[i]**2)/2 - sum(i in N, 1/(q[i] - 1))"
    )
    run = sc.compile_indexed(wall, "stoermer-verlet").start([0.0], [0.5], h=1.0)
    with pytest.raises(sc.StepFailedError, match="finite"):
        run.advance(1)
    assert run.q["q"][0] == 0.0
