"""A point on a plane, by closed forms between its events: flights, impacts with friction, slides and rest."""

from typing import NamedTuple

import numpy as np

REST = 1e-18
"""Rate of an impact, relative to the first one, after which the point no longer leaves the plane."""


class Slide(NamedTuple):
    """A point at a height above a plane with a normal rate and a slip, under g towards the plane and `pull` along it.

    Positions and rates are those relative to the plane; `mu` of sliding, `static` of sticking, `e` of impacts.
    """

    g: float
    pull: float
    mu: float
    static: float
    e: float
    height: float
    rate: float
    slip: float

    def after(self, t: float) -> tuple[float, float, float]:
        """Return the way along the plane, its rate and the height at a time."""
        x, slip, y, rate, left = 0.0, self.slip, self.height, self.rate, t
        first = np.sqrt(rate**2 + 2 * self.g * y)
        while y > 0.0 or rate > REST * first:
            flight = (rate + np.sqrt(rate**2 + 2 * self.g * y)) / self.g
            if flight >= left:
                height = y + (rate - self.g * left / 2) * left
                return x + (slip + self.pull * left / 2) * left, slip + self.pull * left, height
            x += (slip + self.pull * flight / 2) * flight
            slip, rate, y, left = slip + self.pull * flight, self.g * flight - rate, 0.0, left - flight
            slip, rate = np.sign(slip) * max(abs(slip) - self.mu * (1 + self.e) * rate, 0.0), self.e * rate
        return *self._slide(x, slip, left), 0.0

    def _slide(self, x: float, slip: float, left: float) -> tuple[float, float]:
        while left > 0.0:
            if slip == 0.0 and abs(self.pull) <= self.static * self.g:
                return x, 0.0
            way = np.sign(slip or self.pull)
            rate = self.pull - way * self.mu * self.g
            stop = -slip / rate if way * rate < 0.0 else np.inf
            part = min(left, stop)
            x, left = x + (slip + rate * part / 2) * part, left - part
            slip = slip + rate * part if part < stop else 0.0
        return x, slip
