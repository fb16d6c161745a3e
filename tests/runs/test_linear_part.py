"""Steps that are solved implicitly for the linear part of the forces: chains whose vibrations are fast."""

from itertools import pairwise

import numpy as np
import pytest
from mpmath import factorial, mp
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen.codegen.lowering.program import lower
from scvi_codegen.methods.galerkin import SVI
from scvi_codegen.runs.stepping.step_derivatives import LinearisedMethod

COUNT = 9


def ring(cubic: float = 0.0, *, count: int = COUNT, further: str = "", name: str = "ring") -> sc.LagrangianSystem:
    """Return masses on a ring of springs, in an order that is not that of the ring."""
    order = [(2 * k) % count for k in range(count)]
    pairs = [(f"q{order[k]}", f"q{order[(k + 1) % count]}") for k in range(count)]
    springs = [f"-k*({b} - {a})**2/2 - c*({b} - {a})**4/4" for a, b in pairs]
    kinetic = [f"m*q{k}_dot**2/{2 + k % 2}" for k in range(count)]
    return lagrange(
        name, [f"q{k}" for k in range(count)], "+".join(kinetic) + "".join(springs) + further, m=1.5, k=2.0, c=cubic
    )


def start(count: int = COUNT) -> tuple[np.ndarray, np.ndarray]:
    random = np.random.default_rng(3)
    return random.uniform(-1.0, 1.0, (2, count))


def exact_step(system: sc.LagrangianSystem, stepper: sc.Stepper, h: float, stages: int) -> np.ndarray:
    """Return the matrix of a step of the Gauss method for a linear system: the Pade approximant of exp(h J)."""
    values = dict(zip(system.parameters, system.defaults, strict=True))
    q, v = system.coordinates, system.velocities
    L = system.lagrangian.xreplace(values)
    stiffness = mp.matrix([[L.diff(a, b) for b in q] for a in q])
    inverse = mp.diag([1 / mp.mpf(str(L.diff(a, a))) for a in v])
    size = len(q)
    J = mp.zeros(2 * size)
    J[:size, size:], J[size:, :size] = inverse, stiffness
    up, down, power = mp.zeros(2 * size), mp.zeros(2 * size), mp.eye(2 * size)
    for k in range(stages + 1):
        factor = factorial(2 * stages - k) / (factorial(k) * factorial(stages - k))
        up, down, power = up + factor * power, down + (-1) ** k * factor * power, power * J * h
    return np.array((mp.inverse(down) * up).tolist(), dtype=float)


@pytest.mark.rotated
@pytest.mark.parametrize(("degree", "h"), [(8, 9.0), (3, 4.0)])
def test_linear_chain(degree, h):
    system = ring()
    stepper = sc.compile_stepper(system, SVI(degree), solver="fixed-point")
    q, p = start()
    run = stepper.integrate(q, p, h=h, steps=1)
    with mp.workdps(40):
        expected = exact_step(system, stepper, h, degree) @ np.concatenate([q, p])
    assert np.hstack([run.q[-1], run.p[-1]]) == pytest.approx(expected, abs=2e-13)
    assert run.iterations.max() <= 3


@pytest.mark.rotated
def test_errors_of_fast_vibrations_are_transported_by_iterations(monkeypatch):
    """Steps of up to 7 rad: as large as the differences from the exact motion, without differences of steps."""
    monkeypatch.setattr(LinearisedMethod, "_transport_by_differences", None)
    system, h, steps = ring(), 3.0, 12
    stepper, state = sc.compile_stepper(system, "svi:8"), np.concatenate(start())
    run = stepper.integrate(*start(), h=h, steps=steps)
    with mp.workdps(40):
        step = exact_step(system, stepper, h / 64, 8)
        flow = np.array((mp.matrix(step.tolist()) ** (64 * steps)).tolist(), dtype=float)
    true = np.hstack([run.q[-1], run.p[-1]]) - flow @ state
    assert np.hstack([run.error.q[-1], run.error.p[-1]]) == pytest.approx(true, abs=1e-2 * np.abs(true).max())
    assert np.abs(true).max() > 1e-9


@pytest.mark.parametrize(
    ("further", "found"),
    [
        ("", True),
        ("+k*q0**2", False),
        ("-k/(2 + q0)", True),
        ("-k/q0", False),
        ("-t*q0**2", False),
        ("-sqrt(q0**2 + k**2)", False),
    ],
)
def test_systems_with_linear_part(further, found):
    program = lower(ring(further=further), SVI(2), prefix="x")
    assert bool(program.fixed_point and program.fixed_point.linear_part) is found


@pytest.mark.rotated
def test_fast_vibrations_that_cannot_be_extrapolated_begin_with_a_straight_line():
    """With former steps extrapolated whatever the error, the run takes 500 iterations."""
    count, q = 8, [0.9 * np.sin(np.pi * (k + 1) / 9) for k in range(8)]
    ends = ["0", *(f"q{k}" for k in range(count)), "0"]
    springs = [f"-({b} - {a})**2/2 - ({b} - {a})**4/4" for a, b in pairwise(ends)]
    chain = lagrange("fput", ends[1:-1], "+".join(f"q{k}_dot**2/2" for k in range(count)) + "".join(springs))
    run = sc.compile_stepper(chain, SVI(8)).integrate(q, [0.0] * count, t_end=400.0, tolerance=1e-2)
    assert run.iterations.sum() < 450
