"""Sizes of paths and periodic orbits, of which errors and updates are parts."""

from dataclasses import dataclass

import numpy as np

from scvi_codegen.api.states import Array

ROUNDOFF = float(np.finfo(float).eps) / 2.0
"""Largest relative rounding error of a number."""
SAME = 1e-9
"""Relative difference, far above rounding, below which matrices of symmetries are equal and positions at rest."""
SAME_MOTION = 1e-6
"""Relative difference below which states, motions and eigenvalues are the same: rounding errors of monodromy matrices
move double eigenvalues, stability indices of 1, by so much, and equilibria move less over a period, relative to their
distance from the guess."""
INCREMENT = float(np.cbrt(ROUNDOFF))
"""Increment of central differences relative to the size of the motion or to a step: their truncation, its square, and
their rounding, ROUNDOFF over it, are equal then."""
UPDATE_ROUNDING = 4.0
"""Newton updates of so many roundings of the largest value cannot be reduced."""


def largest_range(values: Array) -> float:
    """Return the largest range of a column of (n, m) values."""
    return float(np.ptp(np.asarray(values), axis=0).max(initial=0.0))


@dataclass(frozen=True, slots=True)
class SizeOfMotion:
    """Sizes of a motion that was found, a path or an orbit, of which its errors are parts.

    Attributes:
        position: largest range of a coordinate.
        momentum: largest momentum of a velocity.
        rounding: (2,) rounding errors of positions and of momenta.
    """

    position: float
    momentum: float
    rounding: tuple[float, float]

    @classmethod
    def of(cls, q: Array, p: Array, at_rest: Array | float = 0.0) -> "SizeOfMotion":
        """Return the sizes of (n, m) states; ``at_rest``: (m,) momenta without velocity, of the gauge of L."""
        of_q, of_p = (ROUNDOFF * float(np.abs(vectors).max(initial=0.0)) for vectors in (q, p))
        return cls(largest_range(q), float(np.abs(p - at_rest).max(initial=0.0)), (of_q, of_p))

    def error(self, position: float, momentum: float) -> float:
        """Return the larger one of both errors, with those of rounding, relative to these sizes.

        Those of a motion at rest, which has no size, are relative to its largest position and momentum.
        """
        rounding, sizes = np.array(self.rounding), np.array([self.position, self.momentum])
        sizes = np.where(sizes > 0.0, sizes, rounding / ROUNDOFF)
        errors = np.array([position, momentum]) + rounding
        with np.errstate(all="ignore"):
            return float(np.where(errors == 0.0, 0.0, errors / sizes).max())


def size_for_updates(q: Array, settled: float, least: float = 0.0) -> float:
    """Return the size of (n, m) positions of which updates below the part ``settled`` end an iteration.

    It is the largest range, or ``least``, or what makes ``settled`` some roundings of the positions.
    """
    rounding = UPDATE_ROUNDING * ROUNDOFF * float(np.abs(q).max(initial=0.0))
    return max(largest_range(q), least, rounding / settled)
