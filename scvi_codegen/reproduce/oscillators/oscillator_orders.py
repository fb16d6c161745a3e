"""Figures 7-8: the harmonic oscillator over one step of many sizes; the orders of SVI and SC."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import lru_cache, partial
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.exact.step import derived_step
from scvi_codegen.methods import SpectralCollocation
from scvi_codegen.methods.method import Method
from scvi_codegen.reproduce.laboratory.drawing import COLORS, draw_powers, panels
from scvi_codegen.reproduce.laboratory.experiment import (
    Cell,
    Comparison,
    Experiment,
    Picture,
    Result,
    TableBlock,
    Verdict,
)
from scvi_codegen.reproduce.laboratory.running import ROUNDOFF, stepper_of
from scvi_codegen.reproduce.oscillators.one_degree import judged, svi_with_points
from scvi_codegen.reproduce.oscillators.oscillator import OSCILLATOR, POSITION, SYSTEM, VELOCITY
from scvi_codegen.tables.precision import Number, mp

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["EXPERIMENTS", "fitted_power"]

Array = NDArray[np.float64]

TITLES = {
    "figure-7": "Harmonic oscillator: error of q over one step of size h",
    "figure-8": "Harmonic oscillator: error of the energy over one step of size h",
}
DEGREES = (2, 4, 6)
FEWER, EQUAL, MORE = "SVI, N-1 Gauss points", "SVI, N Gauss points", "SVI, N+1 Gauss points"
SC = "SC"
STEPS = tuple(10.0 ** (0.15 * k - 3.0) for k in range(27))
FITTED = tuple(2.0**exponent for exponent in range(-8, -3))
"""Steps small enough for a straight line; in 60 digits no error there is near round-off."""
NO_ERROR = 1e-50
PRINTED = {"q": {3: 1.5, 5: 1e-2, 7: 1e-5, 9: 1e-5, 13: 1e-10}, "energy": {2: 1.0, 4: 1e-2, 6: 1e-5, 8: 1e-5, 11: 1e-9}}
"""The lines of the paper's legends: the constant of each power of h."""
SETTING = (
    SYSTEM,
    "One step of size h, errors at its end; N is the degree, so there are N + 1 Chebyshev points.",
    "The caption gives no quadrature: SVI has N Gauss points, and N - 1 and N + 1 beside.",
    "Dotted lines are those of the paper's legend.",
    "Marks are the compiled code, iterated to relative round-off: at h = 8 SC does not reach an absolute 1e-14.",
    "Lines, and the fitted powers, are the same equations solved in 60 digits: the orders show without round-off.",
    f"Powers are fitted to steps from {FITTED[0]:g} to {FITTED[-1]:g}.",
)


def _method(scheme: str, degree: int) -> Method:
    points = {FEWER: degree - 1, EQUAL: degree, MORE: degree + 1}
    return svi_with_points(degree, points[scheme]) if scheme in points else SpectralCollocation(degree)


def _errors(q: Number, p: Number, h: float) -> dict[str, float]:
    """Absolute errors at the end of a step, formed in 60 digits."""
    q, p, h = mp.mpf(q), mp.mpf(p), mp.mpf(h)
    return {"q": abs(q - mp.sin(h)), "energy": abs(q * q + p * p - 1) / 2}


@lru_cache
def _exact_errors(scheme: str, degree: int, steps: tuple[float, ...] = STEPS) -> dict[str, Array]:
    """By quantity, what the method itself errs in a step."""
    step = derived_step(OSCILLATOR, _method(scheme, degree))
    ends = [(step(POSITION, VELOCITY, h), h) for h in steps]
    return _collected([_errors(end.q[0], end.p[0], h) for end, h in ends])


@lru_cache
def _compiled_errors(scheme: str, degree: int) -> dict[str, Array]:
    """By quantity, what the compiled code errs in a step."""
    stepper = stepper_of(OSCILLATOR, _method(scheme, degree))
    ends = [(*stepper.step(POSITION, VELOCITY, h=h, options=ROUNDOFF), h) for h in STEPS]
    return _collected([_errors(q[0], p[0], h) for q, p, h in ends])


def _collected(errors: Sequence[Mapping[str, float]]) -> dict[str, Array]:
    return {what: np.array([float(error[what]) for error in errors]) for what in ("q", "energy")}


def fitted_power(what: str, scheme: str, degree: int) -> tuple[float, float] | None:
    """(C, p) of the line C h^p through the errors of small steps; ``None`` where the method makes none."""
    errors = _exact_errors(scheme, degree, FITTED)[what]
    if errors.max() < NO_ERROR:
        return None
    power, intercept = np.polyfit(np.log(FITTED), np.log(errors), 1)
    return float(np.exp(intercept)), float(power)


def _powers(what: str) -> dict[tuple[str, int], tuple[float, float] | None]:
    schemes = (FEWER, EQUAL, MORE, SC)
    return {(scheme, degree): fitted_power(what, scheme, degree) for scheme in schemes for degree in DEGREES}


def _of_configuration(_: Mapping[str, Result]) -> Result:
    return _result("figure-7", "q", (EQUAL,), (_printed_powers("q"), _ahead("q", EQUAL)))


def _of_energy(_: Mapping[str, Result]) -> Result:
    return _result("figure-8", "energy", (MORE, EQUAL, FEWER), (_printed_powers("energy"), _ahead("energy", MORE)))


def _result(name: str, what: str, shown: tuple[str, ...], checks: tuple[Comparison, ...]) -> Result:
    exact = {(scheme, degree): _exact_errors(scheme, degree)[what] for scheme in (*shown, SC) for degree in DEGREES}
    compiled = {key: _compiled_errors(*key)[what] for key in exact if key[0] != FEWER}
    rows: list[tuple[Cell, ...]] = []
    for (scheme, degree), fit in _powers(what).items():
        rows.append((scheme, degree, *(fit[::-1] if fit else (None, None))))
    columns = {f"{scheme}, N = {degree}": values for (scheme, degree), values in exact.items()}
    columns |= {f"{scheme}, N = {degree}, compiled": values for (scheme, degree), values in compiled.items()}
    return Result(
        name=name,
        title=TITLES[name],
        setting=SETTING,
        checks=checks,
        tables=(
            TableBlock(
                columns=("scheme", "N", "fitted power of h", "constant"),
                rows=tuple(rows),
                formats={"fitted power of h": ".2f", "constant": ".1e"},
            ),
            TableBlock(
                name="errors",
                columns=("h", *columns),
                rows=tuple(zip(STEPS, *(values.tolist() for values in columns.values()), strict=True)),
                shown=False,
            ),
        ),
        picture=Picture(
            draw=partial(_draw, what, shown, exact, compiled), width=6.0 if len(shown) == 1 else 11.0, height=4.8
        ),
    )


def _printed_powers(what: str) -> Comparison:
    """Whether each power of the legend is that of some curve, the quadrature being N Gauss points, or N + 1."""
    fits = {key: fit[1] for key, fit in _powers(what).items() if fit}
    schemes = {
        scheme: ", ".join(f"{fits[scheme, n]:.1f}" for n in DEGREES if (scheme, n) in fits) or "no error at all"
        for scheme in (SC, FEWER, EQUAL, MORE)
    }
    found = {round(power) for (scheme, _), power in fits.items() if scheme != FEWER}
    with_fewer = {round(power) for (scheme, _), power in fits.items() if scheme == FEWER}
    missing = [power for power in PRINTED[what] if power not in found]
    verdict = judged(*(power in found for power in PRINTED[what]))
    outcome = "Every printed power is found with N Gauss points"
    if missing:
        outcome = f"Not found with N or N + 1 Gauss points: {_powers_of_h(missing)}"
        outcome += f" (with N - 1: {_powers_of_h(sorted(with_fewer.intersection(missing))) or 'neither'})"
    return Comparison(
        claim=f"The errors of N = 2, 4, 6 follow the lines {_powers_of_h(PRINTED[what])} of the legend.",
        measured=f"Fitted powers: {'; '.join(f'{scheme}: {powers}' for scheme, powers in schemes.items())}. {outcome}.",
        verdict=verdict,
    )


def _powers_of_h(powers: Iterable[int]) -> str:
    return ", ".join(f"h^{power}" for power in powers)


def _ahead(what: str, scheme: str) -> Comparison:
    """SVI against SC at every degree and step, as the methods are, without round-off."""
    pairs = [(_exact_errors(scheme, n)[what], _exact_errors(SC, n)[what]) for n in DEGREES]
    wins = sum(int(np.count_nonzero(svi < sc)) for svi, sc in pairs)
    lost = sorted({f"{STEPS[k]:.3g}" for svi, sc in pairs for k in np.flatnonzero(svi >= sc)}, key=float)
    cases = len(STEPS) * len(DEGREES)
    return Comparison(
        claim=f"SVI is more accurate than SC in {what} with the same number of points and the same step.",
        measured=f"{scheme}, is more accurate in {wins} of {cases} pairs of N and h, from h = {STEPS[0]:g} "
        f"to {STEPS[-1]:.2g}" + (f"; not at h = {', '.join(lost)}." if lost else "."),
        verdict=Verdict.HOLDS if wins == cases else Verdict.PARTLY if wins else Verdict.FAILS,
        bears_on=("accuracy",),
    )


def _draw(
    what: str,
    shown: Sequence[str],
    exact: Mapping[tuple[str, int], Array],
    compiled: Mapping[tuple[str, int], Array],
    figure: Figure,
) -> None:
    for axes, scheme in zip(panels(figure, 1, len(shown)), shown, strict=True):
        draw_powers(axes, (1e-3, 0.5), [(constant, power) for power, constant in PRINTED[what].items()])
        for one in (scheme, SC):
            for degree, mark, style in zip(DEGREES, "osD", ("-", "--", "-."), strict=True):
                label = f"{one[:3].rstrip(',')}, N = {degree}"
                _draw_curve(axes, exact[one, degree], compiled.get((one, degree)), mark, style, label)
        axes.set(xscale="log", yscale="log", xlabel="h", ylim=(1e-20, 1e2), title=scheme)
        axes.plot([], [], ":", color=COLORS["exact"], linewidth=0.8, label="legend of the paper")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    figure.axes[0].set_ylabel(f"error of {what} after one step")


def _draw_curve(axes: Axes, exact: Array, compiled: Array | None, mark: str, style: str, label: str) -> None:
    color = COLORS[label.partition(",")[0]]
    axes.plot(
        [], [], style if compiled is None else mark + style, color=color, markersize=3, linewidth=1.0, label=label
    )
    if exact.max() > NO_ERROR:
        axes.plot(STEPS, exact, style, color=color, linewidth=1.0)
    if compiled is not None:
        axes.plot(STEPS, np.where(compiled > 0.0, compiled, np.nan), mark, color=color, markersize=3)


RUNS: dict[str, Callable[[Mapping[str, Result]], Result]] = {"figure-7": _of_configuration, "figure-8": _of_energy}
EXPERIMENTS = tuple(Experiment(name=name, title=TITLES[name], run=run) for name, run in RUNS.items())
