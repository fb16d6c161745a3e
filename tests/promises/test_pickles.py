"""Options of steppers and runs survive pickling; none is replaced by a default."""

from __future__ import annotations

import pickle
from functools import cache
from typing import Any

import numpy as np
import pytest
from notation import lagrange
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen import Stepper, compile_stepper, problem
from scvi_codegen.codegen.variants import TangentVectors
from scvi_codegen.runs.stepping.step_plan import Adaptive

Q, P = [0.3, 0.8], [-1.1, 0.4]
H, STEPS = 0.1, 6
KEPLER = problem("kepler").system
STEPPERS: dict[str, dict[str, Any]] = {
    "": {},
    "solver": {"solver": "newton"},
    "flags": {"flags": (*QUICK_FLAGS, "-DCHOSEN")},
    "prefix": {"prefix": "chosen"},
    "symmetries": {"symmetries": [sc.check_symmetry(KEPLER, ["q2 + 0*q1", "-q1"])]},
    "events": {"events": ["q1 - 0.25", sc.Event("q2 - 0.7", direction=-1)]},
    "time_transformation": {"time_transformation": "distance"},
    "controller": {"controller": "reversible", "time_transformation": "distance"},
}
"""By the option that it is not the default of."""


@cache
def stepper(option: str) -> Stepper:
    return compile_stepper(KEPLER, "svi:3", **{"flags": QUICK_FLAGS, **STEPPERS[option]})


def copied(original: Any) -> Any:
    return pickle.loads(pickle.dumps(original))


@pytest.mark.tiers(2, 3)
@pytest.mark.sampled(3)
@pytest.mark.parametrize("option", STEPPERS)
def test_pickled_stepper_is_equal(option: str) -> None:
    own = stepper(option)
    made = {
        "changes": own._variants[TangentVectors(2)],
        "second_derivatives": own.second_derivatives,
    }  # which go if asked for
    for copy in (copied(own), copied(copied(own))):
        saved = ("title", "interface", "flags", "events", "source", "ensemble", "fallback", "derivatives")
        assert [name for name in saved if getattr(copy, name) != getattr(own, name)] == []
        assert {"changes": copy._variants[TangentVectors(2)], "second_derivatives": copy.second_derivatives} == made
        in_tau = "time_transformation" in STEPPERS[option]
        plan: dict[str, Any] = {"h": 0.2, "t_end": 0.5} if in_tau else {"h": H, "steps": STEPS}
        runs = [each.integrate(Q, P, **plan) for each in (own, copy)]
        assert_same(*runs)
        assert [len(each) for each in runs[0].events] == [len(each) for each in runs[1].events]
        if not in_tau:
            assert_same(*(each.integrate(Q, P, t_end=0.5) for each in (own, copy)))
            assert_same(*(each.integrate_ensemble([Q], [P], h=H, steps=STEPS) for each in (own, copy)))


def test_missing_second_derivatives_are_named() -> None:
    with pytest.raises(sc.MethodError, match="a pickled stepper has second derivatives only if"):
        _ = copied(compile_stepper(KEPLER, "svi:2", flags=QUICK_FLAGS))._second_derivatives


def assert_same(one: Any, other: Any) -> None:
    assert np.array_equal(one.t, other.t)
    assert np.array_equal(one.q, other.q)
    assert np.array_equal(one.p, other.p)


def test_target_time_of_a_run_may_be_changed_and_is_pickled() -> None:
    run = stepper("").start(Q, P, t_end=5.0)
    run.update(plan=Adaptive(0.7, 1e-6))
    assert copied(run).plan == Adaptive(0.7, 1e-6)
    assert copied(run).record().t[-1] == 0.7


@cache
def driven() -> Stepper:
    system = lagrange("cart with two forces", "x", "x_dot**2/2 - x**2/2 + u*x + w*x**2", inputs="u w")
    return compile_stepper(system, "svi:2", flags=QUICK_FLAGS)


@pytest.mark.parametrize("names_set", [(), ("u",), ("w",), ("u", "w")])
def test_run_requires_inputs_that_are_not_set(names_set: tuple[str, ...]) -> None:
    run = driven().start([0.3], [0.1], h=H)
    run.set_inputs(**dict.fromkeys(names_set, 0.7))
    copy = copied(run)
    for each in (run, copy):
        for name in {"u", "w"} - set(names_set):
            with pytest.raises(sc.StateError, match=r"the input '[uw]' is not set"):
                each.advance(1)
            each.set_inputs(**{name: 0.2})
        each.advance(2)
    assert copy.checkpoint() == run.checkpoint()
