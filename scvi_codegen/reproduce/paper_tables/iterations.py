"""Tables 8 and 9: iterations that SC and SVI need on Kepler's problem, beside the printed numbers."""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from scvi_codegen.errors import StepFailedError
from scvi_codegen.methods.collocation import SpectralCollocation
from scvi_codegen.methods.galerkin import SVI
from scvi_codegen.methods.method import Method
from scvi_codegen.models.systems import kepler
from scvi_codegen.reproduce.laboratory.drawing import panels
from scvi_codegen.reproduce.laboratory.experiment import (
    Comparison,
    Experiment,
    Picture,
    Result,
    TableBlock,
    Verdict,
    holds,
)
from scvi_codegen.reproduce.laboratory.full_newton import newton_counts
from scvi_codegen.reproduce.laboratory.running import SECTION_3, steps_in, trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import LogNorm
    from matplotlib.figure import Figure

__all__ = ["EXPERIMENTS"]

KEPLER = kepler()
SPAN = 100.0
DEGREES = (2, 5, 10, 15, 20)
SCHEMES: Mapping[str, Callable[[int], Method]] = {"SC": SpectralCollocation, "SVI": SVI}
SOLVERS = ("fixed-point", "newton")
LARGE = 2.0
"""From here on a step counts as large."""

EXAMPLE = (0.5, 5, "SVI")
"""The setting that is also solved by Newton's method in full."""

ECCENTRICITY: Mapping[int, float] = {8: 0.2, 9: 0.5}
PRINTED: Mapping[int, Mapping[float, str]] = {
    8: {
        0.5: "-       10/1520  8/1271  7/1168  7/1176  7/1176   7/1181   7/1181   7/1186   7/1185",
        1.0: "-       -        11/870  9/735   9/709   8/695    8/696    8/695    8/697    8/697",
        2.0: "-       -        37/739  11/485  11/476  10/416   10/451   10/414   10/425   10/417",
        5.0: "-       -        -       -       -       15/279   18/311   14/240   14/261   17/239",
        8.0: "-       -        -       -       -       -        -        23/225   135/536  29/215",
    },
    9: {
        0.5: "-       -        13/1511 10/1303 9/1277  9/1270   9/1271   9/1271   9/1274   9/1274",
        1.0: "-       -        -       14/834  13/815  11/764   11/771   11/760   11/765   11/762",
        2.0: "-       -        -       19/674  -       14/504   17/535   13/481   14/504   18/492",
        5.0: "-       -        -       -       -       15/279   -        65/433   -        114/607",
    },
}
"""By table and h: max/total for N = 2, 5, 10, 15, 20, SC and SVI each; a dash where the paper has none."""


@dataclass(frozen=True, slots=True)
class Count:
    """Iterations of a run: most of a step, all, and its largest relative energy error; or why it ended early."""

    largest: int | None
    total: int | None
    failure: str = ""
    energy: float = math.nan

    @property
    def converged(self) -> bool:
        """Whether every step did."""
        return self.total is not None

    @property
    def sound(self) -> bool:
        """Whether besides the energy is not wrong by more than itself, as when the body escapes."""
        return self.converged and self.energy < 1.0


Setting: TypeAlias = tuple[float, int, str]
"""Step size, degree, scheme."""

Counts: TypeAlias = Mapping[Setting, Count]
NONE = Count(None, None)


def printed_counts(number: int) -> Counts:
    """The paper's table."""
    columns = [(degree, scheme) for degree in DEGREES for scheme in SCHEMES]
    return {
        (h, degree, scheme): _parsed(cell)
        for h, text in PRINTED[number].items()
        for (degree, scheme), cell in zip(columns, text.split(), strict=True)
    }


def _parsed(cell: str) -> Count:
    if cell == "-":
        return NONE
    largest, total = map(int, cell.split("/"))
    return Count(largest, total)


@lru_cache(maxsize=4)
def counts(number: int, solver: str) -> Counts:
    """Of our solver at the settings of a table."""
    return {setting: _count(ECCENTRICITY[number], *setting, solver) for setting in printed_counts(number)}


def _start(e: float) -> tuple[tuple[float, float], tuple[float, float]]:
    return (1.0 - e, 0.0), (0.0, math.sqrt((1.0 + e) / (1.0 - e)))


def _count(e: float, h: float, degree: int, scheme: str, solver: str) -> Count:
    try:
        run = trajectory(KEPLER, SCHEMES[scheme](degree), *_start(e), h=h, span=SPAN, solver=solver)
    except StepFailedError as error:
        return Count(None, None, f"step {error.step}: {error.status}")
    largest = int(run.iterations.max())
    if largest > SECTION_3.max_iterations:
        step = int(run.iterations.argmax()) - 1
        return Count(None, None, f"step {step}: {largest} iterations")
    energy = float(np.abs(run.energy() / run.energy()[0] - 1.0).max())
    return Count(largest, int(run.iterations.sum()), energy=energy)


def table_8(results: Mapping[str, Result]) -> Result:
    """Eccentricity 0.2."""
    return _result(8)


def table_9(results: Mapping[str, Result]) -> Result:
    """Eccentricity 0.5."""
    return _result(9)


def _result(number: int) -> Result:
    e, printed = ECCENTRICITY[number], printed_counts(number)
    found = {solver: counts(number, solver) for solver in SOLVERS}
    return Result(
        name=f"table-{number}",
        title=f"Kepler problem, number of iterations with eccentricity e = {e}",
        setting=(
            f"Kepler's problem, e = {e}, T = {SPAN:g}, from perihelion; N is the degree; SVI has N Gauss points, which "
            "the paper leaves open.",
            "The paper's rule: an iteration ends when max(|dQ|, |dP|) < 1e-14, and fails after 1000 iterations.",
            "The paper states neither its iteration nor its first guess; these are the two solvers of this project, "
            "which continue the curve of the step before and count a second attempt from the straight line.",
            "The text of the paper has fewer entries than columns for h = 5 and h = 8; they are set flush right, where "
            "alone convergence improves with N.",
        ),
        checks=(
            *(check for solver in SOLVERS for check in _solver_checks(solver, found[solver])),
            _printed_check(number, printed, found),
        ),
        tables=(_table(printed, found),),
        picture=Picture(draw=partial(draw_counts, {"as printed": printed} | found), width=9.0, height=7.2),
    )


def _table(printed: Counts, found: Mapping[str, Counts]) -> TableBlock:
    headings = [f"{solver} {what}" for solver in SOLVERS for what in ("max", "total", "energy error", "failure")]
    numbers = ["N", "paper max", "paper total", *(heading for heading in headings if "failure" not in heading)]
    return TableBlock(
        columns=("h", "N", "scheme", "paper max", "paper total", *headings),
        rows=tuple(
            (
                *setting,
                count.largest,
                count.total,
                *(cell for solver in SOLVERS for cell in _cells(found[solver][setting])),
            )
            for setting, count in printed.items()
        ),
        formats={"h": "g"} | {heading: ".1e" if "energy" in heading else "d" for heading in numbers},
    )


def _cells(count: Count) -> tuple[float | int | str | None, ...]:
    energy = None if math.isnan(count.energy) else count.energy
    return count.largest, count.total, energy, count.failure or None


def _pairs(found: Counts) -> Iterator[tuple[float, Count, Count]]:
    """(h, SC, SVI) for every h and N."""
    for (h, degree, scheme), count in found.items():
        if scheme == "SC":
            yield h, count, found[h, degree, "SVI"]


def _solver_checks(solver: str, found: Counts) -> Iterator[Comparison]:
    totals = [(sc.total, svi.total) for _, sc, svi in _pairs(found) if sc.sound and svi.sound]
    ratios = [svi / sc for sc, svi in totals if sc and svi]
    fewer, equal = sum(ratio < 1.0 for ratio in ratios), sum(ratio == 1.0 for ratio in ratios)
    yield Comparison(
        claim="SVI converges faster than SC.",
        measured=f"Solver '{solver}': of {len(ratios)} settings where both stay bound, SVI needs fewer "
        f"iterations in {fewer} and as many in {equal}; its number is {statistics.median(ratios):.2f} of that of SC "
        "(median).",
        verdict=_share(fewer / len(ratios)),
        bears_on=("svi-iterations",),
    )
    converged = [(sc.converged, svi.converged) for _, sc, svi in _pairs(found)]
    by_sc, by_svi = (sum(column) for column in zip(*converged, strict=True))
    alone = sum(sc and not svi for sc, svi in converged)
    sc, svi = _sound(found, 0.0)
    sc_large, svi_large = _sound(found, LARGE)
    yield Comparison(
        claim="SVI is more stable than SC, especially with large time-steps.",
        measured=f"Solver '{solver}': of {len(converged)} settings SVI converges at {by_svi} and SC at {by_sc}, at "
        f"{alone} of them alone. The motion stays bound (energy error below 100 %) at {svi} with SVI and {sc} with "
        f"SC, with h >= {LARGE:g} at {svi_large} and {sc_large}.",
        verdict=Verdict.PARTLY if by_svi > by_sc and alone else holds(by_svi > by_sc),
        bears_on=("svi-iterations", "stability"),
    )


def _share(part: float) -> Verdict:
    """Faster at nine settings of ten holds, at half of them or fewer it does not."""
    return holds(part >= 0.9) if part >= 0.9 or part <= 0.5 else Verdict.PARTLY


def _sound(found: Counts, least: float) -> tuple[int, int]:
    """Settings with h >= least at which SC, and at which SVI stays bound."""
    pairs = [(sc.sound, svi.sound) for h, sc, svi in _pairs(found) if h >= least]
    return sum(sc for sc, _ in pairs), sum(svi for _, svi in pairs)


def _printed_check(number: int, printed: Counts, found: Mapping[str, Counts]) -> Comparison:
    h, degree, _ = EXAMPLE
    ours = "; ".join(f"{_text(found[solver][EXAMPLE])} by '{solver}'" for solver in SOLVERS)
    full = newton_counts(KEPLER, SVI(degree), *_start(ECCENTRICITY[number]), h=h, steps=steps_in(SPAN, h))
    return Comparison(
        claim=f"SVI with N = {degree} and h = {h} needs {_text(printed[EXAMPLE])} iterations (largest/all).",
        measured=f"{ours}; Newton's method in full, each step from the straight line, until |dQ| < 1e-14: "
        f"{max(full)}/{sum(full)}.",
        verdict=Verdict.SHOWN,
    )


def _text(count: Count) -> str:
    return f"{count.largest}/{count.total}" if count.converged else "-"


NOTES = dict.fromkeys(SOLVERS, "; in brackets: converged, energy error above 100 %")


CENTRED: Mapping[str, Any] = {"ha": "center", "va": "center", "fontsize": 7}


def draw_counts(tables: Mapping[str, Counts], figure: Figure) -> None:
    """The tables one below the other: colour is iterations a step, grey is failure."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LogNorm

    norm, where = LogNorm(3.0, 100.0), panels(figure, len(tables), 1)
    for axes, (title, found) in zip(where, tables.items(), strict=True):
        _draw_tiles(axes, found, norm)
        axes.set_title(f"{title}: largest number of iterations in a step / all" + NOTES.get(title, ""))
    figure.colorbar(ScalarMappable(norm, "YlOrRd"), ax=where, label="iterations a step", shrink=0.6)


def _draw_tiles(axes: Axes, found: Counts, norm: LogNorm) -> None:
    from matplotlib import colormaps

    steps = list(dict.fromkeys(h for h, _, _ in found))
    columns = list(dict.fromkeys((degree, scheme) for _, degree, scheme in found))
    colors = np.full((len(steps), len(columns), 4), (0.93, 0.93, 0.93, 1.0))
    for (h, degree, scheme), count in found.items():
        y, x, shade = steps.index(h), columns.index((degree, scheme)), 0.0
        if count.total is not None:
            shade = norm(count.total / steps_in(SPAN, h))
            colors[y, x] = colormaps["YlOrRd"](shade)
        lost = count.converged and count.energy >= 1.0
        axes.annotate(
            f"({_text(count)})" if lost else _text(count),
            (x, y),
            color="#fefefe" if shade > 0.65 else "#111111",
            **CENTRED,
        )
    axes.imshow(colors, aspect="auto")
    axes.set_xticks(range(len(columns)), [f"{scheme}\nN = {degree}" for degree, scheme in columns], fontsize=7)
    axes.set_yticks(range(len(steps)), [f"h = {h:g}" for h in steps])
    axes.tick_params(length=0)
    axes.grid(False)


EXPERIMENTS: tuple[Experiment, ...] = (
    Experiment(name="table-8", title="Number of iterations, Kepler problem, e = 0.2", run=table_8),
    Experiment(name="table-9", title="Number of iterations, Kepler problem, e = 0.5", run=table_9),
)
