"""The core knows no extra and works without them; extras use the api and public names alone."""

import ast
import importlib
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import scvi_codegen

PACKAGE = Path(scvi_codegen.__file__).parent
MODULES = ("checks", "commands", "formulas", "methods", "program", "runs", "states", "systems", "text")


def taken() -> Iterator[str]:
    """Names of the core, after their modules, that extras import although they are neither public nor of the api."""
    for path in (PACKAGE / "extras").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.ImportFrom) or not (node.module or "").startswith("scvi_codegen."):
                continue
            home = (node.module or "").removeprefix("scvi_codegen.")
            if home.split(".")[0] not in ("api", "extras", "version") and home != "common.errors":
                private = (name.name for name in node.names if scvi_codegen._HOME_OF.get(name.name) != node.module)
                yield from (f"{home} {name}" for name in private)


def test_extras_take_no_private_name_of_the_core():
    assert set(taken()) == set(), "use scvi_codegen.api, public names or methods of documented classes"


def test_the_api_has_at_most_sixty_names_and_describes_each():
    modules = [importlib.import_module(f"scvi_codegen.api.{name}") for name in MODULES]
    assert {path.stem for path in (PACKAGE / "api").glob("*.py")} == {*MODULES, "__init__"}
    assert sum(len(module.__all__) for module in modules) <= 60
    for module in modules:
        described = re.findall(r"``(\w+)", module.__doc__) + [
            name for name in module.__all__ if getattr(getattr(module, name), "__module__", "") == module.__name__
        ]
        assert {*module.__all__} <= {*described}
        assert all(hasattr(module, name) for name in module.__all__)


WITHOUT = """
import subprocess
import scvi_codegen as sc
from click.testing import CliRunner
from scvi_codegen.interfaces.cli import main
assert sc.__file__.startswith(sys.path[0])
kepler = sc.problem("kepler")
stepper = sc.compile_stepper(kepler.system, "svi:4")
run = stepper.integrate(kepler.q, velocity=kepler.velocity, t_end=1.0, tolerance=1e-9)
print(abs(run.energy() - run.energy()[0]).max() < 1e-8, not any("scvi_codegen.extras" in name for name in sys.modules))
for line in ("run kepler --span 1", "generate kepler -o kepler_svi", "systems", "verify kepler"):
    print(line.split()[0], CliRunner().invoke(main, line.split()).exit_code)
try:
    run.plot
except sc.MissingLibraryError as refusal:
    print(refusal)
"""


@pytest.mark.second
def test_the_core_works_without_extras(tmp_path):
    for name in ("scvi_codegen", "templates"):
        shutil.copytree(PACKAGE.parent / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__", "extras"))
    own = f"import sys\nsys.path.insert(0, {str(tmp_path)!r})\n{WITHOUT}"
    found = subprocess.run([sys.executable, "-c", own], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert found.returncode == 0, found.stderr
    *lines, refusal = found.stdout.splitlines()
    assert lines == ["True True", "run 0", "generate 0", "systems 0", "verify 2"]
    assert refusal.startswith("'plot' is part of the extra 'pictures', which this installation is without")
    assert (tmp_path / "kepler_svi" / "Makefile").is_file()
