"""Overhead of calls of ``integrate`` in function calls instead of seconds, and the reuse of runs."""

from __future__ import annotations

import threading
from functools import partial
from itertools import chain

import numpy as np
import pytest
from counting import TooMuchWorkError, at_most, visited

import scvi_codegen as sc

Q, P = np.array([0.4, 0.0]), np.array([0.0, 2.0])
FIXED, ADAPTIVE = {"h": 0.05, "steps": 1}, {"t_end": 0.05, "tolerance": 1e-10}


@pytest.fixture(scope="module")
def stepper():
    return sc.compile_stepper(sc.problem("kepler").system, sc.SVI(8))


@pytest.mark.parametrize("convert", [list, tuple, np.array])
@pytest.mark.parametrize(
    ("integrate", "plan", "calls"),
    [
        *(("integrate", {"h": 0.05, "steps": steps}, 40) for steps in (1, 900)),
        *(("integrate", {"t_end": t_end, "tolerance": 1e-10}, 62) for t_end in (0.05, 200.0)),
        ("integrate_ensemble", FIXED, 250),
    ],
)
def test_a_call_takes_few_function_calls(stepper, convert, integrate, plan, calls):
    """The limit is a tenth above the present number, and does not depend on the machine."""
    run = partial(getattr(stepper, integrate), convert(Q.tolist()), convert(P.tolist()), **plan)
    run()
    with at_most(calls):
        run()
    with pytest.raises(TooMuchWorkError), at_most(calls // 2):
        run()


@pytest.mark.parametrize("plan", [FIXED, ADAPTIVE, {"t_end": 0.05}])
def test_a_repeated_call_visits_few_functions_and_files(stepper, plan):
    stepper.integrate(Q, P, **plan)
    with visited() as functions:
        stepper.integrate(Q, P, **plan)
    files = {file for file, _ in functions if "scvi_codegen" in file}
    assert 5 <= len(files) <= 8
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
