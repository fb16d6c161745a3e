"""Work-precision curves: time at equal error, interpolated between measured settings."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

__all__ = ["FLOOR", "Point", "common_error", "error_at", "frontier", "time_at"]

FLOOR = 1e-13
"""Errors below count as equal to it: they are round-off and chance."""

LEAST = 1e-18
"""Substitute for an error of 0."""

MARGIN = 2.0
"""Factor on the smallest error of a method, for chance on the plateau of round-off."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """Measured setting: seconds for one trajectory, and the error at its end."""

    seconds: float
    error: float


def frontier(points: Iterable[Point]) -> list[Point]:
    """Return the Pareto-optimal points in time and error, fastest first, up to the first below the floor.

    >>> points = [Point(seconds=s, error=e) for s, e in [(1, 1e-3), (2, 1e-6), (3, 1e-5), (4, 1e-15), (5, 1e-16)]]
    >>> [point.seconds for point in frontier(points)]
    [1, 2, 4]
    """
    points_on: list[Point] = []
    for point in sorted(points, key=lambda point: (point.seconds, point.error)):
        last = points_on[-1].error if points_on else math.inf
        if last > FLOOR and point.error < last:
            points_on.append(point)
    return points_on


def time_at(points: Iterable[Point], error: float) -> float | None:
    """Return the seconds to reach an error, linearly interpolated in log-log along the frontier.

    Nothing is extrapolated: a larger error than any measured takes the time of the fastest setting, and for an error
    that no setting reaches the result is ``None``.

    >>> round(time_at([Point(seconds=1.0, error=1e-4), Point(seconds=4.0, error=1e-8)], 1e-6), 12)
    2.0
    """
    curve, wanted = frontier(points), max(error, FLOOR)
    if not curve or wanted < curve[-1].error:
        return None
    if wanted >= curve[0].error:
        return curve[0].seconds
    after = next(n for n, point in enumerate(curve) if point.error <= wanted)
    loose, tight = curve[after - 1], curve[after]
    share = math.log(loose.error / wanted) / math.log(loose.error / max(tight.error, LEAST))
    return loose.seconds * math.pow(tight.seconds / loose.seconds, share)


def error_at(points: Iterable[Point], seconds: float) -> float | None:
    """Return the error reached in a time, as :func:`time_at`; ``None`` below the time of the fastest setting.

    >>> round(error_at([Point(seconds=1.0, error=1e-4), Point(seconds=4.0, error=1e-8)], 2.0), 12)
    1e-06
    """
    curve = frontier(points)
    if not curve or seconds < curve[0].seconds:
        return None
    if seconds >= curve[-1].seconds:
        return curve[-1].error
    after = next(n for n, point in enumerate(curve) if point.seconds > seconds)
    loose, tight = curve[after - 1], curve[after]
    share = math.log(seconds / loose.seconds) / math.log(tight.seconds / loose.seconds)
    return loose.error * math.pow(max(tight.error, LEAST) / loose.error, share)


def common_error(one: Sequence[Point], other: Sequence[Point]) -> float | None:
    """Return the smallest error that both methods reach safely: twice the larger of their smallest, or the floor."""
    curves = frontier(one), frontier(other)
    if not all(curves):
        return None
    return max(FLOOR, *(MARGIN * curve[-1].error if curve[-1].error > FLOOR else FLOOR for curve in curves))
