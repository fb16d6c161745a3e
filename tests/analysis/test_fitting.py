"""Parameter estimation compared with DOP853 and curve_fit, and validity of standard errors."""

import warnings
from functools import cache
from itertools import product

import numpy as np
import pytest
from notation import lagrange
from numpy.testing import assert_allclose
from samples import QUICK_FLAGS, linkage
from scipy.integrate import solve_ivp
from scipy.optimize import curve_fit

import scvi_codegen as sc
from scvi_codegen.extras.fits.multiple_shooting import _bounded_update, _equality_constrained_update

TRUE = {"m": 1.3, "alpha": -1.0, "beta": 0.8, "delta": 0.2, "gamma": 0.3, "omega": 1.2}
NOISE = 0.01
TIMES = np.sort(np.random.default_rng(0).uniform(0.0, 20.0, 150))
GUESS = {"q": [0.7], "velocity": [0.2], "h": 0.1, "start": 0.0, "parameters": TRUE | {"alpha": -0.9, "delta": 0.3}}
SOME = ["alpha", "beta", "delta"]


@cache
def oscillator():
    text = "m*x_dot**2/2 - alpha*x**2/2 - beta*x**4/4"
    system = lagrange(
        "oscillator", "x", text, parameters=TRUE, forces={"x": "gamma*cos(omega*t)"}, dissipation="delta*x_dot**2/2"
    )
    return sc.compile_stepper(system, sc.SVI(6), flags=QUICK_FLAGS)


def exact(t, alpha, beta, delta, x, p):
    """(2, n) positions and momenta, by DOP853."""
    m, gamma, omega = TRUE["m"], TRUE["gamma"], TRUE["omega"]

    def rates(at, y):
        return [y[1] / m, gamma * np.cos(omega * at) - alpha * y[0] - beta * y[0] ** 3 - delta * y[1] / m]

    return solve_ivp(rates, (0.0, t[-1]), [x, p], method="DOP853", t_eval=t, rtol=1e-12, atol=1e-12).y


@cache
def motion():
    return exact(TIMES, TRUE["alpha"], TRUE["beta"], TRUE["delta"], 0.8, 0.1)


def recorded(seed=None):
    values = motion()
    return values if seed is None else values + NOISE * np.random.default_rng(seed).normal(size=values.shape)


@pytest.mark.rotated
def test_noise_free_data_give_the_true_values():
    found = sc.fit(oscillator(), TIMES, recorded()[0], unknown=SOME, **GUESS)
    assert found.names == (*SOME, "x", "p_x")
    assert_allclose(found.values, [TRUE[name] for name in SOME] + [0.8, 0.1], rtol=1e-9)
    assert_allclose([found.q[0], found.p[0]], [0.8, 0.1], rtol=1e-9)
    assert found.parameters == TRUE | dict(zip(SOME, found.values, strict=False))
    assert np.abs(found.residuals).max() < 1e-9


@pytest.mark.rotated
def test_estimates_and_errors_agree_with_curve_fit():
    """curve_fit integrates with DOP853 and uses finite differences."""
    measured = recorded(1)[0]
    found = sc.fit(oscillator(), TIMES, measured, unknown=SOME, **GUESS)
    values, covariance = curve_fit(
        lambda t, *x: exact(t, *x)[0], TIMES, measured, p0=[-0.9, 0.8, 0.3, 0.7, 0.2], xtol=1e-12, ftol=1e-12
    )
    assert_allclose(found.values, values, rtol=1e-6)
    assert_allclose(found.covariance, covariance, rtol=1e-3, atol=1e-3 * np.abs(covariance).max())
    left = np.sqrt((found.residuals**2).sum() / (len(TIMES) - 5))
    assert_allclose(found.deviations, [left], rtol=1e-12)
    assert_allclose(left, NOISE, rtol=0.15)
    assert list(found.standard_errors) == list(found.names)
    assert "alpha = " in str(found)


@pytest.mark.second
def test_several_quantities_with_gaps_and_individual_noise():
    both = recorded(2).T.copy()
    both[:, 1] += 9 * NOISE * np.random.default_rng(3).normal(size=len(TIMES))
    both[::7, 0] = np.nan
    sizes = [NOISE, np.sqrt(82.0) * NOISE]
    found = sc.fit(oscillator(), TIMES, both, observed=["x", "p_x"], deviations=sizes, unknown=SOME, **GUESS)
    alone = sc.fit(oscillator(), TIMES, both[:, 0], deviations=NOISE, unknown=SOME, **GUESS)
    assert_allclose(found.values, alone.values, rtol=0, atol=4 * np.sqrt(np.diag(alone.covariance)).max())
    assert (np.diag(found.covariance) < np.diag(alone.covariance)).all()
    assert np.isnan(found.residuals[::7, 0]).all()
    assert found.deviations.tolist() == sizes
    bounded = sc.fit(oscillator(), TIMES, both[:, 0], bounds={"delta": (0.25, 0.5)}, unknown=SOME, **GUESS)
    assert bounded.values[2] == pytest.approx(0.25, abs=1e-6)


@pytest.fixture(scope="module")
def pushed():
    """Return the stepper of a pushed oscillator, its input, a run, and times of measurements."""
    system = lagrange("pushed", "x", "m*x_dot**2/2 - k*x**2/2", m=1.5, k=2.0, forces={"x": "u"}, inputs="u")
    stepper = sc.compile_stepper(system, sc.SVI(4), flags=QUICK_FLAGS)
    push = {"u": (np.linspace(0.0, 8.0, 9), np.random.default_rng(4).normal(size=9))}
    run = stepper.integrate([0.5], [0.0], inputs=push, h=0.05, t_end=8.0)
    times = np.linspace(0.13, 7.9, 60)
    return stepper, push, run, times


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("segments", [1, 4])
def test_fit_with_known_start_and_tabulated_inputs(pushed, segments):
    """The cart is pushed as measured; what is known is not found."""
    stepper, push, run, times = pushed
    known = {"q": [0.5], "p": [0.0], "start": 0.0, "h": 0.05, "inputs": push, "fit_initial_state": False}
    parameters = {"m": 1.0, "k": 1.0}
    found = sc.fit(stepper, times, run.at(times)[0], parameters=parameters, segments=segments, **known)
    assert found.names == ("m", "k")
    assert_allclose(found.values, [1.5, 2.0], rtol=1e-8 if segments == 1 else 1e-7)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"unknown": [*SOME, "m", "gamma"]}, "do not determine alpha, beta, delta, m and gamma separately"),
        (
            {"unknown": [*SOME, "m", "gamma"]},
            r"one of them as known: name only .* in unknown=\[...\] .*parameters=\{...\}",
        ),
        (
            {"unknown": ["omega"], "parameters": TRUE | {"gamma": 0.0}},
            "do not determine omega: they do not depend on it",
        ),
        (
            {"unknown": SOME, "t": TIMES[:2], "measured": recorded()[0][:2]},
            "2 measurements do not determine 5 unknowns",
        ),
        ({"unknown": [*SOME, "m", "gamma"], "segments": 3}, r"do not join, .* as known"),
    ],
)
def test_unidentifiable_parameters_are_named(options, message):
    with pytest.raises(sc.FitError, match=message):
        sc.fit(oscillator(), **{"t": TIMES, "measured": recorded(5)[0]} | GUESS | options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"parameters": ["m", "beta"]}, r"must be values, as \{'m': 1.0\}, not names: .* in unknown=\['m', 'beta'\]"),
        ({"unknown": ["alfa"]}, "no parameter 'alfa' to estimate; did you mean 'alpha'"),
        ({"observed": ["v"]}, "'v' cannot be observed"),
        ({"observed": ["x", "p_x"]}, r"measured must have shape \(150, 2\) for x, p_x, not \(150,\)"),
        ({"deviations": -1.0}, "deviations must be a positive number"),
        ({"start": 1.0}, "after the first measurement"),
        ({"fit_initial_state": False}, "give p, or fit_initial_state=True"),
        ({"fit_initial_state": False, "velocity": None, "p": [0.0], "unknown": []}, "nothing to estimate"),
        ({"bounds": {"k": (0, 1)}}, "bounds name 'k', which is not an unknown"),
        ({"bounds": {"delta": (0.0, 0.1)}}, r"guess of delta, 0.3, is not between its bounds \(0.0, 0.1\)"),
        ({"bounds": {"delta": (np.nan, 1.0)}}, "the bounds of delta must be .lower, upper., infinite for no bound"),
        ({"unknown": ["alpha", "alpha"]}, "unknown names 'alpha' twice"),
        ({"observed": ["x", "x"]}, "observed names 'x' twice"),
        ({"deviations": np.inf}, "deviations must be a positive number"),
        ({"h": 0.0}, "h = 0 must be positive"),
        ({"measured": np.where(TIMES[3] == TIMES, np.inf, recorded()[0])}, "a value in measured is infinite"),
        ({"t": TIMES[::-1]}, "ascending"),
        ({"segments": 0}, "segments"),
    ],
)
def test_invalid_arguments_are_named(options, message):
    with pytest.raises(sc.StateError, match=message):
        sc.fit(oscillator(), **{"t": TIMES, "measured": recorded()[0], "unknown": SOME} | GUESS | options)


@pytest.mark.rotated
def test_biased_parameters_warn_of_too_long_steps():
    """With large second-order steps, estimates are off by twelve standard errors, which is reported."""
    soft = lagrange("hard", "x", "x_dot**2/2 - a*x**2/2 - b*x**4/4", a=1.0, b=1.0)
    times = np.linspace(0.0, 20.0, 101)
    exact = sc.compile_stepper(soft, sc.SVI(8), flags=QUICK_FLAGS).integrate(
        [1.0], [0.0], h=0.1, steps=200, save_every=2
    )
    noisy = exact.q[:, 0] + 1e-3 * np.random.default_rng(0).normal(size=101)
    coarse, given = sc.compile_stepper(soft, sc.SVI(1), flags=QUICK_FLAGS), {"q": [0.9], "p": [0.1]}
    with pytest.warns(sc.AccuracyWarning, match=r"h is too large for this fit: .* b changes by \S+ standard errors"):
        found = sc.fit(coarse, times, noisy, h=0.2, **given)
    assert abs(found.parameters["b"] - 1.0) > 10.0 * found.standard_errors["b"]
    assert abs(sc.fit(coarse, times, noisy, h=0.02, **given).parameters["b"] - 1.0) < 0.02


@pytest.mark.parametrize("damping", [0.2, 0.15])
def test_chi_squared_tells_a_model_that_fits_from_one_that_does_not(damping):
    """With less damping than that of the data, beta is wrong by many standard errors; with the true one none warns."""
    guess = GUESS | {"parameters": TRUE | {"delta": damping, "beta": 0.85}}
    settings = {"unknown": ["alpha", "beta"], "deviations": NOISE, **guess}
    if damping == 0.15:
        with pytest.warns(
            sc.AccuracyWarning, match=r"the model does not fit the measurements: chi\^2/n = \S+ with n = 146"
        ):
            found = sc.fit(oscillator(), TIMES, recorded(1)[0], **settings)
        assert abs(found.parameters["beta"] - TRUE["beta"]) > 10.0 * found.standard_errors["beta"]
        return
    fits = [sc.fit(oscillator(), TIMES, recorded(seed)[0], **settings) for seed in range(10)]
    values = np.array([found.chi_squared for found in fits])
    away = np.array([np.sum(found.residuals**2) / NOISE**2 for found in fits])
    assert_allclose(values, away, rtol=1e-12)
    assert abs(values.mean() - 146.0) < 4.0 * np.sqrt(2.0 * 146.0 / len(fits))
    assert str(fits[0]).endswith(f"chi^2/n = {values[0] / 146:.3g} with n = 146")


def test_parameter_at_a_bound_has_no_standard_error():
    """The parameter counts as known; other errors are those to first order."""
    bound = {"alpha": (-0.95, 0.0)}
    found = sc.fit(oscillator(), TIMES, recorded(4)[0], unknown=SOME, bounds=bound, **GUESS)
    assert found.at_bounds == ("alpha",)
    assert "alpha = -0.95 at its bound" in str(found)
    assert np.isnan(found.standard_errors["alpha"])
    known = GUESS | {"parameters": GUESS["parameters"] | {"alpha": -0.95}}
    other = sc.fit(oscillator(), TIMES, recorded(4)[0], unknown=SOME[1:], **known)
    assert other.at_bounds == ()
    for name, error in other.standard_errors.items():
        assert found.standard_errors[name] == pytest.approx(error, rel=1e-3)


@pytest.mark.second
def test_constraints_are_not_fitted():
    bars = sc.compile_stepper(linkage(), sc.SVI(1, "gauss-lobatto:2"), flags=QUICK_FLAGS)
    with pytest.raises(sc.MethodError, match="fit is not available with constraints"):
        sc.fit(bars, [0.0, 0.1], np.zeros((2, 4)), q=[0, 1, 1.94, 1.5], p=np.zeros(4), h=0.1)


CHAOTIC = {"l": 0.8, "m": 1.3}


@cache
def two_rods():
    """A double pendulum, of masses as m to 1, and a noisy record of its angles over 17 Lyapunov times."""
    text = "(m + 1)*a_dot**2/2 + l**2*b_dot**2/2 + l*a_dot*b_dot*cos(a - b) + 9.81*((m + 1)*cos(a) + l*cos(b))"
    system = lagrange("two rods", "a b", text, m=1.0, l=1.0)
    stepper = sc.compile_stepper(system, sc.SVI(6), flags=QUICK_FLAGS)
    run = stepper.integrate([2.0, 2.5], [0.0, 0.0], h=0.02, steps=600, save_every=2, parameters=CHAOTIC)
    return stepper, run, run.q + NOISE * np.random.default_rng(0).normal(size=run.q.shape)


@pytest.mark.rotated
def test_chaotic_record_is_fitted_in_segments():
    """Nearby motions part e^17-fold: from its start alone the motion is lost, in segments it is found."""
    stepper, run, noisy = two_rods()
    known = {"q": noisy[0], "p": [0.05, -0.05], "h": 0.02}
    lost = sc.fit(stepper, run.t, noisy, **known)
    assert np.abs(lost.residuals).max() > 100 * NOISE
    found = sc.fit(stepper, run.t, noisy, segments=20, deviations=NOISE, **known)
    truth = np.array([*(CHAOTIC[name] for name in found.names[:2]), 2.0, 2.5, 0.0, 0.0])
    squares, axes = np.linalg.eigh(found.covariance)  # the least are those of what chaos tells far below rounding
    away = (axes.T @ (found.values - truth))[squares > 1e-10 * squares.max()]
    assert (away**2 / squares[squares > 1e-10 * squares.max()]).sum() < 22.5  # chi squared of 6, at a thousandth
    assert found.standard_errors["l"] < 1e-4
    assert np.sqrt((found.residuals**2).mean()) == pytest.approx(NOISE, rel=0.1)
    assert found.jumps.shape == (19, 4)
    assert np.abs(found.jumps).max() < 1e-9


BOUNDS = [{"delta": (0.25, 0.5)}, {"delta": (0.0, 1.0)}, {"alpha": (-0.95, 0.0), "x": (0.6, 0.75)}]


@pytest.mark.rotated
@pytest.mark.parametrize("bounds", BOUNDS)
def test_segments_with_bounds_agree_with_single_shooting(bounds):
    one = sc.fit(oscillator(), TIMES, recorded(3)[0], bounds=bounds, unknown=SOME, **GUESS)
    parts = sc.fit(oscillator(), TIMES, recorded(3)[0], bounds=bounds, unknown=SOME, segments=4, **GUESS)
    assert parts.at_bounds == one.at_bounds == tuple(name for name in bounds if bounds[name] != (0.0, 1.0))
    free = [k for k, name in enumerate(one.names) if name not in one.at_bounds]
    errors = np.sqrt(np.diag(one.covariance))[free]
    assert (np.abs(parts.values - one.values)[free] < 0.01 * errors).all()
    for name, (low, high) in bounds.items():
        assert low <= parts.values[parts.names.index(name)] <= high
    assert np.abs(parts.jumps).max() < 1e-9
    assert_allclose(np.sqrt(np.diag(parts.covariance))[free], errors, rtol=1e-2)


@pytest.mark.rotated
def test_least_squares_with_equality_constraints_and_bounds():
    """Beside the best of all choices of unknowns that a bound holds."""
    rng = np.random.default_rng(5)
    for _ in range(40):
        partials, found, rows = rng.normal(size=(9, 5)), rng.normal(size=9), 7
        low, high = np.full(5, -np.inf), np.full(5, np.inf)
        low[:3], high[:3] = -rng.uniform(0.01, 0.2, 3), rng.uniform(0.01, 0.2, 3)
        update, _, bounded = _bounded_update(partials, found, rows, (low, high))
        assert np.abs(partials[rows:] @ update + found[rows:]).max() < 1e-12
        assert (low <= update).all()
        assert (update <= high).all()
        assert ((update == low) | (update == high))[bounded].all()
        best = np.inf
        for choice in product((None, low, high), repeat=3):
            fixed = np.array([k for k, bound in enumerate(choice) if bound is not None], dtype=int)
            other = np.zeros(5)
            other[fixed] = [choice[k][k] for k in fixed]
            free = np.setdiff1d(np.arange(5), fixed)
            other[free] = _equality_constrained_update(partials[:, free], found + partials @ other, rows)[0]
            if (low <= other + 1e-12).all() and (other <= high + 1e-12).all():
                best = min(best, float(np.linalg.norm(partials[:rows] @ other + found[:rows])))
        assert np.linalg.norm(partials[:rows] @ update + found[:rows]) == pytest.approx(best, rel=1e-10)


@cache
def kepler():
    text = "(x_dot**2 + y_dot**2 + z_dot**2)/2 + mu/sqrt(x**2 + y**2) - k*z**2/2"
    system = lagrange("Kepler and a spring", "x y z", text, mu=1.0, k=1.0)
    return sc.compile_stepper(system, sc.SVI(8), flags=QUICK_FLAGS)


@pytest.mark.rotated
@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("length", "time", "segments"), [(1.0, 1.0, 1), (1e6, 1e-6, 1), (1e-6, 1e6, 3), (1e6, 1e6, 1), (1e-6, 1e-6, 3)]
)
def test_diagnosis_does_not_depend_on_units(length, time, segments):
    """Derivatives by mu, q and p may differ by 10^30; noise-free data do not trigger a warning."""
    units = [length**3 / time**2, 1 / time**2, *[length] * 3, *[length / time] * 3]
    true = np.array([1.0, 1.0, 1.0, 0.0, 0.2, 0.0, 0.8, 0.1])
    mu, k, *state = (true * units).tolist()
    motion = kepler().integrate(state[:3], state[3:], h=0.05 * time, steps=120, parameters=[mu, k])
    guess = {"q": state[:3], "p": state[3:], "h": 0.05 * time, "start": 0.0, "segments": segments}
    t, q = motion.t[2::2], motion.q[2::2]
    with warnings.catch_warnings(action="error", category=sc.AccuracyWarning):
        found = sc.fit(kepler(), t, q, parameters=[1.01 * mu, 0.99 * k], **guess)
    assert_allclose(found.values / units, true, rtol=0, atol=1e-8)
    with pytest.raises(sc.FitError, match=r"do not determine (k|z|p_z)"):
        sc.fit(kepler(), t, q[:, :2], observed=["x", "y"], parameters=[1.01 * mu, k], **guess)
