"""Growth of tangent vectors along a trajectory, and chaos indicators: Lyapunov exponents, MEGNO, FLI, SALI, GALI.

Tangent vectors v_1, .., v_k are propagated by the exact derivatives of the steps. All indicators follow from the
logarithms of their norms and of the diagonal of R in their QR factorisation, which remain accurate to round-off when
the vectors themselves have become parallel or would overflow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StateError
from scvi_codegen.representation import summary
from scvi_codegen.runtime.chaos.growth import SERIES
from scvi_codegen.runtime.core.validation import Array
from scvi_codegen.validation import checked_count


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class ChaosIndicators:
    """Chaos indicators of k tangent vectors at n saved states; for an ensemble of K trajectories of shape (n, K, k).

    Norms are Euclidean norms of the 2m entries of (q, p); use units in which these are of comparable size.

    Attributes:
        t: (n,) times.
        log_norms: (n, k) logarithms of the norms of the tangent vectors, which are 1 at the start.
        max_log_norms: (n, k) maxima of these logarithms over all steps so far.
        log_r_diagonal: (n, k) logarithms of the diagonal of R: the first i sum to the log volume of i tangent vectors.
        rates: (n, k) 2/T times the integral of T d(log_norms), T the elapsed time: MEGNO before averaging.
        mean_rates: (n, k) time averages of ``rates``.
        status: (K,) for an ensemble, ``"ok"`` or the reason of a failure, after which values are NaN; else ``None``.
    """

    t: Array
    log_norms: Array
    max_log_norms: Array
    log_r_diagonal: Array
    rates: Array
    mean_rates: Array
    status: NDArray[np.str_] | None = None

    __repr__ = summary("t", "log_norms")

    @classmethod
    def of(cls, t: Array, series: Array, status: NDArray[np.str_] | None = None) -> ChaosIndicators:
        """Construct from (n,) times and (5, n, .., k) values of :data:`~scvi_codegen.runtime.chaos.growth.SERIES`."""
        return cls(t=t, status=status, **dict(zip(SERIES, series, strict=True)))

    def lyapunov_exponents(self) -> Array:
        """Return (n, k) the k largest Lyapunov exponents up to each state, descending; NaN at the first state.

        QR method of Benettin et al., Meccanica 15 (1980) 9.
        """
        time = np.abs(self.t - self.t[0]).reshape(-1, *[1] * (self.log_r_diagonal.ndim - 1))
        return np.asarray(-np.sort(-self.log_r_diagonal / np.where(time > 0.0, time, np.nan), axis=-1))

    def megno(self) -> Array:
        """Return (n,) MEGNO, the time-averaged mean exponential growth of nearby orbits, of the first tangent vector.

        It tends to 2 for regular motion (to less near stable periodic orbits) and to lambda t / 2 for chaotic motion:
        Cincotta & Simo, Astron. Astrophys. Suppl. 147 (2000) 205.
        """
        return np.asarray(self.mean_rates[..., 0])

    def fli(self) -> Array:
        """Return (n,) the fast Lyapunov indicator: the logarithm of the largest norm of any tangent vector so far.

        It grows as log t for regular motion and as lambda t for chaotic motion: Froeschle, Lega & Gonczi, Celest. Mech.
        Dyn. Astron. 67 (1997) 41; Froeschle & Lega, ibid. 78 (2000) 167.
        """
        return np.asarray(self.max_log_norms.max(axis=-1))

    def log_gali(self, k: int = 2) -> Array:
        """Return (n,) natural logarithms of :meth:`gali`, also where GALI underflows."""
        most = self.log_norms.shape[-1]
        if checked_count(k, "k", least=1) > most:
            raise StateError(
                f"k = {k} exceeds the number of tangent vectors, {most}: compute deviations with count={k}"
            )
        return np.asarray((self.log_r_diagonal - self.log_norms)[..., :k].sum(axis=-1))

    def gali(self, k: int = 2) -> Array:
        """Return (n,) the generalised alignment index: the volume spanned by the first k tangent vectors, normalised.

        It decays as exp(-(sum over i = 2..k of lambda_1 - lambda_i) t) for chaotic motion; on regular tori of dimension
        m it is about constant for k <= m and decays as t^(-2(k - m)) for k > m: Skokos, Bountis & Antonopoulos, Physica
        D 231 (2007) 30.
        """
        return np.asarray(np.exp(self.log_gali(k)))

    def sali(self) -> Array:
        """Return (n,) the alignment index ``min(|u + v|, |u - v|)`` of the first two normalised tangent vectors.

        Skokos, J. Phys. A 34 (2001) 10029.
        """
        sine = np.minimum(self.gali(2), 1.0)
        return np.asarray(sine * np.sqrt(2.0 / (1.0 + np.sqrt(1.0 - sine**2))))
