"""Errors of a single step from the perihelion, in double precision and in 60 digits, of SVI and SC."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.errors import StepFailedError
from scvi_codegen.methods import SVI, Gauss, SpectralCollocation
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.reproduce.kepler.exact_flow import SYSTEM, angular_momentum, exact_flow, perihelion
from scvi_codegen.reproduce.laboratory.experiment import Comparison, Verdict, holds
from scvi_codegen.reproduce.laboratory.running import stepper_of
from scvi_codegen.tables.precision import DIGITS, Number, mp
from scvi_codegen.tables.tableau import Tableau

__all__ = [
    "CIRCLE",
    "ELLIPSE",
    "LABELS",
    "QUANTITIES",
    "ROUNDOFF",
    "SCHEMES",
    "StepErrors",
    "one_step",
    "orders",
    "shares_won",
    "superiority",
]

Array = NDArray[np.float64]

SCHEMES = ("SVI", "SC")
LABELS = {"q1": "$q_1$", "q2": "$q_2$", "momentum": "angular momentum", "energy": "energy"}
CIRCLE, ELLIPSE = 0.0, 0.5
"""Eccentricities that are run."""

MOSTLY = 0.9
"""Least share of comparisons at which a claim holds in part."""
ROUNDOFF = 1e-13
"""Round-off level of the error of a step."""
TO_ROUNDOFF = SolverOptions(max_iterations=1000)
ORDER_STEPS = ("0.05", "0.025")
"""Step sizes in units of (1 - e)^(3/2), the time scale at perihelion."""
NEGLIGIBLE = mp.mpf(10) ** (5 - DIGITS)


class StepErrors(NamedTuple):
    """Absolute errors of the four quantities of Figs. 16-20."""

    q1: float
    q2: float
    momentum: float
    energy: float


QUANTITIES = StepErrors._fields


@lru_cache(maxsize=4096)
def one_step(scheme: str, degree: int, e: float, h: float) -> StepErrors | None:
    """Return the errors of the compiled step of h from the perihelion; ``None`` if it has no solution."""
    stepper = stepper_of(SYSTEM, SVI(degree) if scheme == "SVI" else SpectralCollocation(degree), "newton")
    q0, v0 = perihelion(e)
    try:
        q, p = stepper.step(q0, v0, h, options=TO_ROUNDOFF)
    except StepFailedError:
        return None
    exact, _ = exact_flow(q0, v0, h)
    momentum = float(angular_momentum(q, p)) - math.sqrt(1 - e * e)
    return StepErrors(*map(float, np.abs([*(q - exact[0]), momentum, stepper.energy(q, p) + 0.5])))


@lru_cache(maxsize=64)
def orders(scheme: str, degree: int, e: float) -> tuple[float | None, ...]:
    """Return the order in h of each error as h goes to 0; ``None`` for an error below 1e-55.

    Steps are computed in 60 digits, as Runge-Kutta methods: an SVI with as many Gauss points as its degree is Gauss
    collocation, SC is collocation on its nodes.
    """
    tableau = Gauss(degree).tableau if scheme == "SVI" else SpectralCollocation(degree).tableau
    scale = (1 - mp.mpf(e)) ** 1.5
    larger, smaller = (_precise_errors(tableau, e, scale * mp.mpf(h)) for h in ORDER_STEPS)
    return tuple(
        None if min(pair) < NEGLIGIBLE else float(mp.log(pair[0] / pair[1]) / mp.log(2))
        for pair in zip(larger, smaller, strict=True)
    )


def _precise_errors(tableau: Tableau, e: float, h: Number) -> tuple[Number, ...]:
    exact_e = mp.mpf(e)
    start = (1 - exact_e, mp.zero), (mp.zero, mp.sqrt((1 + exact_e) / (1 - exact_e)))
    (x, y), (vx, vy) = _runge_kutta(tableau, *start, h)
    anomaly = mp.findroot(lambda E: E - exact_e * mp.sin(E) - h, h / (1 - exact_e))
    q1, q2 = mp.cos(anomaly) - exact_e, mp.sqrt(1 - exact_e**2) * mp.sin(anomaly)
    energy = (vx**2 + vy**2) / 2 - 1 / mp.hypot(x, y)
    momentum = x * vy - y * vx - mp.sqrt(1 - exact_e**2)
    return abs(x - q1), abs(y - q2), abs(momentum), abs(energy + mp.mpf(1) / 2)


Vector = tuple[Number, Number]


def _runge_kutta(tableau: Tableau, q: Vector, v: Vector, h: Number) -> tuple[Vector, Vector]:
    """Return one step of q'' = -q / |q|^3 by fixed-point iteration, which gains at least two digits per iteration."""
    rows = [*tableau.A, tableau.b]
    accelerations = [(mp.zero, mp.zero)] * len(tableau.b)
    for _ in range(DIGITS // 2):
        velocities = [_moved(v, row, accelerations, h) for row in rows]
        positions = [_moved(q, row, velocities[:-1], h) for row in rows]
        accelerations = [_attraction(position) for position in positions[:-1]]
    return positions[-1], velocities[-1]


def _moved(start: Vector, row: tuple[Number, ...], rates: list[Vector], h: Number) -> Vector:
    x, y = (mp.fdot(row, [rate[i] for rate in rates]) for i in (0, 1))
    return start[0] + h * x, start[1] + h * y


def _attraction(q: Vector) -> Vector:
    cube = mp.hypot(*q) ** 3
    return -q[0] / cube, -q[1] / cube


def shares_won(svi: Array, sc: Array, *, roundoff: float = ROUNDOFF) -> tuple[int, int]:
    """Return how often the error of SVI is smaller, and the number of comparisons with SC above round-off."""
    counted = np.isfinite(svi) & (sc > roundoff)
    return int((svi[counted] < sc[counted]).sum()), int(counted.sum())


def superiority(won: list[tuple[int, int]], *, otherwise: str = "") -> Comparison:
    """Return the check of conclusion (ii) from counts of :func:`shares_won`; ``otherwise`` names exceptions."""
    smaller, all_ = (sum(column) for column in zip(*won, strict=True))
    mostly = MOSTLY * all_ <= smaller < all_
    return Comparison(
        claim="SVI is more accurate than SC with the same number of points and the same step.",
        measured=f"The error of SVI is the smaller one in {smaller} of {all_} comparisons{otherwise}.",
        verdict=Verdict.PARTLY if mostly else holds(smaller == all_),
        bears_on=("accuracy",),
    )
