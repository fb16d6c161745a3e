"""Random single steps of systems and methods: the error of each compared with the estimate that its run reports.

A trial is a state and a step size, log-uniform over five decades up to three periods. Its reference is the motion by
short steps of SVI(12), kept where SVI(9) agrees; their difference, and what a change of the state by rounding makes of
the end, are the noise of the error.
"""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
from notation import lagrange
from numpy.typing import NDArray
from samples import UNOPTIMISED_FLAGS

import scvi_codegen as sc
from scvi_codegen.systems.arrays.system import ArraySystem

Array = NDArray[np.float64]
PERIODS, DECADES = 3.0, 5.0
WANTED = 100.0
"""An accepted step is wrong by at most so many times its estimate."""
FLOOR = 64 * np.finfo(float).eps
UNKNOWN = 1e-6
"""A reference that is known no better is left out."""


@dataclass(frozen=True)
class Family:
    """A system with its random states: q, velocity, t from a generator; a period sets the scale of steps."""

    system: Any
    period: float
    state: Callable[[np.random.Generator], tuple[Any, Any, float]]
    written_out: Any = None


@dataclass(frozen=True)
class Trial:
    """A step to take, where it leads, and how well that is known, both relative to the state as estimates are."""

    q: Array
    p: Array
    t: float
    h: float
    end: Array
    noise: float


@dataclass(frozen=True)
class Outcome:
    """Results of the trials of a method: estimate (NaN: none or rejected) and error of each trial."""

    refused: Array
    estimates: Array
    errors: Array

    @property
    def ratios(self) -> Array:
        """Error over estimate, of steps that were accepted."""
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios = np.where(self.errors > 0.0, self.errors / self.estimates, 0.0)
        return np.where(self.refused, 0.0, ratios)


def _normal(q: tuple[float, ...], v: tuple[float, ...], spread: float = 0.7, t: float = 0.0) -> Any:
    def state(random: np.random.Generator) -> tuple[Array, Array, float]:
        return (
            np.array(q) + spread * random.standard_normal(len(q)),
            np.array(v) + spread * random.standard_normal(len(v)),
            t + (random.uniform(0.0, 10.0) if t else 0.0),
        )

    return state


def _ellipse(random: np.random.Generator) -> tuple[Array, Array, float]:
    e, anomaly, turn = random.uniform(0.0, 0.9), random.uniform(0.0, 2 * np.pi), random.uniform(0.0, 2 * np.pi)
    c, s = np.cos(turn), np.sin(turn)
    u = 1 - e * e
    q = u / (1 + e * np.cos(anomaly)) * np.array([np.cos(anomaly), np.sin(anomaly)])
    v = np.array([-np.sin(anomaly), e + np.cos(anomaly)]) / np.sqrt(u)
    turned = np.array([[c, -s], [s, c]])
    return turned @ q, turned @ v, 0.0


def _slow(random: np.random.Generator) -> tuple[Array, Array, float]:
    return random.standard_normal(1), np.tanh(random.standard_normal(1)), 0.0


def _families() -> Mapping[str, Family]:
    text, known = sc.LagrangianSystem.from_text, lambda name: sc.problem(name).system
    chain = lagrange("chain", "x[N]", "sum(a in N, x_dot[a]**2/2 - x[a]**2/2) - sum(a in N-1, (x[a+1] - x[a])**4/4)")
    five = [f"x{k}" for k in range(5)]
    out = " + ".join(f"{x}_dot**2/2 - {x}**2/2" for x in five)
    out += "".join(f" - ({b} - {a})**4/4" for a, b in pairwise(five))

    def rows(name: str, terms: str) -> Any:
        lagrangian = f"sum(a in N, {terms})"
        return sc.LagrangianSystem.from_text(name=name, coordinates=["x[N, 2]"], lagrangian=lagrangian)

    ellipses = rows("ellipses", "(x_dot[a,0]**2 + x_dot[a,1]**2)/2 + 1/sqrt(x[a,0]**2 + x[a,1]**2)")
    pendulums = rows("pendulums", "(x_dot[a,0]**2 + x_dot[a,1]**2)/2 + cos(x[a,0]) + cos(x[a,1])")
    two = "p_dot**2/2 + q_dot**2/2 + cos(p) + cos(q)"
    driven = text(
        name="driven",
        coordinates=["x", "y"],
        lagrangian="x_dot**2/2 + m*y_dot**2/2 - x**2/2 - y**4/4 - x*y/3 + x*cos(w*t) + y*sin(t)",
        parameters={"m": 2.3, "w": 1.7},
    )
    damped = text(
        name="damped",
        coordinates=["x", "y"],
        lagrangian="(1 + x**2/4)*x_dot**2/2 + y_dot**2 - x**2 - cos(y) - x*y/2",
        forces={"x": "-x_dot/5 + sin(t)/3", "y": "-y_dot**3/10"},
    )
    return {
        "pendulum": Family(
            text(name="pendulum", coordinates=["q"], lagrangian="q_dot**2/2 + cos(q)"), 7.0, _normal((0,), (0,), 1.0)
        ),
        "duffing": Family(known("duffing"), 5.0, _normal((0.0,), (0.0,), 0.8)),
        "planar-pendulum": Family(known("planar-pendulum"), 2.0, _normal((0.0,), (0.0,), 1.2)),
        "kepler": Family(known("kepler"), 6.3, _ellipse),
        "henon-heiles": Family(known("henon-heiles"), 6.0, _normal((0, 0), (0, 0), 0.2)),
        "double-pendulum": Family(known("double-pendulum"), 2.0, _normal((0, 0), (0, 0), 0.8)),
        "cart-pole": Family(known("cart-pole"), 2.0, _normal((0, 0), (0, 0), 0.9)),
        "relativistic": Family(
            text(name="rapid", coordinates=["x"], lagrangian="-sqrt(1 - x_dot**2) - x**4/4"), 7.0, _slow
        ),
        "driven": Family(driven, 5.0, _normal((0, 0), (0, 0), 1.0, 30.0)),
        "damped": Family(damped, 5.0, _normal((0, 0), (0, 0), 0.8, 3.0)),
        "chain": Family(
            chain, 5.0, _normal((0,) * 5, (0,) * 5, 0.7), text(name="five", coordinates=five, lagrangian=out)
        ),
        "pendulums": Family(
            pendulums, 7.0, _normal((0, 0), (0, 0), 1.0), text(name="two", coordinates=["p", "q"], lagrangian=two)
        ),
        "ellipses": Family(ellipses, 6.3, _ellipse, known("kepler")),
    }


FAMILIES = _families()


@cache
def compiled(name: str, method: Any, solver: str = "auto") -> Any:
    """The stepper of a family."""
    system = FAMILIES[name].system
    solver = solver.replace("auto", "fixed-point") if isinstance(system, ArraySystem) else solver
    return sc.compile_stepper(system, method, solver=solver, flags=UNOPTIMISED_FLAGS)


def displaced(q: Array, end: Array, other: Array) -> float:
    """Return the difference of two ends of a step relative to the state, as estimates are.

    The displacement is the larger of both: a step of three periods through a kick at its start may end at 200 times the
    distance of the motion, and so do its half steps, which the estimate compares it with.
    """
    size = np.abs(q) + np.maximum(np.abs(end - q), np.abs(other - q))
    return float(np.max(np.abs(end - other) / (size + size.max() + 1e-300)))


@cache
def trials(name: str, count: int, seed: int = 1) -> list[Trial]:
    """Return random trials of a system, without those whose reference is doubtful."""
    family, random, found = FAMILIES[name], np.random.default_rng([seed, sum(map(ord, name))]), []
    system = family.written_out or family.system
    exact, other = (sc.compile_stepper(system, sc.SVI(degree)) for degree in (12, 9))
    for _ in range(count):
        q, v, t = family.state(random)
        h = PERIODS * family.period * 10.0 ** random.uniform(-DECADES, 0.0) * random.choice([-1.0, 1.0], p=[0.2, 0.8])
        p = exact.momentum(q, v, t)
        nudge = 1 + 2.0**-50 * random.choice([-1.0, 1.0], size=(2, len(q)))
        starts = [(exact, q, p, t), (other, q, p, t), (exact, q * nudge[0], p * nudge[1], t * (1 + 2.0**-50))]
        try:
            ends = [by.integrate(a, b, t=begin, t_end=t + h, save_every=10**9).q[-1] for by, a, b, begin in starts]
        except sc.StepFailedError:
            continue
        noise = FLOOR + 4 * displaced(q, ends[0], ends[1]) + 16 * displaced(q, ends[0], ends[2])
        if noise < UNKNOWN:
            found.append(Trial(q, p, t, h, ends[0], noise))
    return found


def taken(stepper: Any, trial: Trial) -> tuple[Array, float]:
    """The end of a step and its estimate."""
    if stepper.run_time_sizes:
        shape = [axis.number or 1 for axis in stepper.interface.layout.coordinates[0].axes]
        at = [np.reshape(x, [-1, *shape[1:]]) for x in (trial.q, trial.p)]
        run = stepper.integrate(*at, t=trial.t, h=trial.h, steps=1)
        return run.q["x"][-1].ravel(), run.step_error
    run = stepper.integrate(trial.q, trial.p, t=trial.t, h=trial.h, steps=1)
    return run.q[-1], run.step_error


def outcome(stepper: Any, of: list[Trial]) -> Outcome:
    """Return the results of the trials."""
    refused, estimates, errors = np.zeros(len(of), bool), np.full(len(of), np.nan), np.zeros(len(of))
    for k, trial in enumerate(of):
        with warnings.catch_warnings(action="ignore"):
            try:
                end, estimates[k] = taken(stepper, trial)
            except sc.StepFailedError:
                refused[k] = True
                continue
        error = displaced(trial.q, trial.end, end)
        errors[k] = max(error - trial.noise, 0.0) if error == error else np.inf
    return Outcome(refused, estimates, errors)
