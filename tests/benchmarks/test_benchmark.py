"""The benchmark's own arithmetic: references against closed forms, equal error, ratios. No peer is needed."""

import csv
import json
import math
import re
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import sympy
from mpmath import mp

import benchmarks as bench
from benchmarks import __main__ as command
from benchmarks import digits, report
from benchmarks.cases import unforced
from benchmarks.cases.adaptive import adaptive_case
from benchmarks.cases.forced import driven_pendulum
from benchmarks.cases.references import equal_steps, gauss_tables, reference, rms_error, states_after
from benchmarks.cases.rods import rods
from benchmarks.cases.suites import SUITE_CASES, SUITE_ENDS, suite_case
from benchmarks.contenders import peers
from benchmarks.contenders.tracing import rates_text
from benchmarks.report import FLOOR, Point, ResultTable, common_error, time_at
from scvi_codegen import SVI, StateError, compile_stepper

ROOT = Path(bench.__file__).parents[1]
EXTENDED = np.finfo(np.longdouble).eps < 1e-18
needs_extended = pytest.mark.skipif(not EXTENDED, reason="long double is no wider than double here")


def points(*pairs):
    return [Point(seconds=seconds, error=error) for seconds, error in pairs]


def short(name, span):
    return replace(unforced.case(name), span=span)


MOVED = (
    {name: partial(unforced.case, name) for name in sorted(unforced.CASES.keys() - {"fput-chain:64", "fput-chain:256"})}
    | {"forced:double-pendulum": driven_pendulum}
    | {name: partial(adaptive_case, name) for name in ("comet", "pythagorean", "hill", "swinging-atwood")}
    | {name: partial(suite_case, name) for name in SUITE_CASES.keys() - {"sciml:henon-heiles", "sciml:pendulum"}}
    | {f"rods:{n}": partial(rods, n) for n in (2, 5)}
)
"""Systems with accelerations solved by hand."""


class TestCases:
    @pytest.mark.tiers(2, 2)
    @pytest.mark.sampled(4)
    @pytest.mark.parametrize("name", MOVED)
    def test_hand_solved_accelerations_are_those_of_the_equations_of_motion(self, name):
        """d/dt L_v = L_q + f at a random state and time."""
        chosen = MOVED[name]()
        system, t = chosen.system, mp.mpf(0.7)
        x = [mp.mpf(int(value)) / 1000 for value in np.random.default_rng(3).integers(100, 600, 2 * chosen.dimension)]
        functions = SimpleNamespace(sin=mp.sin, cos=mp.cos, sqrt=mp.sqrt, time=t)
        accelerations = chosen.formulations[0].rates(x, chosen.parameters, functions)[chosen.dimension :]
        arguments = [*system.coordinates, *system.velocities, system.time, *system.parameters]
        momenta = sympy.Matrix([system.lagrangian]).jacobian(system.velocities)
        forces = sympy.Matrix([system.lagrangian]).jacobian(system.coordinates)
        forces += sympy.Matrix([system.forces or [0] * chosen.dimension])
        rest = momenta.jacobian(system.coordinates) * sympy.Matrix(system.velocities) + momenta.diff(system.time).T
        terms = sympy.lambdify(arguments, [momenta.jacobian(system.velocities), rest, forces.T], "mpmath", cse=True)
        masses, others, forces = terms(*x, t, *system.defaults)
        assert mp.norm(masses * mp.matrix(accelerations) + others - forces) < 1e-12 * (1 + mp.norm(forces))
        assert any(force != 0 for force in system.forces) == name.startswith("forced")

    @pytest.mark.rotated
    def test_published_end_of_the_suite_of_heyoka_is_reached(self):
        """Sun, Jupiter and Saturn after 100,000 years: positions of published quadruple precision, within 4e-9."""
        chosen = suite_case("heyoka:three-bodies")
        stepper = compile_stepper(chosen.system, "svi:8")
        run = stepper.integrate(chosen.q[0], velocity=chosen.velocity[0], t_end=chosen.span, check_growth=False)
        assert rms_error(run.q[-1:], SUITE_ENDS["heyoka:three-bodies"](chosen, None)) < 4e-9

    def test_traced_text_computes_the_same(self):
        chosen = unforced.case("outer-solar-system")
        text = rates_text(chosen.formulations[0].rates, chosen.parameters, 36)
        names = {"sqrt": math.sqrt}
        exec(text, names)
        x = [*chosen.q[0], *chosen.velocity[0]]
        out = np.empty(36)
        names["rates"](out, 0.0, x, 0)
        np.testing.assert_allclose(out, chosen.formulations[0].rates(x, chosen.parameters, math), rtol=1e-13)

    def test_the_loops_of_a_chain_compute_the_same(self):
        chosen = unforced.case("fput-chain:8")
        names = {}
        exec(chosen.loops, names)
        x, out = np.random.default_rng(5).standard_normal(16), np.empty(16)
        names["rates"](out, 0.0, x, 0)
        np.testing.assert_allclose(out, chosen.formulations[0].rates(list(x), chosen.parameters, math), rtol=1e-13)


class TestDigits:
    def test_times_are_compared_at_twice_the_larger_error_below_those_of_doubles(self):
        ours, peer = points((1.0, 1e-20), (2.0, 1e-30)), points((10.0, 1e-15), (400.0, 5e-27))
        middle, row = digits.compared(ours, peer, (1e-12, 1e-20, 1e-28))  # those at which both curves have points
        assert middle["at_error"] == 1e-20
        assert middle["our_ms"] == pytest.approx(1e3)
        assert row["at_error"] == pytest.approx(1e-26)
        assert row["our_ms"] == pytest.approx(1e3 * 2**0.6)
        assert 300 < row["peer_ms"] / 1e3 < 400
        assert [*digits.compared(ours, [], ())] == [{"our_smallest": 1e-30, "smallest": None}]


def kepler_position(q, v, t):
    """The orbit through double q and v about a unit mass, by Kepler's equation with 40 digits."""
    with mp.workdps(40):
        q, v = ([mp.mpf(float(x)) for x in part] for part in (q, v))
        r, speed = mp.hypot(*q), mp.hypot(*v)
        a = 1 / (2 / r - speed**2)
        rate = a ** mp.mpf("-1.5")
        sine, cosine = (q[0] * v[0] + q[1] * v[1]) / mp.sqrt(a), 1 - r / a
        ahead = mp.findroot(lambda x: x - cosine * mp.sin(x) + sine * (1 - mp.cos(x)) - rate * t, rate * t)
        f = 1 - a / r * (1 - mp.cos(ahead))
        g = t - (ahead - mp.sin(ahead)) / rate
        return [f * x + g * y for x, y in zip(q, v, strict=True)]


@needs_extended
class TestReference:
    def test_tables_integrate_polynomials(self):
        a, b, guess = gauss_tables(16)
        c = a.sum(axis=1)
        assert abs(b.sum() - 1) < 1e-18
        assert np.abs(a @ c**5 - c**6 / 6).max() < 1e-18
        assert np.abs(guess @ c**3 - (1 + c) ** 3).max() < 1e-8

    @pytest.mark.rotated
    def test_kepler_against_its_closed_form(self):
        chosen = short("kepler:0.5", 40.0)
        found = reference(chosen)
        exact = [kepler_position(q, v, 40) for q, v in zip(chosen.q, chosen.velocity, strict=True)]
        exact = np.array([[np.longdouble(mp.nstr(x, 25)) for x in row] for row in exact])
        assert np.abs(found.positions - exact).max() < 2e-16
        assert found.accuracy < 2e-16

    def test_driven_oscillator_with_a_span_that_is_no_multiple_of_the_step(self):
        start = np.array([[1.0, 0.0]], dtype=np.longdouble)
        steps = equal_steps(10.1, 0.75)
        end = states_after(lambda x, t: np.stack([x[..., 1], 3 * np.cos(2 * t) - x[..., 0]], axis=-1), start, steps)
        t = np.longdouble(10.1)
        exact = [2 * np.cos(t) - np.cos(2 * t), 2 * np.sin(2 * t) - 2 * np.sin(t)]
        assert np.abs(end[0] - exact).max() < 4e-18

    @pytest.mark.rotated
    def test_reference_is_stored_and_reloaded(self, monkeypatch):
        chosen = short("planar-pendulum", 5.0)
        first = reference(chosen)

        def again(*arguments: object) -> None:
            pytest.fail("again")

        monkeypatch.setattr("benchmarks.cases.references._compute", again)
        assert np.array_equal(reference(chosen).positions, first.positions)
        with pytest.raises(BaseException, match="again"):
            reference(short("planar-pendulum", 6.0))


class TestCurves:
    def test_interpolates_log_time_against_log_error(self):
        curve = points((1e-3, 1e-4), (4e-3, 1e-8), (16e-3, 1e-12))
        assert time_at(curve, 1e-6) == pytest.approx(2e-3)
        assert time_at(curve, 1e-10) == pytest.approx(8e-3)
        assert time_at(curve, 1e-8) == pytest.approx(4e-3)

    def test_curves_are_not_extrapolated(self):
        curve = points((1.0, 1e-4), (2.0, 1e-6))
        assert time_at(curve, 1e-2) == 1.0
        assert time_at(curve, 1e-7) is None
        assert time_at([], 1e-7) is None

    def test_common_error_is_reached_by_both_programs(self):
        one, other = points((1.0, 1e-11)), points((1.0, 1e-9), (2.0, 1e-16))
        assert common_error(one, other) == pytest.approx(2e-11)
        assert common_error(other, other) == FLOOR
        assert common_error(one, []) is None


def measurement(method, seconds, error, **changes):
    entries = {"setting": "h=1", "options": "", "compile_seconds": 0.1, "fastest": seconds, "repeats": 3} | changes
    return report.Measurement(method=method, seconds=seconds, error=error, **entries)


def result_of(*found, **skipped):
    return report.CaseResult(
        name="x", span=1.0, dimension=1, reference_accuracy=1e-18, measurements=found, skipped=skipped
    )


class TestReport:
    result = result_of(
        measurement("scvi-codegen svi", 1e-3, 1e-12),
        measurement("heyoka", 5e-3, 1e-13, setting="tol=default"),
        measurement("heyoka", 4e-3, 1e-12),
        measurement("heyoka fast_math", 3e-3, 1e-12),
        measurement("broken", math.nan, math.nan, failure="ArithmeticError: no"),
        cyrk="not installed",
    )

    def test_ratios_are_against_heyoka_by_default_and_at_best_and_against_the_best_peer(self):
        other = measurement("CyRK DOP853", 2e-3, 1e-12)
        ours, _, fast, _ = report.rows(replace(self.result, measurements=(*self.result.measurements, other)))
        assert [ours[key] for key in ("default", "best", "peer")] == [pytest.approx(x) for x in (5.0, 3.0, 2.0)]
        assert fast["best"] == 1.0

    def test_ratios_at_an_error_are_over_the_fastest_of_this_package(self):
        slow, small = measurement("scvi-codegen other", 2e-3, 1e-12), measurement("CyRK DOP853", 5e-4, 1e-8)
        result = replace(self.result, measurements=(*self.result.measurements, slow, small))
        fastest, times = report.ratios_at(result, 1e-9)
        assert fastest == "scvi-codegen svi"
        expected = {"scvi-codegen svi": 1e-3, "scvi-codegen other": 2e-3, "heyoka": 4e-3, "heyoka fast_math": 3e-3}
        assert times == pytest.approx(expected, rel=1e-14)
        line = next(line for line in result.text().splitlines() if line.startswith("  at 1e-09"))
        assert "1 ms by scvi-codegen svi; others over it: heyoka 4, heyoka fast_math 3, scvi-codegen other 2" in line
        assert line.endswith("not reached: broken, CyRK DOP853")


@needs_extended
class TestCommand:
    @pytest.mark.rotated
    def test_runs_without_peers(self, tmp_path, monkeypatch):
        monkeypatch.setattr(peers.importlib.util, "find_spec", lambda name: None)
        path = tmp_path / "out.json"
        messages = []
        plan = bench.Plan(peers=("heyoka", "cyrk", "rebound"), quick=True, methods=(SVI(4),))
        names = ["planar-pendulum", "drift"]
        text = bench.benchmark(names, plan, output=str(path), report_activity=messages.append).text()
        assert "skipped heyoka: heyoka is not installed (pip install 'scvi-codegen[bench]')" in text
        assert "skipped cyrk: CyRK is not installed" in text
        data = json.loads(path.read_text())
        assert [found["name"] for found in data["cases"]] == names[:1]
        assert data["cases"][0]["rows"][0]["best"] is None
        assert max(found["error"] for found in data["cases"][0]["measurements"]) < 1e-6
        assert len(data["tables"][0]["rows"]) == 6
        assert "planar-pendulum: reference" in messages
        table = tmp_path / "out.csv"
        bench.benchmark(names[:1], plan, output=str(table))
        head, *rows = csv.reader(table.read_text().splitlines())
        assert head == ["prob", "name", "setting", "error", "time", "numruns", "compile_time"]
        assert [row[0] for row in rows] == names[:1] * len(data["cases"][0]["measurements"])
        assert float(rows[-1][3]) == data["cases"][0]["measurements"][-1]["error"]

    def test_interrupt_saves_completed_measurements(self, tmp_path, monkeypatch):
        def interrupt(plan, report_activity):
            raise KeyboardInterrupt

        def fail(plan, report_activity):
            raise StateError("no")

        done = ResultTable(name="done", title="kept", columns={"a": ""}, rows=({"a": "b"},))
        sections = {"one": lambda plan, report_activity: done, "bad": fail, "two": interrupt, "three": interrupt}
        monkeypatch.setattr(bench, "SECTIONS", sections)
        path = tmp_path / "out.json"
        shown = []
        found = bench.benchmark(output=str(path), show=shown.append)
        assert [text.strip().splitlines()[0] for text in shown[1:]] == ["done: kept", "bad: failed: no"]
        assert (found.results[0], found.interrupted) == (done, "two")
        assert "bad: failed: no" in found.text()
        assert json.loads(path.read_text())["interrupted"] == "two"
        assert "done: kept" in found.text()


STEPS_TIMED = ("scaling", "threads", "by-hand", "transforms", "newton", "derivatives", "builds")


class TestTables:
    @pytest.mark.rotated
    @pytest.mark.parametrize("section", [*STEPS_TIMED, "bath", "errors", "tolerances"])
    def test_times_of_steps_are_measured(self, section):
        table = bench.SECTIONS[section](bench.Plan(repeats=1, quick=True), lambda text: None)
        timed = [
            name for name, form in table.columns.items() if form.startswith(".") and name not in ("difference", "bias")
        ]
        assert table.rows
        assert all(row.get(name, 1.0) > 0.0 for row in table.rows for name in timed)
        assert all(row["tangent"] > row["step"] for row in table.rows if section == "derivatives")


class TestCommandLine:
    def test_documented_commands_are_accepted(self):
        words = r"python -m benchmarks(\s[^`]*|)`"
        pages = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "docs").rglob("*.md"))
        lines = [line for line in re.findall(words, pages) if "SECTION" not in line]
        assert len(lines) >= 10
        for line in lines:
            context = command.main.make_context("benchmarks", line.split())
            assert all(bench._sections(name) for name in context.params["sections"])
