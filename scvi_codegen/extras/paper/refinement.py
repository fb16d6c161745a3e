"""Errors of one step of SVI and SC over the number of points (figures 6, 16, 17) and over the step size (7, 8, 18-20).

The captions state neither the eccentricity nor, unambiguously, what "N" counts: the number of points, as they say, or
the degree, as in other figures. Verdicts are based on the cases that are judged; the others show how the result depends
on what a caption leaves open. The studies are those of ``refinement.toml``.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scvi_codegen.api.formulas import Number, mp
from scvi_codegen.api.methods import Method
from scvi_codegen.api.systems import MechanicalSystem
from scvi_codegen.api.text import TableBlock
from scvi_codegen.common.errors import StepFailedError
from scvi_codegen.extras.exact.step import derived_step
from scvi_codegen.extras.paper.experiment import (
    Array,
    Comparison,
    Experiment,
    Panel,
    Picture,
    Result,
    Series,
    comparison,
    package_table,
)
from scvi_codegen.extras.paper.runs import KEPLER, ROUNDOFF, stepper_of, system_of
from scvi_codegen.methods import SVI, SpectralCollocation

SCHEMES = ("SVI", "SC")
LEGEND = (2, 4, 6)
"""Values of N over the step size."""
ROUNDOFF_LEVEL = 1e-13
WINDOW = ROUNDOFF_LEVEL, 1e-1
"""Range of errors to which lines are fitted: smaller ones are round-off, larger ones are not resolved."""
NO_ERROR = 1e-50
"""Bound on errors in 60 digits that count as 0."""
ALONG = 30.0
"""Largest typical factor between errors and a line that counts as agreement."""
STRAIGHT = 0.9
"""Least squared correlation of N and the logarithms of errors that decrease geometrically."""
MOSTLY = 0.9
"""Least share of comparisons at which a claim holds in part."""


class InitialValue(NamedTuple):
    """System with unit masses, initial state, errors of (q, p) after h by quantity, and small steps for fits."""

    system: MechanicalSystem
    q: tuple[Number, ...]
    p: tuple[Number, ...]
    errors: Callable[[Sequence[Number], Sequence[Number], Number], Mapping[str, Number]]
    fitted: tuple[Number, ...]


@dataclass(frozen=True, slots=True, eq=False)
class StepCase:
    """InitialValue, and meaning of N.

    Attributes:
        title: description, as in sentences and above panels.
        problem: initial value problem.
        beyond: N less the degree.
        more: number of Gauss points of SVI less N.
        judged: False if the case is only shown.
    """

    title: str
    problem: InitialValue
    beyond: int = 1
    more: int = 0
    judged: bool = True

    def method(self, scheme: str, n: int) -> Method:
        """Return ``"SVI"`` or ``"SC"`` for N."""
        degree = n - self.beyond
        return SVI(degree, f"gauss-legendre:{n + self.more}") if scheme == "SVI" else SpectralCollocation(degree)


@lru_cache(maxsize=8192)
def step_errors(case: StepCase, scheme: str, n: int, h: Number, precise: bool = False) -> Mapping[str, float]:
    """Return the errors of the compiled step, NaN if it has no solution, or of the step in 60 digits."""
    problem, method = case.problem, case.method(scheme, n)
    if precise:
        end = _derived(problem.system, method)(problem.q, problem.p, h)
        q, p = end.q, end.p
    else:
        stepper = stepper_of(problem.system, method, "newton")
        start = [float(x) for x in problem.q], [float(x) for x in problem.p]
        try:
            ends = stepper.step(start[0], start[1], float(h), options=ROUNDOFF)
        except StepFailedError:
            return dict.fromkeys(problem.errors(problem.q, problem.p, mp.mpf(h)), math.nan)
        q, p = (tuple(map(mp.mpf, x)) for x in ends)
    return {name: float(error) for name, error in problem.errors(q, p, mp.mpf(h)).items()}


_derived = lru_cache(maxsize=64)(derived_step)


class Law(NamedTuple):
    """Line constant base^N, or constant h^base."""

    constant: float
    base: float


class ErrorCurve(NamedTuple):
    """Errors of one scheme over N, or of one scheme and N over h.

    Attributes:
        case, what, scheme, n: problem, quantity, scheme, and N, which curves over N have not.
        x, errors: N or h, and errors.
        law: fitted line, ``None`` if there is no error but round-off.
    """

    case: StepCase
    what: str
    scheme: str
    n: int | None
    x: Array
    errors: Array
    law: Law | None


COLUMNS = ("setting", "scheme", "N", "error of", "constant", "base or power", "paper's constant", "paper's base")


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """Errors over N or over h.

    Attributes:
        sentences: setting of the result.
        cases: problems and meanings of N.
        quantities: names of the errors.
        steps: step sizes; over N a single one.
        degrees: over N, degrees by scheme.
        lines: over N, the paper's lines by scheme and quantity.
        powers: over h, constants of the paper's lines by quantity and power of h.
        resolved: largest error of SC that is compared with that of SVI.
    """

    sentences: tuple[str, ...]
    cases: tuple[StepCase, ...]
    quantities: tuple[str, ...]
    steps: tuple[float, ...]
    degrees: Mapping[str, Sequence[int]] = field(default_factory=dict)
    lines: Mapping[tuple[str, str], Law] = field(default_factory=dict)
    powers: Mapping[str, Mapping[int, float]] = field(default_factory=dict)
    resolved: float = math.inf

    @property
    def judged(self) -> tuple[StepCase, ...]:
        """Cases on which verdicts are based."""
        return tuple(case for case in self.cases if case.judged)

    def curves(self) -> list[ErrorCurve]:
        """Return all curves, those of SVI and SC in turn."""
        numbers = (None,) if self.degrees else LEGEND
        return [
            self._curve(case, quantity, scheme, n)
            for quantity, case, n, scheme in product(self.quantities, self.cases, numbers, SCHEMES)
        ]

    def _curve(self, case: StepCase, quantity: str, scheme: str, n: int | None) -> ErrorCurve:
        counts = [n] if n else [degree + case.beyond for degree in self.degrees[scheme]]
        errors = np.array([step_errors(case, scheme, k, h)[quantity] for k in counts for h in self.steps])
        x = np.array(self.steps if n else counts, dtype=float)
        law = fitted_power(case, scheme, n, quantity) if n else fitted_line(x, errors)
        return ErrorCurve(case, quantity, scheme, n, x, errors, law)

    def printed(self, curve: ErrorCurve) -> Law | None:
        """Return the paper's line of a curve; over h that of the same power."""
        if not curve.n:
            return self.lines.get((curve.scheme, curve.what))
        power = round(curve.law.base) if curve.law else 0
        constant = self.powers.get(curve.what, {}).get(power)
        return Law(constant, power) if constant else None


def within(errors: Array) -> NDArray[np.bool_]:
    """Return a mask of the errors that count: above round-off and resolved."""
    return (errors > WINDOW[0]) & (errors < WINDOW[1])


def fitted_line(n: Array, errors: Array) -> Law | None:
    """Return the line through the errors that count; ``None`` with fewer than three of them."""
    used = within(errors)
    if np.count_nonzero(used) < 3:
        return None
    rate, offset = np.polyfit(n[used], np.log(errors[used]), 1)
    return Law(float(np.exp(offset)), float(np.exp(rate)))


@lru_cache(maxsize=512)
def fitted_power(case: StepCase, scheme: str, n: int, quantity: str) -> Law | None:
    """Return the line through the errors of small steps in 60 digits; ``None`` if there is no error."""
    steps = case.problem.fitted
    errors = np.array([step_errors(case, scheme, n, h, precise=True)[quantity] for h in steps])
    if errors.max() < NO_ERROR:
        return None
    power, offset = np.polyfit(np.log([float(h) for h in steps]), np.log(errors), 1)
    return Law(float(np.exp(offset)), float(power))


def is_straight(n: Array, errors: Array) -> bool:
    """Return True if the errors that count decrease, along a line."""
    used = within(errors)
    correlation = np.corrcoef(n[used], np.log(errors[used]))[0, 1]
    return bool(correlation < 0 and correlation**2 > STRAIGHT)


def factors(n: Array, errors: Array, line: Law) -> Array:
    """Return the factor, at least 1, between each error that counts and a line."""
    used = within(errors)
    return np.asarray(np.exp(np.abs(np.log(errors[used]) - np.log(line.constant) - n[used] * np.log(line.base))))


def refinement(name: str, title: str, study: Study) -> Experiment:
    """Return the experiment of a figure of errors over N or over h."""

    def run(_: Mapping[str, Result]) -> Result:
        curves = study.curves()
        checks = _point_checks(study, curves) if study.degrees else _step_checks(study, curves)
        picture = Picture(panels=tuple(_panels(study, curves)), columns=len(study.cases), size=(4.5, 4.0))
        none, rows = (None, None), list[tuple[Any, ...]]()
        for c in curves:
            rows.append((c.case.title, c.scheme, c.n, c.what, *(c.law or none), *(study.printed(c) or none)))
        table = TableBlock(columns=COLUMNS, rows=tuple(rows), formats=dict.fromkeys(COLUMNS[4:], ".2g"))
        return Result(
            setting=study.sentences,
            checks=(*checks, _superiority(study, curves)),
            tables=(table, picture.curves()),
            picture=picture,
        )

    return Experiment(name=name, title=title, run=run)


def _superiority(study: Study, curves: Sequence[ErrorCurve]) -> Comparison:
    """Return the check of conclusion (ii) where the error of SC is resolved and above round-off."""
    lost, count = [], 0
    for svi, sc in zip(curves[::2], curves[1::2], strict=True):
        by_sc, name = dict(zip(sc.x.tolist(), sc.errors.tolist(), strict=True)), "h" if svi.n else "N"
        for x, error in zip(svi.x.tolist(), svi.errors.tolist(), strict=True):
            if not svi.case.judged or not math.isfinite(error):
                continue
            if ROUNDOFF_LEVEL < by_sc.get(x, 0.0) < study.resolved:
                count += 1
                if error >= by_sc[x]:
                    lost.append(f"{svi.what}, {svi.case.title}, {name} = {x:.2g}")
    return comparison(
        "SVI is more accurate than SC with the same number of points and the same step.",
        f"The error of SVI is the smaller one in {count - len(lost)} of {count} comparisons; not: "
        f"{'; '.join(lost[:8]) or 'none'}.",
        not lost,
        len(lost) <= (1 - MOSTLY) * count,
        bears_on="accuracy",
    )


def _point_checks(study: Study, curves: Sequence[ErrorCurve]) -> Iterator[Comparison]:
    """Yield the checks over N: straight lines, their bases, and their constants."""
    straight = [is_straight(c.x, c.errors) for c in curves if c.law and c.case.judged]
    yield comparison(
        "Under N-refinement the errors fall geometrically.",
        f"{sum(straight)} of {len(straight)} curves above round-off are straight: N and the logarithm of the error "
        f"correlate with r^2 above {STRAIGHT:g}.",
        *straight,
        bears_on="geometric",
    )
    pairs = [(c, line) for c in curves if (line := study.printed(c))]
    off = {
        case: float(np.median(np.concatenate([factors(c.x, c.errors, line) for c, line in pairs if c.case is case])))
        for case in study.cases
    }
    bases = [f"{c.law.base:.2g} for {line.base:g} ({c.scheme} {c.what}, {c.case.title})" for c, line in pairs if c.law]
    yield comparison(
        "The lines c b^N run along the errors.",
        "The typical factor between an error and its line is "
        + ", ".join(f"{factor:.2g} ({case.title})" for case, factor in off.items())
        + f". Below {ALONG:g} counts as along. Fitted bases: {', '.join(bases)}.",
        *(off[case] < ALONG for case in study.judged),
    )


def _step_checks(study: Study, curves: Sequence[ErrorCurve]) -> Iterator[Comparison]:
    """Yield the checks over h: powers and constants of the legend, or that SVI falls faster if there is none."""
    for quantity in study.quantities:
        mine, printed = [c for c in curves if c.what == quantity], study.powers.get(quantity)
        measured = ", ".join(
            f"{f'{c.law.base:.1f}' if c.law else 'none'} ({c.scheme}, N = {c.n}, {c.case.title})" for c in mine
        )
        if printed is None:
            pairs = zip(mine[::2], mine[1::2], strict=True)
            faster = [not svi.law or bool(sc.law and svi.law.base > sc.law.base) for svi, sc in pairs]
            claim = f"The error of the {quantity} falls faster with h for SVI than for SC."
            yield comparison(claim, f"Powers: {measured}.", all(faster), bears_on="accuracy")
            continue
        laws = [c.law for c in mine if c.case.judged and c.law]
        missing = [power for power in printed if power not in {round(law.base) for law in laws}]
        yield comparison(
            f"The errors of {quantity} follow the lines {', '.join(f'h^{power}' for power in printed)}.",
            f"Powers: {measured}. Missing: {', '.join(f'h^{power}' for power in missing) or 'none'}.",
            *(power not in missing for power in printed),
        )
        parts = [law.constant / printed[round(law.base)] for law in laws if round(law.base) in printed]
        off = [max(part, 1 / part) for part in parts]
        yield comparison(
            f"The lines run along the errors of {quantity}.",
            f"The constants of {len(off)} curves whose power is printed are off by factors of {min(off):.1f} to "
            f"{max(off):.1f} with {study.judged[0].title}. Below {ALONG:g} counts as along.",
            max(off) < ALONG,
        )


def _panels(study: Study, curves: Sequence[ErrorCurve]) -> Iterator[Panel]:
    """Yield a panel for each quantity and case; the paper's lines are dotted."""
    looks = dict(zip((None, *LEGEND), (("o", "-"), ("o", "-"), ("s", "--"), ("D", "-.")), strict=True))
    for quantity, case in product(study.quantities, study.cases):
        series = []
        for c in (c for c in curves if c.what == quantity and c.case is case):
            marker, line = looks[c.n]
            label = f"{c.scheme}, N = {c.n}" if c.n else c.scheme
            series.append(Series(x=c.x, y=c.errors, scheme=c.scheme, label=label, marker=marker, line=line))
            if not c.n and (law := study.printed(c)):
                label, y = f"paper: {law.constant:.0e} {law.base:g}$^N$", law.constant * law.base**c.x
                series.append(Series(x=c.x, y=y, scheme=c.scheme, label=label, line=":"))
        for power, constant in study.powers.get(quantity, {}).items() if case.judged else ():
            y = constant * np.array(study.steps) ** power
            series.append(Series(x=study.steps, y=y, scheme="exact", end=f"$h^{{{power}}}$", line=":"))
        yield Panel(
            title=f"{quantity}, {case.title}",
            series=tuple(series),
            xlabel="Chebyshev points N" if study.degrees else "step h",
            ylabel="error",
            log="y" if study.degrees else "xy",
            floor=1e-15,
        )


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
CASES = {
    case.title: case
    for case in (
        StepCase("N points", OSCILLATOR),
        StepCase("N the degree", OSCILLATOR, 0, judged=False),
        StepCase("N the degree, N + 1 Gauss points", OSCILLATOR, 0, 1, judged=False),
        *(StepCase(f"e = {e:g}", _kepler(e), 1, -1) for e in (0.0, 0.2, 0.5)),
        StepCase("circle, N points", _kepler(0.0), 1, -1),
        StepCase("e = 0.5, N the degree", _kepler(0.5), 0, judged=False),
    )
}
STEPS = {
    "oscillator-over-h": tuple(10.0 ** (0.3 * k - 3.0) for k in range(14)),
    "kepler-over-h": tuple(float(h) for h in np.geomspace(1e-3, 3.0, 36)),
}


def _study(name: str, **changes: Any) -> Study:
    """Return a study of the file, with some of its entries changed."""
    table = {"steps": STEPS.get(name), **_TABLES["studies"][name], **changes}
    lines = {(scheme, q): Law(*law) for scheme, laws in table.pop("lines", {}).items() for q, law in laws.items()}
    constants = table.pop("powers", {})
    powers = {q: {int(power): x for power, x in by_power.items()} for q, by_power in constants.items()}
    table |= {key: tuple(table[key]) for key in ("sentences", "quantities", "steps")}
    return Study(**table | {"cases": tuple(CASES[title] for title in table["cases"]), "lines": lines, "powers": powers})


def _figure(name: str, title: str, study: str, **changes: Any) -> Experiment:
    return refinement(name, title, _study(study, **changes))


_TABLES = package_table("refinement.toml")
EXPERIMENTS = tuple(_figure(name, **table) for name, table in _TABLES.items() if name != "studies")
