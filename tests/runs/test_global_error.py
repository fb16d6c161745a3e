"""Global error of whole runs: the estimate bounds the true error, chaos ends what is confirmed, defaults warn."""

import math
import re
from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
from commands import error_of, json_of, output_of
from exact_orbits import motion_stepper, on_an_ellipse
from extrapolation import Real, integrated
from motions import MOTIONS, recorded
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen.runs.accuracy.global_error import _alternative

MASSES = np.array([3, 4, 5], dtype=Real)


def duffing(t, y):
    return np.array([y[1], y[0] - y[0] ** 3 + np.cos(t) / 4 - y[1] / 8])


def made(name, coordinates, lagrangian, **more):
    return sc.LagrangianSystem.from_text(name=name, coordinates=coordinates, lagrangian=lagrangian, **more)


def pythagorean():
    pairs = ((0, 1), (1, 2), (2, 0))
    kinetic = " + ".join(f"{int(m)}*(x{i}_dot**2 + y{i}_dot**2)/2" for i, m in enumerate(MASSES))
    attraction = " + ".join(f"{int(MASSES[i] * MASSES[j])}/sqrt((x{i} - x{j})**2 + (y{i} - y{j})**2)" for i, j in pairs)
    return made("pythagorean", [f"{c}{i}" for i in range(3) for c in "xy"], f"{kinetic} + {attraction}")


PYTHAGOREAN = [1.0, 3.0, -2.0, -1.0, 1.0, -1.0], [0.0] * 6


def true_errors(name, run):
    """Return times and the errors there, relative to the largest range of a coordinate over the run."""
    t, high, low = recorded(name)
    m, forward = high.shape[1] // 2, math.copysign(1.0, t[-1] - t[0])
    t, high, low = (each[forward * t <= forward * run.t[-1]] for each in (t, high, low))
    worst = 0.0
    for states, found, part in zip((run.q, run.p), run.at(t), (slice(m), slice(m, None)), strict=True):
        size = np.ptp(states, axis=0).max() or 1.0  # at rest
        worst = np.maximum(worst, np.abs(found - high[:, part] - low[:, part]).max(axis=1) / size)
    return t, worst


def check_claims(name, run, error):
    """Return the ratio of the estimate to the true error, after checks of all that is claimed."""
    t, true = true_errors(name, run)
    forward = math.copysign(1.0, t[-1] - t[0])
    assert true.max() <= 1.05 * run.global_error, f"{name}: the estimate for {error:g} is no bound"
    assert true[forward * (t - run.confirmed_until) <= 0.0].max() <= error
    assert run.confirmation.confirmed == (run.global_error <= error) == (run.confirmed_until == run.t[-1])
    return run.global_error / true.max()


class TestMotions:
    """Regular and chaotic motions compared with records of 30 digits."""

    @pytest.mark.full
    @pytest.mark.filterwarnings("ignore:the global error")
    def test_a_hundred_estimates_are_bounds_and_close(self):
        """None is false, 97 % of those confirmed that three runs at round-off level attain by a factor of three."""
        ratios, runs, attained = [], [], []
        for name in MOTIONS:
            stepper, start = motion_stepper(name)
            tight = (stepper.integrate(**start, tolerance=each, check_growth=False) for each in (None, 1e-18, 1e-20))
            least = max(true_errors(name, run)[1].max() for run in tight)
            for error in (1e-6, 1e-9, 1e-12):
                run = stepper.integrate(**start, error=error)
                ratios.append(check_claims(name, run, error))
                runs.append(run.confirmation.runs)
                if least < error / 3.0:
                    attained.append(run.confirmation.confirmed)
        assert len(ratios) > 100 > len(attained) > 75, len(attained)
        assert np.mean(attained) >= 0.97
        assert np.median(ratios) < 10.0
        assert np.mean(np.array(runs) <= 2) >= 0.9

    @pytest.mark.second
    @pytest.mark.filterwarnings("ignore:the global error")
    def test_rounding_errors_that_chaos_enlarges_are_part_of_the_estimate(self):
        """To 1e-9: runs at round-off may agree by chance."""
        stepper, start = motion_stepper("duffing")
        check_claims("duffing", stepper.integrate(**start, error=1e-12), 1e-12)

    @pytest.mark.second
    def test_runs_that_agree_by_chance_do_not_confirm_each_other(self):
        """Rounding errors grow a thousandfold: runs with tolerances 1e-14, 1e-17 agree to 3e-15, both off by 3e-13."""
        system = made("d", ["x"], "x_dot**2/2 + x**2/2 - x**4/4", forces={"x": "cos(t)/4 - x_dot/8"})
        start = {"q": [0.8359375], "p": [0.54931640625], "t_end": 39.3681640625}
        run = sc.compile_stepper(system, "svi:6").integrate(**start, error=1e-11)
        exact = integrated(duffing, [*start["q"], *start["p"]], run.t[[0, -1]])[-1]
        assert np.linalg.norm(exact[0] - run.q[-1]) / abs(run.q).max() <= run.global_error <= 1e-11

    @pytest.mark.second
    def test_errors_of_growing_motions_are_relative_to_their_range(self):
        """Of q = p = exp(t)."""
        saddle = sc.compile_stepper(made("saddle", ["q"], "q_dot**2/2 + q**2/2"), "svi:4")
        run = saddle.integrate([1.0], [1.0], t_end=192.0, error=1e-6)
        exact = np.exp(run.t)
        off = np.maximum(abs(run.q[:, 0] - exact), abs(run.p[:, 0] - exact)) / np.ptp(exact)
        assert run.error.relative[-1] == pytest.approx(off.max(), rel=0.05)
        assert 1e-9 < off.max() < 1e-6

    @pytest.mark.second
    def test_a_short_last_step_is_no_close_encounter(self):
        oscillator = made("o", ["x"], "x_dot**2/2 - x**2/2")
        stepper, lost = sc.compile_stepper(oscillator, "svi:6"), SimpleNamespace(estimate=1e-9, requested=1e-9, h=None)
        whole = stepper.integrate([1.0], [0.0], t_end=9.0)
        run = stepper.integrate([1.0], [0.0], t_end=whole.t[-3] + 1e-3)
        assert run.step_sizes[-2] < 0.01 * run.step_sizes[-3]
        assert _alternative(run, lost) == ""

    @pytest.mark.rotated
    def test_time_transformations_can_be_combined(self):
        """Kepler's problem with e = 0.99: one is recommended, and confirms what is not confirmed without it."""
        name, system = "kepler .99", made("k", ["x", "y"], "(x_dot**2 + y_dot**2)/2 + 1/sqrt(x**2 + y**2)")
        stepper, start = motion_stepper(name)
        with pytest.warns(
            sc.AccuracyWarning, match=r"only.* or try a time transformation .* the longest step is \d+ t"
        ):
            run = stepper.integrate(**start, error=1e-9)
        check_claims(name, run, 1e-9)
        for transformed, error in (
            (sc.compile_stepper(sc.reparametrise(system, "frequency"), "svi:8"), 1e-9),
            (sc.compile_stepper(system, "svi:8", time_transformation="frequency"), 1e-6),
        ):
            run = transformed.integrate(**start, error=error)
            assert run.confirmation.confirmed
            check_claims(name, run, error)
            again = transformed.integrate(**start, **run.confirmation.steps)
            assert np.array_equal(again.q, run.q)


@pytest.fixture(scope="module")
def burrau_stepper():
    return sc.compile_stepper(pythagorean(), "svi:8")


@pytest.fixture(scope="module")
def kepler_stepper():
    return sc.compile_stepper(sc.problem("kepler").system, "svi:8")


class TestEnsembles:
    ECCENTRICITIES = np.array([0.0, 0.3, 0.6, 0.9])
    ENDS = np.array([40.0, 30.0, 20.0, 10.0])

    def _start(self):
        e = self.ECCENTRICITIES
        q, v = np.zeros((2, len(e), 2))
        q[:, 0], v[:, 1] = 1 - e, np.sqrt((1 + e) / (1 - e))
        return {"q": q, "velocity": v}

    @pytest.mark.parametrize("threads", [1, 2])
    def test_trajectories_are_those_of_single_runs_bitwise(self, kepler_stepper, threads):
        start = self._start()
        runs = kepler_stepper.integrate_ensemble(**start, t_end=self.ENDS, error=1e-7, threads=threads, save_every=3)
        for j, (t, q, p, *_) in enumerate(runs.each()):
            run = kepler_stepper.integrate(
                start["q"][j], velocity=start["velocity"][j], t_end=self.ENDS[j], error=1e-7, save_every=3
            )
            assert np.array_equal(t, run.t)
            assert np.array_equal(q, run.q)
            assert np.array_equal(p, run.p)
            assert runs.global_error[j] == run.global_error
            assert runs.confirmations[j].tolerance == run.confirmation.tolerance

    @pytest.mark.rotated
    def test_chaotic_and_failed_trajectories_are_named(self):
        """One of them falls into the centre, and one is confirmed."""
        stepper = sc.compile_stepper(
            made("wells", ["x", "y"], "(x_dot**2 + y_dot**2)/2 - cosh(x)*cosh(y)*(x*y)**2"), "svi:8"
        )
        with pytest.warns(
            sc.AccuracyWarning, match=r"confirmed for 1 of 2 trajectories; for trajectory 1 it is until"
        ) as heard:
            runs = stepper.integrate_ensemble(
                [[1.0, 0.0], [1.0, 0.5]], [[0.1, 0.0], [0.3, 0.7]], t_end=150.0, error=1e-9
            )
        assert len(heard) == 1
        assert runs.ok.all()
        assert runs.global_error[0] <= 1e-9 < runs.global_error[1]
        assert runs.confirmed_until[0] == 150.0 > runs.confirmed_until[1]
        kepler = sc.compile_stepper(sc.problem("kepler").system, "svi:4")
        runs = kepler.integrate_ensemble([[1.0, 0.0], [1.0, 0.0]], [[0.0, 1.0], [0.0, 0.0]], t_end=3.0, error=1e-6)
        assert runs.status[0] == "ok" != runs.status[1]
        assert runs.global_error[0] <= 1e-6
        assert np.isnan([runs.global_error[1], runs.confirmed_until[1]]).all()
        assert runs.confirmed_digits[1] == 0


@pytest.mark.rotated
class TestOtherRuns:
    @pytest.mark.second
    def test_saved_states_and_events_are_confirmed(self, kepler_stepper):
        start = {"q": [1.6, 0.0], "p": [0.0, 0.5]}
        at = kepler_stepper.integrate(**start, t_end=50.0, error=1e-9, t_eval=[10.0, 30.0])
        assert at.t.tolist() == [10.0, 30.0]
        assert at.confirmed_until == 50.0
        ended = kepler_stepper.integrate(**start, t_end=50.0, error=1e-9, events=sc.Event("q2", terminal=2))
        assert ended.confirmed_until == ended.t[-1] < 50.0
        exact = on_an_ellipse(start["q"], start["p"], [0.0, *ended.t[1:]])
        assert np.abs(exact[:, :2] - ended.q).max() <= np.ptp(ended.q, axis=0).max() * ended.global_error
        saved = kepler_stepper.integrate(**start, t_end=50.0, error=1e-9, save_every=10)
        assert len(saved) == -(-saved.steps // 10) + 1
        assert saved.global_error <= 1e-9

    @pytest.mark.tiers(0, 1)
    @pytest.mark.parametrize("indexed", [False, True], ids=["scalar", "array"])
    def test_confirmed_runs_with_inputs(self, indexed):
        """x'' = -x + u with u = 1 - t/2 until t = 2, then 0, from t = 0.5: exact."""
        table = (np.array([0.5, 2.0, 6.0]), np.array([0.75, 0.0, 0.0]))
        if indexed:
            system = lagrange("i", "q[N]", "sum(i in N, q_dot[i]**2/2 - q[i]**2/2 + u*q[i])", inputs="u")
            stepper = sc.compile_stepper(system, "svi:6")
        else:
            stepper = sc.compile_stepper(made("i", ["q"], "q_dot**2/2 - q**2/2 + u*q", inputs=["u"]), "svi:6")
        run = stepper.integrate([0.3], [0.1], inputs={"u": table}, t=0.5, t_end=6.0, error=1e-9)
        q = (run.q["q"] if indexed else run.q)[:, 0]

        def pushed(t):
            """The particular solution is 1 - t/2."""
            s = t - 0.5
            return (0.3 - 0.75) * np.cos(s) + (0.1 + 0.5) * np.sin(s) + 1 - t / 2

        at, rate = pushed(2.0), -(0.3 - 0.75) * np.sin(1.5) + 0.6 * np.cos(1.5) - 0.5
        free = at * np.cos(run.t - 2.0) + rate * np.sin(run.t - 2.0)
        exact = np.where(run.t <= 2.0, pushed(run.t), free)
        assert np.abs(q - exact).max() <= run.global_error <= 1e-9
        assert run.confirmed_until == 6.0


def loaded(path):
    with np.load(path) as file:
        return dict(file)


class TestCommandLine:
    def test_text_and_json_agree_with_the_states(self, tmp_path):
        words = ["run", "kepler", "--span", "20", "--error", "1e-9", "-o", tmp_path / "orbit.npz"]
        printed = output_of(*words)
        document = json_of(*words)
        found, saved = document["global_error"], loaded(tmp_path / "orbit.npz")
        exact = on_an_ellipse(saved["q"][0], saved["p"][0], saved["t"])
        size = np.linalg.norm(saved["q"], axis=1).max()
        assert f"global error: {found['estimate']:.1e} (relative), of {found['runs']} run" in printed
        assert np.linalg.norm(exact[:, :2] - saved["q"], axis=1).max() / size <= found["estimate"] <= 1e-9
        assert found["digits"] == math.floor(-math.log10(found["estimate"])) >= 9
        assert (found["requested"], found["confirmed"], found["confirmed_until"]) == (1e-9, True, saved["t"][-1])

    @pytest.mark.rotated
    def test_unconfirmed_result_exits_with_1(self):
        assert re.search(
            r"the bound 1e-09 on the global error is confirmed only until t = [\d.]+",
            error_of("run", "double-pendulum", "--span", "40", "--error", "1e-9", status=1),
        )

    @pytest.mark.parametrize(
        ("run", "words", "message"),
        [
            ("error = 1e-9\ntolerance = 1e-9", [], "[run] tolerance and [run] error exclude each other"),
            ("error = 1e-9\nstep = 0.1", [], "[run] step and [run] error exclude each other"),
            ("error = 2.0", [], "[run] error = 2 must be positive and below 1"),
        ],
    )
    def test_invalid_files_are_rejected(self, tmp_path, run, words, message):
        path = tmp_path / "kepler.toml"
        path.write_text(f'[system]\ncatalogue = "kepler"\n[run]\nspan = 20.0\n{run}\n')
        assert message in error_of("run", path, *words)

    @staticmethod
    def _kepler(folder):
        path = folder / "kepler.toml"
        path.write_text('[system]\ncatalogue = "kepler"\n[run]\nspan = 20.0\nerror = 1e-9\n')
        return path


@pytest.mark.rotated
@pytest.mark.parametrize("power", [-660, 660])
def test_global_errors_of_linear_systems_are_scale_invariant(power):
    """Squares of such states overflow, or are 0."""
    stepper = sc.compile_stepper(made("oscillator", ["q"], "q_dot**2/2 - q**2/2"), "svi:4")
    one, other = (stepper.integrate([size], [0.0], t_end=3.0, error=1e-8) for size in (1.0, 2.0**power))
    assert other.confirmation.confirmed
    assert other.global_error == pytest.approx(one.global_error, rel=0.5)


@pytest.mark.second
@pytest.mark.parametrize("precision", ["double", "double-double"])
def test_a_rod_that_hardly_swings_is_confirmed_in_few_steps(precision):
    """Its height, 1 - a^2/2, loses the digits that the constraint gives back."""
    rod = lagrange("rod", "x y", "(x_dot**2 + y_dot**2)/2 - g*y", g=9.81, constraints=["x**2 + y**2 - 1"])
    angle = sc.compile_stepper(lagrange("angle", "u", "u_dot**2/2 + g*cos(u)", g=9.81), "svi:6")
    stepper = sc.compile_stepper(rod, "svi:4", precision=precision)
    for swing in (1.0, 1e-3, 1e-5, 1e-7):
        run = stepper.integrate([math.sin(swing), -math.cos(swing)], velocity=[0.0, 0.0], t_end=3.0, error=1e-8)
        assert run.confirmation.confirmed
        assert run.steps < 200
        u = angle.integrate([swing], [0.0], t_end=3.0, tolerance=1e-14).q[-1, 0]
        assert abs(float(run.q[-1, 0]) - math.sin(u)) < 1e-8 * swing


def test_times_far_from_zero_are_rounded_and_said_to_be():
    """Formulas of the time see t to half an ulp, whatever the steps: that is neither a narrow force nor an error."""
    stepper = sc.compile_stepper(lagrange("late", "x", "x_dot**2/2 + x*cos(t - a)", a=0.0), "svi:8")
    for late, warning in ((1e6, nullcontext()), (1e9, pytest.warns(sc.AccuracyWarning, match="begin at t = 0: at t"))):
        with warning:
            run = stepper.integrate([0.0], [0.0], t=late, t_end=late + 5.0, parameters={"a": late}, error=1e-9)
        assert abs(run.q[-1, 0] - (1.0 - math.cos(5.0))) < np.ptp(run.q) * run.global_error < 1e-6
