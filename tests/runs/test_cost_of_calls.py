"""Overhead of calls of ``integrate`` in function calls instead of seconds, and the reuse of runs."""

from __future__ import annotations

import sys
import threading
from itertools import chain

import numpy as np
import pytest
from counting import TooMuchWorkError, at_most
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen.runs.driver import run as runs
from scvi_codegen.runs.driver import run_loop
from scvi_codegen.runs.stepping import chunks, memory

Q, P = np.array([0.4, 0.0]), np.array([0.0, 2.0])
FIXED, ADAPTIVE = {"h": 0.05, "steps": 1}, {"t_end": 0.05, "tolerance": 1e-10}


@pytest.fixture(scope="module")
def stepper():
    return sc.compile_stepper(sc.problem("kepler").system, sc.SVI(8))


@pytest.mark.parametrize("convert", [list, tuple, np.array])
@pytest.mark.parametrize(("plan", "calls"), [(FIXED, 40), (ADAPTIVE, 62)])
def test_a_call_takes_few_function_calls(stepper, convert, plan, calls):
    """The limit is a tenth above the present number, and does not depend on the machine."""
    q, p = convert(Q.tolist()), convert(P.tolist())
    stepper.integrate(q, p, **plan)
    with at_most(calls):
        stepper.integrate(q, p, **plan)
    with pytest.raises(TooMuchWorkError), at_most(calls // 2):
        stepper.integrate(q, p, **plan)


@pytest.mark.parametrize("momenta", ["p", "velocity"])
def test_a_call_visits_few_functions_of_few_files(stepper, momenta):
    arguments = {momenta: P} | ADAPTIVE
    stepper.integrate(Q, **arguments)
    visited = set()

    def visit(frame, event, _):
        if event == "call":
            visited.add((frame.f_code.co_filename, frame.f_code.co_firstlineno))

    sys.setprofile(visit)
    try:
        stepper.integrate(Q, **arguments)
    finally:
        sys.setprofile(None)
    assert len(visited) <= 25
    assert len({file for file, _ in visited}) <= 8


@pytest.mark.second
@pytest.mark.parametrize("plan", [FIXED, ADAPTIVE, {"t_end": 9.0, "t_eval": [1.0]}])
@pytest.mark.parametrize("convert", [list, np.array, dict])
def test_velocities_start_the_run_of_their_momenta(plan, convert):
    """The mass matrix depends on the position, and one momentum is 0 although its velocity is not."""
    system = sc.LagrangianSystem.from_text("m", ["x", "y"], "(1 + x**2)*x_dot**2/2 + x_dot*y_dot + y_dot**2 - x**2")
    stepper = sc.compile_stepper(system, "svi:4", flags=QUICK_FLAGS)
    for velocity in ([0.5, 0.25], [0.5, -0.625], [0.0, 0.0]):
        q, v = [0.5, 1.0], velocity
        p = stepper.momentum(q, v)
        if convert is dict:
            q, v = ({"x": a, "y": b} for a, b in (q, v))
        else:
            q, v = convert(q), convert(v)
        assert numbers(stepper.integrate(q, velocity=v, **plan)) == numbers(stepper.integrate([0.5, 1.0], p, **plan))
    with pytest.raises(sc.StateError, match="velocity"):
        stepper.integrate([0.5, 1.0], velocity=[np.inf, 0.0], **plan)
    polar = sc.LagrangianSystem.from_text("polar", ["r", "phi"], "(r_dot**2 + r**2*phi_dot**2)/2 - r**2")
    with pytest.raises(sc.StateError, match=r"phi_dot = 1 at q = \[0. 1.\] has no momentum"):
        sc.compile_stepper(polar, "svi:4", flags=QUICK_FLAGS).integrate([0.0, 1.0], velocity=[0.0, 1.0], **plan)


def test_one_step_of_a_run_takes_few_function_calls(stepper):
    run = stepper.start(Q, P, h=0.05)
    with at_most(10):
        run.advance(1)
    assert run.steps == 1


@pytest.mark.parametrize("values", [[1, 0], [0.4, np.float64(0.25)], (2, -0.0), [2**70, 1]])
def test_lists_and_arrays_start_bitwise_equal_runs(stepper, values):
    whole = np.array(values, dtype=float)
    first, again = (stepper.integrate(q, type(q)([0.0, 2.0]) if q is values else P, **FIXED) for q in (values, whole))
    assert first.q.tobytes() == again.q.tobytes()
    assert first.p.tobytes() == again.p.tobytes()


@pytest.mark.parametrize("q", [[0.4], [0.4, 0.0, 1.0], ["0.4", 1.0], [0.4, np.inf], [10**400, 0.0], [[0.4, 1]]])
def test_invalid_lists_raise_after_valid_ones(stepper, q):
    saved = numbers(stepper.integrate([0.4, 0.0], [0.0, 2.0], **FIXED))
    with pytest.raises(sc.StateError):
        stepper.integrate(q, [0.0, 2.0], **FIXED)
    assert saved == numbers(stepper.integrate([0.4, 0.0], [0.0, 2.0], **FIXED))


def numbers(found):
    return [x.tobytes() for x in (found.t, found.q, found.p, found.iterations, found.step_sizes, found.parameters)]


@pytest.mark.parametrize("plan", [{"h": 0.05, "steps": 400}, {"t_end": 9.0}])
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


def test_calls_within_calls_and_from_threads_have_runs_of_their_own(stepper):
    plan, found, inner = {"h": 0.05, "steps": 3000}, {}, []
    alone = numbers(stepper.integrate(Q, P, **plan))

    def work(number):
        found[number] = [numbers(stepper.integrate(Q, P, **plan)) for _ in range(5)]

    threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    outer = stepper.integrate(Q, P, **plan, progress=lambda _: inner.append(numbers(stepper.integrate(Q, P, **plan))))
    for thread in threads:
        thread.join()
    assert inner
    assert all(each == alone for each in [numbers(outer), *inner, *chain(*found.values())])


def test_large_memory_is_freed(stepper, monkeypatch):
    stepper.integrate(Q, P, **FIXED)
    assert stepper._released_runs
    stepper._released_runs.clear()
    monkeypatch.setattr(runs, "MOST_KEPT", 0)
    stepper.integrate(Q, P, **FIXED)
    assert not stepper._released_runs


@pytest.fixture(scope="module")
def chains():
    """Chains of run-time sizes: elastic, and with fixed distances from the origin that depend on a parameter."""
    kinetic = "sum(i in N, (x_dot[i]**2 + y_dot[i]**2)/2) - k*sum(i in 0..N-2, (x[i+1] - x[i])**2 + (y[i+1] - y[i])**2)"
    common = {"coordinates": ["x[N]", "y[N]"], "parameters": {"k": 0.7}, "lagrangian": kinetic}
    held = {"constraints": ["x[i]**2 + y[i]**2 - 1 for i in N"]}
    kinds = ({}, "svi:4"), (held, "stoermer-verlet")
    return [sc.compile_stepper(sc.LagrangianSystem.from_text(name="chain", **common, **each), by) for each, by in kinds]


def test_calls_of_arrays_take_few_function_calls(chains):
    q, p = {"x": np.arange(3.0), "y": np.zeros(3)}, np.zeros(6)
    run = chains[0].integrate(q, p, h=0.05, steps=50)
    chains[0].integrate(q, p, h=0.05, steps=1)
    with at_most(550):
        chains[0].integrate(q, p, h=0.05, steps=1)
    run.momentum_maps()
    with at_most(400):
        run.momentum_maps()


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


@pytest.mark.parametrize("save_every", [1, 3])
@pytest.mark.parametrize("plan", [{"h": 0.05, "steps": 400}, {"t_end": 9.0}])
def test_number_of_calls_of_c_does_not_matter(stepper, plan, save_every, monkeypatch):
    done = []
    whole = numbers(stepper.integrate(Q, P, **plan, save_every=save_every))
    monkeypatch.setattr(chunks, "CALL_SECONDS", 1e-9)
    for module in (memory, run_loop):
        monkeypatch.setattr(module, "FIRST_STEPS", 4)
    assert numbers(stepper.integrate(Q, P, **plan, save_every=save_every, progress=done.append)) == whole
    assert len(done) > 20
    assert done == sorted(set(done))
