"""Random motions in charts: other origins, other units, from rest, at equilibria; what a run may not depend on.

A chart replaces each coordinate x by x/u_l + c and each velocity by x_dot*u_t/u_l, and multiplies L by u_e. Origins and
units are parameters, so that one compiled stepper runs in all charts. :func:`violations` runs motions at home and in a
chart, converts both to the units of home and compares: failures, numbers of steps or iterations, and errors against a
run of high order. Errors of adaptive steps are compared on average: step sizes are powers of 2^(1/4) in the unit of
time, and one such power is a factor of 16 in an error of order 16. Over 60 motions each, the logarithms of the ratios
in other units are symmetric about 0, with standard deviations of up to a factor of 18 in encounters.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

import scvi_codegen as sc

Numbers = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Kind:
    """Random systems of one kind of equations.

    Attributes:
        coordinates: their names; an array has one, ``q[N]``.
        formula: L, with ``{x}`` and ``{x_dot}`` for coordinates and velocities.
        parameters: intervals from which values are drawn, by name.
        state: initial positions and velocities, drawn by a generator for given parameters.
        span: time of a run, in which errors grow by less than 1e3.
        constraints: formulas as of L.
        rest: whether the motion may start from rest.
        degenerate: whether L is linear in the velocities: positions alone are the state.
        rotation: whether the only coordinate is the angle by which a rigid body is turned about the vertical at first;
            the vertical in the body frame does not depend on it.
    """

    coordinates: tuple[str, ...]
    formula: str
    parameters: Mapping[str, tuple[float, float]]
    state: Callable[[np.random.Generator, Mapping[str, float]], tuple[Numbers, Numbers]]
    span: float = 3.0
    h: float = 0.05
    constraints: tuple[str, ...] = ()
    rest: bool = True
    degenerate: bool = False
    rotation: bool = False

    @property
    def array(self) -> bool:
        return "[" in self.coordinates[0]


def plane(count: int) -> Callable[[np.random.Generator, Mapping[str, float]], tuple[Numbers, Numbers]]:
    return lambda rng, values: (rng.uniform(0.3, 1.2, count), rng.uniform(-0.8, 0.8, count))


def chain(rng: np.random.Generator, values: Mapping[str, float]) -> tuple[Numbers, Numbers]:
    return rng.uniform(0.3, 0.9, 6), rng.uniform(-0.5, 0.5, 6)


def rods(rng: np.random.Generator, values: Mapping[str, float]) -> tuple[Numbers, Numbers]:
    """Two rods on a pivot at (a, b), with velocities that are tangent to the constraints."""
    (alpha, beta), (u, v) = rng.uniform(-2.0, 2.0, 2), rng.uniform(-0.7, 0.7, 2)
    first = values["l"] * np.array([math.sin(alpha), -math.cos(alpha)])
    second = values["k"] * np.array([math.sin(beta), -math.cos(beta)])
    turned, further = np.array([-first[1], first[0]]) * u, np.array([-second[1], second[0]]) * v
    elbow = np.array([values["a"], values["b"]]) + first
    return np.concatenate([elbow, elbow + second]), np.concatenate([turned, turned + further])


KINDS: dict[str, Kind] = {
    "separable": Kind(
        ("x", "y"),
        "m*{x_dot}**2/2 + {y_dot}**2/2 - k*{x}**2/2 - {y}**2 - w*cos({x} - 2*{y}) - e*{x}**4/4",
        {"m": (0.5, 2.0), "k": (0.5, 2.0), "w": (0.1, 0.8), "e": (0.0, 0.5)},
        plane(2),
    ),
    "encounter": Kind(
        ("x", "y"),
        "({x_dot}**2 + {y_dot}**2)/2 + m/sqrt({x}**2 + {y}**2 + k**2)",
        {"m": (0.8, 1.2), "k": (0.05, 0.2)},
        lambda rng, values: (np.array([rng.uniform(0.8, 1.2), 0.1]), np.array([-0.1, rng.uniform(0.3, 0.6)])),
    ),
    "coupled": Kind(
        ("a", "b"),
        "{a_dot}**2 + {b_dot}**2/2 + c*{a_dot}*{b_dot}*cos({a} - {b}) + g*(2*cos({a}) + cos({b}))",
        {"c": (0.4, 0.9), "g": (1.0, 4.0)},
        plane(2),
        span=2.0,
    ),
    "rail": Kind(
        ("s", "a"),
        "m*{s_dot}**2 + {a_dot}**2/2 + {s_dot}*{a_dot}*cos({a}) + g*cos({a})",
        {"m": (1.5, 3.0), "g": (5.0, 10.0)},
        plane(2),
        span=2.0,
    ),
    "rail at equilibrium": Kind(
        ("s", "a"),
        "m*{s_dot}**2 + {a_dot}**2/2 + {s_dot}*{a_dot}*cos({a} - 1) + g*cos({a} - 1)",
        {"m": (1.5, 3.0), "g": (5.0, 10.0)},
        lambda rng, values: (np.array([0.634, 1.0 + rng.choice([0.0, 1e-12, 1e-9])]), np.array([-0.707, 0.0])),
        span=2.0,
    ),
    "hanging": Kind(
        ("a", "b"),
        "{a_dot}**2 + {b_dot}**2/2 + {a_dot}*{b_dot}*cos({a} - {b}) + g*(2*cos({a} - 1) + cos({b} - 1))",
        {"g": (1.0, 4.0)},
        lambda rng, values: (np.ones(2), np.array([rng.uniform(0.2, 0.8), 0.0])),
        span=2.0,
    ),
    "equilibrium": Kind(
        ("a", "b", "c"),
        "({a_dot}**2 + {b_dot}**2 + {c_dot}**2)/2 + k*{a_dot}*{c_dot}*cos({b}) - ({a} - {c})**2 - g*({b} - 1)**2"
        " - ({c} - 1)**4 - k*({a} - 1)**2",
        {"g": (1.0, 4.0), "k": (0.2, 0.6)},
        lambda rng, values: (np.ones(3), np.zeros(3)),
    ),
    "magnetic": Kind(
        ("x", "y"),
        "m*({x_dot}**2 + {y_dot}**2)/2 + (b + {x}/4)*({x}*{y_dot} - {y}*{x_dot})/2 - k*({x}**2 + 2*{y}**2)/2",
        {"m": (0.5, 2.0), "b": (0.5, 2.0), "k": (0.5, 2.0)},
        plane(2),
    ),
    "constrained": Kind(
        ("x", "y", "z", "w"),
        "m*({x_dot}**2 + {y_dot}**2)/2 + ({z_dot}**2 + {w_dot}**2)/2 - g*(m*{y} + {w})",
        {"m": (0.5, 2.0), "g": (1.0, 5.0), "l": (0.5, 1.5), "k": (0.5, 1.5), "a": (2.0, 3.0), "b": (2.0, 3.0)},
        rods,
        span=1.5,
        h=0.02,
        constraints=("({x} - a)**2 + ({y} - b)**2 - l**2", "({z} - {x})**2 + ({w} - {y})**2 - k**2"),
    ),
    "arrays": Kind(
        ("q[N]",),
        "sum(i in N, m*{q_dot[i]}**2/2)"
        " - sum(i in N periodic, k*({q[i+1]} - {q[i]})**2/2 + e*({q[i+1]} - {q[i]})**4/4)",
        {"m": (0.5, 2.0), "k": (0.5, 2.0), "e": (0.1, 0.5)},
        chain,
    ),
    "first order": Kind(
        ("x", "y"),
        "{x}*{y_dot} - m*{x}**2/2 - k*{y}**2/2 - w*cos({x} + {y})",
        {"m": (0.5, 2.0), "k": (0.5, 2.0), "w": (0.1, 0.4)},
        plane(2),
        rest=False,
        degenerate=True,
    ),
    "rotations": Kind(
        ("angle",),
        "u_t**2*(a*omega_1**2 + b*omega_2**2 + c*omega_3**2)/2 - w*(R_33 + R_31/3 + R_32/4)",
        {"a": (0.5, 2.0), "b": (0.5, 2.0), "c": (0.6, 2.4), "w": (0.5, 2.0)},
        lambda rng, values: (rng.uniform(0.4, 2.0, 1), rng.uniform(-1.0, 1.0, 3)),
        span=2.0,
        rotation=True,
    ),
}


@dataclass(frozen=True)
class Chart:
    """An origin and units.

    Attributes:
        origin: coordinates at the start of the run, or None for those of home; offset: those of the origin of home.
        length, time, energy: units of home in those of the chart.
        rest: whether the motion starts from rest.
        alone: whether origin and rest are of the last coordinate only.
        same_bits: whether results are equal up to the units.
    """

    origin: float | None = None
    offset: float = 0.0
    length: float = 1.0
    time: float = 1.0
    energy: float = 1.0
    rest: bool = False
    alone: bool = False
    same_bits: bool = False


CHARTS: dict[str, Chart] = {
    "start at 0": Chart(origin=0.0),
    "start at 1e-9": Chart(origin=1e-9),
    "start at 1e-12": Chart(origin=1e-12),
    "origin ten ranges away": Chart(offset=10.0),
    "powers of two": Chart(length=2.0**20, time=2.0**-13, energy=2.0**9, same_bits=True),
    "tiny powers of two": Chart(length=2.0**-30, time=2.0**17, energy=2.0**-40, same_bits=True),
    "micrometres": Chart(length=1e6),
    "megametres, days": Chart(length=1e-6, time=1e-5, energy=1e-3),
    "nanoseconds": Chart(time=1e9),
    "from rest at 0": Chart(origin=0.0, rest=True),
    "from rest at 1e-9": Chart(origin=1e-9, rest=True),
    "one coordinate at rest at 0": Chart(origin=0.0, rest=True, alone=True),
    "one coordinate at rest at 1e-9": Chart(origin=1e-9, rest=True, alone=True),
    "one coordinate at 1e-9": Chart(origin=1e-9, alone=True),
}

METHODS = ("svi:2", "svi:4", "svi:8", "gauss:3")
TYPES = ("double", "double-double")
STEPPING = ("adaptive", "round-off", "fixed")
TOLERANCE = {"double": 1e-9, "double-double": 1e-24}
"""Of adaptive steps; those to round-off have the default."""
DECREASE = {"svi:2": 2.5, "svi:4": 4.0, "svi:8": 8.0, "gauss:3": 3.0}
"""Power of the step size with which leading coefficients of curves decrease, at least."""
ROUNDED = 1e-6
"""Rounding error of a coordinate relative to its motion, above which steps are those of rounding errors."""
MOST_LONGER = 32.0
MOST_WORSE = 10.0
"""Largest ratio of errors, or their geometric mean over the motions of adaptive steps."""
LEAST_WORK = 10
"""Number of steps below which numbers are not compared."""


@dataclass(frozen=True)
class Cell:
    """Kind of equations, method, number type and stepping."""

    kind: str
    method: str
    precision: str
    stepping: str

    @cached_property
    def system(self) -> sc.LagrangianSystem:
        return charted_system(self.kind)

    @property
    def stepper(self) -> Any:
        return compiled(self.kind, self.method, self.precision)

    def is_offered(self) -> bool:
        """Return whether the combination exists and is affordable: in two words no arrays and no low orders."""
        kind = KINDS[self.kind]
        if kind.constraints and not self.method.startswith("svi"):
            return False
        return self.precision == "double" or (self.method == "svi:8" and not kind.array)


@cache
def charted_system(name: str) -> sc.LagrangianSystem:
    """Return the system of a kind with origins and units as parameters."""
    kind = KINDS[name]
    words: dict[str, str] = {}
    parameters = {parameter: low for parameter, (low, _) in kind.parameters.items()}
    parameters |= {"u_l": 1.0, "u_t": 1.0, "u_e": 1.0}
    lagrangian, constraints = kind.formula, list(kind.constraints)
    if kind.array:
        words = {"{q[i]}": "(q[i]/u_l + c_q)", "{q[i+1]}": "(q[i+1]/u_l + c_q)", "{q_dot[i]}": "(q_dot[i]*u_t/u_l)"}
        parameters["c_q"] = 0.0
    else:
        for x in kind.coordinates:
            words |= {f"{{{x}}}": f"({x}/u_l + c_{x})", f"{{{x}_dot}}": f"({x}_dot*u_t/u_l)"}
            parameters[f"c_{x}"] = 0.0
    for word, formula in words.items():
        lagrangian = lagrangian.replace(word, formula)
        constraints = [each.replace(word, formula) for each in constraints]
    unknowns: dict[str, Any] = {"coordinates": list(kind.coordinates)}
    if kind.rotation:
        unknowns = {"rotations": {"R": "omega"}}
    if constraints:
        unknowns["constraints"] = constraints
    return sc.LagrangianSystem.from_text(
        name="charted_" + name.replace(" ", "_"), lagrangian=f"u_e*({lagrangian})", parameters=parameters, **unknowns
    )


@cache
def compiled(kind: str, method: str, precision: str) -> Any:
    return sc.compile_stepper(charted_system(kind), method, precision=precision, flags=("-O1",))


@dataclass(frozen=True, eq=False)
class Motion:
    """A random motion: values of parameters, positions and velocities, in the units of home."""

    kind: str
    parameters: Mapping[str, float]
    q: Numbers
    v: Numbers

    def start(self, chart: Chart) -> tuple[dict[str, float], Numbers, Numbers]:
        """Return parameters, positions and velocities in a chart; the positions of home are q/u_l + c."""
        kind = KINDS[self.kind]
        v = np.where(np.arange(self.v.size) >= (self.v.size - 1 if chart.alone else 0), 0.0, self.v)
        v = v if chart.rest else self.v
        if kind.rotation:
            values = {**self.parameters, "u_l": 1.0, "u_t": chart.time, "u_e": chart.energy, "c_angle": 0.0}
            return values, self.q if chart.origin is None else np.full(1, chart.origin), v / chart.time
        affected = np.arange(self.q.size) >= (self.q.size - 1 if chart.alone else 0)
        shift = np.zeros_like(self.q) if chart.origin is None else np.where(affected, self.q - chart.origin, 0.0)
        shift = shift - chart.offset
        if kind.array:  # one origin for all elements
            shift = np.full_like(self.q, shift[0])
        units = {"u_l": chart.length, "u_t": chart.time, "u_e": chart.energy}
        names = ["c_q"] if kind.array else [f"c_{x}" for x in kind.coordinates]
        origins = dict(zip(names, map(float, shift[: len(names)]), strict=True))
        q = chart.length * (self.q - shift)
        return {**self.parameters, **units, **origins}, q, chart.length / chart.time * v


def motion(kind: str, seed: int) -> Motion:
    """Return a random motion of a kind."""
    rng = np.random.default_rng([seed, *kind.encode()])
    values = {name: float(rng.uniform(*interval)) for name, interval in KINDS[kind].parameters.items()}
    return Motion(kind, values, *KINDS[kind].state(rng, values))


@dataclass(frozen=True, eq=False)
class Outcome:
    """A run in a chart, in the units of home.

    Attributes:
        failure: message of the error, or None.
        q: (1, m) positions at the end, or the vertical in the body frame; p: those in the chart, divided by its unit of
            length, not shifted.
        work: number of steps with rejected ones, or of iterations of fixed steps.
    """

    failure: str | None = None
    q: Numbers = field(default_factory=lambda: np.empty(0))
    p: Numbers = field(default_factory=lambda: np.empty(0))
    work: int = 0


def run(cell: Cell, motion: Motion, chart: Chart, tolerance: float | None = None) -> Outcome:
    """Run a motion in a chart."""
    kind = KINDS[motion.kind]
    parameters, q, v = motion.start(chart)
    state: dict[str, Any] = {"q": q, "velocity": v}
    if kind.array:
        state = {"q": {"q": q}, "velocity": {"q": v}}
    elif kind.rotation:
        state = {"q": {"R": [math.cos(q[0] / 2), 0.0, 0.0, math.sin(q[0] / 2)]}, "velocity": {"omega": v}}
    elif kind.degenerate:
        state = {"q": q}
    count = 4 * round(kind.span / kind.h / 4)
    span = count * kind.h * chart.time
    steps: dict[str, Any] = {"h": kind.h * chart.time, "steps": count}
    if cell.stepping != "fixed":
        if cell.stepping == "adaptive":
            tolerance = tolerance or TOLERANCE[cell.precision]
        steps = {"t_end": span, "tolerance": tolerance, "check_growth": False}
    try:
        result = cell.stepper.integrate(**state, **steps, parameters=parameters)
    except sc.ScviCodegenError as error:
        return Outcome(failure=f"{type(error).__name__}: {error}"[:160])
    work = len(result.t) - 1 + int(result.rejected_steps)
    if cell.stepping == "fixed":
        work = int(np.sum(result.iterations))
    if kind.rotation:
        vertical = result.rotation("R")[:, 2, :]
        return Outcome(q=vertical[-1:], p=vertical[-1:], work=work)
    positions = np.asarray(result.q["q"] if kind.array else result.q, float).reshape(len(result.t), -1)[-1:]
    shift = ((q / chart.length) - motion.q)[-positions.shape[1] :]  # a system of first order has half as many
    return Outcome(q=positions / chart.length - shift, p=positions / chart.length, work=work)


@cache
def reference(kind: str, seed: int, rest: bool, alone: bool, precision: str) -> Numbers:
    """Return the positions of a motion at its end, at home, to round-off."""
    cell = Cell(kind, "svi:12" if precision == "double" else "svi:8", precision, "adaptive")
    result = run(
        cell, motion(kind, seed), Chart(rest=rest, alone=alone), {"double": 1e-14, "double-double": 1e-26}[precision]
    )
    if result.failure:
        raise AssertionError(f"no reference for {kind} {seed}: {result.failure}")
    return result.q


@cache
def at_home(cell: Cell, seed: int, rest: bool, alone: bool) -> Outcome:
    return run(cell, motion(cell.kind, seed), Chart(rest=rest, alone=alone))


def ratio_of_floors(cell: Cell, body: Motion, chart: Chart, true: Numbers, home_is_faster: bool) -> float:
    """Return by how much longer steps may be where coordinates round more: a coefficient below u |q| counts as 0.

    At most ``MOST_LONGER``, also if a motion is little more than rounding errors. Iterations of fixed steps are those
    in double, whose result is then corrected to two words.
    """
    kind, (_, q, _) = KINDS[cell.kind], body.start(chart)
    if kind.rotation:
        return 1.0
    u = 2.0**-106 if cell.precision == "double-double" and cell.stepping != "fixed" else 2.0**-53
    count = true.shape[-1]
    size = np.abs(true[0] - body.q[-count:]) + u * u
    home, other = (u * np.abs(x[-count:]) / size for x in (body.q, q / chart.length))
    if np.maximum(home, other).max() > ROUNDED:
        return MOST_LONGER
    least = {"adaptive": TOLERANCE[cell.precision], "round-off": u, "fixed": ROUNDED}[cell.stepping]
    home, other = np.maximum(home, least), np.maximum(other, least)
    ratio = float(np.max(home / other if home_is_faster else other / home))
    return min(ratio ** (1 / DECREASE[cell.method]), MOST_LONGER)


def violations(cell: Cell, chart: Chart, seeds: Iterable[int]) -> Iterator[str]:
    """Yield what runs of some motions in a chart do that the same runs at home do not.

    Steps (iterations of fixed steps) may differ by a factor of 2, errors by a factor of 10; in units that differ by
    powers of two by no bit. Few steps are not compared.
    """
    worse: list[float] = []
    for seed in seeds:
        body, home = motion(cell.kind, seed), at_home(cell, seed, chart.rest, chart.alone)
        other = run(cell, body, chart)
        if other.failure and not home.failure:
            yield f"{seed}: {other.failure}"
        if home.failure:
            yield f"{seed}: at home: {home.failure}"
        if other.failure or home.failure:
            continue
        if chart.same_bits and not (home.p == other.p).all():
            yield f"{seed}: other bits: {np.abs(home.p - other.p).max():.1e}"
        true = reference(cell.kind, seed, chart.rest, chart.alone, cell.precision)
        more, less = max(home.work, other.work), max(min(home.work, other.work), LEAST_WORK)
        factor = max(2.0, ratio_of_floors(cell, body, chart, true, home.work < other.work))
        if more > factor * less + 4:
            yield f"{seed}: work {home.work} at home, {other.work} in the chart"
        errors = [error_of(result, cell, body, true) for result in (home, other)]
        least = 1e-12 + 1e-14 * abs(chart.offset)
        worse.append(max(errors[1], least) / max(errors[0], least))
        if cell.stepping != "adaptive" and worse[-1] > MOST_WORSE:
            yield f"{seed}: error {errors[0]:.1e} at home, {errors[1]:.1e} in the chart"
    if worse and (mean := float(np.exp(np.mean(np.log(worse))))) > MOST_WORSE:
        yield f"errors in the chart are larger by {mean:.1f}, the mean of {', '.join(f'{x:.2g}' for x in worse)}"


def error_of(result: Outcome, cell: Cell, body: Motion, true: Numbers) -> float:
    """Return the error of the positions at the end relative to the displacement of the motion."""
    start = 0.0 * true if KINDS[cell.kind].rotation else body.q[None, -true.shape[1] :]
    size = max(np.ptp(np.concatenate([start, true]), axis=0).max(), 1e-3)  # of a motion that rests
    return float(np.abs(result.q - true).max() / size)


def cells() -> list[Cell]:
    every = [Cell(k, m, p, s) for k in KINDS for m in METHODS for p in TYPES for s in STEPPING]
    return [cell for cell in every if cell.is_offered()]


def charts_of(cell: Cell) -> Iterator[tuple[str, Chart]]:
    for name, chart in CHARTS.items():
        kind = KINDS[cell.kind]
        special = kind.array or kind.rotation or kind.constraints
        if (kind.rest or not chart.rest) and not (special and chart.alone) and not (kind.rotation and chart.offset):
            yield name, chart
