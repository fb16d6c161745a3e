"""Work-precision curves: time at equal error, by interpolation between measured settings."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

__all__ = ["FLOOR", "Point", "common_error", "error_at", "frontier", "time_at"]

FLOOR = 1e-13
"""Errors below count as equal to it: there they are round-off and luck."""

LEAST = 1e-18
"""For an error that is 0."""

MARGIN = 2.0
"""On the plateau of round-off one setting beats the next by luck; a method's reach is twice its smallest error."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """A measured setting: seconds for one trajectory, and the error at its end."""

    seconds: float
    error: float


def frontier(points: Iterable[Point]) -> list[Point]:
    """The points that no other beats in time and error, the fastest first, up to the first below the floor.

    >>> points = [Point(seconds=s, error=e) for s, e in [(1, 1e-3), (2, 1e-6), (3, 1e-5), (4, 1e-15), (5, 1e-16)]]
    >>> [point.seconds for point in frontier(points)]
    [1, 2, 4]
    """
    kept: list[Point] = []
    for point in sorted(points, key=lambda point: (point.seconds, point.error)):
        last = kept[-1].error if kept else math.inf
        if last > FLOOR and point.error < last:
            kept.append(point)
    return kept


def time_at(points: Iterable[Point], error: float) -> float | None:
    """Seconds to reach an error, linear in log time against log error along the frontier.

    Nothing is extrapolated: an error looser than any measured takes the time of the fastest setting, and an error that
    no setting reaches gives ``None``.

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
    """The error that is reached in a time, as :func:`time_at`; ``None`` in less than the fastest setting takes.

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
    """The smallest error that two methods reach safely: twice the larger of their smallest, at least the floor."""
    curves = frontier(one), frontier(other)
    if not all(curves):
        return None
    return max(FLOOR, *(MARGIN * curve[-1].error if curve[-1].error > FLOOR else FLOOR for curve in curves))
