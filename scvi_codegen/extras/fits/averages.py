"""Time averages of correlated values with their standard errors.

The variance of the mean of N values with variance s^2 is 2 tau s^2 / N, with the integrated autocorrelation time tau =
1/2 + sum_{k > 0} rho_k (Sokal, Monte Carlo Methods in Statistical Mechanics, 1996, section 3). The sum ends at the
smallest W >= 5 tau(W), his automatic window; the bias by the subtracted mean is corrected (Wolff, Comput. Phys.
Commun. 156 (2004) 143, eq. 32).
"""

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.api.checks import checks_arguments
from scvi_codegen.api.states import Array, checked_number
from scvi_codegen.common.errors import AccuracyWarning, StateError
from scvi_codegen.runs.ensembles.result import EnsembleTrajectory

WINDOW, RELAXATION, LEAST_TIMES = 5.0, 10.0, 50.0
"""Autocorrelation times in a window, omitted by default, and in all values, below which the error is unreliable."""


@dataclass(frozen=True, kw_only=True)
class Average:
    """Mean value with its statistical error; unpacks as ``mean, error, tau``.

    Attributes:
        mean: average over times, and over the trajectories of an ensemble.
        error: its standard error, one sigma; it does not contain the bias of the integrator.
        tau: integrated autocorrelation time, in units of time; exp(-t/T) has tau = T.
        burn_in: time from the start that was omitted.
    """

    mean: Any
    error: Any
    tau: Any
    burn_in: float

    def __iter__(self) -> Iterator[Any]:
        return iter((self.mean, self.error, self.tau))


@checks_arguments()
def average(run: Any, quantity: Callable[[Any], ArrayLike] | ArrayLike, *, burn_in: float | None = None) -> Average:
    """Return the time average of a quantity of a run or an ensemble, with standard error and autocorrelation time.

    Args:
        run: a :class:`Trajectory`, or an :class:`EnsembleTrajectory`, with states at equal distances in time.
        quantity: values of shape (n,) of a run of n states or (n, k) of k trajectories, with further axes for several
            quantities; or a function that returns them of the run, such as ``lambda run: run.q[:, 0]**2``.
        burn_in: time from the start to omit; by default ten autocorrelation times of the second half of the run, at
            most half of the run.

    Raises:
        StateError: if shapes differ, values are not finite, or times are not at equal distances; warns with
            :class:`AccuracyWarning` if the values contain fewer than 50 autocorrelation times.
    """
    t, x = np.asarray(run.t), np.asarray(quantity(run) if callable(quantity) else quantity, dtype=float)
    shape = (len(t), len(run)) if isinstance(run, EnsembleTrajectory) else (len(t),)
    if x.shape[: len(shape)] != shape:
        raise StateError(f"quantity has shape {x.shape}: it must have shape {shape}, one value per state, or more axes")
    if not (x.size and np.isfinite(x).all()):
        raise StateError(
            "quantity is empty or has values that are not finite: select the trajectories that succeeded by runs.ok"
        )
    interval = (t[-1] - t[0]) / max(1, len(t) - 1)
    if t.ndim != 1 or not interval > 0 or np.ptp(np.diff(t)) > 1e-6 * interval + 4 * np.spacing(np.abs(t).max()):
        raise StateError("average requires at least two states at equal distances in time: give h, or t_eval=")
    further, half = x.shape[len(shape) :], len(t) // 2
    x = x.reshape(len(t), shape[-1] if len(shape) > 1 else 1, -1)
    if burn_in is None:
        omitted = min(half, len(t) - 2, int(np.ceil(RELAXATION * _correlation_time(x[half:])[0].max())))
        least = LEAST_TIMES if omitted < half else np.inf  # the run may not have settled
    else:
        omitted, least = int(np.ceil(round(checked_number(burn_in, "burn_in") / interval, 9))), LEAST_TIMES
        if not 0 <= omitted <= len(t) - 2:
            raise StateError(f"burn_in = {burn_in:g} must be at least 0 and leave two states of {t[-1] - t[0]:g}")
    x = x[omitted:]
    tau, sigma = _correlation_time(x)
    times = x.shape[0] * x.shape[1] / tau
    if times.min() < least:
        warnings.warn(
            f"the error of the average is unreliable: of the run, {t[-1] - t[0]:g} long, {omitted * interval:g} are "
            f"omitted, {times.min():.3g} autocorrelation times remain, of {LEAST_TIMES:g} required; integrate longer",
            AccuracyWarning,
            stacklevel=3,
        )
    columns = np.array([x.mean(axis=(0, 1)), sigma * np.sqrt(2 / times), tau * interval])
    mean, error, time = columns.reshape(3, *further) if further else columns[:, 0].tolist()
    return Average(mean=mean, error=error, tau=time, burn_in=float(omitted * interval))


def _correlation_time(x: Array) -> tuple[Array, Array]:
    """Return tau in units of the distance of the values, at least 1/2, and sigma for each column of x (n, k, c)."""
    n, k, columns = x.shape
    low, high = x.min(axis=(0, 1)), x.max(axis=(0, 1))
    scale = np.where(high > low, high / 2 - low / 2, 1.0)  # squares of any unit neither overflow nor underflow
    centred, power = (x - low) / scale, np.zeros((n + 1, columns))
    centred -= centred.mean(axis=(0, 1))
    for part in np.array_split(centred, min(k, 1 + x.size // 2**20), axis=1):  # the summed power of all trajectories
        power += (np.abs(np.fft.rfft(part, 2 * n, axis=0)) ** 2).sum(axis=1)
    covariance = np.fft.irfft(power, axis=0)[:n] / (k * np.arange(n, 0, -1)[:, np.newaxis])
    variance = covariance[0]
    sums = np.cumsum(covariance / np.where(variance > 0, variance, 1.0), axis=0) - 0.5
    ends = np.arange(n)[:, np.newaxis] >= WINDOW * np.maximum(sums, 0.5)
    window = np.where(ends.any(axis=0), ends.argmax(axis=0), n - 1)
    tau = np.maximum(0.5, sums[window, np.arange(columns)] * (1 + (2 * window + 1) / (n * k)))
    return tau, np.sqrt(variance * (1 + 2 * tau / (n * k))) * scale
