"""Tables 8 and 9: iterations of SC and SVI on Kepler's problem, and the printed numbers."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterator, Mapping
from functools import partial

from scvi_codegen.reproduce.laboratory.experiment import (
    Comparison,
    Result,
    TableBlock,
    Verdict,
    experiment,
    holds,
)
from scvi_codegen.reproduce.laboratory.running import BY_DEGREE, BY_POINTS, READINGS, SECTION_3
from scvi_codegen.reproduce.paper_tables.iteration_counts import (
    ECCENTRICITY,
    SPAN,
    Count,
    Counts,
    agreement,
    compiled_counts,
    picard_counts,
    printed_counts,
)

PICARD = "Picard, by points"
"""Iteration on which verdicts are based."""
SOLVERS = ("fixed-point", "newton")
TOLERANCES = (SECTION_3.tolerance, 1e-12, 1e-9)
AS_PRINTED = 0.9
"""Least share of cells that converge or fail as printed for a table to count as reproduced."""
LARGE = 2.0
"""Least step size that counts as large."""


def _all_counts(number: int) -> dict[str, Counts]:
    """Return the counts by iteration."""
    return {
        PICARD: picard_counts(number, BY_POINTS),
        "Picard, by degree": picard_counts(number, BY_DEGREE),
        **{solver: compiled_counts(number, solver) for solver in SOLVERS},
    }


def table(number: int, _: Mapping[str, Result]) -> Result:
    """Return Table 8 or 9."""
    e, printed, result = ECCENTRICITY[number], printed_counts(number), _all_counts(number)
    return Result(
        setting=(
            f"Kepler's problem, e = {e}, T = {SPAN:g}, from perihelion; SVI has N Gauss points, which the paper leaves "
            "open.",
            "The paper names neither its iteration, nor its first guess, nor what N counts. Plain Picard iteration on "
            "(18) and (30), in every step from Q = q0, with N points (degree N - 1), fails where the table has dashes; "
            "verdicts are on it. The reading of N as the degree is shown, too.",
            "An iteration ends when max |dQ| < 1e-14, the paper's tolerance (|dP| is not tested), and fails after "
            "1000 iterations.",
            "'fixed-point' and 'newton' are the two solvers of this project, with N points: they continue the curve of "
            "the step before and count a second attempt from the straight line.",
            "The text of the paper has fewer entries than columns for h = 5 and h = 8; they are set flush right, where "
            "alone convergence improves with N.",
        ),
        checks=(
            _dashes(number, printed),
            *(_faster(name, result[name]) for name in result if name != "Picard, by degree"),
            *(_stabler(name, result[name]) for name in result if name != "Picard, by degree"),
        ),
        tables=(_counts_table(printed, result), _tolerances(number, printed)),
    )


def _counts_table(printed: Counts, result: Mapping[str, Counts]) -> TableBlock:
    headings = [f"{name} {what}" for name in result for what in ("max", "total", "energy error", "failure")]
    numbers = ["N", "paper max", "paper total", *(heading for heading in headings if "failure" not in heading)]
    return TableBlock(
        columns=("h", "N", "scheme", "paper max", "paper total", *headings),
        rows=tuple(
            (
                *setting,
                count.largest,
                count.total,
                *(cell for counts in result.values() for cell in _cells(counts[setting])),
            )
            for setting, count in printed.items()
        ),
        formats={"h": "g"} | {heading: ".1e" if "energy" in heading else "d" for heading in numbers},
    )


def _cells(count: Count) -> tuple[float | int | str | None, ...]:
    energy = None if math.isnan(count.energy) else count.energy
    return count.largest, count.total, energy, count.failure or None


def _tolerances(number: int, printed: Counts) -> TableBlock:
    rows = []
    for reading in READINGS:
        for tolerance in TOLERANCES:
            alike = agreement(picard_counts(number, reading, tolerance), printed)
            rows.append((reading.name, tolerance, alike.alike, alike.cells, alike.ratio))
    return TableBlock(
        name="tolerances",
        columns=("N read", "tolerance", "cells as printed", "of", "iterations over printed ones, median"),
        rows=tuple(rows),
        formats={"tolerance": ".0e", "cells as printed": "d", "of": "d", "iterations over printed ones, median": ".2f"},
    )


def _dashes(number: int, printed: Counts) -> Comparison:
    """Return the check of convergence: where the iteration fails, and where the table has a dash."""
    points, degree = (agreement(picard_counts(number, reading), printed) for reading in READINGS)
    others = [(t, agreement(picard_counts(number, BY_POINTS, t), printed)) for t in TOLERANCES]
    differing = [
        f"{scheme} N = {n}, h = {h:g}"
        for (h, n, scheme), count in picard_counts(number, BY_POINTS).items()
        if count.converged != printed[h, n, scheme].converged
    ]
    return Comparison(
        claim="The iteration converges where the table has numbers, and nowhere else.",
        measured=f"Plain Picard iteration agrees in {points.alike} of {points.cells} cells with N points and in "
        f"{degree.alike} with N the degree; with N points not at {'; '.join(differing) or 'none'}. Its iterations are "
        + ", ".join(f"{one.ratio:.2f} (tolerance {tolerance:g})" for tolerance, one in others)
        + " of the printed ones (median): the paper's iteration is another, or ended earlier.",
        verdict=holds(points.alike >= AS_PRINTED * points.cells),
    )


def _pairs(result: Counts) -> Iterator[tuple[float, Count, Count]]:
    """Yield (h, SC, SVI) for every h and N."""
    for (h, n, scheme), count in result.items():
        if scheme == "SC":
            yield h, count, result[h, n, "SVI"]


def _faster(name: str, result: Counts) -> Comparison:
    totals = [(sc.total, svi.total) for _, sc, svi in _pairs(result) if sc.sound and svi.sound]
    ratios = [svi / sc for sc, svi in totals if sc and svi]
    fewer, equal = sum(ratio < 1.0 for ratio in ratios), sum(ratio == 1.0 for ratio in ratios)
    return Comparison(
        claim="SVI converges faster than SC.",
        measured=f"{name}: of {len(ratios)} settings where both stay bound, SVI needs fewer iterations in {fewer} and "
        f"as many in {equal}; its number is {statistics.median(ratios):.2f} of that of SC (median).",
        verdict=_share(fewer / len(ratios)) if name == PICARD else Verdict.SHOWN,
        bears_on=("svi-iterations",),
    )


def _stabler(name: str, result: Counts) -> Comparison:
    converged = [(sc.converged, svi.converged) for _, sc, svi in _pairs(result)]
    by_sc, by_svi = (sum(column) for column in zip(*converged, strict=True))
    alone = sum(sc and not svi for sc, svi in converged)
    (sc, svi), (sc_large, svi_large) = _sound(result, 0.0), _sound(result, LARGE)
    verdict = Verdict.PARTLY if by_svi > by_sc and alone else holds(by_svi > by_sc)
    return Comparison(
        claim="SVI is more stable than SC, especially with large time-steps.",
        measured=f"{name}: of {len(converged)} settings SVI converges at {by_svi} and SC at {by_sc}, at {alone} of "
        f"them alone. The motion stays bound (energy error below 100 %) at {svi} with SVI and {sc} with SC, with "
        f"h >= {LARGE:g} at {svi_large} and {sc_large}.",
        verdict=verdict if name == PICARD else Verdict.SHOWN,
        bears_on=("svi-iterations", "stability"),
    )


def _share(part: float) -> Verdict:
    """Return the verdict on a share: at least 0.9 holds, at most 0.5 does not."""
    return holds(part >= 0.9) if part >= 0.9 or part <= 0.5 else Verdict.PARTLY


def _sound(result: Counts, least: float) -> tuple[int, int]:
    """Return the number of settings with h >= least at which SC, and at which SVI, remains bound."""
    pairs = [(sc.sound, svi.sound) for h, sc, svi in _pairs(result) if h >= least]
    return sum(sc for sc, _ in pairs), sum(svi for _, svi in pairs)


experiment("table-8", "Number of iterations, Kepler problem, e = 0.2")(partial(table, 8))
experiment("table-9", "Number of iterations, Kepler problem, e = 0.5")(partial(table, 9))
