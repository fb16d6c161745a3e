"""Certificates of runs with contacts and located kinks, and errors of runs that they detect."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

import scvi_codegen as sc
from scvi_codegen.extras.verification import Outcome
from scvi_codegen.extras.verification.impacts import run_of, transition_checks
from scvi_codegen.extras.verification.system_under_test import State, SystemUnderTest
from scvi_codegen.systems.contacts.modes import in_all_modes
from scvi_codegen.systems.kinks import located_kinks

BOUNCES = [sc.contact("y", slip="x_dot", friction=0.2, restitution=0.5)]
BELT = [sc.friction("x_dot - 0.3", limit=0.25, static_limit=0.4)]
SPACE = [sc.contact("z", slip=["x_dot", "y_dot"], friction=0.5, restitution=0.4)]
HITS = {"complementarity", "impacts of contacts", "friction of impacts"}
PLANE = "(x_dot**2 + y_dot**2)/2"
SYSTEMS: dict[str, tuple[str, str, list[Any], list[float], list[float], set[str]]] = {
    "bounces": ("x y", f"{PLANE} - 9.81*y - x**2", BOUNCES, [0, 1], [1, 0], {"friction"} | HITS),
    "space": (
        "x y z",
        f"{PLANE} + z_dot**2/2 - 9.81*(z - x/3)",
        SPACE,
        [0, 0, 0.2],
        [0.3, 1.5, 0],
        {"friction"} | HITS,
    ),
    "belt": ("x", "x_dot**2/2 - x**2/2", BELT, [0], [0.3], {"friction", "closed contacts"}),
    "floor": ("y", "y_dot**2/2 - 9.8*y - 1e3*positive_part(-y)**2", [], [1], [0], {"sides of kinks"}),
    "lens": ("x y", f"{PLANE} - 0.3*unit_step(x) - x**2*(1 + y/9)", [], [-1, 0.2], [1.5, 0.6], {"states at kinks"}),
}
ALWAYS = {"transitions", "order across transitions", "stage equations", "order", "derivatives"}


@cache
def made(name: str) -> tuple[Any, Any, State]:
    coordinates, lagrangian, contacts, q, velocity, _ = SYSTEMS[name]
    system = sc.LagrangianSystem.from_text(name, coordinates.split(), lagrangian, contacts=contacts)
    stepper = sc.compile_stepper(system, "svi:2")
    return system, stepper, State(np.array(q, float), stepper.momentum(q, velocity), 0.0, 0.05)


@pytest.mark.rotated
@pytest.mark.parametrize("name", SYSTEMS)
def test_runs_with_transitions_are_certified(name: str) -> None:
    system, stepper, start = made(name)
    certificate = sc.verify(system, "svi:2", start.q, start.p, h=start.h, stepper=stepper)
    assert certificate.passed, certificate.to_text()
    satisfied = {check.name for check in certificate.checks if check.outcome is Outcome.SATISFIED}
    assert ALWAYS | SYSTEMS[name][-1] <= satisfied


@pytest.mark.rotated
@pytest.mark.parametrize(
    ("name", "before", "q", "p", "violated"),
    [
        ("belt", 1e-9, 0, 0, "transitions"),
        ("belt", 0, 0, 1e-9, "closed contacts"),
        ("belt", 0, 0.5, 0, "friction"),
        ("bounces", 0, -1e-9, 0, "complementarity"),
        ("bounces", 0, 0, 1e-9, "impacts of contacts"),
        ("space", 0, 0, 1e-9, "impacts of contacts"),
        ("space", 0, 0, [0, -1e-8, 0], "friction of impacts"),
        ("floor", 0, 0.1, 0, "sides of kinks"),
        ("lens", 0, 0, 1e-9, "states at kinks"),
        ("lens", 0, 0, 0, None),
    ],
)
def test_an_error_of_a_run_is_detected(name: str, before: float, q: float, p: Any, violated: str | None) -> None:
    """Of states before transitions, and of positions and momenta of all states."""
    system, stepper, start = made(name)
    run = run_of(stepper, start, start.h, steps=200)
    form = located_kinks(in_all_modes(system))[0].with_parameters(**stepper.parameters_by_name(run.parameters))
    transitions = tuple(replace(ends, q=ends.q + before) for ends in run.transitions)
    run = replace(run, transitions=transitions, q=run.q + q, p=np.add(run.p, p))
    checks = transition_checks(SystemUnderTest(form, sc.SVI(2), stepper, None, start), run)
    found = {check.name for check in checks if check.outcome is Outcome.VIOLATED}
    assert violated in found if violated else not found


@pytest.mark.second
def test_a_stepper_with_other_contacts_is_refused() -> None:
    plain = sc.LagrangianSystem.from_text("belt", ["x"], SYSTEMS["belt"][1])
    with pytest.raises(sc.StateError, match=r"'belt' has other contacts than .* pass a system with them, contacts="):
        sc.verify(plain, "svi:2", stepper=made("belt")[1])
