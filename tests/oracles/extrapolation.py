"""A slow integrator in extended precision that shares nothing with the package: Gragg's extrapolation.

E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I, II.9: the explicit midpoint rule with
n = 2, 4, .., 2 k substeps, extrapolated by the scheme of Aitken and Neville in (H/n)^2. Step sizes follow the
difference of the last two columns.
"""

from collections.abc import Callable

import numpy as np

Real = np.longdouble
COLUMNS = 9
TOLERANCE = 1e-16


def integrated(f: Callable, y0, times) -> np.ndarray:
    """Return states y at ascending or descending times, the first of them that of y0; f(t, y) is the derivative."""
    t, y = Real(times[0]), np.array(y0, dtype=Real)
    found, h = [y], (Real(times[1]) - t) / 8
    for end in map(Real, times[1:]):
        while t != end:
            h = end - t if abs(h) >= abs(end - t) else h
            last = h == end - t
            new, error = _step(f, t, y, h)
            size = np.abs(y).max() + np.abs(new - y).max()
            ratio = float(error / (TOLERANCE * size))
            if ratio <= 1.0:
                t, y = (end if last else t + h), new
            if not np.isfinite(ratio) or abs(h) < 1e-16 * max(1.0, abs(float(t))):
                raise ArithmeticError(f"no extrapolation at t = {t}")
            h = h * Real(min(3.0, max(0.2, 0.8 * max(ratio, 1e-20) ** (-1 / (2 * COLUMNS - 1)))))
        found.append(y)
    return np.array(found)


def _step(f: Callable, t, y, h) -> tuple[np.ndarray, np.longdouble]:
    rows: list[np.ndarray] = []
    for k in range(1, COLUMNS + 1):
        n = 2 * k
        part, before, now = h / n, y, y + h / n * f(t, y)
        for i in range(1, n):
            before, now = now, before + 2 * part * f(t + i * part, now)
        row = [(before + now + part * f(t + h, now)) / 2]
        for j in range(1, k):
            factor = (Real(k) / Real(k - j)) ** 2 - 1
            row.append(row[j - 1] + (row[j - 1] - rows[-1][j - 1]) / factor)
        rows.append(row)
    return rows[-1][-1], np.abs(rows[-1][-1] - rows[-1][-2]).max()
