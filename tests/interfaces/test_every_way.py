"""Models run every way: Python, model file, command line, folder and its C program give equal states.

Each model is a text with the arguments that ``integrate`` takes for it. States of Python, of the model, of the command
line and of the generated folder are equal bit by bit, those that the C program prints up to its compiler's flags.
"""

import re
import subprocess
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from commands import output_of
from numpy.testing import assert_allclose
from programs import needs

import scvi_codegen as sc
from scvi_codegen.codegen.native.building import PORTABLE_FLAGS
from scvi_codegen.interfaces.models.model_files.model_file import dump_model, parse_model
from scvi_codegen.runs.stepping.step_plan import Adaptive

T, U = (0.0, 0.37, 0.9, 1.41, 2.05, 2.6), (0.0, 1.2, -0.7, 0.4, 1.9, -1.0)
STRICT = "-O1 -std=c99 -Wall -Wextra -Wpedantic -Wshadow -Wconversion -Werror -ffp-contract=off"


def system(coordinates, formula, *lines, q, moving):
    """The sections of a system and of its initial state."""
    text = f"[system]\nname = 'moving'\ncoordinates = {coordinates}\n{formula}\n"
    return "\n".join([text, *lines, "[initial]", f"q = {q}", moving, ""])


PUSHED = system(
    ["q"],
    "lagrangian = '(1 + w)*q_dot**2/2 + cos(q)'\ninputs = ['u', 'w']",
    "[forces]\nq = '2*u - c*q_dot'\n[inputs]\nu = { file = 'tables/u.csv', kind = 'cubic' }",
    "w = { t = [-1.0, 0.5, 1.41, 3.0], values = [0.0, 0.3, 0.1, 0.2] }\n[parameters]\nc = 0.2",
    q=[0.3],
    moving="q_dot = [0.5]",
)
HAMILTONIAN = PUSHED.replace("lagrangian = '(1 + w)*q_dot**2/2 +", "hamiltonian = 'p_q**2/2 - (1 + w)*")
G = "(x**2 + y**2)**(3/4)"
SHAKEN = system(
    ["x", "y"],
    "lagrangian = '(x_dot**2 + y_dot**2)/2 + 1/sqrt(x**2 + y**2) + x*cos(t)/100'",
    f"time_transformation = '{G}'\n[forces]\nx = '-x_dot/1000'",
    q=[0.2, 0.0],
    moving="p = [0.0, 3.0]",
)
RING = system(
    ["q[N]"],
    "lagrangian = 'sum(i in N, q_dot[i]**2/2) - k*sum(i in N periodic, (q[i+1] - q[i])**2/2)'",
    "[sizes]\nN = 8\n[parameters]\nk = 1.0",
    q="'sin(2*pi*i/N)'",
    moving="q_dot = 'cos(2*pi*i/N) + 1/10'",
)
KEPLER = "[system]\ncatalogue = 'kepler'\n"
IN_TAU = f"{KEPLER}time_transformation = 'frequency'\n"
TABLE = "{ file = 'tables/u.csv', kind = 'cubic' }"
INPUTS = {"u": (T, U, "cubic"), "w": ((-1.0, 0.5, 1.41, 3.0), (0.0, 0.3, 0.1, 0.2))}


class Case(NamedTuple):
    """A model file (``run``: keys of its section), and a phrase of the printed summary.

    ``error``: of the states that the C program prints; 0 for equal bits with portable flags. ``inputs`` and ``t``:
    arguments of ``integrate`` that are in other sections of the file.
    """

    text: str
    method: str
    run: dict
    printed: str
    error: float = 0.0
    g: str | None = None
    inputs: dict = {}  # noqa: RUF012  (read only)
    t: float = 0.0

    @property
    def arguments(self):
        """The arguments of ``integrate`` for the keys of the file."""
        names = {"step": "h", "steps": "steps", "save_every": "save_every", "tolerance": "tolerance"}
        found = {names[key]: value for key, value in self.run.items() if key in names}
        if "span" in self.run:
            found["t_end"] = self.t + np.copysign(self.run["span"], self.run.get("step", 1.0))
        if self.g:  # a step size of tau, which is positive
            found["h"] = abs(found["h"])
        return found | ({"inputs": self.inputs} if self.inputs else {}) | ({"t": self.t} if self.t else {})


def catalogue(name):
    return KEPLER.replace("kepler", name)


BACKWARD = PUSHED.replace("[initial]", "[initial]\nt = 2.55")
OF_MOMENTA = HAMILTONIAN.replace("c*q_dot", "c*p_q").replace("q_dot = [", "p = [")
STEPS, SPAN = {"step": 0.03, "span": 2.3}, {"step": 0.1, "span": 12.0, "controller": "reversible"}
CASES = {
    "pendulum": Case(catalogue("planar-pendulum"), "svi:3", {"step": 0.05, "steps": 41}, "41 steps"),
    "driven": Case(
        catalogue("duffing"), "sc:2", {"step": 0.05, "steps": 60, "save_every": 3}, "60 steps of 0.05 from t"
    ),
    "planets": Case(
        catalogue("outer-solar-system"), "svi:2", {"step": 20.0, "steps": 40, "save_every": 2}, "angular momentum z"
    ),
    "backward": Case(KEPLER, "gauss:2", {"step": -0.05, "span": 0.95}, "to t = -0.95"),
    "adaptive": Case(KEPLER, "svi:4", {"tolerance": 1e-9, "span": 10.0}, "rejected", 1e-8),
    "inputs": Case(PUSHED, "svi:4", STEPS, "to t = 2.3", inputs=INPUTS),
    "constant input": Case(
        PUSHED.replace(TABLE, "0.5"),
        "svi:4",
        STEPS | {"step": 0.1},
        "in the digits that the error of the run leaves",
        inputs=INPUTS | {"u": 0.5},
    ),
    "adaptive inputs": Case(PUSHED, "svi:4", {"span": 2.3}, "rejected) from t = 0", 3e-13, inputs=INPUTS),
    "inputs backward": Case(
        BACKWARD, "gauss:2", STEPS | {"step": -0.07}, "from t = 2.55 to t = 0.25", inputs=INPUTS, t=2.55
    ),
    "Hamiltonian": Case(OF_MOMENTA, "stoermer-verlet", STEPS, "to t = 2.3", inputs=INPUTS),
    "tau": Case(IN_TAU, "svi:8", {"step": 0.2, "span": 20.0}, "in tau from t = 0 to t = 20;", 1e-12),
    "tau backward": Case(IN_TAU, "svi:4", {"step": -0.2, "span": 5.0}, "to t = -5;", 1e-12),
    "controller": Case(SHAKEN, "svi:6", SPAN, "of 0.1 in tau by the reversible controller from t = 0", 1e-9, G),
    "controller backward": Case(SHAKEN, "svi:6", SPAN | {"step": -0.1, "span": 2.0}, "from t = 0 to t = -2;", 1e-9, G),
    "array": Case(RING, "svi:4", {"step": 0.1, "steps": 20, "save_every": 5}, "moving: 8 coordinates, N = 8"),
}


@pytest.fixture(autouse=True)
def folder(here):
    """The model's table in a folder of its own; paths are relative to the model file."""
    Path("models/tables").mkdir(parents=True)
    Path("models/tables/u.csv").write_text("t,u\n\n" + "".join(f"{t!r}, {u!r}\n" for t, u in zip(T, U, strict=True)))


def read(case):
    """Load the model of a case from its file."""
    run = "\n".join(f"{key} = {value!r}" for key, value in case.run.items())
    Path("models/model.toml").write_text(f"{case.text}[method]\nmethod = '{case.method}'\n[run]\n{run}\n")
    return sc.load_model("models/model.toml")


def moving(model):
    return {"p": model.p} if model.p is not None else {"velocity": model.velocity}


def rows(state):
    """A state, or states, as rows, of arrays too."""
    return np.hstack([*state.values()]) if isinstance(state, dict) else state


def assert_equal(found, run):
    """Times and states of a run, a trajectory or a file of it are those of another, bit by bit."""
    assert np.array_equal(found["t"] if isinstance(found, dict) else found.t, run.t)
    for name in "qp":
        one = found[name] if isinstance(found, dict) else rows(getattr(found, name))
        assert np.array_equal(one, rows(getattr(run, name)))


def compiled(case, model, **options):
    """A stepper and its run, without the model."""
    stepper = sc.compile_stepper(model.system, model.method, time_transformation=case.g, **options)
    return stepper, stepper.integrate(model.q, **moving(model), **case.arguments)


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("name", CASES)
def test_every_way_gives_the_states_of_integrate(name):
    case = CASES[name]
    model = read(case)
    assert parse_model(dump_model(model)) == model
    stepper, run = compiled(case, model)
    assert_equal(model.integrate(), run)
    if not model.in_transformed_time:
        started = model.start(stepper)
        for steps in model.segments(started):
            started.record(steps)
        assert started.t == run.t[-1]
        assert all(np.array_equal(rows(x), rows(y)[-1]) for x, y in ((started.q, run.q), (started.p, run.p)))
    printed = output_of("run", "models/model.toml", "-o", "run.npz")
    assert case.printed in printed
    with np.load("run.npz") as file:
        assert_equal({"t": file["t"], "q": file["q"], "p": file["p"]}, run)
    made = sc.generate_package(model, "made")
    assert sc.load_model(made / "model.toml") == model
    loaded = sc.load_package(made)
    assert (loaded.coordinates, loaded.parameters) == (stepper.coordinates, stepper.parameters)
    assert_equal(loaded.integrate(model.q, **moving(model), **case.arguments), run)


def printed_states(folder, compiler):
    """Numbers of the lines that the program of a folder prints, and its comments."""
    command = ["make", "-s", "-C", folder, "run", f"CC={compiler}", f"CFLAGS={STRICT}"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    lines = done.stdout.splitlines()
    return np.array([line.split() for line in lines if line[0] != "#"], dtype=float), [x for x in lines if x[0] == "#"]


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize(
    ("name", "compiler"), [*((name, "cc") for name in CASES if name != "array"), ("driven", "gcc"), ("driven", "clang")]
)
def test_programs_print_the_states_of_integrate(name, compiler):
    """Steps of a fixed size have equal bits with portable flags; of others the last state is compared."""
    needs("make", compiler)
    case = CASES[name]
    model = read(case)
    printed, comments = printed_states(sc.generate_package(model, "made"), compiler)
    stepper, run = compiled(case, model, flags=PORTABLE_FLAGS)
    found, m = printed[:, : 1 + 2 * stepper.dimension], stepper.dimension
    assert 2 < len(printed) <= 21
    if "time_transformation" not in case.text:  # others end with the step that reaches the end
        assert printed[-1, 0] == pytest.approx(run.t[-1], abs=1e-12)
    start = stepper.integrate(model.q, found[0, 1 + m :], **case.arguments | {"save_every": 1})
    states = np.column_stack([start.t, start.q, start.p])
    nearest = np.abs(start.t[:, np.newaxis] - found[:, 0]).argmin(axis=0)
    same = np.abs(start.t[nearest] - found[:, 0]) < 1e-9
    assert same.all() if case.error == 0.0 else same[0] and same.sum() > 1
    assert_allclose(found[same], states[nearest[same]], rtol=0, atol=case.error)
    if isinstance(start.plan, Adaptive):  # steps also end at the printed times
        steps, rejected = map(int, re.fullmatch(r"# (\d+) steps, (\d+) rejected", comments[-1]).groups())
        assert start.steps <= steps < start.steps + len(printed)
        assert abs(rejected - start.rejected_steps) < 3
    energy = "energy_change" if model.system.changes_energy else "energy_error"
    names = [coordinate.name for coordinate in model.system.coordinates]
    assert comments[0].split() == ["#", "t", *names, *(f"p_{name}" for name in names), energy]
    assert np.abs(printed[:, -1]).max() <= 2 * np.abs(run.energy() - run.energy()[0]).max() + 1e-13
