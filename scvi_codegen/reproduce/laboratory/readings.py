"""What "N" counts in the captions of section 3: points, as they say, or the degree, as other figures have it.

Either way SVI has N Gauss points here, which the paper leaves open: one more than the degree if N counts points.
"""

from __future__ import annotations

from dataclasses import dataclass

from scvi_codegen.methods import SVI, SpectralCollocation
from scvi_codegen.methods.method import Method

__all__ = ["BY_DEGREE", "BY_POINTS", "READINGS", "SCHEMES", "Reading"]

SCHEMES = ("SVI", "SC")


@dataclass(frozen=True, slots=True)
class Reading:
    """A meaning of N.

    Attributes:
        name: ``"by points"``.
        meaning: in a few words.
        beyond_degree: N less the degree.
    """

    name: str
    meaning: str
    beyond_degree: int

    def degree(self, n: int) -> int:
        """Of the curves that N stands for."""
        return n - self.beyond_degree

    def method(self, scheme: str, n: int, *, more: int = 0) -> Method:
        """``"SC"``, or ``"SVI"`` with N Gauss points and ``more``."""
        degree = self.degree(n)
        return SVI(degree, f"gauss-legendre:{n + more}") if scheme == "SVI" else SpectralCollocation(degree)


BY_POINTS = Reading("by points", "N Chebyshev points, degree N - 1", 1)
"""As the captions and the axes say: verdicts are on this."""
BY_DEGREE = Reading("by degree", "N the degree, N + 1 Chebyshev points", 0)
READINGS = (BY_POINTS, BY_DEGREE)
