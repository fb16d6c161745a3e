"""Accuracy warnings of runs: too large steps, missed tolerances, correct digits, chaos."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from commands import error_of, invoke, output_of
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen.extras.advice.advice import missed_tolerance
from scvi_codegen.interfaces.cli.reports import in_known_digits


@pytest.fixture(scope="module")
def kepler() -> sc.Stepper:
    return sc.compile_stepper(sc.problem("kepler").system, sc.SVI(8))


class TestLongSteps:
    def test_worst_step_is_named_with_a_remedy(self, kepler):
        with pytest.warns(
            sc.AccuracyWarning, match=r"h = 1 is too large: .* step from t = \S+ is about .*t_end= without h"
        ):
            trajectory = kepler.integrate([0.4, 0.0], [0.0, 2.0], h=1.0, steps=10)
        assert trajectory.step_error > 1e-3
        assert "too large" in trajectory._repr_html_()

    def test_warning_is_issued_once_per_run(self, kepler):
        going = kepler.start([0.4, 0.0], [0.0, 2.0], h=1.0)
        with pytest.warns(sc.AccuracyWarning):
            going.record(10)
        assert going.record(5).step_error > 1e-3  # and raises no warning

    @pytest.mark.second
    @pytest.mark.filterwarnings("error")
    @pytest.mark.parametrize(("name", "h"), [("cart-pole", 0.02), ("charged-particle", 0.1)])
    def test_coordinate_that_hardly_moves_from_0_does_not_warn(self, name, h):
        """Errors are those of the state: beside its own size that of such a coordinate is large, whatever the step."""
        chosen = sc.problem(name)
        stepper = sc.compile_stepper(chosen.system, sc.SVI(2))
        run = stepper.integrate(chosen.q, stepper.momentum(chosen.q, chosen.velocity), h=h, steps=200)
        k = int(np.searchsorted(run.t, run.worst_step_time))
        better = stepper.integrate(run.q[k], run.p[k], h=h / 16, steps=16).q[-1]
        true = np.abs(run.q[k + 1] - better).max() / np.abs(better).max()
        assert true / 10 < run.step_error < 1e-3

    @pytest.mark.second
    @pytest.mark.filterwarnings("error")
    def test_late_or_stepwise_push_does_not_warn(self):
        constrained = lagrange("held", "x", "x_dot**2/2 - x**2/2 + u*x", inputs="u")
        stepper = sc.compile_stepper(constrained, "svi:1")
        stepper.integrate([0.0], [0.0], inputs={"u": ([0.0, 1.0, 1.1, 30.0], [0.0, 0.0, 1.0, 1.0])}, h=0.1, t_end=30.0)
        going = stepper.start([0.0], [0.0], h=0.1)
        for k in range(200):
            going.set_inputs(u=math.cos(0.1 * k))
            going.record(1)
        assert 0.0 < going.step_error < 1e-3

    @pytest.mark.tiers(0, 2)
    @pytest.mark.sampled(2)
    @pytest.mark.parametrize("method", ["svi:1", "svi:2", "svi:3", "svi:4"])
    def test_impulse_misjudged_by_the_first_step_warns(self, method):
        """A flight goes on from it, whose way grows: the momentum is as wrong as ever."""
        blow = lagrange("blow", "x", "x_dot**2/2 + x*exp(-(t/0.03)**2)")
        with pytest.warns(sc.AccuracyWarning, match="h = 0.1 is too large: .* from t = 0 is"):
            run = sc.compile_stepper(blow, method).integrate([0.0], [0.0], h=0.1, steps=200)
        assert abs(run.p[-1, 0] / (0.03 * math.sqrt(math.pi) / 2) - 1.0) > 1e-3

    @pytest.mark.second
    @pytest.mark.parametrize("steps", [3, 30])
    def test_growth_from_the_origin_with_too_long_steps_warns(self, steps):
        unstable = sc.LagrangianSystem.from_text(name="unstable", coordinates=["x"], lagrangian="x_dot**2/2 + x**2/2")
        with pytest.warns(sc.AccuracyWarning, match="too large"):
            sc.compile_stepper(unstable, "svi:1").integrate([0.0], [1e-6], h=1.0, steps=steps)

    def test_close_encounter_from_far_warns(self):
        """Positions shrink to a fortieth of the previous ones; momenta are at their maximum."""
        stepper = sc.compile_stepper(sc.problem("kepler").system, "svi:4")
        with pytest.warns(sc.AccuracyWarning, match="h = 0.02 is too large: .* from t = 3.14 is"):
            stepper.integrate([1.95, 0.0], [0.0, math.sqrt(2 / 1.95 - 1)], h=0.02, steps=300)

    def test_missing_error_estimate_is_reported(self):
        verlet = sc.compile_stepper(sc.problem("kepler").system, sc.StoermerVerlet())
        trajectory = verlet.integrate([1.0, 0.0], [0.0, 1.0], h=0.1, steps=3)
        assert math.isnan(trajectory.step_error)
        assert "unknown: the method" in trajectory._repr_html_()
        words = "run kepler --method stoermer-verlet --step 0.1 --steps 3"
        assert "largest local error: unknown" in output_of(words)


@pytest.fixture(scope="module")
def pair():
    text = """
        sum(i in N, sum(a in 2, x_dot[i, a]**2)/2)
        + sum(i < j in N, 1/sqrt(sum(a in 2, (x[i, a] - x[j, a])**2)))
        """
    return lagrange("falling", ["x[N, 2]"], text)


class TestLostEnergy:
    def test_energy_loss_in_a_near_collision_is_reported(self, kepler):
        """Each step keeps its tolerance; at the pericentre, 5e-7 from the centre, the speed is a thousandfold."""
        with pytest.warns(
            sc.AccuracyWarning, match=r"energy changed from -1 to \S+ although every step.*Reduce the tolerance"
        ):
            far = kepler.integrate([1.0, 0.0], [0.0, 1e-3], t_end=3.0, tolerance=1e-6)
        energy = far.energy()
        assert abs(energy[-1] - energy[0]) > 1e-3

    @pytest.mark.second
    @pytest.mark.filterwarnings("error")
    def test_no_report_if_energy_is_conserved_or_need_not_be(self, kepler):
        kepler.integrate([1.0, 0.0], [0.0, 1e-3], t_end=3.0, check_growth=False)
        driven = lagrange("driven", "q", "q_dot**2/2 - q**2/2 + 5*q*sin(t)")
        run = sc.compile_stepper(driven, "svi:4").integrate([0.1], [0.0], t_end=20.0, tolerance=1e-8)
        energy = run.energy()
        assert abs(energy[-1] - energy[0]) > 1.0

    def test_energy_loss_of_one_trajectory_of_an_ensemble_is_reported(self, kepler):
        """The orbit that is nearly a line is reported; the other conserves its energy."""
        starts = [[1.0, 0.0]] * 2, [[0.0, 1.0], [0.0, 1e-3]]
        with pytest.warns(
            sc.AccuracyWarning, match=r"energy of trajectory 1 changed from -1 to \S+ although every step"
        ):
            kepler.integrate_ensemble(*starts, t_end=3.0, tolerance=1e-6)

    @pytest.mark.second
    @pytest.mark.parametrize(
        ("method", "aside", "steps", "message"),
        [
            ("svi:8", 3e-4, {"t_end": 2.25, "tolerance": 1e-5, "check_growth": False}, "although every step met"),
            ("stoermer-verlet", 0.0, {"h": 0.01, "steps": 400}, "although the system conserves it.* Reduce h"),
        ],
    )
    def test_energy_loss_of_array_systems_is_reported(self, pair, method, aside, steps, message):
        """Two bodies that fall past each other, or onto each other, where the step jumps over the collision."""
        stepper, start = sc.compile_stepper(pair, method), [[-0.987, 0.0], [1.0, 0.0]]
        with pytest.warns(sc.AccuracyWarning, match=rf"energy changed from -0.5\d* to \S+ {message}"):
            run = stepper.integrate(start, velocity=[[0.0, aside], [0.0, -aside]], **steps)
        assert abs(run.energy()[-1] - run.energy()[0]) > 0.1


class TestTolerances:
    @pytest.mark.second
    def test_near_collision_is_integrated_or_rejected(self):
        words = "run kepler --q 1.999,0 --velocity 0,0.022366272 --span 18.849555921538759"
        assert re.search(r"q1 =\s+1\.99", output_of(words, "--tolerance", "1e-9"))
        refused = error_of(words, "--advise", "1e-9", status=1)
        assert re.search(r"(is missed: the error is \S+|have a close encounter); use adaptive step size", refused)

    @pytest.mark.rotated
    @pytest.mark.parametrize(
        ("name", "method"), [("planar-pendulum", "svi:2"), ("cart-pole", "svi:3"), ("harmonic-oscillator", "svi:3")]
    )
    def test_overestimated_error_is_not_a_violation(self, name, method):
        """If a force passes through zero on a step, its leading coefficient overestimates the error."""
        problem, tolerance = sc.problem(name), 1e-9
        stepper = sc.compile_stepper(problem.system, method)
        p = stepper.momentum(problem.q, problem.velocity) if problem.p is None else problem.p
        advice = sc.advise(problem.system, method, problem.q, p, 20.0, tolerance)
        found = stepper.integrate(problem.q, p, h=advice.h, steps=advice.steps)
        assert found.step_error > 50 * tolerance
        assert missed_tolerance(found, tolerance) == ""
        best = sc.compile_stepper(problem.system, "svi:8").integrate(problem.q, p, t_end=20.0)
        error = np.linalg.norm(found.q[-1] - best.q[-1]) / np.linalg.norm(best.q[-1])
        assert error < tolerance
        assert "is missed: the error is" in missed_tolerance(found, error / 5)

    def test_withdrawn_tolerance_is_reported(self, monkeypatch):
        command = "scvi_codegen.extras.advice.advice.missed_tolerance"
        monkeypatch.setattr(command, lambda *_: "the tolerance is not kept")
        assert "the tolerance is not kept" in error_of("run kepler --span 5 --advise 1e-6", status=1)

    def test_tolerance_below_double_precision_is_reported_before_the_run(self):
        result = invoke("run kepler --span 5 --tolerance 1e-30")
        assert "Warning: tolerance 1e-30 is below double precision" in result.stderr


class TestKnownDigits:
    @pytest.mark.parametrize(
        ("x", "error", "text"),
        [
            (1.23456789, 1e-4, " 1.235"),
            (-123.456, 8.0, "-1e+02"),
            (0.3, 7.0, " no digit (error 7)"),
            (0.0, 1e-9, " 0 within 1e-09"),
            (1e-84, 2e-83, " 0"),
            (0.1, 0.0, " 0.10000000000000001"),
        ],
    )
    def test_correct_digits_are_printed(self, x, error, text):
        assert in_known_digits(x, error, size=1.0) == text
