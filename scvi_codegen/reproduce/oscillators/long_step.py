"""Figure 6: the harmonic oscillator over one long step, over the number of points."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache, partial
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.methods.method import Method
from scvi_codegen.reproduce.laboratory.drawing import COLORS, panels
from scvi_codegen.reproduce.laboratory.experiment import (
    Cell,
    Comparison,
    Picture,
    Result,
    TableBlock,
    Verdict,
    experiment,
    holds,
    judged,
)
from scvi_codegen.reproduce.laboratory.geometric import (
    AGREEMENT_FACTOR,
    WINDOW,
    Line,
    factors,
    fitted_line,
    typical,
    within,
)
from scvi_codegen.reproduce.laboratory.running import (
    BY_DEGREE,
    BY_POINTS,
    READINGS,
    ROUNDOFF,
    SCHEMES,
    Reading,
    stepper_of,
)
from scvi_codegen.reproduce.oscillators.one_degree import largest
from scvi_codegen.reproduce.oscillators.oscillator import OSCILLATOR, POSITION, SYSTEM, VELOCITY

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

TITLE = "Harmonic oscillator: error over one step h = 20 with more and more points"
STEP = 20.0
DEGREES: Mapping[str, Sequence[int]] = {"SVI": range(10, 31, 3), "SC": range(10, 37, 3)}
PRINTED: Mapping[str, Line] = {"SVI": (1e14, 0.09), "SC": (1e10, 0.21)}
"""Constants (C, K) of the lines of the paper's legend, the steeper for SVI."""
QUANTITIES = ("q", "energy")


class Errors(NamedTuple):
    """Absolute errors after the step."""

    q: float
    energy: float


class ErrorsOverN(NamedTuple):
    """Errors of a scheme over N."""

    n: Array
    q: Array
    energy: Array

    def fit(self, what: str) -> Line | None:
        """Return (C, K) for one of the two quantities."""
        return fitted_line(self.n, getattr(self, what))


Curves: TypeAlias = Mapping[tuple[Reading, str], ErrorsOverN]


@lru_cache
def _errors(method: Method) -> Errors:
    stepper = stepper_of(OSCILLATOR, method, "newton")
    q, p = stepper.step(POSITION, VELOCITY, h=STEP, options=ROUNDOFF)
    return Errors(float(abs(q[0] - np.sin(STEP))), float(abs(stepper.energy(q, p) - 0.5)))


def _curve(reading: Reading, scheme: str, degrees: Sequence[int]) -> ErrorsOverN:
    counts = [degree + reading.beyond_degree for degree in degrees]
    errors = np.array([_errors(reading.method(scheme, n)) for n in counts])
    return ErrorsOverN(np.array(counts, dtype=float), *errors.T)


@experiment("figure-6", "Harmonic oscillator: error over one step h = 20 with more and more points")
def convergence(_: Mapping[str, Result], degrees: Mapping[str, Sequence[int]] = DEGREES) -> Result:
    """Return the figure, for some degrees."""
    curves = {(reading, scheme): _curve(reading, scheme, degrees[scheme]) for reading in READINGS for scheme in SCHEMES}
    formats = {"N": "g", "error of q": ".2e", "error of the energy": ".2e", "C": ".1e", "printed C": ".0e"}
    return Result(
        setting=(
            SYSTEM,
            "One step, h = 20, errors at its end.",
            "N on the axis counts Chebyshev points, as it says, so the degree is N - 1; verdicts are on this. N read "
            "as the degree is shown, too.",
            "The caption gives no quadrature; SVI has N Gauss points.",
            "Newton's iteration to relative round-off: SC does not reach an absolute 1e-14 on a step this long.",
            f"Lines C K^N are fitted to errors from {WINDOW[0]:g} to {WINDOW[1]:g}, and only these are compared.",
        ),
        checks=(_geometric(curves), _bases(curves), _lines(curves), _ahead(curves)),
        tables=(
            TableBlock(
                columns=("reading", "scheme", "N", "error of q", "error of the energy"),
                rows=tuple(
                    (reading.name, scheme, *map(float, row))
                    for (reading, scheme), curve in curves.items()
                    for row in zip(*curve, strict=True)
                ),
                formats=formats,
            ),
            TableBlock(
                name="fits",
                columns=("reading", "scheme", "error of", "C", "K", "printed C", "printed K"),
                rows=tuple(_fits(curves)),
                formats=formats,
            ),
        ),
        picture=Picture(draw=partial(_draw, curves), height=7.0),
    )


def _fits(curves: Curves) -> Iterator[tuple[Cell, ...]]:
    for (reading, scheme), curve in curves.items():
        for what in QUANTITIES:
            yield reading.name, scheme, what, *(curve.fit(what) or (None, None)), *PRINTED[scheme]


def _geometric(curves: Curves) -> Comparison:
    bases = {
        f"{what} of {scheme}": fit[1]
        for scheme in SCHEMES
        for what in QUANTITIES
        if (fit := curves[BY_POINTS, scheme].fit(what))
    }
    return Comparison(
        claim="SVI and SC converge geometrically in the number of points.",
        measured=f"Fitted bases K: {', '.join(f'{key}: {base:.2f}' for key, base in bases.items())}. With N the degree "
        "the energy of SVI, having as many Gauss points as the degree, has no error but round-off (at most "
        f"{largest(curves[BY_DEGREE, 'SVI'].energy):.0e}), and the figure shows one.",
        verdict=judged(*(base < 0.5 for base in bases.values())),
        bears_on=("geometric",),
    )


def _bases(curves: Curves) -> Comparison:
    fits = {scheme: curves[BY_POINTS, scheme].fit("q") for scheme in SCHEMES}
    pairs = {scheme: (fit[1], PRINTED[scheme][1]) for scheme, fit in fits.items() if fit}
    return Comparison(
        claim="The errors fall like (0.09)^N (SVI) and (0.21)^N (SC), the bases of the legend.",
        measured="Fitted and printed K of q: "
        + ", ".join(f"{scheme}: {base:.3f}, {printed:g}" for scheme, (base, printed) in pairs.items())
        + "; bases that differ by less than 30 % count as the same.",
        verdict=judged(*(abs(base / printed - 1.0) < 0.3 for base, printed in pairs.values())),
    )


def _lines(curves: Curves) -> Comparison:
    """Return the check of the lines including their constants, which indicates what N counts."""
    off = {
        (reading, scheme, what): typical([factors(curve.n, getattr(curve, what), PRINTED[scheme])])
        for (reading, scheme), curve in curves.items()
        for what in QUANTITIES
        if curve.fit(what)
    }

    def listed(wanted: Reading) -> str:
        return ", ".join(f"{f:.0f} ({what} of {scheme})" for (one, scheme, what), f in off.items() if one == wanted)

    return Comparison(
        claim="The errors run along 1e14 (0.09)^N (SVI) and 1e10 (0.21)^N (SC), the lines of the legend.",
        measured=f"The typical factor between an error and its line is {listed(BY_POINTS)} with N points, and "
        f"{listed(BY_DEGREE)} with N the degree. Below {AGREEMENT_FACTOR:g} counts as along.",
        verdict=holds(all(factor < AGREEMENT_FACTOR for (reading, *_), factor in off.items() if reading == BY_POINTS)),
    )


def _ahead(curves: Curves) -> Comparison:
    """Return the comparison of SVI and SC at common degrees, where SC resolves the step above round-off."""
    svi, sc = curves[BY_POINTS, "SVI"], curves[BY_POINTS, "SC"]
    _, ours, theirs = np.intersect1d(svi.n, sc.n, return_indices=True)
    wins, cases = 0, 0
    for what in QUANTITIES:
        one, other = getattr(svi, what)[ours], getattr(sc, what)[theirs]
        wins += int(np.count_nonzero(within(other) & (one < other)))
        cases += int(np.count_nonzero(within(other)))
    return Comparison(
        claim="SVI is more accurate than SC in configuration and energy at every N.",
        measured=f"SVI is more accurate in {wins} of {cases} errors of SC that lie between {WINDOW[0]:g} and "
        f"{WINDOW[1]:g}.",
        verdict=Verdict.HOLDS if wins == cases else Verdict.PARTLY if wins else Verdict.FAILS,
        bears_on=("accuracy",),
    )


def _draw(curves: Curves, figure: Figure) -> None:
    panels_shown = [(reading, what) for reading in READINGS for what in QUANTITIES]
    for axes, (reading, what) in zip(panels(figure, 2, 2), panels_shown, strict=True):
        for scheme in SCHEMES:
            curve, (constant, base) = curves[reading, scheme], PRINTED[scheme]
            errors = getattr(curve, what)
            shown = np.where(errors > 0.0, errors, np.nan)
            axes.semilogy(curve.n, shown, "o-", color=COLORS[scheme], markersize=4, label=scheme)
            label = f"paper: $10^{{{np.log10(constant):.0f}}}\\ {base:g}^N$"
            axes.semilogy(curve.n, constant * base**curve.n, "--", color=COLORS[scheme], linewidth=0.9, label=label)
        axes.set(xlabel="N", ylabel=f"error of {what}", ylim=(1e-17, 1e4), title=reading.meaning)
        axes.legend()
