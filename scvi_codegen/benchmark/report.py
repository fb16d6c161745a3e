"""Work-precision curves of a case as a table for the terminal and as JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from scvi_codegen.benchmark.contenders.contenders import OURS
from scvi_codegen.benchmark.tables import finite, lines_of
from scvi_codegen.benchmark.timing import Measurement
from scvi_codegen.benchmark.work_precision import FLOOR, Point, common_error, time_at

__all__ = ["LEGEND", "CaseResult", "ReportRow", "header_lines", "rows"]

BASELINE, FAST, DEFAULT = "heyoka", "fast_math", "tol=default"


@dataclass(frozen=True, slots=True, kw_only=True)
class CaseResult:
    """Measurements of one case.

    Attributes:
        name, span, dimension: as of the case.
        accuracy: accuracy of its reference.
        measurements: all settings of all methods.
        skipped: methods that were left out, with the reason.
    """

    name: str
    span: float
    dimension: int
    accuracy: float
    measurements: tuple[Measurement, ...]
    skipped: Mapping[str, str]

    def methods(self) -> list[str]:
        """Return the names of the curves in the order of measurement."""
        return list(dict.fromkeys(measurement.method for measurement in self.measurements))

    def text(self) -> str:
        """Return a block of the report for the terminal."""
        return _block(self)

    @classmethod
    def from_data(cls, data: Mapping[str, Any]) -> CaseResult:
        """Return the result that :meth:`data` describes; null becomes NaN."""
        measurements: list[dict[str, Any]] = [
            {key: math.nan if value is None else value for key, value in each.items()} for each in data["measurements"]
        ]
        return cls(
            name=data["name"],
            span=data["span"],
            dimension=data["dimension"],
            accuracy=data["reference_accuracy"],
            measurements=tuple(Measurement(**entries) for entries in measurements),
            skipped=data["skipped"],
        )

    def data(self) -> dict[str, Any]:
        """Return all measurements as data for ``json.dump``; numbers that are not finite are null."""
        return {
            "name": self.name,
            "span": self.span,
            "dimension": self.dimension,
            "reference_accuracy": self.accuracy,
            "skipped": dict(self.skipped),
            "measurements": [finite(asdict(each)) for each in self.measurements],
            "rows": [_row_data(row) for row in rows(self)],
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class ReportRow:
    """Line of the table; ratios are times of others over that of this method at equal error: above 1 it is faster.

    Attributes:
        measurement: the fastest setting that reaches the common error, else the most accurate one.
        at_error: error at which times are compared: the smallest that this method and heyoka both reach.
        seconds: time of this method at that error, interpolated on its curve.
        default: ratio for heyoka at its default tolerance, without ``fast_math``.
        best: ratio for heyoka, the best of all its curves and tolerances.
        peer: ratio for the best of all peers.
        best_by_minima: like best, from the shortest times instead of the medians.
    """

    method: str
    measurement: Measurement
    at_error: float
    seconds: float
    default: float | None
    best: float | None
    peer: float | None
    best_by_minima: float | None


def rows(result: CaseResult) -> list[ReportRow]:
    """Return one row per method."""
    made = [_row(result, method) for method in result.methods()]
    return [row for row in made if row is not None]


def _row(result: CaseResult, method: str) -> ReportRow | None:
    good = [each for each in result.measurements if not each.failure]
    ours = [each for each in good if each.method == method]
    if not ours:
        return None
    peers = [each for each in good if not each.method.startswith(OURS)]
    best = [each for each in peers if each.method.startswith(BASELINE)]
    default = [each for each in best if FAST not in each.method and each.setting == DEFAULT]
    points = [each.point for each in ours]
    error = common_error(points, [each.point for each in best or ours]) or math.inf
    reaching = [each for each in ours if max(each.error, FLOOR) <= error]
    shown = min(reaching, key=lambda each: each.seconds) if reaching else min(ours, key=lambda each: each.error)
    return ReportRow(
        method=method,
        measurement=shown,
        at_error=error,
        seconds=time_at(points, error) or math.nan,
        default=_ratio(_points(default), points),
        best=_ratio(_points(best), points),
        peer=_ratio(_points(peers), points),
        best_by_minima=_ratio([each.fastest_point for each in best], [each.fastest_point for each in ours]),
    )


def _points(measurements: Sequence[Measurement]) -> list[Point]:
    return [one.point for one in measurements]


def _ratio(reference: Sequence[Point], points: Sequence[Point]) -> float | None:
    error = common_error(points, reference)
    if error is None:
        return None
    theirs, ours = time_at(reference, error), time_at(points, error)
    return None if theirs is None or ours is None else theirs / ours


HEADER = ["", "setting", "time", "error", "compile", "default", "best", "peer", "at error", "options"]
_FAILED = ["failed", *("-" for _ in HEADER[2:-1]), ""]
LEGEND = """Times are processor times of stepping one trajectory to the end, medians; of an ensemble, the whole over the
number of trajectories. Errors are those of q at the end, relative, in root mean square over the initial states. The
setting shown is the fastest that reaches the error named. Ratios are times of others over that of the method, at equal
error (errors below 1e-13 count as equal), interpolated on the measured curves: above 1 the method is faster.
default: against heyoka with its default options; best: against heyoka with fast_math or without, at any tolerance,
whichever is fastest; peer: against the fastest of all peers."""


def header_lines(description: Mapping[str, Any]) -> str:
    """Return machine, compiler and versions."""
    versions = ", ".join(f"{name} {version}" for name, version in description["versions"].items())
    first = f"{description['processor']}, {description['cores']} cores, load {description['load']}"
    return f"{first}\n{description['compiler']}, {description['flags']}\n{versions}"


def _block(result: CaseResult) -> str:
    title = f"{result.name}, T = {result.span:g}, m = {result.dimension} (reference accurate to {result.accuracy:.0e})"
    good = {row.method: _cells(row) for row in rows(result)}
    text = lines_of([HEADER, *(good.get(method, [method, *_FAILED]) for method in result.methods())])
    failures = [f"{each.method} {each.setting}: {each.failure}" for each in result.measurements if each.failure]
    notes = [f"skipped {name}: {why}" for name, why in result.skipped.items()]
    return "\n  ".join([title, *text, *failures, *notes])


def _cells(row: ReportRow) -> list[str]:
    measurement = row.measurement
    return [
        row.method,
        measurement.setting,
        f"{1e3 * measurement.seconds:.3g} ms",
        f"{measurement.error:.1e}",
        f"{measurement.compile_seconds:.2f} s",
        *("-" if ratio is None else f"{ratio:.2f}" for ratio in (row.default, row.best, row.peer)),
        f"{row.at_error:.1e}",
        "" if row.method.startswith(OURS) else measurement.options,
    ]


def _row_data(row: ReportRow) -> dict[str, Any]:
    numbers = asdict(row) | {"setting": row.measurement.setting}
    del numbers["measurement"]
    return finite(numbers)
