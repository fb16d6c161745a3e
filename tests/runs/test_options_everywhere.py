"""Every option of runs in every way to run: equal to single runs, or refused by an error that names the option.

The cells of ``TABLE`` are run. ``=`` means that each trajectory ends at the state, time and events of the single
run with the same option, ``-`` that the call is refused and the message contains the name of the option.
"""

import warnings
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen.common.errors import ScviCodegenError
from scvi_codegen.extras.distributed.blocks import integrate_ensemble
from scvi_codegen.runs.ensembles import batches

PENDULUM = sc.LagrangianSystem.from_text("pendulum", ["x"], "x_dot**2/2 + k*cos(x)", parameters={"k": 1.0})
PUSHED = lagrange("pushed", "x", "x_dot**2/2 + k*cos(x)", forces={"x": "u - x_dot/10"}, inputs="u", k=1.0)
Q, P = np.array([[1.0], [1.2], [0.7]]), np.array([[0.0], [0.1], [-0.2]])
FIXED, ADAPTIVE = {"h": 0.125, "steps": 40}, {"t_end": 5.0}
PULSE = {"inputs": {"u": ([0.0, 2.0, 5.0], [0.0, 1.0, 0.0])}}
TERMINAL, TURN = sc.Event("x", direction=-1, terminal=1), {"p_x": "-p_x"}
OPTIONS: dict[str, tuple[dict[str, Any], sc.LagrangianSystem, tuple[sc.Event, ...]]] = {
    "steps": (FIXED, PENDULUM, ()),
    "h and t_end": ({"h": 0.123, "t_end": 5.0}, PENDULUM, ()),
    "backward": ({"h": -0.125, "steps": 40}, PENDULUM, ()),
    "adaptive": (ADAPTIVE, PENDULUM, ()),
    "tolerance": (ADAPTIVE | {"tolerance": 1e-6}, PENDULUM, ()),
    "max_step": (ADAPTIVE | {"max_step": 0.1}, PENDULUM, ()),
    "max_step, steps": (FIXED | {"max_step": 0.1}, PENDULUM, ()),
    "max_step, error": (ADAPTIVE | {"max_step": 0.1, "error": 1e-6}, PENDULUM, ()),
    "save_every": (FIXED | {"save_every": 7}, PENDULUM, ()),
    "t": (FIXED | {"t": 0.5}, PENDULUM, ()),
    "parameters": (FIXED | {"parameters": {"k": 2.0}}, PENDULUM, ()),
    "options": (FIXED | {"options": sc.SolverOptions(max_iterations=70)}, PENDULUM, ()),
    "velocity": (ADAPTIVE | {"velocity": P}, PENDULUM, ()),
    "t_eval": (ADAPTIVE | {"t_eval": [1.0, 3.0, 5.0]}, PENDULUM, ()),
    "inputs": (FIXED | PULSE, PUSHED, ()),
    "inputs, adaptive": (ADAPTIVE | PULSE, PUSHED, ()),
    "max_step, inputs": (ADAPTIVE | PULSE | {"max_step": 0.1}, PUSHED, ()),
    "observe=extremes": (FIXED | {"observe": "extremes"}, PENDULUM, ()),
    "observe=energy": (FIXED | {"observe": "energy"}, PENDULUM, ()),
    "observe, adaptive": (ADAPTIVE | {"observe": "extremes"}, PENDULUM, ()),
    "observe, terminal": (FIXED | {"observe": "extremes"}, PENDULUM, (TERMINAL,)),
    "error": (ADAPTIVE | {"error": 1e-8}, PENDULUM, ()),
    "error, terminal": (ADAPTIVE | {"error": 1e-8}, PENDULUM, (TERMINAL,)),
    "action": (FIXED | {"action": True}, PENDULUM, ()),
    "action, terminal": (FIXED | {"action": True}, PENDULUM, (TERMINAL,)),
    "check_growth": (ADAPTIVE | {"check_growth": False}, PENDULUM, ()),
    "events": (FIXED, PENDULUM, (sc.Event("x"),)),
    "events, adaptive": (ADAPTIVE, PENDULUM, (sc.Event("x"),)),
    "terminal": (FIXED, PENDULUM, (TERMINAL,)),
    "terminal, t_end": ({"h": 0.123, "t_end": 5.0}, PENDULUM, (TERMINAL,)),
    "terminal, adaptive": (ADAPTIVE, PENDULUM, (TERMINAL,)),
    "terminal, t_eval": (ADAPTIVE | {"t_eval": [0.5, 4.0]}, PENDULUM, (TERMINAL,)),
    "terminal, save_every": (FIXED | {"save_every": 7}, PENDULUM, (TERMINAL,)),
    "terminal, inputs": (FIXED | PULSE, PUSHED, (TERMINAL,)),
    "then": (FIXED, PENDULUM, (sc.Event("x", direction=-1, then=TURN),)),
    "then, adaptive": (ADAPTIVE, PENDULUM, (sc.Event("x", direction=-1, then=TURN),)),
    "then, terminal=2": (FIXED, PENDULUM, (sc.Event("x", direction=-1, then=TURN, terminal=2),)),
    "then, another terminal": (FIXED, PENDULUM, (sc.Event("x", direction=-1, then=TURN), sc.Event("t-3", terminal=1))),
    "impact": (FIXED | {"save_every": 7}, PENDULUM, (sc.impact("x", 0.9),)),
    "impact, terminal": (ADAPTIVE, PENDULUM, (sc.impact("x", 0.9, terminal=2),)),
}
TABLE = """
                        ensemble lanes threads cluster recorded words
steps                   =        =     =       =       =        =
h and t_end             =        =     =       =       -        =
backward                =        =     =       =       =        =
adaptive                =        =     =       =       =        =
tolerance               =        =     =       =       =        =
max_step                =        =     =       =       =        =
max_step, steps         -        -     -       -       -        -
max_step, error         =        =     =       =       -        =
save_every              =        =     =       =       =        =
t                       =        =     =       =       =        =
parameters              =        =     =       =       =        =
options                 =        =     =       =       =        =
velocity                =        =     =       =       =        =
t_eval                  =        =     =       =       -        =
inputs                  =        =     =       =       -        =
inputs, adaptive        =        =     =       =       -        =
max_step, inputs        =        =     =       =       -        =
observe=extremes        -        =     =       =       -        -
observe=energy          -        =     =       =       -        -
observe, adaptive       -        -     -       -       -        -
observe, terminal       -        -     -       -       -        -
error                   =        =     =       =       -        =
error, terminal         =        =     =       =       -        =
action                  =        =     =       =       -        -
action, terminal        =        =     =       =       -        -
check_growth            -        -     -       -       -        -
events                  =        =     =       =       =        =
events, adaptive        =        =     =       =       =        =
terminal                =        =     =       =       =        =
terminal, t_end         =        =     =       =       -        =
terminal, adaptive      =        =     =       =       =        =
terminal, t_eval        =        =     =       =       -        =
terminal, save_every    =        =     =       =       =        =
terminal, inputs        =        =     =       =       -        =
then                    =        =     =       =       =        =
then, adaptive          =        =     =       =       =        =
then, terminal=2        =        =     =       =       =        =
then, another terminal  =        =     =       =       =        =
impact                  =        =     =       =       =        =
impact, terminal        =        =     =       =       =        =
"""
WAYS, *ROWS = (line for line in TABLE.splitlines() if line)
CELLS = {
    (line[:22].strip(), way): cell for line in ROWS for way, cell in zip(WAYS.split(), line[22:].split(), strict=True)
}


@cache
def stepper_of(system: sc.LagrangianSystem, method: str, **settings: str) -> sc.Stepper:
    return sc.compile_stepper(system, method, **settings)


SETTINGS = {"ensemble": {"solver": "newton"}, "words": {"method": "svi:12", "precision": "double-double"}}
"""Steps by Newton's method have no SIMD lanes: their trajectories are integrated one after the other."""


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    with warnings.catch_warnings(action="ignore"):
        distributed = pytest.importorskip("distributed", reason="needs the extra 'distributed'")
        settings = {"n_workers": 1, "processes": False, "dashboard_address": ":0", "silence_logs": 50}
        with distributed.LocalCluster(**settings) as running:
            yield running.scheduler_address


def of_one(arguments: dict[str, Any], j: int) -> dict[str, Any]:
    return arguments | ({"velocity": arguments["velocity"][j]} if "velocity" in arguments else {})


def single(stepper: sc.Stepper, arguments: dict[str, Any], j: int) -> sc.Trajectory:
    return stepper.integrate(Q[j], None if "velocity" in arguments else P[j], **of_one(arguments, j))


def check_recorded(stepper: sc.Stepper, arguments: dict[str, Any], folder: Path) -> None:
    of_recording = {name: x for name, x in arguments.items() if name in ("steps", "save_every")}
    start = {name: x for name, x in of_one(arguments, 0).items() if name not in of_recording}
    run = stepper.start(Q[0], None if "velocity" in arguments else P[0], **start)
    recorded, expected = sc.record_run(run, folder / "run", **of_recording), single(stepper, arguments, 0)
    assert [len(each) for each in recorded.events] == [len(each) for each in expected.events]
    for one, other in zip(recorded.events, expected.events, strict=True):
        assert np.array_equal(one.t, other.t)
    assert recorded.t[-1] == expected.t[-1]
    assert "max_step" not in arguments or len(recorded.t) == len(expected.t)
    assert np.array_equal(recorded.q[-1], expected.q[-1])


def check_equal(runs: Any, stepper: sc.Stepper, arguments: dict[str, Any]) -> None:
    assert runs.ok.all()
    for j in range(len(Q)):
        one = single(stepper, arguments, j)
        observed = runs.observed
        if observed is not None:
            its = np.array([observed[0][j], observed[1][j]])
            assert np.allclose(its, one.observed, rtol=0.0, atol=1e-12)
            continue
        t, q, p = (each[j] for each in runs.ends)
        crossed = [each for each in one.events if 0 < int(each.event.terminal) <= len(each)]
        end = crossed[-1] if "t_eval" in arguments and crossed else one
        assert t == pytest.approx(end.t[-1], rel=1e-15)
        assert np.abs(q - end.q[-1]).max() < 1e-13
        assert np.abs(p - end.p[-1]).max() < 1e-13
        assert [len(each) for each in runs[j].events] == [len(each) for each in one.events]
        for its, expected in zip(runs[j].events, one.events, strict=True):
            assert np.abs(its.t - expected.t).max(initial=0.0) < 1e-13
        if "max_step" in arguments:
            assert len(one) > (end.t[-1] - one.t[0]) / arguments["max_step"]
        if "error" in arguments:
            assert runs.confirmed_until[j] == one.confirmed_until
            assert runs.global_error[j] == one.global_error
        if "action" in arguments:
            assert abs(runs.action()[j] - one.action()) < 1e-13


@pytest.mark.tiers(2, 5)
@pytest.mark.filterwarnings("ignore::scvi_codegen.common.errors.AccuracyWarning")
@pytest.mark.covering
@pytest.mark.parametrize("option", OPTIONS)
@pytest.mark.parametrize("way", WAYS.split())
def test_option(option: str, way: str, request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: Any) -> None:
    arguments, system, events = OPTIONS[option]
    stepper = stepper_of(system, **{"method": "svi:4"} | SETTINGS.get(way, {})).with_events(events)
    states = Q, None if "velocity" in arguments else P

    def run() -> None:
        if way == "recorded":
            check_recorded(stepper, arguments, tmp_path)
        elif way == "cluster":
            on_cluster = {"address": request.getfixturevalue("cluster"), "blocks": 2}
            check_equal(integrate_ensemble(stepper, *states, **arguments, **on_cluster), stepper, arguments)
        else:
            threads = 2 if way == "threads" else None
            check_equal(stepper.integrate_ensemble(*states, **arguments, threads=threads), stepper, arguments)

    if way == "threads":
        monkeypatch.setattr(batches, "CHUNK_SECONDS", 0.0)
    if CELLS[option, way] == "=":
        run()
        return
    with pytest.raises((ScviCodegenError, TypeError)) as refused:
        run()
    names = [word.split("=")[0] for word in option.replace(" and", ",").split(", ")]
    assert any(name in str(refused.value) for name in names)


def test_the_table_has_all_options() -> None:
    assert {option for option, _ in CELLS} == set(OPTIONS)
