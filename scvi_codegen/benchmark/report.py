"""Measurements as a table for the terminal and as JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from scvi_codegen.benchmark.contenders import OURS
from scvi_codegen.benchmark.curves import FLOOR, Point, common_error, time_at
from scvi_codegen.benchmark.measuring import Measurement

__all__ = ["SCHEMA", "CaseResult", "Row", "as_json", "rows", "table"]

SCHEMA = 1
"""Version of the JSON."""

BASELINE = "heyoka"


@dataclass(frozen=True, slots=True, kw_only=True)
class CaseResult:
    """Everything measured on one case.

    Attributes:
        name, span, dimension: of the case.
        accuracy: of its reference.
        measurements: all settings of all methods.
        skipped: methods that were left out, and why.
    """

    name: str
    span: float
    dimension: int
    accuracy: float
    measurements: tuple[Measurement, ...]
    skipped: Mapping[str, str]

    def methods(self) -> list[str]:
        """Names of the curves, in the order measured."""
        return list(dict.fromkeys(measurement.method for measurement in self.measurements))


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One line of the table.

    Attributes:
        measurement: the fastest setting that reaches the common error, else the most accurate one.
        at_error: the error at which times are compared: the smallest that this method and heyoka both reach.
        seconds: of this method there, interpolated on its curve.
        ratio: time of heyoka (all its curves taken together) there, over this method's; above 1 is faster.
        minima_ratio: the same from the shortest times instead of the medians.
        plain_ratio: the ratio against heyoka without ``fast_math``.
    """

    method: str
    measurement: Measurement
    at_error: float
    seconds: float
    ratio: float | None
    minima_ratio: float | None
    plain_ratio: float | None


def rows(result: CaseResult) -> list[Row]:
    """One row a method."""
    made = [_row(result, method) for method in result.methods()]
    return [row for row in made if row is not None]


def _row(result: CaseResult, method: str) -> Row | None:
    own = [found for found in result.measurements if found.method == method and not found.failure]
    if not own:
        return None
    best = [found for found in result.measurements if found.method.startswith(BASELINE) and not found.failure]
    plain = [found for found in best if found.method == BASELINE]
    points = [found.point for found in own]
    error = common_error(points, [found.point for found in best or own]) or math.inf
    reaching = [found for found in own if max(found.error, FLOOR) <= error]
    shown = min(reaching, key=lambda found: found.seconds) if reaching else min(own, key=lambda found: found.error)
    return Row(
        method=method,
        measurement=shown,
        at_error=error,
        seconds=time_at(points, error) or math.nan,
        ratio=_ratio([found.point for found in best], points),
        minima_ratio=_ratio([found.fastest_point for found in best], [found.fastest_point for found in own]),
        plain_ratio=_ratio([found.point for found in plain], points),
    )


def _ratio(reference: Sequence[Point], points: Sequence[Point]) -> float | None:
    error = common_error(points, reference)
    if error is None:
        return None
    theirs, own = time_at(reference, error), time_at(points, error)
    return None if theirs is None or own is None else theirs / own


HEADER = ("", "setting", "time", "error", "compile", "ratio", "minima", "plain", "at error", "options")
LEGEND = """Times are processor times of stepping one trajectory to the end, medians. Errors are those of q at the end,
relative, in root mean square over eight initial states. The setting shown is the fastest that reaches the error named.
ratio: time of heyoka's best, with fast_math or without, over the method's, at the error named, interpolated on the
measured curves (errors below 1e-13 count as equal); above 1 is faster than heyoka. minima: the same from the shortest
times instead of the medians, which a busy machine disturbs less. plain: the ratio against heyoka without fast_math."""


def table(results: Sequence[CaseResult], description: Mapping[str, Any]) -> str:
    """The whole report as text."""
    blocks = [_machine_lines(description)]
    blocks += [_block(result) for result in results]
    return "\n\n".join([*blocks, LEGEND])


def _machine_lines(description: Mapping[str, Any]) -> str:
    versions = ", ".join(f"{name} {version}" for name, version in description["versions"].items())
    first = f"{description['processor']}, {description['cores']} cores, load {description['load']}"
    return f"{first}\n{description['compiler']}, {description['flags']}\n{versions}"


def _block(result: CaseResult) -> str:
    title = f"{result.name}, T = {result.span:g}, m = {result.dimension} (reference accurate to {result.accuracy:.0e})"
    lines = [HEADER, *(_cells(row) for row in rows(result))]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    text = ["  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip() for line in lines]
    failures = [f"{found.method} {found.setting}: {found.failure}" for found in result.measurements if found.failure]
    notes = [f"skipped {name}: {why}" for name, why in result.skipped.items()]
    return "\n  ".join([title, *text, *failures, *notes])


def _cells(row: Row) -> tuple[str, ...]:
    found = row.measurement
    return (
        row.method,
        found.setting,
        _seconds(found.seconds),
        f"{found.error:.1e}",
        f"{found.compile_seconds:.2f} s",
        _number(row.ratio),
        _number(row.minima_ratio),
        _number(row.plain_ratio),
        f"{row.at_error:.1e}",
        "" if row.method.startswith(OURS) else found.options,
    )


def _seconds(value: float) -> str:
    return f"{1e3 * value:.3g} ms"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def as_json(results: Sequence[CaseResult], description: Mapping[str, Any]) -> dict[str, Any]:
    """Everything, as data that ``json.dump`` takes; numbers that do not exist are null."""
    return {
        "schema": SCHEMA,
        "machine": dict(description),
        "cases": [
            {
                "name": result.name,
                "span": result.span,
                "dimension": result.dimension,
                "reference_accuracy": result.accuracy,
                "skipped": dict(result.skipped),
                "measurements": [_finite(asdict(found)) for found in result.measurements],
                "rows": [
                    _finite(
                        {
                            "method": row.method,
                            "setting": row.measurement.setting,
                            "at_error": row.at_error,
                            "seconds": row.seconds,
                            "ratio": row.ratio,
                            "minima_ratio": row.minima_ratio,
                            "plain_ratio": row.plain_ratio,
                        }
                    )
                    for row in rows(result)
                ],
            }
            for result in results
        ],
    }


def _finite(entries: dict[str, Any]) -> dict[str, Any]:
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value for key, value in entries.items()
    }
