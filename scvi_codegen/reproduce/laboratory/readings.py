"""Meanings of "N" in the captions of section 3: number of points, as they say, or degree, as in other figures.

In both readings SVI has N Gauss points here, which the paper does not state: one more than the degree if N counts
points.
"""

from __future__ import annotations

from dataclasses import dataclass

from scvi_codegen.methods import SVI, SpectralCollocation
from scvi_codegen.methods.method import Method

__all__ = ["BY_DEGREE", "BY_POINTS", "READINGS", "SCHEMES", "Reading"]

SCHEMES = ("SVI", "SC")


@dataclass(frozen=True, slots=True)
class Reading:
    """Meaning of N.

    Attributes:
        name: ``"by points"``.
        meaning: description in a few words.
        beyond_degree: N less the degree.
    """

    name: str
    meaning: str
    beyond_degree: int

    def degree(self, n: int) -> int:
        """Return the degree of the curves for N."""
        return n - self.beyond_degree

    def method(self, scheme: str, n: int, *, more: int = 0) -> Method:
        """Return ``"SC"``, or ``"SVI"`` with N + ``more`` Gauss points."""
        degree = self.degree(n)
        return SVI(degree, f"gauss-legendre:{n + more}") if scheme == "SVI" else SpectralCollocation(degree)


BY_POINTS = Reading("by points", "N Chebyshev points, degree N - 1", 1)
"""Meaning in captions and on axes, on which verdicts are based."""
BY_DEGREE = Reading("by degree", "N the degree, N + 1 Chebyshev points", 0)
READINGS = (BY_POINTS, BY_DEGREE)
