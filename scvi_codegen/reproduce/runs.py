"""Runs of several methods on one system with the settings of the paper's captions, and quantities measured on them.

The paper ends the nonlinear iteration when max(|Q^{i+1} - Q^i|, |P^{i+1} - P^i|) < TOL with TOL = 1e-14 in section 3
and 1e-12 in section 4, after at most 1000 iterations: :data:`SECTION_3` and :data:`SECTION_4`. Code is compiled with
flags that give the same bits on every machine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from scvi_codegen.compiler import compile_stepper
from scvi_codegen.errors import StepFailedError
from scvi_codegen.mechanics.system import MechanicalSystem
from scvi_codegen.methods import SCVI, SVI
from scvi_codegen.methods.method import Method
from scvi_codegen.models.problems import problem
from scvi_codegen.native.building import PORTABLE_FLAGS
from scvi_codegen.native.options import SolverOptions
from scvi_codegen.reproduce.drawing import Array
from scvi_codegen.runtime.core.stepper import Stepper
from scvi_codegen.runtime.trajectory.trajectory import Trajectory

SECTION_3 = SolverOptions(tolerance=1e-14, max_iterations=1000, absolute=True)
SECTION_4 = SolverOptions(tolerance=1e-12, max_iterations=1000, absolute=True)
ROUNDOFF = SolverOptions(max_iterations=1000)
"""Default convergence criterion of this package, to round-off, where the paper states none."""
NO_DRIFT = 1e-12
"""Largest error that counts as round-off."""
PERIOD = 2.0 * math.pi
"""Period of Kepler's problem with semi-major axis 1."""


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
    areas, count = np.pi * np.abs(r.momenta) * (-2.0 * r.energies) ** -1.5, round(3.0 * PERIOD / r.h)
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
    result: Array = q[..., 0] * p[..., 1] - q[..., 1] * p[..., 0]
    return result


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
