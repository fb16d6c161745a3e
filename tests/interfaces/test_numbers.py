"""Every number that ``run`` prints, and every field of its JSON, compared with the same run in Python.

The command gets its options as flags, the model in Python as keys of the file. That the quantities of a run are right
is tested by ``tests/motions``. A field or a line without a check fails.
"""

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from commands import json_of, output_of

import scvi_codegen as sc
from scvi_codegen.codegen.rendering.source import Interface
from scvi_codegen.interfaces.cli.reports import in_known_digits
from scvi_codegen.interfaces.cli.running import _geometry, final_state
from scvi_codegen.interfaces.models.model_files.model_file import parse_model
from scvi_codegen.runs.stepping.step_plan import FixedSteps

M, K, C, G = 1.75, 0.625, 0.375, 1.25
T = 2.5
PARAMETERS = f"[parameters]\nm = 1.0\nk = 1.0\nc = 0.5\n[initial]\nt = {T}\n"
"""Defaults, which no run below keeps."""
CHANGED = {"m": M, "k": K, "c": C}
SPRINGS = """
[system]
name = "springs"
coordinates = ["x", "y"]
lagrangian = "m*(x_dot**2 + y_dot**2)/2 - k*(x**2 + y**2)/2 - c*(x**2 + y**2)**2/4"
"""
TRANSFORMED = SPRINGS + 'time_transformation = "1/(1 + x**2 + y**2)"\n'
FIXED = {"step": 0.125, "steps": 90, "save_every": 3}
SPAN = {"step": 0.125, "span": 11.25, "save_every": 3}


def flags(run: dict[str, Any], parameters: dict[str, float] = CHANGED) -> list[str]:
    """Return the flags of keys of a model file."""
    options = [(name.replace("_", "-"), value) for name, value in run.items()]
    options += [("parameter", f"{name}={value}") for name, value in parameters.items()]
    return [word for name, value in options for word in (f"--{name}", str(value))]


def largest(x: Any) -> float:
    return float(np.max(np.abs(x)))


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A model as text, and what is printed of its run.

    Attributes:
        reason: why the energy changes, as the run says; "" where it does not.
        symplectic: words on the method.
        known: whether the digits of the end are printed by the error of the run.
    """

    system: str = SPRINGS
    start: str = "q = [1.0, 0.25]\nq_dot = [0.125, 0.5]\n"
    run: dict[str, Any]
    method: str = "svi:2"
    extra: str = ""
    reason: str = ""
    symplectic: str = "symplectic"
    known: bool = True


KINDS = {
    "scalar": Kind(run=FIXED),
    "hamiltonian": Kind(
        system="""
[system]
name = "twisted"
coordinates = ["x"]
momenta = ["r"]
hamiltonian = "r**2*(1 + c*x**2)/(2*m) + k*x**2/2 + x*r/8"
""",
        start="q = [0.75]\np = [0.5]\n",
        run=FIXED,
        method="gauss:2",
    ),
    "forced": Kind(
        system=f'{SPRINGS}[forces]\nx = "-c*x_dot**3 - x_dot/4"\ny = "k*cos(t)"\n',
        run=FIXED,
        reason="forces act",
        symplectic="not symplectic",
    ),
    "damped": Kind(
        system=SPRINGS.replace("lagrangian", 'damping = "c/4"\nlagrangian'),
        run=FIXED,
        reason="damping takes it",
        symplectic="not symplectic",
    ),
    "constrained": Kind(
        system=f"""
[system]
name = "rod"
coordinates = ["x", "y"]
lagrangian = "m*(x_dot**2 + y_dot**2)/2 - {G}*m*y + 0*k*c"
constraints = ["x**2 + y**2 = 1"]
""",
        start="q = [0.6, -0.8]\nq_dot = [0.4, 0.3]\n",
        run=FIXED,
        extra='quadrature = "gauss-lobatto:3"\n',
    ),
    "adaptive": Kind(
        run={"tolerance": 1e-5, "span": 11.25, "save_every": 2}, symplectic="symplectic only at fixed step size"
    ),
    "time in L": Kind(system=SPRINGS.replace("- k*", "- k*(2 + cos(t))*"), run=FIXED, reason="L depends on time"),
    "shorter last step": Kind(run=SPAN | {"span": 11.1875}),
    "inputs": Kind(
        system=f"""
{SPRINGS}inputs = ["u"]
[forces]
x = "u - c*x_dot**3"
[inputs]
u = {{ t = [0.0, {T + 4.5}, {T + 7.3125}, 20.0], values = [0.0, 1.5, -0.5, 0.25] }}
""",
        run=SPAN,
        reason="forces act",
        symplectic="not symplectic",
    ),
    "transformed time": Kind(system=TRANSFORMED, run=SPAN),
    "steps of transformed time": Kind(system=TRANSFORMED, run=FIXED),
    "transformed time by tolerance": Kind(system=TRANSFORMED, run={"tolerance": 1e-6, "span": 11.25, "save_every": 2}),
    "reversible controller": Kind(
        system=TRANSFORMED, run=SPAN | {"controller": "reversible"}, symplectic="symplectic only at fixed step size"
    ),
}


@dataclass(frozen=True)
class Done:
    """A run: its JSON, its text, the file of its states, and the model and the trajectory in Python."""

    kind: Kind
    numbers: dict[str, Any]
    lines: list[str]
    saved: dict[str, Any]
    model: sc.Model
    run: sc.Trajectory

    @property
    def energy_change(self) -> float:
        return largest(self.run.energy() - self.run.energy()[0])

    @property
    def accounted(self) -> bool:
        """Whether the work of forces explains the change of the energy."""
        return self.kind.reason in ("forces act", "damping takes it") and "cos(t)" not in self.kind.system.split("[")[1]

    @property
    def h(self) -> float | None:
        """Step size of t or of tau."""
        if "step" in self.kind.run:
            return self.kind.run["step"]
        return self.model.first_step_size(self.run.stepper) if self.kind.system is TRANSFORMED else None


@pytest.fixture(scope="module", params=list(KINDS))
def done(request: Any, tmp_path_factory: Any) -> Done:
    kind = KINDS[request.param]
    folder = tmp_path_factory.mktemp("numbers")
    path = folder / "model.toml"
    run = "[run]\nstep = 1.0\nspan = 1.0\n"
    path.write_text(f'{kind.system}{PARAMETERS}{kind.start}[method]\nmethod = "{kind.method}"\n{kind.extra}{run}')
    words = ["run", str(path), *flags(kind.run)]
    numbers = json_of(*words, "-o", folder / "states.npz")
    model = sc.load_model(path, {"run": kind.run, "parameters": CHANGED})
    with np.load(folder / "states.npz") as saved:
        states = dict(saved)
    return Done(kind, numbers, output_of(*words).splitlines(), states, model, model.integrate())


def fields_of(done: Done) -> dict[str, Any]:
    """Return the expected value of each field, or a condition on it."""
    kind, run, model = done.kind, done.run, done.model
    names = [coordinate.name for coordinate in model.system.coordinates]
    balance = run.energy() - run.energy()[0] - run.work() if done.accounted else None

    def named(x: Any) -> dict[str, float]:
        return dict(zip(names, x.tolist(), strict=True))

    return {
        "system": model.system.name,
        "method": model.method.name,
        "order": 4,
        "run": lambda x: x.items() >= {"save_every": kind.run["save_every"]}.items(),
        "steps": run.steps,
        "rejected_steps": run.rejected_steps,
        "fallback_steps": 0,
        "h": done.h,
        "states": len(run),
        "seconds": lambda x: 0.0 < x < 5.0,
        "preparation_seconds": lambda x: 0.0 < x < 60.0,
        "energy_change": done.energy_change,
        "energy": run.energy()[0],
        "momentum_errors": dict(
            zip(run.stepper.momentum_map_names, np.abs(run.momentum_errors()).max(axis=0).tolist(), strict=True)
        ),
        "work": None if balance is None else run.work()[-1],
        "energy_balance": None if balance is None else largest(balance),
        "action": None,
        "step_error": run.step_error,
        "worst_step_time": run.worst_step_time,
        "final": {"t": run.t[-1], "q": named(run.q[-1]), "p": named(run.p[-1])},
        "final_error": lambda x: (
            x is None if not kind.known else all(0.0 < y < 1e-2 for part in "qp" for y in x[part].values())
        ),
        "lost": None,
        "failure": None,
        "missed": None,
        "written": lambda x: [Path(name).name for name in x] == ["states.npz"],
    }


def assert_fields(numbers: dict[str, Any], expected: dict[str, Any]) -> None:
    """Check every field, and that there is no other one."""
    assert numbers.keys() == expected.keys()
    wrong = {
        name: numbers[name]
        for name, value in expected.items()
        if not (value(numbers[name]) if callable(value) else numbers[name] == value)
    }
    assert wrong == {}


@pytest.mark.rotated
@pytest.mark.sampled(5)
def test_every_field_of_the_json_is_correct(done):
    assert_fields(done.numbers, fields_of(done))
    for name in ("t", "q", "p"):
        assert np.array_equal(done.saved[name], getattr(done.run, name))


def first_lines(done: Done, lines: list[str]) -> None:
    kind, run, in_tau = done.kind, done.run, "time_transformation" in done.kind.system
    assert lines[0] == done.numbers["system"]
    assert re.fullmatch(rf".*; order 4, {kind.symplectic}, symmetric", lines[1])
    way = f"{done.h:g}" if done.h else f"adaptive size ({run.rejected_steps} rejected)"
    way += " in tau" * in_tau + " by the reversible controller" * ("controller" in kind.run)
    assert lines[2] == f"{run.steps} steps of {way} from t = {T:g} to t = {run.t[-1]:g}; {len(run)} states saved"
    speed = re.fullmatch(r"(\S+) s, (\S+) (\w+) a step, (\S+) iterations a step; prepared in (\S+) s", lines[3])
    a_step = float(speed[2]) * {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[speed[3]]
    assert a_step * run.steps == pytest.approx(float(speed[1]), rel=0.01)
    inside = "span" in kind.run and ((in_tau and "controller" not in kind.run) or kind.run["span"] == 11.1875)
    assert float(speed[4]) == pytest.approx(done.saved["iterations"].sum() / (run.steps - inside), abs=0.006)
    assert 0.0 <= float(speed[5]) < 60.0


def energy_line(done: Done, line: str) -> None:
    change, first = done.energy_change, abs(done.run.energy()[0])
    if done.kind.reason:
        balance = f"; energy balance |E - E0 - W| {done.numbers['energy_balance'] or 0.0:.1e} at most" * done.accounted
        assert line == f"energy: {done.kind.reason}, it changed by {change:.3g} at most{balance}"
        return
    found = re.fullmatch(r"relative energy error: (\S+) at most, drift (\S+) over the run", line)
    assert found[1] == f"{change / first:.2e}"
    rate = np.polyfit(done.run.t, (done.run.energy() - done.run.energy()[0]) / first, 1)[0]
    assert float(found[2]) == pytest.approx(rate * (done.run.t[-1] - T), rel=0.06)


@pytest.mark.tiers(0, 1)
@pytest.mark.sampled(5)
def test_every_line_of_the_text_is_correct(done):
    numbers, rest = done.numbers, done.lines[5:]
    first_lines(done, done.lines)
    energy_line(done, done.lines[4])
    for name, error in numbers["momentum_errors"].items():
        assert rest.pop(0) == f"relative error of {name}: {error:.2e} at most"
    worst = f"largest local error: {numbers['step_error']:.1e} (relative, estimated), step from t = "
    worst += f"{numbers['worst_step_time']:g}" + ": too large" * (numbers["step_error"] > 1e-3)
    assert rest.pop(0) == worst
    accuracy = "in the digits that the error of the run leaves" if done.kind.known else "accuracy unknown"
    assert rest.pop(0) == f"final state ({accuracy})"
    for i, coordinate in enumerate(done.model.system.coordinates):
        found = re.fullmatch(rf" *{coordinate} = +(\S+) +p_{coordinate} = +(\S+) *", rest.pop(0))
        for text, x, known in ((found[1], done.run.q[-1, i], "q"), (found[2], done.run.p[-1, i], "p")):
            digits = 17
            if numbers["final_error"]:
                digits = max(0, math.floor(-math.log10(2 * numbers["final_error"][known][coordinate.name])))
            assert float(text) == pytest.approx(round(x, digits), abs=1e-15)
    assert rest == []


@pytest.fixture
def springs(here: Path) -> Kind:
    kind = KINDS["scalar"]
    Path("model.toml").write_text(f'{kind.system}{PARAMETERS}{kind.start}[method]\nmethod = "svi:2"\n')
    return kind


@pytest.mark.rotated
def test_every_field_and_line_of_an_ensemble_is_correct(springs):
    Path("grid.toml").write_text("[grid]\nx = [0.5, 1.0, 1.5]\nk = [0.5, 2.0]\n")
    words = ("run", "model.toml", *flags(springs.run, {"m": M, "c": C}), "--ensemble", "grid.toml")
    numbers = json_of(*words, "-o", "many.npz")
    runs = []
    for x in (0.5, 1.0, 1.5):
        for k in (0.5, 2.0):
            given = {"initial": {"q": {"x": x, "y": 0.25}}, "parameters": CHANGED | {"k": k}, "run": springs.run}
            runs.append(sc.load_model("model.toml", given).integrate())
    with np.load("many.npz") as saved:
        assert saved["q"] == pytest.approx(np.stack([run.q for run in runs], axis=1), abs=1e-14)
    energy = np.stack([run.energy() for run in runs], axis=1)
    turning = largest([run.momentum_errors() for run in runs])
    checks: dict[str, Any] = {
        "system": "springs",
        "method": sc.SVI(2).name,
        "order": 4,
        "run": FIXED,
        "trajectories": 6,
        "statuses": {"ok": 6},
        "steps": {"least": 90, "most": 90},
        "states": 31,
        "seconds": lambda x: 0.0 < x < 5.0,
        "preparation_seconds": lambda x: 0.0 < x < 60.0,
        "energy": pytest.approx(energy[0], rel=1e-14),
        "action": None,
        "energy_change": pytest.approx(largest(energy - energy[0]), abs=1e-14 * largest(energy)),
        "energy_balance": None,
        "momentum_errors": {"angular momentum": pytest.approx(turning, abs=2e-15)},
        "failure": None,
        "missed": None,
        "written": ["many.npz"],
    }
    assert_fields(numbers, checks)
    lines = output_of(*words).splitlines()
    assert lines[2] == f"6 trajectories of 90 steps of 0.125 from t = {T:g}; 31 states saved of each"
    assert lines[4] == "6 ok"
    relative = np.abs(energy / energy[0] - 1.0)
    worst = np.unravel_index(np.argmax(relative), relative.shape)[1]
    assert lines[5] == f"relative energy error: {relative.max():.2e} at most, of trajectory {worst}"
    assert re.fullmatch(r"relative error of angular momentum: \S+ at most", lines[6])
    assert len(lines) == 7


RING = """
[system]
name = "ring"
coordinates = ["q[N]"]
lagrangian = "sum(i in N, m[i]*q_dot[i]**2/2) - sum(i in N periodic, k*(q[i+1] - q[i])**2/2 + (q[i+1] - q[i])**4/4)"
[sizes]
N = 6
[parameters]
k = 1.0
"m[N]" = "1 + i/4"
[initial]
q = "sin(i)"
q_dot = "cos(i)/4"
[method]
method = "svi:2"
"""


@pytest.mark.second
def test_every_field_and_line_of_an_array_system_is_correct(here):
    Path("ring.toml").write_text(RING)
    given = {"step": 0.25, "steps": 60, "save_every": 4}
    words = ("run", "ring.toml", *flags(given, {"k": 0.75}))
    numbers = json_of(*words)
    run = sc.load_model("ring.toml", {"run": given, "parameters": {"k": 0.75}}).integrate()
    q, p, energy = run.q["q"][-1], run.p["q"][-1], run.energy()
    checks: dict[str, Any | Callable[[Any], bool]] = {
        "system": "ring",
        "method": sc.SVI(2).name,
        "order": 4,
        "run": given,
        "sizes": {"N": 6},
        "steps": 60,
        "h": 0.25,
        "tolerance": None,
        "states": 16,
        "seconds": lambda x: 0.0 < x < 5.0,
        "preparation_seconds": lambda x: 0.0 < x < 60.0,
        "iterations": run.iterations.sum(),
        "energy": energy[0],
        "energy_change": largest(energy - energy[0]),
        "momentum_errors": lambda x: x.keys() == {"momentum of q"} and x["momentum of q"] < 1e-14,
        "rejected_steps": 0,
        "fallback_steps": 0,
        "work": None,
        "energy_balance": None,
        "final_error": None,
        "lost": None,
        "action": None,
        "step_error": run.step_error,
        "worst_step_time": run.worst_step_time,
        "final": {"t": 15.0, "q": {"q": q.tolist()}, "p": {"q": p.tolist()}},
        "failure": None,
        "missed": None,
        "written": [],
    }
    assert_fields(numbers, checks)
    lines = output_of(*words).splitlines()
    assert lines[0] == "ring: 6 coordinates, N = 6"
    assert lines[2] == "60 steps of 0.25 from t = 0 to t = 15; 16 states saved"
    speed = re.fullmatch(r"(\S+) s, .* a step and coordinate, (\S+) iterations a step; prepared in \S+ s", lines[3])
    assert speed[2] == f"{numbers['iterations'] / 60:.2f}"
    error = numbers["energy_change"] / abs(energy[0])
    assert lines[4].startswith(f"relative energy error: {error:.2e} at most, drift ")
    assert lines[5] == f"relative error of momentum of q: {numbers['momentum_errors']['momentum of q']:.2e} at most"
    worst = f"largest local error: {numbers['step_error']:.1e} (relative, estimated), step from t = "
    assert lines[6].startswith(worst)
    final = [line.split() for line in lines[8:]]
    assert [[row[0], float(row[2]), float(row[5])] for row in final] == [[f"q_{i}", q[i], p[i]] for i in range(6)]


def test_numbers_without_a_right_digit_are_not_printed():
    assert in_known_digits(6.1, 8.0) == " no digit (error 8)"
    assert in_known_digits(6.1, 0.01) == " 6.1"


def test_positions_and_momenta_are_printed_with_their_correct_digits():
    errors = np.array([[1e-3, 1e-9]]), np.array([[1e-9, 1e-3]])
    known = SimpleNamespace(bounds=errors, lost=None, sizes=np.ones((2, 2)))
    interface = Interface(
        prefix="two", title="", system="", method="", coordinates=("x", "y"), parameters=(), defaults=()
    )
    lines = list(final_state(interface, np.array([1 / 3, 2 / 3]), np.array([1 / 7, 1 / 9]), known))
    digits = [[len(text) for text in re.findall(r"0\.(\d*[1-9])", line)] for line in lines[1:]]
    assert digits[0][0] == digits[1][1] < digits[0][1] == digits[1][0]


FALLING = """
[system]
name = "falling"
coordinates = ["y"]
lagrangian = "y_dot**2/2 - y"
{acting}
[initial]
q = [1.0]
q_dot = [0.0]
[run]
step = 0.1
span = 1.0
{event}"""


@pytest.mark.parametrize(
    ("acting", "restitution", "printed"),
    [
        ("", None, "symplectic"),
        ("", 1, "symplectic"),
        ("", 0.8, "symplectic only between events"),
        ("damping = 0.1", None, "not symplectic"),
        ("damping = 0.1\ntemperature = 1.0", None, "not symplectic"),
    ],
)
def test_what_acts_decides_whether_a_run_is_symplectic(acting, restitution, printed):
    event = "" if restitution is None else f'[[events]]\nfunction = "y"\nrestitution = {restitution}\n'
    model = parse_model(FALLING.format(acting=acting, event=event))
    assert _geometry(model, SimpleNamespace(plan=FixedSteps(0.1))) == printed
