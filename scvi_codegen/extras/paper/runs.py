"""Figures of runs (1, 3-5, 9-15, 21-30): several methods on one system, views as panels, and conditions of a verdict.

The paper ends the nonlinear iteration when max(|Q^{i+1} - Q^i|, |P^{i+1} - P^i|) < TOL with TOL = 1e-14 in section 3
and 1e-12 in section 4, after at most 1000 iterations: :data:`SECTION_3` with the tolerance of the setting. Code is
compiled with flags that give the same bits on every machine. Settings, views and checks are those of ``figures.toml``.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from itertools import pairwise
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.api.methods import Method
from scvi_codegen.api.systems import MechanicalSystem
from scvi_codegen.api.text import TableBlock
from scvi_codegen.codegen.native.options import SolverOptions
from scvi_codegen.common.errors import MethodWarning, StepFailedError
from scvi_codegen.extras.paper.experiment import (
    Array,
    Comparison,
    Experiment,
    Panel,
    Picture,
    Result,
    Series,
    comparison,
    largest_in_bins,
    package_table,
    thinned,
)
from scvi_codegen.interfaces.models.problems import problem
from scvi_codegen.methods import SCVI, SVI, as_method
from scvi_codegen.runs.compiler import compile_stepper
from scvi_codegen.runs.stepper import Stepper
from scvi_codegen.runs.trajectory import Trajectory

SECTION_3 = SolverOptions(tolerance=1e-14, max_iterations=1000, absolute=True)
ROUNDOFF = SolverOptions(max_iterations=1000)
"""Default convergence criterion of this package, to round-off, where the paper states none."""
NO_DRIFT = 1e-12
"""Largest error that counts as round-off."""
PERIOD = 2.0 * math.pi
"""Period of Kepler's problem with semi-major axis 1."""

PORTABLE_FLAGS = ("-O2", "-ffp-contract=off")
"""Flags of code that gives the same bits on every IEEE 754 machine with the same libm."""


@lru_cache
def system_of(name: str) -> MechanicalSystem:
    """Return a system of the catalogue, built once."""
    return problem(name).system


KEPLER = system_of("kepler")
"""System q'' = -q / |q|^3."""


@lru_cache(maxsize=256)
def stepper_of(system: MechanicalSystem, method: Method, solver: str = "auto") -> Stepper:
    """Return the compiled integrator, cached in the process."""
    return compile_stepper(system, method, solver=solver, flags=PORTABLE_FLAGS)


@dataclass(frozen=True, slots=True)
class Scheme:
    """Method with its label, the scheme that determines its colour, and its step size if it differs."""

    label: str
    method: Method
    color: str
    h: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class RunSetting:
    """Initial value problem and the methods that are compared on it.

    Attributes:
        system, q, velocity, h, span: problem, step size and span.
        schemes: methods by key.
        sentences: description, and how details that the caption omits were chosen.
        options: convergence criterion.
        exact: function that returns the exact (q, p) at given times, or ``None``.
    """

    system: MechanicalSystem
    q: tuple[float, ...]
    velocity: tuple[float, ...]
    h: float
    span: float
    schemes: Mapping[str, Scheme]
    sentences: tuple[str, ...]
    options: SolverOptions = SECTION_3
    exact: Callable[[Array], tuple[Array, Array]] | None = None

    def run(self, key: str) -> MeasuredRun:
        """Return the run of a scheme, the same object at each call."""
        return _run(self, self.schemes[key])

    @property
    def reference(self) -> MeasuredRun:
        """Exact orbit to round-off, over more than one period."""
        return _run(replace(self, h=0.05, span=8.0, options=ROUNDOFF), Scheme("exact", SVI(10), "exact"))


@lru_cache(maxsize=64)
def _run(setting: RunSetting, scheme: Scheme) -> MeasuredRun:
    return MeasuredRun(setting, scheme)


class MeasuredRun:
    """States of a scheme, integrated when first needed, with the quantities of :data:`MEASURES` as attributes."""

    def __init__(self, setting: RunSetting, scheme: Scheme) -> None:
        self.setting, self.scheme, self.label = setting, scheme, scheme.label
        self.h = scheme.h or setting.h

    def __getattr__(self, name: str) -> Any:
        if name not in MEASURES:
            raise AttributeError(name)
        self.__dict__[name] = MEASURES[name].of(self)
        return self.__dict__[name]

    @cached_property
    def stepper(self) -> Stepper:
        """Compiled integrator."""
        method = self.scheme.method
        solver = "newton" if isinstance(method, SCVI) and method.degree > 1 else "auto"
        return stepper_of(self.setting.system, method, solver)

    @cached_property
    def trajectory(self) -> Trajectory:
        """States of all steps, or of those before the first that has no solution."""
        q, steps = self.setting.q, round(self.setting.span / self.h)
        p = self.stepper.momentum(q, self.setting.velocity)
        try:
            return self.stepper.integrate(q, p, h=self.h, steps=steps, options=self.setting.options)
        except StepFailedError as failure:
            return Trajectory.before(failure)


class Measure(NamedTuple):
    """Quantity of a run: name in sentences and headings, format of numbers (``""`` for arrays), and function."""

    heading: str
    form: str
    of: Callable[[MeasuredRun], Any]


def largest(error: Array) -> float:
    """Return the largest absolute value."""
    return float(np.abs(error).max())


def drift(error: Array) -> float:
    """Return the mean over the last fifth of a run less that over the first: 0.8 of the end of a straight line."""
    part = max(1, len(error) // 5)
    return float(error[-part:].mean() - error[:part].mean())


def drift_share(error: Array) -> float:
    """Return the absolute drift over the largest error, 0 for round-off; above a third the error is not oscillation."""
    return abs(drift(error)) / largest(error) if largest(error) > NO_DRIFT else 0.0


def _printed_residual(r: MeasuredRun) -> float:
    """Return the largest residual of q'' = -q/|q|^3 for (cos t - e, sqrt(1 - e^2) sin t), printed in section 2.2."""
    e, t = 1.0 - r.setting.q[0], np.linspace(0.0, PERIOD, 400)
    circle = np.array([np.cos(t), math.sqrt(1.0 - e**2) * np.sin(t)])
    q = circle - [[e], [0.0]]
    return largest(q / np.hypot(*q) ** 3 - circle)


def _position_growth(r: MeasuredRun) -> float:
    return r.position / largest(r.position_error[r.t <= 20.0]) if r.position > 1e-14 else 0.0


def _growth(error: Array) -> float:
    half = len(error) // 2
    return largest(error[half:]) / largest(error[:half])


def _exact(r: MeasuredRun) -> tuple[Array, Array]:
    assert r.setting.exact is not None
    return r.setting.exact(r.t)


def _area_change(r: MeasuredRun) -> float:
    """Return the area enclosed by the last fifth of the states relative to the first fifth, less 1."""
    # States surround the origin. The polygon of n states is smaller than the curve by about (2 pi / n)^2 / 3.
    part = len(r.q) // 5
    first, last = (_enclosed_area(r.q[states, 0], r.p[states, 0]) for states in np.s_[:part, -part:])
    return last / first - 1.0


def _enclosed_area(q: Array, p: Array) -> float:
    """Return the area of the polygon through points in the order of their angle about the origin."""
    order = np.argsort(np.arctan2(p, q))
    x, y = q[order], p[order]
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def _ellipse_change(r: MeasuredRun) -> float:
    """Return the mean area pi a b of the osculating ellipse over the last three periods over the first, less 1."""
    # pi a b with a = -1/(2 E) and b = |M| / sqrt(-2 E)
    areas = np.pi * np.abs(r.momenta) * (-2.0 * r.energies) ** -1.5
    count = round(3.0 * PERIOD / r.h)
    return float(areas[-count:].mean() / areas[:count].mean()) - 1.0


def _turn(r: MeasuredRun) -> float:
    """Return the angle by which the Laplace-Runge-Lenz vector p x M - q / |q| has rotated, whole turns included."""
    (x, y), (px, py), m = r.q.T, r.p.T, r.momenta
    angle = np.unwrap(np.arctan2(-px * m - y / np.hypot(x, y), py * m - x / np.hypot(x, y)))
    return float(angle[-1] - angle[0])


def _revolutions(r: MeasuredRun) -> list[float]:
    """Return the duration of each revolution, from apocentre to apocentre, where q . p changes sign."""
    outward = (r.q * r.p).sum(axis=1)
    before = np.flatnonzero((outward[:-1] > 0) & (outward[1:] <= 0))
    share = outward[before] / (outward[before] - outward[before + 1])
    times = r.t[before] + share * (r.t[before + 1] - r.t[before])
    return [float(duration) for duration in np.diff(times)]


def angular_momentum(q: Array, p: Array) -> Array:
    """Return M = q1 p2 - q2 p1, along the last axis."""
    return np.asarray(q[..., 0] * p[..., 1] - q[..., 1] * p[..., 0])


def exact_oscillator(q: Sequence[float], p: Sequence[float], t: Array) -> tuple[Array, Array]:
    """Return (q, p) of the oscillator q'' = -q after times t, one row each."""
    return np.outer(np.cos(t), q) + np.outer(np.sin(t), p), np.outer(np.cos(t), p) - np.outer(np.sin(t), q)


def perihelion(e: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return (q, v) at perihelion for semi-major axis 1 (energy -1/2, period 2 pi) and eccentricity e."""
    return (1.0 - e, 0.0), (0.0, math.sqrt((1.0 + e) / (1.0 - e)))


def exact_kepler(q: ArrayLike, p: ArrayLike, t: ArrayLike) -> tuple[Array, Array]:
    """Return (q, p) after times t, one row each, from Kepler's equation for the change x of the eccentric anomaly."""
    start, velocity = np.asarray(q, dtype=float), np.asarray(p, dtype=float)
    times = np.atleast_1d(np.asarray(t, dtype=float))
    r0 = float(np.hypot(*start))
    a = 1.0 / (2.0 / r0 - float(velocity @ velocity))
    inward, sigma = 1.0 - r0 / a, float(start @ velocity) / math.sqrt(a)
    mean = times / a**1.5
    x = mean.copy()
    for _ in range(60):  # Newton's iterations
        x -= (x - inward * np.sin(x) + sigma * (1 - np.cos(x)) - mean) / (1 - inward * np.cos(x) + sigma * np.sin(x))
    # Lagrange's coefficients: q(t) = f q_0 + g v_0 (Danby, Fundamentals of Celestial Mechanics, ch. 6).
    r = a * (1 - inward * np.cos(x) + sigma * np.sin(x))
    f, g = 1 - a / r0 * (1 - np.cos(x)), times - a**1.5 * (x - np.sin(x))
    f_dot, g_dot = -math.sqrt(a) / (r * r0) * np.sin(x), 1 - a / r * (1 - np.cos(x))
    return np.outer(f, start) + np.outer(g, velocity), np.outer(f_dot, start) + np.outer(g_dot, velocity)


EXACT: Mapping[str, Callable[[Sequence[float], Sequence[float], Array], tuple[Array, Array]]] = {
    "kepler": exact_kepler,
    "harmonic-oscillator": exact_oscillator,
}
"""Exact flows by system, with all constants 1."""
MEASURES: Mapping[str, Measure] = {
    "t": Measure("t", "", lambda r: r.trajectory.t),
    "q": Measure("positions", "", lambda r: r.trajectory.q),
    "p": Measure("momenta", "", lambda r: r.trajectory.p),
    "steps": Measure("steps", "d", lambda r: len(r.t) - 1),
    "failed": Measure("failed", "", lambda r: r.steps < round(r.setting.span / r.h)),
    "end": Measure("last t", ".1f", lambda r: float(r.t[-1])),
    "exact": Measure("exact states", "", _exact),
    "energies": Measure("energy", "", lambda r: r.trajectory.energy()),
    "kinetic": Measure("kinetic energy, unit masses", "", lambda r: (r.p**2).sum(axis=1) / 2),
    "potential": Measure("potential energy", "", lambda r: r.energies - r.kinetic),
    "momenta": Measure("angular momentum", "", lambda r: angular_momentum(r.q, r.p)),
    "energy_error": Measure("energy error", "", lambda r: r.energies - r.energies[0]),
    "momentum_error": Measure("momentum error", "", lambda r: r.momenta - r.momenta[0]),
    "position_error": Measure("position error", "", lambda r: np.linalg.norm(r.q - r.exact[0], axis=1)),
    "energy": Measure("largest energy error", ".1e", lambda r: largest(r.energy_error)),
    "drift": Measure("drift of the energy", ".1e", lambda r: drift(r.energy_error)),
    "drift_share": Measure("share of the drift in the largest error", ".2f", lambda r: drift_share(r.energy_error)),
    "growth": Measure("energy error, second half over first", ".2f", lambda r: _growth(r.energy_error)),
    "last_energy": Measure("last energy", ".5f", lambda r: float(r.energies[-1])),
    "momentum": Measure("largest momentum error", ".1e", lambda r: largest(r.momentum_error)),
    "last_momentum": Measure("last momentum", ".3f", lambda r: float(r.momenta[-1])),
    "position": Measure("largest position error", ".1e", lambda r: largest(r.position_error)),
    "position_growth": Measure("largest position error over that to t = 20", ".1f", _position_growth),
    "state": Measure(
        "largest error of a state", ".1e", lambda r: largest(np.hypot(r.q - r.exact[0], r.p - r.exact[1]))
    ),
    "area": Measure("change of the phase area", "+.1e", _area_change),
    "ellipse_area": Measure("change of the area of the ellipse", "+.2%", _ellipse_change),
    "turn": Measure("turn of the perihelion", "+.1e", _turn),
    "printed_residual": Measure("residual of the printed solution", ".1f", _printed_residual),
    "revolutions": Measure("durations of revolutions", "", _revolutions),
    "first_revolution": Measure("first revolution", ".4f", lambda r: next(iter(r.revolutions), None)),
    "last_revolution": Measure("last revolution", ".4f", lambda r: next(iter(r.revolutions[::-1]), None)),
    "period_change": Measure(
        "change of the period", ".1e", lambda r: r.last_revolution / r.first_revolution - 1 if r.revolutions else None
    ),
}
"""Quantities by the name of the attribute; arrays have an entry for each state."""

Runs: TypeAlias = Mapping[str, MeasuredRun]


def compared(claim: str, check: str, runs: Runs) -> Comparison:
    """Return the comparison of a claim with measurements.

    Args:
        claim: statement of the paper.
        check: ``"ATTRIBUTE: CONDITION, ..; ATTRIBUTE: ..|CLAIMS|NOTE"``. A condition is a chain such as
            ``svi < 1e-6 < sc`` or ``100*svi < sc`` of numbers and absolute values of the attribute for runs by key; a
            key alone is only listed. CLAIMS are keys of :mod:`scvi_codegen.extras.paper.experiment`; NOTE is appended.
        runs: runs by key.
    """
    conditions, claims, note = (part.strip() for part in f"{check}||".split("|")[:3])
    measured, outcomes = [], []
    for part in conditions.split(";"):
        attribute, _, chains = (text.strip() for text in part.partition(":"))
        terms = [[term.strip() for term in chain.split("<")] for chain in chains.split(",")]
        keys = dict.fromkeys(term.split("*")[-1] for chain in terms for term in chain)
        measure, named = MEASURES[attribute], [runs[key] for key in keys if key in runs]
        listed = ", ".join(
            f"{'none' if (x := getattr(run, attribute)) is None else format(x, measure.form)} ({run.label})"
            for run in named
        )
        measured.append(f"{measure.heading}: {listed}")
        for chain in terms:
            values = [_value(term, attribute, runs) for term in chain]
            outcomes += [all(x < y for x, y in pairwise(values))] if len(values) > 1 else []
    sentence = "; ".join(measured)
    text = f"{sentence[:1].upper()}{sentence[1:]}. {note}".strip()
    return comparison(claim, text, *outcomes, bears_on=claims)


def _value(term: str, attribute: str, runs: Runs) -> float:
    """Return a number, or the absolute value of the attribute of a run, times a factor; NaN if it has none."""
    factor, _, key = term.rpartition("*")
    if key not in runs:
        return float(term)
    value = getattr(runs[key], attribute)
    return math.nan if value is None else float(factor or 1.0) * abs(value)


def figure(name: str, title: str, setting: RunSetting, views: Sequence[Mapping[str, Any]], checks: str) -> Experiment:
    """Return the experiment that runs the schemes of a setting, draws views of them and tests statements.

    ``checks``: statements of the paper, a line each, followed by indented lines as in :func:`compared`.
    """
    tests = re.findall(r"^(\S.*)\n((?:[ ]+.*(?:\n|$))+)", checks, re.MULTILINE)
    measures = dict.fromkeys(re.findall(r"(\w+):", " ".join(test.split("|")[0] for _, test in tests)))

    def run(_: Mapping[str, Result]) -> Result:
        runs = {key: setting.run(key) for key in setting.schemes}
        panels = tuple(panel for view in views for panel in _panels(runs, **view))
        columns = {1: 1, 2: 2, 4: 2}.get(len(panels), 3)
        picture = Picture(panels=panels, columns=columns, size=(7.0, 4.2) if len(panels) == 1 else (4.0, 3.8))
        return Result(
            setting=setting.sentences,
            checks=tuple(compared(claim, " ".join(test.split()), runs) for claim, test in tests),
            tables=(measured_table(runs, list(measures)), picture.curves()),
            picture=picture,
        )

    return Experiment(name=name, title=title, run=run)


def _panels(every_run: Runs, *, draw: str, runs: Sequence[str] = (), **how: Any) -> Iterable[Panel]:
    """Return the panels of a view, of the named runs or of all."""
    return VIEWS[draw]({key: every_run[key] for key in runs or every_run}, **how)


def measured_table(runs: Runs, measures: Sequence[str]) -> TableBlock:
    """Return a row for each run with the values of some attributes."""
    headings = [MEASURES[name].heading for name in measures]
    return TableBlock(
        columns=("method", "h", "steps", *headings),
        rows=tuple((r.label, r.h, r.steps, *(getattr(r, name) for name in measures)) for r in runs.values()),
        formats={"h": ".4g"} | {MEASURES[name].heading: MEASURES[name].form for name in measures},
    )


def _series(run: MeasuredRun, xs: ArrayLike, ys: ArrayLike, **style: str) -> Series:
    x, y = thinned(xs, ys)
    return Series(x=x, y=y, scheme=run.scheme.color, **{"label": run.label} | style)


def plane(
    runs: Runs, *, kind: str = "phase", part: str = ":", window: tuple[float, float] | None = None, more: str = ""
) -> Iterable[Panel]:
    """Yield states over the exact curve, a panel for each run.

    Args:
        runs: runs by key.
        kind: ``"phase"`` for (q_i, p_i) of every coordinate, ``"orbit"`` for (q_1, q_2).
        part: states that are drawn, as in ``"-63:"``.
        window: range of both axes.
        more: text after the label in the title.
    """
    drawn_states = slice(*(int(bound) if bound else None for bound in part.split(":")))
    xlabel, ylabel = ("q", "p") if kind == "phase" else ("$q_1$", "$q_2$")

    def curves(run: MeasuredRun, states: slice) -> list[tuple[ArrayLike, ArrayLike]]:
        q, p = run.q[states], run.p[states]
        return [(q[:, 0], q[:, 1])] if kind == "orbit" else list(zip(q.T, p.T, strict=True))

    for run in runs.values():
        dots = [_series(run, *xy, marker=".", line="", label="") for xy in curves(run, drawn_states)]
        exact = [_series(run.setting.reference, *xy, label="") for xy in curves(run.setting.reference, slice(None))]
        series, title = (*exact, *dots), f"{run.label}{more}"
        yield Panel(title=title, series=series, xlabel=xlabel, ylabel=ylabel, equal=True, window=window)


def over_time(
    runs: Runs, *, quantity: str, title: str = "", periods: bool = False, error: bool = True
) -> Iterable[Panel]:
    """Yield one panel of a quantity of all runs over time.

    Args:
        runs: runs by key.
        quantity: attribute of the runs.
        title: title of the panel.
        periods: True for time in periods of 2 pi.
        error: True for the largest absolute value in each of some hundred intervals, on a logarithmic axis.
    """
    unit, lines = PERIOD if periods else 1.0, ("-", ":", "--")
    series, colors = [], list[str]()
    for run in runs.values():
        colors.append(run.scheme.color)
        points = (run.t / unit, getattr(run, quantity))
        line = lines[(colors.count(run.scheme.color) - 1) % len(lines)]
        series.append(_series(run, *(largest_in_bins(*points) if error else points), line=line))
    name, xlabel = MEASURES[quantity].heading, "t, in periods" if periods else "t"
    ylabel, log = (f"|{name}|, largest in each interval", "y") if error else (name, "")
    yield Panel(title=title or name, series=tuple(series), xlabel=xlabel, ylabel=ylabel, log=log)


def _settings(tables: Mapping[str, Mapping[str, Any]]) -> dict[str, RunSetting]:
    settings = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", MethodWarning)  # SVI with fewer Gauss points than the degree
        for name, table in tables.items():
            system, q, velocity = table["system"], tuple(table["q"]), tuple(table["velocity"])
            settings[name] = RunSetting(
                system=system_of(system),
                q=q,
                velocity=velocity,
                h=table["h"],
                span=table["span"],
                schemes={key: _scheme(**scheme) for key, scheme in table["schemes"].items()},
                sentences=tuple(table["sentences"]),
                options=replace(SECTION_3, tolerance=table["tolerance"]),
                exact=partial(EXACT[system], q, velocity) if system in EXACT else None,
            )
    return settings


def _scheme(label: str, method: str | dict[str, Any], color: str, h: float | None = None) -> Scheme:
    return Scheme(label, as_method(method), color, h)


def _figure(
    name: str, title: str, setting: str, views: Sequence[dict[str, Any]], checks: str, span: float | None = None
) -> Experiment:
    """Return the figure of a table of the file; ``span`` if it differs from that of the setting."""
    run_setting = SETTINGS[setting] if span is None else replace(SETTINGS[setting], span=span)
    return figure(name, title, run_setting, views, checks)


VIEWS: Mapping[str, Callable[..., Iterable[Panel]]] = {"plane": plane, "over time": over_time}
_TABLES = package_table("figures.toml")
SETTINGS = _settings(_TABLES.pop("settings"))
EXPERIMENTS = tuple(_figure(name, **table) for name, table in _TABLES.items())
