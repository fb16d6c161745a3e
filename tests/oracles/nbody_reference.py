"""An independent reference for gravitating bodies: Taylor series of order 26 in extended precision.

It shares nothing with the package: no SymPy, no quadrature, no Newton, no stages. Positions obey

    q_i'' = sum_j G m_j d_ij u_ij,    d_ij = q_j - q_i,    u = s^(-3/2),    s = |d|^2,    s u' = -3/2 s' u,

and the coefficients of every series follow from those of lower order.
"""

import numpy as np

ORDER = 26
REAL = np.longdouble


def accelerated(q, v, masses, gravity):
    """Taylor coefficients (ORDER + 1, n, 3) of the positions about the present."""
    first, second = np.triu_indices(len(masses), 1)
    weights = gravity * np.asarray(masses, dtype=REAL)
    x = np.zeros((ORDER + 1, *q.shape), dtype=REAL)
    x[0], x[1] = q, v
    d = np.zeros((ORDER + 1, len(first), 3), dtype=REAL)
    s = np.zeros((ORDER + 1, len(first)), dtype=REAL)
    u = np.zeros_like(s)
    d[:2] = x[:2, second] - x[:2, first]
    for k in range(ORDER - 1):
        s[k] = (d[: k + 1] * d[k::-1]).sum(axis=(0, 2))
        if k == 0:
            u[0] = s[0] ** REAL(-1.5)
        else:
            j = np.arange(1, k + 1, dtype=REAL)[:, None]
            u[k] = ((-REAL(1.5) * j - (k - j)) * s[1 : k + 1] * u[k - 1 :: -1][:k]).sum(axis=0) / (k * s[0])
        pull = (d[: k + 1] * u[k::-1, :, None]).sum(axis=0)
        force = np.zeros_like(q)
        np.add.at(force, first, pull * weights[second, None])
        np.add.at(force, second, -pull * weights[first, None])
        x[k + 2] = force / ((k + 1) * (k + 2))
        d[k + 2] = x[k + 2, second] - x[k + 2, first]
    return x


def integrate(q, v, masses, gravity, span, steps):
    """Positions and velocities (n, 3) after ``span`` in ``steps`` equal steps."""
    q, v, h = np.array(q, dtype=REAL), np.array(v, dtype=REAL), REAL(span) / steps
    powers = h ** np.arange(ORDER + 1)
    for _ in range(steps):
        x = accelerated(q, v, masses, REAL(gravity))
        q = (x * powers[:, None, None])[::-1].sum(axis=0)
        partials = np.arange(1, ORDER + 1, dtype=REAL) * powers[:-1]
        v = (x[1:] * partials[:, None, None])[::-1].sum(axis=0)
    return q, v
