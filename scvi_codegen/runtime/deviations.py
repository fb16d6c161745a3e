"""What becomes of small changes of the initial state, and the indicators of chaos that are told from it.

Changes v_1, .., v_k are carried along by the exact derivatives of the steps. What all indicators need are the
logarithms of their lengths and, of their QR factorisation, those of the diagonal of R: both stay known to round-off
when the changes themselves have long become parallel, or too large for numbers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StateError
from scvi_codegen.given.counts import checked_count
from scvi_codegen.runtime.growth import SERIES
from scvi_codegen.runtime.inputs import Array

__all__ = ["Deviations"]


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Deviations:
    """Of k changes of the initial state along a motion, at n kept states; of an ensemble with an axis (.., K, ..) more.

    Lengths are those of (q, p) as a vector of 2m numbers: in units in which these are of a size they mean most.

    Attributes:
        t: (n,) times.
        lengths: (n, k) logarithms of the lengths of the changes, of length 1 at first.
        greatest: (n, k) the greatest that these had after any step until then.
        stretches: (n, k) logarithms of the diagonal of R: the first i are that of the volume of i changes, summed.
        rates: (n, k) 2/T times the integral of T d(lengths), T the time passed: MEGNO before it is averaged.
        mean_rates: (n, k) the averages of these over the time passed.
        status: (K,) of an ensemble, ``"ok"``, or why a motion ended: not numbers from there on; else ``None``.
    """

    t: Array
    lengths: Array
    greatest: Array
    stretches: Array
    rates: Array
    mean_rates: Array
    status: NDArray[np.str_] | None = None

    @classmethod
    def of(cls, t: Array, found: Array, status: NDArray[np.str_] | None = None) -> Deviations:
        """From (n,) times and (5, n, .., k) :data:`~scvi_codegen.runtime.growth.SERIES`."""
        return cls(t=t, status=status, **dict(zip(SERIES, found, strict=True)))

    def lyapunov_exponents(self) -> Array:
        """(n, k) the k largest exponents of the time until each state, descending; not numbers at the first.

        By QR: Benettin et al., Meccanica 15 (1980) 9.
        """
        time = np.abs(self.t - self.t[0]).reshape(-1, *[1] * (self.stretches.ndim - 1))
        exponents: Array = -np.sort(-self.stretches / np.where(time > 0.0, time, np.nan), axis=-1)
        return exponents

    def megno(self) -> Array:
        """(n,) the mean exponential growth of nearby orbits of the first change, averaged over the time passed.

        It tends to 2 for regular motions (below it next to stable periodic ones), lambda t / 2 for chaotic ones:
        Cincotta & Simo, Astron. Astrophys. Suppl. 147 (2000) 205.
        """
        mean: Array = self.mean_rates[..., 0]
        return mean

    def fli(self) -> Array:
        """(n,) the fast Lyapunov indicator: the logarithm of the greatest length of any change until then.

        It grows as log t for regular motions, as lambda t for chaotic ones: Froeschle, Lega & Gonczi, Celest. Mech.
        Dyn. Astron. 67 (1997) 41; Froeschle & Lega, ibid. 78 (2000) 167.
        """
        greatest: Array = self.greatest.max(axis=-1)
        return greatest

    def log_gali(self, k: int = 2) -> Array:
        """(n,) natural logarithms of :meth:`gali`, also where that is smaller than all numbers."""
        most = self.lengths.shape[-1]
        if checked_count(k, "k", least=1) > most:
            raise StateError(f"there are {most} changes here, and no generalized alignment index of {k}")
        volume: Array = (self.stretches - self.lengths)[..., :k].sum(axis=-1)
        return volume

    def gali(self, k: int = 2) -> Array:
        """(n,) the generalized alignment index: the volume that the first k changes span, each of length 1.

        exp(-(sum over i = 2..k of lambda_1 - lambda_i) t) for chaotic motions; for regular ones on tori of dimension m
        about constant for k <= m, and t^(-2(k - m)) for k > m: Skokos, Bountis & Antonopoulos, Physica D 231 (2007) 30.
        """
        volume: Array = np.exp(self.log_gali(k))
        return volume

    def sali(self) -> Array:
        """(n,) the smaller alignment index, the lesser length of u + v and u - v, the first two changes of length 1.

        Skokos, J. Phys. A 34 (2001) 10029.
        """
        sine = np.minimum(self.gali(2), 1.0)
        smaller: Array = sine * np.sqrt(2.0 / (1.0 + np.sqrt(1.0 - sine**2)))
        return smaller
