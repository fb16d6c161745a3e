"""A body on a spring between walls, and a puck on a table between walls, by closed forms between their events."""

from typing import NamedTuple

import numpy as np


class Spring(NamedTuple):
    """A body x'' = -w^2 x with dry friction of a size by mass, sliding or sticking, between walls with restitution."""

    w: float
    sliding: float
    held: float
    low: float
    high: float
    e: float

    def after(self, x: float, v: float, t: float) -> tuple[float, float]:
        """Return place and velocity at a time."""
        while t > 0.0:
            if v == 0.0 and abs(self.w**2 * x) <= self.held:
                return x, 0.0
            way = np.sign(v or -x)
            centre = -way * self.sliding / self.w**2
            size, phase = np.hypot(x - centre, v / self.w), np.arctan2(-v / self.w, x - centre)
            wall = self.high if way > 0.0 else self.low
            turn = 0.0 if way > 0.0 else np.pi  # phase of the stop, up to 2 pi
            stop = (turn - phase) % (2 * np.pi)
            reach = size > way * (wall - centre)
            hit = stop - np.arccos(np.clip(way * (wall - centre) / size, -1.0, 1.0)) if reach else np.inf
            part = min(t, stop / self.w, hit / self.w)
            angle = phase + self.w * part
            x, v = centre + size * np.cos(angle), -size * self.w * np.sin(angle)
            t = t - part if part < t else 0.0
            if part == hit / self.w:
                x, v = wall, -self.e * v
            elif part == stop / self.w:
                v = 0.0
        return x, v


class Puck(NamedTuple):
    """A puck that friction of a size by mass slows, on a table |x|, |y| <= high between walls with restitution."""

    friction: float
    high: float
    e: float

    def after(
        self, place: tuple[float, float], velocity: tuple[float, float], t: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return place and velocity at a time."""
        x, v = np.array(place), np.array(velocity)
        while t > 0.0 and v.any():
            speed = np.hypot(*v)
            ends = min(t, speed / self.friction if self.friction else np.inf)
            # the way s along the straight line: to the next wall, or s = speed t - friction t^2/2
            with np.errstate(divide="ignore"):
                ways = np.where(v, (np.sign(v) * self.high - x) / v, np.inf) * speed
            wall = int(np.argmin(ways))
            rest = speed**2 - 2 * self.friction * ways[wall]
            hit = 2 * ways[wall] / (speed + np.sqrt(rest)) if rest > 0.0 else np.inf
            part = min(ends, hit)
            after = max(speed - self.friction * part, 0.0)
            x = x + v / speed * (speed + after) / 2 * part
            v = v * (after / speed)
            if part == hit:
                v[wall] *= -self.e
            elif part < t:
                v = np.zeros(2)
            t -= part
        return x, v
