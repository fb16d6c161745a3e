"""Lists of neighbours made in C: exact for every evaluation of forces, and no bit depends on when they are made."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from contextlib import nullcontext
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from notation import lagrange
from programs import needs

import scvi_codegen as sc
from scvi_codegen.codegen.native.compilers import find_compiler
from scvi_codegen.interfaces.models.packages.package import generate_package

pytestmark = pytest.mark.filterwarnings("ignore::scvi_codegen.common.errors.MethodWarning")  # of all pairs

SQUARE = "sum(a in 3, wrap(r[i, a] - r[j, a], box)**2)"
WELL = f"4*(1/{SQUARE}**6 - 1/{SQUARE}**3)*positive_part(1 - {SQUARE}**2/cut**4)**4"
KINETIC = "sum(i in N, sum(a in 3, r_dot[i, a]**2)/2)"
BOX = (64 / 0.8) ** (1 / 3)
CUT = 1.9


def liquid(skin: float | None = 0.3, pair: str = WELL) -> Any:
    """Return the liquid with a list of neighbours, or with all pairs."""
    near = {"near": {"of": "r", "box": "box", "cutoff": "cut", "skin": skin}}
    text = f"{KINETIC} - sum(i < j in {'near' if skin else 'N'}, {pair})"
    return lagrange("liquid", ["r[N, 3]"], text, neighbours=near if skin else None, box=BOX, cut=CUT)


@cache
def stepper(method: str = "stoermer-verlet", skin: float | None = 0.3, pair: str = WELL) -> Any:
    return sc.compile_stepper(liquid(skin, pair), method)


def start(speed: float = 1.2, side: int = 4) -> tuple[Any, Any]:
    generator = np.random.default_rng(2)
    grid = np.stack(np.meshgrid(*[np.arange(side)] * 3), -1).reshape(-1, 3)
    velocities = speed * generator.normal(size=(side**3, 3))
    return (generator.permutation(grid) + 0.3) * BOX / 4 - 7 * BOX, velocities - velocities.mean(axis=0)


def forces(r: Any) -> Any:
    """Forces of all pairs by NumPy."""
    apart = r[:, None] - r[None]
    apart -= BOX * np.rint(apart / BOX)
    square = (apart**2).sum(axis=-1) + 1e3 * np.eye(len(r))
    s = np.maximum(1 - square**2 / CUT**4, 0.0)
    derivative = 4 * (-6 * square**-7 + 3 * square**-4) * s**4
    derivative -= 4 * (square**-6 - square**-3) * 8 * s**3 * square / CUT**4
    return -(2 * derivative[..., None] * apart).sum(axis=1)


@pytest.mark.full
def test_no_pair_is_missed_in_a_long_run() -> None:
    """The particles travel through several boxes; a run that missed a pair once would be elsewhere."""
    r, v = start()
    run = stepper().integrate(r, velocity=v, h=0.005, steps=6000, save_every=60)
    assert abs(run.q["r"][-1] - r).max() > BOX
    for k in range(len(run.t) - 1):
        r, v = run.q["r"][k], run.p["r"][k]
        for _ in range(60):
            v = v + 0.0025 * forces(r)
            r = r + 0.005 * v
            v = v + 0.0025 * forces(r)
        assert run.q["r"][k + 1] == pytest.approx(r, abs=1e-9)
    assert run.energy_error() < 0.01
    assert abs(run.momentum_maps()).max() < 1e-11


@pytest.mark.rotated
@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", ["stoermer-verlet", "composition:8", "svi:2"])
def test_no_bit_depends_on_skin_and_interruptions(method: str) -> None:
    r, v = start()
    run = stepper(method).integrate(r, velocity=v, h=0.01, steps=60, save_every=20)
    for skin in (0.05, 0.9):
        other = stepper(method, skin).integrate(r, velocity=v, h=0.01, steps=60, save_every=20)
        assert np.array_equal(run.q["r"], other.q["r"])
        assert np.array_equal(run.energy(), other.energy())
    started = stepper(method).start(r, velocity=v, h=0.01)
    started.advance(steps=37)
    resumed = stepper(method).from_checkpoint(started.checkpoint())
    resumed.advance(steps=23)
    assert np.array_equal(resumed.q["r"], run.q["r"][-1])
    all_pairs = stepper(method, None).integrate(r, velocity=v, h=0.01, steps=60, save_every=20)
    assert run.q["r"] == pytest.approx(all_pairs.q["r"], abs=1e-10)


@pytest.mark.rotated
@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", ["stoermer-verlet", "svi:2"])
def test_threads_evaluate_the_same_pairs(method: str) -> None:
    """With 3 x 3 x 3 cells, and enough coordinates for several threads."""
    r, v = start(side=7)
    options: dict[str, Any] = {"velocity": v, "h": 0.005, "steps": 30, "parameters": {"box": 1.75 * BOX}}
    alone, two, three = (stepper(method).integrate(r, **options, threads=threads) for threads in (1, 2, 3))
    assert np.array_equal(alone.q["r"], two.q["r"])
    assert np.array_equal(alone.q["r"], three.q["r"])
    all_pairs = stepper(method, None).integrate(r, **options)
    assert alone.q["r"] == pytest.approx(all_pairs.q["r"], abs=1e-11)


@pytest.mark.rotated
def test_adaptive_steps_and_ensembles_have_the_pairs_of_all() -> None:
    r, v = start()
    run, other = (stepper("svi:3", skin).integrate(r, velocity=v, t_end=0.4, tolerance=1e-7) for skin in (0.2, None))
    assert np.array_equal(run.t, other.t)
    assert run.q["r"][-1] == pytest.approx(other.q["r"][-1], abs=1e-10)
    several = stepper().integrate_ensemble(np.stack([r, r]), velocity=np.stack([v, -v]), h=0.005, steps=40)
    for k, velocity in enumerate((v, -v)):
        alone = stepper().integrate(r, velocity=velocity, h=0.005, steps=40)
        assert np.array_equal(several.q[-1, k], alone.q["r"][-1].reshape(-1))


SOFT = f"positive_part(1 - {SQUARE}/cut**2)**4"


@pytest.mark.rotated
@pytest.mark.sampled(1)
@pytest.mark.parametrize("method", ["stoermer-verlet", "svi:2"])
def test_steps_longer_than_the_skin_miss_no_pair(method: str) -> None:
    r, v = start(6.0)
    run, other = (
        stepper(method, skin, SOFT).integrate(r, velocity=v, h=0.1, steps=40, parameters={"cut": 2.0})
        for skin in (0.01, None)
    )
    assert abs(np.diff(run.q["r"], axis=0)).max() > 1.0
    assert run.q["r"] == pytest.approx(other.q["r"], abs=1e-11)
    with pytest.raises(sc.StepFailedError, match="infinite or NaN"):
        stepper("svi:2", 0.01, SOFT).integrate(r, velocity=20 * v, h=0.1, steps=1)


@pytest.mark.second
def test_parameters_that_change_make_another_list() -> None:
    r, v = start()
    runs = []
    for skin in (0.01, None):
        run = stepper(skin=skin, pair=SOFT).start(r, velocity=v, h=0.001)
        run.advance(steps=2)
        run.update(parameters={"box": 0.97 * BOX, "cut": 2.05})
        run.advance(steps=2)
        runs.append(run.q["r"])
    assert runs[0] == pytest.approx(runs[1], abs=1e-12)


@pytest.mark.rotated
@pytest.mark.sampled(2)
@pytest.mark.parametrize("box", [None, "5", ["5", "L"], ["9", "4*L"]])
def test_boxes_of_other_shapes_and_none(box: Any) -> None:
    """In two dimensions, with an offset in the state, cells of any number per axis, and values of each particle."""
    lengths = [] if box is None else [box] * 2 if isinstance(box, str) else box
    parts = [f"wrap(r[i, {a}] - r[j, {a}], {lengths[a]})" if lengths else f"(r[i, {a}] - r[j, {a}])" for a in (0, 1)]
    square = " + ".join(f"{part}**2" for part in parts)
    pair = f"m[i]*m[j]*exp(-({square}))*positive_part(1 - ({square})/1.1**2)**2"
    inside = f"unit_step(1.1**2 - ({square}))"
    runs = []
    for near, term in (({"of": "r", "cutoff": 1.1, **({"box": box} if box else {})}, pair), (None, f"{inside}*{pair}")):
        system = sc.LagrangianSystem.from_text(
            name="flat",
            coordinates=["x", "r[N, 2]"],
            parameters={"L": 4.0, "m[N]": 1.0},
            neighbours={"near": near} if near else None,
            lagrangian=f"""x_dot**2/2 - x**2/2 + sum(i in N, sum(a in 2, r_dot[i, a]**2)/2)
                - sum(i < j in {"near" if near else "N"}, {term})""",
        )
        generator = np.random.default_rng(5)
        state = {"x": 1.0, "r": generator.uniform(-6, 6, size=(70, 2))}
        velocity = {"x": 0.0, "r": generator.normal(size=(70, 2))}
        run = sc.compile_stepper(system, "stoermer-verlet").integrate(
            state, velocity=velocity, h=0.01, steps=150, parameters={"m": np.linspace(0.5, 1.5, 70)}
        )
        runs.append((run.q["r"], run.energy()))
    assert runs[0][0] == pytest.approx(runs[1][0], abs=1e-11)
    assert runs[0][1] == pytest.approx(runs[1][1], abs=1e-10)


INVALID: tuple[tuple[dict[str, float], str], ...] = (
    (
        {"box": 3.7},
        r"the box of the neighbours 'near'.* is box = 3.7.*: it must be at least two cutoffs, 2\*\(cut\) = 3.8",
    ),
    ({"box": -BOX}, r"the box .* is box = -4\..*: it must be a positive number"),
    ({"cut": -1.0}, r"the cutoff .* is cut = -1: it must be a positive number"),
)


@pytest.mark.rotated
@pytest.mark.parametrize("kind", ["run-time sizes", "known sizes"])
def test_lengths_are_checked_before_every_run(kind: str) -> None:
    points = np.array([[0.0, 0.0, 0.0], [0.9, 0.0, 0.0], [0.0, 1.1, 0.0]])
    each = stepper() if kind == "run-time sizes" else sc.compile_stepper(liquid(), "stoermer-verlet", sizes={"N": 3})
    state, many = ({"r": points}, {"r": 0 * points}), ({"r": np.stack([points] * 2)}, {"r": np.zeros((2, 3, 3))})
    for lengths, message in INVALID:
        ((name, value),) = lengths.items()
        per_trajectory = {name: [5.0 if name == "box" else 1.9, value]}
        calls: tuple[tuple[Callable[..., Any], Any], ...] = (
            (partial(each.integrate, *state, h=0.001, steps=1), lengths),
            (partial(each.start, *state, h=0.001), lengths),
            (each.start(*state, h=0.001).update, lengths),
            (partial(each.energy, *state), lengths),
            (partial(each.integrate_ensemble, *many, h=0.001, steps=1), lengths),
            (partial(each.integrate_ensemble, *many, h=0.001, steps=1), per_trajectory),
        )
        for call, parameters in calls[: 5 if kind == "run-time sizes" else 6]:
            with pytest.raises(sc.StateError, match=message):
                call(parameters=parameters)


@pytest.mark.rotated
@pytest.mark.parametrize("size", ["3", "N"])
def test_lengths_are_checked_before_c_is_generated(size: str, tmp_path: Path) -> None:
    """The program of a package does not check them."""
    text = f"""
[system]
name = "gas"
coordinates = ["q[{size}]"]
lagrangian = "sum(i in {size}, q_dot[i]**2/2) - sum(i < j in near, (q[i] - q[j])**2)"
neighbours = {{ near = {{ of = "q", cutoff = "2*s", box = "L" }} }}
{"[sizes]" if size == "N" else ""}
{"N = 3" if size == "N" else ""}
[parameters]
s = 1.0
L = 3.9
[initial]
q = {{ q = [0.1, 1.0, 2.0] }}
q_dot = {{ q = 0.0 }}
[method]
method = "stoermer-verlet"
[run]
step = 0.01
steps = 3
"""
    for length, message in (("3.9", r"L = 3.9: it must be at least two cutoffs"), ("4.1", "")):
        (tmp_path / "model.toml").write_text(text.replace("3.9", length))
        with pytest.raises(sc.StateError, match=message) if message else nullcontext():
            generate_package(sc.load_model(tmp_path / "model.toml"), tmp_path / "generated_gas")


@pytest.mark.rotated
@pytest.mark.parametrize("sanitizer", ["address,undefined", pytest.param("thread", marks=pytest.mark.full)])
def test_programs_of_packages_make_their_lists(sanitizer: str, tmp_path: Path) -> None:
    """With three threads and the compiler's sanitizers, from the same start to the same bits."""
    needs("setarch")
    r, v = start(3.0, side=7)
    model = sc.Model(system=liquid(0.1, SOFT), q={"r": r}, velocity={"r": v}, h=0.02, method=sc.SVI(2), span=0.1)
    folder = sc.generate_package(model, tmp_path / "soft")
    flags = ["-std=c99", "-O1", "-ffp-contract=off", f"-fsanitize={sanitizer}", "-DSCVI_THREADS", "-pthread"]
    command = [*find_compiler(), *flags, "-Wno-psabi", "main.c", "soft.c", "-lm", "-o", "main"]
    built = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if built.returncode:
        pytest.skip(f"no sanitizer: {built.stderr[-200:]}")
    for threads in ("1", "3"):
        done = subprocess.run(
            ["setarch", "-R", "./main", threads], cwd=folder, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        end = np.loadtxt(folder / "end.txt")
        assert end[: r.size] == pytest.approx(model.integrate().q["r"][-1].reshape(-1), abs=1e-12)
