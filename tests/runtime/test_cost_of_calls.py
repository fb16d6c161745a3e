"""Overhead of calls of ``integrate`` in function calls instead of seconds, and the reuse of runs."""

from __future__ import annotations

import threading
from itertools import chain

import numpy as np
import pytest
from counting import TooMuchWorkError, at_most

from scvi_codegen import SVI, StateError, StepFailedError, compile_stepper, problem
from scvi_codegen.runtime.run import chunks, run_loop
from scvi_codegen.runtime.run import run as runs

Q, P = np.array([0.4, 0.0]), np.array([0.0, 2.0])
FIXED, ADAPTIVE = {"h": 0.05, "steps": 1}, {"t_end": 0.05, "tolerance": 1e-10}


@pytest.fixture(scope="module")
def stepper():
    return compile_stepper(problem("kepler").system, SVI(8))


@pytest.mark.parametrize(("plan", "calls"), [(FIXED, 59), (ADAPTIVE, 82)])
def test_a_call_takes_few_function_calls(stepper, plan, calls):
    """The limit is a tenth above the present number, and does not depend on the machine."""
    stepper.integrate(Q, P, **plan)
    with at_most(calls):
        stepper.integrate(Q, P, **plan)
    with pytest.raises(TooMuchWorkError), at_most(calls // 2):
        stepper.integrate(Q, P, **plan)


def numbers(found):
    return [x.tobytes() for x in (found.t, found.q, found.p, found.iterations, found.step_sizes, found.parameters)]


@pytest.mark.parametrize("plan", [{"h": 0.05, "steps": 400}, {"t_end": 9.0}])
def test_memory_of_earlier_calls_does_not_matter(stepper, plan):
    first = stepper.integrate(Q, P, **plan)
    saved = numbers(first)
    stepper.integrate(2.0 * Q, P, **plan, t=3.0 if "h" in plan else 1.0, parameters={"mu": 1.5})
    with pytest.raises(StepFailedError):
        stepper.integrate(Q, 0.0 * P, **({"h": 0.05, "steps": 400} if "h" in plan else {"t_end": 9.0}))
    with pytest.raises(StateError):
        stepper.integrate([np.nan, 0.0], P, **plan)
    assert numbers(first) == saved == numbers(stepper.integrate(Q, P, **plan))
    assert saved == numbers(compile_stepper(problem("kepler").system, SVI(8)).integrate(Q, P, **plan))


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


@pytest.mark.parametrize("save_every", [1, 3])
@pytest.mark.parametrize("plan", [{"h": 0.05, "steps": 400}, {"t_end": 9.0}])
def test_number_of_calls_of_c_does_not_matter(stepper, plan, save_every, monkeypatch):
    done = []
    whole = numbers(stepper.integrate(Q, P, **plan, save_every=save_every))
    monkeypatch.setattr(chunks, "CALL_SECONDS", 1e-9)
    monkeypatch.setattr(run_loop, "FIRST_STEPS", 4)
    assert numbers(stepper.integrate(Q, P, **plan, save_every=save_every, progress=done.append)) == whole
    assert len(done) > 20
    assert done == sorted(set(done))
