"""Robots' files of a folder: which are loaded, which move as in MuJoCo, and why others are refused.

    python benchmarks/robot_files.py FOLDER

MJCF files are compared with MuJoCo, if it is installed, at a random state: energy, power and equations of motion. URDF
files are loaded, and not compared.
"""

import sys
import warnings
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from scvi_codegen import LagrangianSystem
from scvi_codegen.common.errors import MissingLibraryError, SystemDefinitionError

sys.path.append(str(Path(__file__).parents[1] / "tests" / "tools"))
from random_robots import errors_of_motion  # type: ignore[import-not-found]

EQUAL = 1e-8
"""Largest error of a file that counts as equal."""


def outcome(path: Path, folder: Path) -> str:
    """Return what becomes of a file, the reason first; it may name files of the whole folder."""
    try:
        if path.suffix == ".urdf":
            LagrangianSystem.from_urdf(path)
            return "loaded"
        system = LagrangianSystem.from_mjcf(path, actuators=True, folders=[folder])
    except (SystemDefinitionError, MissingLibraryError) as error:
        return f"refused: {str(error).removeprefix(str(path))}"
    try:
        worst = max(errors_of_motion(system, path))
    except ImportError:
        return "loaded"
    except ValueError as error:  # MuJoCo does not read it
        return f"loaded, not compared: {error!s:.100}"
    return "loaded and equal" if worst < EQUAL else f"loaded, with an error of {worst:.1e}"


def robots(folder: Path) -> Iterator[Path]:
    """Yield the files of robots in a folder and those below."""
    for path in sorted(folder.rglob("*")):
        beginning = path.read_bytes()[:10000] if path.suffix in (".urdf", ".xml", ".mjcf") and path.is_file() else b""
        if path.suffix == ".urdf" or b"<mujoco>" in beginning or b"<mujoco " in beginning:
            yield path


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    kinds = Counter[str]()
    for file in robots(Path(sys.argv[1])):
        text = outcome(file, Path(sys.argv[1]))
        kinds[text.partition(":")[0].partition(", with")[0]] += 1
        print(f"{file}: {text}", flush=True)
    print(", ".join(f"{count} {kind}" for kind, count in kinds.items()))
