"""Figures of errors of one step: over the number of points (6, 16, 17) and over the step size (7, 8, 18-20)."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from scvi_codegen.reproduce.refinement import SCHEMES, WINDOW, InitialValue, Law, StepCase, Study, refinement
from scvi_codegen.reproduce.runs import KEPLER, system_of
from scvi_codegen.tables.precision import Number, mp


def _oscillator_errors(q: Sequence[Number], p: Sequence[Number], h: Number) -> dict[str, Number]:
    return {"q": abs(q[0] - mp.sin(h)), "energy": abs(q[0] ** 2 + p[0] ** 2 - 1) / 2}


def _kepler_errors(e: Number, q: Sequence[Number], p: Sequence[Number], h: Number) -> dict[str, Number]:
    """Return the errors of a step from the perihelion, by Kepler's equation."""
    minor = mp.sqrt(1 - e**2)
    anomaly = mp.findroot(lambda E: E - e * mp.sin(E) - h, h / (1 - e) if h < 1 else h)
    energy = (p[0] ** 2 + p[1] ** 2) / 2 - 1 / mp.hypot(*q) + mp.mpf(1) / 2
    errors = q[0] - mp.cos(anomaly) + e, q[1] - minor * mp.sin(anomaly), q[0] * p[1] - q[1] * p[0] - minor, energy
    return dict(zip(("q1", "q2", "momentum", "energy"), map(abs, errors), strict=True))


def _kepler(eccentricity: float) -> InitialValue:
    e = mp.mpf(eccentricity)
    fitted = tuple((1 - e) ** 1.5 * mp.mpf(h) for h in ("0.05", "0.025"))
    start = (1 - e, mp.zero), (mp.zero, mp.sqrt((1 + e) / (1 - e)))
    return InitialValue(KEPLER, *start, partial(_kepler_errors, e), fitted)


SMALL_STEPS = tuple(mp.mpf(2) ** k for k in (-8, -6, -4))
OSCILLATOR = InitialValue(system_of("harmonic-oscillator"), (mp.zero,), (mp.one,), _oscillator_errors, SMALL_STEPS)
BY_POINTS, BY_DEGREE = StepCase("N points", OSCILLATOR), StepCase("N the degree", OSCILLATOR, 0, judged=False)
BEYOND = StepCase("N the degree, N + 1 Gauss points", OSCILLATOR, 0, 1, judged=False)
CIRCLE, ELLIPSE = (
    StepCase("circle, N points", _kepler(0.0), 1, -1),
    StepCase("e = 0.5, N the degree", _kepler(0.5), 0, judged=False),
)
COUNTS = "N counts Chebyshev points, as the caption says, so the degree is N - 1. N read as the degree is shown, too."
OVER_N = Study(
    sentences=(
        "m = k = 1, q(0) = 0, p(0) = 1; one step, h = 20, errors at its end, solved to round-off.",
        f"{COUNTS} The caption gives no quadrature: SVI has N Gauss points.",
        f"Lines c b^N are fitted to errors from {WINDOW[0]:g} to {WINDOW[1]:g}, and only these are compared.",
    ),
    cases=(BY_POINTS, BY_DEGREE),
    quantities=("q", "energy"),
    steps=(20.0,),
    degrees={"SVI": range(10, 31, 3), "SC": range(10, 37, 3)},
    lines={(s, q): law for q in ("q", "energy") for s, law in (("SVI", Law(1e14, 0.09)), ("SC", Law(1e10, 0.21)))},
    resolved=WINDOW[1],
)
OVER_H = Study(
    sentences=(
        "m = k = 1, q(0) = 0, p(0) = 1; one step of size h, errors at its end, solved to round-off.",
        f"{COUNTS} The caption gives no quadrature: SVI has N Gauss points.",
        "Dotted lines are those of the legend. Powers are fitted to small steps in 60 digits.",
    ),
    cases=(BY_POINTS, BY_DEGREE),
    quantities=("q",),
    steps=tuple(10.0 ** (0.3 * k - 3.0) for k in range(14)),
    powers={
        "q": {3: 1.5, 5: 1e-2, 7: 1e-5, 9: 1e-5, 13: 1e-10},
        "energy": {2: 1.0, 4: 1e-2, 6: 1e-5, 8: 1e-5, 11: 1e-9},
    },
)
KEPLER_OVER_N = Study(
    sentences=(
        "Kepler's problem, one step h = 5 from the perihelion, errors at its end, solved to round-off; SVI has N - 1 "
        "Gauss points. A missing point means that the iteration found no solution.",
        "The caption names no eccentricity. The circle e = 0, e = 0.2 of Table 8 and e = 0.5 of Figs. 13-15 are run, "
        "and each verdict is on all three: what is found on the circle alone holds in part.",
    ),
    cases=tuple(StepCase(f"e = {e:g}", _kepler(e), 1, -1) for e in (0.0, 0.2, 0.5)),
    quantities=("q1", "q2"),
    steps=(5.0,),
    degrees=dict.fromkeys(SCHEMES, (7, 8, 9, 10, 11, 13, 15, 17, 19, 21)),
    lines={(s, q): law for q in ("q1", "q2") for s, law in (("SVI", Law(1e10, 0.03)), ("SC", Law(1e7, 0.1)))},
)
KEPLER_OVER_H = Study(
    sentences=(
        "Kepler's problem, one step of h = 0.001 to 3 from the perihelion, errors at its end, solved to round-off; SVI "
        "has as many Gauss points as its degree.",
        "The caption says that N counts Chebyshev points and names no eccentricity: first so, with e = 0; then N the "
        "degree, as in other figures of section 3, with e = 0.5, that of Figs. 13-15.",
        "Dotted lines are those of the legend. Powers are fitted to small steps in 60 digits.",
    ),
    cases=(CIRCLE, ELLIPSE),
    quantities=("q1", "q2"),
    steps=tuple(float(h) for h in np.geomspace(1e-3, 3.0, 36)),
    powers={
        "q1": {2: 1.5, 4: 1e-2, 6: 1e-5, 8: 1e-4, 12: 1e-8},
        "q2": {3: 1.5, 5: 1e-2, 7: 1e-5, 10: 1e-7},
    },
)
INVARIANT_LINES = {
    ("SC", "momentum"): Law(1e6, 0.1),
    ("SC", "energy"): Law(1e6, 0.1),
    ("SVI", "energy"): Law(1e13, 0.004),
}
BOTH = replace(KEPLER_OVER_N, quantities=("momentum", "energy"), lines=INVARIANT_LINES)
ENERGY = replace(OVER_H, quantities=("energy",), cases=(BY_POINTS, BY_DEGREE, BEYOND))
KEPLER_MOMENTUM, KEPLER_ENERGY = (replace(KEPLER_OVER_H, quantities=(what,)) for what in ("momentum", "energy"))
EXPERIMENTS = (
    refinement("figure-6: Harmonic oscillator: error over one step h = 20 with more and more points", OVER_N),
    refinement("figure-7: Harmonic oscillator: error of q over one step of size h", OVER_H),
    refinement("figure-8: Harmonic oscillator: error of the energy over one step of size h", ENERGY),
    refinement("figure-16: Kepler: error of q1 and q2 in one step h = 5 over the number of points", KEPLER_OVER_N),
    refinement("figure-17: Kepler: error of momentum and energy in one step h = 5 over the number of points", BOTH),
    refinement("figure-18: Kepler: error of q1 and q2 in one step over the step", KEPLER_OVER_H),
    refinement("figure-19: Kepler: error of the momentum in one step over the step", KEPLER_MOMENTUM),
    refinement("figure-20: Kepler: error of the energy in one step over the step", KEPLER_ENERGY),
)
