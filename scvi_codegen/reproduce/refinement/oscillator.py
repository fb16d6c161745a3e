"""Figures 6-8: the harmonic oscillator over one step, with more and more points, and of several step sizes."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache, partial

from scvi_codegen.exact.step import derived_step
from scvi_codegen.methods.method import Method
from scvi_codegen.reproduce.laboratory.experiment import experiment
from scvi_codegen.reproduce.laboratory.geometric import WINDOW
from scvi_codegen.reproduce.laboratory.running import BY_DEGREE, BY_POINTS, ROUNDOFF, SCHEMES, stepper_of
from scvi_codegen.reproduce.oscillators.oscillator import OSCILLATOR, POSITION, SYSTEM, VELOCITY
from scvi_codegen.reproduce.refinement.over_points import over_n
from scvi_codegen.reproduce.refinement.over_steps import over_h
from scvi_codegen.reproduce.refinement.study import Setting, Study
from scvi_codegen.tables.precision import Number, mp


def _errors(q: Number, p: Number, h: Number) -> dict[str, Number]:
    """Return the absolute errors at the end of a step, computed in 60 digits."""
    q, p, h = mp.mpf(q), mp.mpf(p), mp.mpf(h)
    return {"q": abs(q - mp.sin(h)), "energy": abs(q * q + p * p - 1) / 2}


def compiled_errors(solver: str, method: Method, h: float) -> Mapping[str, float]:
    """Return the errors of the compiled code in a step."""
    q, p = stepper_of(OSCILLATOR, method, solver).step(POSITION, VELOCITY, h=h, options=ROUNDOFF)
    return {what: float(error) for what, error in _errors(q[0], p[0], h).items()}


def precise_errors(method: Method, h: Number) -> Mapping[str, Number]:
    """Return the errors of the method in a step."""
    end = _derived(method)(POSITION, VELOCITY, h)
    return _errors(end.q[0], end.p[0], h)


_derived = lru_cache(partial(derived_step, OSCILLATOR))

DEGREES = {"SVI": range(10, 31, 3), "SC": range(10, 37, 3)}
PRINTED = {"SVI": (1e14, 0.09), "SC": (1e10, 0.21)}
"""Constants (C, K) of the lines of the paper's legend, the steeper for SVI."""
OVER_N = Study(
    sentences=(
        SYSTEM,
        "One step, h = 20, errors at its end.",
        "N on the axis counts Chebyshev points, as it says, so the degree is N - 1; verdicts are on this. N read as "
        "the degree is shown, too.",
        "The caption gives no quadrature; SVI has N Gauss points.",
        "Newton's iteration to relative round-off: SC does not reach an absolute 1e-14 on a step this long.",
        f"Lines c b^N are fitted to errors from {WINDOW[0]:g} to {WINDOW[1]:g}, and only these are compared.",
    ),
    settings=tuple(
        Setting(reading.name, short, reading, partial(compiled_errors, "newton"), judged=reading == BY_POINTS)
        for reading, short in ((BY_POINTS, "N points"), (BY_DEGREE, "N the degree"))
    ),
    quantities=("q", "energy"),
    steps=(20.0,),
    degrees=DEGREES,
    lines={(scheme, what): PRINTED[scheme] for what in ("q", "energy") for scheme in SCHEMES},
    resolved=WINDOW[1],
)

STEPS = tuple(10.0 ** (0.3 * k - 3.0) for k in range(14))
FITTED = tuple(2.0**exponent for exponent in (-8, -6, -4))
"""Step sizes for fits in 60 digits: small enough for a straight line, errors far above round-off."""
POINTS, DEGREE, BEYOND = (
    Setting(
        f"{reading.meaning}; SVI: N{f' + {more}' if more else ''} Gauss points",
        short,
        reading,
        partial(compiled_errors, "auto"),
        more,
        reading == BY_POINTS,
        precise_errors,
        FITTED,
    )
    for reading, more, short in (
        (BY_POINTS, 0, "N points"),
        (BY_DEGREE, 0, "N the degree"),
        (BY_DEGREE, 1, "N the degree, N + 1 Gauss points"),
    )
)
OVER_H = Study(
    sentences=(
        SYSTEM,
        "One step of size h, errors at its end.",
        "N counts Chebyshev points, as the caption says, so the degree is N - 1; verdicts are on this. N read as the "
        "degree is shown, too.",
        "The caption gives no quadrature: SVI has N Gauss points, which is one more than the degree.",
        "Dotted lines are those of the paper's legend.",
        "Marks are the compiled code, iterated to relative round-off: at h = 8 SC does not reach an absolute 1e-14.",
        "Lines, and the fitted powers, are the same equations solved in 60 digits: the orders show without round-off.",
        f"Powers are fitted to steps from {FITTED[0]:g} to {FITTED[-1]:g}.",
    ),
    settings=(POINTS, DEGREE),
    quantities=("q",),
    steps=STEPS,
    powers={
        "q": {3: 1.5, 5: 1e-2, 7: 1e-5, 9: 1e-5, 13: 1e-10},
        "energy": {2: 1.0, 4: 1e-2, 6: 1e-5, 8: 1e-5, 11: 1e-9},
    },
    exact=True,
)

experiment("figure-6", "Harmonic oscillator: error over one step h = 20 with more and more points")(
    partial(over_n, OVER_N)
)
experiment("figure-7", "Harmonic oscillator: error of q over one step of size h")(partial(over_h, OVER_H))
experiment("figure-8", "Harmonic oscillator: error of the energy over one step of size h")(
    partial(over_h, OVER_H, quantities=("energy",), settings=(POINTS, DEGREE, BEYOND))
)
