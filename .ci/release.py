"""Build, check and test the archives of a release; ``--upload`` uploads them.

    pip install -e '.[release]'
    python .ci/release.py

The archives are built twice, in copies of the checkout, and must have equal bytes. The wheel is then installed into a
fresh environment with the compiler from a wheel (extra ``compiler``), where no other program of this machine is on the
PATH, and integrates an orbit. ``dist`` contains wheel, sdist, their checksums, and the conda recipe with the checksum
of the sdist.
"""

import argparse
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from datetime import UTC, date, datetime
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
RECIPE = Path(__file__).with_name("recipe.yaml")
LEFT_OUT = (".git", ".venv", "venv", ".*_cache", ".hypothesis", "__pycache__", "site", "dist", "build", "*.egg-info")
"""Files of a checkout that are not part of it."""
PACKAGES = "import sysconfig; print(sysconfig.get_path('purelib'))"


class ReleaseError(Exception):
    """A check of the release failed."""


def called(*command: str, folder: Path, environment: dict[str, str] | None = None) -> str:
    """Return what a command prints."""
    result = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    if result.returncode:
        raise ReleaseError(f"{' '.join(command)} failed:\n{result.stdout[-3000:]}{result.stderr[-3000:]}")
    return result.stdout


def version_and_date() -> tuple[str, date]:
    """Return version and date, which the package, the citation and the changelog must state alike."""
    texts = {name: (ROOT / name).read_text(encoding="utf-8") for name in ("CITATION.cff", "CHANGELOG.md")}
    texts["version.py"] = (ROOT / "scvi_codegen/version.py").read_text(encoding="utf-8")
    patterns = {
        "version.py": r'^__version__ = "(\d+\.\d+\.\d+)"$',
        "CITATION.cff": r"^version: (\S+)\n(?:.*\n)*?date-released: (\S+)$",
        "CHANGELOG.md": r"^## (\S+) \((\S+)\)$",
    }
    stated = {name: re.search(pattern, texts[name], re.MULTILINE) for name, pattern in patterns.items()}
    for name, match in stated.items():
        if match is None:
            raise ReleaseError(f"{name} states no released version: set version and date of the release there")
    versions = {name: match[1] for name, match in stated.items() if match}
    days = {name: match[2] for name, match in stated.items() if match and match.lastindex == 2}
    if len(set(versions.values())) > 1 or len(set(days.values())) > 1:
        raise ReleaseError(f"versions or dates differ, {versions}, {days}: make them equal")
    return versions["version.py"], date.fromisoformat(days["CHANGELOG.md"])


def checksums(paths: Sequence[Path]) -> dict[str, str]:
    """Return the SHA-256 checksums of files by their names."""
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(paths)}


def build(output: Path, day: date) -> list[Path]:
    """Build sdist and wheel twice, in copies of different age, and return those of the first, if both are equal."""
    epoch = str(int(datetime(day.year, day.month, day.day, tzinfo=UTC).timestamp()))
    made = []
    for age in (10**6, 10**8):
        with tempfile.TemporaryDirectory(prefix="scvi-codegen-release-") as folder:
            checkout, dist = Path(folder) / "checkout", Path(folder) / "dist"
            shutil.copytree(ROOT, checkout, ignore=shutil.ignore_patterns(*LEFT_OUT))
            for path in checkout.rglob("*"):
                os.utime(path, (age, age))
            command = (sys.executable, "-m", "build", "--no-isolation", "--outdir", str(dist))
            called(*command, folder=checkout, environment=os.environ | {"SOURCE_DATE_EPOCH": epoch})
            if not made:
                for path in dist.iterdir():
                    shutil.copy(path, output)
            made.append(checksums([*dist.iterdir()]))
    if made[0] != made[1]:
        raise ReleaseError(f"two builds differ: {made}")
    return [output / name for name in made[0]]


def check(archives: Sequence[Path]) -> None:
    """Check the description for the index, and the files of the wheel."""
    names = [str(path) for path in archives]
    called(sys.executable, "-m", "twine", "check", "--strict", *names, folder=ROOT)
    for name in names:
        if name.endswith(".whl"):
            called(sys.executable, "-m", "check_wheel_contents", name, folder=ROOT)


def try_wheel(wheel: Path, *, libraries: Sequence[str] = ()) -> None:
    """Install the wheel into a fresh environment and integrate an orbit, with no compiler but that from a wheel.

    Args:
        wheel: wheel to try.
        libraries: folders with its dependencies, by default installed from the index.
    """
    with tempfile.TemporaryDirectory(prefix="scvi-codegen-wheel-") as name:
        folder = Path(name)
        called(sys.executable, "-m", "venv", *(["--without-pip"] * bool(libraries)), "environment", folder=folder)
        programs = folder / "environment" / ("Scripts" if os.name == "nt" else "bin")
        pip = (sys.executable, "-m", "pip", "--python", str(programs / "python"), "install", "--quiet")
        if libraries:
            called(*pip, "--no-deps", "--no-index", str(wheel), folder=folder)
            packages = Path(called(str(programs / "python"), "-c", PACKAGES, folder=folder).strip())
            (packages / "libraries.pth").write_text("\n".join(libraries), encoding="utf-8")
        else:
            called(*pip, f"{wheel}[compiler]", folder=folder)
        # Windows needs SYSTEMROOT to start any program.
        bare = {name: os.environ[name] for name in ("SYSTEMROOT",) if name in os.environ}
        bare |= {"PATH": str(programs), "HOME": name, "TMPDIR": name, "TEMP": name, "LANG": "C.UTF-8"}
        bare |= {"LOCALAPPDATA": name, "SCVI_CODEGEN_CACHE": str(folder / "cache")}
        program = str(programs / "scvi-codegen")
        called(program, "run", "kepler", "-o", "orbit.npz", folder=folder, environment=bare)
        found = json.loads(called(program, "doctor", "--json", folder=folder, environment=bare))
        if "zig" not in json.dumps(found):
            raise ReleaseError(f"the compiler from a wheel was not used: {found}")
        if not (folder / "orbit.npz").is_file():
            raise ReleaseError("scvi-codegen run wrote no file")


def recipe(version: str, sdist: Path) -> str:
    """Return the conda recipe with version and checksum."""
    text = RECIPE.read_text(encoding="utf-8")
    for key, value in {"version": f'"{version}"', "sha256": f'"{checksums([sdist])[sdist.name]}"'}.items():
        text, count = re.subn(rf"^( *{key}: ).*$", rf"\g<1>{value}", text, count=1, flags=re.MULTILINE)
        if count != 1:
            raise ReleaseError(f"{RECIPE.name} has no line for {key}")
    return text


def main() -> None:
    """Run all steps."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "dist", metavar="FOLDER", help="Folder to write.")
    parser.add_argument("--upload", action="store_true", help="Upload wheel and sdist by twine.")
    parser.add_argument("--repository", default="pypi", help="Index as twine is configured: pypi, testpypi.")
    parser.add_argument("--offline", action="store_true", help="Try the wheel with the libraries of this environment.")
    arguments = parser.parse_args()
    version, day = version_and_date()
    if arguments.upload and called("git", "status", "--porcelain", folder=ROOT):
        raise ReleaseError("the checkout has changes that are not committed: commit or remove them before an upload")
    shutil.rmtree(arguments.output, ignore_errors=True)
    arguments.output.mkdir(parents=True)
    print(f"scvi-codegen {version} of {day}: build twice", flush=True)
    archives = build(arguments.output, day)
    print("equal bytes; check contents", flush=True)
    check(archives)
    (wheel,) = (path for path in archives if path.suffix == ".whl")
    (sdist,) = (path for path in archives if path.suffix == ".gz")
    print("try the wheel without a compiler of the machine", flush=True)
    libraries = [path for path in sys.path if path.endswith("-packages")]
    try_wheel(wheel, libraries=libraries if arguments.offline else ())
    sums = "".join(f"{digest}  {name}\n" for name, digest in checksums(archives).items())
    (arguments.output / "SHA256SUMS").write_text(sums, encoding="utf-8")
    (arguments.output / "recipe.yaml").write_text(recipe(version, sdist), encoding="utf-8")
    upload = (sys.executable, "-m", "twine", "upload", "--repository", arguments.repository, *map(str, archives))
    print(f"{sums}{arguments.output} is complete.")
    if arguments.upload:
        subprocess.run(upload, check=True)
    else:
        print(f"Upload it:\n  python {' '.join(upload[1:])}")
    print(f"Then tag the commit:\n  git tag v{version} && git push origin v{version}")
    print("and propose recipe.yaml to conda-forge (staged-recipes, later the feedstock).")


if __name__ == "__main__":
    try:
        main()
    except ReleaseError as error:
        sys.exit(f"release: {error}")
