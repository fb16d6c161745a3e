"""Every number that ``run`` prints, and every field of its JSON, from the saved states by other code.

Energies, momentum maps and motions are written out here in NumPy; a classical Runge-Kutta method of order four with
many steps says what is exact. A field or a line without a check fails.
"""

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import json_of, output_of
from notation import lagrange

import scvi_codegen as sc
from scvi_codegen.analysis.advice.tolerance_check import Known
from scvi_codegen.codegen.rendering.source import Interface
from scvi_codegen.interfaces.cli.reports import in_known_digits
from scvi_codegen.interfaces.cli.running import final_state

Array = Any
M, K, C, G = 1.75, 0.625, 0.375, 1.25
T = 2.5
PARAMETERS = f"[parameters]\nm = 1.0\nk = 1.0\nc = 0.5\n[initial]\nt = {T}\n"
"""Defaults, which no run below keeps: values come with --parameter."""
CHANGED = ("--parameter", f"m={M}", "--parameter", f"k={K}", "--parameter", f"c={C}")


def square(x: Array) -> Array:
    return np.sum(x**2, axis=-1, keepdims=True)


def column(x: Array) -> Array:
    return np.asarray(x)[..., 0]


def spring(t: Array, q: Array, p: Array) -> Array:
    return -q * (K + C * square(q))


def spring_energy(t: Array, q: Array, p: Array) -> Array:
    return column(square(p) / (2 * M) + K * square(q) / 2 + C * square(q) ** 2 / 4)


def angular(t: Array, q: Array, p: Array) -> tuple[Array, Array]:
    return q[:, 0] * p[:, 1] - q[:, 1] * p[:, 0], np.abs(q[:, 0] * p[:, 1]) + np.abs(q[:, 1] * p[:, 0])


def none(q: Array) -> Array:
    return np.zeros(len(q))


SPRINGS = """
[system]
name = "springs"
coordinates = ["x", "y"]
lagrangian = "m*(x_dot**2 + y_dot**2)/2 - k*(x**2 + y**2)/2 - c*(x**2 + y**2)**2/4"
"""
START = "q = [1.0, 0.25]\nq_dot = [0.125, 0.5]\n"


def springs(t: Array, q: Array, p: Array) -> tuple[Array, Array, Array]:
    return p / M, spring(t, q, p), none(q)


@dataclass(frozen=True, kw_only=True)
class Kind:
    """A model as text, and what it means.

    Attributes:
        rates: of t, q, p of shape (n, m): those of q, of p and of the work of forces; with a time transformation the
            last is that of tau.
        energy: of the same.
        maps: by name: values and sizes of the terms.
        drawn: why the energy changes, as the run says; "" where it does not.
        words: of the command line; ``h`` the step size, ``None`` where steps choose theirs.
        states: saved ones, where there are more than every ``save_every``-th.
        tau: with a time transformation, how far tau between saved states may be off its steps, relative.
        controlled: True if the reversible controller varies the steps of time.
    """

    system: str = SPRINGS
    start: str = START
    rates: Callable[..., tuple[Array, Array, Array]] = springs
    energy: Callable[..., Array] = spring_energy
    maps: Mapping[str, Callable[..., tuple[Array, Array]]] = field(
        default_factory=lambda: {"angular momentum": angular}
    )
    drawn: str = ""
    words: tuple[str, ...] = ("--step", "0.125", "--steps", "90", "--save-every", "3")
    steps: int | None = 90
    save_every: int = 3
    h: float | None = 0.125
    method: tuple[str, str, int] = ("svi:2", "svi-2-gauss-legendre-2", 4)
    coordinates: tuple[str, ...] = ("x", "y")
    symplectic: str = "symplectic"
    extra: str = ""
    accounted: bool = False
    pessimism: float = 100.0
    states: int | None = None
    tau: float = 0.0
    controlled: bool = False


def forced(t: Array, q: Array, p: Array) -> tuple[Array, Array, Array]:
    v = p / M
    f = np.stack([-C * v[:, 0] ** 3 - v[:, 0] / 4, K * np.cos(t)], axis=1)
    return v, -K * q + f, np.sum(f * v, axis=1)


def in_tau(t: Array, q: Array, p: Array) -> tuple[Array, Array, Array]:
    return p / M, spring(t, q, p), 1 + column(square(q))


PUSHES = [0.0, T + 4.5, T + 7.3125, 20.0], [0.0, 1.5, -0.5, 0.25]
"""The steps of 0.125 end at both inner times: 36, 22 and a half, 31 and a half."""


def pushed(t: Array, q: Array, p: Array) -> tuple[Array, Array, Array]:
    v = p / M
    f = np.stack([np.interp(t, *PUSHES) - C * v[:, 0] ** 3, -v[:, 1] / 4], axis=1)
    return v, spring(t, q, p) + f, np.sum(f * v, axis=1)


TRANSFORMED = SPRINGS + 'time_transformation = "1/(1 + x**2 + y**2)"\n'


def constrained_pendulum(t: Array, q: Array, p: Array) -> tuple[Array, Array, Array]:
    v = p / M
    factor = G * q[:, 1:] - square(v)
    return v, M * (np.array([0.0, -G]) + factor * q), none(q)


IN_TAU: dict[str, Any] = {"system": TRANSFORMED, "rates": in_tau}
KINDS = {
    "scalar": Kind(),
    "hamiltonian": Kind(
        maps={},
        system="""
[system]
name = "twisted"
coordinates = ["x"]
momenta = ["r"]
hamiltonian = "r**2*(1 + c*x**2)/(2*m) + k*x**2/2 + x*r/8"
""",
        start="q = [0.75]\np = [0.5]\n",
        rates=lambda t, q, p: (p * (1 + C * q**2) / M + q / 8, -C * q * p**2 / M - K * q - p / 8, none(q)),
        energy=lambda t, q, p: column(p**2 * (1 + C * q**2) / (2 * M) + K * q**2 / 2 + q * p / 8),
        coordinates=("x",),
        method=("gauss:2", "gauss-2", 4),
    ),
    "forced": Kind(
        maps={},
        system="""
[system]
name = "forced"
coordinates = ["x", "y"]
lagrangian = "m*(x_dot**2 + y_dot**2)/2 - k*(x**2 + y**2)/2"
[forces]
x = "-c*x_dot**3 - x_dot/4"
y = "k*cos(t)"
""",
        rates=forced,
        energy=lambda t, q, p: column(square(p) / (2 * M) + K * square(q) / 2),
        drawn="forces act",
        symplectic="not symplectic",
        accounted=True,
    ),
    "damped": Kind(
        maps={},
        system=SPRINGS.replace("lagrangian", 'damping = "c/4"\nlagrangian'),
        rates=lambda t, q, p: (p / M, spring(t, q, p) - C / 4 * p, -C / 4 / M * column(square(p))),
        drawn="damping takes it",
        symplectic="not symplectic",
        accounted=True,
    ),
    "constrained": Kind(
        maps={},
        system=f"""
[system]
name = "rod"
coordinates = ["x", "y"]
lagrangian = "m*(x_dot**2 + y_dot**2)/2 - {G}*m*y + 0*k*c"
constraints = ["x**2 + y**2 = 1"]
""",
        start="q = [0.6, -0.8]\nq_dot = [0.4, 0.3]\n",
        rates=constrained_pendulum,
        energy=lambda t, q, p: column(square(p) / (2 * M)) + M * G * q[:, 1],
        method=("svi:2", "svi-2-gauss-lobatto-3", 4),
        pessimism=10_000.0,  # the estimate is one of the multipliers' curve, too
        extra='quadrature = "gauss-lobatto:3"\n',
    ),
    "adaptive": Kind(
        words=("--tolerance", "1e-5", "--span", "11.25", "--save-every", "2"),
        steps=None,
        save_every=2,
        h=None,
        symplectic="symplectic only at fixed step size",
    ),
    "time in L": Kind(
        system=SPRINGS.replace("- k*", "- k*(2 + cos(t))*"),
        rates=lambda t, q, p: (p / M, spring(t, q, p) - K * (1 + np.cos(t)[:, None]) * q, none(q)),
        energy=lambda t, q, p: spring_energy(t, q, p) + K * (1 + np.cos(t)) * column(square(q)) / 2,
        drawn="L depends on time",
    ),
    "shorter last step": Kind(words=("--step", "0.125", "--span", "11.1875", "--save-every", "3"), states=31),
    "inputs": Kind(
        maps={},
        system=f"""
{SPRINGS}inputs = ["u"]
[forces]
x = "u - c*x_dot**3"
y = "-y_dot/4"
[inputs]
u = {{ t = {PUSHES[0]}, values = {PUSHES[1]} }}
""",
        rates=pushed,
        drawn="forces act",
        symplectic="not symplectic",
        accounted=True,
        words=("--step", "0.125", "--span", "11.25", "--save-every", "3"),
        steps=36 + 23 + 32,
        states=34,
    ),
    "transformed time": Kind(
        **IN_TAU, words=("--step", "0.125", "--span", "11.25", "--save-every", "3"), steps=None, tau=1e-5
    ),
    "steps of transformed time": Kind(**IN_TAU, tau=1e-5),
    "transformed time by tolerance": Kind(
        **IN_TAU,
        words=("--tolerance", "1e-6", "--span", "11.25", "--save-every", "2"),
        steps=None,
        save_every=2,
        h=None,
        tau=1e-5,
    ),
    "reversible controller": Kind(
        **IN_TAU,
        words=("--controller", "reversible", "--step", "0.125", "--span", "11.25", "--save-every", "3"),
        steps=None,
        symplectic="symplectic only at fixed step size",
        tau=1e-2,
        controlled=True,
        pessimism=1000.0,  # steps so small that the estimate is far above the error, as at a fixed step size
    ),
}


@dataclass(frozen=True)
class Done:
    """A run: its JSON, its text, its states, and what is exact."""

    kind: Kind
    numbers: dict[str, Any]
    lines: list[str]
    t: Array
    q: Array
    p: Array
    iterations: Array
    most: float
    model: Any


def advanced(kind: Kind, t: Array, q: Array, p: Array, h: Array, parts: int = 400) -> tuple[Array, Array, Array]:
    """(q, p) after h from many states at once, and the work on the way."""
    t, h, w = np.array(t, float), np.asarray(h, float) / parts, np.zeros(len(q))
    for _ in range(parts):
        k1 = kind.rates(t, q, p)
        k2 = kind.rates(t + h / 2, q + h[:, None] / 2 * k1[0], p + h[:, None] / 2 * k1[1])
        k3 = kind.rates(t + h / 2, q + h[:, None] / 2 * k2[0], p + h[:, None] / 2 * k2[1])
        k4 = kind.rates(t + h, q + h[:, None] * k3[0], p + h[:, None] * k3[1])
        q, p = (x + h[:, None] / 6 * (k1[i] + 2 * k2[i] + 2 * k3[i] + k4[i]) for i, x in enumerate((q, p)))
        w, t = w + h / 6 * (k1[2] + 2 * k2[2] + 2 * k3[2] + k4[2]), t + h
    return q, p, w


@pytest.fixture(scope="module", params=list(KINDS))
def done(request: Any, tmp_path_factory: Any) -> Done:
    kind = KINDS[request.param]
    folder = tmp_path_factory.mktemp("numbers")
    model = folder / "model.toml"
    run = "[run]\nstep = 1.0\nspan = 1.0\n"
    model.write_text(f'{kind.system}{PARAMETERS}{kind.start}[method]\nmethod = "{kind.method[0]}"\n{kind.extra}{run}')
    words = ["run", str(model), *kind.words, *CHANGED]
    first = json_of(*words, "-o", folder / "states.npz")
    second = output_of(*words)
    with np.load(folder / "states.npz") as saved:
        states = dict(saved)
    return Done(
        kind, first, second.splitlines(), states["t"], states["q"], states["p"],
        states["iterations"], 60.0, model,
    )  # fmt: skip


def step_errors(done: Done) -> Array:
    """Return errors between saved states, relative to the sizes of positions and momenta."""
    ends = advanced(done.kind, done.t[:-1], done.q[:-1], done.p[:-1], np.diff(done.t))
    off = [(np.linalg.norm(x - y[1:], axis=1), np.sqrt(np.mean(y**2))) for x, y in zip(ends, (done.q, done.p))]  # noqa: B905
    return np.max([error / size for error, size in off], axis=0)


def exact_end(done: Done) -> tuple[Array, Array, float]:
    h = done.t[-1:] - done.t[0]
    q, p, w = advanced(done.kind, done.t[:1], done.q[:1], done.p[:1], h, 20_000)
    return q[0], p[0], float(w[0])


def largest(x: Array) -> float:
    return float(np.max(np.abs(x)))


def relative_map(done: Done, name: str) -> float:
    values, sizes = done.kind.maps[name](done.t, done.q, done.p)
    return largest(values - values[0]) / largest(sizes)


def expected_fields(done: Done) -> dict[str, Callable[[Any], bool]]:
    """A check of each field."""
    kind, energy = done.kind, done.kind.energy(done.t, done.q, done.p)
    change = largest(energy - energy[0])
    dust = 1e-14 * largest(energy)
    end_q, end_p, work = exact_end(done)
    count = (len(done.t) - 1) * kind.save_every
    errors, transformed = step_errors(done), kind.tau > 0.0 and not kind.controlled

    def named(x: Array) -> dict[str, float]:
        return dict(zip(kind.coordinates, x.tolist(), strict=True))

    def near_truth(found: dict[str, dict[str, float]]) -> bool:
        off = {"q": np.abs(done.q[-1] - end_q), "p": np.abs(done.p[-1] - end_p)}
        sizes = [(np.linalg.norm(list(found[x].values())), np.linalg.norm(off[x])) for x in "qp"]
        return list(found["q"]) == list(kind.coordinates) and all(0.5 * y <= x <= 30 * y + 1e-9 for x, y in sizes)

    def worst_found(t: float) -> bool:
        """Return whether the reported step begins at a step and is in an interval with one of the larger errors."""
        if kind.h and not (kind.tau or kind.states) and abs((t - T) / kind.h - round((t - T) / kind.h)) > 1e-9:
            return False
        place = int(np.searchsorted(done.t, t, side="right")) - 1
        return bool(errors[min(place, len(errors) - 1)] > 0.02 * errors.max())

    return {
        "system": lambda x: f'name = "{x.removesuffix(" in transformed time" * transformed)}"' in kind.system,
        "method": lambda x: x == kind.method[1],
        "order": lambda x: x == kind.method[2],
        "run": lambda x: (x["save_every"], x.get("step")) == (kind.save_every, kind.h),
        "steps": lambda x: x == kind.steps if kind.steps else count - kind.save_every < x <= count,
        "rejected_steps": lambda x: x == 0 if kind.h else 0 <= x < count,
        "fallback_steps": lambda x: x == 0,
        "h": lambda x: x == kind.h if kind.h or not kind.tau else tau_fits(done, x),
        "states": lambda x: x == len(done.t) == (kind.states or len(done.t)),
        "seconds": lambda x: 0.0 < x < 5.0,
        "preparation_seconds": lambda x: 0.0 < x < done.most,
        "energy_change": lambda x: abs(x - change) <= dust and change > 1e-9,
        "energy": lambda x: abs(x - energy[0]) <= dust,
        "momentum_errors": lambda x: (
            x.keys() == kind.maps.keys()
            and all(x[name] == pytest.approx(relative_map(done, name), rel=0.1, abs=1e-15) for name in x)
        ),
        "work": lambda x: abs(x - work) < 2e-3 * abs(work) if kind.accounted else x is None,
        "energy_balance": lambda x: balance_fits(done, x) if kind.accounted else x is None,
        "action": lambda x: x is None,
        "step_error": lambda x: errors.max() / 100 / kind.save_every < x < kind.pessimism * errors.max(),
        "worst_step_time": worst_found,
        "final": lambda x: x["q"] == named(done.q[-1]) and x["p"] == named(done.p[-1]) and x["t"] == done.t[-1],
        "final_error": (lambda x: x is None) if transformed else near_truth,
        "chaotic": lambda x: x is (None if transformed else False),
        "failure": lambda x: x is None,
        "missed": lambda x: x is None,
        "written": lambda x: [Path(each).name for each in x] == ["states.npz"],
    }


def tau_fits(done: Done, h: float) -> bool:
    """The integral of dt/g between saved states, the last of which may be within a step, is that of their steps."""
    tau = advanced(done.kind, done.t[:-1], done.q[:-1], done.p[:-1], np.diff(done.t))[2][:-1]
    varied = np.ptp(np.diff(done.t)[:-1]) > 0.1 * h
    return bool(np.allclose(tau, done.kind.save_every * h, rtol=done.kind.tau, atol=0.0)) and varied


@pytest.mark.tiers(0, 1)
@pytest.mark.sampled(5)
def test_steps_of_tau_are_those_of_the_time_transformation(done):
    assert done.kind.tau == 0.0 or tau_fits(done, done.numbers["h"])


def balance_fits(done: Done, found: float) -> bool:
    """Held against the work that the library integrates along the steps' own curves, which has tests of its own."""
    model = sc.load_model(done.model)
    run = model.stepper().integrate(
        done.q[0], done.p[0], h=done.kind.h, t_end=T + 11.25, save_every=done.kind.save_every, t=T,
        parameters={"m": M, "k": K, "c": C}, inputs=model.inputs or None,
    )  # fmt: skip
    energy = done.kind.energy(done.t, done.q, done.p)
    return abs(found - largest(energy - energy[0] - run.work())) < 1e-14 and found > 0.0


@pytest.mark.tiers(0, 1)
@pytest.mark.sampled(5)
def test_every_field_of_the_json_is_correct(done):
    checks = expected_fields(done)
    assert done.numbers.keys() == checks.keys()
    wrong = {name: done.numbers[name] for name, check in checks.items() if not check(done.numbers[name])}
    assert wrong == {}


def same(text: str, x: float, specification: str) -> bool:
    """Printed in that format; energies of a second run are the same to the last digits, not to the last bit."""
    return text == format(x, specification) or (abs(float(text) - x) <= 0.02 * abs(x) + 1e-15 and len(text) > 0)


def drift(done: Done, scale: float) -> float:
    """Return the rise over the run of a straight line fitted to the relative errors."""
    energy = done.kind.energy(done.t, done.q, done.p)
    derivative = np.polyfit(done.t, (energy - energy[0]) / scale, 1)[0]
    return float(derivative * (done.t[-1] - done.t[0]))


def first_lines(done: Done, lines: list[str]) -> None:
    kind, numbers = done.kind, done.numbers
    assert lines[0] == numbers["system"]
    title = re.fullmatch(r".*; order (\d+), (.*), symmetric", lines[1])
    assert (int(title[1]), title[2]) == (kind.method[2], kind.symplectic)
    way = re.fullmatch(r"(\d+) steps of (.*) from t = (\S+) to t = (\S+); (\d+) states saved", lines[2])
    assert (int(way[1]), int(way[5])) == (numbers["steps"], len(done.t))
    if kind.tau:
        assert way[2] == f"{numbers['h']:g} in tau" + " by the reversible controller" * kind.controlled
    else:
        assert way[2] == (f"{kind.h:g}" if kind.h else f"adaptive size ({numbers['rejected_steps']} rejected)")
    assert (way[3], way[4]) == (f"{T:g}", f"{done.t[-1]:g}")
    speed = re.fullmatch(r"(\S+) s, (\S+) (\w+) a step, (\S+) iterations a step; prepared in (\S+) s", lines[3])
    a_step = float(speed[2]) * {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[speed[3]]
    assert a_step * numbers["steps"] == pytest.approx(float(speed[1]), rel=0.01)
    inside = bool(kind.tau) and not kind.steps and not kind.controlled  # the end is a part of a step, by dense output
    inside |= kind is KINDS["shorter last step"]
    assert float(speed[4]) == pytest.approx(done.iterations.sum() / (numbers["steps"] - inside), abs=0.006)
    assert 0.0 <= float(speed[5]) < done.most


def energy_line(done: Done, line: str) -> None:
    kind, energy = done.kind, done.kind.energy(done.t, done.q, done.p)
    change = largest(energy - energy[0])
    if kind.drawn:
        found = re.fullmatch(
            r"energy: (.*), it changed by (\S+) at most(?:; energy balance \|E - E0 - W\| (\S+) at most)?", line
        )
        assert found[1] == kind.drawn
        assert same(found[2], change, ".3g")
        assert (found[3] is None) != kind.accounted
        assert found[3] is None or same(found[3], done.numbers["energy_balance"], ".1e")
        return
    found = re.fullmatch(r"relative energy error: (\S+) at most, drift (\S+) over the run", line)
    assert same(found[1], change / abs(energy[0]), ".2e")
    assert float(found[2]) == pytest.approx(drift(done, abs(energy[0])), rel=0.06)


@pytest.mark.tiers(0, 1)
@pytest.mark.sampled(5)
def test_every_line_of_the_text_is_correct(done):
    lines = list(done.lines)
    first_lines(done, lines)
    energy_line(done, lines[4])
    rest = lines[5:]
    for name in done.kind.maps:
        found = re.fullmatch(rf"relative error of {name}: (\S+) at most", rest.pop(0))
        assert float(found[1]) == pytest.approx(relative_map(done, name), rel=0.1, abs=2e-15)
    worst = re.fullmatch(
        r"largest local error: (\S+) \(relative, estimated\), step from t = (\S+?)(: too large)?", rest.pop(0)
    )
    assert worst[1] == f"{done.numbers['step_error']:.1e}"
    assert worst[2] == f"{done.numbers['worst_step_time']:g}"
    assert (worst[3] is not None) == (done.numbers["step_error"] > 1e-3)
    second = "accuracy unknown: no second run to compare with" if done.numbers["final_error"] is None else (
        "in the digits confirmed by a second run"
    )  # fmt: skip
    assert rest.pop(0) == f"final state ({second})"
    for i, name in enumerate(done.kind.coordinates):
        found = re.fullmatch(rf" *{name} = +(\S+) +p_{name} = +(\S+) *", rest.pop(0))
        for text, x, known in ((found[1], done.q[-1, i], "q"), (found[2], done.p[-1, i], "p")):
            if done.numbers["final_error"] is None:
                assert float(text) == pytest.approx(x, rel=1e-15)
                continue
            error = done.numbers["final_error"][known][name]
            assert float(text) == pytest.approx(round(x, max(0, math.floor(-math.log10(2 * error)))), abs=1e-15)
    assert rest == []


@pytest.fixture
def springs(here: Path) -> Kind:
    kind = KINDS["scalar"]
    Path("model.toml").write_text(f'{kind.system}{PARAMETERS}{kind.start}[method]\nmethod = "svi:2"\n')
    return kind


@pytest.mark.second
def test_every_field_and_line_of_an_ensemble_is_correct(springs):
    Path("grid.toml").write_text("[grid]\nx = [0.5, 1.0, 1.5]\nk = [0.5, 2.0]\n")
    words = ("run", "model.toml", *springs.words, "--parameter", f"m={M}", "--parameter", f"c={C}", "--ensemble")
    numbers = json_of(*words, "grid.toml", "-o", "many.npz")
    with np.load("many.npz") as saved:
        t, q, p = saved["t"], saved["q"], saved["p"]
    stiff, radii = np.array([0.5, 2.0] * 3), np.sum(q**2, axis=2)
    if not np.allclose(q[0, :, 0], np.repeat([0.5, 1.0, 1.5], 2)):
        stiff = np.repeat([0.5, 2.0], 3)
    energy = np.sum(p**2, axis=2) / (2 * M) + stiff * radii / 2 + C * radii**2 / 4
    turning = q[..., 0] * p[..., 1] - q[..., 1] * p[..., 0]
    sizes = np.max(np.abs(q[..., 0] * p[..., 1]) + np.abs(q[..., 1] * p[..., 0]), axis=0)
    change = largest(energy - energy[0])
    checks: dict[str, Callable[[Any], bool]] = {
        "system": lambda x: x == "springs",
        "method": lambda x: x == springs.method[1],
        "order": lambda x: x == 4,
        "run": lambda x: x == {"step": 0.125, "steps": 90, "save_every": 3},
        "trajectories": lambda x: x == q.shape[1] == 6,
        "statuses": lambda x: x == {"ok": 6},
        "steps": lambda x: x == {"least": 90, "most": 90},
        "states": lambda x: x == len(t) == 31,
        "seconds": lambda x: 0.0 < x < 5.0,
        "preparation_seconds": lambda x: 0.0 < x < 60.0,
        "energy": lambda x: np.allclose(x, energy[0], rtol=1e-14),
        "action": lambda x: x is None,
        "energy_change": lambda x: abs(x - change) < 1e-14 * largest(energy) and change > 1e-7,
        "energy_balance": lambda x: x is None,
        "momentum_errors": lambda x: abs(x["angular momentum"] - largest((turning - turning[0]) / sizes)) < 2e-15,
        "failure": lambda x: x is None,
        "missed": lambda x: x is None,
        "written": lambda x: x == ["many.npz"],
    }
    assert numbers.keys() <= checks.keys()
    assert {name: numbers[name] for name in numbers if not checks[name](numbers[name])} == {}
    lines = output_of(*words, "grid.toml").splitlines()
    assert lines[2] == f"6 trajectories of 90 steps of 0.125 from t = {T:g}; 31 states saved of each"
    assert lines[4] == "6 ok"
    relative = np.abs(energy / energy[0] - 1.0)
    worst = np.unravel_index(np.argmax(relative), relative.shape)[1]
    assert lines[5] == f"relative energy error: {relative.max():.2e} at most, of trajectory {worst}"
    assert re.fullmatch(r"relative error of angular momentum: \S+ at most", lines[6])
    assert len(lines) == 7


@pytest.mark.second
def test_every_field_and_line_of_a_recorded_run_is_correct(springs):
    words = ("run", "model.toml", *springs.words, *CHANGED)
    numbers, memory = json_of(*words, "-o", "long.run"), json_of(*words)
    checks: dict[str, Callable[[Any], bool]] = {
        "system": lambda x: x == "springs",
        "method": lambda x: x == springs.method[1],
        "folder": lambda x: x == "long.run",
        "steps": lambda x: x == 90,
        "states": lambda x: x == 31,
        "final": lambda x: x == memory["final"],  # compared with the saved states above
        "finished": lambda x: x is True,
        "failure": lambda x: x is None,
        "missed": lambda x: x is None,
        "written": lambda x: x == ["long.run"],
    }
    assert numbers.keys() <= checks.keys()
    assert {name: numbers[name] for name in numbers if not checks[name](numbers[name])} == {}
    text = output_of(*words, "-o", "again.run").splitlines()
    in_memory = output_of(*words).splitlines()
    assert text[1] == f"90 steps (all) of 0.125 from t = {T:g} to t = {T + 11.25:g}; 31 states saved in 'again.run'"
    assert text[3:5] == in_memory[4:6]
    finals = [float(x) for line in text for x in re.findall(r"= +(-?[\d.]{9,})", line)]
    expected = [memory["final"][letter][name] for name in ("x", "y") for letter in "qp"]
    assert finals == expected


@pytest.mark.rotated
def test_every_number_of_advice_is_correct(springs):
    words = ("run", "model.toml", "--span", "5.25", *CHANGED, "--advise", "1e-6")
    numbers = json_of(*words, "-o", "advised.npz")
    advice = numbers["advice"]
    assert advice.keys() == {"h", "steps", "message", "warnings"}
    assert (advice["h"], advice["steps"], advice["warnings"]) == (numbers["h"], numbers["steps"], [])
    assert advice["h"] * advice["steps"] == pytest.approx(5.25)
    assert advice["message"].startswith(f"{advice['steps']} steps of {advice['h']:.6g} by {springs.method[1]}")
    with np.load("advised.npz") as saved:
        t, q, p = saved["t"], saved["q"], saved["p"]
    end, _, _ = advanced(springs, t[:1], q[:1], p[:1], t[-1:] - t[0], 20_000)
    error = np.linalg.norm(end[0] - q[-1]) / math.sqrt(np.mean(np.sum(q**2, axis=1)))
    assert 1e-8 < error < 1e-6
    assert float(re.search(r"expected error of (\S+)\.", advice["message"])[1]) > 0.3 * error
    lines = output_of(*words).splitlines()
    pilots = [re.fullmatch(r"  h = (\S+) +(?:error (\S+)|no correct digit|fails) .*", line) for line in lines[1:]]
    rows = [(float(row[1]), row[2]) for row in pilots if row]
    assert len(rows) >= 3
    for h, message in rows:
        steps = round(5.25 / h)
        if message is None or steps > 2000:
            continue
        formula = "m*(x_dot**2 + y_dot**2)/2 - k*(x**2 + y**2)/2 - c*(x**2 + y**2)**2/4"
        model = lagrange("springs", "x y", formula, m=M, k=K, c=C)
        again = sc.compile_stepper(model, "svi:2").integrate(q[0], p[0], h=5.25 / steps, steps=steps, t=T)
        off = np.linalg.norm(again.q[-1] - end[0]) / math.sqrt(np.mean(np.sum(q**2, axis=1)))
        assert 0.2 * off < float(message) < 20 * off


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


def test_every_field_and_line_of_an_array_system_is_correct(here):
    Path("ring.toml").write_text(RING)
    words = ("run", "ring.toml", "--step", "0.25", "--steps", "60", "--save-every", "4", "--parameter", "k=0.75")
    numbers = json_of(*words, "-o", "ring.npz")
    with np.load("ring.npz") as saved:
        t, q, p = saved["t"], saved["q"], saved["p"]
    mass, apart = 1.0 + np.arange(6) / 4, np.roll(q, -1, axis=1) - q
    energy = np.sum(p**2 / (2 * mass) + 0.75 * apart**2 / 2 + apart**4 / 4, axis=1)
    checks: dict[str, Callable[[Any], bool]] = {
        "system": lambda x: x == "ring",
        "method": lambda x: x == "svi-2-gauss-legendre-2",
        "order": lambda x: x == 4,
        "run": lambda x: x == {"step": 0.25, "steps": 60, "save_every": 4},
        "sizes": lambda x: x == {"N": 6},
        "steps": lambda x: x == 60,
        "h": lambda x: x == 0.25,
        "tolerance": lambda x: x is None,
        "states": lambda x: x == len(t) == 16,
        "seconds": lambda x: 0.0 < x < 5.0,
        "preparation_seconds": lambda x: 0.0 < x < 60.0,
        "iterations": lambda x: 60 < x < 60 * 20,
        "energy": lambda x: abs(x - energy[0]) < 1e-14,
        "energy_change": lambda x: x == pytest.approx(largest(energy - energy[0]), rel=1e-9),
        "momentum_errors": lambda x: x.keys() == {"momentum of q"} and x["momentum of q"] < 1e-14,
        "rejected_steps": lambda x: x == 0,
        "fallback_steps": lambda x: x == 0,
        "work": lambda x: x is None,
        "energy_balance": lambda x: x is None,
        "final_error": lambda x: x is None,
        "chaotic": lambda x: x is None,
        "action": lambda x: x is None,
        "step_error": lambda x: 1e-7 < x < 1e-2,
        "worst_step_time": lambda x: x % 0.25 == 0.0 and 0.0 <= x < 15.0,
        "final": lambda x: (x["t"], x["q"]["q"], x["p"]["q"]) == (15.0, q[-1].tolist(), p[-1].tolist()),
        "failure": lambda x: x is None,
        "missed": lambda x: x is None,
        "written": lambda x: x == ["ring.npz"],
    }
    assert numbers.keys() == checks.keys()
    assert {name: numbers[name] for name in numbers if not checks[name](numbers[name])} == {}
    lines = output_of(*words).splitlines()
    assert lines[0] == "ring: 6 coordinates, N = 6"
    assert lines[2] == "60 steps of 0.25 from t = 0 to t = 15; 16 states saved"
    speed = re.fullmatch(r"(\S+) s, .* a step and coordinate, (\S+) iterations a step; prepared in \S+ s", lines[3])
    assert speed[2] == f"{numbers['iterations'] / 60:.2f}"
    assert lines[4].startswith(
        f"relative energy error: {numbers['energy_change'] / abs(energy[0]):.2e} at most, drift "
    )
    error = numbers["momentum_errors"]["momentum of q"]
    assert lines[5] == f"relative error of momentum of q: {error:.2e} at most"
    assert lines[6].startswith(
        f"largest local error: {numbers['step_error']:.1e} (relative, estimated), step from t = "
    )
    final = [line.split() for line in lines[8:]]
    assert [[row[0], float(row[2]), float(row[5])] for row in final] == [
        [f"q_{i}", q[-1, i], p[-1, i]] for i in range(6)
    ]


def test_numbers_without_a_right_digit_are_not_printed():
    assert in_known_digits(6.1, 8.0) == " no digit (error 8)"
    assert in_known_digits(6.1, 0.01) == " 6.1"


def test_positions_and_momenta_are_printed_with_their_correct_digits():
    known = Known(q=np.array([1e-3, 1e-9]), p=np.array([1e-9, 1e-3]), tenfold=np.inf)
    interface = Interface(
        prefix="two", title="", system="", method="", coordinates=("x", "y"), parameters=(), defaults=()
    )
    lines = list(final_state(interface, np.array([1 / 3, 2 / 3]), np.array([1 / 7, 1 / 9]), known))
    digits = [[len(text) for text in re.findall(r"0\.(\d*[1-9])", line)] for line in lines[1:]]
    assert digits[0][0] == digits[1][1] < digits[0][1] == digits[1][0]
