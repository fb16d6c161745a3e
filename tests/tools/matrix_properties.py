"""Properties of the matrix: what each quantity of a run has to be, by code that shares nothing with what is checked.

States are compared with :class:`matrix_systems.Truth`, quantities with its formulas at the true states, derivatives
with difference quotients of whole runs, and what a run is after an interruption with the run that had none, bit by bit.
"""

import math
import pickle
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from functools import cache, cached_property
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matrix_systems import LOW, STOP, Motion, Problem, truth_of
from samples import UNOPTIMISED_FLAGS
from scipy.optimize import brentq

import scvi_codegen as sc
from scvi_codegen import SolverOptions, StateError, StepFailedError, load_run, record_run, resume_run
from scvi_codegen.interfaces.frameworks.flow import FlowOfRows
from scvi_codegen.runs.derivatives import gradients
from scvi_codegen.runs.stepping import chunks, memory

STEPS = 24

SITUATIONS: dict[str, SimpleNamespace] = {
    "defaults": SimpleNamespace(own=False, t=0.0, back=False, save_every=1),
    "own": SimpleNamespace(own=True, t=1.3, back=False, save_every=1),
    "back": SimpleNamespace(own=True, t=-0.7, back=True, save_every=1),
    "sparse": SimpleNamespace(own=True, t=2.1, back=False, save_every=3),
}


@cache
def _stepper(problem: Problem, method: int) -> Any:
    name, solver, _ = problem.methods[method]
    made = sc.methods.method_from_specification(name) if isinstance(name, dict) else name
    if problem.kind == "array":
        return sc.compile_stepper(problem.system(), made, solver=solver, flags=UNOPTIMISED_FLAGS)
    time_transformation = {"time_transformation": problem.time_transformation} if problem.kind == "reversible" else {}
    return sc.compile_stepper(problem.system(), made, solver=solver, flags=UNOPTIMISED_FLAGS, **time_transformation)


@dataclass(frozen=True)
class Case:
    """A problem, a method and a situation, with the run that they make."""

    problem: Problem
    method: int
    situation: str

    @property
    def given(self) -> SimpleNamespace:
        return SITUATIONS[self.situation]

    @property
    def kind(self) -> str:
        return self.problem.kind

    @property
    def error(self) -> float:
        return self.problem.methods[self.method][2]

    @property
    def stepper(self) -> Any:
        return _stepper(self.problem, self.method)

    @property
    def h(self) -> float:
        backward = self.given.back and self.kind != "reversible"
        return -self.problem.h if backward else self.problem.h

    @property
    def span(self) -> float:
        return -STEPS * self.problem.h if self.given.back else STEPS * self.problem.h

    @property
    def options(self) -> SolverOptions | None:
        """Options that are not the defaults, if the parameters are not; too few iterations where they are to fail."""
        if self.problem.falls_back:
            return SolverOptions(max_iterations=12)
        return SolverOptions(max_iterations=60) if self.given.own else None

    @property
    def values(self) -> dict[str, float]:
        """All parameters by name, as text has them."""
        return self.problem.values(self.given.own)

    def parameters(self, values: dict[str, float] | None = None) -> dict[str, Any]:
        """Return the parameters as the package accepts them: arrays by name."""
        known = dict(values or self.values)
        for name, array in self.problem.fields.items():
            known[name] = np.array([known.pop(f"{name}{i}") for i in range(len(array))])
        return known

    def moving(self, x: Any = None) -> dict[str, Any]:
        x = self.problem.x if x is None else x
        return {"p" if "hamiltonian" in self.problem.text else "velocity": np.array(x)}

    def motion(self, values: dict[str, float] | None = None, start: float | None = None, state: Any = None) -> Motion:
        """Integrate from a state at a time, twice as far as the run."""
        begin = self.given.t if start is None else start
        q, x = state or (self.problem.q, self.problem.x)
        reach = begin + 2.0 * self.span
        return truth_of(self.problem).motion(begin, reach, q, x, values or self.values)

    def motion_to(self, steps: int) -> Motion:
        """Over so many steps."""
        problem, end = self.problem, self.given.t + steps * self.h
        return truth_of(problem).motion(self.given.t, end, problem.q, problem.x, self.values)

    @cached_property
    def truth(self) -> Motion:
        return self.motion()

    def common(self, **more: Any) -> dict[str, Any]:
        """Arguments of every run."""
        return {"t": self.given.t, "parameters": self.parameters(), "options": self.options, **more}

    def integrate(self, stepper: Any = None, q: Any = None, x: Any = None, **more: Any) -> Any:
        """The run, with what else is wanted; that of an array with its states as rows."""
        stepper, save_every = stepper or self.stepper, more.pop("save_every", self.given.save_every)
        given = {**self.common(save_every=save_every), **self.moving(x), **more}
        q = np.array(self.problem.q if q is None else q)
        if "t_eval" in more:
            del given["save_every"]
        if "t_end" not in more and self.kind == "reversible":
            given["t_end"] = self.given.t + self.span
        if "h" not in more and ("t_end" not in more or self.kind in ("reversible", "slowed")):
            given["h"] = self.h
        if "t_end" not in given:
            given.setdefault("steps", STEPS)
        if self.kind == "driven":
            span = max(abs(given.get("steps", STEPS) * self.problem.h), 2.0 * abs(self.span))
            data = self.problem.data(self.given.t, self.given.t + math.copysign(span, self.span))
            return stepper.integrate(q, inputs=data, **given)
        found = stepper.integrate(q, **given)
        return as_rows(found) if self.kind == "array" else found

    @cached_property
    def run(self) -> Any:
        return self.integrate()

    def start(self, **more: Any) -> Any:
        """A run to be advanced."""
        plan = {"t_end": self.given.t + self.span} if self.kind == "reversible" else {}
        return self.stepper.start(np.array(self.problem.q), **self.moving(), **self.common(h=self.h, **plan, **more))

    def from_checkpoint(self, run: Any, saved: bytes) -> Any:
        """The run again, in a stepper that was pickled."""
        stepper = pickle.loads(pickle.dumps(self.stepper))
        if self.kind == "array":
            return stepper.from_checkpoint(saved, options=self.options)
        plan = {"t_end": self.given.t + self.span, "h": self.h} if self.kind == "reversible" else {}
        return stepper.from_checkpoint(saved, parameters=run.parameters, options=self.options, **plan)


def as_rows(found: Any) -> SimpleNamespace:
    """The trajectory of an array as those of coordinates are: states are rows."""
    flat = lambda arrays: arrays["q"].reshape(len(found.t), -1)  # noqa: E731
    return SimpleNamespace(
        t=found.t,
        q=flat(found.q),
        p=flat(found.p),
        velocity=flat(found.velocity),
        energy=found.energy,
        momentum_maps=found.momentum_maps,
        steps=found.steps,
        step_error=found.step_error,
        worst_step_time=found.worst_step_time,
        at=lambda t: tuple(each["q"].reshape(len(t), -1) for each in found.at(t)),
        events=[
            SimpleNamespace(t=e.t, q=e.q["q"].reshape(len(e), -1), p=e.p["q"].reshape(len(e), -1)) for e in found.events
        ],
    )


def near(found: Any, wanted: Any, error: float) -> None:
    """Raise where a number differs by more than the error, relative to the largest of its column or to 1."""
    found, wanted = np.asarray(found), np.asarray(wanted)
    assert found.shape == wanted.shape, (found.shape, wanted.shape)
    assert np.isfinite(found).all()
    sizes = np.maximum(1.0, np.abs(wanted).max(axis=0, initial=0.0))
    assert (np.abs(found - wanted) / sizes).max(initial=0.0) <= error, (np.abs(found - wanted) / sizes).max()


def states(case: Case) -> None:
    """Times, positions and momenta."""
    run, given = case.run, case.given
    near(run.q, case.truth.q(run.t), case.error)
    near(run.p, case.truth.p(run.t), case.error)
    if case.kind in ("plain", "array"):
        count = STEPS // given.save_every + 1
        assert run.t.tolist() == [
            float(Fraction(given.t) + k * given.save_every * Fraction(case.h)) for k in range(count)
        ]
        if case.problem.falls_back:
            assert run.fallback_steps > 0, "fixed-point iterations should have failed"
    elif case.kind == "slowed":
        q = case.truth.q(np.linspace(given.t, run.t[-1], 4001))
        tau = np.trapezoid(1.0 / np.linalg.norm(q, axis=1), dx=(run.t[-1] - given.t) / 4000)
        assert abs(tau - run.tau[-1]) < 1e-6
    else:
        assert abs(run.t[-1] - (given.t + case.span)) < 1e-15 * abs(run.t[-1])


def formulas(case: Case) -> None:
    """Velocities, energies and momentum maps of states; once more by functions of single states."""
    run, truth, t = case.run, case.truth, case.run.t
    near(run.velocity, truth.v(t), 10 * case.error)
    near(run.energy(), truth.energy(t), 10 * case.error)
    maps = run.momentum_maps()
    assert maps.shape[1] == len(case.problem.maps)
    near(maps, truth.maps(t), 10 * case.error)
    if case.kind in ("array", "driven"):
        return
    q, p, at, values = run.q[-1], run.p[-1], float(t[-1]), run.parameters
    assert case.stepper.energy(q, p, at, values) == run.energy()[-1]
    near(case.stepper.momentum(q, run.velocity[-1], at, values), p, 1e-12)
    near(case.stepper.velocity(q, p, at, values), run.velocity[-1], 1e-12)
    near(case.stepper.momentum_maps(q, p, at, values), maps[-1], 1e-12)
    assert np.abs(run.momentum_errors()).max(initial=0.0) < 10 * case.error


def tables(case: Case) -> None:
    """Columns of data frames, of files and of data sets."""
    run, truth, m = case.run, case.truth, len(case.problem.q)
    table, data = run.to_dataframe(), run.to_xarray()
    assert np.array_equal(table.index, run.t)
    assert np.array_equal(table.iloc[:, : 2 * m], np.hstack([run.q, run.p]))
    columns = ["iterations", *(f"{name}_dot" for name in case.problem.coordinates), "energy"]
    assert [*table.columns][2 * m :] == columns
    near(table[columns[1:-1]].to_numpy(), truth.v(run.t), 10 * case.error)
    near(table["energy"].to_numpy(), truth.energy(run.t), 10 * case.error)
    for name in ("q", "p", "velocity"):
        assert np.array_equal(data[name].values, getattr(run, name))
    assert np.array_equal(data["energy"].values, run.energy())
    with tempfile.TemporaryDirectory() as folder:
        run.save(f"{folder}/run.csv")
        header, lines = Path(folder, "run.csv").read_text().split("\n", 1)
    assert header.split(",") == ["t", *table.columns]
    assert np.array_equal(np.loadtxt(lines.splitlines(), delimiter=","), table.reset_index().to_numpy())


def slices(case: Case) -> None:
    """Parts of a trajectory, by rows."""
    run = case.run
    for rows in (slice(2, None), slice(None, 5), slice(1, -1, 2), slice(3, 4)):
        part = run[rows]
        for name in ("t", "q", "p"):
            assert np.array_equal(getattr(part, name), getattr(run, name)[rows])
        assert np.array_equal(part.energy(), run.energy()[rows])
        between = (part.t[0] + part.t[-1]) / 2
        near(part.at(between)[0], case.truth.q(between)[0], case.error)
        assert part.tau is None or np.array_equal(part.tau, run.tau[rows])
    for k in (0, 3, -1):
        t, q, p = run[k]
        assert (t, *q, *p) == (run.t[k], *run.q[k], *run.p[k])
    assert len(list(run)) == len(run)
    for rows in (len(run), slice(4, 4), slice(None, None, -1)):
        with pytest.raises(IndexError, match=r"out of range|must be ascending"):
            run[rows]
    for name in case.problem.coordinates:
        assert np.array_equal(run[f"p_{name}"], run.p[:, case.problem.coordinates.index(name)])
    with pytest.raises(StateError, match="there is no quantity 'none_such' of the states"):
        run["none_such"]


def work_and_impulses(case: Case) -> None:
    """Work and impulses of the forces."""
    run = case.run
    wanted = case.truth.work_and_impulses(run.t)
    near(run.work(), wanted[:, 0], 1e-6)
    near(run.impulses(), wanted[:, 1:], 1e-6)
    for xi, impulse in zip(case.problem.impulses, run.impulses().T, strict=True):
        values = dict(zip(case.problem.coordinates, run.q.T, strict=True))
        J = sum(p * eval(formula, {}, values) for p, formula in zip(run.p.T, xi, strict=True))
        near(J - J[0], impulse, 1e-12)


def between(case: Case) -> None:
    """Dense output, by ``states`` between the saved states and by ``t_eval``."""
    run = case.run
    low, high = sorted((run.t[0], run.t[-1]))
    times = np.random.default_rng(1).uniform(low, high, 7)
    q, p = run.at(times)
    near(q, case.truth.q(times), case.error)
    near(p, case.truth.p(times), case.error)
    q, p = run.at(run.t)
    assert np.array_equal(q, run.q)
    assert np.array_equal(p, run.p)
    if case.kind in ("array", "driven"):
        return
    times = np.sort(times)[:: -1 if case.given.back else 1]
    plan = {"t_end": float(run.t[-1])} if case.kind in ("slowed", "reversible") else {}
    saved_states = case.integrate(t_eval=times, **plan)
    assert saved_states.t.tolist() == times.tolist()
    near(saved_states.q, case.truth.q(times), case.error)
    near(saved_states.energy(), case.truth.energy(times), 10 * case.error)


def _as_array(case: Case, text: str) -> str:
    """Return a function of q0, q1, .. as a function of q[0], q[1]."""
    import re

    return re.sub(r"\bq(\d)\b", r"q[\1]", text) if case.kind == "array" else text


def events(case: Case) -> None:
    """Times and states of crossings; a terminal event, and the state of the run after it."""
    far = 3 if case.given.back else 10  # back in time friction makes motions grow
    steps, end = far * STEPS, case.given.t + far * case.span
    plan = {"t_end": end} if case.kind == "reversible" else {"steps": steps, "h": case.h}
    motion = truth_of(case.problem).motion(case.given.t, end, case.problem.q, case.problem.x, case.values)
    grid = np.linspace(case.given.t, end, (16 if case.problem.falls_back else 4) * steps)
    g = motion.event(grid)
    crossed = np.flatnonzero(np.sign(g[1:]) != np.sign(g[:-1]))
    wanted = np.array([brentq(lambda s: motion.event(s)[0], grid[k], grid[k + 1], xtol=1e-14) for k in crossed])
    assert len(wanted) >= 1, "this event should happen"
    text, error = _as_array(case, case.problem.event), 30 * case.error
    run = case.integrate(events=text, **plan)
    (found,) = run.events
    near(found.t, wanted, error)
    near(found.q, motion.q(wanted), error)
    near(found.p, motion.p(wanted), error)
    for number in range(1, min(len(wanted), 3) + 1):
        ended = case.integrate(events=sc.Event(text, terminal=number), **plan)
        assert ended.t[-1] == ended.events[0].t[-1] == found.t[number - 1]
        assert np.array_equal(ended.q[-1], found.q[number - 1])
    rising = case.integrate(events=sc.Event(text, direction=1), **plan).events[0]
    assert rising.t.tolist() == [t for t, k in zip(found.t, crossed, strict=True) if g[k + 1] > g[k]]


def failure(case: Case) -> None:
    """Return number and time of a step that fails far beyond the first chunk, and the preceding states."""
    steps, h = 700, case.h / 100
    values = {**case.values, STOP: case.given.t + 512.5 * h}
    parameters = case.parameters(values)
    with pytest.raises(StepFailedError) as error:
        case.integrate(parameters=parameters, steps=steps, h=h)
    failed, saved_states = error.value, error.value.trajectory
    assert failed.status == "not finite"
    last = float(Fraction(case.given.t) + 512 * Fraction(h))
    assert (failed.step, failed.t) == (512, last)
    saved_states = as_rows(saved_states) if case.kind == "array" else saved_states
    assert len(saved_states.t) == 512 // case.given.save_every + 1
    motion = truth_of(case.problem).motion(case.given.t, last, case.problem.q, case.problem.x, values)
    near(saved_states.q, motion.q(saved_states.t), 1e-6)
    if case.kind != "array":
        others = [{**parameters, STOP: case.given.t + (k + 0.5) * h} for k in (3, 300, 10**6)]
        ensemble_run = ensemble_of(case, others, steps=steps, h=h)
        assert ensemble_run.steps.tolist() == [3, 300, steps]
        assert ensemble_run.status.tolist() == ["not finite", "not finite", "ok"]


def ensemble_of(case: Case, parameters: list[dict[str, Any]], **more: Any) -> Any:
    """A trajectory for each set of parameters, each from a state of its own."""
    count = len(parameters)
    each = {name: np.array([own[name] for own in parameters]) for name in parameters[0]}
    shifts = (
        1e-2 * np.arange(count)[:, np.newaxis] if not case.problem.text.get("constraints") else np.zeros((count, 1))
    )
    q = np.array(case.problem.q) + shifts
    moving = {name: np.tile(values, (count, 1)) for name, values in case.moving().items()}
    call, given = case.stepper.integrate_ensemble, {**case.common(), **moving, "parameters": each, **more}
    if case.kind == "driven":
        data = case.problem.data(case.given.t, case.given.t + 2 * case.span)
        call, given["inputs"] = case.stepper.integrate_ensemble, data
    return call(q, **given)


def _others(case: Case, count: int) -> list[dict[str, float]]:
    """Sets of parameters, no two the same."""
    names = [name for name in case.values if name != STOP]
    return [{**case.values, **{name: case.values[name] * (1 + 0.01 * j) for name in names}} for j in range(count)]


def ensembles(case: Case) -> None:
    """States, energies and maps of trajectories of several parameters and starts, by common steps and by their own."""
    others = _others(case, 10)
    plans = case.given.t + case.span * (1.0 + 0.02 * np.arange(10))
    ways: list[dict[str, Any]] = [{"h": case.h, "steps": STEPS}]
    if case.kind in ("plain", "driven") and _estimates_errors(case):
        ways.append({"t_end": plans, "tolerance": 1e-11})
    for way in ways:
        found = ensemble_of(case, others, save_every=case.given.save_every, **way)
        assert found.ok.all()
        energies, maps = found.energy(), found.momentum_maps()
        data = found.to_xarray() if case.kind != "slowed" and "t_end" not in way else None
        for j in (0, 3, 9):
            rows = np.flatnonzero(np.isfinite(found.q[:, j, 0]))
            t = found.t if found.times is None else found.times[rows, j]
            q0 = found.q[0, j]
            motion = case.motion(others[j], state=(tuple(q0), case.problem.x))
            near(found.q[rows, j], motion.q(t), 10 * case.error)
            near(found.p[rows, j], motion.p(t), 10 * case.error)
            near(energies[rows, j], motion.energy(t), 30 * case.error)
            if data is not None:
                near(data["velocity"].values[rows, j], motion.v(t), 30 * case.error)
                assert np.array_equal(data["energy"].values[rows, j], energies[rows, j])
            near(maps[rows, j], motion.maps(t), 30 * case.error)
            if case.kind != "slowed" and "t_end" not in way:
                assert t[0] == case.given.t


def recording(case: Case) -> None:
    """A run in a folder, in several files, interrupted and gone on with: bit for bit that in memory."""
    whole = case.integrate()
    with tempfile.TemporaryDirectory() as folder:
        looks = iter([False, True])
        steps = {} if case.kind == "reversible" else {"steps": STEPS}
        begun = record_run(
            case.start(),
            f"{folder}/a",
            **steps,
            save_every=case.given.save_every,
            rows=5,
            checkpoint_steps=4,
            stop=lambda: next(looks, True),
        )
        assert not begun.finished
        found = resume_run(f"{folder}/a")
        assert found.finished
        for name in ("t", "q", "p", "iterations"):
            assert np.array_equal(np.asarray(getattr(found, name)), getattr(whole, name)), name
        near(np.asarray(found.energy()), whole.energy(), 1e-14)
        assert len(list(Path(folder, "a").glob("states-*"))) >= len(whole) // 5
        part = load_run(f"{folder}/a")[2:7]
        assert np.array_equal(part.parameters, whole.parameters)
        near(part.energy(), case.truth.energy(part.t), 10 * case.error)


def restarts(case: Case) -> None:
    """A run saved in the middle, in pieces of several calls of C, is bit for bit the one that had none."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(memory, "STEPS_PER_CALL", 3)
        whole, first = case.start(), case.start()
        whole.advance(20)
        for steps in (1, 7, 3):
            first.advance(steps)
        again = case.from_checkpoint(first, first.checkpoint())
        assert low_words(again) == low_words(first)
        again.advance(9)
        assert low_words(again) == low_words(whole)
        assert any(low_words(whole)[4])
    if case.kind != "array":
        copy = pickle.loads(pickle.dumps(first))
        for other in (copy, again):
            assert other.options == first.options
            assert np.array_equal(other.parameters, first.parameters)
        copy.advance(9)
        assert low_words(copy) == low_words(whole)


def low_words(run: Any) -> tuple[Any, ...]:
    """Time and state of a run with what rounding cut off them."""
    flat = lambda x: next(iter(x.values())).ravel().tolist() if isinstance(x, dict) else np.asarray(x).tolist()  # noqa: E731
    inner = run._run if hasattr(run, "_run") else run._memory
    return run.steps, run.t, inner.t_low, flat(run.q), [y for x in run._compensation for y in flat(x)], flat(run.p)


def changes(case: Case) -> None:
    """Other parameters, and another step, in the middle of a run."""
    run, others = case.start(), _others(case, 4)[3]
    run.advance(10)
    first = case.truth
    t, state = run.t, (tuple(first.q(run.t)[0]), tuple(first.p(run.t)[0]))
    run.update(parameters=case.parameters(others), h=0.5 * case.h)
    run.advance(12)
    truth = truth_of(case.problem)
    x = _velocity_of(case, truth, t, state, others)
    then = truth.motion(t, t + case.span, state[0], x, others)
    q, p = (each["q"] if case.kind == "array" else each for each in (run.q, run.p))
    assert abs(run.t - (case.given.t + 16 * case.h)) < 1e-14
    near(q, then.q(run.t)[0], 10 * case.error)
    near(p, then.p(run.t)[0], 10 * case.error)
    energy = run.energy if case.kind == "array" else case.stepper.energy(q, p, run.t, run.parameters)
    near(energy, then.energy(run.t)[0], 30 * case.error)


def _velocity_of(case: Case, truth: Any, t: float, state: Any, values: dict[str, float]) -> Any:
    """Momenta stay where parameters change: the velocities, or momenta, that a motion goes on with."""
    if "hamiltonian" in case.problem.text:
        return state[1]
    v = np.zeros(truth.m)
    for _ in range(2):  # momenta are affine in velocities
        given = (t, state[0], v, list(values.values()), truth._inputs(t))
        derivative = truth._block(*given)[: truth.m, : truth.m]
        v = v + np.linalg.solve(derivative, np.array(state[1]) - truth._p(*given).ravel())
    return tuple(v)


def controlled(case: Case) -> None:
    """Adaptive steps: ends, dense output, and the estimate of the worst step."""
    end = case.given.t + case.span
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(chunks, "CALL_SECONDS", 1e-9)
        run = case.integrate(t_end=end, tolerance=1e-11)
    assert run.t[-1] == end
    near(run.q, case.truth.q(run.t), 1e-8)
    near(run.p, case.truth.p(run.t), 1e-8)
    near(run.energy(), case.truth.energy(run.t), 1e-7)
    times = np.linspace(*run.t[[0, -1]], 5)[1:-1]
    q, p = run.at(times)
    near(q, case.truth.q(times), 1e-8)
    near(p, case.truth.p(times), 1e-8)
    assert 0.0 < run.step_error < 1e-9
    assert min(case.given.t, end) <= run.worst_step_time <= max(case.given.t, end)
    if case.given.save_every == 1:
        assert run.worst_step_time in run.t


def _differences(case: Case, names: list[str], width: float) -> dict[str, np.ndarray]:
    """Return the (n, 2m) differences of all states of a run by its initial data."""

    def ends(name: str, change: float) -> np.ndarray:
        q, p, t, h = base.q[0].copy(), base.p[0].copy(), case.given.t, base.h
        values = case.parameters()
        kind, _, which = name.partition(" ")
        if kind == "q":
            q[int(which)] += change
        elif kind == "p":
            p[int(which)] += change
        elif kind == "t":
            t += change
        elif kind == "h":
            h += change
        else:
            values[which] += change
        run = case.stepper.integrate(
            q, p, h=h, t=t, steps=steps, save_every=case.given.save_every, parameters=values, options=case.options
        )
        return np.concatenate([run.q, run.p], axis=1)

    steps, base = SHORT, case.integrate(steps=SHORT)
    found = {}
    for name in names:
        one, two = ((ends(name, k * width) - ends(name, -k * width)) / (2 * k * width) for k in (1, 2))
        found[name] = (4 * one - two) / 3
    return found


SHORT = 9


def derivatives(case: Case) -> None:
    """Sensitivities, tangents and pullbacks of a run in several segments, compared with difference quotients of it."""
    m = len(case.problem.q)
    names = [f"{k} {i}" for k in "qp" for i in range(m)]
    names += [f"parameter {name}" for name in case.values if name != STOP] + ["t", "h"]
    wanted, run = _differences(case, names, 3e-5 if case.problem.falls_back else 3e-4), case.integrate(steps=SHORT)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gradients, "MOST_STEPS", 4)
        found, tangent = run.sensitivity(), run.tangent()
        seeds = np.random.default_rng(2).normal(size=(len(run), 2 * m))
        pulled = run.pullback(seeds)
    columns = {f"{'qp'[i // m]} {i % m}": found.state[:, :, i] for i in range(2 * m)}
    columns |= {f"parameter {name}": found.parameters[:, :, i] for i, name in enumerate(case.stepper.parameters)}
    columns |= {"t": found.t, "h": found.h}
    partials = {f"{'qp'[i // m]} {i % m}": [*pulled.q, *pulled.p][i] for i in range(2 * m)}
    partials |= {f"parameter {name}": pulled.parameters[i] for i, name in enumerate(case.stepper.parameters)}
    partials |= {"t": pulled.t, "h": pulled.h}
    near(tangent, found.state, 1e-13)
    for name in names:
        near(columns[name], wanted[name], 1e-7)
        near(partials[name], np.sum(seeds * wanted[name]), 1e-6)
    one = case.stepper.sensitivity(run.q[0], run.p[0], case.h, case.given.t, case.parameters(), options=case.options)
    if case.given.save_every == 1:
        near(one.state, found.state[1], 1e-11)
        near(one.parameters, found.parameters[1], 1e-11)


def hessians(case: Case) -> None:
    """Products with the Hessian compared with difference quotients of pullbacks."""
    m, width = len(case.problem.q), 1e-3
    seeds = np.random.default_rng(3).normal(size=(SHORT // case.given.save_every + 1, 2 * m))
    direction = np.random.default_rng(4).normal(size=2 * m)
    run = case.integrate(steps=SHORT)
    found = run.hessian_product(seeds, direction)

    def pulled(change: float) -> np.ndarray:
        q, p = np.split(np.concatenate([run.q[0], run.p[0]]) + change * direction, 2)
        other = case.stepper.integrate(q, p, **case.common(h=case.h, steps=SHORT, save_every=case.given.save_every))
        gradient = other.pullback(seeds)
        return np.concatenate([gradient.q, gradient.p, gradient.parameters, [gradient.t, gradient.h]])

    one, two = ((pulled(k * width) - pulled(-k * width)) / (2 * k * width) for k in (1, 2))
    near(np.concatenate([found.q, found.p, found.parameters, [found.t, found.h]]), (4 * one - two) / 3, 1e-6)


def flows(case: Case) -> None:
    """The flow of frameworks over several pieces of 64 steps, its push and its pull."""
    steps, save_every = 150, 10
    flow = FlowOfRows(case.stepper, steps=steps, save_every=save_every)
    run = case.integrate(steps=steps, save_every=save_every, h=case.h)
    m, binding = len(case.problem.q), flow.library
    row = np.array([*run.q[0], *run.p[0], *run.parameters, case.given.t, case.h])
    near_by = 1.0 if case.problem.text.get("constraints") else 1.001  # other states violate the constraints
    x = np.array([near_by * row, row])  # the second of two rows is what is compared
    saved_states, given = steps // save_every + 1, len(row)
    change, partials = (
        np.random.default_rng(5).normal(size=(2, given)),
        np.random.default_rng(6).normal(size=(2, saved_states, 2 * m)),
    )

    def call(part: int, count: int, what: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
        found, report = np.empty((2, *shape)), binding.new("report *")
        pointers = map(binding.pointer, (x, np.ascontiguousarray(what), found))
        assert binding.function("flow_rows")(part, steps, save_every, count, 2, *pointers, report) == 0
        return found[1]

    states = call(0, 0, x, (saved_states, 2 * m))
    near(states, np.concatenate([run.q, run.p], axis=1), 1e-12)
    near(states[:, :m], case.motion_to(steps).q(run.t), 10 * case.error)
    near(call(1, 1, change, (saved_states, 2 * m)), run.tangent(change[1]), 1e-9)
    pulled = run.pullback(partials[1])
    wanted = np.concatenate([pulled.q, pulled.p, pulled.parameters, [pulled.t, pulled.h]])
    near(call(2, 1, partials, (given,)), wanted, 1e-9)


def reactions(case: Case) -> None:
    """Multipliers of the constraints, and how far states are off them."""
    run = case.run
    near(run.multipliers(), case.truth.multipliers(run.t), 20 * case.error)
    assert max(np.abs(each).max() for each in run.constraint_values()) < 1e-13


Property = Callable[[Case], None]
PROPERTIES: dict[str, tuple[Property, Callable[[Case], bool]]] = {
    "states": (states, lambda case: True),
    "formulas": (formulas, lambda case: True),
    "tables": (tables, lambda case: case.kind == "plain" and "constraints" not in case.problem.text),
    "slices": (slices, lambda case: case.kind in ("plain", "slowed")),
    "work_and_impulses": (
        work_and_impulses,
        lambda case: (
            case.problem.work and _conserves_balance(case) and (case.kind != "reversible" or case.given.save_every == 1)
        ),
    ),
    "between": (between, lambda case: True),
    "events": (events, lambda case: case.kind != "slowed"),
    "failure": (failure, lambda case: STOP in case.problem.text["parameters"] and not case.given.back),
    "ensembles": (ensembles, lambda case: case.kind not in ("array", "reversible")),
    "recording": (recording, lambda case: case.kind not in ("array", "driven")),
    "restarts": (restarts, lambda case: case.kind not in ("driven", "reversible", "slowed")),
    "changes": (changes, lambda case: case.kind in ("plain", "array") and not case.problem.text.get("constraints")),
    "controlled": (
        controlled,
        lambda case: case.kind in ("plain", "array", "driven") and case.error < LOW and _estimates_errors(case),
    ),
    "derivatives": (derivatives, lambda case: case.kind == "plain" and not case.problem.text.get("constraints")),
    "hessians": (
        hessians,
        lambda case: (
            case.kind == "plain" and "damping" not in case.problem.text and not case.problem.text.get("constraints")
        ),
    ),
    "flows": (flows, lambda case: case.kind == "plain"),
    "reactions": (reactions, lambda case: bool(case.problem.text.get("constraints"))),
}


def _conserves_balance(case: Case) -> bool:
    """Return whether the code has Newton's iteration along a curve, which recomputes steps for the balance."""
    if case.problem.methods[case.method][1] == "fixed-point":
        return False
    return str(case.problem.methods[case.method][0]).startswith(("svi", "scvi", "gauss"))


def _estimates_errors(case: Case) -> bool:
    """Return whether adaptive steps are available: with an error estimate by a curve, not for RATTLE."""
    return not isinstance(case.problem.methods[case.method][0], dict) and case.error < LOW
