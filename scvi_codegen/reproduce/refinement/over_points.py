"""Errors of one long step over the number of points N: geometric decrease, and the paper's lines c b^N."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from scvi_codegen.reproduce.laboratory.drawing import Array, Panel, Series
from scvi_codegen.reproduce.laboratory.experiment import (
    Comparison,
    Result,
    TableBlock,
    judged,
)
from scvi_codegen.reproduce.laboratory.geometric import (
    AGREEMENT_FACTOR,
    STRAIGHT,
    Line,
    factors,
    fitted_line,
    is_straight,
    typical,
)
from scvi_codegen.reproduce.laboratory.running import SCHEMES
from scvi_codegen.reproduce.refinement.study import (
    ROUNDOFF,
    Setting,
    Study,
    cells_of,
    picture_of,
    step_errors,
    superiority,
)


class ErrorCurve(NamedTuple):
    """Errors over N."""

    n: Array
    errors: Array


def curve(study: Study, setting: Setting, scheme: str, quantity: str) -> ErrorCurve:
    """Return the errors of a scheme in one quantity."""
    counts = [degree + setting.reading.beyond_degree for degree in study.degrees[scheme]]
    errors = [step_errors(setting, scheme, n, study.steps[0])[quantity] for n in counts]
    return ErrorCurve(np.array(counts, dtype=float), np.array(errors))


def over_n(study: Study, _: Mapping[str, Result], **changes: Any) -> Result:
    """Return the errors of one long step over N, and the claims on them; ``changes`` are fields of the study."""
    study = replace(study, **changes)
    fits = {
        (setting, scheme, quantity): fitted_line(*curve(study, setting, scheme, quantity))
        for setting in study.settings
        for quantity in study.quantities
        for scheme in SCHEMES
    }
    return Result(
        setting=study.sentences,
        checks=(_geometric(study, fits), _bases(study, fits), _along(study), _superior_n(study)),
        tables=(_fits_table(study, fits), _errors_over_n(study)),
        picture=picture_of(list(_panels_over_n(study)), len(study.settings), len(study.quantities), 3.4),
    )


Fits: TypeAlias = Mapping[tuple[Setting, str, str], Line | None]


def _geometric(study: Study, fits: Fits) -> Comparison:
    straight = {
        setting: [is_straight(*curve(study, *key)) for key, fit in fits.items() if fit and key[0] == setting]
        for setting in study.judged
    }
    slowest = {s: max(fit[1] for key, fit in fits.items() if fit and key[0] == s) for s in study.judged}
    none = [f"{what} of {scheme} with {s.short}" for (s, scheme, what), fit in fits.items() if not fit]
    return Comparison(
        claim="Under N-refinement the errors fall geometrically.",
        measured=f"Straight (N and the logarithm of the error correlate with r^2 above {STRAIGHT:g}) are "
        + ", ".join(f"{sum(each)} of {len(each)} curves with {s.short}" for s, each in straight.items())
        + "; the slowest falls by "
        + ", by ".join(f"{base:.2g} ({s.short})" for s, base in slowest.items())
        + " a point."
        + (f" No error but round-off: {', '.join(none)}." if none else ""),
        verdict=judged(*(one for each in straight.values() for one in each)),
        bears_on=("geometric",),
    )


def _bases(study: Study, fits: Fits) -> Comparison:
    measured = {
        s: {key: (fit[1], line[1]) for key, line in study.lines.items() if (fit := fits.get((s, *key)))}
        for s in study.judged
    }
    printed = ", ".join(f"{scheme} {what} {line[1]:g}" for (scheme, what), line in study.lines.items())
    parts = [
        f"with {s.short}: " + ", ".join(f"{scheme} {what} {base:.2g}" for (scheme, what), (base, _) in pairs.items())
        for s, pairs in measured.items()
    ]
    return Comparison(
        claim=f"They fall like b^N with the bases b of the drawn lines: {printed}.",
        measured="; ".join(parts) + ". Bases that differ by less than a factor of two count as the same.",
        verdict=judged(*(all(b / 2 < base < 2 * b for base, b in pairs.values()) for pairs in measured.values())),
    )


def _along(study: Study) -> Comparison:
    """Return the check of the lines with their constants, which indicates what the caption leaves open."""
    off = {
        s: typical(factors(*curve(study, s, *key), line) for key, line in study.lines.items()) for s in study.settings
    }
    return Comparison(
        claim="The lines c b^N run along the errors.",
        measured="The typical factor between an error and its line is "
        + ", ".join(f"{factor:.2g} with {s.short}" for s, factor in off.items())
        + f". Below {AGREEMENT_FACTOR:g} counts as along.",
        verdict=judged(*(off[setting] < AGREEMENT_FACTOR for setting in study.judged)),
    )


def _superior_n(study: Study) -> Comparison:
    pairs, lost = [], []
    for setting in study.judged:
        for quantity in study.quantities:
            svi, sc = (curve(study, setting, scheme, quantity) for scheme in SCHEMES)
            common, ours, theirs = np.intersect1d(svi.n, sc.n, return_indices=True)
            one, other = svi.errors[ours], sc.errors[theirs]
            pairs.append((one, other))
            behind = (one >= other) & (other > ROUNDOFF) & (other < study.resolved)
            lost += [f"of {quantity} with {setting.short}, N = {n:g}" for n in common[behind]]
    exceptions = f"; not {', '.join(lost)}" if lost else ""
    return superiority(pairs, exceptions, roundoff=ROUNDOFF, most=study.resolved)


def _fits_table(study: Study, fits: Fits) -> TableBlock:
    none = None, None
    return TableBlock(
        columns=("setting", "scheme", "error of", "c", "b in c b^N", "paper's c", "paper's b"),
        rows=tuple(
            (s.title, scheme, what, *(fit or none), *study.lines.get((scheme, what), none))
            for (s, scheme, what), fit in fits.items()
        ),
    )


def _errors_over_n(study: Study) -> TableBlock:
    return TableBlock(
        name="errors",
        columns=("setting", "scheme", "N", *study.quantities),
        rows=tuple(
            (setting.title, scheme, *row)
            for setting in study.settings
            for scheme in SCHEMES
            for row in zip(
                (int(n) for n in curve(study, setting, scheme, study.quantities[0]).n),
                *(cells_of(curve(study, setting, scheme, quantity).errors) for quantity in study.quantities),
                strict=True,
            )
        ),
    )


def _panels_over_n(study: Study) -> Iterator[Panel]:
    for setting in study.settings:
        for quantity in study.quantities:
            series = []
            for scheme in SCHEMES:
                n, errors = curve(study, setting, scheme, quantity)
                series.append(Series(x=n, y=errors, scheme=scheme, label=scheme))
                if line := study.lines.get((scheme, quantity)):
                    label = f"paper: $10^{{{np.log10(line[0]):.0f}}}\\ {line[1]:g}^N$"
                    series.append(
                        Series(x=n, y=line[0] * line[1] ** n, scheme=scheme, label=label, marker="", line=":")
                    )
            yield Panel(title=f"{quantity}, {setting.short}", series=tuple(series), xlabel="Chebyshev points N")
