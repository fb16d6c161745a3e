"""Study of the errors of one step of SVI and SC: settings, quantities, grids and the paper's lines as data.

Verdicts are based on the settings that are ``judged``; the others show how the result depends on what a caption leaves
open.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from typing import TypeAlias

import numpy as np

from scvi_codegen.methods.method import Method
from scvi_codegen.reproduce.laboratory.drawing import Array, Panel, draw_panels
from scvi_codegen.reproduce.laboratory.experiment import (
    Cell,
    Comparison,
    Picture,
    Verdict,
    holds,
)
from scvi_codegen.reproduce.laboratory.geometric import Line
from scvi_codegen.reproduce.laboratory.running import Reading
from scvi_codegen.tables.precision import Number

ROUNDOFF = 1e-13
"""Round-off level of the error of a step."""
MOSTLY = 0.9
"""Least share of comparisons at which a claim holds in part."""

Errors: TypeAlias = Callable[[Method, float], Mapping[str, float]]
"""Errors of the compiled step by quantity; NaN if it has no solution."""
PreciseErrors: TypeAlias = Callable[[Method, Number], Mapping[str, Number]]
"""The same, computed in 60 digits."""


@dataclass(frozen=True, slots=True)
class Setting:
    """Problem, and meaning of N.

    Attributes:
        title: description, in tables and above panels.
        short: the same in sentences, as ``"e = 0.5"``.
        reading: meaning of N.
        errors: errors of a compiled step.
        more: number of Gauss points of SVI less N.
        judged: False if the setting is only shown.
        precise: errors in 60 digits.
        fitted: step sizes from which powers of h are fitted.
    """

    title: str
    short: str
    reading: Reading
    errors: Errors
    more: int = 0
    judged: bool = True
    precise: PreciseErrors | None = None
    fitted: tuple[Number, ...] = ()

    def method(self, scheme: str, n: int) -> Method:
        """Return ``"SVI"`` or ``"SC"`` with N points."""
        return self.reading.method(scheme, n, more=self.more)


@dataclass(frozen=True, slots=True, kw_only=True)
class Study:
    """Errors over N or over h.

    Attributes:
        sentences: setting of the result.
        settings: columns (over N: rows) of panels.
        quantities: names of the errors.
        steps: step sizes; over N a single one.
        degrees: over N, degrees by scheme.
        lines: over N, constants (c, b) of the paper's lines c b^N by scheme and quantity.
        powers: over h, constants of the paper's lines by quantity and power of h.
        resolved: over N, largest error of SC that is compared with that of SVI.
        exact: over h, True if curves are computed in 60 digits, and the compiled code only where it is judged.
    """

    sentences: tuple[str, ...]
    settings: tuple[Setting, ...]
    quantities: tuple[str, ...]
    steps: tuple[float, ...]
    degrees: Mapping[str, Sequence[int]] = field(default_factory=dict)
    lines: Mapping[tuple[str, str], Line] = field(default_factory=dict)
    powers: Mapping[str, Mapping[int, float]] = field(default_factory=dict)
    resolved: float = math.inf
    exact: bool = False

    @property
    def judged(self) -> tuple[Setting, ...]:
        """Settings on which verdicts are based."""
        return tuple(setting for setting in self.settings if setting.judged)


@lru_cache(maxsize=4096)
def step_errors(setting: Setting, scheme: str, n: int, h: float) -> Mapping[str, float]:
    """Return the errors of the compiled step."""
    return setting.errors(setting.method(scheme, n), h)


@lru_cache(maxsize=4096)
def precise_errors(setting: Setting, scheme: str, n: int, h: Number) -> Mapping[str, Number]:
    """Return the errors of the step in 60 digits."""
    assert setting.precise is not None
    return setting.precise(setting.method(scheme, n), h)


def superiority(pairs: Sequence[tuple[Array, Array]], exceptions: str, *, roundoff: float, most: float) -> Comparison:
    """Return the check of conclusion (ii) on errors of SVI and of SC, those of SC between two bounds."""
    counted = [(svi, sc, np.isfinite(svi) & (sc > roundoff) & (sc < most)) for svi, sc in pairs]
    smaller = sum(int((svi[seen] < sc[seen]).sum()) for svi, sc, seen in counted)
    all_ = sum(int(seen.sum()) for *_, seen in counted)
    return Comparison(
        claim="SVI is more accurate than SC with the same number of points and the same step.",
        measured=f"The error of SVI is the smaller one in {smaller} of {all_} comparisons{exceptions}.",
        verdict=Verdict.PARTLY if MOSTLY * all_ <= smaller < all_ else holds(smaller == all_),
        bears_on=("accuracy",),
    )


def cells_of(errors: Array) -> list[Cell]:
    """Return cells of a table; NaN becomes empty."""
    return [None if math.isnan(error) else error for error in errors.tolist()]


def picture_of(content: Sequence[Panel], rows: int, columns: int, height: float) -> Picture:
    """Return the picture of some panels, row by row, each of ``height`` inches."""
    draw = partial(draw_panels, rows=rows, columns=columns, content=tuple(content), floor=1e-15)
    return Picture(draw=draw, width=4.5 * columns, height=height * rows)
