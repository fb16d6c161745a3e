"""Damaged files of every kind that a user can load: a result or an error of this package, within bounds.

Each case changes one of the files of a valid document and reads it. It may open files of its folder and those that it
names, write nothing, start nothing, and needs a bounded number of function calls and a bounded memory.
"""

import os
import re
import warnings
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from io import BytesIO
from pathlib import Path
from random import Random
from tempfile import mkdtemp
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
import pytest
from fuzzing import damaged, foreign_files, guarded, limited_memory, seeds
from random_robots import Mjcf, Urdf
from samples import QUICK_FLAGS

import scvi_codegen as sc
from scvi_codegen import BuildError, ModelFileError, generate_package, load_model
from scvi_codegen.codegen.native import building
from scvi_codegen.interfaces.models.model_files.ensemble_file import load_ensemble

ROBOTS = Path(__file__).parents[1] / "systems" / "robots"
END = '[method]\nmethod = "svi:2"\n[run]\nstep = 0.1\nsteps = 10\n'
PUSHED = f"""
[system]
name = "swing"
coordinates = ["q"]
lagrangian = "q_dot**2/2 - w*q**2/2 + u*q + v*q**2"
inputs = ["u", "v"]
[parameters]
w = 1.0
[inputs]
u = {{ file = "u.csv" }}
v = {{ file = "v.npz" }}
[initial]
q = [1.0]
q_dot = [0.0]
{END}
[[events]]
function = "q - 0.2"
then = {{ p_q = "-p_q" }}
"""
NET = f'''
[system]
name = "net"
coordinates = ["r[N, 2]"]
lagrangian = """sum(i in N, m[i]*sum(a in 2, r_dot[i, a]**2)/2)
    - k*sum(b in B, (r[bonds[b, 0], 0] - r[bonds[b, 1], 0])**2)"""
[tables]
"bonds[B, 2]" = {{ file = "bonds.csv" }}
[sizes]
N = 3
[parameters]
k = 1.0
"m[N]" = {{ file = "m.npy" }}
[initial]
q = {{ r = ["cos(i)", "sin(2*i)/3"] }}
q_dot = {{ r = 0.0 }}
{END}
'''
ENTRIES = f"""
[system]
name = "ring"
coordinates = ["x", "q[4]"]
lagrangian = "x_dot**2/2 + sum(i in 4, q_dot[i]**2/2) - sum(i in 4 periodic, (q[i+1] - q[i])**2/2) - x*q[0]"
[initial]
q = {{ x = 0.0, q = [1.0, 0.5, 0.0, -0.5] }}
q_dot = {{ x = 0.0, q = [0.0, 0.0, 0.0, 0.0] }}
{END}
"""
RING = f"""
[system]
name = "ring"
coordinates = ["a", "b"]
lagrangian = "a_dot**2/2 + b_dot**2/2 - (a - b)**4/4"
[initial]
q = [1.0, 0.5]
q_dot = [0.0, 0.0]
{END}
"""
BODY = f"""
[system]
name = "top"
rotations = {{ R = "omega" }}
lagrangian = "(A*(omega_1**2 + omega_2**2) + C*omega_3**2)/2 - R_33"
[parameters]
A = 1.0
C = 0.5
[initial]
q = {{ R = [0.9, 0.3, -0.2, 0.1] }}
q_dot = {{ omega = [0.1, 0.2, 3.0] }}
{END}
"""
CHAIN = f"""
[system]
name = "chain"
coordinates = ["q[N]"]
lagrangian = "sum(i in N, q_dot[i]**2/2) - sum(i in N periodic, k*(q[i+1] - q[i])**2/2)"
[parameters]
k = 1.0
[sizes]
N = 3
[initial]
q = {{ q = [0.1, 0.2, 0.3] }}
q_dot = {{ q = 0.0 }}
{END}
"""
FIELD = f"""
[field]
name = "string"
fields = ["u"]
space = {{ x = [0.0, 1.0] }}
boundary = {{ x = ["a*sin(3*t)", "natural"] }}
density = "u_t**2/2 - c**2*u_x**2/2 - 0.1*u**4"
discretisation = {{ method = "spectral-elements", degree = 4, elements = 2 }}
[parameters]
a = 0.1
c = 1.25
[initial]
q = "0.1*c*sin(x) + t"
q_dot = 0.1
{END}
"""
PERIODIC = FIELD.replace('["a*sin(3*t)", "natural"]', '"periodic"').replace(
    'method = "spectral-elements", degree = 4, elements = 2', 'method = "fourier", points = 8'
)


class Kind(NamedTuple):
    """Files of a valid document, and how the folder is read."""

    files: dict[str, bytes]
    read: Callable[[Path], Any]


def read_inputs(folder: Path) -> Any:
    """The model with its tables of inputs."""
    return load_model(folder / "model.toml").all_inputs()


def model(text: str, **files: bytes) -> Kind:
    """A model file, and the files that it names."""
    others = {name.replace("_", "."): data for name, data in files.items()}
    return Kind({"model.toml": text.encode(), **others}, lambda folder: load_model(folder / "model.toml"))


def of_folder(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.suffix in (".json", ".npz")}


def read_run(folder: Path) -> Any:
    run = sc.load_run(folder)
    return np.asarray(run.q), np.asarray(run.t), repr(run), len(run)


def read_package(folder: Path) -> Any:
    """All of a generated folder but its C code, which is compiled, and runs, as the code that it is."""
    with mock.patch.object(building, "load", side_effect=BuildError("not compiled here")):
        return sc.load_package(folder)


def saved(write: Callable[..., None], *values: Any, **arrays: Any) -> bytes:
    """Return the file that a function of NumPy writes."""
    write(file := BytesIO(), *values, **arrays)
    return file.getvalue()


@cache
def models() -> dict[str, Kind]:
    """Valid model files."""
    tables = {"u.csv": b"t,u\n0,0\n5,1\n10,1.5\n", "v.npz": saved(np.savez, t=[0.0, 10.0], v=[0.0, 1.0])}
    return {
        "inputs": Kind({"model.toml": PUSHED.encode(), **tables}, read_inputs),
        "arrays": model(NET, bonds_csv=b"a,b\n0,1\n1,2\n", m_npy=saved(np.save, [1.0, 2.0, 3.0])),
        "named entries": model(ENTRIES),
        "rotations": model(BODY),
        "field": model(FIELD),
        "periodic field": model(PERIODIC),
    }


@cache
def kinds() -> dict[str, Kind]:
    """Valid documents of every kind."""
    folder = Path(mkdtemp())
    swing = sc.problem("planar-pendulum")
    stepper = sc.compile_stepper(swing.system, "svi:2", flags=QUICK_FLAGS)
    sc.record_run(stepper.start([1.0], [0.0], h=0.1), folder / "a.run", steps=20, rows=8)
    made = load_written(folder, RING)
    package = generate_package(made, folder / "ring")
    packed = files_in(package)
    chain = sc.compile_stepper(load_written(folder, CHAIN).array_system, "svi:2", flags=QUICK_FLAGS)
    kepler = sc.Model.from_problem(sc.problem("kepler"))
    names = [q.name for q in kepler.system.coordinates]
    grid = f"[grid]\n{names[0]} = {{ from = 0.1, to = 0.5, count = 3 }}\n{names[1]} = [0.1, 0.2]\n"
    run = stepper.start([1.0], [0.0], h=0.1)
    run.advance(3)
    checkpoint = run.checkpoint()
    return {
        **models(),
        **{f"corpus {k}": model(text) for k, text in enumerate(seeds("models")) if "[grid]" not in text},
        "grid": Kind({"grid.toml": grid.encode()}, lambda folder: load_ensemble(folder / "grid.toml", kepler)),
        "ensemble": Kind(
            {"states.csv": f"{names[0]},{names[1]}\n0.1,0.2\n0.3,0.4\n".encode()},
            lambda folder: load_ensemble(folder / "states.csv", kepler),
        ),
        "recording": Kind(of_folder(folder / "a.run"), read_run),
        "package": Kind(packed, read_package),
        "checkpoint": Kind(
            {"saved": checkpoint}, lambda folder: stepper.from_checkpoint((folder / "saved").read_bytes())
        ),
        "urdf": Kind(
            {"arm.urdf": (ROBOTS / "arm.urdf").read_bytes()},
            lambda folder: sc.LagrangianSystem.from_urdf(folder / "arm.urdf"),
        ),
        "mjcf": Kind(
            {"ball.xml": (ROBOTS / "ball.xml").read_bytes()},
            lambda folder: sc.LagrangianSystem.from_mjcf(folder / "ball.xml"),
        ),
        "mjcf equalities": Kind(
            {"figure.xml": (ROBOTS / "figure.xml").read_bytes()},
            lambda folder: sc.LagrangianSystem.from_mjcf(folder / "figure.xml"),
        ),
        "random mjcf": Kind(
            {path.name: path.read_bytes() for path in Mjcf(3).write(folder).parent.glob("*.xml")},
            lambda folder: sc.LagrangianSystem.from_mjcf(folder / "model.xml"),
        ),
        "random urdf": Kind(
            {"robot.urdf": Urdf(3).document.encode()},
            lambda folder: sc.LagrangianSystem.from_urdf(folder / "robot.urdf", floating=True, actuated=True),
        ),
        "package of arrays": Kind(
            files_in(generate_package(load_written(folder, CHAIN), folder / "package_of_arrays")), read_package
        ),
        "checkpoint of arrays": Kind(
            {"saved": checkpoint_of(chain)}, lambda folder: chain.from_checkpoint((folder / "saved").read_bytes())
        ),
    }


def files_in(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def checkpoint_of(chain: sc.Stepper) -> bytes:
    run = chain.start({"q": [0.1, 0.2, 0.3]}, {"q": [0.0, 0.0, 0.0]}, h=0.1)
    run.advance(3)
    return run.checkpoint()


def load_written(folder: Path, text: str) -> sc.Model:
    (folder / "written.toml").write_text(text)
    return load_model(folder / "written.toml")


def attempt(kind: Kind, folder: Path, text: str) -> bool:
    """Return whether a document is read; only errors of this package may be raised."""
    with warnings.catch_warnings(), limited_memory(), guarded(may_compile=True):
        warnings.simplefilter("ignore")
        try:
            kind.read(folder)
        except sc.ScviCodegenError:
            return False
        finally:
            foreign = foreign_files(folder, text)
    if foreign:
        raise AssertionError(foreign)
    return True


def try_file(number: int, root: Path) -> bool:
    """Damage one file of a document, chosen by the number of the case."""
    random = Random(number)
    chosen = list(kinds())[number % len(kinds())]
    kind, folder = kinds()[chosen], root / chosen.replace(" ", "_")
    read = ["interface.json", "model.toml"] if chosen.startswith("package") else list(kind.files)
    name = random.choice([each for each in kind.files if each in read])
    data = damaged(random, kind.files[name], seeds("models"))
    (folder / name).write_bytes(data)
    try:
        return attempt(kind, folder, data.decode(errors="replace"))
    except BaseException as error:
        error.add_note(f"case {number}: {chosen}, {name}: {data[:3000]!r}")
        raise
    finally:
        (folder / name).write_bytes(kind.files[name])


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with all valid documents, each read once so that nothing is imported later."""
    root = tmp_path_factory.mktemp("files")
    for chosen, kind in kinds().items():
        for name, data in kind.files.items():
            (path := root / chosen.replace(" ", "_") / name).parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        refused = suppress(BuildError, *[sc.ScviCodegenError] * chosen.startswith("corpus"))  # some of them are wrong
        with warnings.catch_warnings(action="ignore"), refused:
            kind.read(root / chosen.replace(" ", "_"))
    return root


@pytest.mark.rotated
def test_damaged_files_are_read_or_rejected(root: Path) -> None:
    assert sum(try_file(number, root) for number in range(240)) > 12


@pytest.mark.full
@pytest.mark.parametrize("part", range(10))
def test_hundred_thousand_damaged_files(root: Path, part: int) -> None:
    assert sum(try_file(number, root) for number in range(1000 + 10_000 * part, 11_000 + 10_000 * part)) > 500


TOO_LARGE = {
    "N = 3": ("arrays", "N = 2000000000", "2000000000"),
    "4": ("named entries", "99999999", "named coordinates"),
    "[0.0, 1.0]": ("field", "[0.0, 1e-300]", "other units of length"),
    'fields = ["u"]': ("field", 'fields = ["*/"]', "field"),
}


@pytest.mark.parametrize("old", TOO_LARGE)
def test_values_out_of_range_are_rejected(old: str, tmp_path: Path) -> None:
    chosen, new, message = TOO_LARGE[old]
    files = {**models()[chosen].files}
    files["model.toml"] = files["model.toml"].replace(old.encode(), new.encode())
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    with limited_memory(), guarded(may_compile=True), pytest.raises(ModelFileError, match=re.escape(message)):
        load_model(tmp_path / "model.toml")


@pytest.mark.parametrize("load", [sc.load_model, sc.load_run, sc.load_package])
def test_paths_with_null_characters_are_rejected(load: Callable[[str], Any]) -> None:
    with pytest.raises(sc.ScviCodegenError, match="null character"):
        load("a\0b")


@pytest.mark.rotated
@pytest.mark.parametrize("degree", [31, pytest.param(63, marks=pytest.mark.full)])
def test_elements_of_high_degree_are_assembled_in_bounded_work(degree: int, tmp_path: Path) -> None:
    (tmp_path / "model.toml").write_text(FIELD.replace("degree = 4", f"degree = {degree}"))
    with guarded(may_compile=True):
        load_model(tmp_path / "model.toml")


@pytest.mark.rotated
@pytest.mark.parametrize("name", ["model.toml", "u.csv", "v.npz", "grid.toml", "states.csv", "manifest.json"])
@pytest.mark.parametrize("other", ["device", "pipe", "folder"])
def test_only_regular_files_are_read(name: str, other: str, tmp_path: Path) -> None:
    """A device could be read without end; a pipe would wait for a writer."""
    kind = next(each for each in kinds().values() if name in each.files)
    for each, data in kind.files.items():
        (tmp_path / each).write_bytes(data)
    (tmp_path / name).unlink()
    if other == "device":
        (tmp_path / name).symlink_to("/dev/zero")
    elif other == "pipe":
        os.mkfifo(tmp_path / name)
    else:
        (tmp_path / name).mkdir()
    with limited_memory(), guarded(may_compile=True), pytest.raises(sc.ScviCodegenError, match=r"regular|directory"):
        kind.read(tmp_path)


@pytest.mark.second
def test_an_undefined_change_of_the_state_is_not_one_of_the_event_function() -> None:
    stepper = sc.compile_stepper(
        sc.problem("harmonic-oscillator").system,
        "svi:2",
        flags=QUICK_FLAGS,
        events=sc.Event("q", then={"p_q": "log(-1 - q**2)"}),
    )
    with pytest.raises(sc.EventError, match=r"the state after the event 'q' is not finite .* then="):
        stepper.integrate([1.0], [0.0], h=0.1, steps=30)
