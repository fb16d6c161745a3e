"""Overhead of calls of ``integrate`` in function calls instead of seconds, and the reuse of runs."""

from __future__ import annotations

import threading
import warnings
from functools import partial
from itertools import chain

import numpy as np
import numpy.ma  # where a program has imported it, arguments are asked for masks
import pytest
from counting import TooMuchWorkError, at_most, visited
from notation import lagrange
from samples import QUICK_FLAGS

import scvi_codegen as sc

Q, P = np.array([0.4, 0.0]), np.array([0.0, 2.0])
FIXED, ADAPTIVE = {"h": 0.05, "steps": 1}, {"t_end": 0.05, "tolerance": 1e-10}


@pytest.fixture(scope="module")
def stepper():
    return sc.compile_stepper(sc.problem("kepler").system, sc.SVI(8))


@pytest.mark.parametrize("convert", [list, np.array])
@pytest.mark.parametrize(
    ("integrate", "plan", "calls"),
    [
        *(("integrate", {"h": 0.05, "steps": steps}, 40) for steps in (1, 900)),
        *(("integrate", {"t_end": t_end, "tolerance": 1e-10}, 49) for t_end in (0.05, 200.0)),
        ("integrate_ensemble", FIXED, 411),
    ],
)
@pytest.mark.parametrize("moving", ["p", "velocity"])
def test_a_call_takes_few_function_calls(stepper, convert, integrate, plan, calls, moving):
    """The limit is a tenth above the present number, and does not depend on the machine."""
    run = partial(getattr(stepper, integrate), convert(Q.tolist()), **{moving: convert(P.tolist())}, **plan)
    run()
    with at_most(calls):
        run()
    with pytest.raises(TooMuchWorkError), at_most(calls // 2):
        run()


def test_a_call_by_names_and_functions_of_a_state_take_few_function_calls(stepper):
    q, velocity = (dict(zip(stepper.coordinates, x.tolist(), strict=True)) for x in (Q, P))
    for run, calls in [
        (partial(stepper.integrate, q, velocity=velocity, **FIXED), 74),
        (partial(stepper.step, Q, P, 0.05), 84),
        (partial(stepper.velocity, Q, P), 70),
        (partial(stepper.energy, Q, P), 75),
        (partial(stepper.velocity, np.tile(Q, (100, 1)), np.tile(P, (100, 1))), 70),
    ]:
        run()
        with at_most(calls):
            run()
        with pytest.raises(TooMuchWorkError), at_most(calls // 2):
            run()


@pytest.fixture(scope="module")
def rods():
    distances = ["x**2 + y**2 - l**2", "(u - x)**2 + (v - y)**2 - a**2"]
    system = lagrange(
        "rods", "x y u v", "(x_dot**2 + y_dot**2 + u_dot**2 + v_dot**2)/2 - y - v", constraints=distances, l=1.0, a=0.7
    )
    return sc.compile_stepper(system, "svi:4", flags=QUICK_FLAGS)


@pytest.mark.parametrize("moving", ["p", "velocity"])
def test_runs_on_constraints_begin_by_one_call_of_c(rods, moving):
    q, still = [0.6, -0.8, 1.3, -0.8], np.zeros(4)
    for plan, calls in ((FIXED, 40), ({"t_end": 0.05, "check_growth": False}, 72)):
        rods.integrate(q, **{moving: still}, **plan)
        with at_most(calls):
            rods.integrate(q, **{moving: still}, **plan)
    rods.start(q, **{moving: still}, h=0.05)
    with at_most(270):
        rods.start(q, **{moving: still}, h=0.05)


def beginning(rods, q, p):
    """Initial state of a run, with the warning or error that it causes."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            run = rods.integrate(q, p, h=1e-3, steps=0)
        except sc.StateError as error:
            return str(error)
    return run.q.tobytes(), run.p.tobytes(), [str(warning.message) for warning in caught]


def test_c_begins_on_constraints_where_python_does(rods, monkeypatch):
    """States from exact to far away, as they are, moved silently, moved with a warning, refused: the same bits."""
    generator, kinds = np.random.default_rng(4), set()
    states = []
    for _ in range(200):
        a, b = generator.uniform(-3.0, 3.0, 2)
        q = np.cumsum([[np.sin(a), -np.cos(a)], [0.7 * np.sin(b), -0.7 * np.cos(b)]], axis=0).ravel()
        p = np.cumsum([[np.cos(a), np.sin(a)], [0.7 * np.cos(b), 0.7 * np.sin(b)]], axis=0).ravel()
        off = 10.0 ** generator.uniform(-17.0, -1.0) * generator.normal(size=(2, 4))
        states.append((q + off[0], p + off[1]))
    found = [beginning(rods, *state) for state in states]
    monkeypatch.setitem(rods.binding._has, "call_consistent", False)
    monkeypatch.setattr(rods, "_begins_by", None)
    for state, begun in zip(states, found, strict=True):
        assert begun == beginning(rods, *state)
        kinds.add("error" if isinstance(begun, str) else (begun[0] == state[0].tobytes(), len(begun[2])))
    assert kinds == {"error", (True, 0), (False, 0), (False, 1)}


def test_dependent_constraints_are_refused_by_the_least_singular_value():
    """Rows (1, 1, 0) and (1, 1 + d, 0) of length 1; C accepts what is certain, and leaves the rest to Python."""
    system = lagrange(
        "held", "x y z", "(x_dot**2 + y_dot**2 + z_dot**2)/2", constraints=["x + y", "x + (1 + d)*y"], d=1.0
    )
    stepper, accepted = sc.compile_stepper(system, "svi:2", flags=QUICK_FLAGS), list[sc.Trajectory]()
    for d in np.logspace(-11.0, 0.0, 45):
        rows = np.array([[1.0, 1.0, 0.0], [1.0, 1.0 + d, 0.0]])
        least = np.linalg.svd(rows / np.linalg.norm(rows, axis=1, keepdims=True), compute_uv=False)[-1]
        run = partial(stepper.integrate, np.zeros(3), [0.0, 0.0, 1.0], h=0.1, steps=1, parameters={"d": d})
        if least > 1e-9:
            accepted.append(run())
        else:
            with pytest.raises(sc.StateError, match="linearly dependent"):
                run()
    assert 30 < len(accepted) < 45


@pytest.mark.parametrize("plan", [FIXED, ADAPTIVE, {"t_end": 0.05}])
def test_a_repeated_call_visits_few_functions_and_files(stepper, plan):
    stepper.integrate(Q, P, **plan)
    with visited() as functions:
        stepper.integrate(Q, P, **plan)
    files = {file for file, _ in functions if "scvi_codegen" in file}
    assert 5 <= len(files) <= 9
    assert 8 <= len(functions) <= 20


def test_one_step_of_a_run_takes_few_function_calls(stepper):
    run = stepper.start(Q, P, h=0.05)
    with at_most(10):
        run.advance(1)
    assert run.steps == 1


def numbers(found):
    return [x.tobytes() for x in (found.t, found.q, found.p, found.iterations, found.step_sizes, found.parameters)]


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("plan", [{"h": 0.05, "steps": 400}, {"h": 0.05, "steps": 1100}, {"t_end": 9.0}])
def test_memory_of_earlier_calls_does_not_matter(stepper, plan):
    first = stepper.integrate(Q, P, **plan)
    saved = numbers(first)
    stepper.integrate(2.0 * Q, P, **plan, t=3.0 if "h" in plan else 1.0, parameters={"mu": 1.5})
    with pytest.raises(sc.StepFailedError):
        stepper.integrate(Q, 0.0 * P, **({"h": 0.05, "steps": 400} if "h" in plan else {"t_end": 9.0}))
    with pytest.raises(sc.StateError):
        stepper.integrate([np.nan, 0.0], P, **plan)
    assert numbers(first) == saved == numbers(stepper.integrate(Q, P, **plan))
    assert saved == numbers(sc.compile_stepper(sc.problem("kepler").system, sc.SVI(8)).integrate(Q, P, **plan))


@pytest.mark.second
def test_calls_within_calls_and_from_threads_have_runs_of_their_own(stepper):
    plan, found, inner = {"h": 0.05, "steps": 500}, {}, []
    alone = numbers(stepper.integrate(Q, P, **plan))

    def work(number):
        found[number] = [numbers(stepper.integrate(Q, P, **plan)) for _ in range(2)]

    threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    outer = stepper.integrate(Q, P, **plan, progress=lambda _: inner.append(numbers(stepper.integrate(Q, P, **plan))))
    for thread in threads:
        thread.join()
    assert inner
    assert all(each == alone for each in [numbers(outer), *inner, *chain(*found.values())])


@pytest.fixture(scope="module")
def chains():
    """Chains of run-time sizes: elastic, and with fixed distances from the origin that depend on a parameter."""
    kinetic = "sum(i in N, (x_dot[i]**2 + y_dot[i]**2)/2) - k*sum(i in 0..N-2, (x[i+1] - x[i])**2 + (y[i+1] - y[i])**2)"
    common = {"coordinates": ["x[N]", "y[N]"], "parameters": {"k": 0.7}, "lagrangian": kinetic}
    held = {"constraints": ["x[i]**2 + y[i]**2 - 1 for i in N"]}
    kinds = ({}, "svi:4"), (held, "stoermer-verlet")
    return [sc.compile_stepper(sc.LagrangianSystem.from_text(name="chain", **common, **each), by) for each, by in kinds]


@pytest.mark.rotated
def test_calls_of_arrays_take_few_function_calls(chains):
    q, p = {"x": np.arange(3.0), "y": np.zeros(3)}, np.zeros(6)
    run = chains[0].integrate(q, p, h=0.05, steps=50)
    chains[0].integrate(q, p, h=0.05, steps=1)
    with at_most(550):
        chains[0].integrate(q, p, h=0.05, steps=1)
    run.momentum_maps()
    with at_most(400):
        run.momentum_maps()


def test_later_calls_of_a_large_run_need_no_short_chunks(chains):
    """The first one begins with a step, as its time is unknown; then 16 steps are one call of C."""
    run = chains[0].start({"x": np.arange(600.0), "y": np.zeros(600)}, np.zeros(1200), h=0.05)
    run.advance(31)
    with at_most(25):
        run.advance(16)


@pytest.mark.parametrize("constrained", [False, True])
def test_runs_of_arrays_are_reused_bitwise_equally(chains, constrained):
    angles = np.arange(3.0)
    q, still = {"x": np.cos(angles), "y": np.sin(angles)}, np.zeros(6)
    v = np.concatenate([-np.sin(angles), np.cos(angles)])
    chain = chains[constrained]

    def run(velocity, **others):
        return numbers(chain.integrate(q, velocity=velocity, h=0.05, steps=20, **others))

    first, other = run(v), run(v, parameters={"k": 2.0})
    bound = chain.bind(q)[0]
    assert len(bound._released_runs) == 1
    for velocity, parameters, expected in [
        (v, {}, first),
        (still, {"k": 3.0}, None),
        (v, {"k": 2.0}, other),
        (v, {}, first),
    ]:
        found = run(velocity, parameters=parameters or None)
        assert expected in (None, found)
    bound._released_runs.clear()
    assert run(v, parameters={"k": 2.0}) == other
    assert len(bound._released_runs) == 1
