"""Situations of runs, and the run of a motion by a scheme in a situation."""

import math
import pickle
from dataclasses import dataclass, replace
from functools import cache, cached_property
from types import SimpleNamespace
from typing import Any

import numpy as np
from samples import UNOPTIMISED_FLAGS

import scvi_codegen as sc
from scvi_codegen import SolverOptions
from tests.motions.motions import Motion, Problem, Scheme, truth_of

STEPS = 24
"""Steps of every run."""


@dataclass(frozen=True)
class Situation:
    """Circumstances of a run.

    Attributes:
        own: whether parameters and options are no defaults.
        t: initial time.
        back: whether the run goes back in time.
        save_every: steps from one saved state to the next.
        trajectories: size of ensembles: one, a pair, less than a block of SIMD lanes, several blocks and one more.
    """

    own: bool
    t: float
    back: bool
    save_every: int
    trajectories: int


SITUATIONS = {
    "defaults": Situation(own=False, t=0.0, back=False, save_every=1, trajectories=1),
    "own": Situation(own=True, t=1.3, back=False, save_every=1, trajectories=7),
    "back": Situation(own=True, t=-0.7, back=True, save_every=1, trajectories=2),
    "sparse": Situation(own=True, t=2.1, back=False, save_every=3, trajectories=33),
}


@cache
def stepper_by(problem: Problem, number: int) -> Any:
    """Compile a problem with the scheme of a number in its table."""
    return _compiled(problem, problem.methods[number])


@cache
def accurate_stepper(problem: Problem, degree: int) -> Any:
    """Compile a problem with an SVI of high degree in two words."""
    return _compiled(problem, Scheme(f"svi:{degree}", "auto", 0.0, "double-double"))


def _compiled(problem: Problem, scheme: Scheme) -> Any:
    name = scheme.method
    method = sc.methods.method_from_specification(name) if isinstance(name, dict) else name
    options: dict[str, Any] = {"solver": scheme.solver, "precision": scheme.precision, "flags": UNOPTIMISED_FLAGS}
    if problem.kind == "reversible":
        options["time_transformation"] = problem.time_transformation
    return sc.compile_stepper(problem.system(), method, **options)


@dataclass(frozen=True)
class Case:
    """A problem, a method and a situation, with the run that they make."""

    problem: Problem
    method: int
    situation: str

    @property
    def setting(self) -> Situation:
        situation = SITUATIONS[self.situation]
        return replace(situation, t=situation.t * self.problem.time)

    @property
    def kind(self) -> str:
        return self.problem.kind

    @property
    def scheme(self) -> Scheme:
        return self.problem.methods[self.method]

    @property
    def error(self) -> float:
        return self.scheme.error

    @property
    def two_words(self) -> bool:
        return self.scheme.precision == "double-double"

    @property
    def stepper(self) -> Any:
        return stepper_by(self.problem, self.method)

    @property
    def h(self) -> float:
        backward = self.setting.back and self.kind != "reversible"
        return -self.problem.h if backward else self.problem.h

    @property
    def span(self) -> float:
        return -STEPS * self.problem.h if self.setting.back else STEPS * self.problem.h

    @property
    def options(self) -> SolverOptions | None:
        """Options that are not the defaults, if the parameters are not; too few iterations where they are to fail."""
        if self.problem.falls_back:
            return SolverOptions(max_iterations=12)
        return SolverOptions(max_iterations=60) if self.setting.own else None

    @property
    def values(self) -> dict[str, float]:
        """All parameters by name, as text has them."""
        return self.problem.values(self.setting.own)

    def parameters(self, values: dict[str, float] | None = None) -> dict[str, Any]:
        """Return the parameters as the package accepts them: arrays by name."""
        parameters: dict[str, Any] = dict(values or self.values)
        for name, array in self.problem.fields.items():
            parameters[name] = np.array([parameters.pop(f"{name}{i}") for i in range(len(array))])
        return parameters

    def moving(self, x: Any = None) -> dict[str, Any]:
        x = self.problem.x if x is None else x
        return {"p" if "hamiltonian" in self.problem.text else "velocity": np.asanyarray(x)}

    def motion(self, values: dict[str, float] | None = None, start: float | None = None, state: Any = None) -> Motion:
        """Integrate from a state at a time, twice as far as the run."""
        begin = self.setting.t if start is None else start
        q, x = state or (self.problem.q, self.problem.x)
        reach = begin + 2.0 * self.span
        return truth_of(self.problem).motion(begin, reach, q, x, values or self.values)

    def motion_to(self, steps: int) -> Motion:
        """Over so many steps."""
        problem, end = self.problem, self.setting.t + steps * self.h
        return truth_of(problem).motion(self.setting.t, end, problem.q, problem.x, self.values)

    @cached_property
    def truth(self) -> Motion:
        return self.motion()

    def common(self, **more: Any) -> dict[str, Any]:
        """Arguments of every run."""
        return {"t": self.setting.t, "parameters": self.parameters(), "options": self.options, **more}

    def integrate(self, stepper: Any = None, q: Any = None, x: Any = None, **more: Any) -> Any:
        """The run, with what else is wanted; that of an array with its states as rows."""
        stepper, save_every = stepper or self.stepper, more.pop("save_every", self.setting.save_every)
        arguments = {**self.common(save_every=save_every), **self.moving(x), **more}
        q = np.asanyarray(self.problem.q if q is None else q)
        if "t_eval" in more:
            del arguments["save_every"]
        if "t_end" not in more and self.kind == "reversible":
            arguments["t_end"] = self.setting.t + self.span
        if "h" not in more and ("t_end" not in more or self.kind in ("reversible", "slowed")):
            arguments["h"] = self.h
        if "t_end" not in arguments:
            arguments.setdefault("steps", STEPS)
        if self.kind == "driven":
            span = max(abs(arguments.get("steps", STEPS) * self.problem.h), 2.0 * abs(self.span))
            data = self.problem.data(self.setting.t, self.setting.t + math.copysign(span, self.span))
            return stepper.integrate(q, inputs=data, **arguments)
        trajectory = stepper.integrate(q, **arguments)
        return as_rows(trajectory) if self.kind == "array" else trajectory

    @cached_property
    def run(self) -> Any:
        return self.integrate()

    def start(self, **more: Any) -> Any:
        """A run to be advanced."""
        plan = {"t_end": self.setting.t + self.span} if self.kind == "reversible" else {}
        return self.stepper.start(np.array(self.problem.q), **self.moving(), **self.common(h=self.h, **plan, **more))

    def start_adaptive(self, **plan: Any) -> Any:
        """A run by adaptive steps to be advanced."""
        return self.stepper.start(np.array(self.problem.q), **self.moving(), **self.common(**plan))

    def from_checkpoint(self, run: Any, saved: bytes) -> Any:
        """The run again, in a stepper that was pickled."""
        stepper = pickle.loads(pickle.dumps(self.stepper))
        if self.kind == "array":
            return stepper.from_checkpoint(saved, options=self.options)
        plan = {"t_end": self.setting.t + self.span, "h": self.h} if self.kind == "reversible" else {}
        return stepper.from_checkpoint(saved, parameters=run.parameters, options=self.options, **plan)


def as_rows(trajectory: Any) -> SimpleNamespace:
    """The trajectory of an array as those of coordinates are: states are rows."""
    flat = lambda arrays: arrays["q"].reshape(len(trajectory.t), -1)  # noqa: E731
    return SimpleNamespace(
        t=trajectory.t,
        q=flat(trajectory.q),
        p=flat(trajectory.p),
        velocity=flat(trajectory.velocity),
        energy=trajectory.energy,
        momentum_maps=trajectory.momentum_maps,
        steps=trajectory.steps,
        step_error=trajectory.step_error,
        worst_step_time=trajectory.worst_step_time,
        at=lambda t: tuple(arrays["q"].reshape(len(t), -1) for arrays in trajectory.at(t)),
        events=[
            SimpleNamespace(t=e.t, q=e.q["q"].reshape(len(e), -1), p=e.p["q"].reshape(len(e), -1))
            for e in trajectory.events
        ],
    )
