"""Figures 7-8: the harmonic oscillator over one step of several sizes; orders of SVI and SC."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.exact.step import derived_step
from scvi_codegen.methods.method import Method
from scvi_codegen.reproduce.laboratory.drawing import COLORS, draw_powers, panels
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
    series_table,
)
from scvi_codegen.reproduce.laboratory.running import BY_DEGREE, BY_POINTS, ROUNDOFF, SCHEMES, Reading, stepper_of
from scvi_codegen.reproduce.oscillators.oscillator import OSCILLATOR, POSITION, SYSTEM, VELOCITY
from scvi_codegen.tables.precision import Number, mp

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

LEGEND = (2, 4, 6)
"""Values of N."""


@dataclass(frozen=True, slots=True)
class Variant:
    """Meaning of N, and the number of Gauss points of SVI beyond N."""

    reading: Reading
    more: int = 0

    @property
    def title(self) -> str:
        """Description in words."""
        return f"{self.reading.meaning}; SVI: N{f' + {self.more}' if self.more else ''} Gauss points"

    def method(self, scheme: str, n: int) -> Method:
        """Return the method with the label ``SVI, N = 2``."""
        return self.reading.method(scheme, n, more=self.more)


POINTS, DEGREES, BEYOND = Variant(BY_POINTS), Variant(BY_DEGREE), Variant(BY_DEGREE, more=1)
SHOWN = {"q": (POINTS, DEGREES), "energy": (POINTS, DEGREES, BEYOND)}
"""Variants in the pictures; verdicts are based on the first."""
STEPS = tuple(10.0 ** (0.3 * k - 3.0) for k in range(14))
FITTED = tuple(2.0**exponent for exponent in (-8, -6, -4))
"""Step sizes for fits in 60 digits: small enough for a straight line, errors far above round-off."""
NO_ERROR = 1e-50
ALIKE = 10.0
"""Largest factor between constants of lines that count as equal."""
PRINTED = {"q": {3: 1.5, 5: 1e-2, 7: 1e-5, 9: 1e-5, 13: 1e-10}, "energy": {2: 1.0, 4: 1e-2, 6: 1e-5, 8: 1e-5, 11: 1e-9}}
"""Lines of the paper's legends: the constant of each power of h."""
SETTING = (
    SYSTEM,
    "One step of size h, errors at its end.",
    "N counts Chebyshev points, as the caption says, so the degree is N - 1; verdicts are on this. N read as the "
    "degree is shown, too.",
    "The caption gives no quadrature: SVI has N Gauss points, which is one more than the degree.",
    "Dotted lines are those of the paper's legend.",
    "Marks are the compiled code, iterated to relative round-off: at h = 8 SC does not reach an absolute 1e-14.",
    "Lines, and the fitted powers, are the same equations solved in 60 digits: the orders show without round-off.",
    f"Powers are fitted to steps from {FITTED[0]:g} to {FITTED[-1]:g}.",
)


class PowerLaw(NamedTuple):
    """Line constant h^power."""

    constant: float
    power: float


def _errors(q: Number, p: Number, h: float) -> dict[str, float]:
    """Return the absolute errors at the end of a step, computed in 60 digits."""
    q, p, h = mp.mpf(q), mp.mpf(p), mp.mpf(h)
    return {"q": abs(q - mp.sin(h)), "energy": abs(q * q + p * p - 1) / 2}


@lru_cache
def _exact_errors(method: Method, steps: tuple[float, ...]) -> dict[str, Array]:
    """Return the errors of the method in a step, by quantity."""
    step = derived_step(OSCILLATOR, method)
    ends = [(step(POSITION, VELOCITY, h), h) for h in steps]
    return _collected([_errors(end.q[0], end.p[0], h) for end, h in ends])


@lru_cache
def _compiled_errors(method: Method, steps: tuple[float, ...]) -> dict[str, Array]:
    """Return the errors of the compiled code in a step, by quantity."""
    stepper = stepper_of(OSCILLATOR, method)
    ends = [(*stepper.step(POSITION, VELOCITY, h=h, options=ROUNDOFF), h) for h in steps]
    return _collected([_errors(q[0], p[0], h) for q, p, h in ends])


def _collected(errors: Sequence[Mapping[str, float]]) -> dict[str, Array]:
    return {what: np.array([float(error[what]) for error in errors]) for what in ("q", "energy")}


def fitted_power(what: str, method: Method) -> PowerLaw | None:
    """Return the line through the errors of small steps; ``None`` for an exact method."""
    errors = _exact_errors(method, FITTED)[what]
    if errors.max() < NO_ERROR:
        return None
    power, intercept = np.polyfit(np.log(FITTED), np.log(errors), 1)
    return PowerLaw(float(np.exp(intercept)), float(power))


def _fits(what: str, variant: Variant) -> dict[tuple[str, int], PowerLaw | None]:
    """Return the fitted lines by scheme and N."""
    return {(scheme, n): fitted_power(what, variant.method(scheme, n)) for scheme in SCHEMES for n in LEGEND}


class ErrorsOverH(NamedTuple):
    """Errors over h, of the method and, if it was run, of the compiled code."""

    exact: Array
    compiled: Array | None


Curves: TypeAlias = Mapping[tuple[str, int], ErrorsOverH]
"""Errors by scheme and N."""


def _curves(what: str, variant: Variant, steps: tuple[float, ...]) -> Curves:
    methods = {(scheme, n): variant.method(scheme, n) for scheme in SCHEMES for n in LEGEND}
    return {
        key: ErrorsOverH(
            _exact_errors(method, steps)[what],
            _compiled_errors(method, steps)[what] if variant is POINTS else None,
        )
        for key, method in methods.items()
    }


def refinement(what: str, _: Mapping[str, Result], steps: tuple[float, ...] = STEPS) -> Result:
    """Return a figure, for some step sizes."""
    curves = {variant: _curves(what, variant, steps) for variant in SHOWN[what]}
    return Result(
        setting=SETTING,
        checks=(_powers(what), _constants(what), _ahead(what, curves[POINTS], steps)),
        tables=(
            TableBlock(
                columns=("variant", "scheme", "N", "fitted power of h", "constant", "printed constant"),
                rows=tuple(_rows(what)),
                formats={"fitted power of h": ".2f", "constant": ".1e", "printed constant": ".1e"},
            ),
            _errors_table(curves, steps),
        ),
        picture=Picture(draw=partial(_draw, what, curves, steps), width=4.5 * len(curves), height=4.8),
    )


def _rows(what: str) -> Iterator[tuple[Cell, ...]]:
    for variant in SHOWN[what]:
        for (scheme, n), fit in _fits(what, variant).items():
            numbers = (fit.power, fit.constant, PRINTED[what].get(round(fit.power))) if fit else (None, None, None)
            yield variant.title, scheme, n, *numbers


def _errors_table(curves: Mapping[Variant, Curves], steps: tuple[float, ...]) -> TableBlock:
    columns: dict[str, list[float]] = {"h": list(steps)}
    for variant, of_variant in curves.items():
        for (scheme, n), curve in of_variant.items():
            label = f"{scheme}, N = {n}, {variant.title}"
            columns[label] = curve.exact.tolist()
            if curve.compiled is not None:
                columns[f"{label}, compiled"] = curve.compiled.tolist()
    return series_table(columns, "errors")


def _powers(what: str) -> Comparison:
    """Return the check that the powers of the legend are those of the curves."""
    result = {variant: {round(fit.power) for fit in _fits(what, variant).values() if fit} for variant in SHOWN[what]}
    printed, ours = set(PRINTED[what]), result[POINTS]
    outcome = "These are the printed ones"
    if missing := sorted(printed - ours):
        others = _powers_of_h(sorted(ours - printed)) or "nothing"
        outcome = f"{_powers_of_h(missing)} is not among them, where there is {others}"
    return Comparison(
        claim=f"The errors of N = 2, 4, 6 follow the lines {_powers_of_h(PRINTED[what])} of the legend.",
        measured=f"{'; '.join(_listed(what, variant) for variant in SHOWN[what])}. With N points: {outcome}.",
        verdict=judged(*(power in ours for power in PRINTED[what])),
    )


def _listed(what: str, variant: Variant) -> str:
    fits = _fits(what, variant)
    parts = []
    for scheme in SCHEMES:
        powers = [f"{fit.power:.1f}" for n in LEGEND if (fit := fits[scheme, n])]
        parts.append(f"{scheme} {', '.join(powers) or 'no error at all'}")
    return f"{variant.title}: fitted powers {' and '.join(parts)}"


def _powers_of_h(powers: Iterable[int]) -> str:
    return ", ".join(f"h^{power}" for power in powers)


def _factors(what: str, variant: Variant) -> list[float]:
    """Return the factors between fitted constants and the printed constant of the same power."""
    fits = [fit for fit in _fits(what, variant).values() if fit]
    printed = [(fit.constant, PRINTED[what].get(round(fit.power))) for fit in fits]
    return [max(ours / theirs, theirs / ours) for ours, theirs in printed if theirs]


def _constants(what: str) -> Comparison:
    """Return the check of the constants of lines of equal power, which indicates what N counts."""
    ours = _factors(what, POINTS)
    others = [
        f"{min(f):.1f} to {max(f):.0f} ({variant.title})"
        for variant in SHOWN[what][1:]
        if (f := _factors(what, variant))
    ]
    return Comparison(
        claim="The lines run along the errors.",
        measured=f"The constants of {len(ours)} curves whose power is printed are off by factors from "
        f"{min(ours):.1f} to {max(ours):.1f} with N points; otherwise by {', by '.join(others)}. "
        f"Below {ALIKE:g} counts as along.",
        verdict=holds(max(ours) < ALIKE),
    )


def _ahead(what: str, curves: Curves, steps: tuple[float, ...]) -> Comparison:
    """Return the comparison of SVI and SC at every N and step size, without round-off."""
    pairs = [(curves["SVI", n].exact, curves["SC", n].exact) for n in LEGEND]
    wins = sum(int(np.count_nonzero(svi < sc)) for svi, sc in pairs)
    lost = sorted({f"{steps[k]:.3g}" for svi, sc in pairs for k in np.flatnonzero(svi >= sc)}, key=float)
    cases = len(steps) * len(LEGEND)
    return Comparison(
        claim=f"SVI is more accurate than SC in {what} with the same number of points and the same step.",
        measured=f"SVI is more accurate in {wins} of {cases} pairs of N and h, from h = {steps[0]:g} "
        f"to {steps[-1]:.2g}" + (f"; not at h = {', '.join(lost)}." if lost else "."),
        verdict=Verdict.HOLDS if wins == cases else Verdict.PARTLY if wins else Verdict.FAILS,
        bears_on=("accuracy",),
    )


def _draw(
    what: str,
    curves: Mapping[Variant, Curves],
    steps: tuple[float, ...],
    figure: Figure,
) -> None:
    for axes, (variant, of_variant) in zip(panels(figure, 1, len(curves)), curves.items(), strict=True):
        draw_powers(axes, (1e-3, 0.5), [(constant, power) for power, constant in PRINTED[what].items()])
        for (scheme, n), curve in of_variant.items():
            _draw_curve(axes, steps, curve, f"{scheme}, N = {n}")
        axes.set(xscale="log", yscale="log", xlabel="h", ylim=(1e-20, 1e2), title=variant.title.replace("; ", "\n"))
        axes.plot([], [], ":", color=COLORS["exact"], linewidth=0.8, label="legend of the paper")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    figure.axes[0].set_ylabel(f"error of {what} after one step")


LOOKS = dict(zip(map(str, LEGEND), (("o", "-"), ("s", "--"), ("D", "-.")), strict=True))


def _draw_curve(axes: Axes, steps: tuple[float, ...], curve: ErrorsOverH, label: str) -> None:
    color, (mark, line) = COLORS[label.partition(",")[0]], LOOKS[label[-1]]
    axes.plot([], [], mark + line, color=color, markersize=3, linewidth=1.0, label=label)
    if curve.exact.max() > NO_ERROR:
        axes.plot(steps, curve.exact, line, color=color, linewidth=1.0)
    if curve.compiled is not None:
        axes.plot(steps, np.where(curve.compiled > 0.0, curve.compiled, np.nan), mark, color=color, markersize=3)


experiment("figure-7", "Harmonic oscillator: error of q over one step of size h")(partial(refinement, "q"))
experiment("figure-8", "Harmonic oscillator: error of the energy over one step of size h")(
    partial(refinement, "energy")
)
