"""Recommended step sizes reach the requested error, against exact solutions; unreachable tolerances are reported."""

import math
import re
from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest
from mpmath import mp
from notation import lagrange

from scvi_codegen import Advice, LagrangianSystem, StateError, advise, compile_stepper, problem
from scvi_codegen.common.errors import UnresolvedError
from scvi_codegen.interfaces.cli.step_selection import _text
from scvi_codegen.methods import SVI, ExplicitEuler, Gauss, Method, RadauIIA, StoermerVerlet

pytestmark = pytest.mark.long


def kepler_end(eccentricity: float, t: float) -> np.ndarray:
    """Position on the orbit that begins at the pericentre, exactly from the doubles of :func:`kepler_start`."""
    with mp.workdps(40):
        (x, _), (_, v) = kepler_start(eccentricity)
        r, speed = mp.mpf(x), mp.mpf(v)
        a = 1 / (2 / r - speed**2)
        e, n = 1 - r / a, a ** mp.mpf(-1.5)
        E = mp.findroot(lambda E: E - e * mp.sin(E) - n * t, n * t)
        f, g = 1 - a / r * (1 - mp.cos(E)), t - (E - mp.sin(E)) / n
        return np.array([float(f * r), float(g * speed)])


def kepler_start(eccentricity: float) -> tuple[list[float], list[float]]:
    return [1.0 - eccentricity, 0.0], [0.0, math.sqrt((1.0 + eccentricity) / (1.0 - eccentricity))]


def pendulum() -> LagrangianSystem:
    return problem("planar-pendulum").system.with_parameters(m=1.0, l=1.0, g=1.0)


def name(value: object) -> str:
    return value.name if isinstance(value, Method) else str(value)


def achieved(
    system: LagrangianSystem, advice: Advice, q: list[float], p: list[float], exact: np.ndarray, size: float
) -> float:
    run = compile_stepper(system, advice.method).integrate(
        q, p, h=advice.h, steps=advice.steps, save_every=advice.steps
    )
    return float(np.linalg.norm(run.q[-1] - exact)) / size


def assert_achieved(advice: Advice, error: float, tolerance: float) -> None:
    """Half the tolerance is aimed at; high orders miss it where the error is no smooth function of the step.

    The expected error is relative to ranges, which are twice the size of ``error``, and has six deviations of rounding.
    """
    assert advice.warnings == ()
    assert 0.02 * tolerance < advice.expected_error <= tolerance
    assert advice.expected_error / 40.0 < error < 5.0 * advice.expected_error


class TestAchievedErrors:
    @pytest.mark.rotated
    @pytest.mark.sampled(4)
    @pytest.mark.parametrize(
        ("method", "span", "tolerance"),
        [
            (SVI(8), 2000.0, 1e-6),
            (SVI(8), 2000.0, 1e-9),
            (SVI(8), 2000.0, 1e-10),
            (SVI(8), 50_000.0, 1e-6),
            (SVI(8), 50_000.0, 1e-7),
            (SVI(4), 50_000.0, 1e-5),
            (RadauIIA(3), 2000.0, 1e-6),
            (StoermerVerlet(), 100.0, 1e-6),
        ],
        ids=name,
    )
    def test_advised_step_achieves_the_tolerance_beyond_the_pilot_run(
        self, method: Method, span: float, tolerance: float
    ):
        """Errors are extrapolated: linearly, and quadratically for Radau; the step of Stoermer-Verlet by its order."""
        system, (q, p) = problem("kepler").system, kepler_start(0.2)
        advice = advise(system, method, q, p, span, tolerance)
        error = achieved(system, advice, q, p, kepler_end(0.2, span), 1.0)
        assert_achieved(advice, error, tolerance)

    @pytest.mark.rotated
    def test_advice_backward_with_parameters_and_time(self):
        system, span = problem("duffing").system, -40.0
        values = {"gamma": 0.3, "omega": 1.2}
        advice = advise(system, SVI(6), [1.0], [0.0], span, 1e-8, parameters=values, t=3.0)
        assert advice.h < 0.0
        assert advice.h * advice.steps == pytest.approx(span)
        stepper = compile_stepper(system, SVI(6))
        rough, fine = (
            stepper.integrate([1.0], [0.0], h=advice.h / n, steps=n * advice.steps, t=3.0, parameters=values).q[-1]
            for n in (1, 4)
        )
        assert 1e-10 < abs(rough - fine)[0] < 4e-8


def cost(advice: Advice, points: int) -> float:
    """Evaluations for a unit of time, with those of three iterations in addition to those of each step."""
    (row,) = (row for row in advice.evidence if row.h == pytest.approx(advice.h))
    return (row.iterations + 3.0) * math.ceil(points / 8) * 8 / advice.h


class TestDegree:
    @pytest.mark.rotated
    @pytest.mark.sampled(1)
    @pytest.mark.filterwarnings("ignore::scvi_codegen.common.errors.AccuracyWarning")  # two digits are wanted
    @pytest.mark.parametrize("tolerance", [1e-2, 1e-6, 1e-11])
    def test_degree_minimises_the_number_of_evaluations(self, tolerance: float):
        """The count is deterministic: degree 8 fills a SIMD register, lower degrees waste lanes."""
        system, (q, p) = problem("kepler").system, kepler_start(0.2)
        advice = advise(system, SVI(4), q, p, 200.0, tolerance, degree=True)
        costs = {n: cost(advise(system, SVI(n), q, p, 200.0, tolerance), n) for n in (4, 6, 8, 10, 12)}
        assert advice.degree == min(costs, key=costs.__getitem__) == 8
        assert advice.method == SVI(8)
        assert costs[4] > 1.8 * costs[8]
        assert achieved(system, advice, q, p, kepler_end(0.2, 200.0), 1.0) < tolerance

    @pytest.mark.second
    def test_time_of_evidence_is_per_unit_of_time(self, monkeypatch: pytest.MonkeyPatch):
        """Pilot runs over the whole span of one second each."""
        times = count()
        monkeypatch.setattr("scvi_codegen.extras.advice.advice.time", SimpleNamespace(perf_counter=lambda: next(times)))
        advice = advise(pendulum(), SVI(6), [1.5], [0.0], -20.0, 1e-6)
        assert {row.seconds for row in advice.evidence} == {1 / 20}
        found = re.findall(r"h = (-\S+) .* (\S+ \w+) for the whole span\n", _text(advice))
        assert [(float(h), time) for h, time in found] == [
            (pytest.approx(row.h, rel=1e-5), "1 s") for row in advice.evidence if math.isfinite(row.error)
        ]


@pytest.mark.rotated
class TestHonesty:
    @pytest.mark.second
    def test_a_step_for_newton_alone_is_not_advised(self):
        """For a chain of springs, steps beyond the fixed-point limit meet the tolerance at ten times the cost."""
        chosen = problem("fput-chain")
        iterated = compile_stepper(chosen.system, SVI(8), solver="fixed-point")
        p = iterated.momentum(chosen.q, chosen.velocity)
        advice = advise(chosen.system, SVI(8), chosen.q, p, 200.0, 1e-6)
        iterated.integrate(chosen.q, p, h=advice.h, steps=advice.steps, save_every=advice.steps)

    @pytest.mark.rotated
    @pytest.mark.parametrize("span", [100.0, 2000.0, 50_000.0])
    def test_tolerance_below_rounding_is_reported(self, span: float):
        system, (q, p) = problem("kepler").system, kepler_start(0.2)
        advice = advise(system, SVI(8), q, p, span, 1e-17)
        assert any("round-off alone causes an error of about" in warning for warning in advice.warnings)
        error = achieved(system, advice, q, p, kepler_end(0.2, span), 1.0)
        assert 0.02 * advice.expected_error < error < 20.0 * advice.expected_error
        assert 0.1 < advice.h < 1.0  # shorter steps would be for nothing

    @pytest.mark.rotated
    @pytest.mark.sampled(2)
    @pytest.mark.parametrize("method", [SVI(8), StoermerVerlet()], ids=name)
    @pytest.mark.parametrize("span", [50.0, 1000.0])
    def test_chaos_is_reported_as_unpredictable(self, method: Method, span: float):
        entry = problem("double-pendulum")
        p = compile_stepper(entry.system, method).momentum(entry.q, entry.velocity)
        advice = advise(entry.system, method, entry.q, p, span, 1e-6)
        assert advice.expected_error > 1e-2
        assert any("chaos" in warning for warning in advice.warnings)

    @pytest.mark.rotated
    @pytest.mark.parametrize(("k", "direction"), [(1.0, 1), (4.0, -1)])
    def test_growth_times_are_those_of_a_saddle(self, k: float, direction: int):
        """Errors of a motion that decays at a saddle grow tenfold in log(10)/sqrt(k)."""
        saddle = lagrange("saddle", "q", "q_dot**2/2 + k*q**2/2", k=k)
        rate, span = math.sqrt(k), direction * 40.0 / math.sqrt(k)
        advice = advise(saddle, SVI(6), [1.0], [-direction * rate], span, 1e-6)
        words = " ".join(advice.warnings)
        found = re.search(r"tenfold every (\S+) units of time .* meets it until t = (\S+)$", words)
        assert found is not None
        tenfold, until = map(float, found.groups())
        assert tenfold == pytest.approx(math.log(10.0) / rate, rel=0.1)
        assert abs(until) == pytest.approx(math.log(1e-6 / 2.0**-53) / rate, rel=0.1)

    def test_chaotic_system_over_a_short_span_is_not_called_chaotic(self):
        entry = problem("double-pendulum")
        stepper = compile_stepper(entry.system, SVI(8))
        p = stepper.momentum(entry.q, entry.velocity)
        advice = advise(entry.system, SVI(8), entry.q, p, 10.0, 1e-5)
        assert advice.warnings == ()
        ends = [stepper.integrate(entry.q, p, h=advice.h / n, steps=n * advice.steps).q[-1] for n in (1, 3)]
        assert 1e-7 < np.linalg.norm(ends[0] - ends[1]) / np.linalg.norm(ends[1]) < 2e-5

    @pytest.mark.rotated
    def test_quadratic_error_growth_is_extrapolated_quadratically(self):
        system, (q, p) = problem("kepler").system, kepler_start(0.5)
        advice = advise(system, RadauIIA(3), q, p, 50_000.0, 1e-6)
        found = re.search(r"covered \S+ of 5e\+04, where errors grew like t\^(\d\.\d)", advice.message)
        assert found is not None
        assert 1.7 < float(found[1]) < 2.3

    def test_trajectory_that_ends_is_reported(self):
        system = LagrangianSystem.from_text(name="runaway", coordinates=["q"], lagrangian="q_dot**2/2 + q**3/3")
        with pytest.raises(UnresolvedError, match="may end in a singularity"):
            advise(system, Gauss(2), [1.0], [1.0], 10.0, 1e-6)

    def test_low_order_method_is_advised_a_step_too_short_for_the_pilot(self):
        advice = advise(pendulum(), ExplicitEuler(), [1.5], [0.0], 10.0, 1e-6)
        assert "was not tried: the error is extrapolated by order 1" in advice.message
        assert advice.steps > 10**6

    @pytest.mark.parametrize(("q", "p"), [([0.3], [0.0]), ([0.0], [1e-3])])
    def test_turning_points_give_correct_advice(self, q: list[float], p: list[float]):
        advice = advise(pendulum(), SVI(6), q, p, 100.0, 1e-9)
        assert advice.warnings == ()
        stepper = compile_stepper(pendulum(), SVI(6))
        ends = [stepper.integrate(q, p, h=advice.h / n, steps=n * advice.steps).q[-1, 0] for n in (1, 4)]
        assert abs(ends[0] - ends[1]) <= 4e-9 * max(*np.abs(q), *np.abs(p))

    @pytest.mark.tiers(4)
    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"tolerance": 0.0}, "the tolerance must be positive, not 0.0"),
            ({"tolerance": math.nan}, "the tolerance is nan"),
            ({"span": 0.0}, "the span is 0"),
            ({"span": math.inf}, "the span is inf"),
            ({"q": [1.0, 2.0]}, "q must have shape"),
            ({"parameters": {"mass": 1.0}}, "there is no parameter 'mass'"),
        ],
    )
    def test_invalid_arguments_are_named(self, changes: dict[str, object], message: str):
        arguments: dict[str, object] = {"q": [1.0], "p": [0.0], "span": 10.0, "tolerance": 1e-6} | changes
        with pytest.raises(StateError, match=message):
            advise(pendulum(), SVI(6), **arguments)  # type: ignore[arg-type]


class TestEnsembles:
    ECCENTRICITIES = (0.1, 0.6, 0.3, 0.2)

    def advised(self) -> Advice:
        q, p = map(np.array, zip(*map(kepler_start, self.ECCENTRICITIES), strict=True))
        return advise(problem("kepler").system, SVI(6), q, p, 100.0, 1e-8)

    @pytest.mark.rotated
    def test_step_is_that_of_the_worst_trajectory(self):
        """The errors of all trajectories, against the exact solution, are within the tolerance."""
        advice, system = self.advised(), problem("kepler").system
        assert advice.member == 1
        assert "Trajectory 1 (from 0) of the ensemble has the largest error." in advice.message
        alone = [advise(system, SVI(6), *kepler_start(e), 100.0, 1e-8).steps for e in self.ECCENTRICITIES]
        assert 0.8 * max(alone) < advice.steps < 1.25 * max(alone)
        for e in self.ECCENTRICITIES:
            assert achieved(system, advice, *kepler_start(e), kepler_end(e, 100.0), 1.0) < 1e-8

    @pytest.mark.rotated
    def test_parameters_of_each_trajectory_count(self):
        """Oscillators of frequencies 1 and 5: the step is that of the second."""
        system, states = lagrange("oscillator", "q", "q_dot**2/2 - k*q**2/2", k=1.0), ([[1.0], [1.0]], [[0.0], [0.0]])
        advice = advise(system, SVI(4), *states, 10.0, 1e-6, parameters={"k": [1.0, 25.0]})
        assert advice.member == 1
        alone = advise(system, SVI(4), [1.0], [0.0], 10.0, 1e-6, parameters={"k": 25.0})
        assert advice.steps == pytest.approx(alone.steps, rel=0.1)


@pytest.mark.rotated
def test_symplecticity_is_not_claimed_under_forces():
    saved = advise(problem("duffing").system, SVI(4), [0.5], [0.0], 5.0, 1e-6)
    damped = lagrange("damped", "q", "q_dot**2/2 - q**2/2", dissipation="q_dot**2/10")
    assert "symplectic" in saved.message
    assert "symplectic" not in advise(damped, SVI(4), [0.5], [0.0], 5.0, 1e-6).message


@pytest.mark.second
@pytest.mark.parametrize(("origin", "amplitude"), [(1000.0, 1.0), (0.0, 1e-9)])
def test_recommended_steps_depend_neither_on_the_origin_nor_on_the_amplitude(origin, amplitude):
    text = "x_dot**2/2 - (x - c)**2/2 - (x - c)**4/(4*a**2)"
    vibrating = LagrangianSystem.from_text("vibrating", ["x"], text, parameters={"c": 0.0, "a": 1.0})
    steps = [
        advise(vibrating, SVI(4), [c + a], [0.0], span=100.0, tolerance=1e-6, parameters={"c": c, "a": a}).steps
        for c, a in ((0.0, 1.0), (origin, amplitude))
    ]
    assert 0.9 * steps[0] <= steps[1] <= 1.1 * steps[0]
