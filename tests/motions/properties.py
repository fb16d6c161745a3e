"""Properties of the table: what each quantity of a run has to be, by code that shares nothing with what is checked.

States are compared with :class:`Truth`, quantities with its formulas at the true states, derivatives
with difference quotients of whole runs, and what a run is after an interruption with the run that had none, bit by bit.
"""

import json
import pickle
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import output_of
from scipy.optimize import brentq

import scvi_codegen as sc
from scvi_codegen import StateError, StepFailedError, load_run, record_run, resume_run
from scvi_codegen.extras.frameworks.flow import FlowOfRows
from scvi_codegen.runs.derivatives import gradients
from scvi_codegen.runs.stepping import chunks, memory
from tests.motions.motions import LOW, STOP, truth_of
from tests.motions.situations import STEPS, Case, accurate_stepper, as_rows


def near(found: Any, wanted: Any, error: float) -> None:
    """Raise where a number differs by more than the error, relative to the largest of its column or to 1."""
    found, wanted = np.asarray(found), np.asarray(wanted)
    assert found.shape == wanted.shape, (found.shape, wanted.shape)
    assert np.isfinite(found).all()
    sizes = np.maximum(1.0, np.abs(wanted).max(axis=0, initial=0.0))
    assert (np.abs(found - wanted) / sizes).max(initial=0.0) <= error, (np.abs(found - wanted) / sizes).max()


def near_words(values: Any, expected: Any, error: float) -> None:
    """Raise where numbers of one or two words differ by more than the error, relative to the largest or to 1."""
    differences = np.asarray(values - expected)
    assert np.isfinite(differences).all()
    assert np.abs(differences).max() <= error * max(1.0, float(np.abs(expected).max())), np.abs(differences).max()


def same_words(run: Any, expected: Any) -> None:
    """Raise where times or states of trajectories differ in a bit of their one or two words."""
    for name in ("t", "q", "p"):
        values, others = getattr(run, name), getattr(expected, name)
        assert values.shape == others.shape
        assert not np.any(np.asarray(values - others)), name


def states(case: Case) -> None:
    """Times, positions and momenta."""
    run, given = case.run, case.setting
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
    q, p, at, values = run.q[-1], run.p[-1], t[-1], run.parameters
    assert case.stepper.energy(q, p, at, values) == run.energy()[-1]
    momentum = case.stepper.momentum(q, run.velocity[-1], at, values)
    if case.problem.name == "vortices":  # whose velocities are those of several states
        near(case.stepper.velocity(q, momentum, at, values), run.velocity[-1], 1e-12)
    else:
        near(momentum, p, 1e-12)
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
    if case.problem.maps:
        assert np.array_equal(data["momentum_map"].values, run.momentum_maps())
        assert [*data["symmetry"].values] == [*case.stepper.momentum_map_names]
    assert data.attrs == table.attrs
    with tempfile.TemporaryDirectory() as folder:
        run.save(f"{folder}/run.csv")
        header, lines = Path(folder, "run.csv").read_text().split("\n", 1)
    assert header.split(",") == ["t", *table.columns]
    assert np.array_equal(np.loadtxt(lines.splitlines(), delimiter=","), table.reset_index().to_numpy())


def slices(case: Case) -> None:
    """Parts of a trajectory, by rows."""
    run, stride = case.run, 1 if case.kind == "driven" else 2
    for rows in (slice(2, None), slice(None, 5), slice(1, -1, stride), slice(3, 4)):
        part = run[rows]
        for name in ("t", "q", "p"):
            assert not np.any(getattr(part, name) - getattr(run, name)[rows])
        assert not np.any(part.energy() - run.energy()[rows])
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
    if case.kind == "driven":
        with pytest.raises(IndexError, match="stride, or slice"):
            run[0:5:2]
    for name in case.problem.coordinates if case.problem.array is None else ():
        assert np.array_equal(run[f"p_{name}"], run.p[:, case.problem.coordinates.index(name)])
    with pytest.raises(StateError, match="there is no quantity 'none_such' of the states"):
        run["none_such"]


def work_and_impulses(case: Case) -> None:
    """Work and impulses of the forces."""
    run = case.run
    wanted = case.truth.work_and_impulses(run.t)
    near(run.work(), wanted[:, 0], 1e-6)
    near(run.impulses(), wanted[:, 1:], 1e-6)
    near(run[3:-2].work(), run.work()[3:-2] - run.work()[3], 1e-13)
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
    low_word_of_times = 1e-15 if case.two_words else 0.0
    near(q, run.q, low_word_of_times)
    near(p, run.p, low_word_of_times)
    if case.kind in ("array", "driven"):
        return
    times = np.sort(times)[:: -1 if case.setting.back else 1]
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
    far = 3 if case.setting.back else 10  # back in time friction makes motions grow
    steps, end = far * STEPS, case.setting.t + far * case.span
    plan = {"t_end": end} if case.kind == "reversible" else {"steps": steps, "h": case.h}
    motion = truth_of(case.problem).motion(case.setting.t, end, case.problem.q, case.problem.x, case.values)
    grid = np.linspace(case.setting.t, end, (16 if case.problem.falls_back else 4) * steps)
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
    values = {**case.values, STOP: case.setting.t + 512.5 * h}
    parameters = case.parameters(values)
    with pytest.raises(StepFailedError) as error:
        case.integrate(parameters=parameters, steps=steps, h=h)
    failed, saved_states = error.value, error.value.trajectory
    assert failed.status == "not finite"
    last = float(Fraction(case.setting.t) + 512 * Fraction(h))
    assert (failed.step, failed.t) == (512, last)
    saved_states = as_rows(saved_states) if case.kind == "array" else saved_states
    assert len(saved_states.t) == 512 // case.setting.save_every + 1
    motion = truth_of(case.problem).motion(case.setting.t, last, case.problem.q, case.problem.x, values)
    near(saved_states.q, motion.q(saved_states.t), 1e-6)
    if case.kind != "array":
        others = [{**parameters, STOP: case.setting.t + (k + 0.5) * h} for k in (3, 300, 10**6)]
        ensemble_run = ensemble_of(case, others, steps=steps, h=h)
        assert ensemble_run.steps.tolist() == [3, 300, steps]
        assert ensemble_run.status.tolist() == ["not finite", "not finite", "ok"]


def ensemble_of(case: Case, parameters: list[dict[str, Any]], **more: Any) -> Any:
    """A trajectory for each set of parameters, each from a state of its own."""
    count = len(parameters)
    columns = {name: np.array([own[name] for own in parameters]) for name in parameters[0]}
    shift = 0.0 if case.problem.text.get("constraints") else 1e-2
    q = np.array(case.problem.q) + shift * np.arange(count)[:, np.newaxis]
    moving = {name: np.tile(values, (count, 1)) for name, values in case.moving().items()}
    arguments = {**case.common(), **moving, "parameters": columns, **more}
    if case.kind == "driven":
        arguments.setdefault("inputs", case.problem.data(case.setting.t, case.setting.t + 2 * case.span))
    return case.stepper.integrate_ensemble(q, **arguments)


def _others(case: Case, count: int) -> list[dict[str, float]]:
    """Sets of parameters, no two the same."""
    names = [name for name in case.values if name != STOP]
    return [{**case.values, **{name: case.values[name] * (1 + 0.01 * j) for name in names}} for j in range(count)]


def ensembles(case: Case) -> None:
    """States, energies and maps of trajectories of several parameters and starts, by common steps and by their own."""
    count = case.setting.trajectories
    others = _others(case, count)
    ends = case.setting.t + case.span * (1.0 + 0.02 * np.arange(count))
    ways: list[dict[str, Any]] = [{"h": case.h, "steps": STEPS}]
    if case.kind in ("plain", "driven") and _estimates_errors(case):
        ways.append({"t_end": ends, "tolerance": 1e-11})
    if case.kind == "slowed":
        ways.append({"h": case.h, "t_end": float(ends[0])})
    for way in ways:
        runs = ensemble_of(case, others, save_every=case.setting.save_every, **way)
        assert runs.ok.all()
        energies, maps = runs.energy(), runs.momentum_maps()
        data = runs.to_xarray() if not (case.two_words or case.kind == "slowed" or "t_end" in way) else None
        for j in sorted({0, count // 3, count - 1}):
            rows = np.flatnonzero(np.isfinite(runs.q[:, j, 0]))
            t = runs.t if runs.t.ndim == 1 else runs.t[rows, j]
            motion = case.motion(others[j], state=(tuple(runs.q[0, j]), case.problem.x))
            near(runs.q[rows, j], motion.q(t), 10 * case.error)
            near(runs.p[rows, j], motion.p(t), 10 * case.error)
            near(energies[rows, j], motion.energy(t), 30 * case.error)
            if data is not None:
                near(data["velocity"].values[rows, j], motion.v(t), 30 * case.error)
                assert np.array_equal(data["energy"].values[rows, j], energies[rows, j])
            near(maps[rows, j], motion.maps(t), 30 * case.error)
            if case.kind != "slowed" and "t_end" not in way:
                assert t[0] == case.setting.t
            _equals_single_run(case, runs, j, others[j], way, rows)
    if case.kind == "driven":
        _constant_inputs(case, others)


def single_precision(case: Case) -> None:
    """States of trajectories in single precision are within 10 units of rounding of those in double precision."""
    others, inputs = _others(case, case.setting.trajectories), case.kind == "driven"

    def run(precision: str) -> Any:
        return ensemble_of(case, others, h=case.h, steps=STEPS, precision=precision)

    if not case.stepper.supports("single") or (inputs and case.stepper.constraints):
        with pytest.raises(sc.ScviCodegenError, match="precision='single'"):
            run("single")
        return
    single, double = run("single"), run("double")
    assert single.ok.all()
    assert case.problem.falls_back or not np.array_equal(single.q, double.q)
    units = 40 if case.problem.falls_back else 10  # its phase is 100 radians, of which parameters lose 24 bits, too
    near(single.q, double.q, units * np.finfo(np.float32).eps)
    near(single.p, double.p, units * np.finfo(np.float32).eps)


def _constant_inputs(case: Case, others: list[dict[str, float]]) -> None:
    """States of trajectories with constant inputs of their own."""
    inputs = {name: 0.3 - 0.02 * np.arange(len(others)) * k for k, name in enumerate(case.problem.inputs, 1)}
    for plan in ({"h": case.h, "steps": STEPS}, {"t_end": case.setting.t + case.span, "tolerance": 1e-11}):
        runs = ensemble_of(case, others, inputs=inputs, **plan)
        for j in {0, len(others) - 1}:
            constant = replace(case.problem, inputs={name: (values[j],) for name, values in inputs.items()})
            times = runs.t if runs.times is None else runs.times[np.isfinite(runs.times[:, j]), j]
            motion = truth_of(constant).motion(times[0], times[-1], runs.q[0, j], case.problem.x, others[j])
            near(runs.q[: len(times), j], motion.q(times), 10 * case.error)
            near(runs.p[: len(times), j], motion.p(times), 10 * case.error)


def _equals_single_run(case: Case, runs: Any, j: int, values: Any, way: Any, rows: Any) -> None:
    """Raise where a trajectory differs from the run of its start alone: by no bit at adaptive steps."""
    own = {**way, "t_end": float(np.broadcast_to(way["t_end"], len(runs))[j])} if "t_end" in way else way
    alone = case.integrate(q=runs.q[0, j], parameters=case.parameters(values), **own)
    assert len(alone.t) == len(rows)
    rounding = _rounding_of_lanes(case, way)
    times = runs.t if runs.times is None else runs.times[rows, j]
    if case.kind == "slowed":
        near(runs[j].tau, alone.tau, 1e-13)
    for values, others in ((times, alone.t), (runs.q[rows, j], alone.q), (runs.p[rows, j], alone.p)):
        near(values - others, 0.0 * others, rounding * max(1.0, float(np.abs(others).max())))


def _rounding_of_lanes(case: Case, way: dict[str, Any]) -> float:
    """Return the difference of SIMD lanes from single runs; adaptive ones are the same code, constrained ones round
    alike."""
    if case.two_words and case.problem.text.get("constraints"):
        return 1e-28  # of initial states that are projected
    if "t_end" in way or case.problem.alike_in_lanes or case.problem.text.get("constraints"):
        return 0.0
    if case.two_words:
        return 4e-31
    return 1e-11 if case.problem.falls_back else 1e-12


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
            save_every=case.setting.save_every,
            rows=5,
            checkpoint_steps=4,
            stop=lambda: next(looks, True),
        )
        assert not begun.finished
        found = resume_run(f"{folder}/a")
        assert found.finished
        assert case.options in (None, found.manifest.options)
        same_words(found[:], whole)
        assert np.array_equal(np.asarray(found.iterations), whole.iterations)
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


def adaptive_restarts(case: Case) -> None:
    """Adaptive steps in pieces, restored or recorded and interrupted: bit for bit those without interruption."""
    end, plan = case.setting.t + case.span, {"tolerance": 1e-9}
    whole, pieces = (case.start_adaptive(t_end=end, **plan) for _ in range(2))
    whole.advance(10**6)
    pieces.advance(2)
    for advanced in (3, 10**6):
        pieces = case.stepper.from_checkpoint(
            pieces.checkpoint(), parameters=pieces.parameters, options=case.options, t_end=end, **plan
        )
        pieces.advance(advanced)
    assert whole.arrived
    assert low_words(pieces) == low_words(whole)
    save_every = case.setting.save_every
    in_memory = case.integrate(t_end=end, save_every=save_every, **plan)
    with tempfile.TemporaryDirectory() as folder:
        looks = iter([False, True])
        settings = {"rows": 2, "checkpoint_steps": 2, "save_every": save_every}
        begun = record_run(
            case.start_adaptive(t_end=end, **plan), f"{folder}/a", stop=lambda: next(looks, True), **settings
        )
        recorded = resume_run(f"{folder}/a")
        assert recorded.finished
        assert begun.steps <= recorded.steps == in_memory.steps
        same_words(recorded[:], in_memory)
        assert np.array_equal(np.asarray(recorded.iterations), in_memory.iterations)
        assert recorded[:].step_error == in_memory.step_error


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
    assert abs(run.t - (case.setting.t + 16 * case.h)) < 1e-14
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
    end = case.setting.t + case.span
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
    assert min(case.setting.t, end) <= run.worst_step_time <= max(case.setting.t, end)
    if case.setting.save_every == 1:
        assert run.worst_step_time in run.t


def _differences(case: Case, names: list[str], width: float) -> dict[str, np.ndarray]:
    """Return the (n, 2m) differences of all states of a run by its initial data."""

    def ends(name: str, change: float) -> np.ndarray:
        q, p, t, h = base.q[0].copy(), base.p[0].copy(), case.setting.t, base.h
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
            q, p, h=h, t=t, steps=steps, save_every=case.setting.save_every, parameters=values, options=case.options
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
    one = case.stepper.sensitivity(run.q[0], run.p[0], case.h, case.setting.t, case.parameters(), options=case.options)
    if case.setting.save_every == 1:
        near(one.state, found.state[1], 1e-11)
        near(one.parameters, found.parameters[1], 1e-11)


def hessians(case: Case) -> None:
    """Products with the Hessian compared with difference quotients of pullbacks."""
    m, width = len(case.problem.q), 1e-3
    seeds = np.random.default_rng(3).normal(size=(SHORT // case.setting.save_every + 1, 2 * m))
    direction = np.random.default_rng(4).normal(size=2 * m)
    run = case.integrate(steps=SHORT)
    found = run.hessian_product(seeds, direction)

    def pulled(change: float) -> np.ndarray:
        q, p = np.split(np.concatenate([run.q[0], run.p[0]]) + change * direction, 2)
        other = case.stepper.integrate(q, p, **case.common(h=case.h, steps=SHORT, save_every=case.setting.save_every))
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
    row = np.array([*run.q[0], *run.p[0], *run.parameters, case.setting.t, case.h])
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


def reversal(case: Case) -> None:
    """A run back from its end returns to its start: methods are symmetric, with friction, too."""
    run = case.run
    x = run.p[-1] if "hamiltonian" in case.problem.text else run.velocity[-1]
    back = case.integrate(q=run.q[-1], x=x, t=run.t[-1], h=-case.h)
    rounding = 1e-11
    if case.two_words:
        rounding = 1e-26
    elif case.problem.falls_back:
        rounding = 1e-9
    near_words(back.q[-1], run.q[0], rounding)
    near_words(back.p[-1], run.p[0], rounding)


def symplecticity(case: Case) -> None:
    """D^T J D = exp(-c t) J for the derivative D of a run with uniform damping c: areas shrink, or stay."""
    run, m = case.integrate(steps=SHORT, save_every=SHORT), len(case.problem.q)
    damping = eval(case.problem.text.get("damping", "0"), {}, case.values)
    form = np.block([[np.zeros((m, m)), np.eye(m)], [-np.eye(m), np.zeros((m, m))]])
    derivative = run.sensitivity().state[-1]
    near(derivative.T @ form @ derivative, np.exp(-damping * SHORT * case.h) * form, 1e-11)


def two_words(case: Case) -> None:
    """Methods of the orders 24 and 28 agree to 27 digits: fixed and adaptive steps, between states, at crossings."""
    steps, first, second = 6, accurate_stepper(case.problem, 12), accurate_stepper(case.problem, 14)
    other_h = case.h if case.kind == "reversible" else case.h / 2  # the controller sees states at ends of steps
    if case.kind != "reversible":
        run = case.integrate(first, steps=steps)
        other = case.integrate(second, steps=2 * steps, save_every=2 * steps, h=other_h)
        near_states([run.t[-1], run.q[-1], run.p[-1]], [other.t[-1], other.q[-1], other.p[-1]])
    end = case.setting.t + 0.2 * case.span
    run = case.integrate(first, t_end=end, h=case.h, save_every=1)
    plans = [(second, {"h": other_h, "t_end": end})]
    if case.kind == "plain" and not case.problem.text.get("constraints"):
        plans.append((first, {"t_end": end}))
    for stepper, plan in plans:
        other = case.integrate(stepper, save_every=1, **plan)
        assert run.mp("t")[-1] == other.mp("t")[-1] == end
        near_states([run.q[-1], run.p[-1]], [other.q[-1], other.p[-1]])
    between = case.setting.t + 0.11 * case.span
    other = case.integrate(second, h=other_h, t_end=end, save_every=1)
    near_states([*run.at(between)], [*other.at(between)])
    if case.kind == "driven":  # its data depend on the number of steps, and exclude t_eval
        return
    saved = case.integrate(first, h=case.h, t_end=end, t_eval=[between])
    near_states([saved.q[0], saved.p[0]], [*run.at(between)])
    event = sc.Event(case.problem.event, terminal=True)
    plan, other_plan = {"steps": 10 * STEPS}, {"steps": 20 * STEPS}
    if case.kind == "reversible":
        plan = other_plan = {"t_end": case.setting.t + 10 * case.span}
    crossings = [
        case.integrate(stepper, events=event, save_every=10, **more).events[0]
        for stepper, more in ((first, {"h": case.h, **plan}), (second, {"h": other_h, **other_plan}))
    ]
    for name in ("t", "q", "p"):
        near_words(getattr(crossings[0], name), getattr(crossings[1], name), 1e-25)


def near_states(states: list[Any], expected: list[Any]) -> None:
    for values, others in zip(states, expected, strict=True):
        near_words(values, others, 1e-27)


def packages(case: Case) -> None:
    """A model file by the command line, and the program and the Python package made from it, repeat the run."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        model = folder / "model.toml"
        model.write_text(model_text(case))
        output_of("run", str(model), "--output", str(folder / "run.npz"), "--quiet")
        with np.load(folder / "run.npz") as saved:
            rows = np.column_stack([saved["t"], saved["q"], saved["p"]])
        near(rows[:, 1:], np.hstack([case.truth.q(rows[:, 0]), case.truth.p(rows[:, 0])]), case.error)
        package = folder / "package"
        output_of("generate", str(model), "--output", str(package))
        command = ["make", "-s", "-C", str(package), "run", "CFLAGS=-O0 -std=c99"]
        lines = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
        printed = np.array([line.split()[: rows.shape[1]] for line in lines if not line.startswith("#")], dtype=float)
        assert len(printed) > STEPS // 3
        near(printed, rows[np.abs(rows[:, :1] - printed[:, 0]).argmin(axis=0)], 1e-12)
        run = sc.load_package(package).integrate(
            np.array(case.problem.q), **case.moving(), t=case.setting.t, h=case.h, steps=STEPS
        )
        near(np.column_stack([run.t, run.q, run.p]), rows, 1e-12)


def can_be_packed(case: Case) -> bool:
    return case.kind == "plain" and case.problem.array is None and not case.two_words


def model_text(case: Case) -> str:
    """Return a model file whose defaults are the parameters of the case."""
    text = case.problem.text
    momenta = "momenta" in text
    system = {name: value for name, value in text.items() if name not in ("parameters", "forces")}
    method = case.scheme.method
    tables = {
        "system": {"name": "m", **system},
        "parameters": case.values,
        "forces": text.get("forces", {}),
        "initial": {"q": list(case.problem.q), "p" if momenta else "q_dot": list(case.problem.x), "t": case.setting.t},
        "method": {**(method if isinstance(method, dict) else {"method": method}), "solver": case.scheme.solver},
        "run": {"step": case.h, "steps": STEPS},
    }
    lines = []
    for title, table in tables.items():
        lines += [f"[{title}]", *(f"{name} = {json.dumps(value)}" for name, value in table.items())]
    return "\n".join(lines)


def _is_free(case: Case) -> bool:
    """Return whether the states are rows of coordinates without constraints."""
    return case.kind == "plain" and not case.problem.text.get("constraints")


def _is_symplectic(case: Case) -> bool:
    """Return whether the method is symplectic and no forces act but uniform damping."""
    return not case.problem.text.get("forces") and _is_symmetric(case) and not str(case.scheme.method).startswith("sc:")


def _is_accurate(case: Case) -> bool:
    return bool(case.scheme.method != "explicit-euler")


def _is_symmetric(case: Case) -> bool:
    return not str(case.scheme.method).startswith(("radau", "explicit-euler"))


def _conserves_balance(case: Case) -> bool:
    """Return whether the code has Newton's iteration along a curve, which recomputes steps for the balance."""
    if case.scheme.solver == "fixed-point" or (case.kind == "reversible" and case.setting.save_every > 1):
        return False
    return str(case.scheme.method).startswith(("svi", "scvi", "gauss"))


def _estimates_errors(case: Case) -> bool:
    """Return whether adaptive steps are available: with an error estimate by a curve, not for RATTLE."""
    return not isinstance(case.scheme.method, dict) and case.error < LOW


Property = Callable[[Case], None]
PROPERTIES: dict[str, tuple[Property, Callable[[Case], bool]]] = {
    "states": (states, lambda case: True),
    "formulas": (formulas, lambda case: True),
    "tables": (tables, lambda case: _is_free(case) and not case.two_words and case.problem.array is None),
    "slices": (slices, lambda case: case.kind in ("plain", "slowed", "driven")),
    "work_and_impulses": (work_and_impulses, lambda case: case.problem.work and _conserves_balance(case)),
    "between": (between, lambda case: _is_accurate(case)),
    "events": (events, lambda case: case.kind != "slowed" and _is_accurate(case)),
    "failure": (
        failure,
        lambda case: STOP in case.problem.text["parameters"] and not case.setting.back and _is_accurate(case),
    ),
    "ensembles": (ensembles, lambda case: case.kind not in ("array", "reversible")),
    "single_precision": (single_precision, lambda case: case.kind in ("plain", "driven", "slowed")),
    "recording": (recording, lambda case: case.kind not in ("array", "driven")),
    "restarts": (restarts, lambda case: case.kind not in ("driven", "reversible")),
    "adaptive_restarts": (adaptive_restarts, lambda case: case.kind == "plain" and _estimates_errors(case)),
    "changes": (changes, lambda case: case.kind == "array" or _is_free(case)),
    "controlled": (
        controlled,
        lambda case: case.kind in ("plain", "array", "driven") and _estimates_errors(case) and not case.two_words,
    ),
    "reversal": (reversal, lambda case: case.kind not in ("slowed", "reversible", "driven") and _is_symmetric(case)),
    "symplecticity": (symplecticity, lambda case: _is_free(case) and _is_symplectic(case) and not case.two_words),
    "two_words": (two_words, lambda case: case.two_words),
    "derivatives": (derivatives, lambda case: _is_free(case) or case.kind == "slowed"),
    "hessians": (hessians, lambda case: _is_free(case) and "damping" not in case.problem.text and not case.two_words),
    "flows": (flows, lambda case: case.kind == "plain" and not case.two_words and _is_accurate(case)),
    "reactions": (reactions, lambda case: bool(case.problem.text.get("constraints"))),
    "packages": (packages, lambda case: case.situation == "own" and can_be_packed(case)),
}
