"""Integrators of array systems: any size, closed forms, observations, and arguments that are checked."""

from typing import Any

import numpy as np
import pytest
from notation import lagrange

import scvi_codegen as sc

KINETIC = "sum(i in N, q_dot[i]**2/2)"


def random(*shape: int) -> Any:
    """Normal numbers, always the same."""
    return np.random.default_rng(7).normal(size=shape)


RING = lagrange("case", "q[N]", f"{KINETIC} - sum(i in N periodic, (q[i+1] - q[i])**4/4 + q[i-1]*q[i+2])")
FIELD = sc.LagrangianSystem.from_text(
    "case",
    ["u[NX, NY]"],
    "sum(i in NX periodic, j in NY, u_dot[i, j]**2/2 - (u[i+1, j] - u[i, j])**2 + cos(u[i, j]))"
    "- sum(i in NX, j in 1..NY-1, (u[i, j] - u[i, j-1])**2)",
)


@pytest.mark.rotated
@pytest.mark.parametrize("count", [2, 3, 64, 1000])
def test_one_library_is_used_for_every_size(count: int) -> None:
    """A ring of coupled oscillators against its normal modes; momentum to round-off."""
    stepper = sc.compile_stepper(
        lagrange("ring", "q[N]", f"{KINETIC} - sum(i in N periodic, (q[i+1] - q[i])**2/2)"), "svi:6"
    )
    q, velocity = random(count), random(2, count)[1]
    run = stepper.integrate(q, velocity=velocity, h=0.25, steps=40, save_every=40)
    frequencies = 2 * np.abs(np.sin(np.pi * np.arange(count) / count))
    modes, rates, phase = np.fft.fft(q), np.fft.fft(velocity), 10.0 * frequencies
    slow = np.where(frequencies > 1e-12, np.sin(phase) / np.maximum(frequencies, 1e-12), 10.0)
    expected = np.fft.ifft(modes * np.cos(phase) + rates * slow).real
    assert run.q["q"][-1] == pytest.approx(expected, abs=1e-12)
    assert np.ptp(run.momentum_maps()[:, 0]) < 1e-14 * np.sqrt(count)


@pytest.mark.parametrize(
    ("observe", "message"),
    [
        (lambda run: None, "the result of observe must be real numbers, not None"),
        (lambda run: {"a": 1.0}, "the result of observe must be real numbers"),
        (lambda run: np.zeros(run.steps), r"keep its shape: \(1,\) at t = 0.1, \(0,\) before"),
    ],
)
def test_unsupported_observations_are_rejected(observe: Any, message: str) -> None:
    """Errors name the observation; they are neither NumPy errors nor NaN."""
    with pytest.raises(sc.StateError, match=message):
        sc.compile_stepper(RING, "svi:2").integrate(random(5), h=0.1, steps=2, observe=observe)


@pytest.mark.rotated
def test_failures_of_array_runs() -> None:
    """A too large step fails and the preceding states are saved; a coordinate without mass is reported."""
    with pytest.raises(sc.StepFailedError, match="Use a smaller h") as caught:
        sc.compile_stepper(RING, "svi:4").integrate(random(5), h=1.5, steps=3)
    assert len(caught.value.trajectory.t) == 1
    bare = lagrange("bare", "q[N]", "sum(i in 0..N-2, q_dot[i]**2/2) - sum(i in N, q[i]**2)")
    with pytest.raises(sc.StateError, match="coordinate 2 of 3 has no positive mass"):
        sc.compile_stepper(bare, "svi:2").start(np.ones(3), h=0.1)
    with pytest.raises(sc.MethodError, match=r"3000 coordinates are too many .* scvi-4.* is not supported for array"):
        sc.compile_stepper(bare, "scvi:4").integrate(np.ones(3000), h=0.1, steps=1)
    with pytest.warns(sc.AccuracyWarning):
        sc.compile_stepper(FIELD, "svi:2").integrate(random(3, 2), h=0.4, steps=5)


@pytest.mark.tiers(0, 1)
@pytest.mark.sampled(3)
@pytest.mark.parametrize(("method", "most"), [("svi:1", 1.3), ("svi:2", 1.6), ("svi:4", 2.2), ("svi:8", 3.4)])
@pytest.mark.parametrize("form", ["lagrangian", "hamiltonian"])
def test_fixed_point_converges_up_to_the_documented_step_size(form: str, method: str, most: float) -> None:
    """For an oscillator, also where positions or momenta pass through 0; the energy is conserved."""
    formulas = {
        "lagrangian": "sum(i in N, q_dot[i]**2/2 - q[i]**2/2)",
        "hamiltonian": "sum(i in N, (p_q[i]**2 + q[i]**2)/2)",
    }
    kind = sc.LagrangianSystem if form == "lagrangian" else sc.HamiltonianSystem
    system = kind.from_text("o", ["q[N]"], formulas[form])
    run = sc.compile_stepper(system, method).start(np.ones(3), 0.3 * np.ones(3), h=0.95 * most)
    before = run.energy
    run.advance(50)
    assert run.energy == pytest.approx(before, rel=1e-13)
    assert np.isnan(run.step_error) == (method == "svi:1" and form == "hamiltonian")


@pytest.mark.second
def test_energy_error_without_velocities() -> None:
    """Also where the energy changes so much that its size is in question."""
    system = sc.HamiltonianSystem.from_text("H", ["q[N]"], "sum(i in N, p_q[i]**2/2 + q[i]**4/4)")
    run = sc.compile_stepper(system, "stoermer-verlet").integrate([1.0, 2.0], [0.0, 0.0], h=0.1, steps=3)
    assert run.energy_error() == pytest.approx(np.ptp(run.energy()) / 4.25)


def test_error_estimate_of_a_step_from_rest_at_the_origin() -> None:
    """Where nothing but a drive moves anything, it is a part of where that leads; it is held against the coefficient
    below the highest, which is far too much for so short a step."""
    driven = lagrange("driven", "q[N]", f"{KINETIC} - sum(i in N, q[i]**2/2)", forces={"q[0]": "cos(t)"})
    run = sc.compile_stepper(driven, "svi:4").start(np.zeros(3), h=0.2)
    run.advance(1)
    error = abs(run.q["q"][0] - 0.1 * np.sin(0.2)) / 0.02
    assert 0.1 * error < run.step_error < 1e5 * error
