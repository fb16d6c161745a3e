"""Every pair of options of steps, as flags and as keys of a model file: the run of Python, or refused by name.

The cells of ``TABLE`` are run. ``=`` means that the states in the file of the command are bitwise those of
``integrate`` with the same options, ``-`` that the command is refused and the message contains its name.
"""

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import error_of, output_of

import scvi_codegen as sc

BASE = "[system]\nname = 'pendulum'\ncoordinates = ['x']\nlagrangian = 'x_dot**2/2 + cos(x)'\n"
BASE += "[method]\nmethod = 'svi'\ndegree = 4\n"
STATE = "[initial]\nq = [1.0]\np = [0.25]\n"
STEPS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "steps": ({"step": 0.125, "steps": 16}, {"h": 0.125, "steps": 16}),
    "span": ({"step": 0.15, "span": 2.0}, {"h": 0.15, "t_end": 2.0}),
    "tolerance": ({"tolerance": 1e-6, "span": 2.0}, {"tolerance": 1e-6, "t_end": 2.0}),
    "round-off": ({"span": 2.0}, {"t_end": 2.0}),
    "error": ({"error": 1e-6, "span": 2.0}, {"error": 1e-6, "t_end": 2.0}),
}
"""Keys of a model file, which are flags as well, and arguments of ``integrate``."""
EVENT, TERMINAL = {"function": "x", "direction": -1}, {"function": "x", "terminal": 1}
OPTIONS: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "tolerance": ({"tolerance": 1e-5}, {"tolerance": 1e-5}),
    "error": ({"error": 1e-5}, {"error": 1e-5}),
    "max_step": ({"max_step": 0.1}, {"max_step": 0.1}),
    "first_step": ({"first_step": 0.01}, {"first_step": 0.01}),
    "absolute_tolerance": ({"absolute_tolerance": 0.5}, {"absolute_tolerance": 0.5}),
    "absolute_tolerance, named": ({"absolute_tolerance": {"x": 0.5}}, {"absolute_tolerance": {"x": 0.5}}),
    "save_every": ({"save_every": 3}, {"save_every": 3}),
    "t_eval": ({"t_eval": [0.5, 1.25]}, {"t_eval": [0.5, 1.25]}),
    "event": ({"event": EVENT}, {}),
    "event, terminal": ({"event": TERMINAL}, {}),
    "precision": ({"precision": "double-double"}, {}),
}
TABLE = """
                           steps span tolerance round-off error
tolerance                  -     -    =         =         -
error                      -     -    -         =         =
max_step                   -     -    =         =         =
first_step                 -     -    =         =         =
absolute_tolerance         -     -    =         =         =
absolute_tolerance, named  -     -    =         =         =
save_every                 =     =    =         =         =
t_eval                     =     =    =         =         =
event                      =     =    =         =         =
event, terminal            =     =    =         =         =
precision                  =     =    =         =         =
"""
COLUMNS, *ROWS = (line for line in TABLE.splitlines() if line)
CELLS = {
    (line[:27].strip(), steps): cell
    for line in ROWS
    for steps, cell in zip(COLUMNS.split(), line[27:].split(), strict=True)
}


@cache
def stepper_of(event: str, precision: str) -> sc.Stepper:
    events = {"": (), "event": (sc.Event(**EVENT),), "event, terminal": (sc.Event(**TERMINAL),)}[event]
    system = sc.LagrangianSystem.from_text("pendulum", ["x"], "x_dot**2/2 + cos(x)")
    return sc.compile_stepper(system, "svi:4", precision=precision, events=events)


def toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{name} = {toml(each)}" for name, each in value.items()) + "}"
    return repr(value)


def flags(values: dict[str, Any]) -> list[str]:
    words = []
    for name, value in values.items():
        text = str(value)
        if name == "event":
            text = "; ".join(
                [value["function"], *(f"{key}={each}" for key, each in value.items() if key != "function")]
            )
        elif isinstance(value, dict):
            text = ",".join(f"{key}={each}" for key, each in value.items())
        elif isinstance(value, list):
            text = ",".join(map(str, value))
        words += [f"--{name.replace('_', '-')}", text]
    return words


def document(values: dict[str, Any]) -> str:
    event = values.pop("event", {})
    run = "".join(f"{name} = {toml(value)}\n" for name, value in values.items())
    text = f"{BASE}{STATE}[run]\n{run}"
    return text + "".join(
        f"[[events]]\n{''.join(f'{key} = {toml(x)}{chr(10)}' for key, x in event.items())}" * bool(event)
    )


@pytest.mark.covering
@pytest.mark.usefixtures("here")
@pytest.mark.parametrize("way", ["flags", "file"])
@pytest.mark.parametrize("steps", STEPS)
@pytest.mark.parametrize("option", OPTIONS)
def test_options(option: str, steps: str, way: str) -> None:
    (values, arguments), (further, further_arguments) = STEPS[steps], OPTIONS[option]
    both = values | further
    Path("m.toml").write_text(document({} if way == "flags" else dict(both)), encoding="utf-8")
    words = ["run", "m.toml", *(flags(both) if way == "flags" else []), "-o", "m.npz"]
    if CELLS[option, steps] == "-":
        assert option.split(",")[0] in error_of(*words).replace("-", "_")
        return
    output_of(*words)
    stepper = stepper_of(option if option.startswith("event") else "", further.get("precision", "double"))
    expected = stepper.integrate([1.0], [0.25], **arguments | further_arguments)
    with np.load("m.npz") as file:
        for name in ("t", "q", "p"):
            assert np.array_equal(file[name], np.asarray(getattr(expected, name)))
