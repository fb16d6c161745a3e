"""Averages with standard errors: autoregressive series of known autocorrelation time, ensembles, burn-in, messages."""

from types import SimpleNamespace

import numpy as np
import pytest

import scvi_codegen as sc
from scvi_codegen.runs.ensembles.result import EnsembleTrajectory


def autoregressive(factor: float, shape: tuple[int, ...], seed: int) -> np.ndarray:
    """Return stationary x_n = a x_(n-1) + sqrt(1 - a^2) xi: variance 1, tau = (1 + a) / (2 (1 - a)) steps."""
    from scipy.signal import lfilter  # a second of import

    noise = np.random.default_rng(seed).normal(size=shape)
    noise[1:] *= np.sqrt(1 - factor**2)
    return lfilter([1.0], [1.0, -factor], noise, axis=0)


def run_of(n: int, interval: float) -> SimpleNamespace:
    return SimpleNamespace(t=interval * np.arange(n))


def ensemble_of(n: int, k: int, interval: float) -> EnsembleTrajectory:
    t, none = interval * np.arange(n), np.zeros(k)
    states, about = np.zeros((n, k, 1)), {"h": interval, "parameters": none, "stepper": None}
    about |= {"initial": (0.0, *np.zeros((2, k, 1)))}
    return EnsembleTrajectory(t=t, q=states, p=states, status=np.full(k, "ok"), steps=none.astype(int), **about)


@pytest.mark.parametrize("factor", [0.0, 0.9, 0.98])
def test_autocorrelation_time_of_an_autoregressive_series(factor):
    n, exact = 400_000, (1 + factor) / (2 * (1 - factor))
    result = sc.average(run_of(n, 0.25), autoregressive(factor, (n,), 3) + 7.0, burn_in=0.0)
    spread = np.sqrt(2 * (2 * 5 * exact + 1) / n)  # of tau, relative to it (Sokal, eq. 3.19), window 5 tau
    assert abs(result.tau / 0.25 / exact - 1) < 4 * spread + 0.01  # the truncated window: exp(-5)
    assert abs(result.error / np.sqrt(2 * exact / n) - 1) < 2 * spread + 0.01
    assert abs(result.mean - 7.0) < 4 * result.error


def test_errors_are_those_of_repeated_experiments():
    """The mean of the squares of (mean - exact) / error is 1 within 4 standard errors over 200 runs."""
    x = autoregressive(0.8, (4000, 200), 5)
    run = run_of(4000, 1.0)
    ratios = np.array([(m / e) ** 2 for m, e, _ in (sc.average(run, column, burn_in=0) for column in x.T)])
    assert abs(ratios.mean() - 1) < 4 * np.sqrt(2 / 200)


def test_ensembles_and_several_quantities():
    x = autoregressive(0.9, (500, 300), 7)
    mean, error, tau = sc.average(ensemble_of(500, 300, 0.1), lambda runs: np.stack([x, x**2, 0 * x + 2], -1))
    assert mean.shape == error.shape == tau.shape == (3,)
    assert abs(tau[0] / 0.1 / 9.5 - 1) < 0.1
    assert abs(tau[1] / 0.1 / ((1 + 0.81) / (2 * 0.19)) - 1) < 0.1
    assert (abs(mean - [0, 1, 2]) <= 4 * error).all()
    assert (error[2], tau[2]) == (0, 0.05)


def test_the_transient_is_omitted():
    n = 20_000
    x = autoregressive(0.9, (n,), 11) + 50 * 0.9 ** np.arange(n)
    result = sc.average(run_of(n, 0.5), x)
    assert 0.5 * 60 < result.burn_in < 0.5 * 140
    assert abs(result.mean) < 4 * result.error
    assert sc.average(run_of(n, 0.5), x, burn_in=100).mean == x[200:].mean()


@pytest.mark.parametrize("unit", [1e-200, 1e-26, 1e200])
def test_units_and_times_of_values_do_not_matter(unit):
    x, run = autoregressive(0.9, (4000,), 13), run_of(4000, 0.1)
    expected = sc.average(run, x)
    for result in (sc.average(run, unit * x), sc.average(SimpleNamespace(t=1e9 + run.t), unit * x)):
        assert np.allclose(np.divide([*result], [unit, unit, 1]), [*expected], rtol=1e-5, atol=0)
    assert sc.average(run, np.full(4000, 0.1)).error == 0.0


def test_messages():
    with pytest.warns(sc.AccuracyWarning, match=r"299 long, 0 are omitted, .* of 50 required"):
        sc.average(run_of(300, 1.0), autoregressive(0.9, (300,), 1), burn_in=0)
    for t, values, message in (
        (np.arange(4.0), np.zeros(3), r"quantity has shape \(3,\): it must have shape \(4,\)"),
        (np.arange(4.0), np.full(4, np.nan), r"runs\.ok"),
        (np.array([0.0, 1.0, 3.0]), np.zeros(3), "equal distances in time: give h"),
    ):
        with pytest.raises(sc.StateError, match=message):
            sc.average(SimpleNamespace(t=t), values)
    with pytest.raises(sc.StateError, match="burn_in = 3 must be at least 0 and leave two states"):
        sc.average(run_of(4, 1.0), np.zeros(4), burn_in=3)
