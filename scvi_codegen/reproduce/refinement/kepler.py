"""Figures 16-20: error of a single step of Kepler's problem over the number of points, and over the step size.

The captions state neither the eccentricity nor, unambiguously, what "N" counts. The lines in the paper have the slopes
and sizes of the errors on the circle, e = 0, with N points, which is degree N - 1. The errors for e = 0.2 and 0.5, the
eccentricities of Table 8 and of Figs. 13-15, differ; they are computed and judged, too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from scvi_codegen.errors import StepFailedError
from scvi_codegen.exact.step import derived_step
from scvi_codegen.methods import SVI, Gauss, SpectralCollocation
from scvi_codegen.methods.method import Method
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.reproduce.kepler.orbits import SYSTEM, angular_momentum, exact_flow, perihelion
from scvi_codegen.reproduce.laboratory.experiment import experiment
from scvi_codegen.reproduce.laboratory.running import BY_DEGREE, BY_POINTS, SCHEMES, stepper_of
from scvi_codegen.reproduce.refinement.over_points import over_n
from scvi_codegen.reproduce.refinement.over_steps import over_h
from scvi_codegen.reproduce.refinement.study import Setting, Study
from scvi_codegen.tables.precision import Number, mp

QUANTITIES = ("q1", "q2", "momentum", "energy")
TO_ROUNDOFF = SolverOptions(max_iterations=1000)


def compiled_errors(e: float, method: Method, h: float) -> Mapping[str, float]:
    """Return the errors of the compiled step of h from the perihelion; NaN if it has no solution."""
    stepper = stepper_of(SYSTEM, method, "newton")
    q0, v0 = perihelion(e)
    try:
        q, p = stepper.step(q0, v0, h, options=TO_ROUNDOFF)
    except StepFailedError:
        return dict.fromkeys(QUANTITIES, math.nan)
    exact, _ = exact_flow(q0, v0, h)
    momentum = float(angular_momentum(q, p)) - math.sqrt(1 - e * e)
    errors = np.abs([*(q - exact[0]), momentum, stepper.energy(q, p) + 0.5])
    return dict(zip(QUANTITIES, map(float, errors), strict=True))


def precise_errors(e: float, method: Method, h: Number) -> Mapping[str, Number]:
    """Return the errors of the step in 60 digits, as a Runge-Kutta method.

    An SVI with as many Gauss points as its degree is Gauss collocation, SC is collocation on its nodes.
    """
    assert isinstance(method, SVI | SpectralCollocation)
    degree = method.degree
    equal = Gauss(degree) if isinstance(method, SVI) else SpectralCollocation(degree, form="phase-space")
    exact_e = mp.mpf(e)
    start = (1 - exact_e, mp.zero), (mp.zero, mp.sqrt((1 + exact_e) / (1 - exact_e)))
    end = derived_step(SYSTEM, equal)(*start, h)
    (x, y), (vx, vy) = end.q, end.p
    anomaly = mp.findroot(lambda E: E - exact_e * mp.sin(E) - h, h / (1 - exact_e))
    q1, q2 = mp.cos(anomaly) - exact_e, mp.sqrt(1 - exact_e**2) * mp.sin(anomaly)
    energy = (vx**2 + vy**2) / 2 - 1 / mp.hypot(x, y) + mp.mpf(1) / 2
    momentum = x * vy - y * vx - mp.sqrt(1 - exact_e**2)
    return dict(zip(QUANTITIES, map(abs, (x - q1, y - q2, momentum, energy)), strict=True))


POINTS = (8, 9, 10, 11, 12, 14, 16, 18, 20, 22)
OVER_N = Study(
    sentences=(
        "Kepler's problem, one step h = 5 from the perihelion, N = 8, 10, ..., 22 Chebyshev points, which is degree N "
        "- 1; SVI has N - 1 Gauss points. The error is that at the end of the step.",
        "The caption names no eccentricity. The circle e = 0, e = 0.2 of Table 8 and e = 0.5 of Figs. 13-15 are run, "
        "and each verdict is on all three: what is found on the circle alone holds in part.",
        "The stage equations are solved to round-off from the straight line: TOL = 1e-14 is less than the rounding of "
        "the stage velocities at this h. A missing point means that the iteration found no solution.",
    ),
    settings=tuple(
        Setting(f"e = {e:g}", f"e = {e:g}", BY_POINTS, partial(compiled_errors, e), more=-1) for e in (0.0, 0.2, 0.5)
    ),
    quantities=("q1", "q2"),
    steps=(5.0,),
    degrees=dict.fromkeys(SCHEMES, tuple(n - 1 for n in POINTS)),
    lines={
        ("SC", "q1"): (1e7, 0.1),
        ("SC", "q2"): (1e7, 0.1),
        ("SVI", "q1"): (1e10, 0.03),
        ("SVI", "q2"): (1e10, 0.03),
    },
)
OF_INVARIANTS = replace(
    OVER_N,
    quantities=("momentum", "energy"),
    lines={("SC", "momentum"): (1e6, 0.1), ("SC", "energy"): (1e6, 0.1), ("SVI", "energy"): (1e13, 0.004)},
)

ORDER_STEPS = ("0.05", "0.025")
"""Step sizes in units of (1 - e)^(3/2), the time scale at perihelion."""
CIRCLE, ELLIPSE = (
    Setting(
        title,
        short,
        reading,
        partial(compiled_errors, e),
        more,
        e == 0.0,
        partial(precise_errors, e),
        tuple((1 - mp.mpf(e)) ** 1.5 * mp.mpf(h) for h in ORDER_STEPS),
    )
    for title, short, reading, e, more in (
        ("circle, N points (degree N - 1)", "N points", BY_POINTS, 0.0, -1),
        ("e = 0.5, N the degree", "N the degree", BY_DEGREE, 0.5, 0),
    )
)
OVER_H = Study(
    sentences=(
        "Kepler's problem, one step of h = 0.001 to 3 from the perihelion; SVI has as many Gauss points as its degree. "
        "The error is that at the end of the step.",
        "The caption says that N counts Chebyshev points and names no eccentricity. Left: so, degree N - 1, with e = "
        "0. Right: N the degree, as in other figures of section 3, with e = 0.5, that of Figs. 13-15.",
        "Curves are of the compiled steps, solved to round-off. Slopes are for h to 0, from steps in 60 digits of the "
        "Runge-Kutta methods that equal SVI (Gauss) and SC (collocation on its nodes).",
    ),
    settings=(CIRCLE, ELLIPSE),
    quantities=("q1", "q2"),
    steps=tuple(float(h) for h in np.geomspace(1e-3, 3.0, 36)),
    powers={
        "q1": {2: 1.5, 4: 1e-2, 6: 1e-5, 8: 1e-4, 12: 1e-8},
        "q2": {3: 1.5, 5: 1e-2, 7: 1e-5, 10: 1e-7},
    },
)

for number, run, study, title in (
    (16, over_n, OVER_N, "error of q1 and q2 in one step h = 5 over the number of points"),
    (17, over_n, OF_INVARIANTS, "error of momentum and energy in one step h = 5 over the number of points"),
    (18, over_h, OVER_H, "error of q1 and q2 in one step over the step"),
    *(
        (
            *(19 + k, over_h),
            replace(OVER_H, quantities=(what,)),
            f"error of the {what} in one step over the step",
        )
        for k, what in enumerate(("momentum", "energy"))
    ),
):
    experiment(f"figure-{number}", f"Kepler: {title}")(partial(run, study))
