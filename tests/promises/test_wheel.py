"""Released archives: wheel and sdist are reproducible and work outside the checkout."""

import importlib.util
import json
import os
import subprocess
import sys
import tomllib
import zipfile
from datetime import date
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import scvi_codegen

ROOT = Path(__file__).parents[2]
needs_tools = pytest.mark.skipif(
    any(importlib.util.find_spec(tool) is None for tool in ("build", "hatchling", "twine", "check_wheel_contents")),
    reason="pip install 'scvi-codegen[release]'",
)


def loaded_release() -> ModuleType:
    specification = importlib.util.spec_from_file_location("release", ROOT / ".ci" / "release.py")
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


release = loaded_release()


def output_of(*command: str, folder: Path, **variables: str) -> str:
    result = subprocess.run(
        command, cwd=folder, env=os.environ | variables, capture_output=True, text=True, check=False, timeout=400
    )
    assert result.returncode == 0, result.stdout[-3000:] + result.stderr[-3000:]
    return result.stdout


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with sdist and wheel, which were built twice with equal bytes."""
    folder = tmp_path_factory.mktemp("dist")
    release.build(folder, date(2026, 11, 25))
    return folder


@needs_tools
@pytest.mark.second
def test_archives_are_complete(built):
    version = scvi_codegen.__version__
    names = {f"scvi_codegen-{version}.tar.gz", f"scvi_codegen-{version}-py3-none-any.whl"}
    assert {path.name for path in built.iterdir()} == names
    release.check(sorted(built.iterdir()))
    (wheel,) = built.glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        packed = set(archive.namelist())
    assert {name.split("/")[0] for name in packed} == {"scvi_codegen", f"scvi_codegen-{version}.dist-info"}
    packed = {name.replace("scvi_codegen/templates/", "templates/") for name in packed if ".dist-info/" not in name}
    paths = [path for folder in ("scvi_codegen", "templates") for path in (ROOT / folder).rglob("*") if path.is_file()]
    assert packed == {str(path.relative_to(ROOT)) for path in paths if "__pycache__" not in path.parts}


@pytest.fixture(scope="module")
def installed(built: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The programs of a fresh environment with the wheel, which sees the libraries of this one."""
    folder = tmp_path_factory.mktemp("installed") / "venv"
    output_of(sys.executable, "-m", "venv", "--without-pip", str(folder), folder=folder.parent)
    (wheel,) = built.glob("*.whl")
    python = str(folder / "bin" / "python")
    install = ("install", "--quiet", "--no-deps", "--no-index", str(wheel))
    output_of(sys.executable, "-m", "pip", "--python", python, *install, folder=folder.parent)
    (packages,) = folder.glob("lib/python*/site-packages")
    others = [path for path in sys.path if path and Path(path) != ROOT and ROOT / "tests" not in Path(path).parents]
    (packages / "others.pth").write_text("\n".join(others))
    return folder / "bin"


@needs_tools
@pytest.mark.full
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


@needs_tools
@pytest.mark.full
def test_the_wheel_needs_no_compiler_of_the_machine(built):
    """Only the programs of a fresh environment are on the PATH; the extra ``compiler`` provides one."""
    if importlib.util.find_spec("ziglang") is None:
        pytest.skip("pip install 'scvi-codegen[compiler]'")
    (wheel,) = built.glob("*.whl")
    release.try_wheel(wheel, libraries=[path for path in sys.path if path.endswith("-packages")])


def test_two_builds_that_differ_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(release, "LEFT_OUT", ("*",))
    ages = iter("ab")

    def made(*command: str, folder: Path, environment: dict[str, str]) -> str:
        (folder.parent / "dist").mkdir()
        (folder.parent / "dist" / "wheel").write_text(next(ages))
        return ""

    monkeypatch.setattr(release, "called", made)
    with pytest.raises(release.ReleaseError, match="two builds differ"):
        release.build(tmp_path, date(2026, 11, 25))


def test_version_date_and_licence_are_stated_alike():
    version, _ = release.version_and_date()
    assert version == scvi_codegen.__version__
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    code_licence, _, _ = project["license"].partition(" AND ")  # of the font of formulas
    assert f"license: {code_licence}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", ["CITATION.cff", "CHANGELOG.md", "scvi_codegen/version.py"])
def test_different_versions_are_refused(name, tmp_path, monkeypatch):
    for other in ("CITATION.cff", "CHANGELOG.md", "scvi_codegen/version.py"):
        text = (ROOT / other).read_text(encoding="utf-8")
        path = tmp_path / other
        path.parent.mkdir(exist_ok=True)
        path.write_text(text.replace(scvi_codegen.__version__, "9.9.9") if other == name else text, encoding="utf-8")
    monkeypatch.setattr(release, "ROOT", tmp_path)
    with pytest.raises(release.ReleaseError, match=r"versions or dates differ.*9\.9\.9.*make them equal"):
        release.version_and_date()


def test_the_recipe_requires_what_the_package_requires(tmp_path):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    sdist = tmp_path / "archive.tar.gz"
    sdist.write_bytes(b"")
    lines = release.recipe("1.2.3", sdist).splitlines()
    run = lines[lines.index("  run:") + 1 : lines.index("tests:")]
    required = {line.strip(" -").replace(" ", "") for line in run if line.strip()}
    assert required == {*project["dependencies"], "python>=${{python_min}}", "c-compiler"}
    assert '  version: "1.2.3"' in lines
    assert '  sha256: "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855"' in lines
