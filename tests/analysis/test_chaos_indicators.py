"""Chaos indicators compared with closed forms, variational equations by DOP853 and published values."""

import pickle

import numpy as np
import pytest
from notation import hamilton, lagrange
from numpy.testing import assert_allclose, assert_array_equal
from scipy.integrate import solve_ivp

import scvi_codegen as sc
from scvi_codegen.codegen.ir.variants import TangentVectors
from scvi_codegen.extras.chaos.indicators import SERIES, InitialTangents

pytestmark = pytest.mark.rotated

REGULAR, CHAOTIC = ((0.0, 0.0), (0.5, 0.0)), ((0.0, -0.25), (0.42, 0.0))
"""Of Henon and Heiles near the energy 1/8: Skokos, Bountis & Antonopoulos, Physica D 231 (2007) 30, section 3."""


ROD = lagrange("rod", "x y", "(x_dot**2 + y_dot**2)/2 - y", constraints=["x**2 + y**2 = 1"])


@pytest.fixture(scope="module")
def galaxy():
    return sc.compile_stepper(sc.problem("henon-heiles").system, sc.SVI(2))


def derivative(x, y):
    return np.polyfit(x, y, 1)[0]


@pytest.mark.full
def test_an_exponent_of_henon_and_heiles_is_the_published_one(galaxy):
    """0.047 (Skokos, Bountis & Antonopoulos 2007): the mean over orbits near theirs: one stays near islands long.

    That of the regular orbit goes to 0 as log(t)/t.
    """
    q, p = np.tile(CHAOTIC[0], (12, 1)), np.tile(CHAOTIC[1], (12, 1))
    q[:, 1] += 1e-6 * np.arange(12)
    found = galaxy.chaos_indicators_ensemble(q, p, h=0.2, steps=20_000, count=1)
    assert found.lyapunov_exponents()[-1].mean() == pytest.approx(0.047, abs=0.01)
    regular = galaxy.integrate(*REGULAR, h=0.2, steps=20_000, save_every=2000).lyapunov_exponents(history=True)
    assert regular[-1, 0] < 2 * np.log(4000.0) / 4000.0
    assert regular[-1, 0] < 0.25 * regular[1, 0]


def test_a_saddle_has_the_exponents_of_its_linear_motion():
    """Exponents of x'' = a^2 x with y'' = -b^2 y are a, 0, 0, -a; by a method of high order."""
    saddle = lagrange("saddle", "x y", "(x_dot**2 + y_dot**2 + 0.09*x**2 - 4*y**2)/2")
    run = sc.compile_stepper(saddle, sc.Gauss(4)).integrate([0.0, 0.1], [0.0, 0.0], h=0.1, steps=4000)
    assert_allclose(run.lyapunov_exponents(), [0.3, 0.0, 0.0, -0.3], rtol=0, atol=1e-2)
    deviations = run.chaos_indicators()
    assert deviations.log_gali(2)[-1] < -110.0
    assert derivative(run.t[2000:], deviations.log_gali(2)[2000:]) == pytest.approx(-0.3, rel=1e-3)
    assert derivative(run.t[2000:], deviations.log_gali(4)[2000:]) == pytest.approx(-1.2, rel=1e-3)
    assert derivative(run.t[2000:], run.megno()[2000:]) == pytest.approx(0.15, rel=1e-3)
    assert derivative(run.t[2000:], run.fli()[2000:]) == pytest.approx(0.3, rel=1e-3)


def test_indicators_are_those_of_the_variational_equations(galaxy):
    """Changes, the integrals of MEGNO and volumes of a chaotic orbit by DOP853."""
    run = sc.compile_stepper(sc.problem("henon-heiles").system, sc.SVI(6)).integrate(*CHAOTIC, h=0.02, steps=2500)
    found = run.chaos_indicators(3)
    changes = InitialTangents.checked(run.stepper, 3, None).at(run.q[0], run.p[0], 0.02, 0.0, run.parameters, None)
    assert_allclose(changes.T @ changes, np.eye(3), rtol=0, atol=1e-14)

    def motion(t, z):
        x, y, v = z[0], z[1], z[4:16].reshape(4, 3)
        hessian = np.array([[1 + 2 * y, 2 * x], [2 * x, 1 - 2 * y]])
        moved = np.vstack([v[2:], -hessian @ v[:2]])
        rate = (v[:, 0] @ moved[:, 0]) / (v[:, 0] @ v[:, 0])
        mean = 2.0 * z[16] / t if t else 0.0
        return [z[2], z[3], -x - 2 * x * y, -y - x**2 + y**2, *moved.ravel(), rate * t, mean]

    start = [*CHAOTIC[0], *CHAOTIC[1], *changes.ravel(), 0.0, 0.0]
    ends = solve_ivp(motion, (0, 50.0), start, method="DOP853", rtol=1e-12, atol=1e-13).y[:, -1]
    moved = ends[4:16].reshape(4, 3)
    sizes = np.linalg.norm(moved, axis=0)
    assert_allclose(found.log_norms[-1], np.log(sizes), rtol=0, atol=1e-7)
    assert found.gali(3)[-1] == pytest.approx(np.prod(np.linalg.svd(moved / sizes)[1]), rel=1e-5)
    one, other = (moved / sizes).T[:2]
    smaller = min(np.linalg.norm(one + other), np.linalg.norm(one - other))
    assert found.sali()[-1] == pytest.approx(smaller, rel=1e-5)
    assert found.rates[-1, 0] == pytest.approx(2.0 * ends[16] / 50.0, rel=1e-3)
    assert found.megno()[-1] == pytest.approx(ends[17] / 50.0, rel=1e-3)


def test_regular_and_chaotic_trajectories_are_distinguished(galaxy):
    """MEGNO to 2 or along lambda t / 2; GALI_2 constant, GALI_3 and GALI_4 as t^-2 and t^-4, or exponential."""
    regular, chaotic = (galaxy.integrate(*start, h=0.2, steps=10_000) for start in (REGULAR, CHAOTIC))
    assert regular.megno()[-1] == pytest.approx(2.0, abs=0.1)
    late, found = slice(1000, None), regular.chaos_indicators()
    powers = [derivative(np.log(regular.t[late]), found.log_gali(k)[late]) for k in (2, 3, 4)]
    assert_allclose(powers, [0.0, -2.0, -4.0], rtol=0, atol=0.3)
    assert derivative(np.log(regular.t[late]), found.fli()[late]) == pytest.approx(1.0, abs=0.2)
    assert regular.gali(2).min() > 0.05
    found, t = chaotic.chaos_indicators(), chaotic.t[-1]
    exponents = found.lyapunov_exponents()[-1]
    assert 2.0 * chaotic.megno()[-1] / t == pytest.approx(exponents[0], rel=0.4)
    assert chaotic.fli()[-1] / t == pytest.approx(exponents[0], rel=0.1)
    assert found.log_gali(2)[-1] / t == pytest.approx(exponents[1] - exponents[0], rel=0.15)
    assert found.log_gali(4)[-1] / t == pytest.approx(-4.0 * exponents[0], rel=0.1)
    assert found.log_gali(4)[-1] < -250.0  # where products of lengths would long be rounding
    assert 0.0 < chaotic.sali()[1000] < 1e-2 < regular.sali()[-1]


@pytest.mark.second
def test_maximal_growth_between_saved_states_is_found(galaxy):
    """Between states that are kept, too: of a regular motion, whose changes come and go."""
    run, start = galaxy.integrate(*REGULAR, h=0.2, steps=60), ([REGULAR[0]], [REGULAR[1]])
    greatest = run.chaos_indicators(1).log_norms.max()
    assert run.chaos_indicators(1).log_norms[-1, 0] < greatest - 0.01
    some = galaxy.integrate(*REGULAR, h=0.2, steps=60, save_every=60).chaos_indicators(1)
    assert some.fli()[-1] == pytest.approx(greatest, abs=1e-12)
    many = galaxy.chaos_indicators_ensemble(*start, h=0.2, steps=60, count=1)
    assert many.fli()[-1, 0] == pytest.approx(greatest, abs=1e-12)


def test_friction_moves_the_middle_of_the_spectrum():
    """Pairs add up to minus the damping: Dressler, Phys. Rev. A 38 (1988) 2103."""
    text = "q_dot**2/2 + cos(q)"
    driven = lagrange("driven pendulum", "q", text, forces={"q": "1.5*cos(2*t/3)"}, dissipation="c*q_dot**2/2", c=0.25)
    run = sc.compile_stepper(driven, sc.SVI(4)).integrate([0.2], [0.0], h=0.1, steps=3000)
    assert run.lyapunov_exponents().sum() == pytest.approx(-0.25, abs=1e-6)


def test_constraints_reduce_the_number_of_tangent_vectors():
    """A pendulum of rods: two changes, those of the angle."""
    run = sc.compile_stepper(ROD, sc.SVI(4, "gauss-lobatto:5")).integrate([1.0, 0.0], [0.0, 0.0], h=0.1, steps=4000)
    exponents = run.lyapunov_exponents()
    assert exponents.shape == (2,)
    assert np.abs(exponents).max() < 0.02
    along = run.chaos_indicators(directions=[0.0, 1.0, 0.0, 0.0])  # grows as t
    assert along.log_norms.shape == (4001, 1)
    assert along.megno()[-1] == pytest.approx(2.0, abs=0.15)
    with pytest.raises(sc.StateError, match="count=3 exceeds the 2 directions that the constraints allow"):
        run.chaos_indicators(3)
    with pytest.raises(sc.StateError, match="tangent to the constraints"):
        run.chaos_indicators(directions=[0.0, 0.0, 1.0, 0.0])


def test_ensembles_are_the_same_as_runs(galaxy):
    q, p = np.array([REGULAR[0], CHAOTIC[0], [0.0, 0.95]]), np.array([REGULAR[1], CHAOTIC[1], [0.4, 0.4]])
    done = []
    with np.errstate(all="ignore"):
        found = galaxy.chaos_indicators_ensemble(
            q, p, h=0.2, steps=1200, save_every=200, threads=2, progress=done.append
        )
    assert list(found.status) == ["ok", "ok", found.status[2]]
    assert found.status[2] != "ok"
    assert np.isnan(found.megno()[-1, 2])
    assert done[-1] == 3
    for j, start in enumerate((REGULAR, CHAOTIC)):
        alone = galaxy.integrate(*start, h=0.2, steps=1200, save_every=200).chaos_indicators()
        assert_array_equal(found.t, alone.t)
        assert_allclose(found.log_norms[:, j], alone.log_norms, rtol=1e-5)
        assert_allclose(found.megno()[:, j], alone.megno(), rtol=1e-5)
        assert_allclose(found.lyapunov_exponents()[1:, j], alone.lyapunov_exponents()[1:], rtol=0, atol=1e-6)
        assert_allclose(found.log_gali(3)[:, j], alone.log_gali(3), rtol=1e-5, atol=1e-9)
    last = galaxy.chaos_indicators_ensemble(q[:2], p[:2], h=0.2, steps=3000, count=1, threads=1)
    assert_array_equal(
        last.megno()[-1], galaxy.chaos_indicators_ensemble(q[:2], p[:2], h=0.2, steps=3000, count=1).megno()[-1]
    )
    assert last.megno().shape == (2, 2)


def by_derivatives(stepper):
    """Compute the indicators without code for lanes: each trajectory is followed separately."""
    alone = pickle.loads(pickle.dumps(stepper))
    assert alone._variants[TangentVectors(1)] is None
    return alone


def same(found, other, within):
    for name in SERIES:
        assert_allclose(getattr(found, name), getattr(other, name), rtol=0, atol=within)
    assert_array_equal(found.status, other.status)


FORCED = sc.LagrangianSystem.from_text(
    name="forced",
    coordinates=["x", "y"],
    lagrangian="(m*x_dot**2 + y_dot**2)/2 - x**2/2 - x**2*y**2/4 - y**2",
    parameters={"m": 1.3, "w": 1.1},
    forces={"x": "sin(w*t)*y", "y": "u*cos(x)"},
    inputs=["u"],
)
OPEN = hamilton("open", "x y", "a**2/2 + b**2/3 + x**2*y + x**4 + y**2", momenta="a b")


@pytest.mark.sampled(1)
@pytest.mark.parametrize(
    ("system", "method", "options"),
    [
        (FORCED, sc.SVI(3), {"count": 1, "parameters": {"u_0": 0.3, "m": np.linspace(0.5, 2.0, 11)}}),
        pytest.param(FORCED, sc.Gauss(2), {"h": -0.1, "t": 3.0, "parameters": {"u_0": 0.3}}, marks=pytest.mark.full),
        (FORCED, sc.SpectralCollocation(4), {"directions": np.ones((4, 2)), "parameters": {"u_0": 0.3}}),
        (OPEN, sc.SVI(3), {"count": 3, "save_every": 1, "steps": 20}),
        pytest.param(OPEN, sc.SVI(2, "gauss-lobatto:3"), {"directions": [1.0, 0.0, 2.0, 0.0]}, marks=pytest.mark.full),
    ],
)
def test_lanes_have_the_derivatives_of_the_steps(system, method, options):
    """Logarithms agree to round-off, for eleven trajectories in two blocks."""
    start = 0.4 * np.random.default_rng(1).normal(size=(2, 11, 2))
    stepper = sc.compile_stepper(system, method)
    alone = by_derivatives(stepper)
    options = {"h": 0.1, "steps": 120, "save_every": 40} | options
    found = stepper.chaos_indicators_ensemble(*start, **options)
    assert stepper._variants[TangentVectors(found.log_norms.shape[-1])] is not None
    same(found, alone.chaos_indicators_ensemble(*start, **options), 1e-12)


@pytest.mark.tiers(1)
@pytest.mark.parametrize(
    "given",
    [
        {"h": 0.1, "steps": 300},
        {"t_end": 38.5},
        {"t_end": 38.5, "tolerance": 1e-5},
        {"h": 0.1, "steps": 300, "save_every": 60},
        {"h": 0.2, "steps": 300, "events": sc.Event("y", terminal=True, direction=1)},
    ],
    ids=["fixed", "adaptive", "coarse", "sparse", "ended by an event"],
)
def test_megno_is_the_trapezoidal_sum_over_steps_of_any_size(galaxy, given):
    """The sums are formed from the logarithms of norms after all steps and their times, from t = 2.5."""
    run = galaxy.integrate(*CHAOTIC, t=2.5, **given)
    found = run.chaos_indicators(2)
    assert_array_equal(found.t, run.t)
    whole = galaxy.integrate(*CHAOTIC, t=2.5, **(given | {"save_every": 1})).chaos_indicators(2)
    times = whole.t[:, np.newaxis] - 2.5
    moments = np.cumsum((times[1:] + times[:-1]) / 2 * np.diff(whole.log_norms, axis=0), axis=0)
    rates = np.concatenate([np.zeros((1, 2)), 2 * moments / times[1:]])
    means = np.cumsum((rates[1:] + rates[:-1]) / 2 * np.diff(times, axis=0), axis=0) / times[1:]
    here = np.searchsorted(whole.t, found.t[1:])
    assert_allclose(found.rates[1:], rates[here], rtol=1e-9, atol=1e-9)
    assert_allclose(found.mean_rates[1:], means[here - 1], rtol=1e-9, atol=1e-9)


@pytest.mark.full
def test_regular_and_chaotic_planets_agree_with_rebound():
    """Two of a thousandth of their star; its MEGNO by the variational equations of IAS15, of another change."""
    rebound = pytest.importorskip("rebound")
    pairs = ("01", "02", "12")
    energy = " + ".join(f"m{i}*(x{i}_dot**2 + y{i}_dot**2)/2" for i in "012")
    pull = " + ".join(f"m{i}*m{j}/sqrt((x{i} - x{j})**2 + (y{i} - y{j})**2)" for i, j in pairs)
    planets = lagrange("two planets", "x0 y0 x1 y1 x2 y2", f"{energy} + {pull}", m0=1.0, m1=1e-3, m2=1e-3)
    stepper, span = sc.compile_stepper(planets, sc.SVI(3)), 600 * np.pi
    for distance, regular in ((1.3, False), (1.35, True)):
        known = rebound.Simulation()
        known.add(m=1.0)
        known.add(m=1e-3, a=1.0, e=0.02)
        known.add(m=1e-3, a=distance, e=0.02, f=2.0)
        known.move_to_com()
        q, v = (
            [c for p in known.particles for c in pair(p)] for pair in (lambda p: (p.x, p.y), lambda p: (p.vx, p.vy))
        )
        found = stepper.chaos_indicators_ensemble([q], velocity=[v], h=0.15, steps=round(span / 0.15), count=1).megno()[
            -1, 0
        ]
        known.init_megno(seed=1)
        known.integrate(span)
        if regular:
            assert_allclose([found, known.megno()], 2.0, rtol=0, atol=0.05)
        else:
            assert min(found, known.megno()) > 6.0
