"""Imports point down only, each third-party library has one owner, and stepping never loads the symbolic world."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import pytest

import scvi_codegen
from scvi_codegen.models.model_file import Model
from scvi_codegen.models.package import generate_package
from scvi_codegen.models.problems import problem

PACKAGE = Path(scvi_codegen.__file__).parent

FLOORS = """
    version
    errors precision program source ordering bodies files c_outline mathml cards
    derivatives expression_text nodes arguments export cache toml_text
    events
    symbols regularity quadrature
    mechanical_system translation
    system
    hamiltonian
    basis mechanics stage_system
    sampling
    invariants
    symmetry_ansatz
    symmetry_names
    symmetry
    spaces
    auxiliaries
    tableau
    number_tables
    methods.method
    methods.galerkin
    methods.collocation methods.composition
    methods.shooting
    methods
    exactness tape
    exact_motion
    derived_step
    equations lowering c_printer single_precision
    solvers.velocity_tables solvers.padding solvers.splitting rendering building
    solvers.curve_tables
    solvers.separable solvers.coupled solvers.collocation solvers.shooting
    solvers.hamiltonian
    event_source
    solvers.choice
    solvers
    trajectory
    binding text_cache
    dense_output
    event_search
    observation
    run ensemble
    stepper
    compiler
    problems pilot recording
    model_file
    package plotting advice distributed ensemble_file page
    motion
    verification.certificate verification.linearisation
    verification.subject
    verification.stepping verification.structure verification.convergence verification.identities
    verification
    exact
    __init__
    benchmark derivation
    reproduce
    cli
    __main__
"""
"""From the ground up. A room imports from the floors below it; neighbours on one floor know nothing of each other.

A folder stands here by its own name where its rooms have no floors of their own.
"""

FLOOR_OF = {room: height for height, floor in enumerate(FLOORS.split("\n")) for room in floor.split()}

OWNERS = {
    "jinja2": ["rendering", "page"],
    "cffi": ["building"],
    "platformdirs": ["cache"],
    "matplotlib": ["plotting", "benchmark", "reproduce"],
    "click": ["cli"],
    "h5py": ["export"],
    "zarr": ["export"],
    "xarray": ["export"],
    "pandas": ["export"],
}


def rooms() -> dict[str, ast.Module]:
    """Syntax trees by dotted name within the package."""
    trees = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        name = ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
        trees[name.removesuffix(".__init__")] = ast.parse(path.read_text(encoding="utf-8"))
    return trees


ROOMS = rooms()


def imports(tree: ast.Module) -> Iterator[str]:
    """Dotted names imported anywhere in a room, those for the type checker alone left out."""
    pending: list[ast.AST] = [tree]
    while pending:
        node = pending.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            pending.extend(node.orelse)
            continue
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are written in full"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
        pending.extend(ast.iter_child_nodes(node))


def own_room(name: str) -> str | None:
    """The room of this package that a dotted name stands in, or None."""
    if name.split(".")[0] != PACKAGE.name:
        return None
    parts = name.split(".")[1:]
    found = [room for room in (".".join(parts[:n]) for n in range(len(parts), 0, -1)) if room in ROOMS]
    return found[0] if found else "__init__"


def place(room: str) -> str:
    """The entry of the table that a room stands under."""
    return room if room in FLOOR_OF else room.split(".")[0]


def test_every_room_stands_on_one_floor():
    assert len(FLOOR_OF) == len(FLOORS.split())
    assert {place(room) for room in ROOMS} == set(FLOOR_OF)


@pytest.mark.parametrize("room", [room for room in ROOMS if place(room) in FLOOR_OF])
def test_imports_point_down_only(room):
    used = {place(other) for other in map(own_room, imports(ROOMS[room])) if other is not None} - {place(room)}
    assert [other for other in sorted(used) if FLOOR_OF.get(other, 0) >= FLOOR_OF[place(room)]] == []


@pytest.mark.parametrize("library", OWNERS)
def test_a_third_party_library_has_one_owner(library):
    users = {room for room, tree in ROOMS.items() if library in {name.split(".")[0] for name in imports(tree)}}
    assert {room.split(".")[0] for room in users} <= set(OWNERS[library])


HEAVY = ("sympy", "mpmath", "jinja2", "scipy", "matplotlib", "click", "tomli_w", "pycparser", "h5py", "zarr", "pandas")
"""What stepping does not need; pycparser is what cffi loads to compile."""

IMPORTING = "import scvi_codegen"
STEPPING = """
import sys
sys.path.insert(0, {parent!r})
import {name}
{name}.stepper.step([0.5], [0.0], 0.1)
"""
RECORDING = (
    STEPPING
    + """
from scvi_codegen.results.recording import record_run, resume_run
record_run({name}.stepper.start([0.5], [0.0], h=0.1), "a.run", steps=10)
resume_run("a.run", steps=20).save("a.npz")
"""
)


def loaded_modules(script: str, tmp_path: Path) -> set[str]:
    """Top-level modules loaded by a script in a fresh interpreter."""
    ending = "\nimport sys\nprint(*{name.split('.')[0] for name in sys.modules})"
    result = subprocess.run(
        [sys.executable, "-c", script + ending], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    return set(result.stdout.split())


def test_importing_the_package_loads_no_heavy_library(tmp_path):
    loaded = loaded_modules(IMPORTING, tmp_path)
    assert "scvi_codegen" in loaded
    assert loaded.isdisjoint([*HEAVY, "numpy", "cffi"])


@pytest.mark.parametrize("use", [STEPPING, RECORDING], ids=["stepping", "recording"])
def test_a_generated_package_loads_no_heavy_library(tmp_path, use):
    folder = generate_package(Model.from_problem(problem("planar-pendulum")), tmp_path / "pendulum_svi")
    names = {"parent": str(tmp_path), "name": folder.name}
    loaded_modules(STEPPING.format(**names), tmp_path)  # compiles
    loaded = loaded_modules(use.format(**names), tmp_path)
    assert "numpy" in loaded
    assert loaded.isdisjoint(HEAVY)


def test_public_names_are_all_there_and_come_from_where_they_are_said_to():
    for home, names in scvi_codegen._HOMES.items():
        assert FLOOR_OF[home] < FLOOR_OF["__init__"]
        for name in names:
            assert getattr(scvi_codegen, name) is not None
    assert set(chain(*scvi_codegen._HOMES.values())) == set(scvi_codegen.__all__)
    with pytest.raises(AttributeError, match="no_such_name"):
        scvi_codegen.no_such_name  # noqa: B018  (the access is the point)
