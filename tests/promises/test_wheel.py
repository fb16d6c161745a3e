"""Released archives: wheel and sdist are reproducible and work outside the checkout."""

import hashlib
import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import numpy as np
import pytest

import scvi_codegen

ROOT = Path(__file__).parents[2]
TOOLS = ("build", "hatchling", "twine", "check_wheel_contents")
LEFT_BEHIND = shutil.ignore_patterns(".git", ".venv", "venv", ".*_cache", ".hypothesis", "__pycache__", "site", "dist")
EPOCH = "1700000000"

pytestmark = [
    pytest.mark.full,
    pytest.mark.skipif(
        any(importlib.util.find_spec(tool) is None for tool in TOOLS), reason="pip install 'scvi-codegen[release]'"
    ),
]


def output_of(*command: str, folder: Path, **variables: str) -> str:
    result = subprocess.run(
        command, cwd=folder, env=os.environ | variables, capture_output=True, text=True, check=False, timeout=400
    )
    assert result.returncode == 0, result.stdout[-3000:] + result.stderr[-3000:]
    return result.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Folders with an sdist and a wheel each, of two copies that are not equally old."""
    folders = []
    for name, age in (("first", 10**6), ("second", 10**8)):
        copy = tmp_path_factory.mktemp(name) / "checkout"
        shutil.copytree(ROOT, copy, ignore=LEFT_BEHIND)
        for path in copy.rglob("*"):
            os.utime(path, (age, age))
        output_of(sys.executable, "-m", "build", "--no-isolation", folder=copy, SOURCE_DATE_EPOCH=EPOCH)
        folders.append(copy / "dist")
    return folders


def digests(folder: Path) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in folder.iterdir()}


def test_two_builds_have_the_same_bytes(built):
    first, second = map(digests, built)
    assert first == second
    version = scvi_codegen.__version__
    assert set(first) == {f"scvi_codegen-{version}.tar.gz", f"scvi_codegen-{version}-py3-none-any.whl"}


def test_wheel_contents_are_complete(built):
    files = sorted(map(str, built[0].iterdir()))
    assert "PASSED" in output_of(sys.executable, "-m", "twine", "check", "--strict", *files, folder=built[0])
    wheel = next(name for name in files if name.endswith(".whl"))
    assert ": OK" in output_of(sys.executable, "-m", "check_wheel_contents", wheel, folder=built[0])
    with zipfile.ZipFile(wheel) as archive:
        packed = set(archive.namelist())
    version = scvi_codegen.__version__
    assert {name.split("/")[0] for name in packed} == {"scvi_codegen", f"scvi_codegen-{version}.dist-info"}
    packed = {name.replace("scvi_codegen/templates/", "templates/") for name in packed if ".dist-info/" not in name}
    paths = [path for folder in ("scvi_codegen", "templates") for path in (ROOT / folder).rglob("*") if path.is_file()]
    assert packed == {str(path.relative_to(ROOT)) for path in paths if "__pycache__" not in path.parts}


def test_tests_documentation_and_benchmarks_run_from_the_source_archive(built):
    (archive,) = built[0].glob("*.tar.gz")
    with tarfile.open(archive) as packed:
        entries = {name.split("/")[1] for name in packed.getnames()}
    assert entries >= {"scvi_codegen", "templates", "tests", "docs", "examples", "benchmarks", "generated", ".ci"}
    assert entries >= {path.name for path in ROOT.iterdir() if path.suffix in (".md", ".toml", ".cff")}
    assert entries >= {"LICENSE", ".clang-format", ".gitattributes", ".gitignore"}


@pytest.fixture(scope="module")
def installed(built: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The programs of a fresh environment with the wheel, which sees the libraries of this one."""
    folder = tmp_path_factory.mktemp("installed") / "venv"
    output_of(sys.executable, "-m", "venv", "--without-pip", str(folder), folder=folder.parent)
    (wheel,) = built[0].glob("*.whl")
    python = str(folder / "bin" / "python")
    install = ("install", "--quiet", "--no-deps", "--no-index", str(wheel))
    output_of(sys.executable, "-m", "pip", "--python", python, *install, folder=folder.parent)
    (packages,) = folder.glob("lib/python*/site-packages")
    others = [path for path in sys.path if path and Path(path) != ROOT and ROOT / "tests" not in Path(path).parents]
    (packages / "others.pth").write_text("\n".join(others))
    return folder / "bin"


def test_the_wheel_works_outside_the_checkout(installed, tmp_path):
    place = "import scvi_codegen; print(scvi_codegen.__file__)"
    assert Path(output_of(str(installed / "python"), "-c", place, folder=tmp_path)).is_relative_to(installed.parent)
    variables = {"SCVI_CODEGEN_CACHE": str(tmp_path / "cache")}
    program = str(installed / "scvi-codegen")
    output_of(program, "run", "kepler", "-o", "orbit.npz", folder=tmp_path, **variables)
    with np.load(tmp_path / "orbit.npz") as orbit:
        assert orbit["q"].shape[1] == 2
    found = json.loads(output_of(program, "doctor", "--json", folder=tmp_path, **variables))
    assert found["ok"]
    assert {each["name"]: each["status"] for each in found["findings"]}["trial"] == "ok"


def test_citation_has_the_current_version():
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    released = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8").split("\n## ")[1:]
    unreleased = [entry.split()[0] for entry in released if "(unreleased)" in entry.splitlines()[0]]
    cited = next(line for line in citation.splitlines() if line.startswith("version:")).split()[1]
    version, developed, _ = scvi_codegen.__version__.partition(".dev")
    assert version in unreleased if developed else cited == version
    assert f"license: {project['license']}" in citation
