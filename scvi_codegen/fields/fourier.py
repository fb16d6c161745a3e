"""Fourier modes: a periodic axis of equidistant points with the derivatives of the trigonometric interpolant.

int u_x^2 dx = sum_k L k^2 |c_k|^2 over the discrete Fourier coefficients c_k is the quadratic form u . K u with a
circulant K whose rows have the sum 0, so that it is -sum_(i<j) K_ij (u_i - u_j)^2; likewise u_xx with k^4.
"""

from __future__ import annotations

import numpy as np

from scvi_codegen.errors import SystemDefinitionError
from scvi_codegen.fields.axes import PERIODIC, Array, Axis, point_count_of
from scvi_codegen.fields.density import Density

LEAST_TRANSFORMED = 32
"""Smallest even number of Fourier points that are transformed, half of the smallest odd one (measured)."""


class Fourier(Axis):
    """Periodic axis of equidistant points."""

    __slots__ = ()

    @classmethod
    def of(cls, system: Density, name: str, *, points: int, derivative: str | None = None) -> Fourier:
        """Return the axis of a density.

        Args:
            system, name: the density, and the axis.
            points: their number.
            derivative: ``"fft"``, ``"dense"``, or ``None`` for fast Fourier transforms of many points.
        """
        if system.boundary[name] != PERIODIC:
            raise SystemDefinitionError(
                f"'fourier' needs a periodic axis, and '{name}' has ends: use \"spectral-elements\" or "
                '"finite-differences"'
            )
        start, end = system.space[name]
        if derivative not in (None, "fft", "dense"):
            raise SystemDefinitionError(f'derivative= of \'{name}\' is "fft" or "dense", not {derivative!r}')
        count = point_count_of(name, points, least=3, most=4096 if derivative == "dense" else 16384)
        transformed = count >= LEAST_TRANSFORMED * (1 + count % 2) if derivative is None else derivative == "fft"
        h = (end - start) / count
        k = 2 * np.pi * np.fft.fftfreq(count, h)
        distance = np.abs(np.arange(1 if transformed else count)[:, None] - np.arange(count))
        angle = np.pi * np.arange(1, (count + 1) // 2) / count
        signs = np.where(np.arange(1, (count + 1) // 2) % 2, np.pi, -np.pi) / (end - start)
        half = signs / (
            np.sin(angle) if count % 2 else np.tan(angle)
        )  # Trefethen, Spectral Methods in MATLAB, chapter 3
        spectra = (np.fft.ifft(k.astype(np.longdouble) ** (2 * power)).real * h for power in (1, 2))
        rows = [each.astype(np.float64) for each in spectra]
        matrices = (-row[np.minimum(distance, count - distance)] for row in rows)
        return cls(
            name=name,
            points=start + h * np.arange(count, dtype=np.float64),
            weights=np.full(count, h),
            length=end - start,
            pairs=tuple(each[0] if transformed else each for each in matrices),
            rates=np.concatenate([[0.0], half, np.zeros(1 - count % 2), -half[::-1]]),
            stiffness=tuple(float(np.abs(k).max()) ** (2 * power) for power in (1, 2)),
        )

    def between(self, place: float, distance: Array) -> dict[int, float]:
        """See :meth:`Axis.between`: trigonometric interpolation."""
        angle, n = np.pi * distance / self.length, len(self.points)
        values = np.sin(n * angle) / (n * (np.sin(angle) if n % 2 else np.tan(angle)))
        return dict(enumerate(values.tolist()))
