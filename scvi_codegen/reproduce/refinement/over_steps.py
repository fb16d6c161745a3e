"""Errors of one step over the step size h: fitted powers, and the paper's lines c h^p."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from scvi_codegen.reproduce.laboratory.drawing import Array, Panel, Series
from scvi_codegen.reproduce.laboratory.experiment import (
    Cell,
    Comparison,
    Result,
    TableBlock,
    holds,
    judged,
    series_table,
)
from scvi_codegen.reproduce.laboratory.geometric import AGREEMENT_FACTOR
from scvi_codegen.reproduce.laboratory.running import SCHEMES
from scvi_codegen.reproduce.refinement.study import (
    ROUNDOFF,
    Setting,
    Study,
    cells_of,
    picture_of,
    precise_errors,
    step_errors,
    superiority,
)

LEGEND = (2, 4, 6)
"""Values of N."""
NO_ERROR = 1e-50
"""Bound on errors in 60 digits that count as 0."""


class PowerLaw(NamedTuple):
    """Line constant h^power."""

    constant: float
    power: float


@lru_cache(maxsize=512)
def fitted_power(setting: Setting, scheme: str, n: int, quantity: str) -> PowerLaw | None:
    """Return the line through the errors of small steps in 60 digits; ``None`` if there is no error."""
    errors = np.array([float(precise_errors(setting, scheme, n, h)[quantity]) for h in setting.fitted])
    if errors.max() < NO_ERROR:
        return None
    power, intercept = np.polyfit(np.log([float(h) for h in setting.fitted]), np.log(errors), 1)
    return PowerLaw(float(np.exp(intercept)), float(power))


def _fitted(setting: Setting, quantity: str) -> dict[tuple[str, int], PowerLaw | None]:
    return {(scheme, n): fitted_power(setting, scheme, n, quantity) for scheme in SCHEMES for n in LEGEND}


def _compiled(study: Study, setting: Setting, scheme: str, n: int, quantity: str) -> Array | None:
    if study.exact and not setting.judged:
        return None
    return np.array([step_errors(setting, scheme, n, h)[quantity] for h in study.steps])


def _exact(study: Study, setting: Setting, scheme: str, n: int, quantity: str) -> Array | None:
    if not study.exact:
        return None
    return np.array([float(precise_errors(setting, scheme, n, h)[quantity]) for h in study.steps])


def over_h(study: Study, _: Mapping[str, Result], **changes: Any) -> Result:
    """Return the errors of one step over h, and the claims on them; ``changes`` are fields of the study."""
    study = replace(study, **changes)
    with_lines = [quantity for quantity in study.quantities if quantity in study.powers]
    return Result(
        setting=study.sentences,
        checks=(
            *(_powers(study, quantity) for quantity in with_lines),
            *(_constants(study, quantity) for quantity in with_lines),
            *(_faster(study, quantity) for quantity in study.quantities if quantity not in with_lines),
            _superior_h(study),
        ),
        tables=(_powers_table(study), *(_errors_over_h(study, quantity) for quantity in study.quantities)),
        picture=picture_of(list(_panels_over_h(study)), len(study.quantities), len(study.settings), 4.4),
    )


def _powers(study: Study, quantity: str) -> Comparison:
    """Return the check that the powers of the legend are those of the curves."""
    ours = {round(fit.power) for s in study.judged for fit in _fitted(s, quantity).values() if fit}
    printed = study.powers[quantity]
    missing, others = sorted(set(printed) - ours), sorted(ours - set(printed))
    outcome = "These are the printed ones"
    if missing:
        outcome = f"{_powers_of_h(missing)} is not among them, where there is {_powers_of_h(others) or 'nothing'}"
    return Comparison(
        claim=f"The errors of {quantity} with N = 2, 4, 6 follow the lines {_powers_of_h(printed)} of the legend.",
        measured=f"{_powers_text(study, quantity)}. With {study.judged[0].short}: {outcome}.",
        verdict=judged(*(power in ours for power in printed)),
    )


def _powers_of_h(powers: Sequence[int] | Mapping[int, float]) -> str:
    return ", ".join(f"h^{power}" for power in powers)


def _powers_text(study: Study, quantity: str) -> str:
    parts = []
    for setting in study.settings:
        fits = _fitted(setting, quantity)
        powers = [[f"{fit.power:.1f}" for n in LEGEND if (fit := fits[scheme, n])] for scheme in SCHEMES]
        texts = (f"{s} {', '.join(each) or 'no error at all'}" for s, each in zip(SCHEMES, powers, strict=True))
        parts.append(f"{setting.title}: fitted powers {' and '.join(texts)}")
    return "; ".join(parts)


def _constants(study: Study, quantity: str) -> Comparison:
    """Return the check of the constants of lines of equal power, which indicates what N counts."""

    def off(setting: Setting) -> list[float]:
        pairs = [(fit.constant, study.powers[quantity].get(round(fit.power))) for fit in _laws(setting, quantity)]
        return [max(ours / theirs, theirs / ours) for ours, theirs in pairs if theirs]

    ours = [factor for setting in study.judged for factor in off(setting)]
    others = [
        f"{min(each):.1f} to {max(each):.0f} ({s.title})" for s in study.settings if not s.judged and (each := off(s))
    ]
    return Comparison(
        claim=f"The lines run along the errors of {quantity}.",
        measured=f"The constants of {len(ours)} curves whose power is printed are off by factors from {min(ours):.1f} "
        f"to {max(ours):.1f} with {study.judged[0].short}; otherwise by {', by '.join(others) or 'none'}. Below "
        f"{AGREEMENT_FACTOR:g} counts as along.",
        verdict=holds(max(ours) < AGREEMENT_FACTOR),
    )


def _laws(setting: Setting, quantity: str) -> list[PowerLaw]:
    return [fit for fit in _fitted(setting, quantity).values() if fit]


def _faster(study: Study, quantity: str) -> Comparison:
    """Return the check of the powers of SVI and SC in all settings; an exact SVI falls faster than any."""
    pairs = [
        (fits["SVI", n] or PowerLaw(0.0, math.inf), fits["SC", n] or PowerLaw(0.0, 0.0))
        for fits in (_fitted(setting, quantity) for setting in study.settings)
        for n in LEGEND
    ]
    return Comparison(
        claim=f"The error of the {quantity} falls faster with h for SVI than for SC.",
        measured=f"{_powers_text(study, quantity)}.",
        verdict=holds(all(svi.power > sc.power for svi, sc in pairs)),
        bears_on=("accuracy",),
    )


def _superior_h(study: Study) -> Comparison:
    pairs, errors_of, roundoff = [], _exact if study.exact else _compiled, 0.0 if study.exact else ROUNDOFF
    for setting in study.judged if study.exact else study.settings:
        for n in LEGEND:
            for quantity in study.quantities:
                svi, sc = (errors_of(study, setting, scheme, n, quantity) for scheme in SCHEMES)
                assert svi is not None
                assert sc is not None
                pairs.append((svi, sc))
    behind = [np.array(study.steps)[(svi >= sc) & (sc > roundoff)] for svi, sc in pairs]
    lost = [h for steps in behind for h in steps]
    exceptions = f"; where it is not, h is {min(lost):.2g} or more" if lost else ""
    return superiority(pairs, exceptions, roundoff=roundoff, most=math.inf)


def _powers_table(study: Study) -> TableBlock:
    rows: list[tuple[Cell, ...]] = []
    for setting in study.settings:
        for quantity in study.quantities:
            printed = study.powers.get(quantity, {})
            for (scheme, n), fit in _fitted(setting, quantity).items():
                numbers = (fit.power, fit.constant, printed.get(round(fit.power))) if fit else (None, None, None)
                rows.append((setting.title, scheme, n, quantity, *numbers))
    return TableBlock(
        columns=("setting", "scheme", "N", "error of", "fitted power of h", "constant", "printed constant"),
        rows=tuple(rows),
        formats={"fitted power of h": ".2f", "constant": ".1e", "printed constant": ".1e"},
    )


def _errors_over_h(study: Study, quantity: str) -> TableBlock:
    columns: dict[str, list[Cell]] = {"h": list(study.steps)}
    for setting in study.settings:
        for scheme in SCHEMES:
            for n in LEGEND:
                label = f"{scheme}, N = {n}, {setting.title}"
                for errors_of, name in ((_exact, label), (_compiled, f"{label}, compiled")):
                    errors = errors_of(study, setting, scheme, n, quantity)
                    if errors is not None:
                        columns[name] = cells_of(errors)
    return series_table(columns, f"errors-{quantity}")


LOOKS = dict(zip(LEGEND, (("o", "-"), ("s", "--"), ("D", "-.")), strict=True))


def _panels_over_h(study: Study) -> Iterator[Panel]:
    """Yield panels: curves in 60 digits are lines, compiled steps marks; the paper's lines are dotted."""
    for quantity in study.quantities:
        for setting in study.settings:
            series = [
                Series(x=study.steps, y=[c * h**power for h in study.steps], scheme="exact", end=f"$h^{{{power}}}$")
                for power, c in study.powers.get(quantity, {}).items()
                if setting.judged
            ]
            series = [replace(each, marker="", line=":") for each in series]
            for scheme in SCHEMES:
                for n, (marker, line) in LOOKS.items():
                    exact = _exact(study, setting, scheme, n, quantity)
                    marks = _compiled(study, setting, scheme, n, quantity)
                    label = f"{scheme}, N = {n}"
                    if exact is not None and exact.max() > NO_ERROR:
                        series.append(Series(x=study.steps, y=exact, scheme=scheme, label=label, marker="", line=line))
                        label = ""
                    if marks is not None:
                        style = "" if study.exact else line
                        series.append(
                            Series(x=study.steps, y=marks, scheme=scheme, label=label, marker=marker, line=style)
                        )
            yield Panel(title=f"{quantity}, {setting.short}", series=tuple(series), steps=True)
