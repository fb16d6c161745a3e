"""Generated folders: C that any compiler takes, Python that needs no SymPy, files that are not lost."""

import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from commands import invoke
from notation import lagrange
from programs import needs

import scvi_codegen as sc

STRICT = "-O1 -std=c99 -Wall -Wextra -Wpedantic -Wshadow -Wconversion -Werror"

WITHOUT_SYMPY = """
import sys
for name in ("sympy", "mpmath", "jinja2"):
    sys.modules[name] = None               # importing it is an error
import {name}
q, p = {name}.stepper.step({q}, {p}, {h})
print(*map(float.hex, [*q, *p]))
"""


def model_of(name: str, **changes: object) -> sc.Model:
    return replace(sc.Model.from_problem(sc.problem(name)), **changes)


def printed_by(folder: Path, flags: str = STRICT) -> list[str]:
    """Return the lines that the program of a folder prints."""
    command = ["make", "-s", "-C", str(folder), "run", f"CFLAGS={flags}"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()


@pytest.fixture
def pendulum() -> sc.Model:
    return model_of("planar-pendulum", method=sc.SVI(3))


def test_folder_contains_a_complete_integrator(pendulum, tmp_path):
    folder = sc.generate_package(pendulum, tmp_path / "made" / "pendulum_svi")
    assert folder == tmp_path / "made" / "pendulum_svi"
    names = "Makefile README.md __init__.py interface.json main.c model.toml pendulum_svi.c pendulum_svi.h"
    further = ["pendulum_svi_adaptive.h", "pendulum_svi_mechanics.h"]
    assert sorted(path.name for path in folder.iterdir()) == names.split() + further
    assert sc.load_model(folder / "model.toml") == pendulum
    assert "pendulum_svi_step" in (folder / "README.md").read_text()


@pytest.mark.rotated
def test_a_single_file_computes_the_same_bits(tmp_path):
    pendulum = model_of("planar-pendulum", method=sc.SVI(3), steps=200, span=None)
    many = sc.generate_package(pendulum, tmp_path / "many" / "pendulum_svi")
    single = sc.generate_package(pendulum, tmp_path / "single" / "pendulum_svi", single_file=True)
    assert sorted(path.name for path in single.glob("*.[ch]")) == ["main.c", "pendulum_svi.c", "pendulum_svi.h"]
    assert not (single / "support").exists()
    printed = [printed_by(folder, f"{STRICT} -ffp-contract=off") for folder in (many, single)]
    assert len(printed[0]) > 20
    assert printed[0] == printed[1]
    assert sc.load_package(single).step([0.5], [0.0], 0.1) == sc.load_package(many).step([0.5], [0.0], 0.1)


@pytest.mark.rotated
@pytest.mark.parametrize(
    ("name", "method", "lines"),
    [("kepler", "stoermer-verlet", 280), ("kepler", "composition:4", 290), ("double-pendulum", "svi:2", 3000)],
)
def test_the_source_is_the_step_and_its_run(name, method, lines, tmp_path):
    """The source ends with fixed steps; it and the files that it includes define what the header declares."""
    model = model_of(name, method=sc.as_method(method), h=0.01)
    folder = sc.generate_package(model, tmp_path / "own_run")
    code = (folder / "own_run.c").read_text()
    assert code.count("\n") <= lines
    assert code.index("solve(") < code.index("own_run_advance(") < code.index('#include "own_run_mechanics.h"')
    assert "own_run_energy(" not in code
    assert "advance_to(" not in code
    declared = re.findall(r"^\w[\w *]*?\b(own_run_\w+)\(", (folder / "own_run.h").read_text(), re.MULTILINE)
    assert len(declared) >= 10
    (folder / "all.c").write_text(
        f'#include "own_run.h"\nint main(void) {{ return !({" && ".join(f"(long){name}" for name in declared)}); }}'
    )
    command = [needs("gcc"), "-std=c99", "-Werror", "all.c", "own_run.c", "-lm", "-o", "all"]
    subprocess.run(command, cwd=folder, check=True)
    subprocess.run([folder / "all"], check=True)
    ours, other = sc.load_package(folder), sc.compile_stepper(model.system, model.method)
    q, p = np.array([0.5, 0.1]), np.array([0.2, 1.7])
    for call in (
        lambda of: of.step(q, p, 0.1),
        lambda of: of.velocity(q, of.momentum(q, p)),
        lambda of: of.energy(q, p),
        lambda of: of.momentum_maps(q, p) if name == "kepler" else 0,
        lambda of: of.integrate(q, p, h=0.1, steps=50).p,
        lambda of: of.integrate(q, p, t_end=2.0).q[-1] if method == "svi:2" else 0,
        lambda of: of.discrete_lagrangian(q, q + 0.1, 0.1) if method != "composition:4" else 0,
    ):
        np.testing.assert_allclose(call(ours), call(other), rtol=1e-14)


@pytest.mark.rotated
@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", ["planar-pendulum", "kepler", "spherical-pendulum"])
def test_package_steps_as_the_compiled_system_without_sympy(name, tmp_path):
    model = model_of(name, method=sc.Gauss(2))
    stepper = sc.compile_stepper(model.system, model.method)
    p = model.momenta(stepper)
    folder = sc.generate_package(model, tmp_path / "generated_stepper")
    script = WITHOUT_SYMPY.format(name=folder.name, q=list(model.q), p=list(map(float, p)), h=model.h)
    result = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True, check=True)
    expected = np.concatenate(stepper.step(model.q, p, model.h))
    assert [float.fromhex(word) for word in result.stdout.split()] == expected.tolist()


@pytest.mark.rotated
@pytest.mark.parametrize(
    ("h", "solver", "reported"),
    [
        (0.5, "auto", ""),
        (
            0.5,
            "fixed-point",
            "the step from t = 0 failed: the iteration on the stage equations did not converge; use a smaller step",
        ),
        (1.5, "auto", ""),
    ],
)
def test_c_program_falls_back_to_newton_where_the_fixed_point_fails(h, solver, reported, tmp_path):
    """Two stiff springs with forces: omega h = 5 and more, where the fixed-point iteration diverges."""
    needs("make", "cc")
    text = "(x_dot**2 + y_dot**2)/2 - 50*(x**2 + y**2) - x**2*y**2"
    system = lagrange("springs", "x y", text, forces={"x": "-0.1*x_dot", "y": "cos(t) - 0.1*y_dot"})
    model = sc.Model(system=system, method="svi:2", q=(1.0, 0.5), velocity=(0.0, 0.0), h=h, steps=20)
    folder = sc.generate_package(replace(model, solver=solver), tmp_path / "springs_svi")
    if reported:
        with pytest.raises(subprocess.CalledProcessError) as failed:
            printed_by(folder)
        assert reported in failed.value.stderr
        return
    table = np.array([line.split() for line in printed_by(folder) if line[0] != "#"], dtype=float)
    run = sc.compile_stepper(system, "svi:2", solver="newton").integrate(
        model.q, velocity=model.velocity, h=h, steps=20
    )
    assert np.abs(table[:, 1:-1] - np.hstack([run.q, run.p])).max() < 1e-9
    with pytest.raises(sc.StepFailedError):
        sc.compile_stepper(system, "svi:2", solver="fixed-point").step(model.q, run.p[0], h)


def point(**arguments: Any) -> sc.Model:
    """Return a model of a point that falls."""
    run = {name: arguments.pop(name) for name in ("inputs", "events", "h") if name in arguments}
    if "inputs" in run:
        arguments |= {"forces": {"x": "u"}, "inputs": ["u"]}
    system = sc.LagrangianSystem.from_text("point", ["x", "y"], "(x_dot**2 + y_dot**2)/2 - 9*y", **arguments)
    return sc.Model(system=system, method="svi:3", q=(0.0, -1.0), velocity=(1.0, 0.0), span=1.0, **run)


def touching(*contacts: Any) -> sc.Model:
    return point(
        contacts=contacts, inputs={"u": ([0.0, 2.0], [0.0, 1.0])}, events=(sc.Event("x - 1/3"), sc.impact("x - 2", 0.5))
    )


FLOOR, WALL = sc.contact("y + 2", slip="x_dot", friction=0.2, restitution=0.5), sc.contact("x + 2")
KINDS: dict[str, str | Callable[[], sc.Model]] = {
    "adaptive": "kepler",
    "embedded": "kepler --method svi:4 --embedded double",
    "single": "double-pendulum --method svi:4 --embedded single",
    "bath": lambda: point(temperature="1", damping="1/2", h=0.01),
    "constraints": lambda: point(constraints=["x**2 + y**2 = 1"]),
    "arrays": "fput_ring.toml",
    "contacts": lambda: touching(sc.contact("y + 2"), WALL, sc.friction("y_dot", limit=0.2)),
    "friction": lambda: touching(FLOOR, WALL),
    "dry friction": lambda: touching(sc.friction("x_dot", limit=0.1)),
    "Newton": "double-pendulum --method radau-iia:2",
    "shooting": "planar-pendulum --method scvi:3",
    "collocation": "duffing --method sc:3",
    "explicit": "kepler --method stoermer-verlet",
    "explicit arrays": "fput_ring.toml --method stoermer-verlet",
    "time": "shaken_tower.toml",
    "vortices": "vortex_pairs.toml",
}
"""Arguments of ``generate``, or a model."""


@pytest.mark.tiers(0, 7)
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_folder_is_built_without_a_warning(kind, tmp_path):
    """By the generated Makefile as it is: gcc warns of bounds and uninitialised values where it optimises alone."""
    words, folder = KINDS[kind], tmp_path / "own"
    if callable(words):
        sc.generate_package(words(), folder)
    else:
        model, *options = words.split()
        model = str(Path(__file__).parents[2] / "examples" / model) if model.endswith(".toml") else model
        invoke("generate", model, *options, "-o", folder)
    flags = next(line for line in (folder / "Makefile").read_text().splitlines() if line.startswith("CFLAGS = "))
    assert "-Wall -Wextra" in flags
    command = ["make", "-s", "-C", str(folder), "own_main", f"CFLAGS={flags.removeprefix('CFLAGS = ')} -Wconversion"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "")


@pytest.mark.rotated
@pytest.mark.sampled(2)
@pytest.mark.parametrize("name", ["main.c", "pendulum_svi.c", "__init__.py", "README.md", "interface.json"])
def test_foreign_and_edited_files_require_force(pendulum, tmp_path, name):
    folder = tmp_path / "pendulum_svi"
    folder.mkdir()
    (folder / name).write_text("mine")
    with pytest.raises(sc.PackageError, match="force"):
        sc.generate_package(pendulum, folder)
    assert [(path.name, path.read_text()) for path in folder.iterdir()] == [(name, "mine")]
    sc.generate_package(pendulum, folder, force=True)
    sc.generate_package(replace(pendulum, h=0.125), folder)  # they are ours now
    if name != "interface.json":
        with (folder / name).open("a") as file:
            file.write("\n")
        with pytest.raises(sc.PackageError, match="edited"):
            sc.generate_package(pendulum, folder)


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("Pendulum-SVI", "pendulum_svi"),
        ("1st", "integrator_1st"),
        ("a b", "a_b"),
        ("main", "main_integrator"),
        ("math", "math_integrator"),
        ("class", "class_integrator"),
        ("json", "json_integrator"),
        ("numpy", "numpy_integrator"),
        ("x" * 80, "x" * 64),
    ],
)
def test_unsuitable_folder_names_are_rejected_with_a_suggestion(pendulum, tmp_path, name, hint):
    with pytest.raises(sc.PackageError, match=f"'{hint}'"):
        sc.generate_package(pendulum, tmp_path / name)
    assert not (tmp_path / name).exists()


@pytest.mark.rotated
def test_methods_without_text_form_are_generated_without_a_model_file(pendulum, tmp_path):
    own = sc.Quadrature(name="mine", points=(-0.5, 0.5), weights=(1, 1))
    folder = sc.generate_package(replace(pendulum, method=sc.SVI(1, own)), tmp_path / "own")
    assert not (folder / "model.toml").exists()
    assert sc.load_package(folder).dimension == 1


@pytest.mark.second
def test_velocities_without_momenta_are_rejected(tmp_path):
    model = model_of("relativistic-particle", velocity=(2.0,))
    with pytest.raises(sc.StateError, match="no momenta"):
        sc.generate_package(model, tmp_path / "too_fast")


@pytest.mark.rotated
@pytest.mark.parametrize(("precision", "error"), [("double", 1e-4), ("single", 1.0)])
def test_microcontroller_code_has_adaptive_steps_if_requested(tmp_path, precision, error):
    model = model_of("kepler", method=sc.SVI(4), h=None, tolerance=1e-5, span=10.0)
    folder = sc.generate_package(model, tmp_path / "board", embedded=precision)
    flags = "-O1 -std=c99 -Wall -Wextra -Werror -Wno-psabi"
    own = ["-Wdouble-promotion"] if precision == "single" else []
    subprocess.run(["cc", "-c", *flags.split(), *own, "-ffreestanding", "board.c"], cwd=folder, check=True)
    lines = printed_by(folder, flags)
    exact = sc.compile_stepper(model.system, sc.SVI(8)).integrate(model.q, velocity=model.velocity, t_end=10.0).q[-1]
    assert np.abs(np.array(lines[-2].split()[1:3], dtype=float) - exact).max() < error
    fixed = sc.generate_package(replace(model, h=0.1, tolerance=None), tmp_path / "fixed", embedded=precision)
    assert "advance_to" not in (fixed / "fixed.c").read_text()


def test_method_without_adaptive_steps_is_reported(tmp_path):
    model = model_of("kepler", method=sc.StoermerVerlet(), h=None, tolerance=1e-9)
    with pytest.raises(sc.MethodError, match="give h and steps"):
        sc.generate_package(model, tmp_path / "verlet")
    assert not (tmp_path / "verlet").exists()
