"""The seams: what the developers' page adds in a file and a line works, and blocks may be of any size."""

import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

import scvi_codegen
from scvi_codegen.errors import MethodError
from scvi_codegen.lowering.stage_groups import layout_of
from scvi_codegen.mechanics.lagrangian import LagrangianSystem
from scvi_codegen.methods.discretise import discretise
from scvi_codegen.methods.galerkin import SVI

ROOT = Path(scvi_codegen.__file__).parents[1]
PAGE = ROOT / "docs" / "extending.md"


# What the page adds.


def additions() -> tuple[list[tuple[str, str]], list[tuple[str, str]]]:
    """Return the code of the page by the file named above it: new files, and changes of files."""
    new, changes = (
        re.findall(rf"^`([\w/.]+)`\n\n```{kind}\n(.*?)^```$", PAGE.read_text(), re.M | re.S)
        for kind in ("python", "diff")
    )
    return new, changes


def changed(text: str, change: str) -> str:
    """The text with the one place that a diff names changed."""
    lines = [(line[:1], line[1:]) for line in change.splitlines()]
    old, new = ("".join(f"{line}\n" for sign, line in lines if sign in saved) for saved in (" -", " +"))
    assert text.count(old) == 1, f"the page changes what is not there, or not once:\n{change}"
    return text.replace(old, new)


@pytest.fixture(scope="module")
def extended(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the package with all that the page adds."""
    folder = tmp_path_factory.mktemp("extended")
    for name in ("scvi_codegen", "templates"):
        if (ROOT / name).is_dir():
            shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    new, changes = additions()
    for path, text in new:
        (folder / path).write_text(text)
    for path, change in changes:
        (folder / path).write_text(changed((folder / path).read_text(), change))
    return folder


def run(folder: Path, script: str) -> str:
    """Return the output of a script that uses the modified copy."""
    own = f"import sys\nsys.meta_path[:] = [f for f in sys.meta_path if 'editable' not in repr(f).lower()]\n{script}"
    own = own.replace("import sys\n", f"import sys\nsys.path.insert(0, {str(folder)!r})\n", 1)
    found = subprocess.run([sys.executable, "-c", own], capture_output=True, text=True, check=False, cwd=folder)
    assert found.returncode == 0, found.stderr
    return found.stdout


def test_documented_method_and_solver_need_one_file_and_one_line() -> None:
    new, changes = additions()
    lines = [line for _, change in changes for line in change.splitlines() if line[:1] in "+-"]
    assert len(new) == 2
    assert not any((ROOT / path).exists() for path, _ in new)
    assert all(line.startswith("+") for line in lines)
    assert sum("import" not in line for line in lines) == 2


def test_documented_method_is_the_midpoint_rule(extended: Path) -> None:
    script = """
import scvi_codegen, numpy as np
from scvi_codegen.methods import Gauss, method_from_specification
from scvi_codegen.models.problems import problem
from scvi_codegen.pipeline import program_of
assert scvi_codegen.__file__.startswith(sys.path[0])
system, method = problem("kepler").system, method_from_specification({"method": "midpoint"})
own, gauss = (program_of(system, each, prefix="p") for each in (method, Gauss(1)))
same = own.equations.stage_groups == gauss.equations.stage_groups, own.fixed_point == gauss.fixed_point
print(*same, *(each.exact for each in own.quantities.momentum_maps))
"""
    assert run(extended, script).split() == ["True", "True", "True"]


def test_documented_solver_agrees_with_newton(extended: Path) -> None:
    script = """
import numpy as np
from scvi_codegen import SCVI, compile_stepper
from scvi_codegen.pipeline import program_of
from scvi_codegen.models.problems import problem
given = problem("kepler")
method = SCVI(4, abscissae="gauss")
print(*(program_of(given.system, each).fixed_point.name for each in (method, SCVI(4))))
ends = []
for solver in ("fixed-point", "newton"):
    run = compile_stepper(given.system, method, solver=solver).integrate([1.0, 0.0], [0.0, 1.1], h=0.1, steps=50)
    ends.append(np.array([*run.q[-1], *run.p[-1]]))
print(abs(ends[0] - ends[1]).max() < 1e-13)
"""
    assert run(extended, script).split() == ["separable", "shooting", "True"]


def test_two_block_sizes_need_blocks_and_rows_of_each() -> None:
    """Multipliers are blocks of as many components as there are constraints."""
    rod = LagrangianSystem.from_text(
        name="mass on a rod",
        coordinates=["x", "y"],
        lagrangian="(x_dot**2 + y_dot**2)/2 - y",
        constraints=["x**2 + y**2 = 1"],
    )
    stages = discretise(rod, SVI(2, "gauss-lobatto:3"))
    assert layout_of(stages, 2) is not None
    with pytest.raises(MethodError, match="3 blocks and 2 rows of 1"):
        layout_of(replace(stages, rows=stages.rows[:-1]), 2)
