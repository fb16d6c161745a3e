"""Bodies in a row that meet at distances 1: event by event, by closed forms between impacts."""

import numpy as np

Array = np.ndarray
TOUCH, REST = 1e-12, 1e-14
"""Gap of bodies that touch, and rate, relative to the velocities, of those that do not approach."""


def positions_after(x: Array, v: Array, m: Array, e: float, duration: float) -> Array:
    """Return positions (n,) after a time, of bodies whose pairs collide one after another until none approaches."""
    x, v, left = np.array(x, float), np.array(v, float), duration
    while True:
        met, gaps = True, np.diff(x) - 1.0
        while met:
            met = False
            for i in np.flatnonzero(gaps <= TOUCH):
                rate = v[i + 1] - v[i]
                if rate < -REST * (abs(v[i]) + abs(v[i + 1])):
                    impulse = (1.0 + e) * rate / (1.0 / m[i] + 1.0 / m[i + 1])
                    v[i : i + 2] += impulse / m[i], -impulse / m[i + 1]
                    met = True
        rates = np.diff(v)
        times = np.full(len(rates), np.inf)
        times = np.divide(gaps, -rates, out=times, where=(gaps > TOUCH) & (rates < 0.0))
        h = min(float(times.min()), left)
        x, left = x + h * v, left - h
        if left <= 0.0:
            return x
