"""Imports point down only and in no circle, libraries have their rooms, and stepping loads nothing symbolic."""

import ast
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from programs import needs

import scvi_codegen
from scvi_codegen import Model, generate_package, problem
from scvi_codegen.common.registry import EXTRAS, MODULES, homes, part

PACKAGE = Path(scvi_codegen.__file__).parent

ROOMS = ("common", "systems", "methods", "codegen", "runs", "interfaces", "api", "extras")
"""Folders of the package in the order of the way from L to a run; imports go to the left, those for the type checker
and those inside functions, too."""
ROOT = ("__init__", "__main__", "version")
FOR_TYPES = {"runs.forwarding": {f"extras.{name}.methods" for name in ("chaos", "paths", "pictures")}}
"""Where the core tells type checkers of the methods that extras add; at run time it knows their names alone."""

OWNERS = {
    "casadi": "extras",
    "cffi": "codegen",
    "click": "interfaces extras",
    "distributed": "extras",
    "filelock": "runs",
    "h5netcdf": "common runs",
    "h5py": "common runs",
    "jax": "extras",
    "jaxlib": "extras",
    "jinja2": "codegen extras",
    "markupsafe": "extras",
    "matplotlib": "extras",
    "mpmath": "common methods runs extras",
    "pandas": "common runs",
    "platformdirs": "common",
    "scipy": "codegen runs systems extras",
    "tomli_w": "interfaces",
    "xarray": "common runs",
    "zarr": "common runs",
}
"""The rooms that may import a third-party library; NumPy and SymPy are everybody's."""


@cache
def names() -> dict[str, frozenset[str]]:
    """Dotted names that each module imports anywhere, by its dotted name within the package."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        module = ".".join(path.relative_to(PACKAGE).with_suffix("").parts).removesuffix(".__init__")
        found[module] = frozenset(imports(ast.parse(path.read_text(encoding="utf-8"))))
    return found


def room_of(module: str) -> str:
    """The folder of a module, or itself in the root."""
    return module.split(".")[0]


def statements(body: list[ast.stmt]) -> Iterator[ast.AST]:
    """Statements and those within them."""
    for node in body:
        yield node
        for name in ("body", "orelse", "finalbody", "handlers", "cases"):
            yield from statements(getattr(node, name, []))


def imports(tree: ast.Module, *, deep: bool = True) -> Iterator[str]:
    """Dotted names imported anywhere in a module, or, not deep, at its top."""
    for node in statements(tree.body) if deep else tree.body:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are written in full"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def own_module(name: str) -> str | None:
    """Return the module of this package that defines a dotted name, or None."""
    package, *parts = name.split(".")
    if package != PACKAGE.name:
        return None
    found = [module for module in (".".join(parts[:n]) for n in range(len(parts), 0, -1)) if module in names()]
    return found[0] if found else "__init__"


@cache
def used() -> dict[str, set[str]]:
    """Return the modules of this package that each imports."""
    return {
        module: {other for other in map(own_module, imported) if other is not None} - {module}
        for module, imported in names().items()
    }


def circle(used: dict[str, set[str]]) -> list[str]:
    """Modules each of which imports the next, and the last the first; empty if there are none."""
    try:
        TopologicalSorter(used).prepare()
    except CycleError as error:
        return list(error.args[1])
    return []


def test_the_package_has_eight_rooms():
    assert {room_of(module) for module in names()} == {*ROOMS, *ROOT}


def test_folders_have_at_most_16_files():
    counts = Counter(path.parent for path in PACKAGE.rglob("*.py"))
    assert len(counts) > 40
    assert [str(folder) for folder, count in counts.items() if count > 16] == []


def downwards() -> dict[str, set[str]]:
    """The modules of the package that each imports, but for those that only type checkers need."""
    return {module: others - FOR_TYPES.get(module, set()) for module, others in used().items()}


def test_imports_go_to_lower_rooms_only():
    pairs = [(m, other) for m, others in downwards().items() for other in others]
    within = [(m, other) for m, other in pairs if room_of(m) in ROOMS and room_of(other) in ROOMS]
    assert len(within) > 1000
    assert [pair for pair in within if ROOMS.index(room_of(pair[1])) > ROOMS.index(room_of(pair[0]))] == []
    assert {other for m, other in pairs if room_of(m) in ROOMS and room_of(other) not in ROOMS} == {"version"}


def test_extras_import_those_above_them_in_the_registry():
    folders = {module.split(".")[1] for module in names() if room_of(module) == "extras" and "." in module}
    assert folders == set(EXTRAS)
    order = list(EXTRAS)
    pairs = {
        (module.split(".")[1], other.split(".")[1])
        for module, others in downwards().items()
        for other in others
        if room_of(module) == room_of(other) == "extras" and "." in module and "." in other
    }
    assert len(pairs) > 20
    assert {(one, other) for one, other in pairs if order.index(one) < order.index(other)} == set()


def test_types_of_methods_that_extras_add_are_for_type_checkers_only():
    for module, others in FOR_TYPES.items():
        assert others <= used()[module]
        tree = ast.parse((PACKAGE / f"{module.replace('.', '/')}.py").read_text(encoding="utf-8"))
        at_run_time = [node for node in tree.body if not isinstance(node, ast.If)]
        assert others.isdisjoint(map(own_module, imports(ast.Module(body=at_run_time, type_ignores=[]))))


@pytest.mark.parametrize("kind", MODULES)
def test_every_registered_name_is_a_part_of_its_extra(kind):
    assert homes(kind)
    assert all(part(kind, name) is not None for name in homes(kind))


def folders() -> dict[str, set[str]]:
    """For each folder, of whatever depth, the folders and modules beside it that its modules import."""
    found: dict[str, set[str]] = {}
    for module, others in downwards().items():
        for other in others:
            parts, its = module.split("."), other.split(".")
            depth = next((n for n, (a, b) in enumerate(zip(parts, its, strict=False)) if a != b), None)
            if depth:
                found.setdefault(".".join(parts[: depth + 1]), set()).add(".".join(its[: depth + 1]))
    return found


def test_no_folder_imports_itself_indirectly():
    assert circle(folders()) == []


def test_the_package_imports_nothing_else_of_the_checkout():
    folders = {path.name for path in PACKAGE.parent.iterdir() if path.is_dir()} - {PACKAGE.name}
    assert {"benchmarks", "tests", "examples"} <= folders
    assert {name for imported in names().values() for name in imported if name.split(".")[0] in folders} == set()


def test_no_module_imports_itself_indirectly():
    assert circle(downwards()) == []


def test_circular_import_is_detected():
    assert circle({"a": {"b"}, "b": {"c"}, "c": {"a", "d"}})


def test_third_party_libraries_are_imported_by_assigned_packages_only():
    users = {(name.split(".")[0], room_of(m)) for m, imported in names().items() for name in imported}
    assert {(name, room) for name, room in users if room not in OWNERS.get(name, room).split()} == set()


POSIX = {"fcntl", "grp", "posix", "pty", "pwd", "resource", "termios"}


def test_modules_specific_to_one_kind_of_system_are_not_imported():
    assert [m for m, imported in names().items() if POSIX & {name.split(".")[0] for name in imported}] == []


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
from scvi_codegen.runs.recording import record_run, resume_run
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


@pytest.mark.tiers(0, 1)
@pytest.mark.parametrize("use", [STEPPING, RECORDING], ids=["stepping", "recording"])
def test_a_generated_package_loads_no_heavy_library(tmp_path, use):
    folder = generate_package(Model.from_problem(problem("planar-pendulum")), tmp_path / "pendulum_svi")
    names = {"parent": str(tmp_path), "name": folder.name}
    loaded_modules(STEPPING.format(**names), tmp_path)  # compiles
    loaded = loaded_modules(use.format(**names), tmp_path)
    assert "numpy" in loaded
    assert loaded.isdisjoint(HEAVY)


def test_type_checkers_find_the_public_names():
    stub = ast.parse((PACKAGE / "__init__.pyi").read_text(encoding="utf-8"))
    seen = {alias.name: node.module for node in stub.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert seen == scvi_codegen._HOME_OF | {"__version__": "scvi_codegen.version"}
    assert dir(scvi_codegen) == sorted(seen)


TYPED = """
import scvi_codegen as sc
reveal_type(sc.SVI(4))
reveal_type(sc.compile_stepper)
sc.no_such_name
"""


USE = ("systems", "symmetries", "forces", "inputs", "mechanisms", "steps")
TYPED_PAGES = (*USE, "derivatives", "chaos", "fits", "ensembles", "long_runs")


@pytest.mark.full
def test_mypy_checks_public_names_and_code_of_the_pages(tmp_path):
    (tmp_path / "typed.py").write_text(TYPED)
    files = ["typed.py"]
    for page in ("README.md", *(f"docs/{name}.md" for name in TYPED_PAGES)):
        text = (PACKAGE.parent / page).read_text(encoding="utf-8")
        files.append(f"{Path(page).stem}_page.py")
        blocks = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
        (tmp_path / files[-1]).write_text("\n".join(blocks))
    command = [sys.executable, "-m", "mypy", "--ignore-missing-imports", "--cache-dir", str(tmp_path / "cache")]
    words = [*command, *files]
    lines = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False).stdout.splitlines()
    assert 'typed.py:3: note: Revealed type is "scvi_codegen.methods.galerkin.SVI"' in lines
    assert any(line.startswith("typed.py:4") and "scvi_codegen.runs.stepper.Stepper" in line for line in lines)
    assert [line for line in lines if "error" in line] == [
        'typed.py:5: error: Module has no attribute "no_such_name"  [attr-defined]',
        f"Found 1 error in 1 file (checked {len(files)} source files)",
    ]


@pytest.mark.full
def test_pyright_checks_public_names(tmp_path):
    needs("pyright")
    text = (PACKAGE.parent / "README.md").read_text(encoding="utf-8")
    (tmp_path / "readme.py").write_text(
        "\n".join(re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL))
    )
    (tmp_path / "typed.py").write_text(TYPED)
    words = ["pyright", "--pythonpath", sys.executable, "."]
    output = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False).stdout
    assert 'Type of "sc.SVI(4)" is "SVI"' in output
    assert re.findall(r"(\w+\.py:\d+):\d+ - error", output) == ["typed.py:5"]
    assert "1 error, " in output


def test_public_names_exist_and_come_from_the_documented_modules():
    for name, home in scvi_codegen._HOME_OF.items():
        assert room_of(home.removeprefix("scvi_codegen.")) in ROOMS
        assert getattr(scvi_codegen, name) is not None
    assert set(scvi_codegen._HOME_OF) == set(scvi_codegen.__all__)
    with pytest.raises(AttributeError, match="no_such_name"):
        scvi_codegen.no_such_name  # noqa: B018  (the access is the point)
