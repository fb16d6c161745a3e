"""Contenders of a case, their measurements and work-precision curves, and tables of them for the terminal and JSON."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.cases.unforced import STATES


@dataclass(frozen=True, slots=True, kw_only=True)
class ResultTable:
    """Rows with named entries.

    Attributes:
        name: name of the section on the command line.
        title: one line that describes what is compared.
        columns: formats by name of entry, in order.
        rows: entries by name; one that is missing, None or NaN is shown as a dash.
        remarks: lines below the table.
    """

    name: str
    title: str
    columns: Mapping[str, str]
    rows: tuple[Mapping[str, Any], ...]
    remarks: tuple[str, ...] = ()

    def text(self) -> str:
        """Return the table for the terminal."""
        header = [name.replace("_", " ") for name in self.columns]
        rows = [finite(dict(row)) for row in self.rows]
        cells = [
            ["-" if row.get(name) is None else format(row[name], form) for name, form in self.columns.items()]
            for row in rows
        ]
        widths = [max(map(len, column)) for column in zip(header, *cells, strict=True)]
        aligned = ("  ".join(map(str.ljust, row, widths)).rstrip() for row in (header, *cells))
        return "\n  ".join([f"{self.name}: {self.title}", *aligned, *self.remarks])

    def data(self) -> dict[str, Any]:
        """Return the table as data for JSON."""
        return asdict(self) | {"rows": [finite(dict(row)) for row in self.rows], "remarks": [*self.remarks]}


def finite(entries: dict[str, Any]) -> dict[str, Any]:
    """Return entries with numbers that are not finite replaced by None."""
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value for key, value in entries.items()
    }


FLOOR = 1e-13
"""Errors below count as equal to it: they are round-off and chance."""

LEAST = 1e-34
"""Substitute for an error of 0."""

MARGIN = 2.0
"""Factor on the smallest error of a method, for chance on the plateau of round-off."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """Measured setting: seconds for one trajectory, and the error at its end."""

    seconds: float
    error: float


def frontier(points: Iterable[Point], floor: float = FLOOR) -> list[Point]:
    """Return the Pareto-optimal points in time and error, fastest first, up to the first below the floor.

    >>> points = [Point(seconds=s, error=e) for s, e in [(1, 1e-3), (2, 1e-6), (3, 1e-5), (4, 1e-15), (5, 1e-16)]]
    >>> [point.seconds for point in frontier(points)]
    [1, 2, 4]
    """
    points_on: list[Point] = []
    for point in sorted(points, key=lambda point: (point.seconds, point.error)):
        last = points_on[-1].error if points_on else math.inf
        if last > floor and point.error < last:
            points_on.append(point)
    return points_on


def time_at(points: Iterable[Point], error: float, floor: float = FLOOR) -> float | None:
    """Return the seconds to reach an error, linearly interpolated in log-log along the frontier.

    Nothing is extrapolated: a larger error than any measured takes the time of the fastest setting, and for an error
    that no setting reaches the result is ``None``.

    >>> round(time_at([Point(seconds=1.0, error=1e-4), Point(seconds=4.0, error=1e-8)], 1e-6), 12)
    2.0
    """
    curve, wanted = frontier(points, floor), max(error, floor)
    if not curve or wanted < curve[-1].error:
        return None
    errors = -np.log([max(point.error, LEAST) for point in curve])
    return float(np.exp(np.interp(-np.log(wanted), errors, np.log([point.seconds for point in curve]))))


def common_error(one: Sequence[Point], other: Sequence[Point], floor: float = FLOOR) -> float | None:
    """Return the smallest error that both methods reach safely: twice the larger of their smallest, or the floor."""
    curves = frontier(one, floor), frontier(other, floor)
    if not all(curves):
        return None
    return max(floor, *(MARGIN * curve[-1].error if curve[-1].error > floor else floor for curve in curves))


ERRORS = (1e-3, 1e-6, 1e-9, 1e-12)
"""Errors at which all methods are compared, where they reach them."""

BASELINE, FAST, DEFAULT = "heyoka", "fast_math", "tol=default"


OURS = "scvi-codegen"


@dataclass(frozen=True, slots=True, eq=False)
class Contender:
    """Compiled integrator at one setting.

    Attributes:
        method: name of the work-precision curve, as in ``"heyoka"``.
        setting: step size or tolerance.
        options: formulation and options, for the reader.
        compile_seconds: time from the equations to a function that can be called.
        prepare: function from the number of a run, which is that of its initial state, to a function that integrates
            from it and returns the final q, or a function for it that is not timed.
        momenta: (k, m) initial momenta, if they are its state; ``None`` if it starts from velocities.
        trajectories: number of trajectories of one run; the final q of an ensemble is (trajectories, m).
        starts: number of initial states, each of which is a run unless one run has all.
        error: error of the final q, if it is not to be compared with the reference of the case (on other meshes).
    """

    method: str
    setting: str
    options: str
    compile_seconds: float
    prepare: Callable[[int], Callable[[], Any]]
    momenta: NDArray[np.float64] | None = None
    trajectories: int = 1
    starts: int = STATES
    error: Callable[[NDArray[np.float64]], float] | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class Measurement(Point):
    """Result of one contender.

    Attributes:
        method, setting, options, compile_seconds: as of the contender.
        seconds: time of one trajectory: median of the repeats for each state, averaged over the states.
        fastest: the same with minima instead of medians.
        error: relative root-mean-square error over the final states.
        repeats: number of rounds timed.
        failure: reason why there is no result, or ``""``.
    """

    method: str
    setting: str
    options: str
    compile_seconds: float
    fastest: float
    repeats: int
    failure: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class CaseResult:
    """Measurements of one case.

    Attributes:
        name, span, dimension: as of the case.
        reference_accuracy: accuracy of its reference.
        measurements: all settings of all methods.
        skipped: methods that were left out, with the reason.
        errors: at which all methods are compared.
    """

    name: str
    span: float
    dimension: int
    reference_accuracy: float
    measurements: tuple[Measurement, ...]
    skipped: Mapping[str, str]
    errors: tuple[float, ...] = ERRORS

    def methods(self) -> list[str]:
        """Return the names of the curves in the order of measurement."""
        return list(dict.fromkeys(measurement.method for measurement in self.measurements))

    def text(self) -> str:
        """Return the table for the terminal."""
        failures = [f"{each.method} {each.setting}: {each.failure}" for each in self.measurements if each.failure]
        good = {row["method"]: row for row in rows(self)}
        return ResultTable(
            name=self.name,
            title=f"T = {self.span:g}, m = {self.dimension} (reference accurate to {self.reference_accuracy:.0e})",
            columns=COLUMNS,
            rows=tuple(good.get(method, {"method": method, "setting": "failed"}) for method in self.methods()),
            remarks=(
                *filter(None, (_line_at(self, error) for error in self.errors)),
                *failures,
                *(f"skipped {name}: {why}" for name, why in self.skipped.items()),
            ),
        ).text()

    def data(self) -> dict[str, Any]:
        """Return all measurements as data for ``json.dump``; numbers that are not finite are null."""
        measurements = [finite(asdict(each)) for each in self.measurements]
        return asdict(self) | {"measurements": measurements, "rows": [finite(row) for row in rows(self)]}


def rows(result: CaseResult) -> list[dict[str, Any]]:
    """Return one row per method without failures, with the entries of :data:`COLUMNS` and, for JSON, more.

    ``setting``: the fastest that reaches ``at_error``, else the most accurate one; ``at_error``: the smallest error
    that this method and heyoka (else the best peer) both reach; ``seconds``: time of this method there, interpolated;
    """
    made = [_row(result, method) for method in result.methods()]
    return [row for row in made if row]


def _row(result: CaseResult, method: str) -> dict[str, Any]:
    good = [each for each in result.measurements if not each.failure]
    own = [each for each in good if each.method == method]
    if not own:
        return {}
    peers = [each for each in good if not each.method.startswith(OURS)]
    best = [each for each in peers if each.method.startswith(BASELINE)]
    default = [each for each in best if FAST not in each.method and each.setting == DEFAULT]
    error = common_error(own, best or own) or math.inf
    reaching = [each for each in own if max(each.error, FLOOR) <= error]
    shown = min(reaching, key=lambda each: each.seconds) if reaching else min(own, key=lambda each: each.error)
    return {
        "method": method,
        "setting": shown.setting,
        "time_ms": 1e3 * shown.seconds,
        "error": shown.error,
        "compile_s": shown.compile_seconds,
        "default": _ratio(default, own),
        "best": _ratio(best, own),
        "peer": _ratio(peers, own),
        "at_error": error,
        "options": "" if method.startswith(OURS) else shown.options,
        "seconds": time_at(own, error) or math.nan,
    }


def ratios_at(result: CaseResult, error: float) -> tuple[str, dict[str, float]]:
    """Return the fastest method of this package at an error, and the times of all methods that reach it, in seconds."""
    good = [each for each in result.measurements if not each.failure]
    curves = {
        method: [Point(seconds=each.fastest, error=each.error) for each in good if each.method == method]
        for method in result.methods()
    }
    times = {method: time_at(points, error) for method, points in curves.items()}
    reached = {method: seconds for method, seconds in times.items() if seconds is not None}
    return min((each for each in reached if each.startswith(OURS)), key=reached.__getitem__, default=""), reached


def _line_at(result: CaseResult, error: float) -> str:
    """Return a line with the time of the fastest method of this package at an error, and ratios of all others."""
    ours, times = ratios_at(result, error)
    if not ours:
        return ""
    others = [f"{name} {seconds / times[ours]:.3g}" for name, seconds in times.items() if name != ours]
    missing = [name for name in result.methods() if name not in times]
    never = f"; not reached: {', '.join(missing)}" if missing else ""
    return f"at {error:.0e}: {1e3 * times[ours]:.3g} ms by {ours}; others over it: {', '.join(others)}{never}"


PRECISION, STANDARD = "precision:", "svi:8"
"""Beginning of the names of cases with curves of all degrees, and the default method."""


def degree_table(results: Iterable[CaseResult]) -> ResultTable:
    """Return, by case and error, the fastest degree and how many times as long the default degree and peers take."""
    lines = []
    for result in results:
        line: dict[str, Any] = {"problem": result.name.removeprefix(PRECISION)}
        for error in ERRORS:
            best, times = ratios_at(result, error)
            peers = [seconds for name, seconds in times.items() if not name.startswith(OURS)]
            others = [times.get(f"{OURS} {STANDARD}"), min(peers, default=None)]
            ratios = ["-" if seconds is None else f"{seconds / times[best]:.2f}" for seconds in others if best]
            line[f"{error:.0e}"] = " ".join([best.removeprefix(f"{OURS} svi:"), *ratios]) if best else None
        lines.append(line)
    return ResultTable(
        name="precision",
        title="fastest degree of SVI, time of SVI(8) and of the fastest peer divided by its time, at errors",
        columns={"problem": ""} | {f"{error:.0e}": "" for error in ERRORS},
        rows=tuple(lines),
    )


def _ratio(reference: Sequence[Point], points: Sequence[Point]) -> float | None:
    error = common_error(points, reference)
    if error is None:
        return None
    theirs, ours = time_at(reference, error), time_at(points, error)
    return None if theirs is None or ours is None else theirs / ours


COLUMNS = {"method": "", "setting": "", "time_ms": ".3g", "error": ".1e", "compile_s": ".2f"}
COLUMNS |= {"default": ".2f", "best": ".2f", "peer": ".2f", "at_error": ".1e", "options": ""}
LEGEND = """Times are processor times of stepping one trajectory to the end, medians; of an ensemble, the whole over the
number of trajectories. Errors are those of q at the end, relative, in root mean square over the initial states. The
setting shown is the fastest that reaches the error named. Ratios are times of others over that of the method, at equal
error (errors below 1e-13 count as equal), interpolated on the measured curves: above 1 the method is faster.
default: against heyoka with its default options; best: against heyoka with fast_math or without, at any tolerance,
whichever is fastest; peer: against the fastest of all peers. Lines "at ..." compare the shortest times of all methods
with that of the fastest of this package."""


def header_lines(description: Mapping[str, Any]) -> str:
    """Return machine, compiler and versions."""
    versions = ", ".join(f"{name} {version}" for name, version in description["versions"].items())
    first = f"{description['processor']}, {description['cores']} cores, load {description['load']}"
    return f"{first}\n{description['compiler']}, {description['flags']}\n{versions}"
