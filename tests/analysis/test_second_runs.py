"""Arguments of advice: parameters, times and velocities other than defaults, worst and final errors, chaos."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen.analysis.advice import tolerance_check
from scvi_codegen.analysis.advice.tolerance_check import Known, _final_error, known_digits, missed_tolerance
from scvi_codegen.runs.compiler import second_stepper

T, SPAN = 2.5, 7.5
STIFFER = {"k": 9.0, "a": 0.75}


@pytest.fixture(scope="module")
def driven():
    """Stiffer by far than its defaults, and driven by the clock."""
    return lagrange("driven", "x", "x_dot**2/2 - k*x**2/2 + a*x*cos(t)", k=1.0, a=0.0)


def exact(t, q, p):
    """x'' = -k x + a cos t, from the state at T."""
    k, a = STIFFER["k"], STIFFER["a"]
    w, forced = math.sqrt(k), a / (k - 1.0)
    b, c = q - forced * math.cos(T), (p + forced * math.sin(T)) / w
    return forced * np.cos(t) + b * np.cos(w * (t - T)) + c * np.sin(w * (t - T))


@pytest.mark.rotated
@pytest.mark.parametrize("turns", [0, 1])
def test_motion_at_rest_has_no_advice(turns):
    """Neither at the origin nor elsewhere; an ensemble has advice if a trajectory moves."""
    pendulum = lagrange("pendulum", "a", "a_dot**2/2 + cos(a)")
    q, settings = 2.0 * math.pi * turns, {"span": 5.0, "tolerance": 1e-4}
    with pytest.raises(sc.StateError, match="at rest"):
        sc.advise(pendulum, "svi:4", [q], velocity=[0.0], **settings)
    moving, both = ([q + 1.0], [0.0]), ([[q], [q + 1.0]], [[0.0], [0.0]])
    alone, together = (sc.advise(pendulum, "svi:4", x, velocity=v, **settings) for x, v in (moving, both))
    assert together.member == 1
    assert together.h == alone.h
    with pytest.raises(sc.StateError, match="all 2 trajectories are at rest"):
        sc.advise(pendulum, "svi:4", [[q], [q]], velocity=both[1], **settings)


def run(system, h, q=0.75, p=-0.5):
    steps = round(SPAN / h)
    return sc.compile_stepper(system, "svi:2").integrate([q], [p], h=h, steps=steps, t=T, parameters=STIFFER)


@pytest.mark.rotated
@pytest.mark.parametrize("h", [0.125, 0.03125])
def test_the_second_run_has_the_time_and_parameters_of_the_first(driven, h):
    trajectory = run(driven, h)
    off = abs(trajectory.q[:, 0] - exact(trajectory.t, 0.75, -0.5))
    known = known_digits(second_stepper(driven), trajectory, most=10_000)
    late = off[-max(1, len(off) // 16) :]
    assert known.q[0] == pytest.approx(max(off[-1], math.sqrt(np.mean(late**2))), rel=1e-3)
    assert not known.chaotic


def test_accidentally_small_final_error_is_not_the_error():
    apart = np.full((160, 1), 1e-3)
    apart[-1] = 1e-9
    assert 0.9e-3 < _final_error(apart)[0] < 1e-3
    apart[-1], apart[:140] = 5e-3, 1.0
    assert _final_error(apart)[0] == 5e-3


@pytest.mark.second
def test_chaotic_trajectory_is_classified_as_chaotic():
    double = sc.problem("double-pendulum")
    stepper = sc.compile_stepper(double.system, "svi:4")
    found = {}
    for angle in (0.05, 2.5):
        trajectory = stepper.integrate([angle, angle / 2], [0.0, 0.0], h=0.02, steps=1500)
        found[angle] = known_digits(second_stepper(double.system), trajectory, most=50_000)
    assert not found[0.05].chaotic
    assert found[2.5].chaotic
    assert 0.3 < found[2.5].tenfold < 10.0


def claimed_run(**more):
    """A run whose worst step and energy are in doubt or not."""
    q = np.sqrt(2.0) * np.cos(np.pi * (np.arange(64.0) + 0.5) / 32.0)[:, np.newaxis]  # 1 is its distance from its mean
    stepper = SimpleNamespace(interface=SimpleNamespace(conserves_energy=True))
    stated = {"step_error": 1e-12, "worst_step_time": 3.25, "q": q, "p": q, "velocity": q, "steps": 63}
    stated["stepper"] = stepper
    return SimpleNamespace(**(stated | {"energy": lambda: np.ones(64)} | more))


@pytest.mark.parametrize(
    ("known", "more", "words"),
    [
        (1e-7, {}, ""),
        (1.9e-6, {}, ""),
        (2.1e-6, {}, "differs by 2.1e-06 at the end"),
        (1e-7, {"step_error": 1e-4}, ""),
        (1e-3, {"step_error": 1e-4}, "the step from t = 3.25 alone has a relative error of about 1.0e-04"),
        (1e-3, {"energy": lambda: np.linspace(1.0, 1.01, 64)}, "the conserved energy has a relative error of"),
    ],
    ids=["kept", "just kept", "just broken", "doubt that a second run dispels", "worst step", "energy"],
)
def test_claimed_tolerance_is_compared_with_the_final_error(known, more, words):
    system = sc.LagrangianSystem.from_text(name="free", coordinates=["x"], lagrangian="x_dot**2/2 - x**2/2")
    regular, chaotic = (Known(q=np.array([known]), p=np.array([9.0]), tenfold=tenfold) for tenfold in (math.inf, 2.0))
    found = missed_tolerance(second_stepper(system), claimed_run(**more), 1e-6, regular)
    assert (words in found) if words else found == ""
    assert bool(missed_tolerance(second_stepper(system), claimed_run(**more), 1e-6, chaotic)) == bool(more)


def test_missing_second_run_is_made_if_the_estimate_is_doubtful(driven, monkeypatch):
    asked = []
    monkeypatch.setattr(tolerance_check, "known_digits", lambda second, run, *, most: asked.append(most))
    assert missed_tolerance(second_stepper(driven), claimed_run(), 1e-6) == ""
    assert asked == []
    assert "alone has a relative error" in missed_tolerance(second_stepper(driven), claimed_run(step_error=1e-4), 1e-6)
    assert asked == [10_000 + 4 * 63]
