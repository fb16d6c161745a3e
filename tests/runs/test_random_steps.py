"""Random single steps: none that is accepted is wrong by more than 100 times its estimate; spurious solutions."""

import warnings

import numpy as np
import pytest
from notation import lagrange
from random_steps import FAMILIES, WANTED, compiled, displaced, outcome, trials

import scvi_codegen as sc
from scvi_codegen.systems.arrays.system import ArraySystem

pytestmark = pytest.mark.rotated

QUICK = {
    "duffing": ("scvi:3", "auto"),
    "planar-pendulum": ("scvi:6", "auto"),
    "kepler": ("svi:2", "auto"),
    "relativistic": ("svi:2", "auto"),
    "driven": ("sc:3", "auto"),
    "damped": ("gauss:3", "auto"),
    "chain": ("svi:2", "auto"),
    "pendulums": ("svi:2", "newton"),
    "ellipses": ("svi:2", "newton"),
}
REDUNDANT = ("planar-pendulum", "damped", "pendulums")
"""Systems with the iteration of another one of them, for the full tier."""
METHODS = (
    *(sc.SVI(degree) for degree in (2, 3, 4, 5, 6, 8, 12)),
    *(sc.SVI(*sizes) for sizes in ((3, "gauss-legendre:5"), (3, "gauss-lobatto:3"), (4, "gauss-lobatto:4"))),
    *(sc.SCVI(degree) for degree in (2, 3, 4, 6, 8)),
    sc.SCVI(3, variational=False),
    *(sc.SpectralCollocation(degree) for degree in (2, 3, 4, 6)),
    sc.SpectralCollocation(3, form="phase-space"),
    *(sc.Gauss(stages) for stages in (2, 3, 4, 6)),
    *(family(stages) for family in (sc.RadauIIA, sc.RadauIA, sc.LobattoIIIA) for stages in (3, 4)),
    *(family(stages) for family in (sc.ChebyshevGauss, sc.ChebyshevLobatto) for stages in (3, 4)),
)
"""Those that estimate the error of a step."""


def check(name, method, solver, steps):
    found = outcome(compiled(name, method, solver), steps)
    accepted = ~found.refused
    assert accepted.mean() > 0.5
    assert not np.isnan(found.estimates[accepted]).any()
    assert found.ratios.max() <= WANTED, steps[int(found.ratios.argmax())]
    return found


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.full] if name in REDUNDANT else []) for name in QUICK]
)
def test_step_errors_are_bounded_by_their_estimates(name):
    found = check(name, *QUICK[name], trials(name, 150))
    assert (found.errors > 1e-12).sum() > 10  # enough of them have an error to compare


@pytest.mark.full
@pytest.mark.parametrize("solver", ["auto", "newton"])
@pytest.mark.parametrize("method", METHODS, ids=lambda method: method.name)
def test_step_errors_of_all_methods_are_bounded_by_their_estimates(method, solver):
    """10,000 steps of each method that estimates the error of a step."""
    for name in FAMILIES:
        try:
            compiled(name, method, solver)
        except sc.MethodError:
            assert isinstance(FAMILIES[name].system, ArraySystem)
            continue
        check(name, method, solver, trials(name, 1100))


def adaptive_ratio(name, method, solver, q, p, t, tolerance):
    """Error of the first adaptive step of an array over the estimate of its run; None if the run fails."""
    family, stepper = FAMILIES[name], compiled(name, method, solver)
    shape = [axis.number or 1 for axis in stepper.interface.layout.coordinates[0].axes]
    at = [np.reshape(x, [-1, *shape[1:]]) for x in (q, p)]
    with warnings.catch_warnings(action="ignore"):
        try:
            run = stepper.integrate(*at, t=t, t_end=t + 3 * family.period, tolerance=tolerance)
        except sc.StepFailedError:
            return None
    exact = sc.compile_stepper(family.written_out, sc.SVI(12))
    end = exact.integrate(q, p, t=t, t_end=run.t[1]).q[-1]
    return max(displaced(q, end, np.ravel(run.q["x"][1])) - 1e-11, 0.0) / run.step_error


@pytest.mark.parametrize("solver", ["fixed-point", "newton"])
def test_adaptive_array_run_starts_with_a_correct_step(solver):
    """The curve of a step of three periods is smooth: its end was off by 50 times the state, at an estimate of 0.02."""
    for method, q, p, tolerance in (
        ("svi:2", [-0.39936294, 0.54643295], [-1.0628843, -0.90845495], 0.0415577830),
        ("svi:3", [-0.33422731, -0.19620278], [0.07154765, -2.03847018], 0.0061320165),
    ):
        ratio = adaptive_ratio("ellipses", method, solver, np.array(q), np.array(p), 0.0, tolerance)
        assert ratio is not None
        assert ratio < WANTED


@pytest.mark.full
@pytest.mark.parametrize("solver", ["fixed-point", "newton"])
@pytest.mark.parametrize("method", ["svi:2", "svi:3", "svi:4", "svi:6", "svi:8", "gauss:3", "gauss:4"])
def test_adaptive_array_runs_start_with_correct_steps_full_sample(method, solver):
    """At tolerances above 1e-2 the half steps of an accepted step may differ from it by the whole state."""
    for name in (each for each in FAMILIES if isinstance(FAMILIES[each].system, ArraySystem)):
        random = np.random.default_rng(5)
        exact = sc.compile_stepper(FAMILIES[name].written_out, sc.SVI(12))
        ratios = []
        for _ in range(100):
            q, v, t = FAMILIES[name].state(random)
            tolerance = 10.0 ** random.uniform(-7.0, -2.0)
            ratios.append(adaptive_ratio(name, method, solver, q, exact.momentum(q, v, t), t, tolerance))
        accepted = [ratio for ratio in ratios if ratio is not None]
        assert len(accepted) > 80
        assert max(accepted) <= WANTED


SPURIOUS = {
    "planar-pendulum": [
        ("scvi:3", 0.3071399754577905, -1.0088668625585298, 3.2754332164851276),
        ("scvi:6", 0.6144060580820349, 0.8655135641512931, 3.847090915225689),
    ],
    "duffing": [("scvi:3", 0.48772377726415744, -0.43246828955033717, 2.716772389715709)],
}


@pytest.mark.covering
@pytest.mark.parametrize(("name", "flags"), [(name, flags) for name in SPURIOUS for flags in (("-O1",), ("-O2",))])
def test_spurious_solution_is_rejected_or_its_error_reported(name, flags):
    """Their curves are smooth: the energy of the first grows from -0.44 to 591."""
    system = sc.problem(name).system
    for method, q, p, h in SPURIOUS[name]:
        stepper = sc.compile_stepper(system, method, flags=flags)
        exact = sc.compile_stepper(system, sc.SVI(12)).integrate([q], [p], t_end=h).q[-1, 0]
        with warnings.catch_warnings(record=True, action="always") as heard:
            try:
                run = stepper.integrate([q], [p], h=h, steps=1)
            except sc.StepFailedError:
                continue
        error = abs(run.q[-1, 0] - exact) / (2 * (abs(q) + abs(exact - q)))
        assert run.step_error > error / WANTED
        assert error < 1e-2 or any(issubclass(each.category, sc.AccuracyWarning) for each in heard)


@pytest.mark.rotated
def test_run_with_controller_starts_with_a_correct_step():
    """With a tolerance of 1e-2, the error estimate of a step of many periods is too small."""
    stepper = sc.compile_stepper(sc.problem("planar-pendulum").system, "scvi:3")
    exact = sc.compile_stepper(sc.problem("planar-pendulum").system, sc.SVI(12))
    for q, p in [(0.3, -1.0), (0.6, 0.9), (1.4, 0.2)]:
        run = stepper.integrate([q], [p], t_end=6.0, tolerance=1e-2)
        first = exact.integrate([q], [p], t_end=run.t[1]).q[-1, 0]
        assert abs(run.q[1, 0] - first) < 0.3


def test_comparison_with_half_steps_does_not_change_a_run():
    """Every 512th step is compared: what goes from step to step stays, by Newton's iteration, too."""
    system = sc.problem("henon-heiles").system
    start = {"q": [0.1, 0.2], "p": [0.3, 0.1]}
    for solver in ("auto", "newton"):
        stepper = sc.compile_stepper(system, "svi:4", solver=solver)
        whole = stepper.integrate(**start, h=0.1, steps=1030)
        run = stepper.start(**start, h=0.1)
        run.record(512)
        last = run.record(518)
        assert np.array_equal(last.q[-1], whole.q[-1])
        assert whole.step_error < 1e-6


def test_spurious_solutions_are_recognised_in_every_unit_of_mass():
    """Newton's iteration takes the place of a fixed-point iteration that fails in steps of about a period."""
    quartic = lagrange("quartic", "x", "m*(x_dot**2/2 - x**2/2 - x**4/4)", m=1.0)
    stepper, random = sc.compile_stepper(quartic, sc.SVI(3), flags=("-O0",)), np.random.default_rng(5)

    def status(q, v, h, m):
        try:
            stepper.integrate([q], [m * v], h=h, steps=1, parameters={"m": m}, check_growth=False)
        except sc.StepFailedError as failed:
            return failed.status
        return "ok"

    steps = [(*random.uniform(-2.0, 2.0, size=2), random.uniform(0.5, 2.5)) for _ in range(60)]
    found = [[status(*step, m) for step in steps] for m in (1.0, 2.0**20, 2.0**-20)]
    assert found[0] == found[1] == found[2]
    assert found[0].count("spurious solution") > 3
